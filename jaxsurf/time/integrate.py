r"""One call from a problem and a state to a solution in time."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, ArrayLike, PyTree

from ..arguments import as_float
from .checkpoint import Checkpoint, integrate_in_parts
from .pde import AbstractEvolution
from .run import Run

# Steps that are allowed when the number that are stored does not grow with it, and otherwise.
_MANY_STEPS, _STORED_STEPS = 10_000_000, 4096


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
        args: handed to reactions and forcings.
        max_steps: by default ten million, or 4,096 where every step is stored; with a
            checkpoint, of one part.
        throw: raise if the end is not reached; if False, see `Solution.result`.

    Returns:
        A `diffrax.Solution`: times `ts`, states `ys` with time first, `stats`, `result`. On
        concrete arrays `stats["solver"]` says how it was done.

    Accuracy: of each solver, in its docstring; the number of digits follows `rtol`.
    Differentiable: reverse (forward with `ForwardMode`) in the state, the problem and `args`, for
    the steps taken: how the controller chose them is not differentiated.
    Raises:
        ValueError: a state that is not finite, or for which the right-hand side is not; a
            checkpoint that is of another run or damaged.
        IntegrationError: the end was not reached: the solution diverges, the tolerance cannot
            be met, a linear system does not converge. Holds the last good state. (Under
            `jit` an error of the run time.)

    Example:
        >>> cloud = js.sphere(500)
        >>> problem = js.AdvectionDiffusionReaction(
        ...     js.laplace_beltrami(cloud), reaction=lambda t, u, args: args * u
        ... )
        >>> solution = js.integrate(problem, cloud.points[:, 2], t1=1.0, args=1.0)
        >>> bool(jnp.abs(solution.ys[-1] - jnp.exp(-1.0) * cloud.points[:, 2]).max() < 0.01)
        True
    """
    saveat = dfx.SaveAt(t1=True) if saveat is None else saveat
    if checkpoint is not None:

        def part(state, start, end, saves):
            return integrate(
                problem, state, t1=end, t0=start, solver=solver, dt0=dt0, rtol=rtol, atol=atol,
                controller=controller, saveat=saves, event=event, adjoint=adjoint, args=args,
                max_steps=max_steps, throw=throw,
            )  # fmt: skip

        settings = (problem, solver, dt0, rtol, atol, controller, event)
        return integrate_in_parts(
            checkpoint, part, jax.tree.map(as_float, u0), t0, t1, saveat, args, settings,
            progress,
        )  # fmt: skip
    run = Run.of(problem, u0, t0, t1, solver, dt0, rtol, atol, controller, adjoint, args)
    if max_steps is None:
        max_steps = _STORED_STEPS if _stores_steps(saveat) else _MANY_STEPS
    solution = dfx.diffeqsolve(
        run.terms,
        run.solver,
        run.t0,
        run.t1,
        run.dt0,
        run.u0,
        args,
        saveat=_with_last(_closed(saveat, run.problem), run.problem),
        stepsize_controller=run.controller,
        adjoint=run.adjoint,
        event=event,
        max_steps=max_steps,
        throw=throw and not run.concrete,
        progress_meter=dfx.TqdmProgressMeter() if progress else dfx.NoProgressMeter(),
    )
    return _finished(run, solution, throw)


def steady_state(*, rtol: float = 1e-4, atol: float = 1e-6) -> dfx.Event:
    r"""Event that ends an integration once the state hardly changes.

    When $\|\partial_t u\| < \text{atol} + \text{rtol}\,\|u\|$, in the root mean square, per unit
    of time. Tolerances below those of the integration are met late: the errors of long steps
    keep the state moving.

    Example:
        >>> problem = js.AdvectionDiffusionReaction(js.laplace_beltrami(js.sphere(500)))
        >>> z = js.sphere(500).points[:, 2]
        >>> solution = js.integrate(problem, 1 + z, t1=1e3, event=js.steady_state())
        >>> bool(solution.ts[-1] < 20)
        True
    """
    return dfx.Event(dfx.steady_state_event(rtol, atol, optx.rms_norm))


# --- saving, closing, reporting ------------------------------------------------------------


def _is_sub(x) -> bool:
    return isinstance(x, dfx.SubSaveAt)


def _subs(saveat: dfx.SaveAt) -> list[dfx.SubSaveAt]:
    return [s for s in jax.tree.leaves(saveat.subs, is_leaf=_is_sub) if _is_sub(s)]


def _stores_steps(saveat: dfx.SaveAt) -> bool:
    return saveat.dense or any(sub.steps for sub in _subs(saveat))


class _Closed(eqx.Module):
    """What is saved of a state, from the state with its boundary values."""

    problem: AbstractEvolution
    what: Callable

    def __call__(self, t, y, args):
        return self.what(t, self.problem.closed(t, y), args)


def _state(t, y, args):
    return y


def _closed(saveat: dfx.SaveAt, problem: AbstractEvolution) -> dfx.SaveAt:
    """The same saves with boundary values filled in."""

    def closed(sub):
        return eqx.tree_at(lambda s: s.fn, sub, _Closed(problem, sub.fn))

    subs = jax.tree.map(closed, saveat.subs, is_leaf=_is_sub)
    return eqx.tree_at(lambda s: s.subs, saveat, subs, is_leaf=lambda x: x is None)


def _with_last(saveat: dfx.SaveAt, problem: AbstractEvolution) -> dfx.SaveAt:
    """The same saves and the last state in any case."""
    subs = (saveat.subs, dfx.SubSaveAt(t1=True, fn=_Closed(problem, _state)))
    return eqx.tree_at(lambda s: s.subs, saveat, subs, is_leaf=lambda x: x is None)


def _finished(run: Run, solution: dfx.Solution, throw: bool) -> dfx.Solution:
    """The solution as asked for; an error with the last good state if it ended early."""
    assert solution.ts is not None and solution.ys is not None
    (ts, (t_last,)), (ys, last) = solution.ts, solution.ys
    stats = dict(solution.stats)
    if run.concrete:
        stats["solver"] = run.why if run.why != "given" else f"{type(run.solver).__name__}: given"
    solution = eqx.tree_at(
        lambda s: (s.ts, s.ys, s.stats), solution, (ts, ys, stats), is_leaf=lambda x: x is None
    )
    good = (dfx.RESULTS.successful, dfx.RESULTS.event_occurred)
    if not throw or not run.concrete or any(solution.result == r for r in good):
        return solution
    t, state = float(t_last), jax.tree.map(lambda leaf: leaf[-1], last)
    raise IntegrationError(_reason(run, solution, t, state), solution, t, state)


def _reason(run: Run, solution: dfx.Solution, t: float, state) -> str:
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
    return (
        f"{type(run.solver).__name__} stopped at t = {t:.6g} of {float(run.t1):.6g}: {reason}. "
        f"{steps} steps were accepted and {rejected} refused; the last good state has values up to "
        f"{largest:.3g} and is kept as `state` of this error"
    )
