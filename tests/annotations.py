"""Annotations are checked while the tests run: jaxtyping with beartype.

Arguments are looked at only after a function has returned, together with what it returns. So what
a function should refuse, it has to refuse itself, in its own words; if it returns all the same,
either the function or its annotation is wrong. Arrays of NumPy are as good as JAX's: annotations
that name these are read as naming both, once this module has been imported.
"""

import types
from typing import Any

import jax
import jaxtyping
import numpy as np
from beartype import BeartypeConf, beartype

# Before the package is imported: what fails a first check is written out in full, which takes
# longer than all checks.
jaxtyping.Array = jax.Array | np.ndarray | np.generic
# An int is as good as a float.
_strict = beartype(conf=BeartypeConf(is_pep484_tower=True))


def check(function):
    """A type checker as jaxtyping wants it, for one that is called twice.

    It makes two functions of every signature: one for the arguments before the call, whose result
    may be anything and which is left alone, and one for arguments and result after it.
    """
    return function if function.__annotations__.get("return") is Any else _strict(function)


def _where_there_are_any(*, typechecker):
    """What the import hook puts around every function, also whenever one within another is made."""
    checked = _jaxtyped(typechecker=typechecker)
    bare = lambda f: isinstance(f, types.FunctionType) and not f.__annotations__
    return lambda f: f if bare(f) else checked(f)


_jaxtyped, jaxtyping.jaxtyped = jaxtyping.jaxtyped, _where_there_are_any
