r"""Steady problems with a reaction, $L u + r(u) = f$, by Newton's method."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float

from ..arguments import (
    as_float,
    finite,
    more_digits,
    precision_of,
    switched_off,
    traced_call,
    whole,
)
from ..boundary import Closure
from ..compiling import sized_jit
from ..failures import is_concrete, refuse
from ..functions import canonical, constant, numbers_as_arrays
from ..solutions import told
from ..stencils.algebra import AbstractOperator
from ..stencils.stencil import prepared
from .krylov import BiCGStab, solve_system, tolerances_as_arrays
from .precondition import AbstractPreconditioner, multigrid
from .system import System, check_system, tolerance

# A step is accepted if the residual falls by this share of what the linear model promises.
_ARMIJO = 1e-4
# Residual of the linear systems of all steps but the last.
_FORCING = 1e-4
# Halvings of a step before the search is given up.
_HALVINGS = 12

Reaction = Callable[[Float[Array, " n"], Any], Float[Array, " n"]]


def solve_nonlinear(
    operator: AbstractOperator,
    reaction: Reaction,
    u0: Float[Array, " n"],
    *,
    args: Any = None,
    rhs: Float[Array, " n"] | float = 0.0,
    closure: Closure | None = None,
    preconditioner: AbstractPreconditioner | None = None,
    solver: lx.AbstractLinearSolver | None = None,
    rtol: float | None = None,
    atol: float = 0.0,
    max_steps: int = 30,
    throw: bool = True,
) -> optx.Solution:
    r"""Solve $L u + r(u) = f$ at the free points, under conditions.

    Newton's method: each step solves $(L + r'(u))\,\delta = f - L u - r(u)$ by a preconditioned
    Krylov method, and is halved until the residual falls (Armijo's rule).

    Args:
        operator: L, a scalar stencil or a composition.
        reaction: `reaction(u, args)`, as a rule pointwise. It may couple points: products with
            its whole derivative are taken, only the preconditioner sees sums of rows.
        u0: where to start, `(n,)`.
        args: parameters of the reaction, any pytree; derivatives in them need them here.
        rhs: f, `(n,)` or a number.
        closure: from `js.eliminate` or `js.with_ghosts`.
        preconditioner: for $L + r'$; `js.multigrid` of it at u0 if None, under
            `jit` and `vmap` where the neighbours are concrete. One serves all steps.
        solver: of the linear systems; `js.BiCGStab` if None, loosely but for derivatives.
        rtol: the residual may be this share of its size at u0 (or of f, if that is larger);
            1e-8 in double and 1e-4 in single precision if None.
        atol: or this, whichever is larger.
        max_steps: most Newton steps.
        throw: raise where the iteration fails; if False, see `result`.

    Returns:
        An `optimistix.Solution`: `value`, `result`, and in `stats` `num_steps`,
        `num_linear_steps` and `relative_residual`.

    Accuracy: of the operator (`tests/test_newton.py`).
    Differentiable: forward and reverse, in the weights of the operator, args, rhs and the
    conditions, by one linear solve at the solution; not in u0.
    Raises:
        TypeError: what is no operator, closure, preconditioner, solver or function; no numbers.
        ValueError: shapes that do not fit; values that are not finite; a border without
            conditions; under `jit`, no preconditioner.
        RuntimeError: no convergence (with steps and residual).

    Example:
        >>> cloud = js.sphere(1_000)
        >>> z = cloud.points[:, 2]
        >>> screened = -js.laplace_beltrami(cloud)
        >>> f = 2 * z + z + z**3
        >>> u = js.solve_nonlinear(screened, lambda u, _: u + u**3, 0 * z, rhs=f).value
        >>> bool(jnp.abs(u - z).max() < 0.01)
        True
    """
    check_system(operator, closure, preconditioner, solver, atol)
    if not callable(reaction):
        raise TypeError(f"reaction is a {type(reaction).__name__}, expected a function (u, args)")
    whole(max_steps, "max_steps", least=1)
    u0 = as_float(u0, "u0", (operator.n,))
    rhs = as_float(rhs, "right-hand side", (), u0.shape)
    u0 = u0.astype(jnp.promote_types(precision_of(u0, operator), jnp.float32))
    rhs, rtol = rhs.astype(u0.dtype), tolerance(rtol, u0.dtype)
    u0 = switched_off(operator.active, u0)
    if rhs.ndim:
        rhs = switched_off(operator.active, rhs)
    given = jax.eval_shape(lambda u: traced_call(reaction, "reaction", u, args), u0)
    if getattr(given, "shape", None) != u0.shape:
        shape = getattr(given, "shape", type(given).__name__)
        raise ValueError(f"reaction returns {shape}, expected an array of shape {u0.shape}")
    finite(u0, "u0")
    finite(rhs, "right-hand side")
    # Programs and arrays: other numbers, or the same code in a new lambda, compile nothing.
    args = numbers_as_arrays(args)
    reaction = canonical(reaction, u0, args)
    problem = _Problem(operator, closure, reaction, args, rhs)
    if preconditioner is None:
        linearized = operator + problem.slope(u0)
        preconditioner = multigrid(linearized, closure=closure, mean_zero=False)
    if preconditioner.mean_zero:
        raise ValueError(
            "singular at u0: the operator annihilates the constants and the reaction has slope "
            "zero. Start elsewhere, or solve a linear problem with js.solve"
        )
    concrete = is_concrete(problem, u0, preconditioner)
    if not concrete:  # nothing concrete is differentiated
        problem = eqx.tree_at(lambda p: p.operator, problem, prepared(operator))
    limits = np.asarray(rtol), np.asarray(float(atol)), np.asarray(max_steps)
    solver = None if solver is None else tolerances_as_arrays(solver)
    # Errors of concrete problems are raised here: they share one program, whatever `throw` is.
    flags = concrete, throw and not concrete
    solution = _solve(problem, u0, preconditioner, solver, limits, *flags)
    if throw and concrete and bool(solution.result != optx.RESULTS.successful):
        raise RuntimeError(
            f"not solved: relative residual {float(solution.stats['relative_residual']):.1e} after "
            f"{int(solution.stats['num_steps'])} Newton steps, wanted rtol = {rtol:g}, atol = "
            f"{atol:g}. The start may be far from a solution, the system singular there, or the "
            f"tolerance below the round-off of {u0.dtype}{more_digits(u0.dtype)}; throw=False "
            "returns what was reached"
        )
    return told(solution)


class _Problem(eqx.Module):
    operator: AbstractOperator
    closure: Closure | None
    reaction: Reaction
    args: Any
    rhs: Array

    def field(self, v):
        return v if self.closure is None else self.closure(v)

    def residual(self, v):
        """P (f - L u - r(u)) at u = E v + e."""
        u = self.field(v)
        left = self.rhs - self.operator(u) - self.reaction(u, self.args)
        left = switched_off(self.operator.active, left)
        return left if self.closure is None else self.closure.restrict(left)

    def slope(self, v):
        """r'(u)."""
        u = self.field(v)
        slope = jax.jvp(lambda u: self.reaction(u, self.args), (u,), (jnp.ones_like(u),))[1]
        return switched_off(self.operator.active, slope)

    def correction(self, v, residual, preconditioner, solver):
        """The solution of (L + r') delta = residual; what it is linearised at is a constant."""
        fixed, v = constant((self, v))
        slope = _Slope(fixed.reaction, fixed.args, fixed.field(v))
        system = System(fixed.operator + Map(slope, len(v)), fixed.closure)
        return solve_system(system.matrix, residual, solver, constant(preconditioner))


class _State(eqx.Module):
    v: Array
    residual: Array
    size: Array
    steps: Array
    linear: Array
    falls: Array


@sized_jit
def _solve(problem, u0, preconditioner, solver, limits, concrete, throw):
    rtol, atol, max_steps = limits
    fixed = constant(problem)
    loose = BiCGStab(_FORCING, 0.0, 1000) if solver is None else solver
    start = fixed.residual(jax.lax.stop_gradient(u0))
    size = jnp.linalg.norm(start)
    source = jnp.broadcast_to(fixed.rhs, u0.shape)
    source = jnp.linalg.norm(switched_off(problem.operator.active, source))
    scale = jnp.maximum(size, source)
    target = jnp.maximum(rtol * scale, atol)

    def step(state):
        found = fixed.correction(state.v, state.residual, preconditioner, loose)

        def trial(t):
            v = state.v + t * found.value
            residual = fixed.residual(v)
            return v, residual, jnp.linalg.norm(residual)

        def too_long(search):
            t, (_, _, size) = search
            falls = size <= (1 - _ARMIJO * t) * state.size
            return ~falls & (t > 0.5**_HALVINGS)

        one = jnp.ones((), u0.dtype)
        halve = lambda search: (search[0] / 2, trial(search[0] / 2))
        _, (v, residual, size) = jax.lax.while_loop(too_long, halve, (one, trial(one)))
        falls = size < state.size
        keep = lambda new, old: jnp.where(falls, new, old)
        linear = state.linear + found.stats["num_steps"]
        return _State(
            keep(v, state.v), keep(residual, state.residual), keep(size, state.size),
            state.steps + 1, linear, falls,
        )  # fmt: skip

    zero = jnp.asarray(0)
    state = _State(jax.lax.stop_gradient(u0), start, size, zero, zero, jnp.isfinite(size))
    state = jax.lax.while_loop(
        lambda s: s.falls & (s.size > target) & (s.steps < max_steps), step, state
    )
    result = optx.RESULTS.where(
        state.steps >= max_steps,
        optx.RESULTS.nonlinear_max_steps_reached,
        optx.RESULTS.nonlinear_divergence,
    )
    result = optx.RESULTS.where(state.size <= target, optx.RESULTS.successful, result)
    v = state.v
    if not concrete:
        # One more Newton step has the derivative of the solution; its value is below the tolerance.
        finest = tolerance(None, u0.dtype)
        tight = BiCGStab(jnp.minimum(rtol, finest), 0.0, 1000) if solver is None else solver
        last = problem.correction(v, problem.residual(v), preconditioner, tight).value
        v = v + last - jax.lax.stop_gradient(last)
    u = switched_off(problem.operator.active, problem.field(v))  # in reverse too
    if throw:
        text = (
            "js.solve_nonlinear did not reach its tolerance within max_steps; with throw=False, "
            "`result` says why and `stats` what was reached"
        )
        u = refuse(u, result != optx.RESULTS.successful, text)
    stats = {
        "num_steps": state.steps,
        "num_linear_steps": state.linear,
        "relative_residual": state.size / jnp.where(scale > 0, scale, 1),
    }
    return optx.Solution(u, result, None, stats, None)


class _Slope(eqx.Module):
    """The derivative of a reaction at u, as a linear map."""

    reaction: Reaction
    args: Any
    u: Array

    def __call__(self, tangent):
        return jax.jvp(lambda u: self.reaction(u, self.args), (self.u,), (tangent,))[1]


class Map(AbstractOperator):
    """A linear map of scalar fields given as a function, of which only products are known.

    Args:
        function: takes and gives a field.
        n: number of points.
    """

    function: Callable
    n: int = eqx.field(static=True, default=0)
    in_shape = ()
    out_shape = ()

    def __call__(self, u):
        return self.function(u)
