r"""Weights that integrate over a surface, of high order.

The surface is cut into the cells of the points, $\{x : |x - x_i| \le |x - x_j|\}$. In the tangent
plane of its point a cell is a polygon, whose sides are slightly curved; with the surface as a graph
over that plane, fitted to the neighbours, the moments of the cell are found by Gauss's rule.
A function is integrated over a cell as its local polynomial is: from these moments come weights of
all neighbours, exactly as those of a derivative come from its values on monomials
(`fits/moments.py`). Their sums over all cells integrate over the surface.
"""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from .build import blocks_of, determined, rows_of
from .cloud import PointCloud
from .compiling import copying_jit, kept, namespace, sized_jit, stored
from .failures import is_concrete, refuse, warn
from .fits.graph import Graph
from .fits.moments import blockwise, in_blocks, moment_solve, out_of_blocks
from .fits.monomials import polynomial_count
from .fits.plane import Neighborhood, TangentPlane
from .fits.polygon import Sides, moments_over, ways_of
from .machine import CELLS, block
from .neighbors import Neighbors
from .stencils.method import AbstractMethod, with_center

# So many neighbours may bound a cell; where points are very uneven, all are tried.
_CELLS = 24


def cells_of(cloud: PointCloud, neighbors: Neighbors, method: AbstractMethod, border):
    """Arguments of `areas` and `cell_areas`, looked at."""
    degree = method.polynomial_degree
    need = polynomial_count(cloud.dim - 1, degree)
    if neighbors.k < need:
        raise ValueError(
            f"k = {neighbors.k} neighbours, polynomials of degree {degree} need at least {need}"
        )
    if border is None:
        return cloud, neighbors, degree, None
    outward = jnp.zeros_like(cloud.points).at[border.points].set(border.conormals(cloud))
    return cloud, neighbors, degree, outward


def shares_fits(neighbors: Neighbors, method: AbstractMethod) -> bool:
    """Whether surfaces in blocks may come from where a method's stencils are built."""
    same = neighbors.near is None and block(method.batch_size) == block(CELLS)
    return method.shares_moments and same


def areas(
    cloud: PointCloud,
    neighbors: Neighbors,
    degree: int,
    outward: Float[Array, "n d"] | None,
    surfaces: tuple[TangentPlane, Graph] | None = None,
) -> Float[Array, " n"]:
    """Weights of the points in integrals over the surface; arguments as of `cell_weights`."""
    uneven, neighbors = neighbors.near is not None, neighbors.nearest
    look = lambda cells: cell_weights(cloud, neighbors, degree, cells, outward, surfaces)
    weights, closed, residual = _by_enough(look, neighbors.k, uneven)
    more = 2 * neighbors.k
    text = (
        "the neighbours of point {i} do not close its cell, out of {v} of them: mark the "
        "border of the surface (`boundary`), or, where there is none, take more neighbours, "
        f"js.discretize(cloud, js.find_neighbors(cloud, k={more})); in folds of a scan that is of "
        "no use, but surface.cell_areas @ u integrates to second order"
    )
    bad, count = _open(closed, neighbors.mask)
    found = refuse(_summed(weights, neighbors.indices), bad, text, count)
    return determined(found, residual, degree)


def cell_areas(
    cloud: PointCloud,
    neighbors: Neighbors,
    degree: int,
    outward: Float[Array, "n d"] | None,
    surfaces: tuple[TangentPlane, Graph] | None = None,
) -> Float[Array, " n"]:
    """Areas of the cells themselves, arguments as of `cell_weights`.

    Where neighbours do not close a cell, as at folds of a scan, the mean of theirs, with a warning.
    """
    uneven, neighbors = neighbors.near is not None, neighbors.nearest
    look = lambda cells: _cell_sizes(cloud, neighbors, degree, cells, outward, surfaces)
    sizes, closed = _by_enough(look, neighbors.k, uneven)
    if is_concrete(closed) and not np.all(closed):
        warn(
            f"the cells of {int((~closed).sum())} points, the first {int(jnp.argmin(closed))}, "
            "are not closed by their neighbours and are given the mean area of theirs: is a "
            "border not marked?"
        )
    sizes, bad = _completed(sizes, closed, neighbors)
    return refuse(sizes, bad, "the cell of point {i} has the area {v}", sizes)


@copying_jit
def _completed(sizes, closed, neighbors):
    """With the mean of the neighbours in place of what is not closed; where there is none."""
    xp = namespace(sizes)
    good = closed & (sizes > 0)
    counted = neighbors.mask & good[neighbors.indices]
    total = xp.sum(xp.where(counted, sizes[neighbors.indices], 0), axis=1)
    mean = total / xp.maximum(xp.sum(counted, axis=1), 1).astype(total.dtype)
    on = neighbors.mask[:, 0]
    sizes = xp.where(good | ~on, sizes, mean)
    return sizes, on & ~(sizes > 0)


def _by_enough(look: Callable, k: int, uneven: bool):
    """What the usual number of sides gives; where that closes not all cells, all neighbours.

    Uneven points are taken to need all, as traced ones cannot be asked.
    """
    if uneven:
        return look(k)
    found = look(_CELLS)
    closed = found[1]
    return look(k) if is_concrete(closed) and not np.all(closed) else found


@copying_jit
def _open(closed, mask):
    """Whether cells are not closed, and out of how many neighbours."""
    return ~closed, mask.sum(axis=1)


@copying_jit
def _summed(weights, indices):
    n, slots = weights.shape[1], indices.T
    if namespace(weights) is np:
        return np.bincount(slots.ravel(), weights.ravel(), n).astype(weights.dtype)
    return jnp.zeros(n, weights.dtype).at[slots].add(weights)


@jax.jit
def integral(areas, u):
    """Of a field or of each of its components."""
    return jnp.tensordot(areas, u, 1)


@jax.jit
def mean(areas, u):
    """Integral over area."""
    return integral(areas, u) / jnp.sum(areas)


def cell_weights(
    cloud: PointCloud,
    neighbors: Neighbors,
    degree: int,
    cells: int,
    outward: Float[Array, "n d"] | None,
    surfaces: tuple[TangentPlane, Graph] | None = None,
) -> tuple[Float[Array, "k n"], Bool[Array, " n"], Float[Array, " n"]]:
    """Weights of the neighbours in the integral over each cell, and what may be wrong with it.

    Args:
        degree: of the polynomials.
        cells: the first so many neighbours may bound a cell, the point itself included.
        outward: conormals where the surface ends, zero elsewhere.
        surfaces: the surface over each tangent plane, in blocks; None: to be fitted.

    Returns:
        Weights `(k, n)`; whether each cell is bounded by neighbours so near that no other
        point can have a part of it; the relative moment residual of its weights.
    """
    blocks = _blocks(cloud, neighbors, degree, outward, surfaces)
    weights, others = _weights_of_blocks(blocks, min(cells, neighbors.k), degree)
    weights, (closed, residual) = rows_of(weights, others, cloud.n)
    return weights, *_where_on(neighbors.mask, closed, residual)


def _cell_sizes(cloud, neighbors, degree, cells, outward, surfaces):
    blocks = _blocks(cloud, neighbors, degree, outward, surfaces)
    sizes, closed = _out_of_blocks(_sizes_of_blocks(blocks, min(cells, neighbors.k)), cloud.n)
    closed, sizes = _where_on(neighbors.mask, closed, sizes)
    return sizes, closed


@copying_jit
def _out_of_blocks(found, count: int):
    return jax.tree.map(lambda a: out_of_blocks(a, count), found)


@copying_jit
def _where_on(mask, closed, values):
    on = mask[:, 0]
    return closed | ~on, namespace(values).where(on, values, 0)


def _blocks(cloud, neighbors, degree, outward, surfaces):
    """Surfaces over the tangent planes, masks and lines of the border, in blocks."""
    size = block(CELLS)
    lines = None if outward is None else in_blocks(outward.T, size)
    if surfaces is None:
        rows = np.arange(cloud.n, dtype=np.int32)
        surfaces = _surfaces(blocks_of(cloud, neighbors, rows, size), degree)
    return *surfaces, _in_blocks(neighbors.mask, size), lines


@copying_jit
def _in_blocks(mask, size: int):
    return in_blocks(mask.T, size)


@sized_jit
def _surfaces(blocks, degree: int):
    return blockwise(lambda block: Graph.of(Neighborhood.of(*block), degree), blocks)


def _moments(block, cells: int):
    """Of a cell, and whether it is closed."""
    plane, graph, mask, line = block
    sides = Sides.of(plane, mask, cells, line)
    ways, room = jax.tree.map(kept, ways_of(jax.lax.stop_gradient(sides)))
    moments, reach = moments_over(sides, graph, ways)
    return stored(moments, plane.width[0] < 0), 4 * reach <= room


@sized_jit
def _sizes_of_blocks(blocks, cells: int):
    def size(block):
        moments, closed = _moments(block, cells)
        plane = block[0]
        return plane.width ** len(plane.points) * moments[0], closed

    return blockwise(size, blocks)


@sized_jit
def _weights_of_blocks(blocks, cells: int, degree: int):
    def weights(block):
        plane, _, mask, _ = block
        moments, closed = _moments(block, cells)
        unit = plane.width ** len(plane.points)
        # The fit knows differences from the point itself: the constant is the area times its value.
        eta, _, residual = moment_solve(plane.points, plane.weights, moments[1:, None], 1, degree)
        area = jnp.where(mask[0], unit * moments[0], 0)
        eta = with_center(unit * eta)[0].at[0].add(area)
        return jnp.where(mask, eta, 0), (closed, residual)

    return blockwise(weights, blocks)
