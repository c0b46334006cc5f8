"""Loops over steps that are differentiated in reverse, with few arrays in their state."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PyTree

from ..failures import is_concrete

# Of the state that are kept for the reverse pass.
COPIES = 64


def count_steps(t0, t1, dt0) -> float | None:
    """How many steps of this length there are, but for round-off; None where that is not known."""
    if dt0 is None or not is_concrete(t0, t1, dt0):
        return None
    with np.errstate(divide="ignore", invalid="ignore"):
        return float(np.abs((np.asarray(t1) - np.asarray(t0)) / np.asarray(dt0)))


def most_steps(t0, t1, dt0, otherwise: int) -> int:
    """As many as copies, where so few steps of this length are known to be taken.

    The state of every step is kept then: none has to be chosen, and nothing that does is compiled.
    """
    steps = count_steps(t0, t1, dt0)
    return COPIES if steps is not None and steps < COPIES - 1 else otherwise


class RecursiveCheckpoints(dfx.RecursiveCheckpointAdjoint):
    """`diffrax.RecursiveCheckpointAdjoint` of a loop with all its counters in one array.

    Copies of the state are kept, put in order and loaded again array by array, each by kernels of
    its own, whatever its size: most of what was compiled for that was for counters.
    """

    @property
    def _loop(self) -> Callable:
        loop = super()._loop

        def with_few_arrays(*, outer_while_loop, **kwargs):
            outer = functools.partial(_with_counts_together, outer_while_loop)
            return loop(outer_while_loop=outer, **kwargs)

        return with_few_arrays


def _with_counts_together(while_loop: Callable, cond_fun, body_fun, init, *, buffers, **kwargs):
    """A loop whose state has its integers and booleans in one array."""
    init = jax.tree.map(jnp.asarray, init)
    # By name: within the loop buffers are objects, with leaves of their own.
    leaves = jax.tree.leaves_with_path(init)
    counts = [(name, leaf.dtype) for name, leaf in leaves if _counts(leaf)]
    places = {name: _Place(i, dtype) for i, (name, dtype) in enumerate(counts)}
    dtype = jnp.result_type(*(dtype for _, dtype in counts))

    def together(state) -> _State:
        leaves = jax.tree.leaves_with_path(state)
        numbers = [jnp.asarray(leaf, dtype) for name, leaf in leaves if name in places]
        others = [places.get(name, leaf) for name, leaf in leaves]
        return _State(jnp.stack(numbers), jax.tree.unflatten(jax.tree.structure(state), others))

    end = while_loop(
        lambda state: cond_fun(state.apart()),
        lambda state: together(body_fun(state.apart())),
        together(init),
        buffers=lambda state: buffers(state.others),
        **kwargs,
    )
    return end.apart()


def _counts(leaf: Array) -> bool:
    """Whether it is one number through which no derivative passes."""
    return leaf.ndim == 0 and jnp.result_type(leaf) in (jnp.bool_, jnp.int32, jnp.int64)


class _Place(eqx.Module):
    """Of a number in the array of all of them, and its type. It has no leaves."""

    index: int = eqx.field(static=True)
    dtype: Any = eqx.field(static=True)


class _State(eqx.Module):
    """The state of a loop: its counters, and the rest with their places in their stead."""

    counts: Array
    others: PyTree[Any]

    def apart(self) -> PyTree[Any]:
        """As the loop knows it."""
        is_place = lambda x: isinstance(x, _Place)
        number = lambda x: self.counts[x.index].astype(x.dtype) if is_place(x) else x
        return jax.tree.map(number, self.others, is_leaf=is_place)
