"""What is computed of all neighbourhoods, block by block, and what it reads."""

from __future__ import annotations

from collections.abc import Callable

import equinox as eqx
import jax

from .compiling import host_jit, namespace, sized_jit
from .fits.moments import blockwise, in_blocks, out_of_blocks
from .fits.plane import Neighborhood
from .stencils.gathers import take


def of_each(f: Callable, cloud, neighbors, rows, size: int, *args):
    """`f(neighborhood, *args)` in blocks of the neighbourhoods of some rows; in compiled code.

    Neighbours are read block by block, and never stored; for derivatives all are before: what is
    transposed to reading would else go over all points for each block.
    """
    return _read_in_blocks(f, *_columns_and_lists(cloud, neighbors, rows, size), args)


@sized_jit
def _read_in_blocks(f, columns, lists, args):
    return _in_blocks(f, columns, lists, args)


@eqx.filter_custom_jvp
def _in_blocks(f, columns, lists, args):
    return jax.lax.map(lambda part: f(Neighborhood.of(*_read(columns, part)), *args), lists)


@_in_blocks.def_jvp
def _in_blocks_jvp(primals, tangents):
    def read_before(f, columns, lists, args):
        blocks = _read(columns, lists)
        return blockwise(lambda block: f(Neighborhood.of(*block), *args), blocks)

    return eqx.filter_jvp(read_before, primals, tangents)


@host_jit
def blocks_of(cloud, neighbors, rows, size: int):
    """Positions and normals of the neighbours of some rows, mask, radius and border, in blocks."""
    return _read(*_columns_and_lists(cloud, neighbors, rows, size))


def _columns_and_lists(cloud, neighbors, rows, size: int):
    """Coordinates of all points and of their normals; and lists, mask, radius, border in blocks."""
    cloud, radius, border = cloud.seen, neighbors.radius, cloud.boundary
    if radius is not None:
        radius = namespace(radius).broadcast_to(radius, (cloud.n,))[in_blocks(rows, size)]
    if border is not None:
        border = border[in_blocks(rows, size)]
    slots, mask = (in_blocks(a.T, size) for a in (neighbors.indices, neighbors.mask))
    return ([*cloud.points.T], [*cloud.normals.T]), (slots, mask, radius, border)


def _read(columns, lists):
    """What is seen of a neighbourhood, see `Neighborhood.of`."""
    slots, *others = lists
    # One coordinate at a time: one gather for all of them is slower.
    points, normals = ([take(column, slots) for column in vectors] for vectors in columns)
    return points, normals, *others


@host_jit
def rows_of(weights, others, count: int):
    """Weights, with the slots first, and what else was found of the rows, out of their blocks."""
    weights, others = jax.tree.map(lambda a: out_of_blocks(a, count), (weights, others))
    return jax.tree.map(lambda a: namespace(a).moveaxis(a, -2, 0), weights), others
