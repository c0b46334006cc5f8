"""Points sorted along a space-filling curve, so that neighbours in space are close in memory."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

from jaxsurf.arguments import POINTS, instance, on_host
from jaxsurf.cloud import PointCloud
from jaxsurf.failures import needs_values, not_finite, raise_at

# 16 bits an axis tell 65,536 steps along the longest side apart: finer than any surface cloud
# that fits in memory, and a key of at most 48 bits.
_BITS = 16


def sort_points(points) -> np.ndarray:
    """Order of the points along a Hilbert curve through their bounding cube.

    Stencils gather neighbours; with points in this order the gathers stay within the cache.
    Runs on the host.

    Args:
        points: positions, `(n, d)` with d = 2 or 3, concrete and finite.

    Returns:
        Permutation `(n,)`: `points[order]` is sorted.

    Raises:
        ValueError: wrong shape, traced arrays, or a point that is not finite, named by index.

    Source: J. Skilling, *Programming the Hilbert curve*, AIP Conf. Proc. 707 (2004).

    Example:
        >>> order = sort_points(np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [1.0, 1.0]]))
        >>> sorted(order.tolist())
        [0, 1, 2, 3]
    """
    needs_values("points", points, instead="sort before entering jit or grad")
    points = on_host(points, "points", *POINTS)
    raise_at(not_finite(points), "point {i} is not finite: {v}", points)
    if len(points) < 2:
        return np.arange(len(points))
    lower = points.min(axis=0)
    # One scale for all axes: the cells must be cubes for the curve to stay local.
    side = (points - lower).max() or 1.0
    cells = ((points - lower) / side * (2**_BITS - 1)).astype(np.uint64)
    return np.argsort(_hilbert_key(cells), kind="stable")


def sort_cloud(cloud: PointCloud) -> tuple[PointCloud, np.ndarray]:
    """A copy of the cloud sorted along a space-filling curve, with the permutation.

    Carry fields in with `sorted_field = field[order]`, and out again with
    `field = sorted_field[np.argsort(order)]`. Rows that are switched off go to the end.

    Args:
        cloud: any concrete cloud of n points.

    Returns:
        The sorted cloud, and `order` `(n,)`: row i of the sorted cloud is row `order[i]` of the
        given one.

    Raises:
        ValueError: the cloud is traced (sort outside `jit` and `grad`).

    Example:
        >>> cloud = js.PointCloud([[1.0, 0.0], [-1.0, 0.0], [0.9, 0.1]], [[1.0, 0.0]] * 3)
        >>> field = jnp.array([10.0, 20.0, 30.0])
        >>> tidy, order = js.sort_cloud(cloud)
        >>> bool((tidy.points == cloud.points[order]).all())
        True
        >>> field[order][np.argsort(order)].tolist()
        [10.0, 20.0, 30.0]
    """
    instance(cloud, PointCloud, "cloud", "js.PointCloud(points, normals) makes one")
    needs_values("cloud", cloud, instead="sort before entering jit or grad")
    on = cloud.host_active
    rows = np.flatnonzero(on)
    order = np.concatenate([rows[sort_points(np.asarray(cloud.points)[rows])], np.flatnonzero(~on)])
    return cloud.permuted(jnp.asarray(order)), order


def _hilbert_key(cells: np.ndarray) -> np.ndarray:
    """Position along the Hilbert curve of cells with integer coordinates below 2**_BITS."""
    x = [cells[:, axis].copy() for axis in range(cells.shape[1])]
    one = np.uint64(1)
    # From the coarsest cube to the finest: undo the reflections and exchanges of axes by which
    # the curve in each sub-cube differs from the one in the whole.
    for bit in range(_BITS - 1, 0, -1):
        q = one << np.uint64(bit)
        below = q - one
        for axis in range(len(x)):
            upper = (x[axis] & q) != 0
            swap = np.where(upper, np.uint64(0), (x[0] ^ x[axis]) & below)
            x[0] = np.where(upper, x[0] ^ below, x[0] ^ swap)
            if axis:
                x[axis] = x[axis] ^ swap
    # Gray code across the axes.
    for axis in range(1, len(x)):
        x[axis] ^= x[axis - 1]
    flip = np.zeros_like(x[0])
    for bit in range(_BITS - 1, 0, -1):
        q = one << np.uint64(bit)
        flip = np.where((x[-1] & q) != 0, flip ^ (q - one), flip)
    key = np.zeros_like(x[0])
    for bit in range(_BITS - 1, -1, -1):
        for coordinate in x:
            key = (key << one) | (((coordinate ^ flip) >> np.uint64(bit)) & one)
    return key
