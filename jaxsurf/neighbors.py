"""Neighbourhoods of fixed size: which points take part in the stencil of which."""

from __future__ import annotations

import equinox as eqx
from jaxtyping import Array, Bool, Float, Int


class Neighbors(eqx.Module):
    """Padded neighbour lists.

    Slot 0 of every row is the point itself; k counts it. A padded slot repeats the row's own
    point with mask False, so that every gather is legal.

    Args:
        indices: `(n, k)`, int32, sorted by distance within a row.
        mask: `(n, k)`, True where a slot holds a neighbour.
        radius: the search radius, scalar or `(n,)`, for lists made with a radius: operators
            then let their kernels vanish smoothly there. None for the k nearest.
    """

    indices: Int[Array, "n k"]
    mask: Bool[Array, "n k"]
    radius: Float[Array, "*n"] | None = None

    @property
    def n(self) -> int:
        return self.indices.shape[0]

    @property
    def k(self) -> int:
        return self.indices.shape[1]
