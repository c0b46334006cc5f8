"""Weights of points with which a diffusing system on a closed surface conserves its mass."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from ..arguments import instance, real
from ..compiling import sized_jit
from ..failures import refuse
from ..stencils.stencil import Stencil, prepared
from .krylov import BiCGStab, solve_system
from .precondition import AbstractPreconditioner, multigrid
from .system import System, check_system

# Relative tolerance of two solves, of which the second takes away what the first one leaves, in
# units of round-off.
_SOLVED = 1e4
# Largest sum of weights times a column of the operator that counts as round-off, in units of it and
# of the sum of moduli.
_LEFT = 1e3


def conservative_weights(
    operator: Stencil,
    total: ArrayLike,
    *,
    preconditioner: AbstractPreconditioner | None = None,
) -> Float[Array, " n"]:
    r"""Weights m with $m^T L = 0$: $\sum_i m_i u_i$ is what $\partial_t u = L u$ conserves.

    The areas of the points fit $\sum_i a_i (L u)_i = 0$ to the order of the operator only, so that
    the mass $\sum_i a_i u_i$ drifts. On a connected closed surface there is, but for a factor, one
    vector of weights with which it does not. It is a quadrature of the surface as well.

    Args:
        operator: L, scalar, of a connected closed surface: it annihilates the constants.
        total: what the weights add up to: the area of the surface, `surface.areas.sum()`.
        preconditioner: from `multigrid(operator)`; made here if None, under `jit` and `vmap` where
            the neighbours are concrete.

    Returns:
        Weights `(n,)`, in the units of `total`; as `mass=` of a problem in time they make its
        correction vanish. Positive where the points allow it, as the areas are; not made so.

    Accuracy: $m^T L$ to round-off; as a quadrature $O(h^r)$ with operators of order r
    (`tests/test_conserve.py`). In float32 within 1e-4 of themselves, and conserving to 1e-5
    (`tests/test_conserve.py`).
    Differentiable: forward and reverse, in the weights of the operator and in `total`.
    Raises:
        TypeError: no operator or preconditioner.
        ValueError: an operator with components, one that does not annihilate the constants; no
            preconditioner for traced neighbours.
        RuntimeError: no such weights have been found.

    Example:
        >>> surface = js.discretize(js.sphere(1_000))
        >>> m = js.conservative_weights(surface.laplacian, surface.areas.sum())
        >>> u = surface.cloud.points[:, 0] ** 3
        >>> bool(abs(m @ surface.laplacian(u)) < 1e-10)
        True
    """
    hint = "js.laplace_beltrami(cloud) makes one; of compositions pass the outer operator"
    instance(operator, Stencil, "operator", hint)
    check_system(operator, None, preconditioner, None, 0.0)
    real(total, "total", above=0)
    if preconditioner is None:
        preconditioner = multigrid(operator, mean_zero=True)
    if preconditioner.mean_zero is False:
        raise ValueError(
            "operator does not annihilate the constants: no weights are conserved, as where heat "
            "passes through a border or is lost"
        )
    total = jnp.asarray(total, jnp.result_type(float, *jax.tree.leaves(operator)))
    weights, left, bad = _weights(prepared(operator), total, preconditioner)
    text = (
        "mass is not conserved: the weights times the column of point {i} are {v:.1e} of the sum "
        f"of moduli, at most {_LEFT * float(jnp.finfo(weights.dtype).eps):.0e} is needed{{more}}: "
        "the surface may fall into parts, or the operator have growing modes"
    )
    return refuse(weights, bad, text, left, error=RuntimeError)


@sized_jit
def _weights(operator, total, preconditioner):
    """The weights, what is left of their products with the columns, and where that is too much."""
    # S = L - σ p pᵀ / n, p = 1, is not singular, and Sᵀ m = -σ total / n where Lᵀ m = 0.
    dtype = total.dtype
    system = System.of(operator, None, dtype, True)
    adjoint = system.matrix.T
    fixed, inverse = jax.lax.stop_gradient((adjoint, system.inverse(preconditioner).T))
    solver = BiCGStab(_SOLVED * float(jnp.finfo(dtype).eps))
    sigma = jnp.asarray(system.sigma)
    rhs = system.constant(-sigma * total / system.count, dtype)
    first = solve_system(fixed, jax.lax.stop_gradient(rhs), solver, inverse).value
    # Has the derivative of the solution.
    weights = first + solve_system(adjoint, rhs - adjoint(first), solver, inverse).value
    products = jax.lax.stop_gradient(adjoint(weights) - rhs)
    size = jax.lax.stop_gradient(jnp.max(jnp.abs(operator.diagonal * weights)))
    left = jnp.abs(products) / size
    return weights, left, ~(left <= _LEFT * jnp.finfo(dtype).eps)
