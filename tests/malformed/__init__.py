"""A corpus of malformed input: what users get wrong, and what they must be told.

One module for each part of the package, each with a list `CASES`; `tests/test_malformed.py` runs
them all, and checks that no public function is left out.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Case:
    """One malformed call.

    Args:
        function: the public name it is about, as in `js.<name>` (a method: its class's name).
        label: what is wrong, in a few words; function and label together are unique.
        call: makes the call. Everything it needs that is dear is shared and cached.
        words: each has to be in the message: the argument's name, the number (or type) that it had,
            the number needed, the point.
        right: for input that is unusual but fine: whether what came back is right. The call must
            then not raise.
    """

    function: str
    label: str
    call: Callable[[], Any]
    words: tuple[str, ...] = ()
    right: Callable[[Any], bool] | None = None

    def __post_init__(self):
        if bool(self.words) == (self.right is not None):
            raise ValueError(f"{self.id}: give the words of the message, or what is right")

    @property
    def id(self) -> str:
        return f"{self.function}: {self.label}"
