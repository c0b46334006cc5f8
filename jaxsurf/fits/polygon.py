r"""Cells of points in their tangent planes: polygons whose sides are slightly curved.

A cell is what is nearer to its point than to any other. Its sides are found as if they were
straight, each from the one before; Newton's method puts them on the surface, a graph over the
plane, and Gauss's rule sums over the ways from the point to them.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.special
from jaxtyping import Array, Bool, Float, Int

from .graph import Graph
from .moments import blockwise
from .monomials import monomial_rows, monomials_on_lines, multi_indices, polynomial_count
from .plane import TangentPlane
from .sums import spread, sums

# Newton steps from straight sides to those on the surface, each of which squares what is left of an
# error of the size (spacing x curvature)^2; and more where one of a block is not small by then.
_STEPS, _MORE = 3, 5
# Sides that it puts so much farther out than straight ones, or behind the point, are not found.
_STRETCH = 2.0
# Nor are roots so far away, in units of the kernel or of the straight way.
_LOST = 1e3
# Of the neighbours that are tried so many are its sides at most, or half of them.
_SIDES = 16


class Lines(eqx.Module):
    """Where a surface ends: those at the nearest point of its border.

    Args:
        outward: conormals there, zero for none; at a convex corner there are two.
        rise: of these along the normal of a cell's point.
        away: how far they are from that point, negative behind it.
    """

    outward: Float[Array, "r d *p"]
    rise: Float[Array, "r *p"]
    away: Float[Array, "r *p"]


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
    def of(cls, plane: TangentPlane, mask, cells: int, lines=None) -> Sides:
        """Those of the first neighbours, and at the end of a surface the lines of its border.

        Of a line at a distance, as of the image across it, unless others are nearer.
        """
        flat, high, on = plane.points[:, 1:cells], plane.heights[1:cells], mask[1:cells]
        offset = (jnp.sum(flat**2, axis=0) + high**2) / 2
        if lines is not None:
            away = lines.away / plane.width
            size = jnp.where(away > 0, 2 * away, 1)
            along = size * jnp.sum(plane.tangents[:, None] * lines.outward, axis=2)
            reach = jnp.max(jnp.where(on, jnp.sum(flat**2, axis=0), 0), axis=0)
            near = jnp.any(lines.outward != 0, axis=1) & (away >= 0) & (4 * away**2 <= reach)
            flat, on = jnp.concatenate([flat, along], axis=1), jnp.concatenate([on, near])
            high = jnp.concatenate([high, jnp.where(away > 0, size * lines.rise, 0)])
            offset = jnp.concatenate([offset, jnp.where(away > 0, 2 * away**2, 0)])
        return cls(flat, high, jnp.where(on, offset, 0), on)

    def chosen(self, *places: Int[Array, "s p"]) -> list[Sequence[Float[Array, "s p"]]]:
        """Those with the numbers at some places: d along each tangent, along the normal, and b."""
        values = jnp.stack([*self.flat, self.high, self.offset])
        (kinds, _, points), (rows, _) = values.shape, places[0].shape
        at = points * jnp.stack(places) + np.arange(points, dtype=np.int32)
        starts = np.arange(kinds, dtype=np.int32)[:, None, None] * values[0].size
        at = at[:, None] + starts
        found = values.reshape(-1).at[at].get(mode="promise_in_bounds", wrap_negative_indices=False)
        parts = jax.lax.split(found.reshape(-1, points), (rows,) * (len(places) * kinds))
        return [parts[i : i + kinds] for i in range(0, len(parts), kinds)]


def moments_over(sides: Sides, graph: Graph, ways):
    r"""$\int q^\gamma\,dA$ over a cell for all monomials up to the degree, and how far it reaches.

    The latter squared.
    """
    if graph.dim == 1:
        (end,), measure, which = ways
        (bounds,) = sides.chosen(which)
        given = [a[None] for a in (end, measure, *bounds, *graph.repeated(len(which)))]
        found, reach = _along_ways(graph, given[:1], given[1], given[2:5], given[5:])
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
        none = jnp.zeros((size, *side.shape[1:]), sides.offset.dtype)
        of_sides = lambda: _over_sides(graph, *sides.chosen(side, after))
        return jax.lax.cond(ended, lambda: (none, none[0]), jax.checkpoint(of_sides))

    size = polynomial_count(graph.dim, graph.degree)
    found, reach = blockwise(half, (side[halves], after[halves], jnp.stack(ended)))
    return jnp.sum(found, axis=0), jnp.max(reach, axis=0)


def _over_sides(graph: Graph, these, those):
    """What triangles between the point and each side add to the moments of a cell.

    Args:
        these: sides in turn, of which the first is that before.
        those: what cuts each of them off.
    """
    (*flat, high, offset), (*across, rise, room) = these, those
    coefficients = graph.repeated(len(high))
    # The planes of two sides meet in a line, which leans by so much over the plane: there the
    # height is a polynomial of the height.
    foot = _meeting(offset, room, flat, across)
    lean = [-along for along in _meeting(high, rise, flat, across)]
    missed: list = [0, 1] + [0] * (graph.degree - 1)
    for c, row in zip(coefficients, monomials_on_lines(foot, lean, graph.degree)[1:]):
        missed[: len(row)] = [total - c * a for total, a in zip(missed, row)]
    height, lost = _root(0, missed)
    corners = [start + height * along for start, along in zip(foot, lean)]

    share, weights = (np.array(a, high.dtype)[:, None, None] for a in _gauss(_nodes(graph), 0))
    # In one go: what is transposed to it are sums over the ways in one pass.
    given = [*(a[:-1] for a in corners), *(a[1:] for a in (*corners, *these, *coefficients))]
    x, y, u, v, *others = spread(given, 0, len(share))
    ends = [x + share * (u - x), y + share * (v - y)]
    found, reach = _along_ways(graph, ends, weights * (x * v - u * y), others[:4], others[4:])
    straight, curved = jax.lax.stop_gradient((jnp.stack(foot), jnp.stack(corners)))
    moved = jnp.abs(curved - straight) > _STRETCH * (1 + jnp.abs(straight))
    far = jnp.where(lost | jnp.any(moved, axis=0), jnp.inf, jnp.sum(curved**2, axis=0))
    return found, jnp.maximum(jnp.max(far, axis=0), reach)


def _along_ways(graph: Graph, ends, measure, bounds, coefficients):
    """The moments from those of ways that end at sides, and how far these reach, squared.

    That is infinite where the surface bends so much within the cell that a side is not found.

    Args:
        ends: of the ways if the sides were straight, one or several to each side, `(w, r, *p)` for
            each coordinate.
        measure: what each stands for then.
        bounds: what bounds each, as `Sides.chosen` gives it.
        coefficients: of the graph.
    """
    one_by_one = lambda a: a.reshape(-1, *a.shape[2:])
    given = jax.tree.map(one_by_one, (ends, measure, bounds, coefficients))
    ends, measure, (*flat, high, offset), coefficients = given
    # Along a way each monomial is a power, and so is what is missed of the side.
    rows = monomial_rows(ends, graph.degree)
    heights, slopes = graph.by_degree(coefficients, rows)
    missed = [high * height for height in heights]
    missed[0] = sum((a * b for a, b in zip(ends, flat)), missed[0])
    length, lost = _root(1, [-offset, *missed])

    # The area along a way by Gauss's rule, for each degree of the monomials.
    areas: list = [0] * (graph.degree + 1)
    measure = measure * length**graph.dim
    for at, weight in zip(*_gauss(_nodes(graph), graph.dim - 1)):
        square = sum(_horner(at * length, slope)[0] ** 2 for slope in slopes)
        area = weight * measure * jnp.sqrt(1 + square)
        for degree in range(graph.degree + 1):
            areas[degree] = areas[degree] + area
            area = area * (at * length)
    degrees = multi_indices(graph.dim, 0, graph.degree).sum(axis=1)
    found = sums([areas[degree] * row for degree, row in zip(degrees, rows)], 0)

    length, *ends, offset = jax.lax.stop_gradient((length, *ends, offset))
    resolved = (length > 0) & (length < _STRETCH) & ~lost
    reach = jnp.where(resolved, sum((length * end) ** 2 for end in ends), jnp.inf)
    # The line of a border passes through the point: there is nothing between them.
    reach = jnp.where(offset > 0, reach, 0)
    return jnp.stack(found), jnp.max(reach, axis=0)


def _horner(x, coefficients):
    """A polynomial of one variable, and its slope."""
    value, slope = coefficients[-1], jnp.zeros_like(x)
    for coefficient in coefficients[-2::-1]:
        value, slope = value * x + coefficient, slope * x + value
    return value, slope


def _nodes(graph: Graph) -> int:
    """Of Gauss's rule: exact for the polynomials of the surface."""
    return graph.degree // 2 + 1


def ways_of(sides: Sides):
    """The sides of a cell in turn.

    Returns:
        Their numbers, and whether each is the last; and the square of twice as far as the cell may
        reach: no point beyond the neighbours looked at can then have a part of it. Negative where
        it is not closed.
    """
    if len(sides.flat) == 1:
        return _ways_of_curve(sides)
    side, following, closed = _round(sides.flat, sides.offset, sides.on)
    away = jnp.where(sides.on & (sides.offset > 0), jnp.sum(sides.flat**2, axis=0), 0)
    return (side, following == side[0]), jnp.where(closed, jnp.max(away, axis=0), -1)


def _meeting(u, v, a, b):
    r"""Where two lines meet, those of $q\cdot a = u$ and of $q\cdot b = v$."""
    size = a[0] * b[1] - a[1] * b[0]
    size = jnp.where(size == 0, 1, size)
    return (b[1] * u - a[1] * v) / size, (a[0] * v - b[0] * u) / size


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


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def _root(start: int, coefficients):
    """Where polynomials vanish, by Newton's method, and whether that was lost: then the start.

    Differentiable: to any order, by the implicit function theorem.
    """

    def steps(x, count: int):
        for _ in range(count):
            before, x = x, x - _divided(*_horner(x, coefficients))
        return x, jnp.abs(x - before)

    x, moved = steps(jnp.full_like(coefficients[0], start), _STEPS)
    small = jnp.sqrt(jnp.finfo(x.dtype).eps)
    more = lambda x: jax.lax.fori_loop(0, _MORE, lambda _, x: steps(x, 1)[0], x)
    x = jax.lax.cond(jnp.any(~(moved < small)), more, lambda x: x, x)
    lost = ~(jnp.abs(x - start) < _LOST)
    return jnp.where(lost, start, x), lost


@_root.defjvp
def _root_jvp(start, primals, tangents):
    (coefficients,), (moved,) = primals, tangents
    x, lost = _root(start, coefficients)
    missed, slope = _horner(x, moved)[0], _horner(x, coefficients)[1]
    return (x, lost), (-_divided(missed, slope), np.zeros(lost.shape, jax.dtypes.float0))


def _divided(missed, slope):
    """A step of Newton's method, where the slope is that of a surface that faces the point."""
    return missed / jnp.where(slope > 0, slope, 1)


@functools.cache
def _gauss(nodes: int, power: int) -> tuple[list[float], list[float]]:
    r"""Gauss's rule for $\int_0^1 s^p f(s)\,ds$."""
    x, w = scipy.special.roots_jacobi(nodes, 0, power)
    return ((1 + x) / 2).tolist(), (w / 2 ** (power + 1)).tolist()
