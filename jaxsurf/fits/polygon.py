r"""Cells of points in their tangent planes: polygons whose sides are slightly curved.

A cell is what is nearer to its point than to any other. Its sides are found as if they were
straight, each from the one before; Newton's method puts them on the surface, a graph over the
plane, and Gauss's rule sums over the ways from the point to them.
"""

from __future__ import annotations

import functools
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.special
from jaxtyping import Array, Bool, Float

from ..compiling import kept
from .graph import Expansion, Graph, polynomial
from .moments import blockwise
from .monomials import monomials_by_degree, polynomial_count
from .plane import TangentPlane

# Newton steps from cells with straight sides to those on the surface end with the one after one as
# small as this, or after so many: each squares what is left of an error of the size
# (spacing x curvature)^2.
_SMALL, _STEPS = 1e-4, 8
# Sides that it puts so much farther out than straight ones, or behind the point, are not found.
_STRETCH = 2.0
# Nor are roots so far away, in units of the kernel or of the straight way.
_LOST = 1e3
# Of the neighbours that are tried so many are its sides at most, or half of them.
_SIDES = 16


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


def moments_over(sides: Sides, graph: Graph, ways):
    r"""$\int q^\gamma\,dA$ over a cell for all monomials up to the degree, and how far it reaches.

    The latter squared.
    """
    by_degree = graph.by_degree()
    if graph.dim == 1:
        ends, measure, which = ways
        found, reach = _along_ways(sides.chosen(which), by_degree, ends[:, None], measure[None])
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

        def of_sides():
            both = sides.chosen(jnp.concatenate([side, after]))
            these = jax.tree.map(lambda a: a[..., : len(side), :], both)
            those = jax.tree.map(lambda a: a[..., len(side) :, :], both)
            return _over_sides(these, those, by_degree)

        return jax.lax.cond(ended, lambda: (none, none[0]), of_sides)

    size = polynomial_count(graph.dim, graph.degree)
    found, reach = blockwise(half, (side[halves], after[halves], jnp.stack(ended)))
    return jnp.sum(found, axis=0), jnp.max(reach, axis=0)


def _over_sides(these: Sides, those: Sides, graph: Expansion):
    """What triangles between the point and each side add to the moments of a cell.

    Args:
        these: sides in turn, of which the first is that before.
        those: what cuts each of them off.
    """
    # The planes of two sides meet in a line, which leans by so much over the plane.
    foot = _meeting(these.offset, those.offset, these.flat, those.flat)
    lean = -_meeting(these.high, those.high, these.flat, those.flat)

    def misses(z, foot, lean, graph):
        height, slope = graph.at(foot + z * lean)
        return z - height, 1 - jnp.sum(slope * lean, axis=0)

    z, lost = _root(misses, jnp.zeros_like(these.high), foot, lean, graph)
    corners = foot + z * lean
    first, last = corners[:, :-1], corners[:, 1:]
    turn = first[0] * last[1] - first[1] * last[0]
    share, weights = (
        np.array(a, turn.dtype).reshape(-1, *(1,) * turn.ndim) for a in _gauss(_nodes(graph), 0)
    )
    ends = first[:, None] + share * (last - first)[:, None]
    again = jax.tree.map(lambda a: a[..., 1:, :], these)
    found, reach = _along_ways(again, graph, ends, weights * turn)
    foot, corners = jax.lax.stop_gradient((foot, corners))
    lost = lost | jnp.any(jnp.abs(corners - foot) > _STRETCH * (1 + jnp.abs(foot)), axis=0)
    far = jnp.where(lost, jnp.inf, jnp.sum(corners**2, axis=0))
    return found, jnp.maximum(jnp.max(far, axis=0), reach)


def _along_ways(sides: Sides, graph: Expansion, ends, measure):
    """The moments from those of ways that end at sides, and how far these reach, squared.

    That is infinite where the surface bends so much within the cell that a side is not found.

    Args:
        ends: of the ways if the sides were straight, one or several to each side, `(t, w, r, *p)`.
        measure: what each stands for then, `(w, r, *p)`.
    """
    degree, nodes = graph.degree, _nodes(graph)

    # Along a way each monomial is a power, and so is what is missed of the side.
    rows = monomials_by_degree(ends, degree)
    heights = [sides.high * polynomial([c], [row]) for c, row in zip(graph.heights, rows[1:])]
    heights[0] = heights[0] + jnp.sum(ends * sides.flat[:, None], axis=0)

    def misses(length, offset, heights):
        beyond, rate = heights[-1], jnp.zeros_like(length)
        for height in [*heights[-2::-1], -offset]:
            beyond, rate = beyond * length + height, rate * length + beyond
        return beyond, rate

    length, lost = _root(misses, jnp.ones_like(measure), sides.offset, heights)
    lengths = [jnp.ones_like(length)]
    for _ in range(degree):
        lengths.append(lengths[-1] * length)
    measure = measure * lengths[graph.dim]

    at, share = (np.array(a, length.dtype) for a in _gauss(nodes, graph.dim - 1))
    powers = at ** np.arange(degree + 1)[:, None].astype(length.dtype)
    square = jnp.ones((nodes, *length.shape), length.dtype)
    for slope in graph.slopes:
        along = [s * polynomial([c], [row]) for s, c, row in zip(lengths, slope, rows)]
        square = square + jnp.tensordot(powers[:-1].T, jnp.stack(along), 1) ** 2
    sums = jnp.tensordot(powers * share, jnp.sqrt(square), 1) * measure * jnp.stack(lengths)
    found = [jnp.sum(row * total, axis=(1, 2)) for row, total in zip(rows, sums)]
    length, ends = jax.lax.stop_gradient((length, length * ends))
    resolved = (length > 0) & (length < _STRETCH) & ~lost
    reach = jnp.where(resolved, jnp.sum(ends**2, axis=0), jnp.inf)
    # The line of a border passes through the point: there is nothing between them.
    reach = jnp.where(sides.offset > 0, reach, 0)
    return jnp.concatenate(found), jnp.max(reach, axis=(0, 1))


def _nodes(graph: Expansion) -> int:
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


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def _root(misses: Callable, start, *known):
    """Where what is missed vanishes, by Newton's method, and whether that was lost: then the start.

    Args:
        misses: of x and what is known: what is missed there, and its slope in x.

    Differentiable: in what is known, to any order, by the implicit function theorem.
    """

    def step(state):
        count, x, moved, _ = state
        new = x - _divided(*misses(x, *known))
        return count + 1, new, jnp.max(jnp.abs(new - x)), moved

    # One step more than to one that is small.
    moves = lambda state: (state[0] < _STEPS) & ~(state[3] < _SMALL)
    infinite = jnp.asarray(jnp.inf, start.dtype)
    x = jax.lax.while_loop(moves, step, (0, start, infinite, infinite))[1]
    lost = ~(jnp.abs(x - start) < _LOST)
    return jnp.where(lost, start, x), lost


@_root.defjvp
def _root_jvp(misses, primals, tangents):
    (start, *known), (_, *moved) = primals, tangents
    x, lost = _root(misses, start, *known)
    x = kept(x)
    slope = misses(x, *known)[1]
    _, missed = jax.jvp(lambda *known: misses(x, *known)[0], known, moved)
    return (x, lost), (-_divided(missed, slope), np.zeros(lost.shape, jax.dtypes.float0))


def _divided(missed, slope):
    """A step of Newton's method, where the slope is that of a surface that faces the point."""
    return missed / jnp.where(slope > 0, slope, 1)


@functools.cache
def _gauss(nodes: int, power: int) -> tuple[list[float], list[float]]:
    r"""Gauss's rule for $\int_0^1 s^p f(s)\,ds$."""
    x, w = scipy.special.roots_jacobi(nodes, 0, power)
    return ((1 + x) / 2).tolist(), (w / 2 ** (power + 1)).tolist()
