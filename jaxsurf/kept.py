"""Properties that are computed once."""

from __future__ import annotations

from collections.abc import Callable

from jax.extend.core import get_opaque_trace_state

from .compiling import at_once
from .failures import is_concrete


class Kept:
    """A property that is computed once; where the owner is traced, once in each trace."""

    def __init__(self, make: Callable):
        self.make = make
        self.__doc__ = make.__doc__

    def __set_name__(self, owner, name):
        self.name = name

    def __get__(self, owner, kind=None):
        return self if owner is None else once(owner, self.name, lambda: self.make(owner))


def once(owner, key, make: Callable):
    """What is made of an owner, by key: once, or where the owner is traced, once in each trace."""
    kept = vars(owner).setdefault("_kept", {})
    if key in kept:
        return kept[key]
    if not is_concrete(owner):
        # Within other traces, of a branch or a derivative, it would leak from them.
        now = get_opaque_trace_state(convention="flax")
        traced = vars(owner).setdefault("_traced", {})
        if key not in traced or traced[key][0] != now:
            traced[key] = now, make()
        return traced[key][1]
    # Also where other things are traced: this is a constant of theirs.
    with at_once():
        kept[key] = make()
    return kept[key]
