r"""One call from a problem and a state to a solution in time."""

from __future__ import annotations

import functools
import operator
from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, PyTree

from ..arguments import instance, real
from ..failures import check, is_marking, not_finite, refuse, warn
from ..functions import numbers_as_arrays
from ..solutions import told
from .checkpoint import Checkpoint, integrate_in_parts
from .problem import AbstractEvolution
from .run import Plan, Run, planned, solve
from .saving import SteadyState, between_steps
from .stability import Verdict


class IntegrationError(RuntimeError):
    """An integration that stopped before its end.

    Args:
        message: why, and what was reached.
        solution: what there is: the last entry of `state` is the last good state.
        time: when that was.
        state: the last state that was accepted, conditions filled in.

    Example:
        >>> cloud = js.sphere(300)
        >>> problem = js.AdvectionDiffusionReaction(
        ...     js.laplace_beltrami(cloud), reaction=lambda t, u, args: 50 * u**2
        ... )
        >>> try:
        ...     js.integrate(problem, jnp.ones(300), t1=1.0)
        ... except js.IntegrationError as error:
        ...     print(error.time < 0.03)
        True
    """

    def __init__(self, message: str, solution: dfx.Solution, time: float, state: PyTree[Array]):
        super().__init__(message)
        self.solution, self.time, self.state = solution, time, state


def integrate(
    problem: AbstractEvolution,
    u0: PyTree[Array],
    *,
    t1: ArrayLike,
    t0: ArrayLike = 0.0,
    solver: dfx.AbstractSolver | None = None,
    dt0: ArrayLike | None = None,
    rtol: float = 1e-4,
    atol: float = 1e-6,
    controller: dfx.AbstractStepSizeController | None = None,
    saveat: dfx.SaveAt | None = None,
    event: dfx.Event | None = None,
    progress: bool = False,
    checkpoint: Checkpoint | None = None,
    adjoint: dfx.AbstractAdjoint | None = None,
    args: Any = None,
    max_steps: int | None = None,
    throw: bool = True,
) -> dfx.Solution:
    r"""Integrate an evolution problem from t0 to t1.

    Args:
        problem: for example `AdvectionDiffusionReaction`, or one of your own.
        u0: state at t0: `(n,)`, `(n, c)`, or a tuple of such for a `WaveEquation`.
        t1, t0: end and start.
        solver: `RKC2`, `IMEX`, `SDIRK` or any of diffrax; None for the one that
            `choose_solver` picks. The log (`logging`, level INFO) says which and why.
        dt0: length of the first step; None for an automatic one. Without a controller but
            with a `dt0` all steps have this length.
        rtol, atol: tolerances of the error of one step, relative to the values and absolute,
            when there is neither a controller nor a `dt0`.
        controller: of the step sizes, from diffrax.
        saveat: what to save, a `diffrax.SaveAt`; the final state if None. Boundary values are
            filled in.
        event: ends the integration early, a `diffrax.Event`; see `steady_state`.
        progress: show a progress bar.
        checkpoint: write the state to disk now and then, and go on from there if it is.
        adjoint: how to differentiate; by default reverse mode with 64 copies of the state
            however many the steps. `diffrax.ForwardMode()` for forward mode.
        args: handed to reactions and forcings. Numbers in it are arrays to them; what has to be
            a constant (an index, a shape) is for them to close over.
        max_steps: by default ten million, or 4,096 where every step is stored, and a `dt0` that
            makes more is an error; with a checkpoint, of one part.
        throw: raise if the end is not reached; if False, see `Solution.result`.

    Returns:
        A `diffrax.Solution`: times `ts`, states `ys` with time first, `stats`, `result`. On
        concrete arrays `stats["solver"]` says how it was done, `stats["summary"]` what came of it.
        Other numbers, arrays of the same shapes and functions of the same code compile nothing.

    Accuracy: of each solver, in its docstring; the number of digits follows `rtol`. In single
        precision 1e-3 in values and 1e-2 in derivatives at the default tolerances, for every
        solver (`tests/test_time_pde.py::test_single_precision`); `rtol` below 5e-7 is refused.
    Differentiable: reverse (forward with `ForwardMode`) in the state, the problem and `args`, for
    the steps taken: how the controller chose them is not differentiated.
    Raises:
        TypeError: arguments of another kind; functions not made of operations of JAX; a state of
            another precision than its rate; a derivative in forward mode without `ForwardMode`.
        ValueError: a state that is not finite, or for which the right-hand side is not; steps of
            given length that are explicit, in part or whole, beyond the limit of stability (with
            step, limit and spectral radius; of a rate that depends on time at six times, and at 128
            where the state has grown a hundredfold after all; of a solver of one's own as its first
            16 steps tell); diffusion backwards in time; a border about which nothing is said;
            tolerances out of range; times or steps that are lost in the precision of the state; a
            linear part of a problem of one's own that is not linear; a checkpoint that is of
            another run or damaged.
        IntegrationError: the end was not reached: the solution diverges (or grows a hundredfold
            where the equation lets none grow, or has it grow less and steps whose length a
            controller of one's own chooses amplify a mode as much), the tolerance cannot be met, a
            linear system does not converge. Holds the last good state. (Under `jit` an error of the
            run time.)

    Example:
        >>> cloud = js.sphere(500)
        >>> problem = js.AdvectionDiffusionReaction(
        ...     js.laplace_beltrami(cloud), reaction=lambda t, u, args: args * u
        ... )
        >>> solution = js.integrate(problem, cloud.points[:, 2], t1=1.0, args=1.0)
        >>> bool(jnp.abs(solution.ys[-1] - jnp.exp(-1.0) * cloud.points[:, 2]).max() < 0.01)
        True
    """
    if checkpoint is not None:
        instance(checkpoint, Checkpoint, "checkpoint", "js.Checkpoint(path, every=...)")
    plan = planned(
        problem, u0, t0, t1, solver=solver, dt0=dt0, rtol=rtol, atol=atol, controller=controller,
        saveat=saveat, event=event, adjoint=adjoint, args=args, max_steps=max_steps,
        progress=progress and checkpoint is None, throw=throw,
    )  # fmt: skip
    if problem.caution and plan.concrete:
        warn(problem.caution)
    if checkpoint is None:
        return told(_finished(plan, plan.run, throw))
    part = lambda run: _finished(plan, run, throw)
    solution, last = integrate_in_parts(checkpoint, plan, part, progress)
    stats = solution.stats | dict(solver=plan.why, summary=_summary(plan, solution, last))
    return told(eqx.tree_at(lambda s: s.stats, solution, stats))


def steady_state(*, rtol: float = 1e-4, atol: float = 1e-6) -> dfx.Event:
    r"""Event that ends an integration once the state hardly changes.

    When $\|\partial_t u\| < \text{atol} + \text{rtol}\,\|u\|$, in the root mean square, per unit
    of time. Tolerances below those of the integration are met late: the errors of long steps
    keep the state moving, and those of explicit solvers like `diffrax.Tsit5`, at the limit of
    stability, may do so for ever.

    Accuracy: in float32 the state at rest is within 1e-3 (`tests/test_time_forms.py`).

    Example:
        >>> problem = js.AdvectionDiffusionReaction(js.laplace_beltrami(js.sphere(500)))
        >>> z = js.sphere(500).points[:, 2]
        >>> solution = js.integrate(problem, 1 + z, t1=1e3, event=js.steady_state())
        >>> bool(solution.ts[-1] < 20)
        True
    """
    real(rtol, "rtol", least=0, below=1)
    real(atol, "atol", least=0)
    return dfx.Event(SteadyState(numbers_as_arrays(rtol), numbers_as_arrays(atol)))


# --- what came of it -----------------------------------------------------------------------


def _finished(plan: Plan, run: Run, throw: bool) -> dfx.Solution:
    """The solution as asked for; an error with the last good state if it ended early."""
    solution, verdict = _solved(run)
    assert solution.ts is not None and solution.ys is not None
    (ts, (t_last,)), (ys, last) = solution.ts, solution.ys
    stats = dict(solution.stats)
    if plan.concrete:
        stats["solver"] = plan.why
        stats["summary"] = _summary(plan, solution, float(t_last))
    else:
        stats.pop("max_steps")  # nothing but a number of ours
    solution = between_steps(solution, plan.filled)
    solution = eqx.tree_at(
        lambda s: (s.ts, s.ys, s.stats), solution, (ts, ys, stats), is_leaf=lambda x: x is None
    )
    results = (dfx.RESULTS.successful, dfx.RESULTS.event_occurred)
    if not plan.concrete:
        good = functools.reduce(operator.or_, (solution.result == r for r in results))
        if not (throw and is_marking()):
            return solution
        ended = lambda y: refuse(y, ~good, "the end was not reached")
        return eqx.tree_at(lambda s: s.ys, solution, jax.tree.map(ended, solution.ys))
    if any(bool(solution.result == r) for r in results):
        if throw and (hidden := run.hidden(last)):
            raise ValueError(_unstable(plan.name, run, hidden))
        return solution
    if verdict is not None and not bool(verdict.stable):
        if throw:
            raise ValueError(_unstable(plan.name, run, verdict))
        return solution
    _check_start(run)
    if not throw:
        return solution
    t, state = float(t_last), jax.tree.map(lambda leaf: leaf[-1], last)
    raise IntegrationError(_reason(plan, run, solution, t, state), solution, t, state)


def _solved(run: Run) -> tuple[dfx.Solution, Verdict | None]:
    """As `solve`; a derivative that the adjoint does not have is refused in words."""
    try:
        return solve(run)
    except TypeError as error:
        if "forward-mode autodiff" not in str(error):  # JAX has no class of its own for it
            raise
        raise TypeError(
            f"adjoint={type(run.adjoint).__name__} has derivatives in reverse mode only: for "
            "forward mode (jvp, jacfwd) pass adjoint=diffrax.ForwardMode(), for one over the other "
            "(jax.hessian) diffrax.DirectAdjoint() with a small max_steps"
        ) from error


def _summary(plan: Plan, solution: dfx.Solution, t: float) -> str:
    accepted, refused = (
        int(solution.stats[f"num_{kind}_steps"]) for kind in ("accepted", "rejected")
    )
    end = float(plan.run.t1)
    reached = f"t = {t:g}" if t == end else f"t = {t:g} of {end:g}"
    return f"{plan.name}: {accepted} steps ({refused} refused) to {reached}"


def _unstable(name: str, run: Run, verdict: Verdict) -> str:
    assert run.amplification is not None and run.step is not None
    dt, span = abs(float(run.step)), abs(float(run.t1 - run.t0))
    limit, radius = verdict.longest(run.amplification, dt, span)
    split, given = len(verdict.projected) > 1, run.dt0 is not None
    step = f"dt0 = {dt:g}" if given else f"a step of {dt:g}"
    when = "" if verdict.time == run.t0 else f" at t = {float(verdict.time):.3g}"
    stable = f"is stable up to {limit:.3g}" if limit else "is stable for no step here"
    what = "explicit part of the right-hand side" if split else "right-hand side"
    ways = ["shorter steps"] if limit else []
    if isinstance(run.solver, dfx.AbstractAdaptiveSolver):
        ways += ["no dt0 (steps are then adapted)" if given else "a controller that adapts them"]
    ways += [f"js.{other}()" for other in ("RKC2", "IMEX") if other != name and not split]
    better = ", or ".join(ways) or "another solver"
    better = better if better.startswith("js.") else better[0].upper() + better[1:]
    return (
        f"{step} is unstable{when}: {name} {stable}, the spectral radius of the {what} is "
        f"{radius:.3g}; {'longer' if limit else 'these'} steps multiply its fastest mode by "
        f"{float(jnp.exp(verdict.excess)):.3g} each. {better}"
    )


def _check_start(run: Run) -> None:
    """Raise if the run failed because there was no rate to start with."""
    parts = run.terms.terms if isinstance(run.terms, dfx.MultiTerm) else (run.terms,)
    for term in parts:
        for leaf in jax.tree.leaves(eqx.filter_jit(term.vf)(run.t0, run.u0, run.args)):
            check(leaf, not_finite, "the right-hand side at point {i} is not finite: {v}")


def _reason(plan: Plan, run: Run, solution: dfx.Solution, t: float, state) -> str:
    steps, rejected = (
        int(solution.stats[f"num_{kind}_steps"]) for kind in ("accepted", "rejected")
    )
    largest = max(float(jnp.max(jnp.abs(leaf))) for leaf in jax.tree.leaves(state))
    why = (
        (dfx.RESULTS.max_steps_reached, "the largest number of steps was reached"),
        (
            dfx.RESULTS.dt_min_reached,
            "no step is short enough: the solution diverges or the tolerance cannot be met",
        ),
        (
            dfx.RESULTS.nonlinear_divergence,
            "a step diverged, needed more stages than allowed, or a system in it was not solved",
        ),
    )
    reason = next((text for code, text in why if solution.result == code), None)
    if reason is None:
        reason = f"a linear system was not solved ({dfx.RESULTS[solution.result]})"  # type: ignore[misc]
    if run.amplification is not None and run.is_watched:
        span = abs(float(run.t1 - run.t0))
        longest, radius = run.checked(span).longest(run.amplification, span, span)
        reason += (
            f" (it is stable in steps up to {longest:.3g}, the spectral radius is {radius:.3g}; "
            f"controller={type(run.controller).__name__} may have chosen longer ones)"
        )
    if float(run.limit) < jnp.inf:
        reason += f" (no solution of this problem grows beyond {run.limit:.3g})"
    return (
        f"{plan.name} stopped at t = {t:.6g} of {float(run.t1):.6g}: {reason}. "
        f"{steps} steps were accepted and {rejected} refused; the last good state has values up to "
        f"{largest:.3g} and is kept as `state` of this error"
    )
