"""Steady linear problems A u = f, with conditions or in the mean-zero sense."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
from jaxtyping import Array, Float

from ..arguments import is_concrete
from ..boundary import Closure
from ..stencils.stencil import AbstractOperator, check_scalar
from .krylov import BiCGStab
from .padded import matching_layout
from .precondition import AbstractPreconditioner, multigrid
from .reduced import annihilates_constants, reduced_matrix
from .system import Inverse, System


def solve(
    operator: AbstractOperator,
    rhs: Float[Array, "n *c"],
    *,
    conditions: Closure | None = None,
    preconditioner: AbstractPreconditioner | None = None,
    solver: lx.AbstractLinearSolver | None = None,
    mean_zero: bool | None = None,
    rtol: float = 1e-8,
    atol: float = 0.0,
    max_steps: int = 1000,
    throw: bool = True,
) -> lx.Solution:
    r"""Solve a steady linear problem $A u = f$ at the free points, under conditions.

    With conditions, $u = E v + e$ and $P A E v = P (f - A e)$ is solved for the free
    values v. Where A annihilates the constants (on a closed surface, or with flux conditions
    only), a solution exists for right-hand sides of one mean only, and is determined up to a
    constant. It is then found in the mean-zero sense: $A u = f - \lambda$ with the mean of
    u over all points zero, through the nonsingular system $(A - \sigma 1 1^T / n) u = f$. The
    incompatible part $\lambda$ is reported; for a right-hand side that is compatible on the
    surface it is of the size of the discretisation error.

    Args:
        operator: A, a scalar stencil such as `js.laplace_beltrami(...)`, shifted and scaled at
            will, or a composition.
        rhs: f, `(n,)` or `(n, c)` for c problems at once; values at bound points do not count.
        conditions: from `js.close` or `js.with_ghosts`.
        preconditioner: `js.multigrid(operator, conditions=conditions)` if None, which takes
            concrete arrays: under `jit` and `grad` make it outside and pass it. Or
            `js.jacobi(operator)`.
        solver: a solver of lineax; `js.BiCGStab(rtol, atol, max_steps)` if None.
        mean_zero: whether A annihilates the constants; seen from the preconditioner or a
            concrete operator if None.
        rtol: the residual $\|P(f - A u)\|_2$ may be this share of the norm of the right-hand
            side.
        atol: or this, whichever is larger.
        max_steps: most steps of the solver, of two products with A each.
        throw: raise where the solver fails; if False, see `result`.

    Returns:
        A `lineax.Solution`: `value` like rhs, `result` a code of `lineax.RESULTS`, and in `stats`
        `num_steps`, `relative_residual` (computed from the solution) and `incompatible` (λ).

    Accuracy: of the operator (`tests/test_steady.py`).
    Differentiable: forward and reverse, in the weights of the operator (hence the geometry), the
    conditions and the right-hand side, by the implicit function theorem: one more solve with A
    or its transpose, to the same tolerance.
    Raises:
        ValueError: shapes that do not fit; a right-hand side or weights that are not finite;
            a system that is seen to be singular; under `jit`, what has to be given there.
        RuntimeError: the tolerance was not reached (with steps and residual).

    Example:
        >>> cloud = js.sphere(2_000)
        >>> z = cloud.points[:, 2]
        >>> solution = js.solve(js.laplace_beltrami(cloud), -2 * z)
        >>> bool(jnp.abs(solution.value - z).max() < 0.01)
        True
    """
    rhs = jnp.asarray(rhs)
    rhs = rhs.astype(jnp.result_type(rhs, *jax.tree.leaves(operator), jnp.float32))
    _check(operator, rhs, conditions)
    if preconditioner is None:
        preconditioner = multigrid(operator, conditions=conditions)
    if mean_zero is None:
        mean_zero = _is_mean_zero(operator, conditions, preconditioner)
    if solver is None:
        solver = BiCGStab(rtol, atol, max_steps)
    concrete = is_concrete(*jax.tree.leaves((operator, rhs, conditions, preconditioner)))
    layout = matching_layout(preconditioner.incoming, operator)
    problem = (operator, layout, conditions, preconditioner, solver, mean_zero, rtol, atol)
    one = lambda f: _solve(f, *problem, throw and not concrete)
    if rhs.ndim == 1:
        solution = one(rhs)
    else:
        solution = jax.vmap(one, in_axes=1, out_axes=lx.Solution(1, 0, 0, 0))(rhs)
    if throw and concrete:
        _raise_on_failure(solution, rtol, atol)
    return solution


@eqx.filter_jit
def _solve(rhs, operator, layout, conditions, preconditioner, solver, mean_zero, rtol, atol, throw):
    system = System.of(operator, conditions, layout, rhs.dtype, mean_zero)
    offset = jnp.zeros_like(rhs) if conditions is None else conditions.offset()
    known = rhs if conditions is None else system.free(rhs - operator(offset))
    inverse = Inverse(preconditioner, system)
    options = {"preconditioner": jax.lax.stop_gradient(inverse)}
    found = lx.linear_solve(system, known, solver, options=options, throw=False)

    u = found.value
    incompatible = system.shift(u)
    if conditions is not None:
        u = conditions.homogeneous(u) + offset
    if mean_zero:
        u = u - jnp.mean(u)
    left = system.free(rhs - incompatible - operator(u))
    residual, size = jnp.linalg.norm(left), jnp.linalg.norm(known)
    # Whatever the solver says, the residual decides.
    reached = residual <= 1.5 * jnp.maximum(rtol * size, atol)
    result = lx.RESULTS.where(
        reached | (found.result != lx.RESULTS.successful), found.result, lx.RESULTS.stagnation
    )
    result = lx.RESULTS.where(jnp.isfinite(size), result, lx.RESULTS.nonfinite_input)
    if throw:
        u = eqx.error_if(
            u,
            result != lx.RESULTS.successful,
            f"js.solve did not reach rtol = {rtol}, atol = {atol}, or was given values that are "
            "not finite; with throw=False, `result` says why and `stats` what was reached",
        )
    stats = {
        "num_steps": found.stats.get("num_steps"),
        "relative_residual": residual / jnp.where(size > 0, size, 1),
        "incompatible": incompatible,
    }
    stats = {key: value for key, value in stats.items() if value is not None}
    return lx.Solution(u, result, jax.lax.stop_gradient(stats), None)


# --- checks --------------------------------------------------------------------------------


def _is_mean_zero(operator, conditions, preconditioner) -> bool:
    if preconditioner.mean_zero is not None:
        return preconditioner.mean_zero
    if not is_concrete(*jax.tree.leaves((operator, conditions))):
        raise ValueError(
            "whether the operator annihilates the constants is not to be seen on traced arrays: "
            "pass mean_zero=True or False, or a preconditioner made outside by js.multigrid"
        )
    return annihilates_constants(reduced_matrix(operator, conditions), conditions)


def _check(operator, rhs, conditions) -> None:
    check_scalar(operator)
    if rhs.ndim not in (1, 2) or rhs.shape[0] != operator.n:
        n = operator.n
        raise ValueError(f"right-hand side has shape {rhs.shape}, expected ({n},) or ({n}, c)")
    if conditions is not None and conditions.n != operator.n:
        raise ValueError(f"conditions for {conditions.n} points, the operator has {operator.n}")
    if not is_concrete(*jax.tree.leaves((rhs, conditions))):
        return
    values = np.asarray(rhs if conditions is None else conditions(rhs))
    bad = np.flatnonzero(~np.isfinite(values).reshape(operator.n, -1).all(axis=1))
    if bad.size:
        what = "right-hand side or condition" if conditions is not None else "right-hand side"
        raise ValueError(f"{what} is not finite at point {bad[0]} ({bad.size} such points)")


def _raise_on_failure(solution, rtol, atol) -> None:
    failed = np.ravel(np.asarray(solution.result != lx.RESULTS.successful))
    if not failed.any():
        return
    i = int(np.argmax(failed))
    residual = np.ravel(solution.stats["relative_residual"])[i]
    steps = solution.stats.get("num_steps")
    after = "" if steps is None else f" after {np.ravel(steps)[i]} steps"
    of = "" if failed.size == 1 else f" for right-hand side {i}"
    raise RuntimeError(
        f"not solved{of}: relative residual {residual:.1e}{after}, wanted rtol = {rtol:g}, "
        f"atol = {atol:g}. The system may be singular or indefinite, or the tolerance below "
        "round-off; throw=False returns what was reached"
    )
