r"""Weights that integrate over a surface, of high order.

The surface is cut into the cells of the points, $\{x : |x - x_i| \le |x - x_j|\}$. In the tangent
plane of its point a cell is a polygon, whose sides are slightly curved; with the surface as a graph
over that plane, fitted to the neighbours, the moments of the cell are found by Gauss's rule.
A function is integrated over a cell as its local polynomial is: from these moments come weights of
all neighbours, exactly as those of a derivative come from its values on monomials
(`fits/moments.py`). Their sums over all cells integrate over the surface.

At a border cells end at straight lines along it, two at a convex corner: those at the first border
point in the list of each point.
"""

from __future__ import annotations

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from .blocks import blocks_of, rows_of
from .build import determined
from .cloud import PointCloud
from .compiling import Pieces, host_jit, kept, namespace, sized_jit, stored
from .failures import is_concrete, refuse, warn
from .fits.graph import Graph
from .fits.moments import blockwise, in_blocks, moment_solve
from .fits.monomials import polynomial_count
from .fits.plane import Neighborhood
from .fits.polygon import Lines, Sides, moments_over, ways_of
from .machine import CELLS, block
from .neighbors import Neighbors
from .stencils.method import AbstractMethod, with_center

# So many neighbours may bound a cell; where points are very uneven, all are tried.
_SIDES = 24


class Cells(NamedTuple):
    """The cells of all points, or of those of a block.

    Args:
        weights: of the neighbours in the integral over each cell.
        sizes: their areas.
        closed: whether each is bounded by neighbours so near that no other point can have a part of
            it.
        residual: the relative moment residual of its weights.
    """

    weights: Float[Array, "k *p"]
    sizes: Float[Array, "*p"]
    closed: Bool[Array, "*p"]
    residual: Float[Array, "*p"]


class Cut(eqx.Module):
    """How the cells of a block of points are cut out of the surface.

    Args:
        degree: of the polynomials.
        sides: the first so many neighbours may bound a cell, the point itself included.
    """

    degree: int = eqx.field(static=True)
    sides: int = eqx.field(static=True)

    def __call__(self, around: Neighborhood, lines: Lines | None = None) -> Cells:
        """Of a block, and the lines where the surface ends."""
        plane, graph = Graph.of(around, self.degree)
        on = around.mask[0]
        sides = Sides.of(plane, around.mask, self.sides, lines)
        ways, room = jax.tree.map(kept, ways_of(jax.lax.stop_gradient(sides)))
        moments, reach = moments_over(sides, graph, ways)
        moments = stored(moments, plane.width[0] < 0)
        unit = plane.width ** len(plane.points)
        # The fit knows differences from the point itself: the constant is the area times its value.
        b = moments[1:, None]
        eta, _, residual = moment_solve(plane.points, plane.weights, b, 1, self.degree)
        area = jnp.where(on, unit * moments[0], 0)
        eta = with_center(unit * eta)[0].at[0].add(area)
        weights, residual = jnp.where(around.mask, eta, 0), jnp.where(on, residual, 0)
        return Cells(weights, area, (4 * reach <= room) | ~on, residual)


def cut_by(neighbors: Neighbors, method: AbstractMethod, dim: int) -> Cut:
    """The usual one; where points are uneven, by all neighbours.

    Traced ones cannot be asked whether these close their cells.
    """
    degree = method.polynomial_degree
    need = polynomial_count(dim - 1, degree)
    if neighbors.k < need:
        raise ValueError(
            f"k = {neighbors.k} neighbours, polynomials of degree {degree} need at least {need}"
        )
    return Cut(degree, neighbors.k if neighbors.near is not None else min(_SIDES, neighbors.k))


def cells_of(cloud: PointCloud, neighbors: Neighbors, method: AbstractMethod, border) -> Cells:
    """All cells; if the usual number of neighbours closes not all of them, by all neighbours."""
    cut, size = cut_by(neighbors, method, cloud.dim), block(CELLS)
    neighbors = neighbors.nearest
    lines = None if border is None else _lines(cloud, neighbors, border)
    lines = jax.tree.map(lambda a: in_blocks(a, size), lines)
    blocks = blocks_of(cloud, neighbors, np.arange(cloud.n, dtype=np.int32), size)

    def by(cut: Cut) -> Cells:
        return cells_in_rows(_cells_of_blocks((blocks, lines), cut), cloud.n)

    cells = by(cut)
    if is_concrete(cells.closed) and not np.asarray(cells.closed).all() and cut.sides < neighbors.k:
        return by(Cut(cut.degree, neighbors.k))
    return cells


@sized_jit
def _lines(cloud: PointCloud, neighbors: Neighbors, border) -> Lines:
    """Of the first border point in the list of each point."""
    x = cloud.points
    edges = jnp.zeros((2, *x.shape), x.dtype).at[:, border.points].set(border.edges(cloud))
    marked = jnp.zeros(cloud.n, bool).at[border.points].set(True)
    seen = marked[neighbors.indices] & neighbors.mask
    first = jnp.take_along_axis(neighbors.indices, jnp.argmax(seen, axis=1)[:, None], axis=1)[:, 0]
    outward = jnp.where(jnp.any(seen, axis=1)[:, None], edges[:, first], 0)
    along = lambda a: jnp.sum(outward * a, axis=2)
    return Lines(outward.swapaxes(1, 2), along(cloud.normals), along(x[first] - x))


def cells_in_rows(blocks: Cells, count: int) -> Cells:
    """Out of their blocks."""
    weights, others = rows_of(blocks.weights, blocks[1:], count)
    return Cells(weights, *others)


@Pieces
def _cells_of_blocks(blocks, count, cut: Cut) -> Cells:
    return blockwise(lambda block: cut(Neighborhood.of(*block[0]), block[1]), blocks, count)


def areas(cells: Cells, neighbors: Neighbors, degree: int) -> Float[Array, " n"]:
    """Weights of the points in integrals over the surface."""
    neighbors = neighbors.nearest
    more = 2 * neighbors.k
    text = (
        "the neighbours of point {i} do not close its cell, out of {v} of them: mark the "
        "border of the surface (`boundary`), or, where there is none, take more neighbours, "
        f"js.discretize(cloud, js.find_neighbors(cloud, k={more})); in folds of a scan that is of "
        "no use, but surface.cell_areas @ u integrates to second order"
    )
    bad, count = _open(cells.closed, neighbors.mask)
    found = refuse(_summed(cells.weights, neighbors.indices), bad, text, count)
    return determined(found, cells.residual, degree)


def cell_areas(cells: Cells, neighbors: Neighbors) -> Float[Array, " n"]:
    """Areas of the cells themselves.

    Where neighbours do not close a cell, as at folds of a scan, the mean of theirs, with a warning.
    """
    closed = cells.closed
    if is_concrete(closed) and not np.asarray(closed).all():
        warn(
            f"the cells of {int((~closed).sum())} points, the first {int(jnp.argmin(closed))}, "
            "are not closed by their neighbours and are given the mean area of theirs: is a "
            "border not marked?"
        )
    sizes, bad = _completed(cells.sizes, closed, neighbors.nearest)
    return refuse(sizes, bad, "the cell of point {i} has the area {v}", sizes)


@host_jit
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


@host_jit
def _open(closed, mask):
    """Whether cells are not closed, and out of how many neighbours."""
    return ~closed, mask.sum(axis=1)


@host_jit
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
