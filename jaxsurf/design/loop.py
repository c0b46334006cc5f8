r"""The loop of an optimisation: steps that may be refused, lists and points that are renewed."""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import PyTree

from ..arguments import flag, same_values
from ..time.checkpoint import Checkpoint, digest, read_back, written
from .asked import ILL, is_only_far, refuse_start
from .lagrangian import (
    Asked,
    Multipliers,
    Problem,
    Values,
    Violation,
    direction,
    evaluated,
    first_penalty,
    kinds,
    started,
    weightless,
    with_penalty,
)
from .outcome import COLUMNS, ShapeOptimization
from .shape import (
    AbstractShape,
    checked_shape,
    renewed_with_room,
    surface_of,
    unchecked_surface,
    with_wear,
)

# A step that fails is halved so often.
_HALVINGS = 12
# Forces are corrected after so many steps, or when the gradient has fallen to a share of the scale.
_INNER, _GOAL = 20, 0.1
# A violation that does not fall to this share makes the penalty grow by that factor.
_FALLS, _GROWTH = 0.25, 4.0
# One that stays above this share, so many times in a row or at the end, is minimised alone, in so
# many steps: if it stays then too, constraints contradict each other.
_STAYS, _STALLS, _ALONE = 0.9, 8, 50
# Why there is no step where nothing is wrong with those that were tried.
_BOTTOM = "no step along the search lowers the objective"
# An objective that has grown so much has run away.
_RUN_AWAY = 1e3


class _Run(NamedTuple):
    """All that a step begins with, as arrays: what is on disk.

    Args:
        step: how many were made.
        theta, state: parameters, and what the optimiser remembers.
        multipliers, values: forces, and what is seen at theta.
        lists: the arrays of the shape.
        first: size of the first gradient of the objective alone.
        scale: the same, or what it was when forces were corrected last, if that is larger.
        goal: share of it at which the forces are corrected.
        since: steps since they were.
        violation: what it was then.
        stalls: how often in a row it has stayed.
        history: one row a step, NaN where there was none.
    """

    step: Any
    theta: PyTree
    state: PyTree
    multipliers: Multipliers
    values: Values
    lists: PyTree
    first: Any
    scale: Any
    goal: Any
    since: Any
    violation: Any
    stalls: Any
    history: dict[str, np.ndarray]


class _File(NamedTuple):
    """Where a run is written, after how many steps, and what it is known by."""

    path: Path
    every: int
    told: str

    def read(self, run: _Run) -> _Run:
        """As far as it has come, if it is there."""
        if not self.path.exists():
            return run
        differ = "shape, start, functions, optimiser or settings"
        found = read_back(self.path, self.told, run, same_sizes=False, run=differ)
        # More steps may be asked for now.
        longer = lambda rows, room: np.concatenate([rows, room[len(rows) :]])
        history = {name: longer(rows, run.history[name]) for name, rows in found.history.items()}
        place = lambda new, old: jnp.asarray(new) if isinstance(old, jax.Array) else new
        return jax.tree.map(place, found._replace(history=history), run)


class Loop(NamedTuple):
    """What does not change during a run."""

    asked: Asked
    args: tuple
    optimizer: Any
    numbers: dict[str, Any]
    callback: Callable | None
    checkpoint: Checkpoint | None

    def run(self, shape: AbstractShape, theta) -> tuple[ShapeOptimization, bool]:
        """What is found, and whether it failed."""
        clock, renew = time.perf_counter(), self.numbers["renew"]
        shape = checked_shape(shape.rebuilt(theta), shape, "rebuilt") if renew else shape
        try:
            surface = surface_of(shape, theta)
        except ValueError:
            surface = unchecked_surface(shape, theta)
            if not (renew and is_only_far(surface)):
                raise
            shape = shape.renewed(theta, surface.search())
        search = surface.search() if renew else None
        shape = with_wear(shape) if renew else shape
        problem = Problem.of(self.asked, shape, theta, self.args, renew)
        run = self.first(problem, shape, theta)
        file = None
        if self.checkpoint is not None:
            numbers = self.numbers | dict(steps=None)
            known = self._replace(callback=None, checkpoint=None, numbers=numbers)
            told = digest(((known, shape, theta), problem))
            file = _File(Path(self.checkpoint.path), max(1, round(self.checkpoint.every)), told)
            run = file.read(run)
            shape = eqx.combine(run.lists, shape)
        clock -= float(run.history["seconds"][int(run.step)])
        stopped, failed = self.ended(run), False
        while not stopped:
            problem = problem.at(shape)
            run, shape, stopped = self.step(problem, shape, run, search)
            run.history["seconds"][int(run.step)] = time.perf_counter() - clock
            failed = bool(stopped)
            if failed:
                break
            stopped = self.ended(run)
            if why := self.contradiction(shape, run, last=bool(stopped)):
                stopped, failed = why, True
                break
            if file is not None and (stopped or int(run.step) % file.every == 0):
                written(file.path, file.told, run)
            call = self.callback
            said = None if call is None else call(self.found(run, shape, stopped))
            if said is not None and flag(np.asarray(said)[()], "what callback returns"):
                stopped = stopped or "ended by the callback"
        return self.found(run, shape, stopped), failed

    def first(self, problem, shape, theta) -> _Run:
        """At the start, if it is good."""
        f, h, g = kinds(problem, theta)
        if f.shape != ():
            raise ValueError(f"objective returns shape {f.shape}, expected one number")
        for name, x in (h | g).items():
            if not x.size:
                raise ValueError(f"constraint {name!r} returns shape {x.shape}: no numbers")
        nothing = lambda some: {name: jnp.zeros(x.shape, x.dtype) for name, x in some.items()}
        multipliers = Multipliers(nothing(h), nothing(g), jnp.ones((), f.dtype))
        theta, values = evaluated(problem, theta, weightless(multipliers))
        refuse_start(theta, values)
        first, given = np.asarray(values.size), self.numbers["penalty"]
        mu = first_penalty(values) if given is None else jnp.asarray(given, f.dtype)
        multipliers = multipliers._replace(penalty=mu)
        if h or g:
            theta, values = evaluated(problem, theta, multipliers)
            refuse_start(theta, values)
        rows = self.numbers["steps"] + 1
        history = {name: np.full(rows, np.nan) for name in COLUMNS}
        for name, x in (values.equalities | values.inequalities).items():
            history[name] = np.full((rows, *x.shape), np.nan)
        zero = np.array(0)
        run = _Run(
            zero, theta, started(self.optimizer, theta), multipliers, values,
            eqx.filter(shape, eqx.is_array), first, first, np.array(_GOAL), zero,
            np.array(np.inf), zero, history,
        )  # fmt: skip
        _note(run, refused=0, renewed=0, rebuilt=0)
        history["seconds"][0] = 0.0
        return run

    def step(self, problem, shape, run: _Run, search) -> tuple[_Run, AbstractShape, str]:
        """One step, what it asks for, and why there is none."""

        def look(theta, *updates):
            theta, values = evaluated(problem, theta, run.multipliers, *updates)
            return _covered(problem, shape, theta, values, run.multipliers, search), theta

        updates, state, ahead = self.searched(look, run)
        for refused in range(_HALVINGS + 1):
            (covering, values, ill), theta = look(run.theta, updates, 0.5**refused)
            anew = covering
            if not ill and bool(values.worn) and search is not None:
                anew, ill = _with_new_lists(problem, covering, theta, run.multipliers, search)
            if not ill:
                break
        else:
            return run, shape, _halved(run, ill)
        rebuilt, renewed, shape = covering is not shape, anew is not covering, anew
        still, why = same_values(run.theta, theta), ""
        run = run._replace(
            step=run.step + 1, theta=theta, state=state, values=values, since=run.since + 1
        )
        if renewed or rebuilt:
            run = run._replace(lists=eqx.filter(shape, eqx.is_array))
        small = _is_small(run, run.goal)
        corrected = bool(self.asked.equalities or self.asked.inequalities) and (
            still or small or int(run.since) >= _INNER
        )
        if corrected:
            run = self.corrected(problem.at(shape), run, solved=still or small)
        if renewed or rebuilt or corrected:
            run = _seen_again(problem.at(shape), run, self.optimizer)
        # Other forces are no way round what is ahead: there the Lagrangian is not least.
        if still and not (renewed or rebuilt) and (ahead or not corrected):
            why = _BOTTOM
            if ahead:
                why += f", and farther along it {ahead}: the last good shape is kept"
        _note(run, refused=refused, renewed=renewed, rebuilt=rebuilt)
        return run, shape, why

    def searched(self, look, run: _Run) -> tuple[PyTree, Any, str]:
        """Updates, the state of the optimiser, and what is wrong with the nearest it has tried."""
        ills = [""]

        def beyond(theta):
            """A search along a line goes on to where there are other parts."""
            (_, values, ill), there = look(theta)
            ills.extend([] if same_values(run.theta, there) else [ill])
            return values

        updates, state = direction(self.optimizer, beyond, run.theta, run.values, run.state)
        return updates, state, ills[-1]

    def corrected(self, problem, run: _Run, solved: bool) -> _Run:
        """With forces that the constraints were met with, and the penalty that this asks for.

        A violation tells of penalty and constraints only where the Lagrangian was minimised: steps
        of a given length leave one that no penalty takes away.
        """
        now, last = float(run.values.violation), float(run.violation)
        multipliers = run.values.forced
        wrong = now > self.numbers["ctol"]
        if wrong and solved and now > _FALLS * last:
            multipliers = with_penalty(multipliers, _GROWTH)
        # Under a projection they are not minimised alone.
        counts = solved or self.asked.project is None
        stalls = run.stalls + counts if wrong and now > _STAYS * last else np.array(0)
        goal = np.maximum(self.numbers["rtol"], _GOAL * run.goal)
        _, alone = evaluated(problem, run.theta, weightless(multipliers))
        return run._replace(
            multipliers=multipliers, violation=np.array(now), stalls=stalls, goal=goal,
            scale=np.maximum(run.first, alone.size), since=np.array(0),
        )  # fmt: skip

    def contradiction(self, shape, run: _Run, last: bool) -> str:
        """What is told of a violation that has stayed and cannot be lessened, if there is one."""
        off, stalls = float(run.values.violation), int(run.stalls)
        often = stalls >= _STALLS and stalls % _STALLS == 0 and int(run.since) == 0
        if off <= self.numbers["ctol"] or not stalls or not (often or last):
            return ""
        text = f"constraints are not met: a violation of {off:.3g} has stayed"
        if self.asked.project is None:
            alone, failed = self.alone(shape, run.theta)
            violation = alone.history["objective"]
            if violation[-1] <= _STAYS**2 * violation[0]:
                return ""
            if failed and alone.stopped != _BOTTOM:
                return f"{text}; where they alone are minimised, {alone.stopped}"
            text += ", and is not lessened where they alone count either"
        elif not often:
            return ""
        return f"{text}; they contradict each other, or what the shape can do"

    def alone(self, shape, theta) -> tuple[ShapeOptimization, bool]:
        """What is found where constraints alone are minimised."""
        met = lambda now: bool(now.objective <= self.numbers["ctol"] ** 2 / 2)
        off = Violation(self.asked.equalities, self.asked.inequalities)
        alone = self._replace(
            asked=Asked(off, {}, {}, None), optimizer=optax.lbfgs(), callback=met,
            checkpoint=None, numbers=self.numbers | dict(steps=_ALONE),
        )  # fmt: skip
        return alone.run(shape, theta)

    def ended(self, run: _Run) -> str:
        """Why it ends here, if it does."""
        steps, off = int(run.step), float(run.values.violation)
        nothing = float(run.history["gradient"][0]) == 0 and float(run.values.size) == 0
        if steps == 0 and nothing and not (run.values.equalities | run.values.inequalities):
            return "the gradient vanishes at the first theta"
        if _is_small(run, self.numbers["rtol"]) and off <= self.numbers["ctol"]:
            return "converged"
        if steps < self.numbers["steps"]:
            return ""
        unmet = f", and constraints are off by {off:.2g}" if off > self.numbers["ctol"] else ""
        return f"all {steps} steps used{unmet}"

    def found(self, run: _Run, shape, stopped: str) -> ShapeOptimization:
        rows = {name: values[: int(run.step) + 1].copy() for name, values in run.history.items()}
        v, forces = run.values, run.multipliers.equalities | run.multipliers.inequalities
        return ShapeOptimization(
            run.theta, shape, v.objective, v.equalities, v.inequalities, forces, rows,
            stopped == "converged", stopped or "under way",
        )  # fmt: skip


def _covered(problem, shape, theta, values, multipliers, search):
    """A shape whose points cover the surface at theta, what is seen of it, what is wrong."""
    try:
        covering = shape if search is None else _quietly(shape.rebuilt, theta, search)
    except ValueError as error:
        return shape, values, str(error)
    if covering is not shape:
        values = evaluated(problem.at(covering), theta, multipliers)[1]
    code = int(values.code)
    return covering, values, ILL[code] if code else ""


def _with_new_lists(problem, shape, theta, multipliers, search) -> tuple[AbstractShape, str]:
    """The shape with neighbours found anew at theta, and what is wrong with it."""
    try:
        anew = _quietly(renewed_with_room, shape, theta, search)
    except ValueError as error:
        return shape, f"neighbours could not be found anew: {error}"
    code = int(evaluated(problem.at(anew), theta, multipliers)[1].code)
    return anew, f"with neighbours found anew {ILL[code]}" if code else ""


def _halved(run: _Run, ill: str) -> str:
    """Why there is no step."""
    why = f"steps were halved {_HALVINGS} times, and still {ill}"
    first, now = float(run.history["objective"][0]), float(run.values.objective)
    if abs(now) > _RUN_AWAY * max(abs(first), 1):
        why += f"; before that the objective went from {first:.3g} to {now:.3g}: shorter steps?"
    return f"{why}: the last good shape is kept"


def _quietly(change: Callable, *args) -> AbstractShape:
    """Without warnings: what bends within one stencil was told of the first surface."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return change(*args)


def _seen_again(problem: Problem, run: _Run, optimizer) -> _Run:
    """After a change of what is minimised: value and gradient, also that which is remembered.

    L-BFGS compares gradients at two places, which have to be those of one function. It begins
    again where that has none at the place before.
    """
    _, values = evaluated(problem, run.theta, run.multipliers)
    state = run.state
    head = state[0] if isinstance(state, tuple) and state else None
    if isinstance(head, optax.ScaleByLBFGSState):
        _, past = evaluated(problem, head.params, run.multipliers)
        if int(past.code):
            state = started(optimizer, run.theta)
        else:
            state = (head._replace(updates=past.gradient), *state[1:])
    return run._replace(values=values, state=state)


def _is_small(run: _Run, share) -> bool:
    """Whether the gradient is a share of the objective's.

    That of a penalty tells how far off constraints were, not what is stationary: it counts only
    where the objective has none.
    """
    first, scale = float(run.history["gradient"][0]), float(run.scale)
    nil = scale <= np.finfo(run.scale.dtype).eps * first
    return float(run.values.size) <= float(share) * (first if nil else scale)


def _note(run: _Run, **others) -> None:
    """The row of a step."""
    v, row = run.values, int(run.step)
    known = dict(objective=v.objective, gradient=v.size, violation=v.violation)
    known |= dict(penalty=run.multipliers.penalty) | others | v.equalities | v.inequalities
    for name, value in known.items():
        run.history[name][row] = np.asarray(value)
