r"""What `integrate` asks of its arguments."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PyTree

from ..arguments import as_float, real, within_round_off
from ..boundary import check_border
from ..compiling import AnyArray, namespace
from ..failures import check, is_concrete, not_finite, raise_at
from .higher import WaveEquation
from .problem import AbstractEvolution
from .states import dtype_of, only_on

# So many units of round-off a step has at least.
_RESOLVED = 4


def resolved(t0: AnyArray, t1: AnyArray) -> AnyArray:
    """A step that is not lost in the times of a run."""
    return _RESOLVED * jnp.finfo(t0.dtype).eps * namespace(t0).maximum(abs(t0), abs(t1))


def checked_state(problem: AbstractEvolution, u0: Any) -> PyTree[Array]:
    """The state as arrays of floating-point numbers.

    Raises:
        TypeError: lists, numbers, complex fields.
        ValueError: another number of points than the operators have, entries that are not finite.
    """
    pair = isinstance(problem, WaveEquation)
    n = problem.n
    size = "n" if n is None else n
    want = f"a pair of arrays ({size}, ...)" if pair else f"an array ({size}, ...)"
    if isinstance(u0, list) or u0 is None:
        raise TypeError(f"u0 is a {type(u0).__name__}, expected {want}")
    if pair and not (isinstance(u0, tuple) and len(u0) == 2):
        raise TypeError(f"u0 is a {type(u0).__name__}, a wave needs {want}: values and velocities")
    if n is not None and not pair and not hasattr(u0, "shape"):
        raise TypeError(f"u0 is a {type(u0).__name__}, expected {want}")
    u0 = only_on(problem.active, jax.tree.map(lambda leaf: as_float(leaf, "u0"), u0))
    leaves = jax.tree.leaves(u0)
    if not leaves:
        raise TypeError(f"u0 holds no arrays, expected {want}")
    for leaf in leaves:
        if leaf.ndim == 0 or leaf.size == 0:
            raise ValueError(f"u0 has shape {leaf.shape}, expected {want}")
        if n is not None and (leaf.shape[0] != n or leaf.ndim > 2):
            raise ValueError(f"u0 has shape {leaf.shape}, expected ({n},) or ({n}, c)")
        check(leaf, not_finite, "the state at point {i} is not finite: {v}")
    if pair and u0[0].shape != u0[1].shape:
        shapes = f"{u0[0].shape} and {u0[1].shape}"
        raise ValueError(f"u0 has shapes {shapes}, expected values and velocities of one shape")
    if len({leaf.dtype for leaf in leaves}) > 1:
        raise TypeError(f"u0 has entries of types {[str(leaf.dtype) for leaf in leaves]}, not one")
    return u0


def checked_times(problem: AbstractEvolution, u0, t0, t1, dt0):
    """Times in the precision of the state.

    Raises:
        TypeError: not numbers.
        ValueError: not finite; a first step in the other direction; diffusion backwards.
    """
    dtype = dtype_of(u0)
    for name, value in (("t0", t0), ("t1", t1), ("dt0", dt0)):
        if value is not None or name != "dt0":
            real(value, name)
    apart = is_concrete(t0, t1) and t0 != t1
    # A conversion by NumPy is compiled by nobody.
    number = lambda t: jnp.asarray(np.asarray(t, dtype) if is_concrete(t) else t, dtype)
    t0, t1, dt0 = number(t0), number(t1), None if dt0 is None else number(dt0)
    if not is_concrete(t0, t1):
        return t0, t1, dt0
    start, end = float(t0), float(t1)
    if apart and start == end:
        raise ValueError(
            f"t0 and t1 are {start:g} both in {dtype.name}, the precision of the state: count from "
            "t0 = 0, or use float64"
        )
    if dt0 is not None and is_concrete(dt0) and 0 < abs(float(dt0)) < resolved(t0, t1):
        raise ValueError(
            f"dt0 = {float(dt0):g} is lost in times from {start:g} to {end:g}, which {dtype.name} "
            f"tells {resolved(t0, t1):.2g} apart: count from t0 = 0, or use float64"
        )
    if end < start and problem.diffusive:
        raise ValueError(
            f"t1 = {end:g} is before t0 = {start:g}: diffusion backwards in time has no solution"
        )
    if dt0 is not None and is_concrete(dt0) and not float(dt0) * np.sign(end - start) > 0:
        if start != end:
            raise ValueError(f"a step dt0 = {float(dt0)} does not lead from {start} to {end}")
        if not float(dt0) > 0:
            raise ValueError(f"dt0 = {float(dt0)}, expected above 0")
    return t0, t1, dt0


def checked_rate(rate: Callable) -> Callable:
    """A right-hand side whose results are looked at: they must be like the state.

    Raises:
        ValueError: another structure or shape.
        TypeError: another precision.
    """

    def checked(t, u, args):
        found = jax.tree.map(jnp.asarray, rate(t, u, args))
        have: Any = jax.tree.structure(found)
        want: Any = jax.tree.structure(u)
        if have != want:
            raise ValueError(f"the state u0 is a {want}, its rate a {have}")
        for y, k in zip(jax.tree.leaves(u), jax.tree.leaves(found)):
            if y.shape != k.shape:
                raise ValueError(f"the state u0 has shape {y.shape}, its rate {k.shape}")
            if y.dtype != k.dtype:
                raise TypeError(
                    f"the state u0 is {y.dtype}, its rate {k.dtype} by the operators and "
                    f"coefficients: bring them to one, as with u0.astype({k.dtype})"
                )
        return found

    return checked


def check_saves(saveat: dfx.SaveAt, t0, t1) -> dfx.SaveAt:
    """The same, its times in the precision of the run.

    Raises:
        ValueError: times out of order or outside of the run.
    """

    def checked(sub):
        if not isinstance(sub, dfx.SubSaveAt) or sub.ts is None:
            return sub
        ts = as_float(sub.ts, "saveat.ts").astype(t0.dtype)
        if is_concrete(ts, t0, t1):
            values, start, end = np.asarray(ts), float(t0), float(t1)
            low, high = min(start, end), max(start, end)
            out = ~((values >= low) & (values <= high))
            raise_at(
                out,
                f"saveat.ts is {{v}} at entry {{i}}, expected within {low:g} and {high:g}",
                values,
            )
            # (diffrax takes times in the order of the integration.)
            falls = np.diff(values) * (1 if end >= start else -1) < 0
            raise_at(falls, "saveat.ts turns back after entry {i} = {v}, expected in order", values)
        return eqx.tree_at(lambda s: s.ts, sub, ts)

    is_sub = lambda x: isinstance(x, dfx.SubSaveAt)
    subs = jax.tree.map(checked, saveat.subs, is_leaf=is_sub)
    return eqx.tree_at(lambda s: s.subs, saveat, subs, is_leaf=lambda x: x is None)


def check_coefficients(problem: AbstractEvolution, t0, t1) -> None:
    """Look at what could not be seen when the problem was made.

    Raises:
        ValueError: a diffusivity that is negative at the start or at the end; a border about which
            nothing is said.
    """
    for operator in problem.operators:
        check_border(operator, problem.closure)
    if is_concrete(t0, t1):
        problem.check(t0)
        problem.check(t1)


def check_linear(problem: AbstractEvolution, t0, u0) -> None:
    """Refuse a stiff part that is not linear, of problems of users' own: no step would be short
    enough for solvers that take it for one.

    Raises:
        ValueError: it makes something of nothing.
    """
    ours = type(problem).linear.__module__.partition(".")[0] == __name__.partition(".")[0]
    if ours or not is_concrete(problem, t0, u0):
        return
    text = (
        f"linear of {type(problem).__name__} is not linear in the state: where that is zero it "
        "gives {v} at point {i}, in place of 0. What does not depend on the state belongs to `rest`"
    )
    some = lambda x: (x != 0).reshape(len(x), -1).any(axis=1)
    for leaf in jax.tree.leaves(_of_nothing(problem, t0, u0)):
        check(leaf, some, text)


@eqx.filter_jit
def _of_nothing(problem: AbstractEvolution, t, u):
    now = problem.at(t, problem.closed(t, u))
    return now.implicit_rate(t, jax.tree.map(jnp.zeros_like, u), None)


def check_tolerances(controller: dfx.AbstractStepSizeController, dtype) -> None:
    """Refuse those that no step meets: it would be tried ever shorter, for ever."""
    if not isinstance(controller, dfx.AbstractAdaptiveStepSizeController):
        return
    numbers: dict[str, Any] = {name: getattr(controller, name, None) for name in ("rtol", "atol")}
    for name, value in numbers.items():
        if value is None or not is_concrete(value) or jnp.ndim(value):
            return
        real(value, f"controller.{name}", least=0)
    if not numbers["atol"] > 0:
        within_round_off(numbers["rtol"], dtype, "controller.rtol")


def check_adjoint(adjoint) -> None:
    """Refuse what solves backwards, or differentiates the state at rest alone."""
    if isinstance(adjoint, dfx.BacksolveAdjoint | dfx.ImplicitAdjoint):
        raise ValueError(
            f"adjoint={type(adjoint).__name__} does not differentiate what is saved here: "
            "RecursiveCheckpointAdjoint, DirectAdjoint and ForwardMode of diffrax do"
        )


def check_solver(solver: dfx.AbstractSolver, controller) -> None:
    """Refuse solvers of other equations, and a choice of steps by errors that are not estimated."""
    name = type(solver).__name__
    if isinstance(solver.term_structure, tuple):
        raise ValueError(
            f"solver={name} steps {len(solver.term_structure)} unknowns by turns, each by a "
            "right-hand side of its own: the state of a problem has one"
        )
    adaptive = isinstance(controller, dfx.AbstractAdaptiveStepSizeController)
    if adaptive and not isinstance(solver, dfx.AbstractAdaptiveSolver):
        raise ValueError(
            f"solver={name} estimates no error that would choose the steps: pass their length as "
            "dt0"
        )
