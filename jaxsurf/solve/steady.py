"""Steady linear problems A u = f, with conditions or in the mean-zero sense."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
from jaxtyping import Array, Float

from ..arguments import as_float, count_on, finite, more_digits, precision_of, switched_off, whole
from ..boundary import Closure
from ..compiling import at_once, sized_jit
from ..failures import is_concrete, needs_values, refuse, without_derivatives
from ..functions import constant
from ..solutions import told
from ..stencils.algebra import AbstractOperator
from ..stencils.stencil import prepared
from .krylov import BiCGStab, scale_of, solve_system, tolerances_as_arrays
from .precondition import AbstractPreconditioner, multigrid
from .reduced import annihilates_constants, reduced_matrix, restriction_of
from .system import System, check_system, tolerance

# An incompatible part may be this share of what of the right-hand side is not resolved,
_UNRESOLVED = 0.25
# and this share of its mean modulus: what is compatible cancels.
_CANCELLED = 0.1
# Of what fluxes through borders add it may be so many spacings, in units of the surface's size.
_SPACINGS = 2
# Round-off may leave a residual of this share of the right-hand side.
_EXCUSED = 0.1


def solve(
    operator: AbstractOperator,
    rhs: Float[Array, "n *c"],
    *,
    closure: Closure | None = None,
    preconditioner: AbstractPreconditioner | None = None,
    solver: lx.AbstractLinearSolver | None = None,
    mean_zero: bool | None = None,
    project: bool = False,
    rtol: float | None = None,
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
    surface it is of the size of the discretisation error. More than that is an error, unless
    `project` asks for the problem without it. With D the half row sums of $|A|$, about $4 / h^2$
    on a surface, the mean of $|D^{-1} A f|$ is how much of f is not resolved to second order;
    a quarter of that is allowed (even on random points compatible ones have no more than 0.04 of
    it), but never more than a tenth of the mean of |f|. What fluxes through borders add to f there
    is resolved nowhere: $2 / \sqrt n$ of its mean modulus is allowed.

    Args:
        operator: A, a scalar stencil such as `js.laplace_beltrami(...)`, shifted and scaled at
            will, or a composition.
        rhs: f, `(n,)` or `(n, c)` for c problems at once, whose conditions have the same values or
            their own; values at bound points do not count.
        closure: from `js.eliminate` or `js.with_ghosts`.
        preconditioner: `js.multigrid(operator, closure=closure)` if None, also under
            `grad`, and with `mean_zero` under `jit` and `vmap` where the neighbours are concrete.
            Where these are traced, make it outside and pass it, `renewed` inside where the
            operator is another. Or `js.jacobi(operator)`. Of sums with compositions, as
            `1 + L @ L`, it is made outside `jit` and `vmap` too, and not renewed.
        solver: a solver of lineax; `js.BiCGStab(rtol, atol, max_steps)` if None.
        mean_zero: whether A annihilates the constants; seen from the preconditioner or a
            concrete operator if None.
        project: solve for f less its incompatible part, however large.
        rtol: the residual $\|P(f - A u)\|_2$ may be this share of the norm of the right-hand
            side. If None: 1e-8 in double and 1e-4 in single precision, or what the rounding of u
            leaves, if that is more.
        atol: or this, whichever is larger.
        max_steps: most steps of the solver, of two products with A each.
        throw: raise where the solver fails; if False, see `result`.

    Returns:
        A `lineax.Solution`: `value` like rhs, `result` a code of `lineax.RESULTS`, and in `stats`
        `num_steps`, `relative_residual` (computed from the solution), `round_off` (what of it
        the rounding of u leaves), `incompatible` (λ) and `compatible_within` (what is allowed of
        it). An incompatible right-hand side has the result `singular`.

    Accuracy: of the operator (`tests/test_steady.py`); in single precision u is within 1e-3
    of that in double on a sphere of 1,000 points, and rounding grows with the condition of A.
    Differentiable: forward and reverse, in the weights of the operator (hence the geometry), the
    conditions and the right-hand side, by the implicit function theorem: one more solve with A
    or its transpose, to the same tolerance. Under `jit` and `vmap` as without, also over weights.
    Raises:
        TypeError: what is no operator, closure, preconditioner or solver; a right-hand side that
            is no array of real numbers.
        ValueError: shapes that do not fit; a right-hand side or weights that are not finite;
            a system that is seen to be singular; an incompatible right-hand side (what it had
            and what is allowed); a border without conditions; under `jit`, what has to be given
            there.
        RuntimeError: the tolerance was not reached (with steps and residual).

    Example:
        >>> cloud = js.sphere(2_000)
        >>> z = cloud.points[:, 2]
        >>> solution = js.solve(js.laplace_beltrami(cloud), -2 * z)
        >>> bool(jnp.abs(solution.value - z).max() < 0.01)
        True
    """
    check_system(operator, closure, preconditioner, solver, atol)
    rhs = as_float(rhs, "right-hand side", (operator.n,), (operator.n, "c"))
    rhs = rhs.astype(jnp.promote_types(precision_of(rhs, operator), jnp.float32))
    rhs = switched_off(operator.active, rhs)
    _check(operator, rhs, closure)
    # What was not asked for may end at round-off.
    given, rtol = rtol is not None, tolerance(rtol, rhs.dtype)
    whole(max_steps, "max_steps", least=1)
    concrete = is_concrete(operator, rhs, closure, preconditioner)
    if preconditioner is None:
        preconditioner = multigrid(operator, closure=closure, mean_zero=mean_zero)
    if mean_zero is None:
        mean_zero = _is_mean_zero(operator, closure, preconditioner)
    if solver is None:
        solver = BiCGStab(rtol, float(atol), np.asarray(max_steps))
    if not concrete:  # nothing concrete is differentiated
        operator = prepared(operator)
    limits = np.asarray(rtol), np.asarray(float(atol)), np.asarray(given), np.asarray(bool(project))
    problem = (operator, closure, preconditioner, tolerances_as_arrays(solver), limits)
    solution = _solve(rhs, *problem, bool(mean_zero), throw and not concrete)
    if throw and concrete:
        _raise_on_failure(solution, rhs.dtype, rtol, atol)
    return told(solution)


@sized_jit
def _solve(rhs, operator, closure, preconditioner, solver, limits, mean_zero, throw):
    problem = (operator, closure, preconditioner, solver, limits, mean_zero, throw)
    offset = jnp.zeros(operator.n, rhs.dtype) if closure is None else closure.offset()
    if rhs.ndim == 1:
        return _solve_one(rhs, offset, *problem)
    columns = lx.Solution(1, 0, 0, 0)  # type: ignore[arg-type]
    each = (1, 1 if offset.ndim == 2 else None)
    return jax.vmap(lambda f, e: _solve_one(f, e, *problem), each, columns)(rhs, offset)


def _solve_one(rhs, offset, operator, closure, preconditioner, solver, limits, mean_zero, throw):
    rtol, atol, given, project = limits
    system = System.of(operator, closure, rhs.dtype, mean_zero)
    known = rhs if closure is None else system.restriction(rhs - operator(offset))
    inverse = constant(system.inverse(preconditioner))
    found = solve_system(system.matrix, known, solver, inverse)
    v = found.value
    u = v if closure is None else closure.homogeneous(v) + offset
    if mean_zero:
        u = u - jnp.sum(u) / count_on(operator.active, operator.n)
    # Whatever comes back from there in reverse.
    u = switched_off(operator.active, u)
    # Judged at size one, as squares of 1e-300 are zero; and whatever the solver says, by residuals.
    fixed, f, b, v = constant(
        (system, rhs if closure is None else system.restriction(rhs), known, v)
    )
    scale = scale_of(b)
    f, b, v = f / scale, b / scale, v / scale
    signs = 1.0 - 2.0 * (jnp.arange(operator.n) % 2).astype(v.dtype)
    products = fixed.reduced(jnp.stack([v, signs * v, f], axis=1))
    incompatible = fixed.shift(v)
    left = b - fixed.constant(incompatible, b.dtype) - products[:, 0]
    residual, size = jnp.linalg.norm(left), jnp.linalg.norm(b)
    # The rounding of every u_j changes A u by this much. Where that is much of the right-hand side,
    # as u has grown in a system that is singular, it excuses nothing.
    round_off = 4 * jnp.finfo(v.dtype).eps * jnp.linalg.norm(products[:, 1])
    excused = jnp.where(given, 0, jnp.minimum(round_off, _EXCUSED * size))
    target = 1.5 * jnp.maximum(jnp.maximum(rtol * size, atol / scale), excused)
    reached = residual <= target
    failed = found.result != lx.RESULTS.successful
    result = lx.RESULTS.where(failed, found.result, lx.RESULTS.stagnation)
    result = lx.RESULTS.where(reached, lx.RESULTS.successful, result)
    unresolved = fixed.mean(jnp.abs(products[:, 2] * fixed.spread()))
    allowed = jnp.minimum(_UNRESOLVED * unresolved, _CANCELLED * fixed.mean(jnp.abs(f)))
    root = jnp.sqrt(jnp.asarray(count_on(operator.active, operator.n), target.dtype))
    flux = fixed.mean(jnp.abs(b - f))
    allowed = allowed + (_SPACINGS * flux + target) / root
    torn = reached & ~project & mean_zero & (jnp.abs(incompatible) > allowed)
    result = lx.RESULTS.where(torn, lx.RESULTS.singular, result)
    result = lx.RESULTS.where(jnp.all(jnp.isfinite(known)), result, lx.RESULTS.nonfinite_input)
    if throw:
        text = (
            "js.solve did not reach its tolerance, or was given values that are not finite, or a "
            "right-hand side that is incompatible (see `project`); with throw=False, `result` says "
            "why and `stats` what was reached"
        )
        u = refuse(u, result != lx.RESULTS.successful, text)
    size = jnp.where(size > 0, size, 1)
    stats = {
        "num_steps": found.stats.get("num_steps"),
        "relative_residual": residual / size,
        "round_off": round_off / size,
    }
    if mean_zero:
        stats |= {"incompatible": scale * incompatible, "compatible_within": scale * allowed}
    stats = {key: value for key, value in stats.items() if value is not None}
    return lx.Solution(u, result, jax.lax.stop_gradient(stats), None)


# --- checks --------------------------------------------------------------------------------


def _is_mean_zero(operator, closure, preconditioner) -> bool:
    if preconditioner.mean_zero is not None:
        return preconditioner.mean_zero
    known = without_derivatives((operator, closure))
    needs_values(
        "operator and closure",
        known,
        instead="pass mean_zero=True or False, or a preconditioner made outside jit and vmap",
    )
    free = restriction_of(operator, closure).on_host
    return annihilates_constants(reduced_matrix(operator, closure), free)


def _check(operator, rhs, closure) -> None:
    if rhs.ndim == 2 and not rhs.shape[1]:
        raise ValueError(
            f"right-hand side has shape {rhs.shape}: no column, one at least is needed"
        )
    if closure is not None:
        held = jax.eval_shape(lambda closure: closure.offset(), closure).shape
        if held[1:] not in ((), rhs.shape[1:]):
            raise ValueError(
                f"conditions have values for {held[1]} components, the right-hand side has shape "
                f"{rhs.shape}"
            )
    if is_concrete(rhs, closure):
        with at_once():  # constants, while the operator is traced
            values = rhs if closure is None else closure(rhs)
        named = "right-hand side" if closure is None else "right-hand side or condition"
        finite(values, named)


def _raise_on_failure(solution, dtype, rtol, atol) -> None:
    failed = np.ravel(np.asarray(solution.result != lx.RESULTS.successful))
    if not failed.any():
        return
    i = int(np.argmax(failed))
    stats = {key: np.ravel(value)[i] for key, value in solution.stats.items()}
    of = "" if failed.size == 1 else f" for right-hand side {i}"
    if np.ravel(np.asarray(solution.result == lx.RESULTS.singular))[i]:
        raise ValueError(
            f"right-hand side{'' if failed.size == 1 else f' {i}'} is incompatible: the operator "
            f"annihilates the constants, so that only a right-hand side of mean zero over the "
            f"surface has a solution. Its mean is {stats['incompatible']:.3g}, of which the "
            f"discretisation explains {stats['compatible_within']:.2g} at most. Subtract its "
            "mean, balance it with the flux through borders, or take it out by project=True"
        )
    residual, round_off = stats["relative_residual"], stats["round_off"]
    after = f" after {stats['num_steps']} steps" if "num_steps" in stats else ""
    why = "The system may be singular or indefinite, or need a better preconditioner"
    if max(rtol, 0.05 * residual) < round_off:
        why = (
            "The system may be singular or indefinite, or the tolerance is below round-off: the "
            f"rounding of the solution to {dtype} alone leaves {round_off:.1e}{more_digits(dtype)}"
        )
    raise RuntimeError(
        f"not solved{of}: relative residual {residual:.1e}{after}, wanted rtol = {rtol:g}, "
        f"atol = {atol:g}. {why}; throw=False returns what was reached"
    )
