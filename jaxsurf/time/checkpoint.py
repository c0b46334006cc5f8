r"""Long runs in parts: a file after each, and on from the file later."""

from __future__ import annotations

import functools
import hashlib
import os
import re
import zipfile
from collections.abc import Callable
from pathlib import Path
from types import CodeType
from typing import Any, NamedTuple

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree
from tqdm import tqdm

from ..arguments import real
from .run import Plan, Run

_COUNTS = ("num_accepted_steps", "num_rejected_steps", "num_steps")


class Checkpoint(eqx.Module):
    """Where and how often a run in time is written to disk.

    The run is done in parts of equal length in time, each from nothing but the state at its
    start. So a run that goes on from its file ends, bit by bit, in what the same run without
    interruption ends in. If the file is there, `js.integrate` goes on from it; it must be of the
    same run: problem, initial state, times and settings are compared by value, functions by what
    they compute.

    Args:
        path: of the file, a NumPy archive; replaced in one piece, so that a run that is killed
            while writing leaves the one before.
        every: time between two files, in the units of t. Every part picks its first step anew
            and ends with a step of its own, so that many short parts cost steps. Of an
            optimisation, the number of its steps, which cost the same.

    Raises:
        TypeError: a path or a time that is none.
        ValueError: a time that is not positive, a folder that is not there.

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

    def __init__(self, path: str | Path, every: float):
        if not isinstance(path, str | os.PathLike):
            raise TypeError(f"path is a {type(path).__name__}, expected the path of a file")
        if not Path(path).absolute().parent.is_dir():
            raise ValueError(
                f"path is {str(path)!r}: there is no folder {str(Path(path).parent)!r}"
            )
        self.path, self.every = Path(path), float(real(every, "every", above=0))


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
    checkpoint: Checkpoint, plan: Plan, solve: Callable[[Run], dfx.Solution], progress: bool
) -> tuple[dfx.Solution, float]:
    """One part after another, and when the last ended.

    Args:
        checkpoint: where and how often.
        plan: of the whole run.
        solve: integrates one part.
        progress: show a bar.
    """
    run = plan.run
    sub = _single(run.saveat)
    if not plan.concrete:
        raise ValueError("a checkpoint needs concrete arrays: it is written by the host")
    t0, t1 = float(run.t0), float(run.t1)
    if not t1 > t0:
        raise ValueError(f"a checkpoint needs t1 > t0, not from t0 = {t0} to t1 = {t1}")
    # A remainder that is nothing but round-off is no part of its own.
    count = max(1, int(np.ceil((t1 - t0) / checkpoint.every * (1 - 1e-12))))
    ends = np.append(t0 + checkpoint.every * np.arange(count), t1)
    between = np.zeros(0) if sub.ts is None else np.asarray(sub.ts)
    times = np.concatenate([[t0], between, [t1]])
    asked = np.array([sub.t0, *[True] * len(between), sub.t1])

    path = Path(checkpoint.path)
    key = digest((checkpoint.every, run))
    one = jax.eval_shape(lambda: sub.fn(run.t0, run.u0, run.args))
    saved = jax.tree.map(lambda y: np.zeros((len(times), *y.shape), y.dtype), one)
    now = _Progress(np.array(0), jax.tree.map(np.asarray, run.u0), saved, np.zeros(3, int))
    if path.exists():
        now = read_back(path, key, now)
    reached = times <= ends[int(now.part)]
    last_state = run.saveat.subs[1]
    solution, last = None, float(ends[int(now.part)])
    bar = tqdm(total=count, initial=int(now.part), disable=not progress, unit="part")
    with bar:
        for part in range(int(now.part), count):
            start, end = float(ends[part]), float(ends[part + 1])
            within = jnp.clip(jnp.asarray(times, run.t0.dtype), start, end)
            subs = [dfx.SubSaveAt(ts=within, fn=sub.fn), last_state]
            saveat = eqx.tree_at(lambda s: s.subs, run.saveat, (subs, last_state))
            solution = solve(run.over(now.state, start, end, saveat))
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
            written(path, key, now)
            bar.update()
    return _joined(solution, now, times, asked, reached, last, sub, run), last


def _single(saveat: dfx.SaveAt) -> dfx.SubSaveAt:
    sub = saveat.subs[0]
    stores = saveat.dense or saveat.solver_state or saveat.controller_state
    if not isinstance(sub, dfx.SubSaveAt) or sub.steps or stores:
        raise ValueError("with a checkpoint, save at t0, t1 and given times only")
    return sub


def _joined(
    solution, now: _Progress, times, asked, reached, last: float, sub, run: Run
) -> dfx.Solution:
    """What one call without parts would have returned."""
    ts = np.where(reached, times, np.inf)
    for into in jax.tree.leaves(now.saved):
        if np.issubdtype(into.dtype, np.inexact):
            into[~reached] = np.inf
    if sub.t1:  # the end may have come early
        ts[-1] = last
        final = sub.fn(last, jax.tree.map(jnp.asarray, now.state), run.args)
        for into, found in zip(jax.tree.leaves(now.saved), jax.tree.leaves(final)):
            into[-1] = np.asarray(found)
    stats = {name: jnp.asarray(value) for name, value in zip(_COUNTS, now.counts)}
    result: Any = dfx.RESULTS.successful
    if solution is not None:
        stats, result = solution.stats | stats, solution.result
    return dfx.Solution(
        t0=run.t0, t1=run.t1, ts=jnp.asarray(ts[asked], run.t0.dtype),
        ys=jax.tree.map(lambda y: jnp.asarray(y[asked]), now.saved), interpolation=None,
        stats=stats, result=result, solver_state=None, controller_state=None, made_jump=None,
        event_mask=None if solution is None else solution.event_mask,
    )  # fmt: skip


# --- the file ------------------------------------------------------------------------------


def digest(content: PyTree, within: tuple = ()) -> str:
    """Of all numbers, of all that is static, and of what functions compute.

    Args:
        within: functions whose surroundings this is, which may hold them again.
    """
    found = hashlib.sha256()
    leaves, structure = jax.tree.flatten(content)
    for leaf in leaves:
        if eqx.is_array_like(leaf):
            leaf = np.asarray(leaf)
            found.update(f"{leaf.dtype}{leaf.shape}".encode() + leaf.tobytes())
        else:
            found.update(_described(leaf, within).encode())
    found.update(_without_addresses(str(structure)).encode())
    return found.hexdigest()


def _described(value: Any, within: tuple) -> str:
    """Something that is no array, with the code and the surroundings of what can be called.

    Of what functions read of their module numbers are among these. Where all of it counts, the
    caller adds the program that they are (`functions.canonical`).
    """
    inside = None if any(value is other for other in within) else _inside(value)
    if inside is None:
        return _without_addresses(repr(value))
    text, parts = inside
    return _without_addresses(f"{text}{digest(parts, (*within, value))}")


def _inside(value: Any) -> tuple[str, PyTree] | None:
    """What something that can be called is made of, as text and as more of the kind."""
    if isinstance(value, functools.partial):
        return "partial", (value.func, value.args, value.keywords)
    code, kind = getattr(value, "__code__", None), type(value)
    if code is not None:
        cells = [cell.cell_contents for cell in value.__closure__ or ()]
        names = getattr(value, "__globals__", {})
        read = {name: names[name] for name in code.co_names if eqx.is_array_like(names.get(name))}
        parts = cells, value.__defaults__, getattr(value, "__self__", None), read
        return f"{value.__qualname__}{_told(code)}", parts
    if callable(getattr(value, "__wrapped__", None)):  # by `jax.jit`, say
        return kind.__qualname__, value.__wrapped__
    if callable(value) and not isinstance(value, type) and hasattr(value, "__dict__"):
        return kind.__qualname__, (vars(value), kind.__call__)
    return None


def _told(code: CodeType) -> str:
    """What a function does, with the names that it uses and the functions within it."""
    constants = [_told(c) if isinstance(c, CodeType) else repr(c) for c in code.co_consts]
    return f"{code.co_code!r}{code.co_names}{constants}"


def _without_addresses(text: str) -> str:
    """They differ between processes."""
    return re.sub(r" at 0x[0-9a-f]+", "", text)


def written(path: Path, key: str, now: PyTree) -> None:
    """A file of the arrays of `now`, in one piece."""
    leaves = [np.asarray(leaf) for leaf in jax.tree.leaves(now)]
    data = {f"leaf_{i:04d}": leaf for i, leaf in enumerate(leaves)}
    partial = path.with_name(path.name + ".part")
    with open(partial, "wb") as file:
        seal = np.array(digest((key, leaves)))
        np.savez(file, key=np.array(key), seal=seal, **data)  # type: ignore[arg-type]
        file.flush()
        os.fsync(file.fileno())
    os.replace(partial, path)


def read_back(
    path: Path,
    key: str,
    like: Any,
    *,
    same_sizes: bool = True,
    run: str = "problem, initial state, times or settings",
) -> Any:
    """What was written: of the same run, with arrays as in `like`, or of other sizes.

    Args:
        run: what may differ in another.
    """
    expected, structure = jax.tree.flatten(like)
    try:
        with open(path, "rb") as file, np.load(file, allow_pickle=False) as archive:
            found, seal = str(archive["key"]), str(archive["seal"])
            leaves = [archive[name] for name in sorted(archive.files) if name.startswith("leaf_")]
    except Exception as error:  # a damaged archive raises anything
        why = error if zipfile.is_zipfile(path) else "it is no archive"
        raise ValueError(f"{path} does not hold a checkpoint, or is damaged: {why}") from error
    if seal != digest((found, leaves)):
        raise ValueError(f"{path} is damaged: its content does not have the digest {seal}")
    size = lambda leaf: np.shape(leaf) if same_sizes else np.ndim(leaf)
    shapes = [[(size(leaf), np.asarray(leaf).dtype) for leaf in x] for x in (leaves, expected)]
    if found != key or shapes[0] != shapes[1]:
        raise ValueError(
            f"{path} is a checkpoint of another run: {run} differ. Remove it or choose another path"
        )
    return jax.tree.unflatten(structure, leaves)
