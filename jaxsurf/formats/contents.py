"""What a file holds, in one form for all formats."""

from __future__ import annotations

from dataclasses import dataclass, field

from jaxtyping import Float, Int
from numpy import ndarray as Array


@dataclass(frozen=True, eq=False)
class Contents:
    """What a file holds, before any check of its meaning.

    Args:
        points: `(n, 3)`, or `(n, 2)` for a plane curve.
        faces: polygons as vertex numbers from 0, one array `(m, corners)` per run of equal size.
        normals: `(n, d)` as found, of any length; None if there are none.
        fields: other values per point, `(n,)` or `(n, c)`.
        notes: what was converted on the way, in words.
    """

    points: Float[Array, "n d"]
    faces: list[Int[Array, "m corners"]] = field(default_factory=list)
    normals: Float[Array, "n d"] | None = None
    fields: dict[str, Array] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)


def complete(what: str, announced: int, found: int) -> None:
    if found < announced:
        raise ValueError(f"truncated: {announced} {what} announced, {found} found")
