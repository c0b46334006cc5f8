"""Annotations are checked while the tests run: jaxtyping with beartype.

Arguments are looked at only after a function has returned, together with what it returns. So what
a function should refuse, it has to refuse itself, in its own words; if it returns all the same,
either the function or its annotation is wrong. Arrays of NumPy are as good as JAX's, but not as a
result: annotations that name these are read as naming both, once this module has been imported.
"""

import functools
import types
import typing
from typing import Any

import jax
import jaxtyping
import numpy as np
from beartype import BeartypeConf, beartype


class _OfNumPy(type):
    def __instancecheck__(cls, x):
        return isinstance(x, np.ndarray | np.generic)


class AsGood(metaclass=_OfNumPy):
    """An array of NumPy where one of JAX is due."""


# Before the package is imported: what fails a first check is written out in full, which takes
# longer than all checks.
jaxtyping.Array = jax.Array | AsGood
# An int is as good as a float.
_strict = beartype(conf=BeartypeConf(is_pep484_tower=True))


def check(function):
    """A type checker as jaxtyping wants it, for one that is called twice.

    It makes two functions of every signature: one for the arguments before the call, whose result
    may be anything and which is left alone, and one for arguments and result after it.
    """
    hint = function.__annotations__.get("return")
    if hint is Any:
        return function
    strict = _strict(function)
    if not _is_of_jax(hint):
        return strict

    @functools.wraps(function)
    def checked(*args, **kwargs):
        found = strict(*args, **kwargs)
        # The kind that goes in may come out. What came out is among the arguments here.
        given = [a for a in (*args, *kwargs.values()) if a is not found]
        if isinstance(found, AsGood) and not any(isinstance(a, AsGood) for a in given):
            raise TypeError(f"the result is a {type(found).__name__}, {hint} is an array of JAX")
        return found

    return checked


def _is_of_jax(hint) -> bool:
    """Whether it names arrays of JAX, and none of NumPy beside: what is returned is one."""
    kinds = [getattr(part, "array_type", part) for part in typing.get_args(hint)]
    return AsGood in kinds and np.ndarray not in kinds


def _where_there_are_any(*, typechecker):
    """What the import hook puts around every function, also whenever one within another is made."""
    checked = _jaxtyped(typechecker=typechecker)
    bare = lambda f: isinstance(f, types.FunctionType) and not f.__annotations__
    return lambda f: f if bare(f) else checked(f)


_jaxtyped, jaxtyping.jaxtyped = jaxtyping.jaxtyped, _where_there_are_any
