"""Annotations are checked while the tests run: jaxtyping with beartype.

Arguments are looked at only after a function has returned, together with what it returns. So what
a function should refuse, it has to refuse itself, in its own words; if it returns all the same,
either the function or its annotation is wrong. Arrays of NumPy are as good as JAX's.
"""

import functools
from typing import Any

import jax
import numpy as np
from beartype import BeartypeConf, beartype
from beartype.roar import BeartypeCallHintParamViolation

# An int is as good as a float.
_strict = beartype(conf=BeartypeConf(is_pep484_tower=True))


def check(function):
    """A type checker as jaxtyping wants it, for one that is called twice.

    It makes two functions of every signature: one for the arguments before the call, whose result
    may be anything and which is left alone, and one for arguments and result after it.
    """
    if function.__annotations__.get("return") is Any:
        return function
    strict = _strict(function)

    @functools.wraps(function)
    def checked(*args, **kwargs):
        try:
            return strict(*args, **kwargs)
        except BeartypeCallHintParamViolation:
            kwargs = {name: _as_jax(value) for name, value in kwargs.items()}
            return strict(*map(_as_jax, args), **kwargs)

    return checked


def _as_jax(value):
    if not isinstance(value, np.ndarray | np.generic):
        return value
    with jax.core.eval_context():  # a copy, for which nothing is compiled
        return jax.device_put(value)
