r"""Long runs on the host: some steps, a file, some more steps, and on from the file later."""

from __future__ import annotations

import hashlib
import os
from pathlib import Path
from typing import Any, NamedTuple

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PyTree
from tqdm import tqdm

from .run import Run


class Checkpoint(eqx.Module):
    """Where and how often a run is written to disk.

    If the file is there, `js.integrate` goes on from it; it must be of the same run (problem,
    initial state, times, solver and tolerances, compared by value). The steps are the same as
    those of a run that was never interrupted, bit by bit.

    Args:
        path: of the file, a NumPy archive; replaced in one piece, so that a run that is killed
            while writing leaves the one before.
        every: number of steps between two files.

    Raises:
        ValueError: a number of steps below one.
    """

    path: str | Path = eqx.field(static=True)
    every: int = eqx.field(static=True, default=1000)

    def __check_init__(self):
        if self.every < 1:
            raise ValueError(f"every = {self.every}, at least one step is needed")


class _Progress(NamedTuple):
    """All that the next step depends on, and what was saved so far.

    Args:
        time, state: of the last accepted step.
        end: time at the end of the next step.
        solver, controller, jump: inner states of solver and controller.
        counts: accepted and refused steps, their sum.
        saved: outputs at the times asked for; zeros where not reached.
        reached: which of them are there.
    """

    time: Array
    state: PyTree[Array]
    end: Array
    solver: PyTree
    controller: PyTree
    jump: Array
    counts: np.ndarray
    saved: PyTree
    reached: np.ndarray


class _Resumed(dfx.AbstractStepSizeController):
    """A controller that starts in a given state, and whose state says where the next step ends."""

    controller: dfx.AbstractStepSizeController
    end: Array
    state: PyTree
    t1: Array

    def wrap(self, direction):
        return eqx.tree_at(lambda c: c.controller, self, self.controller.wrap(direction))

    def init(self, terms, t0, t1, y0, dt0, args, func, error_order):
        return self.end, (self.state, self.end)

    def adapt_step_size(self, t0, t1, y0, y1_candidate, args, y_error, error_order, state):
        keep, start, end, jump, inner, result = self.controller.adapt_step_size(
            t0, t1, y0, y1_candidate, args, y_error, error_order, state[0]
        )
        # What diffrax would do to a step that ends close to the last time, done before, so that
        # the state knows.
        margin = 256 * jnp.finfo(self.t1.dtype).eps * jnp.maximum(jnp.abs(t0), jnp.abs(self.t1))
        last = jnp.where(keep, self.t1, start + 0.5 * (self.t1 - start))
        end = jnp.where(end > self.t1 - margin, last, end)
        return keep, start, end, jump, (inner, end), result


def integrate_in_parts(
    run: Run, checkpoint: Checkpoint, saveat: dfx.SaveAt, event, max_steps: int, progress: bool
) -> dfx.Solution:
    """As `diffeqsolve`, with a file every so many steps."""
    sub = _single(saveat)
    if not run.concrete:
        raise ValueError("a checkpoint needs concrete arrays: it is written by the host")
    if not float(run.t1) > float(run.t0):
        raise ValueError(f"a checkpoint needs t1 > t0, not from {float(run.t0)} to {float(run.t1)}")
    path, key = Path(checkpoint.path), _digest(run)
    now = _begin(run, sub)
    if path.exists():
        now = _read(path, key, now)
    times = np.zeros(0) if sub.ts is None else np.asarray(sub.ts)
    result = dfx.RESULTS.max_steps_reached
    with _Bar(progress, float(run.t0), float(run.t1), float(now.time)) as bar:
        while float(now.time) < float(run.t1) and result == dfx.RESULTS.max_steps_reached:
            left = max_steps - int(now.counts[2])
            if left <= 0:
                break
            now, result = _part(run, now, sub, times, event, min(checkpoint.every, left))
            _write(path, key, now)
            bar(float(now.time))
    if float(now.time) >= float(run.t1):
        result = dfx.RESULTS.successful
    return _solution(run, sub, times, now, result, max_steps)


def _single(saveat: dfx.SaveAt) -> dfx.SubSaveAt:
    sub = saveat.subs
    stores = saveat.dense or saveat.solver_state or saveat.controller_state
    if not isinstance(sub, dfx.SubSaveAt) or sub.steps or stores:
        raise ValueError("with a checkpoint, save at t0, t1 and given times only")
    return sub


@eqx.filter_jit
def _started(run: Run):
    """End of the first step, states of controller and solver."""
    solver, terms = run.solver, run.terms
    order = solver.error_order(terms)
    end, state = run.controller.init(
        terms, run.t0, run.t1, run.u0, run.dt0, run.args, solver.func, order
    )
    end = jnp.minimum(end, run.t1)
    inner = solver.init(terms, run.t0, end, run.u0, run.args)
    return end, jax.tree.map(jnp.asarray, state), jax.tree.map(jnp.asarray, inner)


def _begin(run: Run, sub: dfx.SubSaveAt) -> _Progress:
    end, state, inner = _started(run)
    count = 0 if sub.ts is None else len(sub.ts)
    one = jax.eval_shape(lambda: sub.fn(run.t0, run.u0, run.args))
    saved = jax.tree.map(lambda y: np.zeros((count, *y.shape), y.dtype), one)
    return _Progress(
        run.t0, run.u0, end, inner, state, jnp.asarray(False), np.zeros(3, int), saved,
        np.zeros(count, bool),
    )  # fmt: skip


def _part(run: Run, now: _Progress, sub, times, event, steps: int):
    """At most so many steps more."""
    subs: list[dfx.SubSaveAt] = [dfx.SubSaveAt(t1=True)]
    if times.size:
        subs.append(dfx.SubSaveAt(ts=jnp.maximum(sub.ts, now.time), fn=sub.fn))
    solution = dfx.diffeqsolve(
        run.terms,
        run.solver,
        now.time,
        run.t1,
        None,
        now.state,
        run.args,
        saveat=dfx.SaveAt(subs=subs, solver_state=True, controller_state=True, made_jump=True),
        stepsize_controller=_Resumed(run.controller, now.end, now.controller, run.t1),
        adjoint=run.adjoint,
        event=event,
        max_steps=steps,
        throw=False,
        solver_state=now.solver,
        made_jump=now.jump,
    )
    assert solution.ts is not None and solution.ys is not None
    time, state = solution.ts[0][-1], jax.tree.map(lambda y: y[-1], solution.ys[0])
    saved, reached = now.saved, now.reached
    if times.size:
        new = (times <= float(time)) & ~reached
        for into, found in zip(jax.tree.leaves(saved), jax.tree.leaves(solution.ys[1])):
            into[new] = np.asarray(found)[new]
        reached = reached | new
    kinds = ("num_accepted_steps", "num_rejected_steps", "num_steps")
    counts = now.counts + np.array([int(solution.stats[kind]) for kind in kinds])
    controller, end = solution.controller_state
    jump = jnp.asarray(solution.made_jump)
    now = _Progress(
        time, state, end, solution.solver_state, controller, jump, counts, saved, reached
    )
    return now, solution.result


def _solution(run: Run, sub, times, now: _Progress, result, max_steps: int) -> dfx.Solution:
    """What one call of `diffeqsolve` would have returned, and the last state after it."""
    at = lambda t, y: jax.tree.map(lambda a: jnp.asarray(a)[None], sub.fn(t, y, run.args))
    parts = [(run.t0[None], at(run.t0, run.u0))] if sub.t0 else []
    if times.size:
        ts = jnp.where(jnp.asarray(now.reached), jnp.asarray(times, run.t1.dtype), jnp.inf)
        parts.append((ts, jax.tree.map(jnp.asarray, now.saved)))
    if sub.t1:
        parts.append((now.time[None], at(now.time, now.state)))
    ts = jnp.concatenate([t for t, _ in parts])
    ys = jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *[y for _, y in parts])
    last = jax.tree.map(lambda y: y[None], run.problem.closed(now.time, now.state))
    kinds = ("num_accepted_steps", "num_rejected_steps", "num_steps")
    stats: dict[str, Any] = {kind: jnp.asarray(c) for kind, c in zip(kinds, now.counts)}
    return dfx.Solution(
        t0=run.t0, t1=run.t1, ts=(ts, now.time[None]), ys=(ys, last), interpolation=None,
        stats=stats | {"max_steps": max_steps}, result=result, solver_state=None,
        controller_state=None, made_jump=None, event_mask=None,
    )  # fmt: skip


# --- the file ------------------------------------------------------------------------------


def _digest(run: Run) -> str:
    """Of all values that the steps depend on."""
    content = hashlib.sha256()
    parts = (run.problem, run.u0, run.t0, run.t1, run.dt0, run.args, run.solver, run.controller)
    for path, leaf in jax.tree_util.tree_flatten_with_path(parts)[0]:
        if eqx.is_array_like(leaf):
            content.update(jax.tree_util.keystr(path).encode())
            content.update(np.ascontiguousarray(leaf).tobytes())
    kinds = [type(part).__name__ for part in (run.problem, run.solver, run.controller)]
    return content.hexdigest() + " " + " ".join(kinds)


def _write(path: Path, key: str, now: _Progress) -> None:
    leaves = jax.tree.leaves(now)
    data = {f"leaf_{i:04d}": np.asarray(leaf) for i, leaf in enumerate(leaves)}
    partial = path.with_name(path.name + ".part")
    with open(partial, "wb") as file:
        np.savez(file, allow_pickle=False, key=np.array(key), **data)
        file.flush()
        os.fsync(file.fileno())
    os.replace(partial, path)


def _read(path: Path, key: str, like: _Progress) -> _Progress:
    leaves, structure = jax.tree.flatten(like)
    try:
        with np.load(path, allow_pickle=False) as archive:
            found = str(archive["key"])
            new = [archive[f"leaf_{i:04d}"] for i in range(len(leaves))] if found == key else []
    except (OSError, EOFError, KeyError, ValueError) as error:
        raise ValueError(f"{path} does not hold a checkpoint: {error}") from error
    if found != key:
        raise ValueError(
            f"{path} is a checkpoint of another run: problem, initial state, times, solver or "
            "tolerances differ. Remove it or choose another path"
        )
    back = [
        np.asarray(a) if isinstance(b, np.ndarray) else jnp.asarray(a) for a, b in zip(new, leaves)
    ]
    return jax.tree.unflatten(structure, back)


class _Bar:
    """Progress in time, part by part."""

    def __init__(self, shown: bool, t0: float, t1: float, now: float):
        self.meter = tqdm(total=100, unit="%", disable=not shown)
        self.share = lambda t: 100 * (t - t0) / (t1 - t0)
        self(now)

    def __call__(self, t: float) -> None:
        self.meter.update(round(self.share(t), 2) - self.meter.n)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.meter.close()
