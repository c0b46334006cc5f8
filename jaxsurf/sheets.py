"""The nearest points of each on its own sheet of a surface, by a k-d tree on the host."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

from .checks import DETOUR, LINK, RINGS, query, ring_size, two_sheets


def distance_key(squared: np.ndarray) -> np.ndarray:
    """Integer that grows with a squared distance and ignores its last bits.

    Distances that are equal up to round-off, as on lattices, get equal keys on every machine,
    so that the tie is broken by the index, not by the rounding.
    """
    if squared.dtype == np.float32:
        return (squared.view(np.int32) + (1 << 7)) >> 8
    return (squared.astype(np.float64).view(np.int64) + (1 << 21)) >> 22


def cosine_slack(dtype) -> float:
    """Round-off allowed in the cosine between two normals."""
    return 64 * float(jnp.finfo(dtype).eps)


def nearest(points, normals, tree, k: int, min_cosine: float, *, rows=None):
    """The k nearest acceptable points of each (of `rows`), from as many candidates as it takes."""
    n = len(points)
    rows = np.arange(n) if rows is None else rows
    slots = np.tile(rows[:, None], k)
    mask = np.zeros(slots.shape, bool)
    todo = np.arange(len(rows))
    count = min(n, k + 4)
    most = min(n, max(8 * k, 64))
    while todo.size:
        centre = rows[todo]
        found = query(tree, points[centre], count)
        key, accepted = judge(points, normals, centre[:, None], found, min_cosine)
        # Beyond the farthest candidate there may be others at the same distance.
        sure = np.sum(accepted & (key < key.max(axis=1, keepdims=True)), axis=1) >= k
        done = sure | (count == most)
        order = np.lexsort((found, np.where(accepted, key, np.iinfo(key.dtype).max)), axis=1)
        order = order[done, :k]
        mask[todo[done]] = np.take_along_axis(accepted[done], order, axis=1)
        slots[todo[done]] = np.take_along_axis(found[done], order, axis=1)
        todo = todo[~done]
        count = min(most, 2 * count)
    return np.where(mask, slots, rows[:, None]), mask


def nearest_on_sheet(points, normals, tree, k: int, min_cosine: float, *, rows=None):
    """`nearest`, without what lies across a gap on another sheet of the same orientation."""
    slots, mask = nearest(points, normals, tree, k, min_cosine, rows=rows)
    above = two_sheets(points, normals, slots, np.arange(len(points)) if rows is None else rows)
    if above.any():
        slots, mask = without_islands(
            points, normals, tree, slots, mask, above, min_cosine, rows=rows
        )
    return slots, mask


def without_islands(
    points, normals, tree, slots, mask, above, min_cosine: float, *, rows=None, refill=True
):
    """Take out what lies across a gap, on another sheet of the same orientation.

    Only rows that hold a point `above` their own are changed. They keep what a short way over
    the surface leads to, and are refilled from twice as many candidates.
    """
    rows = np.arange(len(points)) if rows is None else rows
    held = np.flatnonzero(above.any(axis=1))
    slots, mask = slots.copy(), mask.copy()
    wide, admitted, k = slots[held], mask[held], slots.shape[1]
    if refill:
        most = min(len(points), 2 * k)
        wide, admitted = nearest(points, normals, tree, most, min_cosine, rows=rows[held])
    members = np.unique(wide)
    links = _links(points, normals, tree, members, min_cosine)
    for i, candidates, good in zip(held, wide, admitted, strict=True):
        found = candidates[good]
        place = np.searchsorted(members, found)
        way = dijkstra(links[place][:, place], directed=False, indices=0)
        chord = np.linalg.norm(points[found] - points[rows[i]], axis=1)
        kept = found[way <= DETOUR * chord][:k]
        slots[i], mask[i] = rows[i], np.arange(k) < kept.size
        slots[i, : kept.size] = kept
    return slots, mask


def _links(points, normals, tree, members, min_cosine: float) -> csr_array:
    """Lengths of the steps over the surface between members that are close to each other."""
    count = min(len(points), 2 * RINGS)
    near, used = nearest(points, normals, tree, count, min_cosine, rows=members)
    d = points[near] - points[members][:, None]
    length = np.linalg.norm(d, axis=2)
    # A chord of a smooth curve makes equal angles with the normals at its ends.
    both = normals[near] + normals[members][:, None]
    along = np.abs(np.einsum("nkd,nkd->nk", d, both)) <= 0.5 * length * np.linalg.norm(both, axis=2)
    place = np.minimum(np.searchsorted(members, near), len(members) - 1)
    reach = LINK * length[:, [min(ring_size(points.shape[1]), count) - 1]]
    step = used & along & (members[place] == near) & (length > 0) & (length <= reach)
    entries = (length[step], (np.nonzero(step)[0], place[step]))
    return csr_array(entries, shape=(len(members), len(members)))


def judge(points, normals, row, found, min_cosine: float):
    """Distance key of each candidate, and whether its normal lets it in."""
    d = points[found] - points[row]
    key = distance_key(np.einsum("...d,...d->...", d, d))
    cosine = np.einsum("...d,...d->...", normals[found], normals[row])
    return key, cosine >= min_cosine - cosine_slack(points.dtype)
