"""Masks of points, of which any may be None for want of one."""

import jax.numpy as jnp
import numpy as np

from ..failures import is_concrete


def either(one, other):
    """True where one of two masks is, of which either may be None."""
    return _combined("logical_or", one, other)


def both(one, other):
    """True where two masks are, of which either may be None: true everywhere."""
    return _combined("logical_and", one, other)


def _combined(how: str, one, other):
    if one is None or other is None or one is other:
        return other if one is None else one
    return getattr(np if is_concrete(one, other) else jnp, how)(one, other)
