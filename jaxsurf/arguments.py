"""What public functions ask of their arguments, and how they say what is wrong with them.

A wrong type is a `TypeError`, a wrong shape or value a `ValueError`; both name the argument, what
it was and what is needed. Values are looked at only where arrays are concrete.
"""

from __future__ import annotations

import math
import operator
import re
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int


def is_concrete(*arrays: Any) -> bool:
    """True if none of the arrays is being traced, so that their values can be looked at."""
    return not any(isinstance(a, jax.core.Tracer) for a in arrays)


def without_derivatives(tree: Any) -> Any:
    """The values that are being differentiated, where they are known: what choices are made by.

    Under `grad` and `jvp` these are concrete arrays; the tracers of `jit` and `vmap` stay.
    """
    leaves, structure = jax.tree.flatten(tree)
    return jax.tree.unflatten(structure, [_beneath(x) for x in leaves])


def _beneath(x: Any) -> Any:
    if is_concrete(x) or not jnp.issubdtype(x.dtype, jnp.inexact):
        return x
    seen = []

    @jax.custom_jvp
    def look(x):
        seen.append(x)
        return x

    # A rule is called with what its transformation differentiates: one level after another.
    look.defjvp(lambda primals, tangents: (look(*primals), *tangents))
    look(x)
    return seen[-1]


def raise_at(bad: np.ndarray, message: str, values: np.ndarray) -> None:
    """Raise a ValueError that names the first bad index, its value, and how many there are."""
    where = np.flatnonzero(bad)
    if where.size:
        text = message.format(i=where[0], v=values[where[0]])
        more = f" (and {where.size - 1} more)" if where.size > 1 else ""
        raise ValueError(text + more)


def refuse(x: Array, bad: Array, message: str, values: Array) -> Array:
    """The array, but an error where there is anything bad: now, or when a compiled program runs.

    Args:
        bad: one for each point; concrete, or traced under `jit`, `vmap` and `grad`.
        message: with places {i} for the point and {v} for its value.

    Raises:
        ValueError: names the first bad point, its value, and how many there are. Compiled programs
            cannot name them: theirs is an `EquinoxRuntimeError`.
    """
    if is_concrete(bad):
        raise_at(np.asarray(bad), message, np.asarray(values))
        return x
    return eqx.error_if(x, bad, re.sub(r"\{[iv][^}]*\}", "(to be seen outside jit)", message))


def as_float(x: Any, name: str = "array") -> Float[Array, "..."]:
    """The array as it is if it is of a floating-point type, else in the default one.

    Raises:
        TypeError: what is no array of real numbers: complex numbers, text, objects, ragged lists.
    """
    if not isinstance(x, jax.Array):
        x = jnp.asarray(_real_numbers(x, name))
    if jnp.issubdtype(x.dtype, jnp.complexfloating):
        raise TypeError(f"{name} is complex ({x.dtype}), expected real numbers")
    return x if jnp.issubdtype(x.dtype, jnp.floating) else x.astype(jnp.result_type(float))


def on_host(x: Any, name: str = "array") -> np.ndarray:
    """The array in NumPy and double precision, for what is done on the host.

    Raises:
        TypeError: traced, or no array of real numbers.
    """
    if not is_concrete(x):
        raise TypeError(f"{name} must be concrete: give it from outside jit, vmap and grad")
    if isinstance(x, jax.Array):
        x = np.asarray(as_float(x, name))
    return _real_numbers(x, name).astype(float)


def switched_off(on: Any, x: Any, value: Any = 0) -> Array:
    """An array of one row for each point, with a value in the rows of those that are switched off.

    What stands there has no part in anything, nor in derivatives.

    Args:
        on: True at points that are on, `(n,)`; None if all are.
    """
    if on is None:
        return x
    value = jnp.asarray(value, jnp.result_type(x))
    return jnp.where(jnp.reshape(on, (-1, *(1,) * (jnp.ndim(x) - 1))), x, value)


def count_on(on: Any, n: int) -> Any:
    """How many of n points are on; None: all."""
    return n if on is None else jnp.maximum(jnp.sum(on), 1)


def in_range(values: Any, name: str) -> Any:
    """The values, of which none may be so large that squares and cubes of lengths overflow.

    Raises:
        ValueError: names the first row with a number that is too large.
    """
    largest = float(np.finfo(float).max ** (1 / 3))
    size = np.abs(np.atleast_1d(np.asarray(values, float)))
    size = size.max(axis=tuple(range(1, size.ndim)), initial=0)
    text = f"{name}: size {{v:.3g}} in row {{i}}, at most {largest:.3g} can be calculated with"
    raise_at(size > largest, text, size)
    return values


def finite(x: Array, name: str, on: Any = None) -> Array:
    """The array, of which every concrete entry must be a finite number.

    Args:
        on: rows that are looked at; None for all.

    Raises:
        ValueError: names the first row with an entry that is not.
    """
    if is_concrete(x, on):
        values = np.asarray(x)
        good = np.isfinite(values)
        if on is not None and values.shape[:1] == np.shape(on):
            good = good | ~np.asarray(on).reshape(-1, *(1,) * (values.ndim - 1))
        if values.ndim == 0 and not good:
            raise ValueError(f"{name} is {values}, expected a finite number")
        if not good.all():
            bad = ~good.reshape(len(values), -1).all(axis=1)
            raise_at(bad, f"{name} is not finite at point {{i}}: {{v}}", values)
    return x


def whole(value: Any, name: str, *, least: int | None = None, most: int | None = None) -> int:
    """A whole number as an `int`, within bounds.

    Raises:
        TypeError: not a whole number, like 2.5, True or '3'.
        ValueError: out of bounds (both numbers given).
    """
    try:
        if isinstance(value, bool | np.bool_):
            raise TypeError
        number = operator.index(value)
    except TypeError:
        raise TypeError(f"{name} is {_short(value)}, expected a whole number") from None
    if least is not None and number < least:
        raise ValueError(f"{name} = {number}, at least {least} is needed")
    if most is not None and number > most:
        raise ValueError(f"{name} = {number}, at most {most} is possible")
    return number


def real(
    value: Any,
    name: str,
    *,
    above: float = -math.inf,
    below: float = math.inf,
    least: float = -math.inf,
    most: float = math.inf,
) -> Any:
    """A real number, returned as it came: finite and within bounds if it is concrete.

    Raises:
        TypeError: not a number: text, None, an array of several, a complex number.
        ValueError: not finite, or out of bounds (value and bound given).
    """
    if isinstance(value, str | bytes | bool | np.bool_ | None.__class__) or np.ndim(value) != 0:
        raise TypeError(f"{name} is {_short(value)}, expected a real number")
    as_float(value, name)
    if is_concrete(value):
        number = float(value)
        bounds = (
            (above, "above", number > above), (below, "below", number < below),
            (least, "at least", number >= least), (most, "at most", number <= most),
        )  # fmt: skip
        wanted = [f"{word} {b:g}" for b, word, _ in bounds if math.isfinite(b)]
        if not (math.isfinite(number) and all(ok for b, _, ok in bounds if math.isfinite(b))):
            what = " and ".join(wanted) if wanted else "a finite number"
            raise ValueError(f"{name} = {number:g}, expected {what}")
    return value


def instance(value: Any, kinds: type | tuple[type, ...], name: str, hint: str = "") -> Any:
    """The value, which must be of one of these classes.

    Raises:
        TypeError: names its class and those needed, with a hint at the way from one to the other.
    """
    if not isinstance(value, kinds):
        kinds = kinds if isinstance(kinds, tuple) else (kinds,)
        needed = " or ".join(kind.__name__.removeprefix("Abstract") for kind in kinds)
        more = f": {hint}" if hint else ""
        article = "an" if needed[0] in "AEIO" else "a"
        raise TypeError(f"{name} is {_short(value)}, expected {article} {needed}{more}")
    return value


def mask(value: Any, n: int, name: str) -> Bool[Array, " n"]:
    """A mask over n points.

    Raises:
        TypeError: not of type bool, like a list of indices.
        ValueError: another length than n (both given).
    """
    given = value if isinstance(value, jax.Array) else np.asarray(value)
    if given.dtype != bool:
        what = _described(value, given)
        raise TypeError(f"{name} is {what}, expected a mask: one bool for each of {n} points")
    if given.shape != (n,):
        raise ValueError(f"{name} has shape {given.shape}, expected ({n},)")
    return jnp.asarray(given)


def indices_of(where: Any, n: int | None, name: str) -> Int[np.ndarray, " m"]:
    """Points named by a mask over n points or by their indices, as indices in the order given.

    Args:
        where: concrete.
        n: number of points; None where it is not known yet, which then is not checked.

    Raises:
        TypeError: traced, or neither a mask nor indices.
        ValueError: a mask of another length, an index out of range or given twice.
    """
    if not is_concrete(where):
        raise TypeError(f"{name} must be concrete: which points it names decides shapes")
    given = np.asarray(where)
    if given.ndim != 1 or not (given.dtype.kind in "bui" or given.size == 0):
        raise TypeError(
            f"{name} is {_described(where, given)}, expected a mask over the points or indices, 1-D"
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


def point_indices(indices: Any, name: str, *, axes: str, n: int) -> None:
    """Check an array of indices of points, whose points run along its axis `n` (0 or -1).

    Raises:
        TypeError: not of an integer type.
        ValueError: not two axes, no points or slots; on concrete arrays an index that is no point.
    """
    if not jnp.issubdtype(indices.dtype, jnp.integer):
        raise TypeError(f"{name} are {indices.dtype}, expected integers")
    if indices.ndim != 2 or 0 in indices.shape:
        raise ValueError(f"{name} have shape {indices.shape}, expected {axes}, both at least 1")
    if is_concrete(indices):
        given, count = np.asarray(indices), indices.shape[n]
        if given.min() < 0 or given.max() >= count:
            where = np.argwhere((given < 0) | (given >= count))[0]
            wrong, row = given[tuple(where)], where[n]
            raise ValueError(f"{name} of point {row} name point {wrong}, there are {count}")


def is_array(x: Any) -> bool:
    """True for an array or what stands for one while JAX traces; False for other leaves."""
    return isinstance(x, jax.Array | np.ndarray)


def differentiable(f: Any, name: str, *arguments: jax.ShapeDtypeStruct) -> Any:
    """The shapes that a function returns, which must be one that JAX can trace.

    Args:
        f: of arrays of these shapes.
        arguments: their shapes and types.

    Raises:
        TypeError: no function, or one that turns its arguments into NumPy arrays or numbers.
    """
    if not callable(f):
        raise TypeError(f"{name} is {_short(f)}, expected a function")
    try:
        return jax.eval_shape(f, *arguments)
    except (jax.errors.TracerArrayConversionError, jax.errors.ConcretizationTypeError) as error:
        what = str(error).splitlines()[0]
        raise TypeError(
            f"{name} cannot be traced by JAX; write it with jax.numpy in place of NumPy, math and"
            f" conditions on values ({what})"
        ) from None


def _real_numbers(x: Any, name: str) -> np.ndarray:
    """What is given, as an array of NumPy."""
    try:
        given = np.asarray(x)
    except ValueError as error:  # ragged
        raise TypeError(f"{name} is no array of numbers: {error}") from None
    if given.dtype.kind not in "fiub" and not jnp.issubdtype(given.dtype, jnp.floating):
        raise TypeError(f"{name} is {_described(x, given)}, expected an array of real numbers")
    return given


def _short(value: Any) -> str:
    """A value as it is told in a message."""
    if hasattr(value, "shape") and hasattr(value, "dtype") and np.ndim(value) > 0:
        return _described(value, value)
    text = repr(value)
    kind = type(value).__name__
    return f"{text} ({kind})" if len(text) <= 40 else f"a {kind}"


def _described(value: Any, array: Any) -> str:
    if isinstance(value, str | bytes) or value is None or array.shape == ():
        return _short(value)
    kind = {"O": "objects", "U": "text", "S": "text"}.get(array.dtype.kind, str(array.dtype))
    return f"an array of {kind} of shape {array.shape}"
