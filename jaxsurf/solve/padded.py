"""Sparse matrices as padded arrays, slots first, with gathers in both directions.

Sizes are rounded up to a few: a program compiled for one matrix then serves another that is
about as wide, as the operators of different surfaces of as many points are.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse
from jaxtyping import Array, Float, Int

from ..arguments import is_concrete
from ..stencils.stencil import AbstractOperator, Composition, Stencil

# An entry added by a scatter costs about as much as this many padded slots.
_SCATTER = 12
# Room in the list of entries beyond the slots: this share of the rows, or 4, 16, ... times that.
_LISTED = 1 / 8
# Widths tried for a matrix of known usual width: that times powers of this, if not told otherwise.
_STEP = 0.7
# Below this many entries everything is gathered at once, without a loop over slots.
_SMALL = 50_000


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
    for k in _widths(width, step):
        over = int(overflow[min(k, widest + 1)])
        listed = max(math.ceil(m * _LISTED), 1)
        while listed < over:
            listed *= 4
        best = min(best, (k * m + _SCATTER * listed, k, listed))
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
    """A sparse, possibly rectangular matrix that is applied with one gather per slot.

    Args:
        indices: columns, `(k, m)`.
        weights: entries, `(k, m)`; zero in padded slots.
        diagonal: added to the diagonal, `(m,)`; None for zero.
        extra: rows, columns and values of entries that did not fit; zeros fill the list up.
    """

    indices: Int[Array, "k m"]
    weights: Float[Array, "k m"]
    diagonal: Float[Array, " m"] | None
    extra: tuple[Int[Array, " e"], Int[Array, " e"], Float[Array, " e"]]

    @classmethod
    def from_scipy(
        cls, matrix: scipy.sparse.csr_matrix, dtype, *, rows=None, width=None, step=_STEP
    ) -> PaddedMatrix:
        """Its rows in slots; `rows` and `width` as for `tabulate`."""
        table = tabulate(matrix.indptr, matrix.indices, rows=rows, width=width, step=step)
        values = np.append(matrix.data.astype(dtype), np.zeros(1, dtype))
        extra = (table.rows, table.others, values[table.sources])
        return cls(*jax.device_put((table.columns, values[table.source], None, extra)))

    def minus(self, factor, other: PaddedMatrix) -> PaddedMatrix:
        """This matrix less a number times another of the same layout."""
        weights = self.weights - factor * other.weights
        extra = self.extra[2] - factor * other.extra[2]
        return PaddedMatrix(self.indices, weights, None, (*self.extra[:2], extra))

    def __call__(self, x: Float[Array, " p"]) -> Float[Array, " m"]:
        k, m = self.indices.shape
        take = lambda j: x.at[j].get(mode="promise_in_bounds")
        zero = jnp.zeros(m, jnp.result_type(x, self.weights))
        start = zero if self.diagonal is None else self.diagonal * x
        if k * m < _SMALL:
            total = start + jnp.sum(self.weights * take(self.indices), axis=0)
        else:
            add = lambda total, slot: (total + slot[0] * take(slot[1]), None)
            total = jax.lax.scan(add, start, (self.weights, self.indices))[0]
        rows, columns, values = self.extra
        return total.at[rows].add(values * take(columns))


class Incoming(eqx.Module):
    """Which entries of a stencil refer to each point: its transpose without a scatter.

    Args:
        indices: of the stencil that the layout belongs to, `(k, n)`.
        table: entries by the point they read; those on the diagonal left out.
    """

    indices: Int[Array, "k n"]
    table: Table

    @classmethod
    def of(cls, stencil: Stencil) -> Incoming | None:
        """The layout of a scalar stencil with concrete indices; None of one with components."""
        if stencil.in_shape or stencil.out_shape:
            return None
        k, n = stencil.indices.shape
        target = np.ascontiguousarray(np.asarray(stencil.indices).T, dtype=np.int32)
        number = np.arange(n, dtype=np.int32)[:, None] + np.arange(k, dtype=np.int32) * np.int32(n)
        # Padded slots refer to their own row: left in, they would make long rows.
        other = target != np.arange(n, dtype=np.int32)[:, None]
        indptr = np.append(0, np.cumsum(other.sum(axis=1)))
        matrix = scipy.sparse.csr_matrix((number[other], target[other], indptr), shape=(n, n))
        turned = matrix.tocsc()
        # A point is read about as often as it reads.
        table = tabulate(turned.indptr, turned.indices, turned.data, width=1.15 * k)
        return cls(stencil.indices, jax.device_put(table))

    def belongs_to(self, stencil: Stencil) -> bool:
        """Whether it was made for these indices; concrete."""
        mine, others = self.indices, stencil.indices
        return mine is others or np.array_equal(np.asarray(mine), np.asarray(others))

    def transpose(self, stencil: Stencil) -> PaddedMatrix:
        """The transposed stencil, with its weights gathered once.

        The stencil must have the indices that the layout was made for.
        """
        weights = stencil.weights
        if stencil.indices is not self.indices:
            weights = eqx.error_if(
                weights,
                jnp.any(stencil.indices != self.indices),
                "the preconditioner was made for other neighbours than the operator has: make it "
                "for this operator",
            )
        values = weights.reshape(-1)
        fill = lambda place: values.at[place].get(mode="fill", fill_value=0)
        table = self.table
        extra = (table.rows, table.others, fill(table.sources))
        return PaddedMatrix(table.columns, fill(table.source), stencil.diagonal, extra)


# Of a stencil; of the factors of a composition; None where it is not known.
Layout = Incoming | tuple | None


def incoming_layout(operator: AbstractOperator) -> Layout:
    """The layout of the transpose of an operator with concrete indices."""
    if isinstance(operator, Composition):
        return incoming_layout(operator.outer), incoming_layout(operator.inner)
    return Incoming.of(operator) if isinstance(operator, Stencil) else None


def matching_layout(layout: Layout, operator: AbstractOperator) -> Layout:
    """The layout if it is one of this operator, as far as can be seen; else a new one."""
    if isinstance(operator, Composition) and isinstance(layout, tuple):
        return matching_layout(layout[0], operator.outer), matching_layout(
            layout[1], operator.inner
        )
    if isinstance(operator, Stencil) and is_concrete(operator.indices):
        if not isinstance(layout, Incoming) or not layout.belongs_to(operator):
            return Incoming.of(operator)
    return layout


def adjoint(operator: AbstractOperator, layout: Layout) -> Callable | None:
    """The transposed operator by gathers; None where a layout is lacking."""
    if isinstance(operator, Composition) and isinstance(layout, tuple):
        outer, inner = adjoint(operator.outer, layout[0]), adjoint(operator.inner, layout[1])
        return None if outer is None or inner is None else _Chain(outer, inner)
    if isinstance(operator, Stencil) and isinstance(layout, Incoming):
        if operator.indices.shape == layout.indices.shape:
            return layout.transpose(operator)
    return None


class _Chain(eqx.Module):
    first: Callable
    second: Callable

    def __call__(self, v):
        return self.second(self.first(v))
