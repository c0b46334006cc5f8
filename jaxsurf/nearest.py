"""The k nearest in compiled code, for points that move: cells in runs, candidates in a network.

Points are sorted by the cell of a grid that they lie in, along one axis by finer cells, so that the
candidates of a point lie in few runs of that order. Cells are folded onto a grid of fixed size: the
images of cells next to each other are the same or next to each other, whatever the extent of the
cloud; what else lies there its distance rules out.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from .cells import distance_key
from .checks import stands_above
from .compiling import power_of_two, stored
from .machine import SEARCHED, block, machine
from .sheets import cosine_slack

# Cells are a little wider than the reach, so that rounding puts no neighbour beyond them.
_MARGIN = 1.01
# How many cells a width is cut into along the axis of the runs.
_FINE = 4
# Room beside the key of a distance for a number and a bit, in 64 bits.
_LOW = 22


class Grid(eqx.Module):
    """Points sorted by the cell that they lie in.

    Args:
        width: of the cells, in the units of the points.
        first: where the points of each cell begin in the order; one more at the end.
        order: the numbers of the points, by cell.
        cells: the cell of each point, `(n,)` for each axis, the last one of finer cells.
        ordered: coordinates and components of the normals in the order.
        given: the same as they were given.
        on: rows that are points.
        wide: cells of the folded grid along each axis.
    """

    width: Float[Array, ""]
    first: Int[Array, " b"]
    order: Int[Array, " n"]
    cells: list[Int[Array, " n"]]
    ordered: list[Float[Array, " n"]]
    given: list[Float[Array, " n"]]
    on: Bool[Array, " n"]
    wide: int = eqx.field(static=True)

    @classmethod
    def of(cls, points, normals, on, reach) -> Grid:
        """A grid in which a cell is as wide as `reach`."""
        n, d = points.shape
        wide = 1 << max(2, math.ceil(math.log2(max(n, 2)) / d))
        on = on & jnp.all(jnp.isfinite(points) & jnp.isfinite(normals), axis=1)
        corner = jnp.min(jnp.where(on[:, None], points, jnp.inf), axis=0)
        width = _MARGIN * reach
        at = jnp.where(on[:, None], points - corner, 0) / width
        parts = [1] * (d - 1) + [_FINE]
        cells = [_folded(jnp.floor(x * part), wide * part) for x, part in zip(at.T, parts)]
        last = wide**d * _FINE
        bucket = jnp.where(on, _raveled(cells[:-1], wide) * (wide * _FINE) + cells[-1], last)
        order = jnp.argsort(bucket).astype(jnp.int32)
        count = jnp.zeros(last + 1, jnp.int32).at[bucket + 1].add(1, mode="drop")
        given = [*points.T, *normals.T]
        ordered = [column[order] for column in given]
        return cls(width, jnp.cumsum(count), order, cells, ordered, given, on, wide)

    def candidates(self, rows, reach: int):
        """Where in the order the candidates of some rows stand, `(s, r)` for slots `(s, 1)`.

        Returns:
            That as a function, and their number.
        """
        far, last = reach * _FINE, self.wide * _FINE - 1
        *across, along = (cell[rows] for cell in self.cells)
        steps = np.array(list(itertools.product(range(-reach, reach + 1), repeat=len(across))))
        places = [cell + step[:, None] for cell, step in zip(across, steps.T.astype(np.int32))]
        inside = self.on[rows]
        for place in places:
            inside = inside & (place >= 0) & (place < self.wide)
        column = jnp.where(inside, _raveled(places, self.wide), 0) * (last + 1)
        start = self.first[column + jnp.maximum(along - far, 0)]
        stop = self.first[column + jnp.minimum(along + far, last) + 1]
        length = jnp.where(inside, stop - start, 0)
        ends = jnp.cumsum(length, axis=0)
        # From a slot to the order: a shift that grows from run to run.
        shift = start - (ends - length)
        more = jnp.diff(shift, axis=0)

        def stands_at(slot):
            at = slot + shift[0]
            for end, step in zip(ends[:-1], more):
                at = at + jnp.where(slot >= end, step, 0)
            return at

        return stands_at, ends[-1]


def _folded(cell, wide: int):
    """Cells on a strip that is folded up: steps of one stay steps of one, or of none."""
    cell = jnp.mod(cell, 2 * wide)
    return jnp.where(cell < wide, cell, 2 * wide - 1 - cell).astype(jnp.int32)


def _raveled(places, wide: int):
    place = jnp.zeros_like(places[0])
    for other in places:
        place = place * wide + other
    return place


class Nearest(eqx.Module):
    """The nearest of some rows, slots first.

    Args:
        indices: numbers of the points, the row's own where a slot is empty.
        mask: which slots are filled.
        above: which of them lie on a sheet above or below the row's own.
        crowded: whether there was no room for all that were to be looked at.
        all: whether no point was out of reach; not known of searches that are not for few rows.
    """

    indices: Int[Array, "k r"]
    mask: Bool[Array, "k r"]
    above: Bool[Array, "k r"]
    crowded: Bool[Array, " r"]
    all: Bool[Array, " r"]


def nearest_in(
    grid: Grid, rows, k: int, *, reach: int, count: int, min_cosine=0.0, few: bool = False
) -> Nearest:
    """The k nearest acceptable points of some rows, of those within `reach` widths of a cell.

    Args:
        count: candidates that there is room for; where more are needed, the row is of no use.
        few: sort by the compiler's own sorting, which is sooner compiled; else by a network,
            which on a CPU is two to seven times as fast.
    """
    find = lambda rows: _nearest(grid, rows, k, reach, count, min_cosine, few)
    size = block(SEARCHED)
    if len(rows) <= size:
        return find(rows)
    n, blocks = len(rows), -(-len(rows) // size)
    rows = jnp.pad(rows, (0, blocks * size - n), mode="edge")
    found = jax.lax.map(find, rows.reshape(blocks, size))
    # Blocks side by side.
    return jax.tree.map(
        lambda a: jnp.moveaxis(a, 0, -2).reshape(*a.shape[1:-1], -1)[..., :n], found
    )


def _nearest(grid, rows, k, reach, count, min_cosine, few) -> Nearest:
    d = len(grid.cells)
    stands_at, candidates = grid.candidates(rows, reach)
    own = [column[rows] for column in grid.given]
    limit = distance_key((reach * grid.width / _MARGIN) ** 2)

    def looked_at(slot):
        """Keys to sort, and which candidates are near."""
        place = stands_at(slot)
        take = lambda column: column.at[place].get(mode="clip")
        j = take(grid.order)
        theirs = [take(column) for column in grid.ordered]
        offset = [x - x0 for x, x0 in zip(theirs[:d], own[:d])]
        squared = _dot(offset, offset)
        key = distance_key(squared)
        cosine = _dot(theirs[d:], own[d:])
        real, near = slot < candidates, key <= limit
        good = near & (cosine >= min_cosine - cosine_slack(squared.dtype))
        good = (good | (j == rows)) & real
        rise = [jnp.abs(_dot(offset, normal)) for normal in (own[d:], theirs[d:])]
        above = stands_above(squared, cosine, jnp.minimum(*rise))
        key = jnp.where(good, jnp.where(j == rows, -1, key), _last(key.dtype))
        return _packed(key, 2 * j + above, len(grid.order)), near | ~real

    slots = lambda count: jnp.arange(count, dtype=jnp.int32)[:, None]
    # Where all rows are searched this is not asked, and would cost as much as all the rest.
    every = candidates == jnp.sum(grid.on)
    if few or machine().sorts:
        keys, seen = looked_at(slots(max(count, k)))
        every = every & (jnp.all(seen, axis=0) if few else False)
        keys = _sorted_few(keys, k)
    else:
        every = every & False
        width = power_of_two(max(k, 2))
        most = jnp.minimum(jnp.max(candidates), count)
        keys = _smallest(lambda i: looked_at(i * width + slots(width))[0], width, most)
        keys = [a[:k] for a in keys]
    key, low = _unpacked(keys)
    mask = key < _last(key.dtype)
    above = mask & (low & 1 > 0)
    return Nearest(jnp.where(mask, low >> 1, rows), mask, above, candidates > count, every)


def _dot(a, b):
    return sum(x * y for x, y in zip(a[1:], b[1:], strict=True)) + a[0] * b[0]


# --- sorting -------------------------------------------------------------------------------


def _last(dtype):
    """A key beyond those of all distances."""
    return jnp.iinfo(dtype).max >> (_LOW if dtype == jnp.int64 else 0)


def _packed(key, low, n: int) -> tuple[Array, ...]:
    """One array to sort in place of two, where there is room for both."""
    if key.dtype == jnp.int64 and 2 * n <= 1 << _LOW:
        return ((key << _LOW) | low,)
    return key, low


def _unpacked(keys):
    if len(keys) == 2:
        return keys
    return keys[0] >> _LOW, (keys[0] & ((1 << _LOW) - 1)).astype(jnp.int32)


def _sorted_few(keys, k: int):
    keys = [jnp.moveaxis(a, 0, 1) for a in keys]
    return [a[:, :k].T for a in jax.lax.sort(keys, num_keys=len(keys))]


def _smallest(group: Callable, width: int, count):
    """The smallest of `count` keys along the first axis, by Batcher's network of exchanges.

    Group by group, each put in order and merged into those that were the smallest before, for as
    many groups as there are.

    Args:
        group: the keys of group i, so many as the width.
    """

    def put_in_order(keys):
        size = 2
        while size <= width:
            keys = _merged(keys, size)
            size *= 2
        return keys

    def more(i, best):
        # In one piece with what comes before, the compiler would find keys again for every use.
        apart = lambda keys: tuple(stored(a, count < 0) for a in keys)
        keys = apart(put_in_order(apart(group(i))))
        low = _exchanged(best, tuple(a[::-1] for a in keys))[0]
        return _merged(low, width, first=False)

    none = [jnp.full(a.shape, jnp.iinfo(a.dtype).max, a.dtype) for a in jax.eval_shape(group, 0)]
    return jax.lax.fori_loop(0, -(-count // width), more, tuple(none))


def _merged(keys, size: int, first: bool = True):
    """Groups of a size put in order whose halves are; or, if not `first`, bitonic ones."""
    half = size // 2
    if first:
        keys = _stage(keys, half, reverse=True)
        half //= 2
    while half:
        keys = _stage(keys, half, reverse=False)
        half //= 2
    return keys


def _stage(keys, half: int, reverse: bool):
    """The first half of every group against the second, and this if need be turned round."""
    parts = [a.reshape(-1, 2, half, *a.shape[1:]) for a in keys]
    turn = (lambda a: a[:, ::-1]) if reverse else (lambda a: a)
    low, high = _exchanged([a[:, 0] for a in parts], [turn(a[:, 1]) for a in parts])
    return tuple(
        jnp.stack([a, turn(b)], axis=1).reshape(whole.shape) for a, b, whole in zip(low, high, keys)
    )


def _exchanged(a, b):
    if len(a) == 1:
        return (jnp.minimum(a[0], b[0]),), (jnp.maximum(a[0], b[0]),)
    swap = (a[0] > b[0]) | ((a[0] == b[0]) & (a[1] > b[1]))
    low = tuple(jnp.where(swap, y, x) for x, y in zip(a, b))
    return low, tuple(jnp.where(swap, x, y) for x, y in zip(a, b))
