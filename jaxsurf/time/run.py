r"""What an integration consists of: terms, solver and controller that go together, checked."""

from __future__ import annotations

import logging
from typing import Any, NamedTuple

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, PyTree

from ..arguments import instance, real, whole, within_round_off
from ..compiling import AnyArray, host_jit, namespace, sized_filter_jit, without_full_collections
from ..failures import is_concrete, is_marking, warn
from ..functions import Traced, canonical, constant, numbers_as_arrays
from .amplification import AbstractAmplification, amplification_of
from .asked import (
    check_adjoint,
    check_coefficients,
    check_linear,
    check_saves,
    check_solver,
    check_tolerances,
    checked_rate,
    checked_state,
    checked_times,
    resolved,
)
from .chebyshev import Loop
from .explicit import RKC2
from .guard import GROWN, Guard, guarded
from .loops import COPIES, RecursiveCheckpoints, count_steps, most_steps
from .phases import Linear, Rest, frozen, has_phases
from .problem import AbstractEvolution, checked_problem
from .saving import closed_saves, ending, filling, stores_steps
from .stability import Verdict, Watch, check_steps
from .states import Norm, root_mean_square

_log = logging.getLogger(__name__)

# Asked by programs while they are traced; JAX keeps those apart that were told otherwise.
_forwards = jax.make_user_context(default_value=False)
# A step this much shorter than the whole interval means that something diverges.
_SHORTEST = 1e-11
# Steps that are allowed when the number that are stored does not grow with it, and otherwise.
_MANY_STEPS, _STORED_STEPS = 10_000_000, 4096


def choose_solver(problem: AbstractEvolution) -> tuple[dfx.AbstractSolver, str]:
    """A solver that suits the kind of problem, and why: its `suggested_solver()`.

    Only the kind counts, not the values, so that the choice is the same under `jit` and
    `grad`. Reactions faster than diffusion on the smallest scale call for `SDIRK`, which is
    yours to pass.

    Args:
        problem: what is to be integrated.

    Returns:
        The solver and a sentence.

    Raises:
        TypeError: not a problem in time.

    Example:
        >>> js.choose_solver(js.WaveEquation(js.laplace_beltrami(js.sphere(500))))[1]
        'Tsit5: waves are not stiff'
    """
    return checked_problem(problem).suggested_solver()


class Run(eqx.Module):
    """Everything that is compiled: arrays, and programs that are equal if they compute the same."""

    terms: PyTree
    solver: dfx.AbstractSolver
    t0: Array
    t1: Array
    dt0: Array | None
    u0: PyTree[Array]
    args: Any
    controller: dfx.AbstractStepSizeController
    limit: Array
    saveat: dfx.SaveAt
    event: dfx.Event | None
    adjoint: dfx.AbstractAdjoint
    max_steps: int = eqx.field(static=True)
    progress: bool = eqx.field(static=True)
    throw: bool = eqx.field(static=True)
    moving: bool = eqx.field(static=True)

    def over(self, u0, t0, t1, saveat: dfx.SaveAt) -> Run:
        """The same from another state over another time."""
        times = (jnp.asarray(t, self.t0.dtype) for t in (t0, t1))
        new = (jax.tree.map(jnp.asarray, u0), *times, saveat)
        return eqx.tree_at(lambda run: (run.u0, run.t0, run.t1, run.saveat), self, new)

    @property
    def step(self) -> Array | None:
        """The length of the steps if it is given: of the longest if they differ."""
        controller = _clipped(self.controller)
        if isinstance(controller, dfx.StepTo):
            return jnp.max(jnp.abs(jnp.diff(controller.ts)))
        return self.dt0 if isinstance(controller, dfx.ConstantStepSize) else None

    @property
    def amplification(self) -> AbstractAmplification | None:
        """Of the steps, if they are explicit, in part or whole, and nothing sees their errors:
        these can be unstable."""
        if isinstance(_clipped(self.controller), dfx.AbstractAdaptiveStepSizeController):
            return None
        return amplification_of(self.solver, 1 + _takes_two(self.solver))

    @property
    def changes(self) -> bool:
        """Whether a rate depends on time."""
        return any(part.reads_first for part in _programs(self.terms))

    def judged(self, closely: bool = False) -> Verdict | None:
        """Whether they are; None if they cannot be. Closely: at many times."""
        if self.amplification is None or self.step is None:
            return None
        return self.checked(self.step, closely)

    def checked(self, dt, closely: bool = False) -> Verdict:
        """The same for steps of some length, where they can be unstable."""
        assert self.amplification is not None
        now = (self.t0, self.u0, self.args, dt, self.t1 - self.t0)
        return check_steps(self.amplification, self.rates, *now, self.changes, closely)

    @property
    def is_watched(self) -> bool:
        """Whether steps can be unstable whose lengths are not known before they are taken."""
        return self.amplification is not None and self.step is None

    def watched(self) -> Watch | None:
        """A watch on steps whose length a controller chooses that knows no errors."""
        if not self.is_watched:
            return None
        now = (self.t0, self.u0, self.args, self.t1 - self.t0)
        return Watch.over(self.amplification, self.rates, *now, self.changes)

    @property
    def rates(self) -> tuple:
        """The right-hand side, or its parts, with what is frozen for a step as at the start."""
        terms = self.terms
        terms = frozen(terms, self.t0, self.u0) if has_phases(terms) else terms
        parts = terms.terms if isinstance(terms, dfx.MultiTerm) else (terms,)
        return tuple(part.vf for part in parts)

    def hidden(self, states: PyTree[Array]) -> Verdict | None:
        """What made a state grow that nothing bounds, if it was steps; on the host.

        Where a rate depends on time, few times are looked at before a run.

        Args:
            states: of which the last is the end.
        """
        bounded = float(self.limit) < jnp.inf
        if self.amplification is None or self.step is None or not self.changes or bounded:
            return None
        last = jax.tree.map(lambda leaf: leaf[-1], states)
        if not 0 < GROWN * root_mean_square(self.u0) < root_mean_square(last):
            return None
        verdict = _judged_closely(self)
        return None if verdict is None or bool(verdict.stable) else verdict


@eqx.filter_jit
def _judged_closely(run: Run) -> Verdict | None:
    return run.judged(closely=True)


class Plan(NamedTuple):
    """A run and what is told of it.

    Args:
        run: as it is compiled.
        name: of the solver.
        why: it was chosen.
        concrete: nothing is traced, so that results can be looked at.
        filled: what fills in boundary values between steps.
    """

    run: Run
    name: str
    why: str
    concrete: bool
    filled: Traced | None


def solve(run: Run) -> tuple[dfx.Solution, Verdict | None]:
    """The integration, and whether its steps were stable; one program for all numbers."""
    return (_solved_moving if run.moving else _solved)(run)


@without_full_collections
def _solution(run: Run) -> tuple[dfx.Solution, Verdict | None]:
    verdict = run.judged()
    refused = jnp.asarray(False) if verdict is None else ~verdict.stable
    solution = dfx.diffeqsolve(
        run.terms,
        run.solver,
        run.t0,
        run.t1,
        run.dt0,
        run.u0,
        run.args,
        saveat=run.saveat,
        stepsize_controller=guarded(run.controller, Guard(run.limit, refused, run.watched())),
        adjoint=run.adjoint,
        event=run.event,
        max_steps=run.max_steps,
        throw=run.throw,
        progress_meter=dfx.TqdmProgressMeter() if run.progress else dfx.NoProgressMeter(),
    )
    return solution, verdict


_solved, _solved_moving = eqx.filter_jit(_solution), sized_filter_jit(_solution)


def forwards() -> Any:
    """Within it, integrations that are traced have derivatives in forward mode, unless told how."""
    return _forwards(True)


def planned(
    problem, u0, t0, t1, *, solver, dt0, rtol, atol, controller, saveat, event, adjoint, args,
    max_steps, progress, throw,
) -> Plan:  # fmt: skip
    """Check all that `integrate` is given, and bring it into the form that is compiled."""
    checked_problem(problem)
    u0 = checked_state(problem, u0)
    times = t0, t1, dt0  # constants, where a program makes arrays of them that it does not know
    t0, t1, dt0 = checked_times(problem, u0, t0, t1, dt0)
    args = numbers_as_arrays(args)
    for value, kind, name in (
        (solver, dfx.AbstractSolver, "solver"), (event, dfx.Event, "event"),
        (controller, dfx.AbstractStepSizeController, "controller"),
        (adjoint, dfx.AbstractAdjoint, "adjoint"), (saveat, dfx.SaveAt, "saveat"),
    ):  # fmt: skip
        if value is not None:
            instance(value, kind, name, f"an object of diffrax or jaxsurf, like {_LIKE[name]}")
    check_adjoint(adjoint)
    why = "given"
    if solver is None:
        solver, why = choose_solver(problem)
    name = type(solver).__name__
    if adjoint is None:
        reverse = RecursiveCheckpoints(COPIES)
        adjoint = dfx.ForwardMode() if _forwards.value else reverse
    if isinstance(solver, RKC2):
        solver = _looped(solver, adjoint)
    if controller is None and dt0 is None:
        within_round_off(rtol, t0.dtype)
        real(atol, "atol", least=0)
        problem.tell_small(u0, atol)
        controller = problem.controller(rtol, atol, _shortest(t0, t1))
    elif controller is None:
        controller = dfx.ConstantStepSize()
    check_tolerances(controller, t0.dtype)
    check_solver(solver, controller)
    saveat = check_saves(dfx.SaveAt(t1=True) if saveat is None else saveat, t0, t1)
    allowed = _allowed(max_steps, saveat, t0, t1, dt0, controller)
    check_coefficients(problem, t0, t1)
    if problem.active is not None and getattr(controller, "norm", None) is optx.rms_norm:
        controller = eqx.tree_at(lambda c: c.norm, controller, Norm(jnp.asarray(problem.active)))
    arrays = numbers_as_arrays(problem)
    now = (t0, u0, args)
    terms = _terms(arrays, solver, now)
    if _takes_two(solver):
        check_linear(arrays, t0, u0)
    controller = _with_arrays(controller)
    if event is not None:
        told = dict(
            terms=terms, solver=solver, t0=t0, t1=t1, dt0=dt0, saveat=saveat,
            stepsize_controller=controller, max_steps=allowed,
        )  # fmt: skip
        event = ending(event, arrays, now, told)
    filled = filling(arrays, saveat, now)
    saveat = closed_saves(saveat, arrays, now)
    limit = _limit(*constant((u0, jnp.asarray(problem._grows, t0.dtype), t0, t1)))
    parts = (terms, solver, t0, t1, dt0, u0, args, controller, limit, saveat, event, adjoint)
    concrete = is_concrete(parts)  # also not inside a `jit`, which would make the limit traced
    _log.info("%s over [%s, %s] by %s", type(problem).__name__, t0, t1, why)
    if not concrete and max_steps is None and type(controller) is dfx.ConstantStepSize:
        # What is stored at every step is as long as there may be steps.
        allowed = allowed if stores_steps(saveat) else most_steps(*times, allowed)
    throw = bool(throw) and not concrete and not is_marking()
    run = Run(*parts, allowed, bool(progress), throw, problem._moves)
    why = f"{name}: given" if why == "given" else why
    return Plan(run, name, why, concrete, filled)


_LIKE = dict(
    solver="js.RKC2()", event="js.steady_state()", controller="dfx.PIDController(...)",
    adjoint="dfx.ForwardMode()", saveat="dfx.SaveAt(ts=...)",
)  # fmt: skip


def _terms(problem: AbstractEvolution, solver: dfx.AbstractSolver, now):
    """The right-hand side, in two parts for solvers that treat them differently."""
    if not _takes_two(solver):
        return dfx.ODETerm(canonical(checked_rate(problem.rate), *now))
    if type(problem).at is AbstractEvolution.at:
        parts = (problem.explicit_rate, problem.implicit_rate)
        return dfx.MultiTerm(*(dfx.ODETerm(canonical(checked_rate(part), *now)) for part in parts))
    linear = _linear_part(problem, now)
    whole = canonical(checked_rate(problem.rate), *now)
    return dfx.MultiTerm(dfx.ODETerm(Rest(whole, linear)), dfx.ODETerm(linear))


def _linear_part(problem: AbstractEvolution, now) -> Linear:
    """In two phases, each a program."""
    t, u, _ = now
    fixed = []

    def freeze(t, u):
        arrays, rest = eqx.partition(problem.at(t, problem.closed(t, u)), eqx.is_array)
        fixed.append(rest)
        return arrays

    def apply(t, u, arrays):
        return eqx.combine(arrays, fixed[0]).implicit_rate(t, u, None)

    first = canonical(freeze, t, u)
    shapes = jax.eval_shape(first, t, u)
    arrays = jax.tree.map(lambda s: jnp.zeros(s.shape, s.dtype), shapes)
    return Linear(first, canonical(checked_rate(apply), t, u, arrays))


def _programs(terms: PyTree) -> list[Traced]:
    is_program = lambda x: isinstance(x, Traced)
    return [x for x in jax.tree.leaves(terms, is_leaf=is_program) if is_program(x)]


def _takes_two(solver: dfx.AbstractSolver) -> bool:
    return getattr(solver.term_structure, "__origin__", None) is dfx.MultiTerm


def _looped(solver: RKC2, adjoint: dfx.AbstractAdjoint) -> RKC2:
    """With the kind of loop that the adjoint can differentiate."""
    loop: Loop = "checkpointed"
    if isinstance(adjoint, dfx.ForwardMode):
        loop = "lax"
    elif isinstance(adjoint, dfx.DirectAdjoint):
        loop = "bounded"
    return RKC2(solver.spectral_radius, solver.max_stages, loop)


@host_jit
def _limit(u0, growth, t0: AnyArray, t1: AnyArray) -> AnyArray:
    """Size beyond which a state is none of the problem's."""
    xp, size = namespace(t0), root_mean_square(u0)
    # (Infinite times nothing would be no number.)
    grown = xp.where(xp.isfinite(growth), xp.exp(growth * abs(t1 - t0)), xp.inf)
    return xp.where(size > 0, GROWN * size * grown, xp.where(xp.isfinite(grown), 0 * size, xp.inf))


@host_jit
def _shortest(t0: AnyArray, t1: AnyArray) -> AnyArray:
    """A step that is not worth trying: much shorter than all, or lost in the time."""
    return namespace(t0).maximum(_SHORTEST * abs(t1 - t0), resolved(t0, t1))


def _clipped(controller: dfx.AbstractStepSizeController) -> dfx.AbstractStepSizeController:
    """What chooses the steps that another cuts off at some times."""
    if isinstance(controller, dfx.ClipStepSizeController):
        return _clipped(controller.controller)
    return controller


def _with_arrays(controller: dfx.AbstractStepSizeController):
    """Tolerances as arrays; whole numbers stay, like coefficients that are zero."""
    number = lambda x: jnp.asarray(x) if isinstance(x, float) else x
    return jax.tree.map(number, controller)


def _allowed(max_steps, saveat: dfx.SaveAt, t0, t1, dt0, controller) -> int:
    """The largest number of steps; an error if steps of given length are sure to be more."""
    given = max_steps is not None
    if given:
        max_steps = whole(max_steps, "max_steps", least=1)
    else:
        max_steps = _STORED_STEPS if stores_steps(saveat) else _MANY_STEPS
    adaptive = isinstance(controller, dfx.AbstractAdaptiveStepSizeController)
    steps = None if given or adaptive else count_steps(t0, t1, dt0)
    if steps is not None:
        if steps > max_steps + 1:
            raise ValueError(
                f"dt0 = {float(dt0):g} makes {steps:.3g} steps from {float(t0):g} to "
                f"{float(t1):g}, at most {max_steps} are taken: a longer step, or `max_steps`"
            )
        if steps > _MANY_STEPS / 10:
            warn(f"dt0 = {float(dt0):g} makes {steps:.3g} steps")
    return max_steps
