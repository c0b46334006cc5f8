r"""Functionals that are extreme values of an energy: eigenvalues and compliance.

Where an energy is stationary, an error of the field counts with its square only. So both are
computed from the energy of the field that the Laplacian gives, and most of the error of the
Laplacian is gone; what remains is that of the integrals and of the gradient (as in Pierce and
Giles, SIAM Review 42, 247-264, 2000, where residuals are weighted with the adjoint solution).
Polynomials of degree 2 have gradients that are worse than their Laplacian: those methods, and
their like, keep what the Laplacian gives.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import jax.scipy.linalg
from jaxtyping import Array, Float

from ..arguments import as_float, finite, real, switched_off
from ..discretization import Discretization
from ..failures import needs_values
from ..solve.eigen import eigenmodes, lowest_space
from ..solve.krylov import BiCGStab
from ..solve.steady import solve
from ..solve.system import tolerance
from .functionals import closed

# Multiple of round-off that is the tolerance of solves: gradients are as exact as they are.
_SOLVE = 1_000


def eigenvalues(surface: Discretization, k: int, *, degenerate: float = 1e-3) -> Float[Array, " k"]:
    r"""The lowest k eigenvalues of $-\Delta_S$: Ritz values of the modes of the Laplacian.

    Those of the matrices $\int_S \nabla f_i \cdot \nabla f_j\,dS$ and $\int_S f_i f_j\,dS$, with
    $f_i$ from `js.eigenmodes(surface.laplacian, k)` and with all modes in the group of the last. Of
    methods of degree (or order) 2 or less, the values of `js.eigenmodes` themselves.

    Args:
        surface: from `js.discretize`, closed.
        k: how many, the zero of the constants counted.
        degenerate: relative distance of neighbouring values within a group.

    Returns:
        Values, ascending, `(k,)`, in 1/length²; Ritz values are not below zero where areas are
        positive.

    Accuracy: the square of the error of the modes, and the errors of areas and gradient, O(h⁴)
    with `js.GFDM(degree=4)`: some twenty times below those of `js.eigenmodes` on 2,000 points of a
    torus. On a sphere, whose symmetry makes some modes better than the gradient, within 1e-3 of
    l (l + 1) up to l = 3 (`tests/test_energies.py`, where single precision is too).
    Differentiable: once, forward and reverse, in points and normals; of values that coincide to
    round-off only symmetric functions (sums over the group). A gradient solves with the operator
    once more for each group of modes.
    Raises:
        TypeError: what is no discretisation; a k that is no whole number.
        ValueError: as `js.eigenmodes`; a surface with a border (`js.eigenmodes` takes conditions).
        RuntimeError: the iteration has not converged.

    Example:
        >>> surface = js.discretize(js.sphere(500), method=js.GFDM(degree=4))
        >>> bool(jnp.allclose(js.eigenvalues(surface, 4), jnp.array([0.0, 2, 2, 2]), atol=1e-5))
        True
    """
    closed(surface)
    if not _serves(surface):
        return eigenmodes(surface.laplacian, k, degenerate=degenerate).values
    functions = lowest_space(surface.laplacian, k, degenerate)
    return _ritz(functions, surface.gradient(functions), surface.areas)[:k]


def compliance(
    surface: Discretization, f: Float[Array, " n"], *, screening: float = 0.0
) -> Float[Array, ""]:
    r"""$\int_S f u\,dS$ with $-\Delta u + \kappa u = f$: how far a load f moves where it acts.

    Computed as $\int_S (2 f u - |\nabla u|^2 - \kappa u^2)\,dS$, of which it is the largest value;
    not so with methods of degree (or order) 2 or less.

    Args:
        surface: from `js.discretize`, closed.
        f: load, `(n,)`.
        screening: $\kappa \ge 0$ in 1/length², not traced; without it f stands for f less its mean.

    Accuracy: the square of the error of u, and the errors of areas and gradient: with
    `js.GFDM(degree=4)` some twenty times below that of $\int_S f u\,dS$ on 2,000 points of a torus
    (`tests/test_energies.py`); in float32 as `volume` (`tests/test_functionals.py`).
    Differentiable: forward and reverse, in points, normals and f, by the implicit function theorem;
        once in points and normals, as `areas`.
    Raises:
        TypeError: what is no discretisation, a load or a screening that is not made of numbers.
        ValueError: a load of another shape, a negative or traced screening, traced neighbours (a
            compiled function closes over the surface and moves it), a surface with a border (solve
            with `js.solve` and conditions there).
        RuntimeError: the linear solve failed.

    Example:
        >>> surface = js.discretize(js.sphere(500), method=js.GFDM(degree=4))
        >>> z = surface.cloud.points[:, 2]  # the solution is z / 2
        >>> bool(abs(js.compliance(surface, z) - 2 * jnp.pi / 3) < 1e-2)
        True
    """
    closed(surface)
    needs_values(
        "neighbours of the surface",
        surface.neighbors.indices,
        instead="let the function that is compiled close over the surface and move it, "
        "lambda points: js.compliance(surface.moved(points), load)",
    )
    f = finite(as_float(f, "load", (surface.n,)), "load", surface.cloud.active)
    f = switched_off(surface.cloud.active, f)
    real(screening, "screening", least=0)
    needs_values("screening", screening, instead="give a number from outside")
    free = float(screening) == 0
    if free:
        f = f - surface.mean(f)
    operator = -surface.laplacian if free else -surface.laplacian + screening
    # As far as round-off allows, which on curves and graded points is not always that far.
    rtol = _SOLVE * float(jnp.finfo(f.dtype).eps)
    solver = BiCGStab(rtol=rtol, enough=tolerance(None, f.dtype))
    u = solve(operator, f, mean_zero=free, project=free, solver=solver).value
    if not _serves(surface):
        return surface.inner(f, u)
    return _largest(f, screening, u, surface.gradient(u), surface.areas)


def _serves(surface: Discretization) -> bool:
    """Whether the gradient is accurate enough."""
    return surface.method.polynomial_degree > 2


@jax.jit
def _ritz(u: Float[Array, "n k"], slopes: Float[Array, "n k d"], areas: Float[Array, " n"]):
    """Eigenvalues of the matrices of energies and of products; of columns of zeros, the largest."""
    energies = jnp.einsum("n,nad,nbd->ab", areas, slopes, slopes)
    products = jnp.einsum("n,na,nb->ab", areas, u, u)
    absent = jnp.diag((jnp.diag(products) == 0).astype(u.dtype))
    products = products + absent
    # Above all others.
    energies = energies + 2 * jnp.trace(energies / jnp.diag(products)) * absent
    factor = jnp.linalg.cholesky(products)
    half = jax.scipy.linalg.solve_triangular(factor, energies, lower=True)
    return jnp.linalg.eigvalsh(jax.scipy.linalg.solve_triangular(factor, half.T, lower=True))


@jax.jit
def _largest(f, screening, u, slope, areas):
    """The energy of a load."""
    return areas @ ((2 * f - screening * u) * u - jnp.sum(slope**2, axis=1))
