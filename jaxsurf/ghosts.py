r"""Ghost points: the surface continued across its border by mirror images.

A point at distance s inside the border has an image at distance s outside. The condition
$a\,u + b\,\partial_\nu u = g$ at the foot between them, with the mean of both for u and their
difference over 2 s for $\partial_\nu u$, gives the value of the image,

$$u' = \frac{(b/2s - a/2)\,u + g}{b/2s + a/2}:$$

even images for Neumann conditions, odd ones for Dirichlet.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import compress
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from .arguments import instance, is_concrete, real
from .borders import Border, checked_border, find_border
from .boundary import Closure, Source, check_pivots
from .cloud import PointCloud
from .conditions import Condition, checked_conditions
from .stencils.dcpse import DCPSE
from .stencils.method import AbstractMethod

# An image closer than this share of the spacing to another point is left out (not a half: on a
# lattice the last bit would decide).
_CLOSE = 0.49
# Lengths that differ by less than this share are the same.
_SAME = 1e-5


def with_ghosts(
    cloud: PointCloud,
    conditions: Condition | Sequence[Condition],
    *,
    method: AbstractMethod = DCPSE(order=2),
    depth: float | None = None,
    border: Border | None = None,
    throw: bool = True,
) -> tuple[PointCloud, Closure]:
    r"""A cloud continued across its border, with the values that the conditions give there.

    Points near the border are reflected at the plane through their foot point on it and normal
    to its conormal, normals along with them: planes, spheres and cylinders continue exactly,
    any surface to second order. At a right-angled corner images are reflected again. Operators
    on the enlarged cloud have full stencils up to the border. Border points under a Neumann or
    Robin condition stay free, those under a Dirichlet condition are bound to its value.

    Args:
        cloud: n points with `boundary`, concrete.
        conditions: as for `close`; points off the border take Dirichlet conditions only. Parts
            of the border under no condition get no images.
        method: of the operators to come: its neighbourhoods decide how deep the images reach.
        depth: how deep, in the units of the points; by the method if None.
        border: from `find_border`; found if None.
        throw: check the factors of the images.

    Returns:
        The enlarged cloud, its first n points the old ones, the ghosts its new border (with what
        is left of the old one under no condition), and the closure for its fields
        (`Closure.extend` fills in a field of the n points).

    Accuracy: images are off by O(h³) (Neumann, Robin with b ≠ 0) and O(h²) (Dirichlet), so that
    solutions converge with second order whatever the method (`tests/test_boundary.py`); exact
    to the method's order only where the solution itself has the symmetry.
    Differentiable: in values, a and b; not in the points, whose images are found on the host.
    Raises:
        ValueError: as `close` and `find_border`; a Neumann or Robin condition off the border; no
            border point under any condition; b/s + a near zero (a Robin condition of the wrong
            sign), with the point.
    Source: the method of images of Singh et al. 2023, Section 4.5.

    Example:
        >>> square = js.graph(lambda x, y: 0.0 * x, (11, 11))
        >>> wide, closure = js.with_ghosts(square, js.neumann(square.boundary))
        >>> x = wide.points[:, 0]
        >>> even = closure.extend(square.points[:, 0] ** 2)
        >>> bool(jnp.allclose(even, jnp.minimum(abs(x), 2 - abs(x)) ** 2))
        True
    """
    instance(cloud, PointCloud, "cloud")
    instance(method, AbstractMethod, "method", "as js.GFDM(degree=2)")
    if not is_concrete(cloud.points, cloud.normals, cloud.boundary, cloud.active):
        raise ValueError("with_ghosts needs concrete points: images are found on the host")
    conditions, owned = checked_conditions(cloud, conditions)
    with jax.ensure_compile_time_eval():  # of the points alone; values may be traced
        border = find_border(cloud) if border is None else checked_border(border, cloud)
    _check_places(conditions, owned, border)
    declared = np.zeros(cloud.n, bool)
    for condition in conditions:
        declared[condition.where] = True
    binding = [not condition.is_free for condition in conditions]
    conditions, owned = list(compress(conditions, binding)), list(compress(owned, binding))
    owner, place = np.full(cloud.n, -1), np.zeros(cloud.n, int)
    for number, (condition, own) in enumerate(zip(conditions, owned)):
        owner[condition.where[own]], place[condition.where[own]] = number, np.flatnonzero(own)
    with jax.ensure_compile_time_eval():
        images = _reflected(cloud, border, owner, _reach(cloud, border, method, depth))
    if not len(images.parent):
        raise ValueError("no border point is under a condition: there is nothing to reflect")
    images = images.only(_apart(cloud, images), cloud.n)
    bare = np.zeros(cloud.n, bool) if cloud.boundary is None else np.asarray(cloud.boundary)
    bare = bare & (owner < 0)  # remains a border
    rows, indices, weights, sources = _values(cloud, images, conditions, owned, place, throw)
    grown = lambda mask: jnp.asarray(np.pad(mask, (0, len(images.parent)), constant_values=True))
    wide = _joined(cloud, images, grown(bare))
    return wide, Closure(wide.n, rows, indices, weights, sources, grown(declared))


@dataclass(frozen=True)
class _Images:
    """Images, those of images after their parents.

    Args:
        points, normals: `(m, d)`.
        parent: the point that is reflected, n + j for image j, `(m,)`.
        distance: from the parent to the foot, `(m,)`.
        condition: number of the condition that holds at the foot, `(m,)`.
        carriers: border points that carry its values to the foot, `(m, r)`.
        shares: with which weight, `(m, r)`.
    """

    points: Float[np.ndarray, "m d"]
    normals: Float[np.ndarray, "m d"]
    parent: Int[np.ndarray, " m"]
    distance: Float[np.ndarray, " m"]
    condition: Int[np.ndarray, " m"]
    carriers: Int[np.ndarray, "m r"]
    shares: Float[np.ndarray, "m r"]

    def only(self, kept, n) -> _Images:
        """Some of them, parents renumbered."""
        number = np.concatenate([np.arange(n), n + np.cumsum(kept) - 1])
        fields = {name: value[kept] for name, value in vars(self).items()}
        return _Images(**(fields | {"parent": number[fields["parent"]]}))

    def ancestors(self, n):
        """Which are images of images, of which one, and the point that all began with."""
        second = self.parent >= n
        parent = np.where(second, self.parent - n, 0)
        return second, parent, np.where(second, self.parent[parent], self.parent)

    @classmethod
    def none(cls, points, r) -> _Images:
        vectors, number, length = points[:0], np.zeros(0, int), np.zeros(0, points.dtype)
        return cls(
            vectors, vectors, number, length, number, number.reshape(0, r), length.reshape(0, r)
        )

    @classmethod
    def joined(cls, parts: list[_Images]) -> _Images:
        columns = zip(*(vars(part).values() for part in parts))
        return cls(*(np.concatenate(column) for column in columns))


def _check_places(conditions, owned, border) -> None:
    on_border = np.asarray(border.points)
    for number, (condition, own) in enumerate(zip(conditions, owned)):
        off = np.setdiff1d(condition.where[own], on_border)
        if condition.b is not None and off.size:
            raise ValueError(
                f"condition {number} takes a derivative at point {off[0]}, which is not on the "
                f"border ({off.size} such points): images need a border"
            )


def _reach(cloud, border, method, depth) -> Float[np.ndarray, " m"]:
    """How deep images reach, for every border point: as far as half its neighbours."""
    m = len(border.points)
    if depth is not None:
        real(depth, "depth", above=0)
        return np.full(m, float(depth))
    on = cloud.host_active
    points = np.asarray(cloud.points, float)
    half = method.neighbor_count(cloud.dim) / 2
    count = np.where(np.asarray(border.corners), half / 2, half).astype(int) + 1
    most = min(int(count.max()), int(on.sum()))
    distance = cKDTree(points[on]).query(points[np.asarray(border.points)], most)[0]
    return distance[np.arange(m), np.minimum(count, most) - 1]


# --- where images are ----------------------------------------------------------------------


def _reflected(cloud, border, owner, reach) -> _Images:
    """Images across every piece of the border, and next to corners images of images."""
    on = cloud.host_active
    names = np.flatnonzero(on)
    points, normals = np.asarray(cloud.points)[names], np.asarray(cloud.normals)[names]
    pieces = _pieces(border)
    across = _Across(cloud, border, owner, reach)
    first = [across.reflect(piece, names, points, normals) for piece in pieces]
    start = cloud.n + np.cumsum([0, *(len(images.parent) for images in first)])
    again = []
    # Either order leads to the same place at a right angle; one is enough.
    for i, images in enumerate(first):
        for j in range(i + 1, len(pieces)):
            common = np.intersect1d(pieces[i], pieces[j])
            if common.size:
                own = start[i] + np.arange(len(images.parent))
                args = (pieces[j], own, images.points, images.normals)
                again.append(across.reflect(*args, corners=common))
    return _Images.joined([*first, *again])


@dataclass(frozen=True)
class _Across:
    """Reflection across the pieces of a border.

    Args:
        cloud, border: the surface.
        owner: number of the condition at each point, −1 for none, `(n,)`.
        reach: how deep images go, for each border point.
    """

    cloud: PointCloud
    border: Border
    owner: Int[np.ndarray, " n"]
    reach: Float[np.ndarray, " m"]

    def reflect(self, piece, names, points, normals, *, corners=None) -> _Images:
        """Images of some points across one piece; with `corners`, of those beyond its ends."""
        spots = np.asarray(self.border.points)
        all_points = np.asarray(self.cloud.points)
        distance, nearest = _nearest(all_points[spots[piece]], points)
        slot = piece[nearest]
        near = (distance < (1 - _SAME) * self.reach[slot]) & ~np.isin(names, spots[piece])
        near &= self.owner[spots[slot]] >= 0
        if corners is not None:
            near &= np.isin(slot, corners)
        names, points, normals, slot = names[near], points[near], normals[near], slot[near]
        side = _sides(self.border, piece, slot)
        if not len(slot):
            return _Images.none(points, self.border.rows.shape[2])
        # Filled up with copies, so that few shapes are ever compiled.
        fill = np.arange(max(64, 1 << (len(slot) - 1).bit_length())) % len(slot)
        found = self.border.at(self.cloud, side[fill], slot[fill], jnp.asarray(points[fill]))
        foot, _, conormal, share = (np.asarray(x)[: len(slot)] for x in found)
        inside = -np.einsum("pd,pd->p", points - foot, conormal)

        row, used = (np.asarray(x)[side, slot] for x in (self.border.rows, self.border.mask))
        end = all_points[spots[slot]]
        beside = used & (row != spots[slot][:, None])
        inner = row[np.arange(len(row)), np.argmax(beside, axis=1)]
        is_end = np.asarray(self.border.corners)[slot]
        past = np.einsum("pd,pd->p", foot - end, end - all_points[inner])
        beyond = is_end & (past > np.finfo(points.dtype).eps ** 0.5 / 16 * distance[near])
        keep = inside > 1e-3 * distance[near]
        keep &= ~beyond if corners is None else beyond

        # A corner may be under the condition of the other side.
        speaker = np.where(is_end & (self.owner[inner] >= 0), inner, spots[slot])
        condition = self.owner[speaker]
        # Values of another condition say nothing here; one point then speaks alone.
        shared = np.all(~used | (self.owner[row] == condition[:, None]), axis=1)
        alone = np.arange(row.shape[1]) == 0
        carriers = np.where(shared[:, None], row, speaker[:, None])
        shares = np.where(shared[:, None], share, alone)
        step = 2 * inside[:, None] * conormal
        turned = normals - 2 * np.einsum("pd,pd->p", normals, conormal)[:, None] * conormal
        images = (points + step, turned, names, inside, condition, carriers, shares)
        return _Images(*(x[keep] for x in images))


def _nearest(points, queries) -> tuple[Float[np.ndarray, " q"], Int[np.ndarray, " q"]]:
    """Distance and number of the nearest point, of several equally near ones the first."""
    count = min(4, len(points))
    distance, near = cKDTree(points).query(queries, count)
    distance, near = distance.reshape(-1, count), near.reshape(-1, count)
    tied = distance <= (1 + _SAME) * distance[:, :1]
    return distance[:, 0], np.where(tied, near, len(points)).min(axis=1)


def _pieces(border: Border) -> list[Int[np.ndarray, " p"]]:
    """Places in `border.points` of every smooth piece, the corners at its ends included."""
    spots, rows = np.asarray(border.points), np.asarray(border.rows)
    place = np.full(int(spots.max(initial=0)) + int(rows.max(initial=0)) + 1, -1)
    place[spots] = np.arange(len(spots))
    corner = np.asarray(border.corners)
    near = place[rows[0]] if rows.shape[2] > 2 else np.arange(len(spots))[:, None]
    i = np.broadcast_to(np.arange(len(spots))[:, None], near.shape)
    inner = ~corner[i] & ~corner[near]
    graph = coo_array((np.ones(inner.sum()), (i[inner], near[inner])), shape=(len(spots),) * 2)
    label = connected_components(graph, directed=False)[1]
    pieces = []
    for number in np.unique(label[~corner]):
        members = np.flatnonzero(~corner & (label == number))
        pieces.append(np.unique(np.concatenate([members, near[members].ravel()])))
    return pieces


def _sides(border: Border, piece, slot) -> Int[np.ndarray, " p"]:
    """On which side of each slot the piece lies; it matters at corners only."""
    rows, spots = np.asarray(border.rows), np.asarray(border.points)
    inner = spots[piece[~np.asarray(border.corners)[piece]]]
    return np.where(np.isin(rows[0, slot], inner).any(axis=1), 0, 1)


def _apart(cloud, images) -> Bool[np.ndarray, " m"]:
    """Images that are not too close to points, or to images before them."""
    on = cloud.host_active
    points = np.asarray(cloud.points, float)[on]
    tree = cKDTree(points)
    distance, nearest = tree.query(images.points)
    spacing = tree.query(points[nearest], 2)[0][:, 1]
    kept = distance > _CLOSE * spacing
    pairs = cKDTree(images.points).query_pairs(_CLOSE * float(spacing.max()), output_type="ndarray")
    gap = np.linalg.norm(images.points[pairs[:, 0]] - images.points[pairs[:, 1]], axis=1)
    for i, j in pairs[gap < _CLOSE * spacing[pairs[:, 0]]].tolist():
        kept[max(i, j)] &= not kept[min(i, j)]
    second = images.parent >= cloud.n
    kept[second] &= kept[images.parent[second] - cloud.n]
    return kept


# --- their values --------------------------------------------------------------------------


def _values(cloud, images, conditions, owned, place, throw):
    """Rows, indices, weights and sources of the closure."""
    n, m, dtype = cloud.n, len(images.parent), cloud.points.dtype
    second, parent, root = images.ancestors(n)

    weight, inverse = _factors(images, conditions, place, root, dtype, throw)
    chosen = np.where if is_concrete(weight) else jnp.where
    total = chosen(second, weight * weight[parent], weight)

    fixed = [c.where[own] if c.b is None else c.where[:0] for c, own in zip(conditions, owned)]
    rows = np.concatenate([*fixed, n + np.arange(m)])
    first = len(rows) - m
    bound = np.full(n, -1)
    sources, start = [], 0
    for number, (condition, points) in enumerate(zip(conditions, fixed)):
        entries = _Entries(dtype)
        if len(points):
            a = _on_host(jnp.broadcast_to(condition.a, condition.m))[place[points]]
            entries.add(start + np.arange(len(points)), 1 / a, place[points])
            bound[points] = number
            start += len(points)
        here = np.flatnonzero(images.condition == number)
        entries.add_carried(images, place, first + here, inverse[here], here)
        child = np.flatnonzero(second & (images.condition[parent] == number))
        above = parent[child]
        entries.add_carried(images, place, first + child, weight[child] * inverse[above], above)
        sources.append(entries)
    # Images of points of known value.
    for number, condition in enumerate(conditions):
        here = np.flatnonzero(bound[root] == number)
        if here.size:
            a = _on_host(jnp.broadcast_to(condition.a, condition.m))[place[root[here]]]
            sources[number].add(first + here, total[here] / a, place[root[here]])
    free = int(np.argmax((bound < 0) & cloud.host_active))
    depends = np.where(bound[root] < 0, root, free)
    total = total * (bound[root] < 0)

    indices = jnp.asarray(np.concatenate([np.full(first, free), depends]).astype(np.int32))
    weights = _concatenated([np.zeros(first, dtype), total]).astype(dtype)
    given = tuple(entries.source(c) for entries, c in zip(sources, conditions) if entries.slots)
    return jnp.asarray(rows.astype(np.int32)), indices[None], weights[None], given


def _factors(images, conditions, place, root, dtype, throw) -> Any:
    """The value of an image is `weight` u + `inverse` g; conditions are carried to the feet."""
    start = np.cumsum([0, *(c.m for c in conditions)])
    pick = start[images.condition][:, None] + place[images.carriers]
    every = [
        jnp.concatenate([_each(x, c, dtype) for c, x in zip(conditions, xs)])
        for xs in zip(*((c.a, c.b) for c in conditions))
    ]
    a, b = map(_on_host, _carried(*every, pick, images.shares, images.distance))
    if throw and is_concrete(a, b):
        check_pivots(a + b, abs(a) + abs(b), root, "image of point {i}: a/2 + b/2s")
    with np.errstate(divide="ignore", invalid="ignore"):
        return (b - a) / (a + b), 1 / (a + b)


def _on_host(x) -> Any:
    """Where it is concrete: new sizes compile nothing there."""
    return np.asarray(x) if is_concrete(x) else x


def _concatenated(parts) -> Array:
    return jnp.asarray(np.concatenate(parts)) if is_concrete(*parts) else jnp.concatenate(parts)


def _each(x, condition, dtype) -> Float[Array, " m"]:
    """A factor at all points of a condition; none counts as zero."""
    return jnp.broadcast_to(jnp.zeros((), dtype) if x is None else x.astype(dtype), condition.m)


@jax.jit
def _carried(a, b, pick, shares, distance):
    """The terms a/2 and b/2s of all images."""
    return tuple(jnp.sum(shares * x[pick], axis=1) / 2 / s for x, s in ((a, 1), (b, distance)))


class _Entries:
    """The places where the values of one condition enter."""

    def __init__(self, dtype):
        self.dtype = dtype
        self.slots: list[np.ndarray] = []
        self.factors: list[Array] = []
        self.picks: list[np.ndarray] = []

    def add(self, slots, factors, picks):
        self.slots.append(np.asarray(slots))
        self.factors.append(factors)
        self.picks.append(np.asarray(picks))

    def add_carried(self, images, place, slots, factors, which):
        """Values carried to the feet of some images."""
        share = images.shares[which]
        i, r = np.nonzero(share)
        self.add(slots[i], factors[i] * share[i, r], place[images.carriers[which][i, r]])

    def source(self, condition) -> Source:
        slots, picks = (jnp.asarray(np.concatenate(x)) for x in (self.slots, self.picks))
        return Source(slots, _concatenated(self.factors).astype(self.dtype), picks, condition)


def _joined(cloud, images, border) -> PointCloud:
    m = len(images.parent)
    pad = lambda x, value: None if x is None else jnp.concatenate([x, jnp.full(m, value, x.dtype)])
    root = images.ancestors(cloud.n)[2]
    spacing = cloud.spacing
    return PointCloud(
        jnp.concatenate([cloud.points, jnp.asarray(images.points, cloud.points.dtype)]),
        jnp.concatenate([cloud.normals, jnp.asarray(images.normals, cloud.points.dtype)]),
        boundary=border,
        active=pad(cloud.active, True),
        spacing=None if spacing is None else jnp.concatenate([spacing, spacing[root]]),
    )
