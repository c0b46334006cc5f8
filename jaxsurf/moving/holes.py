"""Holes in a cloud: large empty circles, and where points in them go."""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree

from ..borders.border import Border
from ..cloud import PointCloud
from ..compiling import on_device
from ..frames import frames_of
from ..neighbors import Neighbors

# Numbers held together: points times neighbours.
_BATCH = 1 << 18
# Gaps of a border that are treated together.
_GAPS = 32
# Of directions, and of a centre in its triangle: what round-off makes of even grids.
_ROUNDOFF = 1e-6


def large_triangles(
    cloud: PointCloud, neighbors: Neighbors, radius: Float[np.ndarray, " n"]
) -> tuple[Int[np.ndarray, "m 3"], Float[np.ndarray, "m d"]]:
    """Corners and circumcentres of triangles whose circumcircle is empty, larger than the mean of
    the radii at its corners, and has its centre inside.

    Surfaces in space. Circles lie in the tangent plane of the first corner, and are empty as far as
    its list tells; of those that reach farther the centre is moved towards the corner, so that the
    part that is known to be empty is what is returned.

    Source: after paper 002, Section 3.4.
    """
    x, frames = np.asarray(cloud.points, float), frames_of(np.asarray(cloud.normals, float))
    indices, mask = np.asarray(neighbors.indices)[:, 1:], np.asarray(neighbors.mask)[:, 1:]
    rows = np.flatnonzero(cloud.host_active & mask.any(axis=1))
    corners, centers = [np.zeros((0, 3), int)], [np.zeros((0, x.shape[1]))]
    for row in np.array_split(rows, 1 + len(rows) * indices.shape[1] // _BATCH):
        around, on = indices[row], mask[row]
        q = np.einsum("btd,bkd->bkt", frames[row, :2], x[around] - x[row, None])
        on = on & (np.sum(q**2, axis=2) > 0)
        point, first, second = _sides(q, on)
        center = _centers(q[point, first], q[point, second])
        corner = np.stack([row[point], around[point, first], around[point, second]], axis=1)
        with np.errstate(invalid="ignore"):
            large = np.sum(center**2, axis=1) > radius[corner].mean(axis=1) ** 2
        corner, point, center = corner[large], point[large], center[large]
        known = np.max(np.where(on, np.sum(q**2, axis=2), 0), axis=1)[point]
        reach = np.minimum(1, np.sqrt(known / (4 * np.sum(center**2, axis=1))))
        corners.append(corner)
        away = np.einsum("mt,mtd->md", center * reach[:, None], frames[row[point], :2])
        centers.append(x[row[point]] + away)
    return np.concatenate(corners), np.concatenate(centers)


def _sides(q: Float[np.ndarray, "b k 2"], on: Bool[np.ndarray, "b k"]) -> tuple[np.ndarray, ...]:
    """Rows and two slots of each, of all circles through the origin and two points that are empty.

    By inversion in the unit circle these are straight lines with all points on the side of the
    origin: the sides of the convex hull. It is walked around from the point that is nearest to the
    origin, by the least turn each time; of points in line the next one is taken.
    """
    squared = np.where(on, np.sum(q**2, axis=2), np.inf)
    p = q / squared[..., None]
    row, start = np.arange(len(q)), np.argmin(squared, axis=1)
    at, found = start, [np.zeros((3, 0), int)]
    heading = p[row, at] @ np.array([[0.0, 1.0], [-1.0, 0.0]])
    for _ in range(q.shape[1]):
        way = p[row] - p[row, at][:, None]
        across = heading[:, :1] * way[..., 1] - heading[:, 1:] * way[..., 0]
        turn = np.arctan2(across, np.einsum("bt,bkt->bk", heading, way))
        turn = np.where(turn < -np.pi / 2, turn + 2 * np.pi, turn)
        length = np.sum(way**2, axis=2)
        turn = np.where(on[row] & (length > 0), turn, np.inf)
        in_line = turn <= np.min(turn, axis=1, keepdims=True) + _ROUNDOFF
        after = np.argmin(np.where(in_line & np.isfinite(turn), length, np.inf), axis=1)
        found.append(np.stack([row, at, after]))
        heading, goes_on = way[np.arange(len(row)), after], after != start[row]
        row, at, heading = row[goes_on], after[goes_on], heading[goes_on]
        if not len(row):
            break
    row, at, after = np.concatenate(found, axis=1)
    a, b = q[row, at], q[row, after]
    surrounding = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0] > 0
    return row[surrounding], at[surrounding], after[surrounding]


def _centers(a: Float[np.ndarray, "m 2"], b: Float[np.ndarray, "m 2"]) -> Float[np.ndarray, "m 2"]:
    """Centres of the circles through the origin, a and b; NaN where outside of their triangle."""
    half_a, half_b = np.sum(a**2, axis=1) / 2, np.sum(b**2, axis=1) / 2
    area = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
    area = np.where(area**2 > _ROUNDOFF**2 * half_a * half_b, area, np.nan)
    x = (half_a * b[:, 1] - half_b * a[:, 1]) / area
    y = (half_b * a[:, 0] - half_a * b[:, 0]) / area
    u, v = (x * b[:, 1] - y * b[:, 0]) / area, (a[:, 0] * y - a[:, 1] * x) / area
    inside = (u >= -_ROUNDOFF) & (v >= -_ROUNDOFF) & (u + v <= 1 + _ROUNDOFF)
    return np.where(inside[:, None], np.stack([x, y], axis=1), np.nan)


def large_gaps(
    cloud: PointCloud, neighbors: Neighbors, radius: Float[np.ndarray, " n"]
) -> tuple[Int[np.ndarray, "m 2"], Float[np.ndarray, "m 2"]]:
    """Neighbours on a plane curve that are farther apart than the sum of their radii, and the
    middles."""
    x, n = np.asarray(cloud.points, float), np.asarray(cloud.normals, float)
    indices, mask = np.asarray(neighbors.indices)[:, 1:], np.asarray(neighbors.mask)[:, 1:]
    tangents = np.stack([n[:, 1], -n[:, 0]], axis=1)
    along = np.einsum("nkd,nd->nk", x[indices] - x[:, None], tangents)
    following = np.where(mask & (along > 0), along, np.inf)
    slot = np.argmin(following, axis=1)
    rows = np.flatnonzero(cloud.host_active & np.isfinite(np.min(following, axis=1)))
    pairs = np.stack([rows, indices[rows, slot[rows]]], axis=1)
    ends = x[pairs]
    wide = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1) > radius[pairs].sum(axis=1)
    return pairs[wide], ends[wide].mean(axis=1)


def border_gaps(
    cloud: PointCloud, border: Border, radius: Float[np.ndarray, " n"]
) -> tuple[Float[np.ndarray, "m 3"], Float[np.ndarray, "m 3"], Float[np.ndarray, " m"]]:
    """Points of a border, normals and radii there, in its gaps.

    They are longer than the side of an equilateral triangle whose corners are on such a circle.
    """
    rows, mask = np.asarray(border.rows)[1], np.asarray(border.mask)[1]
    own = np.argmax(mask & (rows == np.asarray(border.points)[:, None]), axis=1)
    slot = np.flatnonzero(own + 1 < mask.sum(axis=1))
    ends = np.stack([rows[slot, own[slot]], rows[slot, own[slot] + 1]])
    x = np.asarray(cloud.points)[ends]
    wide = np.linalg.norm(x[1] - x[0], axis=1) > math.sqrt(3) * radius[ends].mean(axis=0)
    slot, near = slot[wide], x.mean(axis=0)[wide]
    known = np.asarray(border.points)[slot], rows[slot], mask[slot], near
    feet = [np.zeros((2, 0, 3))]
    for first in range(0, len(slot), _GAPS):
        feet.append(_on_border(cloud, *(a[first : first + _GAPS] for a in known)))
    foot, normal = np.concatenate(feet, axis=1)
    return foot, normal, radius[ends].mean(axis=0)[wide]


def _on_border(cloud, points, rows, mask, near) -> Float[np.ndarray, "2 m 3"]:
    """Foot points on a border and normals there, of some gaps: on a border of nothing but these.

    Filled up, so that what is compiled for it serves any number, and any border.
    """
    some = np.resize(np.arange(len(points)), _GAPS)
    names = np.append(rows[some], points[some])
    x, normals = np.asarray(cloud.points)[names], np.asarray(cloud.normals)[names]
    own = np.arange(len(names), dtype=np.int32)
    windows, ends = np.split(own, [rows[some].size])
    arrays = ends, np.tile(windows.reshape(_GAPS, -1), (2, 1, 1)), np.tile(mask[some], (2, 1, 1))
    alone = Border(*map(on_device, arrays))
    cloud = PointCloud(on_device(x), on_device(normals))
    slot = on_device(np.arange(_GAPS, dtype=np.int32))
    foot, normal, *_ = alone.at(cloud, 1, slot, on_device(near[some]))
    return np.stack([foot, normal])[:, : len(points)]


def circumcenters(
    cloud: PointCloud, triangles: Int[np.ndarray, "m 3"], *, corrected: bool = False
) -> Float[np.ndarray, "m 3"]:
    """Circumcentres of triangles; corrected, moved along the mean normal.

    Equations 8 and 9 ask that the ways to the corners stand on the corners' normals; so restored
    they overshoot on a sphere by as much as was missing. Here the ways stand on the sum of that
    normal and the new one, which is exact for circles.

    Source: after paper 002, equations 8 and 9.
    """
    x, normals = np.asarray(cloud.points)[triangles], np.asarray(cloud.normals)[triangles]
    # The weight of a corner is the squared side across times the cosine of its angle.
    across = np.roll(x, -1, axis=1) - np.roll(x, 1, axis=1)
    sides = np.sum(across**2, axis=2)
    weights = sides * (np.sum(sides, axis=1, keepdims=True) - 2 * sides)
    center = np.einsum("mc,mcd->md", weights / np.sum(weights, axis=1, keepdims=True), x)
    if not corrected:
        return center
    mean = np.mean(normals, axis=1)
    normals = normals + mean[:, None]
    above = np.sum((x - center[:, None]) * normals, axis=(1, 2))
    return center + (above / np.einsum("md,mcd->m", mean, normals))[:, None] * mean


def fillings(
    cloud: PointCloud, neighbors: Neighbors, radius: Float[np.ndarray, " n"]
) -> tuple[Float[np.ndarray, "m d"], Float[np.ndarray, " m"]]:
    """Points for the holes, in tangent planes, and radii there: they are as far from each other.

    These are the means of those of the points around. (Were one of them enough, a small radius
    would spread from hole to hole over all of a surface.) What has only points of borders around it
    is no hole but where the surface ends.
    """
    find = large_gaps if cloud.dim == 2 else large_triangles
    around, at = find(cloud, neighbors, radius)
    if cloud.boundary is not None:
        inside = ~np.asarray(cloud.boundary)[around].all(axis=1)
        around, at = around[inside], at[inside]
    x = np.asarray(cloud.points, float)[cloud.host_active]
    size, wanted = cKDTree(x).query(at)[0], radius[around].mean(axis=1)
    if cloud.dim == 2:
        # Past a sharp corner what comes next along the tangent may be far, and filled between.
        empty = size >= wanted * (1 - _ROUNDOFF)
        at, size, wanted = at[empty], size[empty], wanted[empty]
    # The largest first: the middle of a hole, not a smaller circle at its rim. A centre above the
    # surface may be nearer to others than to those that it was found from.
    order = np.argsort(-size / wanted, kind="stable")
    at, wanted = at[order], wanted[order]
    kept = _apart(at, wanted) if len(at) else slice(None)
    return at[kept], wanted[kept]


def _apart(
    x: Float[np.ndarray, "m d"], distance: Float[np.ndarray, " m"]
) -> Bool[np.ndarray, " m"]:
    """Which points to take, the first ones first, so that all are as far apart."""
    near = cKDTree(x).query_ball_point(x, distance)
    kept = np.zeros(len(x), bool)
    for i, others in enumerate(near):
        kept[i] = not kept[others].any()
    return kept


def close_pairs(
    cloud: PointCloud,
    neighbors: Neighbors,
    distance: Float[np.ndarray, " n"],
    rank: Int[np.ndarray, " n"],
) -> Int[np.ndarray, "m 2"]:
    """Neighbours that are closer than the distance, the closest first; no point is in two pairs.

    The first of a pair is that of the higher rank.
    """
    x, indices = np.asarray(cloud.points, float), np.asarray(neighbors.indices)
    length = np.linalg.norm(x[indices] - x[:, None], axis=2)
    allowed = np.minimum(distance[indices], distance[:, None])
    close = np.asarray(neighbors.mask) & (length < allowed) & cloud.host_active[indices]
    close &= indices > np.arange(len(x))[:, None]
    i, slot = np.nonzero(close)
    order = np.argsort(length[i, slot], kind="stable")
    i, j = i[order], indices[i, slot][order]
    free, kept = np.ones(len(x), bool), np.zeros(len(i), bool)
    for pair in range(len(i)):
        kept[pair] = free[i[pair]] and free[j[pair]]
        if kept[pair]:
            free[i[pair]] = free[j[pair]] = False
    pairs = np.stack([i, j], axis=1)[kept]
    return np.where(rank[pairs[:, :1]] >= rank[pairs[:, 1:]], pairs, pairs[:, ::-1])
