r"""Sums over gathered slots: the one product behind every sparse operator.

$(W u)_i = \sum_s w_{si}\, u_{j(s, i)}$ with slots along the first axis and points along the last:
one pass adds one slot for all points, reading contiguous columns.
"""

from __future__ import annotations

import functools
import math

import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array, Bool, Float, Int

from ..arguments import switched_off
from ..compiling import AnyArray, is_quick, namespace
from ..machine import machine


def take(values: Float[AnyArray, "m *c"], j: Int[AnyArray, "..."]) -> Float[AnyArray, "... *c"]:
    """The values at these points: where operators and builds of stencils read those of others.

    On several devices the values are a device's own and its halo, see `sharding`.
    """
    if namespace(values) is np:
        return values[j]
    return values.at[j].get(mode="promise_in_bounds", wrap_negative_indices=False)


# Compiled once for each shape, not at every call outside jit.
@functools.partial(jax.jit, static_argnums=3)
def product(
    weights: Float[Array, "k *w m"],
    indices: Int[Array, "k m"],
    u: Float[Array, "n *c"],
    contracted: int = 0,
    more: tuple[Int[Array, " e"], Int[Array, " e"], Float[Array, "*w e"]] | None = None,
    active: Bool[Array, " n"] | None = None,
) -> Float[Array, "m *b"]:
    """The product with a field or a batch of fields.

    Args:
        weights: `(k, *out_shape, *in_shape, m)`.
        indices: point that row i reads in slot s.
        u: `(n, *batch, *in_shape)`.
        contracted: number of axes of `in_shape`.
        more: rows, points read and weights `(*out_shape, *in_shape, e)` of entries beside.
        active: False at points that have no part in it; their results are zero.

    Returns:
        `(m, *batch, *out_shape)`.
    """
    u = switched_off(active, u)
    n, components = len(u), u.shape[u.ndim - contracted :]
    batch = u.shape[1 : u.ndim - contracted]
    out_shape, m = weights.shape[1 : weights.ndim - 1 - contracted], weights.shape[-1]
    if contracted > 1:  # all components along one axis
        one = (math.prod(components),)
        flat = lambda w: w.reshape(*w.shape[: w.ndim - 1 - contracted], *one, w.shape[-1])
        more = more and (*more[:2], flat(more[2]))
        weights, components, contracted = flat(weights), one, 1
    # A single column is gathered alone; of several, whole rows.
    values = u if u.ndim == 1 else u.reshape(n, -1, *components)
    total = sum_slots(weights, indices, values, contracted)
    if more is not None:
        rows, others, entries = more
        place = (*[slice(None)] * len(out_shape), rows)
        total = total.at[place].add(_term(entries, others, values, contracted))
    total = jnp.moveaxis(total.reshape(*out_shape, m, -1), -2, 0)
    return switched_off(active, jnp.moveaxis(total, -1, 1).reshape(m, *batch, *out_shape))


@functools.partial(jax.custom_jvp, nondiff_argnums=(3,))
def sum_slots(weights, indices, values, contracted: int):
    """All slots' terms, `(*out_shape, m, *batch)`; the last `contracted` axes are summed over."""

    def add(slot, total):
        w, j = (jax.lax.dynamic_index_in_dim(a, slot, keepdims=False) for a in (weights, indices))
        return total + _term(w, j, values, contracted)

    def add_group(i, total):
        for q in range(size):
            total = add(i * np.uint32(size) + np.uint32(q), total)
        return total

    if is_quick():
        return _scan_slots(weights, indices, values, contracted)
    size = machine().slots
    groups, left = divmod(len(indices), size)
    # Numbers without a sign need no code for negative ones.
    start = _zero(weights, values, contracted)
    total = jax.lax.fori_loop(np.uint32(0), np.uint32(groups), add_group, start)
    for slot in range(len(indices) - left, len(indices)):
        total = add(np.uint32(slot), total)
    return total


@functools.partial(sum_slots.defjvp, symbolic_zeros=True)
def _sum_slots_jvp(contracted, primals, tangents):
    # Bilinear. The tangents are sums one slot at a time, because JAX transposes a scan over slots
    # into one that writes each slot's part once.
    weights, indices, values = primals
    d_weights, _, d_values = tangents
    out = sum_slots(weights, indices, values, contracted)
    parts = []
    if not isinstance(d_weights, SymbolicZero):
        # For a single field all slots at once: transposed that is one product for each weight.
        single = values.ndim == 1 and weights.ndim == 2
        add = _all_slots if single else _scan_slots
        parts.append(add(d_weights, indices, values, contracted))
    if not isinstance(d_values, SymbolicZero):
        parts.append(_scan_slots(weights, indices, d_values, contracted))
    return out, sum(parts, jnp.zeros_like(out))


def _all_slots(weights, indices, values, contracted: int):
    return jnp.sum(weights * take(values, indices), axis=0)


def constant_product(weights, indices, x):
    """The product of a scalar operator that is a constant for derivatives, quick to compile."""
    if weights.size < machine().gathered and x.ndim == 1:
        return jnp.sum(weights * take(x, indices), axis=0)
    return _scan_slots(weights, indices, x, 0)


def _scan_slots(weights, indices, values, contracted: int):
    def add_slot(total, slot):
        w, j = slot
        return total + _term(w, j, values, contracted), None

    zero = _zero(weights, values, contracted)
    return jax.lax.scan(add_slot, zero, (weights, indices))[0]


def _term(w, j, values, contracted: int):
    """One slot's part: weights `(*out_shape, *in_shape, m)` times the neighbours' values."""
    neighbor = take(values, j)
    if contracted:
        return sum(w[..., i, :, None] * neighbor[..., i] for i in range(values.shape[-1]))
    return w * neighbor if values.ndim == 1 else w[..., None] * neighbor


def _zero(weights, values, contracted: int):
    out_shape, m = weights.shape[1 : weights.ndim - 1 - contracted], weights.shape[-1]
    shape = (*out_shape, m, *values.shape[1 : values.ndim - contracted])
    return jnp.zeros(shape, jnp.result_type(weights, values))
