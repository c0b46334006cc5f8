r"""What touches cut out, and what is left closed by a smooth surface."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PyTree
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from ..cloud import PointCloud
from ..discretization import Discretization
from ..failures import raise_at
from ..neighbors import Neighbors, first_ring
from ..shapes.thinning import DISK, poisson_disk
from .contact import Facing, chambers, facing, turned_over
from .rows import Rows, exchanged

# All within this of the middle between two points that face each other is cut out, in contact
# distances. Caps of a neck then are two apart, a bridge between drops nearly three thick.
_CUT = 1.5
# What is beyond the cut for as many contact distances, or points, shapes the new part.
_AROUND, _MOST = 4.0, 300
# Middles that are nearer than this, in contact distances, tell the same.
_SAME = 0.5
# Tries for a place where it was cut out, in volumes of a ball of a spacing; Newton steps to the
# surface.
_TRIES, _STEPS = 30, 12
_CLOSE = 1e-9
# A value at a new point is the mean over so many points around.
_MEAN = 6


class Cut(NamedTuple):
    """What is to change where sheets touch.

    Args:
        leaving: rows that go.
        points, normals: that come.
        pinched, joined, vanished: how many necks, gaps and whole parts were cut out.
    """

    leaving: Int[np.ndarray, " m"]
    points: Float[np.ndarray, "p d"]
    normals: Float[np.ndarray, "p d"]
    pinched: int
    joined: int
    vanished: int


def cut(
    cloud: PointCloud,
    neighbors: Neighbors,
    distance: float,
    spacing: Float[np.ndarray, " n"],
) -> Cut | None:
    """Where a surface touches itself; None where it does not."""
    both = facing(cloud, distance), turned_over(cloud, neighbors)
    met = jax.tree.map(lambda *found: np.concatenate(found), *both)
    if not len(met.pairs):
        return None
    x, on, part = np.asarray(cloud.points, float), cloud.host_active, chambers(cloud, neighbors)
    places, inside = _places(met, x, distance)
    away, nearest = cKDTree(places).query(x)
    leaving = on & (away <= _CUT * distance)
    if cloud.boundary is not None:
        text = "sheets touch within {v:.3g} of point {i} on the border: only closed ones are cut"
        raise_at(leaving & np.asarray(cloud.boundary), text, np.full(cloud.n, _CUT * distance))
    group = _groups(places, 2 * _CUT * distance)
    new = [(np.zeros((0, cloud.dim)),) * 2]
    pinched = joined = 0
    for one in range(group.max() + 1):
        mine = group == one
        parts = np.unique(part[leaving & mine[nearest]])
        stays = on & ~leaving & np.isin(part, parts)
        around = np.flatnonzero(stays & (away <= (_CUT + _AROUND) * distance) & mine[nearest])
        if len(around):
            around = around[np.argsort(away[around], kind="stable")[:_MOST]]
            new.append(_closed(cloud, around, places[mine], inside[mine], distance, spacing))
            pinched, joined = pinched + inside[mine].any(), joined + (~inside[mine]).any()
    gone = np.setdiff1d(part[on], part[on & ~leaving]).size
    points, normals = (np.concatenate(arrays) for arrays in zip(*new))
    return Cut(np.flatnonzero(leaving), points, normals, int(pinched), int(joined), gone)


def _places(met: Facing, x, distance: float):
    """Middles between points that face each other, few where there are many."""
    middles = np.mean(x[met.pairs], axis=1)
    kept = poisson_disk(middles, _SAME * distance)
    return middles[kept], met.inside[kept]


def _groups(places: Float[np.ndarray, "m d"], reach: float) -> Int[np.ndarray, " m"]:
    i, j = cKDTree(places).query_pairs(reach, output_type="ndarray").T
    graph = coo_array((np.ones(len(i)), (i, j)), shape=(len(places),) * 2)
    return connected_components(graph, directed=False)[1]


def _closed(cloud, around, places, inside: Bool[np.ndarray, " m"], distance: float, spacing):
    """Points and normals where the cut was, spread evenly."""
    x, n = (np.asarray(a, float)[around] for a in (cloud.points, cloud.normals))
    h = float(np.median(spacing[around]))
    # What was inside between the sheets is outside now, and the other way round.
    surface = HermiteSurface(x, n, places, np.where(inside, distance, -distance), h)
    rng, dim, size = np.random.default_rng(0), cloud.dim, _CUT * distance
    balls = len(poisson_disk(places, size / 2))
    count = int(_TRIES * balls * max(1.0, size / h) ** dim)
    ways = rng.normal(size=(count, dim))
    ways *= (rng.random(count) ** (1 / dim) / np.linalg.norm(ways, axis=1))[:, None]
    tries = places[rng.integers(len(places), size=count)] + size * ways
    tries, slope = _onto(surface, tries, distance)
    good = cKDTree(places).query(tries)[0] <= size + h
    good &= cKDTree(x).query(tries)[0] >= DISK * h
    tries, slope = tries[good], slope[good]
    kept = poisson_disk(tries, DISK * h) if len(tries) else np.zeros(0, int)
    normals = slope[kept] / np.linalg.norm(slope[kept], axis=1, keepdims=True)
    return tries[kept], normals


def _onto(surface: HermiteSurface, tries, distance: float):
    """Those that Newton's method takes to the surface, and the gradients there."""
    moving, slopes, there = np.arange(len(tries)), np.zeros_like(tries), np.zeros(len(tries), bool)
    for left in range(_STEPS, -1, -1):
        value, slope = surface(tries[moving])
        done = np.abs(value) <= _CLOSE * distance
        there[moving[done]], slopes[moving[done]] = True, slope[done]
        moving, value, slope = moving[~done], value[~done], slope[~done]
        if not left or not len(moving):
            break
        length = np.linalg.norm(slope, axis=1)
        length = np.where(length > 0, length, 1.0)
        step = np.clip(value / length, -distance / 2, distance / 2)
        tries[moving] -= (step / length)[:, None] * slope
    return tries[there], slopes[there]


class HermiteSurface:
    r"""The smooth function that vanishes at points, with their normals as its gradient.

    $f(x) = \sum_j \alpha_j\,r_j^3 - \beta_j\cdot\nabla r_j^3 + p(x)$ with $r_j = |x - x_j|$ and p
    linear: of all functions that meet the conditions the one that bends least.

    Args:
        points, normals: `(m, d)`, where f = 0 and its gradient.
        places, values: `(l, d)` and `(l,)`: values of f elsewhere.
        scale: a length of the size of the spacing.

    Source: Macedo, Gois and Velho 2011, Hermite radial basis functions implicits.
    """

    def __init__(self, points, normals, places, values, scale: float):
        self.center, self.scale, self.count = np.mean(points, axis=0), scale, len(points)
        self.at = (np.concatenate([points, places]) - self.center) / scale
        given = self.at[: self.count]
        rows = np.concatenate([self._values(self.at), self._slopes(given).reshape(points.size, -1)])
        linear = rows.shape[1] - len(rows)
        matrix = np.zeros((rows.shape[1],) * 2)
        matrix[: len(rows)], matrix[len(rows) :, : len(rows)] = rows, rows[:, -linear:].T
        values = [np.zeros(self.count), values / scale, normals.ravel(), np.zeros(linear)]
        self.weights = np.linalg.solve(matrix, np.concatenate(values))

    def __call__(self, x):
        """Values `(m,)` and gradients `(m, d)` at points."""
        z = (x - self.center) / self.scale
        # In parts, each of which fits into a cache.
        parts = [
            (self._values(y) @ self.weights * self.scale, self._slopes(y) @ self.weights)
            for y in np.array_split(z, 1 + len(z) // 256)
        ]
        return tuple(np.concatenate(arrays) for arrays in zip(*parts))

    def _values(self, z):
        way = z[:, None] - self.at
        r = np.linalg.norm(way, axis=2)
        turned = -3 * r[:, : self.count, None] * way[:, : self.count]
        ones = np.ones((len(z), 1))
        return np.concatenate([r**3, turned.reshape(len(z), -1), ones, z], axis=1)

    def _slopes(self, z):
        dim = z.shape[1]
        way = z[:, None] - self.at
        r = np.linalg.norm(way, axis=2)
        first = np.moveaxis(3 * r[..., None] * way, 2, 1)
        r, way = r[:, : self.count, None, None], way[:, : self.count]
        second = -3 * (r * np.eye(dim) + way[..., None] * way[:, :, None] / np.where(r > 0, r, 1))
        second = np.moveaxis(second, 2, 1).reshape(len(z), dim, -1)
        straight = np.broadcast_to(np.eye(dim), (len(z), dim, dim))
        zero = np.zeros((len(z), dim, 1))
        return np.concatenate([first, second, zero, straight], axis=2)


def rejoined(
    surface: Discretization,
    fields: PyTree[Array],
    distance: float,
    spacing: Float[np.ndarray, " n"],
    capacity: int | None,
) -> tuple[Discretization | None, PyTree[Array], Cut | None]:
    """The surface without what touches, and its fields; the same where nothing does.

    None where nothing of it is left.
    """
    cloud = surface.cloud
    found = cut(cloud, surface.neighbors, distance, spacing)
    if found is not None:
        on = np.array(cloud.host_active)
        on[found.leaving] = False
        if not on.any():
            return None, fields, found
        rows, stays = Rows.of(surface, fields, spacing), np.flatnonzero(on)
        points = jnp.asarray(found.points, cloud.points.dtype)
        normals = jnp.asarray(found.normals, cloud.points.dtype)
        values, wanted = _means(cloud, stays, found.points, (fields, rows.spacing))
        coming = Rows(points, normals, values, wanted, jnp.zeros(len(points), rows.rank.dtype))
        surface, rows = exchanged(surface, rows, found.leaving, coming, capacity)
        fields, spacing = rows.fields, np.asarray(rows.spacing)
    crumbs, parts = _crumbs(surface)
    if parts:
        none = np.zeros((0, cloud.dim))
        found = found or Cut(crumbs, none, none, 0, 0, 0)
        found = found._replace(vanished=found.vanished + parts)
        if len(crumbs) == surface.cloud.host_active.sum():
            return None, fields, found
        rows = Rows.of(surface, fields, spacing)
        nothing = jax.tree.map(lambda u: u[:0], rows)
        surface, rows = exchanged(surface, rows, crumbs, nothing, capacity)
        fields = rows.fields
    return surface, fields, found


def _crumbs(surface: Discretization) -> tuple[Int[np.ndarray, " m"], int]:
    """Rows of parts that have fewer points than a stencil asks for, and how many such parts."""
    cloud, dim = surface.cloud, surface.cloud.dim
    part = chambers(cloud, first_ring(surface.neighbors, dim))
    small = np.bincount(part[part >= 0]) < surface.method.neighbor_count(dim)
    return np.flatnonzero((part >= 0) & small[part]), int(small.sum())


def _means(cloud: PointCloud, stays: Int[np.ndarray, " m"], points, values) -> PyTree[Array]:
    """Values at new points: Gaussian means over the points around."""
    x = np.asarray(cloud.points, float)[stays]
    distance, near = cKDTree(x).query(points, np.arange(1, 1 + min(_MEAN, len(stays))))
    shares = np.exp(-((distance / distance.mean(axis=1, keepdims=True)) ** 2))
    shares, rows = shares / shares.sum(axis=1, keepdims=True), stays[near]
    mean = lambda u: jnp.asarray(
        np.einsum("pm,pm...->p...", shares.astype(u.dtype), np.asarray(u)[rows])
    )
    return jax.tree.map(mean, values)
