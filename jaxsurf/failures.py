"""One way to fail: what is known is checked now, what is traced goes with the result.

Where values are concrete an error is raised now, which names the first bad point, its number and
the one needed. Elsewhere the result carries a code (`Diagnostics`, `Discretization.code`,
`Solution.result`), or the compiled program raises an error when it runs.
"""

from __future__ import annotations

import dataclasses
import re
import sys
import warnings
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

# Asked by programs while they are traced; JAX keeps those apart that were told otherwise.
_marking = jax.make_user_context(default_value=False)


def marking() -> Any:
    """Within it, programs that are traced put NaN where there is anything bad, and go on.

    For searches, which try what may not exist.
    """
    return _marking(True)


def is_marking() -> bool:
    """Whether what is being traced is to put NaN where there is anything bad."""
    return _marking.value


def is_concrete(*trees: Any) -> bool:
    """True if no array in these is being traced, so that their values can be looked at."""
    return not any(isinstance(x, jax.core.Tracer) for x in jax.tree.leaves(trees))


def is_eager() -> bool:
    """True if what is computed of known numbers is known: nothing around it is being compiled."""
    return is_concrete(jnp.asarray(np.zeros(())))


def without_derivatives(tree: Any) -> Any:
    """The values that are being differentiated, where they are known: what choices are made by.

    Under `grad` and `jvp` these are concrete arrays; the tracers of `jit` and `vmap` stay.
    """
    return jax.tree.map(_beneath, tree)


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


def needs_values(what: str, *trees: Any, instead: str = "call it outside jit, vmap and grad"):
    """Refuse traced arrays where the host has to know their values.

    Args:
        what: names of the arguments.
        trees: that must hold no traced array.
        instead: what to do.

    Raises:
        ValueError: says both.
    """
    if not is_concrete(trees):
        raise ValueError(f"{what} must be concrete, not traced: {instead}")


def raise_at(
    bad: Any,
    message: str,
    values: Any = None,
    *,
    points: Any = None,
    error: type[Exception] = ValueError,
    **others: Any,
) -> None:
    """Raise an error that names the first bad point, its value, and how many there are.

    Args:
        bad: one for each point, `(m,)`, or one for all.
        message: with places {i} for the point, {v} for its value, {more} for how many more there
            are (else at the end), and for other values by their names.
        values: one for each point, with further axes or not; or one for all.
        points: which they are; None if they are counted from 0.
    """
    where = np.flatnonzero(bad)
    if where.size:
        at, told = np.unravel_index(where[0], np.shape(bad)), {"v": values} | others
        told = {name: np.asarray(x) for name, x in told.items() if f"{{{name}" in message}
        told = {name: x[at] if x.ndim else x[()] for name, x in told.items()}
        told["i"] = where[0] if points is None else np.asarray(points)[at]
        told["more"] = f" (and {where.size - 1} more)" if where.size > 1 else ""
        raise error((message if "{more}" in message else message + "{more}").format(**told))


def check(values: Any, bad: Callable, message: str, *others: Any, **how: Any) -> None:
    """Raise where values are bad, if they are known; what is traced is not looked at.

    Args:
        values: for {v} in the message.
        bad: which are, by these and others in NumPy.
        how: as in `raise_at`.
    """
    if is_concrete(values, others):
        known = [np.asarray(x) for x in (values, *others)]
        raise_at(bad(*known), message, known[0], **how)


def refuse(x: Any, bad: Any, message: str, values: Any = None, **how: Any) -> Any:
    """The array, but an error where there is anything bad: now, or when a compiled program runs.

    Args:
        bad: one for each point, or for all; concrete, or traced under `jit`, `vmap` and `grad`.
        message, values, how: as in `raise_at`.

    Raises:
        ValueError: names the first bad point, its value, and how many there are. Compiled programs
            cannot name them: theirs is an `EquinoxRuntimeError`. Those traced within `marking`
            have NaN in all of a floating-point array instead.
    """
    if is_concrete(bad):
        raise_at(bad, message, values, **how)
        return x
    if _marking.value:
        inexact = eqx.is_inexact_array(x)
        return jnp.where(jnp.any(bad), jnp.nan, x) if inexact else x
    message = message.replace("{more}", "")
    return eqx.error_if(x, bad, re.sub(r"\{\w+[^}]*\}", "(to be seen outside jit)", message))


def unchecked(cls: type, *values: Any, **named: Any) -> Any:
    """A module of fields that are known to be sound, none of which is looked at again.

    What a constructor cannot see in compiled code it leaves to the program (`refuse`), which
    takes time to compile: lists that were checked when they were made need none of it.
    """
    fields = dataclasses.fields(cls)
    given = {field.name: value for field, value in zip(fields, values)} | named
    made: Any = object.__new__(cls)
    for field in fields:
        object.__setattr__(made, field.name, given.get(field.name, field.default))
    return made


def not_positive(x: Any) -> Any:
    """Where numbers are not positive, or not finite."""
    return ~(np.isfinite(x) & (x > 0))


def not_finite(x: Any) -> Any:
    """Which rows have an entry that is not finite."""
    return ~np.isfinite(x).all(axis=tuple(range(1, np.ndim(x))))


# Packages that stand between a user's line and what is found by it.
_BETWEEN = {"jaxsurf", "jax", "equinox", "diffrax", "jaxtyping", "beartype", "contextlib"}


def warn(message: str) -> None:
    """A warning that names the line of the user's that led here, once for each such line."""
    frame, level = sys._getframe(1), 2
    while frame.f_back and frame.f_globals.get("__name__", "").split(".")[0] in _BETWEEN:
        frame, level = frame.f_back, level + 1
    warnings.warn(message, stacklevel=level)
