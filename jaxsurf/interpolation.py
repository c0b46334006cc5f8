"""Values of fields at other points of a surface, by the polynomials that the stencils fit."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from scipy.spatial import cKDTree

from .blocks import blocks_of, rows_of
from .build import determined
from .cloud import PointCloud
from .compiling import Pieces, host_jit, in_batches, namespace, on_device
from .failures import is_concrete, refuse
from .fits.moments import blockwise, in_blocks, moment_solve
from .fits.monomials import monomials
from .fits.plane import Neighborhood, TangentPlane
from .functions import constant
from .machine import PAIRS, READ, block, block_of_pairs
from .neighbors import Neighbors, Rows
from .stencils.method import with_center


def interpolated(
    cloud: PointCloud,
    neighbors: Neighbors,
    degree: int,
    points: Float[Array, "m d"],
    u: Float[Array, "n *c"],
) -> Float[Array, "m *c"]:
    """Values of a field at points of the surface, refused farther away than neighbours reach."""
    centers = nearest_points(cloud.points, cloud.active, points)
    distance, reach = distance_and_reach(cloud, neighbors, points, centers)
    text = (
        "points: {i} is {v:.3g} away from the nearest point of the cloud, farther than the "
        "neighbours of that reach"
    )
    points = refuse(points, beyond(distance, reach), text, distance)
    return read_from(cloud, neighbors, degree, points, centers, u)[0]


def read_from(
    cloud: PointCloud,
    neighbors: Neighbors,
    degree: int,
    points: Float[Array, "m d"],
    centers: Int[Array, " m"],
    u: Float[Array, "n *c"],
    *,
    check: bool = True,
) -> tuple[Float[Array, "m *c"], Float[Array, " m"]]:
    """Values of a field at points, by the polynomials of these centres; residuals of the fits.

    Args:
        check: refuse fits that are not determined.
    """
    slots, weights, residual = _interpolation_weights(cloud, neighbors, degree, points, centers)
    weights = determined(weights, residual, degree) if check else weights
    return _summed(weights, slots, u), residual


def nearest_points(
    among: Float[Array, "n d"], on: Bool[Array, " n"] | None, points: Float[Array, "m d"]
) -> Int[Array, " m"]:
    """Which of some points, of those that are on, is next to each of others."""
    if is_concrete(among, on, points):
        rows = np.arange(len(among)) if on is None else np.flatnonzero(on)
        tree = cKDTree(np.asarray(among, float)[rows])
        return on_device(rows[tree.query(np.asarray(points, float))[1]].astype(np.int32))
    return _nearest(jax.lax.stop_gradient(among), on, points)


@jax.jit
def _nearest(points, active, wanted):
    def nearest(x):
        squared = jnp.sum((points - x) ** 2, axis=1)
        return jnp.argmin(squared if active is None else jnp.where(active, squared, jnp.inf))

    wanted = jax.lax.stop_gradient(wanted)
    return in_batches(nearest, wanted, block_of_pairs(PAIRS)).astype(jnp.int32)


def _interpolation_weights(
    cloud: PointCloud,
    neighbors: Neighbors,
    degree: int,
    points: Float[Array, "m d"],
    centers: Int[Array, " m"],
) -> tuple[Int[Array, "k m"], Float[Array, "k m"], Float[Array, " m"]]:
    """Neighbours of the points next to these, their weights, and the residuals of their moments.

    Over the tangent plane of its centre each field is the polynomial that fits the neighbours and
    passes through the centre; it is read off where the point stands above that plane.
    """
    slots, lists, at = _seen_from(cloud, neighbors, points, centers)
    blocks = blocks_of(cloud, lists, centers, block(READ))
    return slots, *rows_of(*_of_blocks((blocks, at), degree), len(points))


@host_jit
def _seen_from(cloud, neighbors, points, centers):
    """Neighbours of the centres, slots first; their lists; ways to the points, in blocks."""
    lists = Rows(neighbors.indices[centers], neighbors.mask[centers], neighbors.radius)
    return lists.indices.T, lists, in_blocks((points - cloud.points[centers]).T, block(READ))


@Pieces
def _of_blocks(blocks, count, degree: int):
    def weights(block):
        around, offset = Neighborhood.of(*block[0]), block[1]
        plane = TangentPlane.of(around, degree)
        place = jnp.sum(plane.tangents * offset, axis=1) / plane.width
        wanted = monomials(place, degree)[1:, None]
        eta, _, residual = moment_solve(plane.points, plane.weights, wanted, 1, degree)
        return jnp.where(around.mask, with_center(eta)[0].at[0].add(1), 0), residual

    return blockwise(weights, blocks, count)


@host_jit
def distance_and_reach(cloud, neighbors, points, centers):
    """How far points are from those of the cloud next to them, and how far these's lists reach."""
    x, points = constant((cloud.points, points))
    center, xp = x[centers], namespace(x)
    squared = lambda vectors: xp.einsum("...d,...d->...", vectors, vectors)
    away = xp.where(neighbors.mask[centers].T, squared(x[neighbors.indices[centers].T] - center), 0)
    return xp.sqrt(squared(points - center)), xp.sqrt(xp.max(away, axis=0))


@host_jit
def beyond(distance, reach):
    """Whether something is farther than it may be, or no number."""
    return ~(distance <= reach)


@host_jit
def _summed(weights, slots, u):
    if namespace(weights) is np:
        columns = np.moveaxis(u, 0, -1)
        return np.moveaxis(sum(w * columns[..., s] for w, s in zip(weights, slots)), -1, 0)
    weights = weights.reshape(*weights.shape, *(1,) * (u.ndim - 1))
    add = lambda total, slot: (total + slot[0] * u[slot[1]], None)
    zero = jnp.zeros((slots.shape[1], *u.shape[1:]), jnp.result_type(weights, u))
    return jax.lax.scan(add, zero, (weights, slots))[0]
