"""What is seen of a run: states with their boundary values, when it ends, and the way between."""

from __future__ import annotations

from collections.abc import Callable

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..compiling import on_device
from ..failures import is_concrete
from ..functions import Traced, canonical
from .problem import AbstractEvolution
from .states import Norm, root_mean_square

_AS_IT_IS = dfx.SubSaveAt(t1=True).fn


def _is_sub(x) -> bool:
    return isinstance(x, dfx.SubSaveAt)


def stores_steps(saveat: dfx.SaveAt) -> bool:
    """Whether memory grows with the number of steps."""
    subs = [s for s in jax.tree.leaves(saveat.subs, is_leaf=_is_sub) if _is_sub(s)]
    return saveat.dense or any(sub.steps for sub in subs)


def _closed(problem: AbstractEvolution, what: Callable, now) -> Callable:
    """What is made of a state, from the state with its boundary values."""
    if problem.closure is None and what is _AS_IT_IS:
        return what
    return canonical(lambda t, y, args: what(t, problem.closed(t, y), args), *now)


def closed_saves(saveat: dfx.SaveAt, problem: AbstractEvolution, now) -> dfx.SaveAt:
    """The same saves with boundary values filled in, and the last state in any case."""
    new = lambda sub: eqx.tree_at(lambda s: s.fn, sub, _closed(problem, sub.fn, now))
    subs = jax.tree.map(new, saveat.subs, is_leaf=_is_sub)
    last = new(dfx.SubSaveAt(t1=True))
    return eqx.tree_at(lambda s: s.subs, saveat, (subs, last), is_leaf=lambda x: x is None)


class AbstractCondition(eqx.Module):
    """One of our own, which knows what diffrax gives it, and is not traced beforehand."""


class SteadyState(AbstractCondition):
    """True where the rate is small. Its numbers are leaves: others compile nothing."""

    rtol: Array
    atol: Array
    norm: Callable = root_mean_square

    def __call__(self, t, y, args, *, terms, solver, **_):
        rate = solver.func(terms, t, y, args)
        return self.norm(rate) < self.atol + self.rtol * self.norm(y)


class _Ending(eqx.Module):
    """A condition that ends a run, as a program, in the time of the problem.

    Args:
        value: of the time, the state and `args`.
        direction: -1 where the run goes backwards: diffrax then counts time forwards.
    """

    value: Callable
    direction: Array

    def __call__(self, t, y, args, **_):
        return self.value(self.direction * t, y, args)


def ending(event: dfx.Event, problem: AbstractEvolution, now, told: dict) -> dfx.Event:
    """The event with its conditions as programs, of the state with its boundary values.

    Args:
        now: time, state and arguments to begin with.
        told: what diffrax tells conditions of the run.
    """
    t0, t1 = told["t0"], told["t1"]
    if is_concrete(t0, t1):
        direction = on_device(np.where(np.asarray(t1) < np.asarray(t0), -1, 1).astype(t0.dtype))
    else:
        direction = jnp.where(t1 < t0, -1, 1).astype(t0.dtype)

    def new(condition):
        if isinstance(condition, AbstractCondition):
            if problem.active is None or not isinstance(condition, SteadyState):
                return condition
            return eqx.tree_at(lambda c: c.norm, condition, Norm(jnp.asarray(problem.active)))
        value = lambda t, y, args: condition(t, y, args, **told)
        return _Ending(_closed(problem, value, now), direction)

    conditions = jax.tree.map(new, event.cond_fn, is_leaf=callable)
    return eqx.tree_at(lambda e: e.cond_fn, event, conditions)


class _Filled(dfx.AbstractPath):
    """A solution between its steps, with boundary values.

    Args:
        path: as the steps have it.
        filled: of a time and a state.
    """

    path: dfx.AbstractPath
    filled: Traced

    t0 = property(lambda self: self.path.t0)  # type: ignore[misc]
    t1 = property(lambda self: self.path.t1)  # type: ignore[misc]

    def evaluate(self, t0, t1=None, left=True):
        if t1 is not None:
            ends = self.evaluate(t1, left=left), self.evaluate(t0, left=left)
            return jax.tree.map(jnp.subtract, *ends)
        t0 = jnp.asarray(t0, jnp.asarray(self.t0).dtype)
        return self.filled(t0, self.path.evaluate(t0, left=left))

    def derivative(self, t, left=True):
        t = jnp.asarray(t, jnp.asarray(self.t0).dtype)
        now = t, self.path.evaluate(t, left=left)
        rates = jnp.ones_like(t), self.path.derivative(t, left=left)
        return jax.jvp(self.filled, now, rates)[1]


def filling(problem: AbstractEvolution, saveat: dfx.SaveAt, now) -> Traced | None:
    """What fills in boundary values of a dense solution; None where there is nothing to fill."""
    if problem.closure is None or not saveat.dense:
        return None
    return canonical(problem.closed, *now[:2])


def between_steps(solution: dfx.Solution, filled: Traced | None) -> dfx.Solution:
    """The solution with boundary values also between its steps."""
    path = solution.interpolation
    if filled is None or path is None:
        return solution
    return eqx.tree_at(lambda s: s.interpolation, solution, _Filled(path, filled))
