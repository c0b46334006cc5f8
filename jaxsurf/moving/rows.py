"""Points that come and go, in arrays of a fixed number of rows."""

from __future__ import annotations

import functools
import math
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Float, Int, PyTree

from ..borders.border import Border
from ..borders.order import find_border
from ..cloud import PointCloud
from ..compiling import on_device
from ..discretization import Discretization
from ..neighbors import Neighbors, changed, find_neighbors

# By how much the arrays grow when they are full, at least: all that has been compiled is lost.
_GROWTH = 1.5


class Rows(NamedTuple):
    """What each point has.

    Args:
        points, normals: `(n, d)`.
        fields: `(n, *c)`, any number of them.
        spacing: wanted there, `(n,)`.
        rank: 0 of points inside, 1 on the border, 2 at corners: which of two stays.
    """

    points: Float[Array, "n d"]
    normals: Float[Array, "n d"]
    fields: PyTree[Array]
    spacing: Float[Array, " n"]
    rank: Int[Array, " n"]

    @classmethod
    def of(cls, surface: Discretization, fields, spacing: Float[np.ndarray, " n"]) -> Rows:
        rank, border, cloud = np.zeros(surface.n, int), surface.border, surface.cloud
        if border is not None:
            points = np.asarray(border.points)
            corners = border.corners if cloud.dim == 3 else np.ones(len(points), bool)
            rank[points] = 1 + corners
        return cls(cloud.points, cloud.normals, fields, on_device(spacing), on_device(rank))


def exchanged(
    surface: Discretization,
    rows: Rows,
    leaving: Int[np.ndarray, " m"],
    coming: Rows,
    capacity: int | None,
) -> tuple[Discretization, Rows]:
    """The surface on other points, with its neighbours found anew, in longer arrays if need be."""
    on, count = np.array(surface.cloud.host_active), len(coming.points)
    on[leaving] = False
    on = np.append(on, np.zeros(_more_rows(on, count, capacity), bool))
    free = np.flatnonzero(~on)[:count]
    on[free] = True
    rows = jax.tree.map(functools.partial(_put, free, len(on)), rows, coming)
    held = surface.border is not None
    marked = on_device((np.asarray(rows.rank) > 0) & on) if held else None
    cloud = PointCloud(rows.points, rows.normals, active=on_device(on), boundary=marked)
    k = min(surface.method.neighbor_count(cloud.dim), int(on.sum()))
    neighbors = find_neighbors(cloud, k)
    neighbors = _widened(neighbors, surface.neighbors.k)
    border = find_border(cloud) if held else None
    return Discretization(cloud, neighbors, surface.method, border), rows


def compact(surface: Discretization, fields: PyTree[Array]) -> tuple[Discretization, PyTree[Array]]:
    """Without the rows that are switched off."""
    cloud, lists = surface.cloud, surface.neighbors
    on = np.flatnonzero(cloud.host_active)
    row = np.zeros(cloud.n, np.int32)
    row[on] = np.arange(len(on))
    kept = lambda u: on_device(np.asarray(u)[on])
    marked = None if cloud.boundary is None else kept(cloud.boundary)
    border = surface.border
    if border is not None:
        renamed = lambda names: on_device(row[np.asarray(names)])
        border = Border(renamed(border.points), renamed(border.rows), border.mask)
    cloud = PointCloud(kept(cloud.points), kept(cloud.normals), boundary=marked)
    left = lambda some: Neighbors(on_device(row[np.asarray(some.indices)[on]]), kept(some.mask))
    lists = changed(lists, left)
    fields = jax.tree.map(kept, fields)
    return Discretization(cloud, lists, surface.method, border), fields


def _more_rows(on: np.ndarray, added: int, capacity: int | None) -> int:
    """By how much arrays are to grow."""
    needed, rows = int(on.sum()) + added, len(on)
    if capacity is not None and needed > capacity:
        raise ValueError(f"the spacing wanted needs {needed} points, the capacity is {capacity}")
    if capacity is not None:
        return max(0, capacity - rows)
    return 0 if needed <= rows else max(needed, math.ceil(_GROWTH * rows)) - rows


def _widened(lists: Neighbors, k: int) -> Neighbors:
    """With as many slots."""
    more = ((0, 0), (0, max(0, k - lists.k)))
    indices = np.where(
        np.pad(lists.mask, more), np.pad(lists.indices, more), np.arange(lists.n)[:, None]
    )
    return Neighbors(on_device(indices.astype(np.int32)), on_device(np.pad(lists.mask, more)))


def _put(rows: np.ndarray, count: int, old: Array, new: Array) -> Array:
    """Some rows replaced, in an array that gets more rows like its first.

    In NumPy: how many come differs each time, and JAX would compile each time.
    """
    before = np.asarray(old)
    longer = np.broadcast_to(before[:1], (count - len(before), *before.shape[1:]))
    after = np.concatenate([before, longer])
    after[rows] = np.asarray(new)
    return on_device(after)
