r"""When lists of neighbours no longer serve the points that have moved."""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ..motion import stretch, unreached
from ..neighbors import Neighbors
from ..time.saving import AbstractCondition

# Points are added and merged where neighbourhoods have grown or shrunk by this factor, or two
# points have neared by that; a step that has taken them past its square is taken again, in parts.
STRETCH, _NEARED = 1.15, 0.7
# Lists are found anew once points outside may come as near as this share of the farthest in them.
_WORN = 0.75


class Worn(AbstractCondition):
    """True once lists do not serve well, from where the points were when they were found.

    Args:
        free: how far points may go before sheets may touch; None if that does not matter.
        uneven: also where neighbourhoods have become so much larger or smaller that points are to
            be added or merged.
    """

    points: Float[Array, "n d"]
    neighbors: Neighbors
    free: Float[Array, " n"] | None
    uneven: bool = eqx.field(static=True)

    def __call__(self, t, y, args, **_) -> Bool[Array, ""]:
        worn = unreached(self.points, y[0], self.neighbors, _WORN)
        if self.free is not None:
            worn = worn | (jnp.sum((y[0] - self.points) ** 2, axis=1) > self.free**2)
        if self.uneven:
            worn = worn | uneven(self.points, y[0], self.neighbors)
        return jnp.any(worn)


def uneven(before, after, neighbors: Neighbors, times: int = 1) -> Bool[Array, " n"]:
    """Where neighbourhoods have grown or shrunk, or two points neared, by more than a factor."""
    growth, least = stretch(before, after, neighbors)
    most = STRETCH**times
    return (growth > most) | (growth < 1 / most) | (least < _NEARED**times)
