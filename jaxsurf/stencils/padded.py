"""Sparse matrices as padded arrays, slots first, with gathers in both directions.

Sizes are rounded up to a few: a program compiled for one matrix then serves another that is
about as wide, as the operators of different surfaces of as many points are.
"""

from __future__ import annotations

import functools
import itertools
import math
import weakref
from collections.abc import Iterator
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse
from jaxtyping import Array, Bool, Float, Int

from ..compiling import at_once
from .gathers import constant_product, product, take

# An entry added by a scatter costs about as much as this many padded slots.
_SCATTER = 12
# Room in the list of entries beyond the slots: this share of the rows, but at least so many, or 4,
# 16, ... times that. (In shorter lists a long row more would need another program.)
_LISTED, _LEAST = 1 / 8, 32
# Widths tried for a matrix of known usual width: that times powers of this, if not told otherwise.
_STEP = 0.7
# By how much another width has to be cheaper than the usual one: else the next surface, which has
# rows about as long, would be given another width now and then, and be compiled for.
_CHEAPER = 4 / 3


class Table(NamedTuple):
    """Where the entries of a sparse matrix go: row by row in slots, what sticks out in a list.

    Args:
        columns: column of row i in slot s, `(k, m)`; padding refers to column 0.
        source: number of the entry, `(k, m)`; in padding a number past the end.
        rows, others, sources: row, column and number of the entries beyond the k-th of their row;
            filled up with entries past the end.
    """

    columns: Any
    source: Any
    rows: Any
    others: Any
    sources: Any


def tabulate(
    indptr: np.ndarray,
    columns: np.ndarray,
    source: np.ndarray | None = None,
    *,
    rows: int | None = None,
    width: float | None = None,
    step: float = _STEP,
) -> Table:
    """Slots for the rows of a matrix in compressed form.

    Args:
        indptr, columns: of the matrix.
        source: numbers to put in place of those of the entries.
        rows: number of rows, empty ones at the end counted; those of the matrix if None.
        width: about the length of the longest rows, if known.
        step: widths tried are that times powers of this.
    """
    start, length = indptr[:-1].astype(np.int32), np.diff(indptr).astype(np.int32)
    count, m = len(columns), max(len(length), rows or 0)
    k, listed = _slots(length, m, width, step)
    table, numbers = np.zeros((k, m), np.int32), np.full((k, m), count, np.int32)
    # By the transposes: a row at a time, entries where they stand in memory.
    filled = np.arange(k, dtype=np.int32) < length[:, None]
    place = (start[:, None] + np.arange(k, dtype=np.int32))[filled]
    slot = np.zeros((len(length), k), np.int32)
    slot[filled] = columns[place]
    table[:, : len(length)] = slot.T
    slot[filled], slot[~filled] = place, count
    numbers[:, : len(length)] = slot.T

    long = np.flatnonzero(length > k)
    over = length[long] - k
    owner = np.repeat(long, over)
    rank = np.arange(len(owner)) - np.repeat(np.cumsum(over) - over, over)
    beyond = start[owner] + k + rank
    padded = lambda a, fill: np.append(a, np.full(listed - len(a), fill)).astype(np.int32)
    others, sources = padded(columns[beyond], 0), padded(beyond, count)
    if source is not None:
        source = np.append(source, np.iinfo(np.int32).max).astype(np.int32)
        numbers, sources = source[numbers], source[sources]
    return Table(table, numbers, padded(owner, 0), others, sources)


def _slots(length: np.ndarray, m: int, width: float | None, step: float) -> tuple[int, int]:
    """Number of slots and room in the list, of the few that there are, by the cost of applying."""
    widest = int(length.max(initial=0))
    # Number of entries beyond the k-th of their row, for every k.
    longer = len(length) - np.cumsum(np.bincount(length, minlength=widest + 1))
    overflow = np.append(np.cumsum(longer[::-1])[::-1], 0)
    best = math.inf, 0, 0
    usual = None if width is None else math.ceil(width)
    for k in _widths(width, step):
        over = int(overflow[min(k, widest + 1)])
        listed = max(math.ceil(m * _LISTED), _LEAST)
        while listed < over:
            listed *= 4
        cost = (k * m + _SCATTER * listed) * (1 if k == usual else _CHEAPER)
        best = min(best, (cost, k, listed))
        if over == 0:
            return best[1:]
    raise AssertionError("the widths have no end")


def _widths(width: float | None, step: float) -> Iterator[int]:
    """Numbers of slots: powers of two times 5/4 and 7/4, or those around a usual width."""
    if width is None:
        yield 1
        for power in itertools.count(2):
            yield 2**power * 5 // 4
            yield 2**power * 7 // 4
    else:
        for power in itertools.count(-math.ceil(math.log(max(width, 1)) / -math.log(step))):
            yield math.ceil(width * step**-power)


class PaddedMatrix(eqx.Module):
    """A sparse, possibly rectangular matrix of scalars that is applied with one gather per slot.

    Args:
        indices: columns, `(k, m)`.
        weights: entries, `(k, m)`; zero in padded slots.
        extra: rows, columns and values of entries that did not fit; zeros fill the list up.
    """

    indices: Int[Array, "k m"]
    weights: Float[Array, "k m"]
    extra: tuple[Int[Array, " e"], Int[Array, " e"], Float[Array, " e"]]

    @classmethod
    def from_scipy(
        cls, matrix: scipy.sparse.csr_matrix, dtype, *, rows=None, width=None, step=_STEP
    ) -> PaddedMatrix:
        """Its rows in slots; `rows` and `width` as for `tabulate`."""
        table = tabulate(matrix.indptr, matrix.indices, rows=rows, width=width, step=step)
        values = np.append(matrix.data.astype(dtype), np.zeros(1, dtype))
        extra = (table.rows, table.others, values[table.sources])
        return cls(*jax.device_put((table.columns, values[table.source], extra)))

    def minus(self, factor, other: PaddedMatrix) -> PaddedMatrix:
        """This matrix less a number times another of the same layout."""
        weights = self.weights - factor * other.weights
        extra = self.extra[2] - factor * other.extra[2]
        return PaddedMatrix(self.indices, weights, (*self.extra[:2], extra))

    def __call__(self, x: Float[Array, "p *c"]) -> Float[Array, "m *c"]:
        rows, columns, values = self.extra
        total = constant_product(self.weights, self.indices, x)
        values = values.reshape(-1, *[1] * (x.ndim - 1))
        return total.at[rows].add(values * take(x, columns))


class Incoming(eqx.Module):
    """A transposed stencil: its entries by the point they read, components exchanged.

    Args:
        indices, weights: as of a stencil, `(k, n)` and `(k, *in_shape, *out_shape, n)`.
        extra: rows, columns and weights of entries that did not fit.
        active: of the stencil.
        contracted: number of components axes that are summed over.
    """

    indices: Int[Array, "k n"]
    weights: Float[Array, "k *c n"]
    extra: tuple[Int[Array, " e"], Int[Array, " e"], Float[Array, "*c e"]]
    active: Bool[Array, " n"] | None
    contracted: int = eqx.field(static=True)

    @classmethod
    def of(cls, stencil, table: Table) -> Incoming:
        """The weights of a stencil gathered once, in the order of a table made for its indices."""
        contracted = len(stencil.out_shape)
        gathered = functools.partial(_gathered, stencil.weights, contracted)
        weights = gathered(table.source)
        # The first slot of the table is kept for what a row adds to its own point.
        diagonal = _exchanged(stencil.diagonal, contracted, 0)
        weights = weights.at[0].set(diagonal)
        extra = (table.rows, table.others, gathered(table.sources))
        return cls(table.columns, weights, extra, stencil.active, contracted)

    def __call__(self, v: Float[Array, "n *c"]) -> Float[Array, "n *d"]:
        return product(self.weights, self.indices, v, self.contracted, self.extra, self.active)


@functools.partial(jax.jit, static_argnums=1)
def _gathered(weights, contracted: int, place):
    """Entries of `(k, *c, n)` weights by their number slot * n + row, zero past the end."""
    components = weights.shape[1:-1]
    flat = jnp.moveaxis(weights, -1, 1).reshape(-1, *components)
    found = flat.at[place].get(mode="fill", fill_value=0)
    return _exchanged(jnp.moveaxis(found, place.ndim - 1, -1), contracted, place.ndim - 1)


def _exchanged(weights, contracted: int, start: int):
    """Components given, the first of those from axis `start` on, put behind those taken."""
    if not 0 < contracted < weights.ndim - start - 1:
        return weights
    given = range(start, start + contracted)
    return jnp.moveaxis(weights, tuple(given), tuple(range(-1 - contracted, -1)))


def table_of(indices: Int[Array, "k n"]) -> Table:
    """Where the entries of the transpose of a stencil with these indices stand; kept for them."""
    if isinstance(indices, np.ndarray):  # might be changed
        return jax.device_put(_table(indices))
    key = id(indices)
    known = _tables.get(key)
    if known is None or known[0]() is not indices:
        with at_once():  # kept, so that it must be no part of a trace
            table = jax.device_put(_table(np.asarray(indices)))
        known = weakref.ref(indices, lambda _: _tables.pop(key, None)), table
        _tables[key] = known
    return known[1]


# By the identity of the indices, for as long as these live.
_tables: dict[int, tuple[weakref.ref, Table]] = {}


def _table(indices: np.ndarray) -> Table:
    k, n = indices.shape
    target = np.ascontiguousarray(indices.T, dtype=np.int32)
    number = np.arange(n, dtype=np.int32)[:, None] + np.arange(k, dtype=np.int32) * np.int32(n)
    # Padded slots refer to their own row: left in, they would make long rows.
    other = target != np.arange(n, dtype=np.int32)[:, None]
    indptr = np.append(0, np.cumsum(other.sum(axis=1)))
    matrix = scipy.sparse.csr_matrix((number[other], target[other], indptr), shape=(n, n))
    transposed = matrix.tocsc()
    # A point is read about as often as it reads.
    table = tabulate(transposed.indptr, transposed.indices, transposed.data, width=1.15 * k)
    own, none = np.arange(n, dtype=np.int32), np.full(n, np.iinfo(np.int32).max, np.int32)
    return table._replace(
        columns=np.concatenate([own[None], table.columns]),
        source=np.concatenate([none[None], table.source]),
    )
