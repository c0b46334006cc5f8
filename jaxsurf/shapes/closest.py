"""Closest points of a triangle mesh."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray as Array
from scipy.spatial import cKDTree


class ClosestPoint:
    """Exact closest points on a triangle mesh, for many points at once.

    Args:
        vertices: `(n, 3)`.
        triangles: vertex numbers, `(m, 3)`; long triangles are no worse than others.
    """

    def __init__(self, vertices: Float[Array, "n 3"], triangles: Int[Array, "m 3"]):
        self._corners = vertices[triangles]
        centers, parents, self._reach = _cover(self._corners)
        self._parents = parents
        self._tree = cKDTree(centers)

    def __call__(
        self, points: Float[Array, "q 3"], *, exact: bool = True
    ) -> tuple[Float[Array, "q 3"], Int[Array, " q"], Float[Array, "q 3"]]:
        """Closest points, the triangles they are on, and their barycentric coordinates.

        With `exact=False` only the four triangles with the nearest centres are looked at: a
        point of the mesh, and for points near the mesh hardly another one.
        """
        q = len(points)
        place, triangle, bary = np.empty((q, 3)), np.zeros(q, np.int64), np.empty((q, 3))
        todo, k = np.arange(q), 12 if exact else 4
        while todo.size:
            k = min(k, self._tree.n)
            distance, index = self._tree.query(points[todo], k=range(1, k + 1))
            candidates = self._parents[index]
            found, weights = _closest_on_triangles(points[todo][:, None], self._corners[candidates])
            gap = np.linalg.norm(found - points[todo][:, None], axis=2)
            best = np.argmin(gap, axis=1)
            row = np.arange(len(todo))
            place[todo], bary[todo] = found[row, best], weights[row, best]
            triangle[todo] = candidates[row, best]
            # A triangle not looked at keeps its centre beyond the last one, so none of its
            # points is nearer than that distance less its reach.
            sure = (gap[row, best] <= distance[:, -1] - self._reach) | (k == self._tree.n)
            todo, k = todo[~sure & exact], 4 * k
        return place, triangle, bary


def _cover(corners):
    """Centres of pieces of triangles, all within one small reach of every point of them."""
    parents = np.arange(len(corners))
    limit = 2 * np.median(_reach(corners))
    done, whose = [], []
    for _ in range(12):
        long = _reach(corners) > limit
        done.append(corners[~long].mean(axis=1))
        whose.append(parents[~long])
        corners, parents = corners[long], parents[long]
        if not len(corners):
            return np.concatenate(done), np.concatenate(whose), limit
        a, b, c = corners.swapaxes(0, 1)
        ab, bc, ca = (a + b) / 2, (b + c) / 2, (c + a) / 2
        quarters = ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))
        corners = np.concatenate([np.stack(t, axis=1) for t in quarters])
        parents = np.tile(parents, 4)
    done.append(corners.mean(axis=1))
    whose.append(parents)
    return np.concatenate(done), np.concatenate(whose), float(_reach(corners).max())


def _reach(corners):
    return np.linalg.norm(corners - corners.mean(axis=1, keepdims=True), axis=2).max(axis=1)


def _closest_on_triangles(point, corners):
    """Closest point of each triangle `(..., 3, 3)`, with barycentric coordinates."""
    a, b, c = np.moveaxis(corners, -2, 0)
    u, v, w = b - a, c - a, point - a
    uu, uv, vv = _dot(u, u), _dot(u, v), _dot(v, v)
    wu, wv = _dot(w, u), _dot(w, v)
    det = uu * vv - uv * uv
    flat = det <= 1e-14 * uu * vv
    det = np.where(flat, 1, det)
    s, t = (vv * wu - uv * wv) / det, (uu * wv - uv * wu) / det
    inside = (s >= 0) & (t >= 0) & (s + t <= 1) & ~flat
    best = np.stack([1 - s - t, s, t], axis=-1)
    best_gap = np.where(inside, 0, np.inf)
    # Outside the triangle the closest point is on one of its sides.
    for i in range(3):
        p, d = (a, b, c)[i], (b, c, a)[i] - (a, b, c)[i]
        length = _dot(d, d)
        r = np.clip(_dot(point - p, d) / np.where(length > 0, length, 1), 0, 1)
        gap = _dot(p + r[..., None] * d - point, p + r[..., None] * d - point)
        side = np.zeros(best.shape)
        side[..., i], side[..., (i + 1) % 3] = 1 - r, r
        closer = gap < best_gap
        best = np.where(closer[..., None], side, best)
        best_gap = np.where(closer, gap, best_gap)
    return np.einsum("...i,...ij->...j", best, corners), best


def _dot(a, b):
    return np.einsum("...i,...i->...", a, b)
