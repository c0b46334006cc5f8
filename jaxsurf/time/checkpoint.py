r"""Long runs in parts: a file after each, and on from the file later."""

from __future__ import annotations

import hashlib
import os
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PyTree
from tqdm import tqdm

from ..arguments import is_concrete

_COUNTS = ("num_accepted_steps", "num_rejected_steps", "num_steps")


class Checkpoint(eqx.Module):
    """Where and how often a run in time is written to disk.

    The run is done in parts of equal length in time, each from nothing but the state at its
    start. So a run that goes on from its file ends, bit by bit, in what the same run without
    interruption ends in. If the file is there, `js.integrate` goes on from it; it must be of the
    same run (problem, initial state, times and settings, compared by value).

    Args:
        path: of the file, a NumPy archive; replaced in one piece, so that a run that is killed
            while writing leaves the one before.
        every: time between two files, in the units of t. Every part picks its first step anew
            and ends with a step of its own, so that many short parts cost steps.

    Raises:
        ValueError: a time that is not positive.

    Example:
        >>> cloud = js.sphere(300)
        >>> problem = js.AdvectionDiffusionReaction(js.laplace_beltrami(cloud))
        >>> parts = js.Checkpoint("run.npz", every=0.05)
        >>> run = lambda: js.integrate(problem, cloud.points[:, 2], t1=0.1, checkpoint=parts).ys
        >>> first, again = run(), run()
        >>> bool(jnp.all(first == again))  # the second call reads the end of the first
        True
    """

    path: str | Path = eqx.field(static=True)
    every: float = eqx.field(static=True)

    def __check_init__(self):
        if not self.every > 0:
            raise ValueError(f"every = {self.every}, a positive time is needed")


class _Progress(NamedTuple):
    """What is on disk.

    Args:
        part: number of parts done.
        state: at the end of the last.
        saved: outputs at the times asked for; zeros where not reached.
        counts: accepted and refused steps, their sum.
    """

    part: Any
    state: PyTree
    saved: PyTree
    counts: Any


def integrate_in_parts(
    checkpoint: Checkpoint,
    solve: Callable[[PyTree[Array], float, float, dfx.SaveAt], dfx.Solution],
    u0: PyTree[Array],
    t0: Any,
    t1: Any,
    saveat: dfx.SaveAt,
    args: Any,
    settings: PyTree,
    progress: bool,
) -> dfx.Solution:
    """One part after another, each by `solve(state, start, end, saveat)`.

    Args:
        checkpoint: where and how often.
        solve: integrates one part; its last save is the final state.
        u0, t0, t1: initial state and times.
        saveat: what to save: at t0, t1 and given times.
        args: handed to what saves.
        settings: everything else that the steps depend on.
        progress: show a bar.
    """
    sub = _single(saveat)
    if not is_concrete(*jax.tree.leaves((u0, t0, t1, args, settings))):
        raise ValueError("a checkpoint needs concrete arrays: it is written by the host")
    t0, t1 = float(t0), float(t1)
    if not t1 > t0:
        raise ValueError(f"a checkpoint needs t1 > t0, not from {t0} to {t1}")
    # A remainder that is nothing but round-off is no part of its own.
    count = max(1, int(np.ceil((t1 - t0) / checkpoint.every * (1 - 1e-12))))
    ends = np.append(t0 + checkpoint.every * np.arange(count), t1)
    between = np.zeros(0) if sub.ts is None else np.asarray(sub.ts)
    times = np.concatenate([[t0], between, [t1]])
    asked = np.array([sub.t0, *[True] * len(between), sub.t1])

    path = Path(checkpoint.path)
    key = _digest((checkpoint.every, u0, t0, t1, sub.ts, args, settings))
    one = jax.eval_shape(lambda: sub.fn(t0, u0, args))
    saved = jax.tree.map(lambda y: np.zeros((len(times), *y.shape), y.dtype), one)
    now = _Progress(np.array(0), jax.tree.map(np.asarray, u0), saved, np.zeros(3, int))
    if path.exists():
        now = _read(path, key, now)
    reached = times <= ends[int(now.part)]
    solution, last = None, float(ends[int(now.part)])
    bar = tqdm(total=count, initial=int(now.part), disable=not progress, unit="part")
    with bar:
        for part in range(int(now.part), count):
            start, end = float(ends[part]), float(ends[part + 1])
            subs = [
                dfx.SubSaveAt(ts=jnp.clip(jnp.asarray(times), start, end), fn=sub.fn),
                dfx.SubSaveAt(t1=True),
            ]
            solution = solve(now.state, start, end, dfx.SaveAt(subs=subs))
            assert solution.ts is not None and solution.ys is not None
            last = float(solution.ts[1][-1])
            new = (times <= last) & ((times > start) | ((part == 0) & (times == start)))
            for into, found in zip(jax.tree.leaves(now.saved), jax.tree.leaves(solution.ys[0])):
                into[new] = np.asarray(found)[new]
            reached = reached | new
            counts = now.counts + np.array([int(solution.stats[name]) for name in _COUNTS])
            state = jax.tree.map(lambda y: np.asarray(y[-1]), solution.ys[1])
            now = _Progress(np.array(part + 1), state, now.saved, counts)
            if solution.result != dfx.RESULTS.successful:
                break
            _write(path, key, now)
            bar.update()
    return _joined(solution, now, times, asked, reached, last, sub, args)


def _single(saveat: dfx.SaveAt) -> dfx.SubSaveAt:
    sub = saveat.subs
    stores = saveat.dense or saveat.solver_state or saveat.controller_state
    if not isinstance(sub, dfx.SubSaveAt) or sub.steps or stores:
        raise ValueError("with a checkpoint, save at t0, t1 and given times only")
    return sub


def _joined(
    solution, now: _Progress, times, asked, reached, last: float, sub, args
) -> dfx.Solution:
    """What one call without parts would have returned."""
    ts = np.where(reached, times, np.inf)
    if sub.t1:  # the end may have come early
        ts[-1] = last
        final = sub.fn(last, jax.tree.map(jnp.asarray, now.state), args)
        for into, found in zip(jax.tree.leaves(now.saved), jax.tree.leaves(final)):
            into[-1] = np.asarray(found)
    stats = {name: jnp.asarray(value) for name, value in zip(_COUNTS, now.counts)}
    result: Any = dfx.RESULTS.successful
    if solution is not None:
        stats, result = solution.stats | stats, solution.result
    return dfx.Solution(
        t0=jnp.asarray(times[0]), t1=jnp.asarray(times[-1]), ts=jnp.asarray(ts[asked]),
        ys=jax.tree.map(lambda y: jnp.asarray(y[asked]), now.saved), interpolation=None,
        stats=stats, result=result, solver_state=None, controller_state=None, made_jump=None,
        event_mask=None if solution is None else solution.event_mask,
    )  # fmt: skip


# --- the file ------------------------------------------------------------------------------


def _digest(content: PyTree) -> str:
    """Of all values and all that is static; functions count by their being there."""
    found = hashlib.sha256()
    leaves, structure = jax.tree.flatten(eqx.filter(content, eqx.is_array_like))
    for leaf in leaves:
        found.update(np.ascontiguousarray(leaf).tobytes())
    # Addresses differ between processes.
    found.update(re.sub(r" at 0x[0-9a-f]+", "", str(structure)).encode())
    return found.hexdigest()


def _write(path: Path, key: str, now: _Progress) -> None:
    data = {f"leaf_{i:04d}": np.asarray(leaf) for i, leaf in enumerate(jax.tree.leaves(now))}
    partial = path.with_name(path.name + ".part")
    with open(partial, "wb") as file:
        np.savez(file, allow_pickle=False, key=np.array(key), **data)
        file.flush()
        os.fsync(file.fileno())
    os.replace(partial, path)


def _read(path: Path, key: str, like: _Progress) -> _Progress:
    count, structure = len(jax.tree.leaves(like)), jax.tree.structure(like)
    try:
        with np.load(path, allow_pickle=False) as archive:
            found = str(archive["key"])
            leaves = [archive[f"leaf_{i:04d}"] for i in range(count)] if found == key else []
    except (OSError, EOFError, KeyError, ValueError) as error:
        raise ValueError(f"{path} does not hold a checkpoint: {error}") from error
    if found != key:
        raise ValueError(
            f"{path} is a checkpoint of another run: problem, initial state, times or settings "
            "differ. Remove it or choose another path"
        )
    return jax.tree.unflatten(structure, leaves)
