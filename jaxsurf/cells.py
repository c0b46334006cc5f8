"""Neighbour search on the device, for points that move: a hashed list of cells."""

from __future__ import annotations

import functools
import math
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from scipy.spatial import cKDTree

from .arguments import as_float, finite, instance, real, whole
from .compiling import in_batches
from .failures import is_concrete, refuse, unchecked
from .indices import mask
from .machine import COUNTED, block
from .neighbors import Neighbors
from .sheets import cosine_slack

# Cells are a little wider than the radius, so that rounding puts no neighbour two cells away.
_MARGIN = 1.01


class SearchCapacity(NamedTuple):
    """Sizes of the arrays of a search; they are part of the compiled program.

    Args:
        k: slots per row.
        candidates: points in the 3^d cells around a point.

    Example:
        >>> cloud = js.sphere(300)
        >>> capacity = js.allocate_search(cloud.points, 0.5)
        >>> neighbors, report = js.search_neighbors(cloud.points, radius=0.5, capacity=capacity)
        >>> neighbors.k == capacity.k, bool(report.overflow)
        (True, False)
    """

    k: int
    candidates: int


class SearchReport(eqx.Module):
    """What a search needed and what it had: both searches agree if nothing overflowed.

    Args:
        k: slots per row that were available.
        k_needed: largest number of neighbours within the radius; for the k nearest, k.
        k_found: least number of neighbours found, for the k nearest (k_needed otherwise).
        candidates: candidates per point that were available.
        candidates_needed: largest number of points in the cells around a point.
        point: the point that needed most.
    """

    k: int = eqx.field(static=True)
    candidates: int = eqx.field(static=True)
    k_needed: Int[Array, ""]
    k_found: Int[Array, ""]
    candidates_needed: Int[Array, ""]
    point: Int[Array, ""]

    @property
    def overflow(self) -> Bool[Array, ""]:
        """True if neighbours are missing."""
        return (
            (self.k_needed > self.k)
            | (self.candidates_needed > self.candidates)
            | (self.k_found < self.k_needed)
        )

    def check(self) -> None:
        """Raise a ValueError with the numbers needed and available; outside jit."""
        if self.candidates_needed > self.candidates:
            raise ValueError(
                f"point {self.point} has {self.candidates_needed} points in the cells around it, "
                f"capacity is {self.candidates} candidates"
            )
        if self.k_needed > self.k:
            raise ValueError(
                f"point {self.point} has {self.k_needed} neighbours within the radius, "
                f"capacity is {self.k}"
            )
        if self.k_found < self.k_needed:
            raise ValueError(
                f"a point has {self.k_found} neighbours within the radius, "
                f"{self.k_needed} are needed: enlarge the radius"
            )


def allocate_search(
    points: Float[Array, "n d"],
    radius: float,
    *,
    active: Bool[Array, " n"] | None = None,
    margin: float = 1.25,
) -> SearchCapacity:
    """Capacity for `search_neighbors` on these points, with room to move.

    Args:
        points: typical positions, concrete.
        radius: search radius, in the units of `points`.
        active: False for rows that are switched off.
        margin: factor on what these points need.

    Returns:
        Number of slots and of candidates. Whatever the normals reject is counted too.

    Raises:
        TypeError: points or numbers that are none.
        ValueError: traced points or points that are not finite, a radius that is not positive, a
            margin below 1.

    Example:
        >>> x = jnp.stack([jnp.arange(10.0), jnp.zeros(10)], axis=1)
        >>> js.allocate_search(x, 2.5, margin=1)
        SearchCapacity(k=5, candidates=8)
    """
    if not is_concrete(points, active):
        raise ValueError("allocate_search needs concrete points: call it outside jit")
    points = _checked_points(points, active)
    real(radius, "radius", above=0)
    real(margin, "margin", least=1)
    on = all_on(points, active)
    candidates = int(jax.jit(_candidates)(points, radius, on)[1].sum(axis=1).max())
    x = np.asarray(points, float)[np.asarray(on)]
    k = int(cKDTree(x).query_ball_point(x, radius * (1 + 1e-6), return_length=True).max())
    n = len(points)
    return SearchCapacity(min(n, math.ceil(margin * k)), min(n, math.ceil(margin * candidates)))


def search_neighbors(
    points: Float[Array, "n d"],
    *,
    radius: float | Float[Array, ""],
    capacity: SearchCapacity,
    k: int | None = None,
    normals: Float[Array, "n d"] | None = None,
    active: Bool[Array, " n"] | None = None,
    min_cosine: float = 0.0,
    throw: bool = True,
    batch_size: int = COUNTED,
) -> tuple[Neighbors, SearchReport]:
    r"""Neighbours within a radius, found on the device, under jit, for points that move.

    The same sets in the same order as `find_neighbors`, up to distances that round-off
    decides, and up to sheets of the same orientation across a gap: this search keeps whatever
    the radius and the normals let in. Points are sorted by the cell of a grid that they lie in;
    each looks into the 3^d cells around it. Cells are hashed, so that neither the extent of the
    cloud nor its distance from the origin matters.

    Args:
        points: `(n, d)`, d = 2 or 3.
        radius: neighbours are at most this far away; one number, may be traced.
        capacity: array sizes, from `allocate_search`.
        k: take only the k nearest of those within the radius.
        normals: `(n, d)`; if given, neighbours have $n_i\cdot n_j \ge$ `min_cosine`.
        active: False for rows that are switched off, `(n,)`.
        min_cosine: least cosine between the normals of neighbours.
        throw: raise when the capacity is exceeded, also from within jit.
        batch_size: points treated at a time on a CPU, elsewhere in proportion; bounds the memory.

    Returns:
        Neighbour lists with `capacity.k` slots (or k), and what was needed and available. If
        `report.overflow`, neighbours are missing; `report.check()` gives the numbers.

    Accuracy: in float32 the lists of `find_neighbors` (`tests/test_neighbors.py`).
    Differentiable: the lists are integers; no derivative flows through the search.
    Raises:
        TypeError: points, numbers or a capacity that are none.
        ValueError: normals or k that do not fit (both numbers given); on concrete arrays a radius
            or a cosine out of range.
        RuntimeError: capacity exceeded and `throw`.

    Example:
        >>> x = jnp.stack([jnp.arange(10.0), jnp.zeros(10)], axis=1)
        >>> capacity = js.allocate_search(x, 2.5)
        >>> neighbors, report = js.search_neighbors(x, radius=2.5, capacity=capacity)
        >>> neighbors.indices[4, :5].tolist(), int(report.k_needed)
        ([4, 3, 5, 2, 6], 5)
    """
    points = _checked_points(points, active)
    instance(capacity, SearchCapacity, "capacity", "see allocate_search")
    for name, size in capacity._asdict().items():
        whole(size, f"capacity.{name}", least=1)
    if normals is not None:
        normals = as_float(normals, "normals")
        if normals.shape != points.shape:
            raise ValueError(f"normals have shape {normals.shape}, points {points.shape}")
    if k is not None:
        k = whole(k, "k")
        if not 2 <= k <= capacity.candidates:
            raise ValueError(f"k = {k} neighbours, 2 to {capacity.candidates} candidates allowed")
    real(radius, "radius", above=0)
    real(min_cosine, "min_cosine", least=-1, most=1)
    # Numbers go in as arrays: another value compiles nothing.
    bounds = tuple(jnp.asarray(value, points.dtype) for value in (radius, min_cosine))
    batch_size = min(block(whole(batch_size, "batch_size", least=1)), len(points))
    return _search((points, normals), active, bounds, capacity, k, throw, batch_size)


@functools.partial(jax.jit, static_argnums=(3, 4, 5, 6))
def _search(
    where, active, bounds, capacity: SearchCapacity, k: int | None, throw: bool, batch_size: int
) -> tuple[Neighbors, SearchReport]:
    """Within bounds (a radius and a least cosine), where points are and how they face, if known."""
    (points, normals), (radius, min_cosine) = jax.lax.stop_gradient((where, bounds))
    n, slots = len(points), capacity.k if k is None else k
    on = all_on(points, active)
    start, length, order = _candidates(points, radius, on)
    limit = distance_key(radius * radius)
    last = jnp.iinfo(limit.dtype).max

    def row(i, start, length):
        # Slot t of the candidates lies in the cell whose run of slots has not ended before t.
        ends = jnp.cumsum(length)
        t = jnp.arange(capacity.candidates)
        cell = jnp.searchsorted(ends, t, side="right", method="compare_all")
        cell = jnp.minimum(cell, len(length) - 1)
        j = order.at[(start - (ends - length))[cell] + t].get(mode="clip")
        d = points[j] - points[i]
        key = distance_key(jnp.sum(d * d, axis=1))
        good = (t < ends[-1]) & (key <= limit) & on[i]
        if normals is not None:
            good &= jnp.sum(normals[j] * normals[i], axis=1) >= (
                min_cosine - cosine_slack(points.dtype)
            )
        good |= (j == i) & (t < ends[-1]) & on[i]
        key = jnp.where(good, jnp.where(j == i, -1, key), last)
        key, j = jax.lax.sort((key, j), num_keys=2)
        mask = key[:slots] < last
        j = jnp.where(mask, j[:slots], i)
        return _pad(j, slots, i), _pad(mask, slots, False), good.sum()

    rows = (jnp.arange(n, dtype=jnp.int32), start, length)
    indices, mask, count = in_batches(lambda a: row(*a), rows, batch_size)
    needed = length.sum(axis=1)
    full = jnp.asarray(slots, count.dtype)
    report = SearchReport(
        k=slots,
        candidates=capacity.candidates,
        k_needed=count.max() if k is None else full,
        k_found=count.max() if k is None else jnp.min(jnp.where(on, count, full)),
        candidates_needed=needed.max(),
        point=jnp.where(needed.max() > capacity.candidates, jnp.argmax(needed), jnp.argmax(count)),
    )
    neighbors = unchecked(Neighbors, indices, mask, radius if k is None else None)
    if throw:
        neighbors = refuse(
            neighbors,
            report.overflow,
            f"neighbour search: {slots} slots and {capacity.candidates} candidates per point are "
            "not enough, or the radius is too small for k; `throw=False` and `report.check()` "
            "give the numbers needed",
        )
    return neighbors, report


def _checked_points(points, active) -> Float[Array, "n d"]:
    points = as_float(points, "points")
    if points.ndim != 2 or points.shape[1] not in (2, 3) or not len(points):
        raise ValueError(
            f"points must have shape (n, 2) or (n, 3), n at least 1, not {points.shape}"
        )
    if active is not None:
        mask(active, len(points), "active")
    if is_concrete(points, active):
        finite(points if active is None else points[np.asarray(active)], "points")
    return points


def all_on(points, active) -> Bool[Array, " n"]:
    return jnp.ones(len(points), bool) if active is None else jnp.asarray(active, bool)


def _pad(row, width: int, value):
    return jnp.pad(row, (0, width - len(row)), constant_values=value) if len(row) < width else row


def distance_key(squared: Array) -> Array:
    """The same integers as `neighbors.distance_key`."""
    if squared.dtype == jnp.float32:
        return (jax.lax.bitcast_convert_type(squared, jnp.int32) + (1 << 7)) >> 8
    return (jax.lax.bitcast_convert_type(squared, jnp.int64) + (1 << 21)) >> 22


def _candidates(points, radius, on):
    """Per point, start and length of the 3^d runs of `order` that hold its surroundings.

    The grid is wrapped onto a torus with a few buckets per point. Wrapping adds candidates,
    which their distance then rules out, and loses none; three or more buckets per axis keep
    the 3^d cells around a point apart.
    """
    n, d = points.shape
    wide = 1 << max(2, math.ceil(math.log2(4 * max(n, 1)) / d))
    corner = jnp.min(jnp.where(on[:, None], points, jnp.inf), axis=0)
    # Wrapped as floating-point numbers: far cells would overflow an int32.
    cell = jnp.floor((jnp.where(on[:, None], points, corner) - corner) / (_MARGIN * radius))
    cell = jnp.mod(cell, wide).astype(jnp.int32)
    places = np.array([wide**a for a in range(d)], np.int32)
    bucket = jnp.where(on, cell @ places, wide**d)
    order = jnp.argsort(bucket).astype(jnp.int32)
    first = jnp.searchsorted(bucket[order], jnp.arange(wide**d + 1)).astype(jnp.int32)
    steps = np.stack(np.meshgrid(*[[-1, 0, 1]] * d, indexing="ij"), axis=-1).reshape(-1, d)
    around = jnp.mod(cell[:, None] + steps.astype(np.int32), wide) @ places
    start = first[around]
    length = jnp.where(on[:, None], first[around + 1] - start, 0)
    return start, length, order
