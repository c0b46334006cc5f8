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
        if owner is None:
            return self
        kept = vars(owner).setdefault("_kept", {})
        if self.name in kept:
            return kept[self.name]
        if not is_concrete(owner):
            # Within other traces, of a branch or a derivative, it would leak from them.
            now = get_opaque_trace_state(convention="flax")
            traced = vars(owner).setdefault("_traced", {})
            if self.name not in traced or traced[self.name][0] != now:
                traced[self.name] = now, self.make(owner)
            return traced[self.name][1]
        # Also where other things are traced: this is a constant of theirs.
        with at_once():
            kept[self.name] = self.make(owner)
        return kept[self.name]
