"""A run on the host, in stretches of fixed neighbours and, if asked for, parts on disk."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float
from tqdm import tqdm

from ..arguments import is_array
from ..discretization import Discretization, discretize
from ..motion import unreached
from ..neighbors import Neighbors
from ..normals import refit_normals
from ..renew import NeighborSearch
from ..time.checkpoint import Checkpoint, digest, read_back, written
from ..time.integrate import integrate
from ..time.run import planned
from .problem import Moving, joined, parted

# Lists are found anew once points outside may come as near as this share of the farthest in them.
_WORN = 0.75
# Of the way that is left; a surface that cannot be followed this far is an error.
_LEAST = 1e-6


class _Place(NamedTuple):
    """What a run goes on from, or what is saved of it.

    Args:
        surface: to go on, where its neighbours were found.
        state: points and fields.
    """

    surface: Discretization
    state: tuple


class _Progress(NamedTuple):
    """What is on disk.

    Args:
        part: number of parts done.
        place: at the end of the last.
        saved: at the times asked for; those not reached hold anything of these shapes.
        counts: steps accepted and refused, and how often neighbours were found anew.
    """

    part: Any
    place: _Place
    saved: list[_Place]
    counts: Any


def followed(
    moving: Moving, state, t0, times, options, checkpoint: Checkpoint | None, progress: bool
) -> tuple:
    """Times, surfaces, fields and statistics of an `Evolution`."""
    times, start = np.asarray(times, state[0].dtype), np.asarray(t0, state[0].dtype)
    saved: list = [None] * len(times)
    now = _Progress(np.array(0), _place(moving, state), saved, np.zeros(3, int))
    ends, file, why = times[-1:], None, ""
    if checkpoint is not None:
        ends = _ends(start, times[-1], checkpoint.every)
        file = _File(checkpoint, _digest(moving, state, start, times, options, checkpoint))
        now, why = file.read(now._replace(saved=[_saved(moving, state, start)] * len(times)))
    saved, search = list(now.saved), None
    bar = tqdm(total=float(times[-1] - start), disable=not progress, unit="t")
    with bar:
        for part in range(int(now.part), len(ends)):
            t, end = ends[part - 1] if part else start, ends[part]
            state, counts = now.place.state, np.asarray(now.counts)
            if file is not None:  # from nothing but what is on disk
                moving, search = Moving.of(now.place.surface, moving.motion, moving.on), None
            here = (part == 0) & (times == t) | (times > t) & (times <= end)
            for i in [*np.flatnonzero(here), None]:
                target = end if i is None else times[i]
                moving, state, search, new, told = _to(moving, state, t, target, search, options)
                bar.update(float(target - t))
                t, counts, why = target, counts + new, told or why
                if i is not None:
                    saved[i] = _saved(moving, state, target)
            now = _Progress(np.array(part + 1), _place(moving, state), saved, counts)
            if file is not None:
                file.write(now)
    steps, refused, renewals = map(int, now.counts)
    stats = {"steps": steps, "refused": refused, "renewals": renewals, "solver": why}
    fields = [parted(place.state)[1] for place in saved]
    return jnp.asarray(times), [place.surface for place in saved], fields, stats


def _place(moving: Moving, state) -> _Place:
    surface = moving.surface
    plain = Discretization(surface.cloud, surface.neighbors, surface.method, surface.border)
    return _Place(plain, state)


def _saved(moving: Moving, state, t) -> _Place:
    surface = moving.surface_at(state[0])
    # What was wrong with it would have been an error.
    surface = eqx.tree_at(lambda s: s.found, surface, None, is_leaf=lambda x: x is None)
    return _Place(surface, joined(state[0], moving.fields(t, state)))


class _File(NamedTuple):
    """A run on disk: its arrays, after each part."""

    checkpoint: Checkpoint
    key: str

    def read(self, now: _Progress) -> tuple[_Progress, str]:
        """What is there, and that it is; else what is given."""
        path = Path(self.checkpoint.path)
        if not path.exists():
            return now, ""
        arrays, others = eqx.partition(now, is_array)
        arrays = jax.tree.map(jnp.asarray, read_back(path, self.key, arrays))
        return eqx.combine(arrays, others), "read from disk"

    def write(self, now: _Progress) -> None:
        written(Path(self.checkpoint.path), self.key, eqx.filter(now, is_array))


def _ends(start, end, every: float) -> np.ndarray:
    """Of the parts; a remainder that is nothing but round-off is none of its own."""
    count = max(1, int(np.ceil(float(end - start) / every * (1 - 1e-12))))
    return np.append(start + every * np.arange(1, count), end).astype(end.dtype)


def _digest(moving: Moving, state, start, times, options, checkpoint: Checkpoint) -> str:
    """Of all that a run hangs on; functions by what they compute."""
    unset = dict.fromkeys(("controller", "saveat", "event", "adjoint", "max_steps"))
    plan = planned(moving, state, start, times[-1], **options, **unset, progress=False, throw=True)
    return digest((checkpoint.every, times, moving.surface.neighbors, plan.run))


def _to(moving: Moving, state, t, target, search: NeighborSearch | None, options):
    """At a later time, with neighbours found anew on the way."""
    counts, why, end = np.zeros(3, int), "", target
    while float(t) < float(target):
        points, neighbors = moving.surface.cloud.points, moving.surface.neighbors
        event = dfx.Event(_Worn(points, neighbors))
        solution = integrate(moving, state, t0=t, t1=end, event=event, **options)
        assert solution.ts is not None and solution.ys is not None
        reached, new = solution.ts[-1], jax.tree.map(lambda y: y[-1], solution.ys)
        why, worn = solution.stats["solver"], solution.result == dfx.RESULTS.event_occurred
        accepted, refused = (
            int(solution.stats[f"num_{kind}_steps"]) for kind in ("accepted", "rejected")
        )
        if jnp.any(unreached(points, new[0], neighbors)) and reached - t > _LEAST * (target - t):
            # The last step went farther than the neighbours serve: half of the way first.
            end = t + (reached - t) / 2
            counts += [0, accepted + refused, 0]
            continue
        t, state, end = reached, new, target
        if worn:
            surface, search = _renewed(moving, state[0], search)
            moving = Moving.of(surface, moving.motion, moving.on)
        counts += [accepted, refused, int(worn)]
    return moving, state, search, counts, why


class _Worn(eqx.Module):
    """True once lists do not serve well, from where the points were when they were found."""

    points: Float[Array, "n d"]
    neighbors: Neighbors

    def __call__(self, t, y, args, **_) -> Bool[Array, ""]:
        return jnp.any(unreached(self.points, y[0], self.neighbors, _WORN))


def _renewed(
    moving: Moving, points, search: NeighborSearch | None
) -> tuple[Discretization, NeighborSearch]:
    """The surface at these points with normals and neighbours found anew, and room for the next."""
    surface, moved = moving.surface, moving.surface_at(points)
    normals, degree = moved.cloud.normals, surface.method.polynomial_degree
    normals = refit_normals(points, normals, surface.neighbors, degree=degree)
    search = surface.search() if search is None else search
    try:
        return surface.moved(points, normals, search=search), search
    except ValueError:  # there is no room, or an error that will be raised again
        cloud = eqx.tree_at(lambda c: c.normals, moved.cloud, normals)
        surface = discretize(cloud, method=surface.method)
        return surface, surface.search()
