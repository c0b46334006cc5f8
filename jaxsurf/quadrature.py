r"""Weights that integrate over a surface, of high order.

The surface is cut into the cells of the points, $\{x : |x - x_i| \le |x - x_j|\}$. In the tangent
plane of its point a cell is a polygon, whose sides are slightly curved; with the surface as a graph
over that plane, fitted to the neighbours, the moments of the cell are found by Gauss's rule.
A function is integrated over a cell as its local polynomial is: from these moments come weights of
all neighbours, exactly as those of a derivative come from its values on monomials
(`fits/moments.py`). Their sums over all cells integrate over the surface.
"""

from __future__ import annotations

import functools
import warnings
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.special
from jaxtyping import Array, Bool, Float

from .build import blocks_of, determined, neighborhood, rows_of
from .cloud import PointCloud
from .compiling import sized_jit
from .failures import is_concrete, refuse
from .fits.graph import Graph, polynomial
from .fits.moments import blockwise, in_blocks, moment_solve
from .fits.monomials import monomials_by_degree, polynomial_count
from .fits.plane import TangentPlane
from .neighbors import Neighbors
from .stencils.method import AbstractMethod, with_center

_BATCH = 128
# Newton steps from cells with straight sides to those on the surface: each squares what is left of
# an error of the size (spacing x curvature)^2.
_STEPS = 2
# Sides that it puts so much farther out than straight ones, or behind the point, are not found.
_STRETCH = 2.0
# So many neighbours may bound a cell; where points are very uneven, all are tried.
_CELLS = 24
# Of these so many are its sides at most, or half of those that are tried.
_SIDES = 16


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


def areas(
    cloud: PointCloud,
    neighbors: Neighbors,
    degree: int,
    outward: Float[Array, "n d"] | None,
) -> Float[Array, " n"]:
    """Weights of the points in integrals over the surface; arguments as of `cell_weights`."""
    look = lambda cells: cell_weights(cloud, neighbors, degree, cells, outward)
    weights, closed, residual = _by_enough(look, neighbors.k)
    text = (
        "the neighbours of point {i} do not close its cell, out of {v} of them: mark the "
        "border of the surface (`boundary`), or choose more neighbours"
    )
    weights = refuse(weights, ~closed, text, jnp.sum(neighbors.mask, axis=1))
    return _summed(determined(weights, residual, degree), neighbors.indices.T)


def cell_areas(
    cloud: PointCloud,
    neighbors: Neighbors,
    degree: int,
    outward: Float[Array, "n d"] | None,
) -> Float[Array, " n"]:
    """Areas of the cells themselves, arguments as of `cell_weights`.

    Where neighbours do not close a cell, as at folds of a scan, the mean of theirs, with a warning.
    """
    look = lambda cells: _cell_sizes(cloud, neighbors, degree, cells, outward)
    sizes, closed = _by_enough(look, neighbors.k)
    if is_concrete(closed) and not closed.all():
        warnings.warn(
            f"the cells of {int((~closed).sum())} points, the first {int(jnp.argmin(closed))}, "
            "are not closed by their neighbours and are given the mean area of theirs: is a "
            "border not marked?",
            stacklevel=4,
        )
    sizes, bad = _completed(sizes, closed, neighbors)
    return refuse(sizes, bad, "the cell of point {i} has the area {v}", sizes)


@jax.jit
def _completed(sizes, closed, neighbors):
    """With the mean of the neighbours in place of what is not closed; where there is none."""
    good = closed & (sizes > 0)
    counted = neighbors.mask & good[neighbors.indices]
    total = jnp.sum(jnp.where(counted, sizes[neighbors.indices], 0), axis=1)
    mean = total / jnp.maximum(jnp.sum(counted, axis=1), 1)
    on = neighbors.mask[:, 0]
    sizes = jnp.where(good | ~on, sizes, mean)
    return sizes, on & ~(sizes > 0)


def _by_enough(look: Callable, k: int):
    """What the usual number of sides gives; where that closes not all cells, all neighbours."""
    found = look(_CELLS)
    closed = found[1]
    return look(k) if is_concrete(closed) and not closed.all() else found


@jax.jit
def _summed(weights, indices):
    return jnp.zeros(weights.shape[1], weights.dtype).at[indices].add(weights)


def cell_weights(
    cloud: PointCloud,
    neighbors: Neighbors,
    degree: int,
    cells: int,
    outward: Float[Array, "n d"] | None,
) -> tuple[Float[Array, "k n"], Bool[Array, " n"], Float[Array, " n"]]:
    """Weights of the neighbours in the integral over each cell, and what may be wrong with it.

    Args:
        degree: of the polynomials.
        cells: the first so many neighbours may bound a cell, the point itself included.
        outward: conormals where the surface ends, zero elsewhere.

    Returns:
        Weights `(k, n)`; whether each cell is bounded by neighbours so near that no other
        point can have a part of it; the relative moment residual of its weights.
    """
    planes, mask, moments, closed = _cells(cloud, neighbors, degree, cells, outward)
    weights, residual = _weights_of_blocks(planes, mask, moments, degree)
    weights, (closed, residual) = rows_of(weights, (closed, residual), cloud.n)
    return weights, *_where_on(neighbors.mask, closed, residual)


def _cell_sizes(cloud, neighbors, degree, cells, outward):
    planes, _, moments, closed = _cells(cloud, neighbors, degree, cells, outward)
    sizes = _scaled(planes.width, planes.points.shape[1], moments)
    _, (sizes, closed) = rows_of(moments, (sizes, closed), cloud.n)
    closed, sizes = _where_on(neighbors.mask, closed, sizes)
    return sizes, closed


@functools.partial(jax.jit, static_argnums=1)
def _scaled(width, dim: int, moments):
    return width**dim * moments[:, 0]


@jax.jit
def _where_on(mask, closed, values):
    on = mask[:, 0]
    return closed | ~on, jnp.where(on, values, 0)


def _cells(cloud, neighbors, degree, cells, outward):
    """Planes, masks and moments of all cells in blocks, and whether they are closed."""
    blocks = blocks_of(cloud, neighbors, np.arange(cloud.n, dtype=np.int32), _BATCH)
    lines = None if outward is None else in_blocks(outward.T, _BATCH)
    mask, cells = blocks[2], min(cells, neighbors.k)
    # Programs of their own: in one, the compiler finds much again for every use of it, and a
    # derivative took fifteen times as long as the value.
    planes, graphs = _surfaces(blocks, degree)
    ways = _ways_of_blocks(*jax.lax.stop_gradient((planes, mask, lines)), cells)
    return planes, mask, *_moments_of_blocks(planes, graphs, mask, lines, ways, cells)


@sized_jit
def _surfaces(blocks, degree: int):
    """The tangent planes, and the surface as a polynomial over each."""

    def fit(block):
        plane = TangentPlane.of(neighborhood(block), degree)
        return plane, Graph(plane.surface(1, degree)[0], degree, len(plane.points))

    return blockwise(fit, blocks)


@sized_jit
def _ways_of_blocks(planes, mask, lines, cells: int):
    def ways(block):
        plane, mask, line = block
        sides = Sides.of(plane, mask, cells, line)
        return _ways_of_curve(sides) if len(sides.flat) == 1 else _ways(sides)

    return blockwise(ways, (planes, mask, lines))


@sized_jit
def _moments_of_blocks(planes, graphs, mask, lines, ways, cells: int):
    def moments(block):
        plane, graph, mask, line, (ways, room) = block
        found, reach = _moments(Sides.of(plane, mask, cells, line), graph, ways)
        return found, 4 * reach <= room

    return blockwise(moments, (planes, graphs, mask, lines, ways))


@sized_jit
def _weights_of_blocks(planes, mask, moments, degree: int):
    def weights(block):
        plane, mask, moments = block
        unit = plane.width ** len(plane.points)
        # The fit knows differences from the point itself: the constant is the area times its value.
        eta, _, residual = moment_solve(plane.points, plane.weights, moments[1:, None], 1, degree)
        area = jnp.where(mask[0], unit * moments[0], 0)
        eta = with_center(unit * eta)[0].at[0].add(area)
        return jnp.where(mask, eta, 0), residual

    return blockwise(weights, (planes, mask, moments))


class Sides(eqx.Module):
    r"""What bounds a cell: the planes $x\cdot d = b$ half way to its neighbours.

    Args:
        flat: d along the tangents.
        high: d along the normal.
        offset: b.
        on: which of them count.
    """

    flat: Float[Array, "t r *p"]
    high: Float[Array, "r *p"]
    offset: Float[Array, "r *p"]
    on: Bool[Array, "r *p"]

    @classmethod
    def of(cls, plane: TangentPlane, mask, cells: int, outward) -> Sides:
        """Those of the first neighbours, and at the end of a surface the line of its border."""
        flat, high, on = plane.points[:, 1:cells], plane.heights[1:cells], mask[1:cells]
        offset = (jnp.sum(flat**2, axis=0) + high**2) / 2
        if outward is not None:
            line = jnp.sum(plane.tangents * outward, axis=1)[:, None]
            flat = jnp.concatenate([flat, line], axis=1)
            high, offset = (jnp.pad(a, [(0, 1)] + [(0, 0)] * (a.ndim - 1)) for a in (high, offset))
            on = jnp.concatenate([on, jnp.any(line != 0, axis=0)])
        return cls(flat, high, jnp.where(on, offset, 0), on)

    def chosen(self, which) -> Sides:
        """One of them at every place, by number."""
        pick = lambda a: jnp.take_along_axis(a, which, axis=0)
        flat = jnp.stack([pick(a) for a in self.flat])
        return Sides(flat, pick(self.high), pick(self.offset), jnp.ones_like(which, bool))

    def miss(self, graph: Graph, q):
        """How far the points of the surface over q are beyond them, and the slope of that."""
        z, slope = graph.at(q)
        beyond = jnp.sum(q * self.flat, axis=0) + z * self.high - self.offset
        return beyond, self.flat + slope * self.high


def _moments(sides: Sides, graph: Graph, ways):
    r"""$\int q^\gamma\,dA$ over a cell for all monomials up to the degree, and how far it reaches.

    The latter squared.
    """
    if graph.dim == 1:
        found, reach = _along_ways(sides.chosen(ways[2]), graph, *ways[:2])
        # The nearest to either side bound a curve's cell, if it is found at all.
        return found, jnp.where(reach < jnp.inf, 0, reach)
    side, still = ways
    count, few = len(side), len(side) // 2
    after = jnp.where(still, side[:1], jnp.roll(side, -1, axis=0))
    # Few cells have sides in the second half, and most blocks have none of these. The one before
    # each half has the corner at which it begins.
    halves = np.minimum(np.arange(0, count, few)[:, None] + np.arange(-1, few), count - 1)
    ended = [jnp.zeros((), bool), *(jnp.all(still[row[0]]) for row in halves[1:])]

    def half(these):
        side, after, ended = these
        none = jnp.zeros((size, *side.shape[1:]), graph.coefficients.dtype)
        of_sides = lambda: _over_sides(sides.chosen(side), sides.chosen(after), graph)
        return jax.lax.cond(ended, lambda: (none, none[0]), of_sides)

    size = polynomial_count(graph.dim, graph.degree)
    found, reach = jax.lax.map(half, (side[halves], after[halves], jnp.stack(ended)))
    return jnp.sum(found, axis=0), jnp.max(reach, axis=0)


def _over_sides(these: Sides, those: Sides, graph: Graph):
    """What triangles between the point and each side add to the moments of a cell.

    Args:
        these: sides in turn, of which the first is that before.
        those: what cuts each of them off.
    """

    def newton(q, these, those, graph):
        (u, a), (v, b) = these.miss(graph, q), those.miss(graph, q)
        return q - _meeting(u, v, *jax.lax.stop_gradient((a, b)))

    straight = _meeting(these.offset, those.offset, these.flat, those.flat)
    corners = _root(newton, jax.lax.stop_gradient(straight), these, those, graph)
    first, last = corners[:, :-1], corners[:, 1:]
    turn = first[0] * last[1] - first[1] * last[0]
    share, weights = _gauss(_nodes(graph), 0)
    ends = jnp.concatenate([first + x * (last - first) for x in share], axis=1)
    again = jax.tree.map(lambda a: jnp.concatenate([a[..., 1:, :]] * len(share), axis=-2), these)
    found, reach = _along_ways(again, graph, ends, jnp.concatenate([w * turn for w in weights]))
    corners = jnp.max(jnp.sum(jax.lax.stop_gradient(corners) ** 2, axis=0), axis=0)
    return found, jnp.maximum(corners, reach)


def _along_ways(sides: Sides, graph: Graph, ends, measure):
    """The moments from those of ways that end at sides, and how far these reach, squared.

    That is infinite where the surface bends so much within the cell that a side is not found.

    Args:
        ends: of the ways if the sides were straight.
        measure: what each stands for then.
    """
    degree, nodes = graph.degree, _nodes(graph)

    def newton(length, sides, graph, ends):
        beyond, slope = sides.miss(graph, length * ends)
        rate = jax.lax.stop_gradient(jnp.sum(slope * ends, axis=0))
        return length - beyond / jnp.where(rate > 0, rate, 1)

    length = _root(newton, jnp.ones_like(measure), sides, graph, ends)
    ends = length * ends
    measure = measure * length**graph.dim

    # Along a way each monomial is a power.
    rows = monomials_by_degree(ends, degree)
    at, share = (np.array(a, length.dtype) for a in _gauss(nodes, graph.dim - 1))
    powers = at ** np.arange(degree + 1)[:, None].astype(length.dtype)
    square = jnp.ones((nodes, *length.shape), length.dtype)
    for slope in graph.slopes:
        along = jnp.stack([polynomial([c], [row]) for c, row in zip(slope, rows)])
        square = square + jnp.tensordot(powers[:-1].T, along, 1) ** 2
    sums = jnp.tensordot(powers * share, jnp.sqrt(square), 1) * measure
    found = [jnp.sum(row * total, axis=1) for row, total in zip(rows, sums)]
    length, ends = jax.lax.stop_gradient((length, ends))
    resolved = (length > 0) & (length < _STRETCH)
    reach = jnp.where(resolved, jnp.sum(ends**2, axis=0), jnp.inf)
    # The line of a border passes through the point: there is nothing between them.
    reach = jnp.where(sides.offset > 0, reach, 0)
    return jnp.concatenate(found), jnp.max(reach, axis=0)


def _nodes(graph: Graph) -> int:
    """Of Gauss's rule: exact for the polynomials of the surface."""
    return graph.degree // 2 + 1


def _ways(sides: Sides):
    """The sides of a cell in turn.

    Returns:
        Their numbers, and whether each is the last; and the square of twice as far as the cell may
        reach: no point beyond the neighbours looked at can then have a part of it. Negative where
        it is not closed.
    """
    side, following, closed = _round(sides.flat, sides.offset, sides.on)
    away = jnp.where(sides.on & (sides.offset > 0), jnp.sum(sides.flat**2, axis=0), 0)
    return (side, following == side[0]), jnp.where(closed, jnp.max(away, axis=0), -1)


def _meeting(u, v, a, b):
    r"""Where two lines meet, those of $q\cdot a = u$ and of $q\cdot b = v$."""
    size = a[0] * b[1] - a[1] * b[0]
    return jnp.stack([b[1] * u - a[1] * v, a[0] * v - b[0] * u]) / jnp.where(size == 0, 1, size)


def _round(flat, offset, on):
    """Once round a cell, counter-clockwise from its nearest side: each side, and what cuts it off.

    Where there are fewer sides than steps, the last of them stand still.
    """
    squared = jnp.sum(flat**2, axis=0)
    on = on & (squared > 0)
    foot = offset / jnp.where(on, squared, 1)
    numbers = np.arange(len(on), dtype=np.int32)[:, None]

    def least(a):
        # `argmin` takes several times as long.
        low = jnp.min(a, axis=0)
        return jnp.min(jnp.where(a == low, numbers, len(a) - 1), axis=0), low < jnp.inf

    def advance(state):
        side, following, found = state
        side = jnp.where(following == start, side, following)
        # Side j is f d_j + t c with c perpendicular to d_j, of which all others cut off a part.
        x, y, f = (jnp.take_along_axis(a, side[None], axis=0)[0] for a in (*flat, foot))
        cross = x * flat[1] - y * flat[0]
        cuts = on & (cross > 0) & (numbers != side)
        room = offset - f * (x * flat[0] + y * flat[1])
        following, cut = least(jnp.where(cuts, room / jnp.where(cuts, cross, 1), jnp.inf))
        return side, following, found & cut

    def step(state, first):
        state = jax.lax.cond(first | jnp.any(state[1] != start), advance, lambda s: s, state)
        return state, state[:2]

    start, found = least(jnp.where(on, foot * offset, jnp.inf))
    firsts = np.arange(max(_SIDES, len(on) // 2)) == 0
    state, (side, following) = jax.lax.scan(step, (start, start, found), firsts)
    return side, following, state[2] & (state[1] == start)


def _ways_of_curve(sides: Sides):
    """The ways to either side of a curve's cell, and the numbers of these; room as above."""
    # The product of an end and the way to it does not depend on the end.
    flat, offset, on = sides.flat[0], sides.offset, sides.on
    at = offset / jnp.where(flat == 0, 1, flat)
    after = jnp.where(on & (flat > 0), at, jnp.inf)
    before = jnp.where(on & (flat < 0), at, -jnp.inf)
    ends = jnp.stack([jnp.max(before, axis=0), jnp.min(after, axis=0)])
    which = jnp.stack([jnp.argmax(before, axis=0), jnp.argmin(after, axis=0)])
    closed = jnp.all(jnp.isfinite(ends), axis=0)
    ends = jnp.where(jnp.isfinite(ends), ends, 0)
    return (ends[None], jnp.abs(ends), which), jnp.where(closed, 0, -1)


def _root(newton: Callable, start, *known):
    """The end of some Newton steps, of which the last has the derivative of the root."""
    fixed = jax.lax.stop_gradient(known)
    near = jax.lax.fori_loop(0, _STEPS, lambda _, x: newton(x, *fixed), start)
    # Without the barrier the compiler finds the value again for every use of it.
    return jax.lax.optimization_barrier(newton(jax.lax.stop_gradient(near), *known))


@functools.cache
def _gauss(nodes: int, power: int) -> tuple[list[float], list[float]]:
    r"""Gauss's rule for $\int_0^1 s^p f(s)\,ds$."""
    x, w = scipy.special.roots_jacobi(nodes, 0, power)
    return ((1 + x) / 2).tolist(), (w / 2 ** (power + 1)).tolist()
