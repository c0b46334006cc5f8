r"""Lengths of steps by errors that are measured against the surface, wherever and however large."""

from __future__ import annotations

from typing import Any, NamedTuple

import diffrax as dfx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ..arguments import count_on, switched_off

# Errors of positions count as far as they exceed so many times their round-off, which grows with
# the distance from the origin: no shorter step makes that less.
_ROUND_OFF = 4


class RelativeToSurface(dfx.PIDController):
    r"""Steps of a state of points and fields, by errors of the points in units of the surface.

    A position x counts as $(x - m) / L$, with m the middle of the surface and L its size: with
    positions as they are, a surface far from the origin would be allowed errors in proportion to
    how far it is, and one in small units errors as large as itself.

    Args:
        active: False at points that are switched off; None if all are on.
    """

    active: Bool[Array, " n"] | None = None

    def init(self, terms, t0, t1, y0, dt0, args, func, error_order):
        units = _Units.of(y0[0], self.active)

        def rate(terms, t, y, args):
            return units.rate(func(terms, t, units.state(y), args))

        return super().init(terms, t0, t1, units.counted(y0), dt0, args, rate, error_order)

    def adapt_step_size(self, t0, t1, y0, y1_candidate, args, y_error, error_order, state):
        units = _Units.of(y0[0], self.active)
        lost = _ROUND_OFF * jnp.finfo(y0[0].dtype).eps * jnp.abs(y0[0])
        more = (jnp.maximum(jnp.abs(y_error[0]) - lost, 0), *y_error[1:])
        before, after, error = units.counted(y0), units.counted(y1_candidate), units.rate(more)
        return super().adapt_step_size(t0, t1, before, after, args, error, error_order, state)


class _Units(NamedTuple):
    """Where positions are measured from, and in what.

    Args:
        middle: m, the mean of the points.
        size: L, the root of the mean square of their distances from it.
    """

    middle: Float[Array, " d"]
    size: Float[Array, ""]

    @classmethod
    def of(cls, points: Float[Array, "n d"], active: Bool[Array, " n"] | None) -> _Units:
        mean = lambda x: jnp.sum(switched_off(active, x), axis=0) / count_on(active, len(x))
        middle = mean(points)
        size2 = mean(jnp.sum((points - middle) ** 2, axis=1))
        return cls(middle, jnp.sqrt(jnp.where(size2 > 0, size2, 1)))

    def counted(self, y: tuple) -> tuple[Any, ...]:
        return ((y[0] - self.middle) / self.size, *y[1:])

    def state(self, y: tuple) -> tuple[Any, ...]:
        return (self.middle + self.size * y[0], *y[1:])

    def rate(self, change: tuple) -> tuple[Any, ...]:
        """Of what is counted; so are errors, which a middle leaves alone too."""
        return (change[0] / self.size, *change[1:])
