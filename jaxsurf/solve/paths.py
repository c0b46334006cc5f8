"""Shortest paths from sources along the lists of neighbours, and the points next to them."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import cKDTree

from ..arguments import switched_off
from ..cloud import PointCloud
from ..compiling import power_of_two
from ..failures import is_concrete, needs_values, raise_at, warn

# The share by which more than so large a share of distances falls short of straight lines. (Some do
# where fronts meet next to a source.)
_SHORT, _FEW = 0.05, 0.01


def source_indices(sources, cloud: PointCloud) -> Int[np.ndarray, " m"]:
    """Sources given as a mask or as indices, as sorted indices; else an error."""
    n = cloud.n
    # Arrays that jnp makes in compiled code are traced, constants too.
    instead = "under jit, vmap and grad make them with np.array, not with jnp.array"
    needs_values("sources", sources, instead=instead)
    sources = np.asarray(sources)
    if sources.dtype == bool:
        if sources.shape != (n,):
            raise ValueError(f"mask of sources has shape {sources.shape}, expected ({n},)")
        sources = np.flatnonzero(sources)
    elif sources.ndim != 1 or (sources.size and sources.dtype.kind not in "iu"):
        raise TypeError(
            f"sources is an array of {sources.dtype} of shape {sources.shape}, expected a mask or "
            "indices"
        )
    sources = np.unique(sources)
    if not sources.size:
        raise ValueError("no sources: at least one point is needed")
    if not (0 <= sources[0] and sources[-1] < n):
        wrong = sources[0] if sources[0] < 0 else sources[-1]
        raise ValueError(f"source {wrong} is not among the points 0 to {n - 1}")
    if cloud.active is not None:
        needs_values("cloud.active, which decides where paths lead to,", cloud.active)
        raise_at(~cloud.host_active[sources], "source {v} is switched off", sources)
    return sources


def path_lengths(points, neighbors, indices, mask, sources, off) -> Float[Array, " n"]:
    """Length of the shortest path from a source along neighbours; that there is one is checked."""
    concrete = is_concrete(points)
    row, slot = np.nonzero(mask & (indices != np.arange(len(indices))[:, None]))
    # SciPy 1.14 takes no wider index.
    row, column = row.astype(np.int32), indices[row, slot].astype(np.int32)
    length = np.ones(len(row))
    if concrete:
        x = np.asarray(points, float)
        length = np.linalg.norm(x[column] - x[row], axis=1)
    links = csr_array((length, (column, row)), shape=(len(indices), len(indices)))
    path = dijkstra(links, indices=sources, min_only=True)
    path[off] = 0
    raise_at(~np.isfinite(path), "no path along neighbours leads from the sources to point {i}")
    if concrete:
        return jax.device_put(path.astype(points.dtype))
    return switched_off(~off, _relaxed(points, neighbors, sources))


@eqx.filter_jit
def _relaxed(points, neighbors, sources):
    """Length of the shortest path from a source along neighbours, by relaxation."""
    edge = jnp.linalg.norm(points[neighbors.indices] - points[:, None], axis=2)
    edge = jnp.where(neighbors.mask, edge, jnp.inf)

    def relax(carry):
        length, _ = carry
        shorter = jnp.min(length[neighbors.indices] + edge, axis=1)
        return shorter, jnp.any(shorter < length)

    start = jnp.full(len(points), jnp.inf, points.dtype).at[sources].set(0)
    return jax.lax.while_loop(lambda carry: carry[1], relax, (start, jnp.array(True)))[0]


def around(indices, sources):
    """Points next to a source, and for each the sources that it is next to.

    Both are filled up with copies to one of few sizes, so that few programs are compiled.
    """
    k = indices.shape[1]
    pairs = np.stack([indices[sources].ravel(), np.repeat(sources, k)], axis=1)
    near, row = np.unique(pairs[:, 0], return_inverse=True)
    order = np.argsort(row, kind="stable")
    row, owner = row[order], pairs[order, 1]
    first = np.searchsorted(row, np.arange(len(near)))
    place = np.arange(len(row)) - first[row]
    owners = np.tile(owner[first][:, None], power_of_two(int(place.max()) + 1))
    owners[row, place] = owner
    full = np.minimum(np.arange(min(power_of_two(len(near)), len(indices))), len(near) - 1)
    return near[full].astype(np.int32), owners[full].astype(np.int32)


def tell_short(cloud: PointCloud, sources, distance) -> None:
    """Warn of many distances that are shorter than straight lines."""
    points = np.asarray(cloud.points, float)
    straight = cKDTree(points[sources]).query(points)[0]
    far = cloud.host_active & (straight > 0)
    share = np.where(far, distance / np.where(far, straight, 1), 1)
    short, i = int(np.sum(share < 1 - _SHORT)), int(share.argmin())
    if short > _FEW * np.sum(far):
        warn(
            f"the distances of {short} points are shorter than the straight line, that of point "
            f"{i} is {share[i]:.2f} of it: directions on neighbouring points do not agree, as "
            "where a surface has texture finer than its points. Use more of them there"
        )
