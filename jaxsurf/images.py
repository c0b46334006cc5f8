"""Mirror images of points across the border of a surface: where they are."""

from __future__ import annotations

from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from .arguments import real
from .borders.border import Border
from .cloud import PointCloud
from .compiling import power_of_two

# An image closer than this share of the spacing to another point is left out (not a half: on a
# lattice the last bit would decide).
_CLOSE = 0.49
# Lengths that differ by less than this share are the same.
_SAME = 1e-5


@dataclass(frozen=True)
class Images:
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

    def only(self, kept, n) -> Images:
        """Some of them, parents renumbered."""
        number = np.concatenate([np.arange(n), n + np.cumsum(kept) - 1])
        fields = {name: value[kept] for name, value in vars(self).items()}
        return Images(**(fields | {"parent": number[fields["parent"]]}))

    def ancestors(self, n):
        """Which are images of images, of which one, and the point that all began with."""
        second = self.parent >= n
        parent = np.where(second, self.parent - n, 0)
        return second, parent, np.where(second, self.parent[parent], self.parent)

    @classmethod
    def none(cls, points, r) -> Images:
        vectors, number, length = points[:0], np.zeros(0, int), np.zeros(0, points.dtype)
        return cls(
            vectors, vectors, number, length, number, number.reshape(0, r), length.reshape(0, r)
        )

    @classmethod
    def joined(cls, parts: list[Images]) -> Images:
        columns = zip(*(vars(part).values() for part in parts))
        return cls(*(np.concatenate(column) for column in columns))


def reach_of(cloud, border, method, depth) -> Float[np.ndarray, " m"]:
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


def reflected(cloud, border, owner, reach) -> Images:
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
    return Images.joined([*first, *again])


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

    def reflect(self, piece, names, points, normals, *, corners=None) -> Images:
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
            return Images.none(points, self.border.rows.shape[2])
        # Filled up with copies, so that few shapes are ever compiled.
        fill = np.arange(max(64, power_of_two(len(slot)))) % len(slot)
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
        mirrored = normals - 2 * np.einsum("pd,pd->p", normals, conormal)[:, None] * conormal
        images = (points + step, mirrored, names, inside, condition, carriers, shares)
        return Images(*(x[keep] for x in images))


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


def apart(cloud, images) -> Bool[np.ndarray, " m"]:
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
