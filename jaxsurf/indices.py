"""Points named by masks and by indices, as public functions ask for them."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Int

from .arguments import described, shaped
from .failures import is_concrete, needs_values, raise_at, refuse


def mask(value: Any, n: int, name: str) -> Bool[Array, " n"]:
    """A mask over n points.

    Raises:
        TypeError: not of type bool, like a list of indices.
        ValueError: another length than n (both given).
    """
    given = value if isinstance(value, jax.Array) else np.asarray(value)
    if given.dtype != bool:
        what = described(value, given)
        raise TypeError(f"{name} is {what}, expected a mask: one bool for each of {n} points")
    return jnp.asarray(shaped(given, name, (n,)))


def indices_of(where: Any, n: int | None, name: str) -> Int[np.ndarray, " m"]:
    """Points named by a mask over n points or by their indices, as indices in the order given.

    Args:
        where: concrete.
        n: number of points; None where it is not known yet, which then is not checked.

    Raises:
        TypeError: neither a mask nor indices.
        ValueError: traced, a mask of another length, an index out of range or given twice.
    """
    needs_values(name, where, instead="which points it names decides shapes")
    given = np.asarray(where)
    if given.ndim != 1 or not (given.dtype.kind in "bui" or given.size == 0):
        raise TypeError(
            f"{name} is {described(where, given)}, expected a mask over the points or indices, 1-D"
        )
    if given.dtype == bool:
        if n is not None and len(given) != n:
            raise ValueError(f"{name} is a mask of {len(given)} points, there are {n}")
        return np.flatnonzero(given).astype(np.int32)
    if n is not None:
        raise_at((given < 0) | (given >= n), f"{name} names point {{v}}, there are {n}", given)
    unique, count = np.unique(given, return_counts=True)
    if count.max(initial=1) > 1:
        raise ValueError(f"{name} names point {unique[np.argmax(count)]} {count.max()} times")
    return given.astype(np.int32)


def point_indices(indices: Any, name: str, *, axes: str, n: int) -> Any:
    """An array of indices of points, whose points run along its axis `n` (0 or -1), checked.

    Under `jit` and `vmap` an index that is no point is an error when the program runs.

    Raises:
        TypeError: not of an integer type.
        ValueError: not two axes, no points or slots; on concrete arrays an index that is no point.
    """
    if not jnp.issubdtype(indices.dtype, jnp.integer):
        raise TypeError(f"{name} are {indices.dtype}, expected integers")
    if indices.ndim != 2 or 0 in indices.shape:
        raise ValueError(f"{name} have shape {indices.shape}, expected {axes}, both at least 1")
    count = indices.shape[n]
    points = np.arange(count).reshape((-1, 1) if n == 0 else (1, -1))
    points = np.broadcast_to(points, indices.shape)
    text = f"{name} of point {{i}} name point {{v}}, there are {count}"
    # What is known is looked at on the host: it stays known in compiled code, and compiles nothing.
    seen = np.asarray(indices) if is_concrete(indices) else indices
    wide = seen.astype(jnp.promote_types(indices.dtype, jnp.int32))
    return refuse(indices, (wide < 0) | (wide >= count), text, seen, points=points)
