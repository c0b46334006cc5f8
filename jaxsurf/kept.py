"""Properties that are computed once."""

from __future__ import annotations

from collections.abc import Callable

from .compiling import at_once
from .failures import is_concrete


class Kept:
    """A property that is computed once; anew where the owner is traced."""

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
            return self.make(owner)
        # Also where other things are traced: this is a constant of theirs.
        with at_once():
            kept[self.name] = self.make(owner)
        return kept[self.name]
