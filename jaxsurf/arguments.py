"""What public functions ask of their arguments.

A wrong type is a `TypeError`, a wrong shape or value a `ValueError`; both name the argument, what
it was and what is needed. Values are looked at only where arrays are concrete (`failures.py`).
"""

from __future__ import annotations

import math
import operator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from .failures import check, is_concrete, needs_values, not_finite, raise_at


def as_float(x: Any, name: str = "array", *shapes: tuple) -> Float[Array, "..."]:
    """The array as it is if it is of a floating-point type, else in the default one.

    Args:
        shapes: as in `shaped`; any if there are none.

    Raises:
        TypeError: what is no array of real numbers: complex numbers, text, objects, ragged lists.
        ValueError: another shape.
    """
    if not isinstance(x, jax.Array):
        x = _real_numbers(x, name)
        kind = x.dtype if jnp.issubdtype(x.dtype, jnp.floating) else jnp.result_type(float)
        with jax.core.eval_context():  # a copy, where `jnp.asarray` compiles one for every shape
            x = jax.device_put(np.asarray(x, kind))
    if jnp.issubdtype(x.dtype, jnp.complexfloating):
        raise TypeError(f"{name} is complex ({x.dtype}), expected real numbers")
    x = shaped(x, name, *shapes)
    return x if jnp.issubdtype(x.dtype, jnp.floating) else x.astype(jnp.result_type(float))


def same_values(a: Any, b: Any) -> bool:
    """Whether two pytrees of one structure hold the same numbers; compiles nothing."""
    return all(np.array_equal(*pair) for pair in zip(jax.tree.leaves(a), jax.tree.leaves(b)))


def on_host(x: Any, name: str = "array", *shapes: tuple) -> np.ndarray:
    """The array in NumPy and double precision, for what is done on the host.

    Args:
        shapes: as in `shaped`; any if there are none.

    Raises:
        TypeError: no array of real numbers.
        ValueError: traced, or of another shape.
    """
    needs_values(name, x, instead="give it from outside jit, vmap and grad")
    if isinstance(x, jax.Array):
        x = np.asarray(as_float(x, name))
    return shaped(_real_numbers(x, name), name, *shapes).astype(float)


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


def finite(x: Array, name: str, on: Any = None, points: Any = None) -> Array:
    """The array, of which every concrete entry must be a finite number.

    Args:
        on: rows that are looked at; None for all.
        points: which points the rows are; None for all.

    Raises:
        ValueError: names the first row with an entry that is not.
    """
    looked_at = True if on is None or np.shape(x)[:1] != np.shape(on) else on
    text = f"{name} is not finite{' at point {i}' if np.ndim(x) else ''}: {{v}}"
    check(x, lambda x, on: on & not_finite(x), text, looked_at, points=points)
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


def flag(value: Any, name: str) -> bool:
    """True or False.

    Raises:
        TypeError: anything else, like 1, None or 'no'.
    """
    if not isinstance(value, bool | np.bool_):
        raise TypeError(f"{name} is {_short(value)}, expected True or False")
    return bool(value)


def traced_call(f: Any, name: str, *args: Any) -> Any:
    """What a function of the user's returns while JAX traces it.

    Raises:
        TypeError: it is not made of operations of JAX.
    """
    try:
        return f(*args)
    except (jax.errors.TracerArrayConversionError, jax.errors.ConcretizationTypeError) as error:
        reason = str(error).splitlines()[0]
        raise TypeError(
            f"{name} needs values where JAX has only shapes: write it with jax.numpy in place of "
            f"NumPy, and jnp.where in place of `if` ({reason})"
        ) from error


def pair(value: Any, name: str, what: str) -> tuple:
    """Two things.

    Raises:
        TypeError, ValueError: anything else, with what is expected.
    """
    if not isinstance(value, tuple | list):
        raise TypeError(f"{name} is {_short(value)}, expected a pair: {what}")
    if len(value) != 2:
        raise ValueError(f"{name} has {len(value)} parts, expected 2: {what}")
    return tuple(value)


def further(args: Any) -> tuple:
    """Further arguments of a function, as a tuple.

    Raises:
        TypeError: a number or array in place of a tuple of one.
    """
    if not isinstance(args, tuple | list):
        raise TypeError(f"args is {_short(args)}, expected a tuple: (value,) for one")
    return tuple(args)


def instance(value: Any, kinds: type | tuple[type, ...], name: str, hint: str = "") -> Any:
    """The value, which must be of one of these classes.

    Raises:
        TypeError: names its class and those needed, with a hint at the way from one to the other.
    """
    if not isinstance(value, kinds):
        kinds = kinds if isinstance(kinds, tuple) else (kinds,)
        needed = " or ".join(kind.__name__.removeprefix("Abstract") for kind in kinds)
        if isinstance(getattr(value, "cloud", None), kinds):  # a surface in place of its points
            hint = "its .cloud is one"
        more = f": {hint}" if hint else ""
        article = "an" if needed[0] in "AEIO" else "a"
        raise TypeError(f"{name} is {_short(value)}, expected {article} {needed}{more}")
    return value


def shaped(x: Any, name: str, *shapes: tuple) -> Any:
    """The array, which must be of one of these shapes, if any are named.

    Args:
        shapes: lengths of axes, with names for those of any length and ... for any number of axes:
            `(5,)`, `("n", 2)`, `(5, ...)`.

    Raises:
        ValueError: gives its shape and those expected.
    """
    if shapes and not any(_fits(np.shape(x), shape) for shape in shapes):
        expected = " or ".join(_told(shape) for shape in shapes)
        have = "have" if name.endswith("s") and not name.endswith("ss") else "has"
        raise ValueError(f"{name} {have} shape {np.shape(x)}, expected {expected}")
    return x


def as_many(what: str, n: int, other: str, wanted: int) -> None:
    """Refuse what belongs to another number of points.

    Raises:
        ValueError: gives both numbers.
    """
    if n != wanted:
        raise ValueError(f"{what} of {n} points, {other} has {wanted}")


# Shapes of points and of vectors at them.
POINTS = (("n", 2), ("n", 3))


def is_array(x: Any) -> bool:
    """True for an array or what stands for one while JAX traces; False for other leaves."""
    return isinstance(x, jax.Array | np.ndarray)


def precision_of(*trees: PyTree) -> Any:
    """The floating type that combines those of all arrays; that of numbers where there are none."""
    kinds = [leaf.dtype for leaf in jax.tree.leaves(trees) if is_array(leaf)]
    found = [kind for kind in kinds if jnp.issubdtype(kind, jnp.inexact)]
    return jnp.result_type(*found) if found else jnp.result_type(float)


def more_digits(dtype: Any) -> str:
    """The way to more digits than a precision has, where there is one."""
    return "" if dtype == jnp.float64 else ": for more digits set jax_enable_x64"


def within_round_off(rtol: Any, dtype: Any, name: str = "rtol") -> None:
    """Refuse a relative tolerance that is none, or that a precision cannot reach.

    Raises:
        TypeError, ValueError: with the least one there.
    """
    real(rtol, name, above=0, below=1)
    least = 4 * float(jnp.finfo(dtype).eps)
    if is_concrete(rtol) and rtol < least:
        need = f"{dtype} allows at least {least:.1e}"
        raise ValueError(f"{name} = {float(rtol):g}, {need}{more_digits(dtype)}")


def differentiable(f: Any, name: str, *arguments: jax.ShapeDtypeStruct) -> Any:
    """The shapes that a function returns, which must be one that JAX can trace.

    Args:
        f: of arrays of these shapes.
        arguments: their shapes and types.

    Raises:
        TypeError: no function, or one that turns its arguments into NumPy arrays or numbers.
        Exception: the function's own, with a note that says what it was called with.
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
    except Exception as error:
        shapes = ", ".join(str(x.shape) for x in jax.tree.leaves(arguments))
        error.add_note(f"{name} was called with {shapes}: arrays of these shapes are what it gets")
        raise


def _fits(given: tuple, wanted: tuple) -> bool:
    if ... in wanted and len(given) >= len(wanted) - 1:
        at, after = wanted.index(...), len(given) - len(wanted) + 1
        given, wanted = given[:at] + given[at + after :], wanted[:at] + wanted[at + 1 :]
    pairs = zip(given, wanted)
    return len(given) == len(wanted) and all(isinstance(w, str) or g == w for g, w in pairs)


def _told(shape: tuple) -> str:
    words = ["..." if a is ... else str(a) for a in shape]
    return f"({', '.join(words)}{',' * (len(words) == 1)})"


def _real_numbers(x: Any, name: str) -> np.ndarray:
    """What is given, as an array of NumPy."""
    try:
        given = np.asarray(x)
    except ValueError as error:  # ragged
        raise TypeError(f"{name} is no array of numbers: {error}") from None
    if given.dtype.kind not in "fiub" and not jnp.issubdtype(given.dtype, jnp.floating):
        raise TypeError(f"{name} is {described(x, given)}, expected an array of real numbers")
    return given


def _short(value: Any) -> str:
    """A value as it is told in a message."""
    if hasattr(value, "shape") and hasattr(value, "dtype") and np.ndim(value) > 0:
        return described(value, value)
    if isinstance(value, type):
        return f"the class {value.__name__}"
    text = repr(value)
    kind = type(value).__name__
    return f"{text} ({kind})" if len(text) <= 40 else f"a {kind}"


def described(value: Any, array: Any) -> str:
    """What was given, which as an array is this, as it is told in a message."""
    if isinstance(value, str | bytes) or value is None or array.shape == ():
        return _short(value)
    kind = {"O": "objects", "U": "text", "S": "text"}.get(array.dtype.kind, str(array.dtype))
    return f"an array of {kind} of shape {array.shape}"


def floating(tree: Any, name: str) -> Any:
    """The tree with its leaves as arrays, which have to be of a floating-point type."""
    leaves = jax.tree.leaves(tree)
    if not leaves:
        raise ValueError(f"{name} has no arrays")
    for leaf in leaves:
        kind = getattr(leaf, "dtype", type(leaf).__name__)
        if kind != "float" and (isinstance(kind, str) or not jnp.issubdtype(kind, jnp.floating)):
            raise TypeError(f"{name} has a leaf of type {kind}, expected floating-point arrays")
    return jax.tree.map(lambda leaf: finite(jnp.asarray(leaf), name), tree)


def per_point(value: Any, n: int, name: str) -> Float[Array, "*n"]:
    """A number or one number per point, as an array; else an error."""
    return as_float(value, name, (), (n,))
