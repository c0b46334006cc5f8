r"""Many sums over the neighbours in one pass, and what is transposed to them.

On a CPU XLA makes three programs of a sum over more than 32 numbers, and stores what is summed in
between. Several sums as one reduction are one program, which stores nothing. Two primitives, as
derivatives keep this form then: transposed by JAX each sum would be one by itself.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir

from ..machine import CPU, machine

# The most numbers that XLA sums in one program on a CPU.
_SHORT = 32


def total(a: jax.Array, axis: int = 0) -> jax.Array:
    """Sum over an axis; over a long one in parts, which are one program together.

    For what is computed in few operations: those before it may be found again for each part.
    """
    count = a.shape[axis]
    parts = -(-count // _SHORT) if machine() is CPU else 1
    ends = [count * i // parts for i in range(1, parts)]
    return functools.reduce(jnp.add, [jnp.sum(part, axis) for part in jnp.split(a, ends, axis)])


def sums(rows: Sequence[jax.Array], axis: int) -> list[jax.Array]:
    """Each of several arrays of one shape summed over an axis."""
    return _sums.bind(*rows, axis=axis, size=rows[0].shape[axis])


def spread(rows: Sequence[jax.Array], axis: int, size: int) -> list[jax.Array]:
    """Each of several arrays of one shape so many times along a new axis."""
    return _spread.bind(*rows, axis=axis, size=size)


def _summed(*rows, axis, size):
    return [jnp.sum(row, axis=axis) for row in rows]


def _summed_at_once(*rows, axis, size):
    zero = jnp.zeros((), rows[0].dtype)
    both = lambda a, b: tuple(map(jax.lax.add, a, b))
    return jax.lax.reduce(rows, (zero,) * len(rows), both, (axis,))


def _repeated(*rows, axis, size):
    shape = (*rows[0].shape[:axis], size, *rows[0].shape[axis:])
    return [jnp.broadcast_to(jnp.expand_dims(row, axis), shape) for row in rows]


def _primitive(name: str, shape: Callable, ways: dict[str | None, Callable]) -> Primitive:
    """A linear function of arrays of one shape, by platform (None: all others)."""
    primitive = Primitive(name)
    primitive.multiple_results = True
    primitive.def_impl(ways[None])

    @primitive.def_abstract_eval
    def _abstract(*rows, axis, size):
        return [row.update(shape=shape(row.shape, axis, size), sharding=None) for row in rows]

    def batched(rows, dims, *, axis, size):
        count = next(row.shape[dim] for row, dim in zip(rows, dims) if dim is not None)
        rows = [
            jnp.broadcast_to(row, (count, *row.shape)) if dim is None else jnp.moveaxis(row, dim, 0)
            for row, dim in zip(rows, dims)
        ]
        return primitive.bind(*rows, axis=axis + 1, size=size), [0] * len(rows)

    batching.primitive_batchers[primitive] = batched
    for platform, way in ways.items():
        lowered = mlir.lower_fun(way, multiple_results=True)
        mlir.register_lowering(primitive, lowered, platform)
    return primitive


def _transposed_by(other: Callable[[], Primitive]) -> Callable:
    def transpose(cotangents, *rows, axis, size):
        moving = [type(c) is not ad.Zero for c in cotangents]
        given = [c for c, moves in zip(cotangents, moving) if moves]
        found = iter(other().bind(*given, axis=axis, size=size) if given else ())
        zero = lambda row: ad.Zero(row.aval.to_ct_aval())
        return [next(found) if moves else zero(row) for row, moves in zip(rows, moving)]

    return transpose


_sums = _primitive(
    "sums",
    lambda shape, axis, size: (*shape[:axis], *shape[axis + 1 :]),
    {None: _summed, "cpu": _summed_at_once},
)
_spread = _primitive(
    "spread",
    lambda shape, axis, size: (*shape[:axis], size, *shape[axis:]),
    {None: _repeated},
)
ad.deflinear2(_sums, _transposed_by(lambda: _spread))
ad.deflinear2(_spread, _transposed_by(lambda: _sums))
