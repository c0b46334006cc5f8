r"""Step size controllers that stop where a solution leaves what it can be."""

from __future__ import annotations

from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PyTree

from .states import root_mean_square


class Guard(eqx.Module):
    """What no accepted state may be.

    Args:
        limit: the largest root mean square of a state; infinite for none.
        refused: True if no step is to be taken at all.
    """

    limit: Float[Array, ""]
    refused: Bool[Array, ""]

    def stops(self, y: PyTree[Array]) -> Bool[Array, ""]:
        """True if entries are not finite or too large together."""
        finite = [jnp.all(jnp.isfinite(leaf)) for leaf in jax.tree.leaves(y)]
        return ~(jnp.all(jnp.stack(finite)) & (root_mean_square(y) <= self.limit)) | self.refused


class Guarded(dfx.AbstractStepSizeController):
    """A controller that stops with a result code, the state before as the last, where `guard` says.

    An adaptive controller refuses steps with entries that are no numbers by itself, and tries
    shorter ones: only what it would accept is looked at. (Of infinite ones it would make steps of a
    length that is no number, for ever.)
    """

    controller: dfx.AbstractStepSizeController
    guard: Guard

    def wrap(self, direction):
        return type(self)(self.controller.wrap(direction), self.guard)

    def init(self, terms, t0, t1, y0, dt0, args, func, error_order):
        return self.controller.init(terms, t0, t1, y0, dt0, args, func, error_order)

    def adapt_step_size(self, t0, t1, y0, y1_candidate, args, y_error, error_order, state):
        numbers = lambda y: jnp.where(jnp.isfinite(y), y, jnp.nan)
        tried = jax.tree.map(numbers, y1_candidate)
        keep, start, end, jump, new_state, result = self.controller.adapt_step_size(
            t0, t1, y0, tried, args, y_error, error_order, state
        )
        stop = keep & self.guard.stops(y1_candidate) | self.guard.refused
        result = dfx.RESULTS.where(stop, dfx.RESULTS.nonlinear_divergence, result)
        return keep & ~stop, jnp.where(stop, t0, start), end, jump, new_state, result


class GuardedAdaptive(Guarded, dfx.AbstractAdaptiveStepSizeController):
    """The same around an adaptive controller."""

    controller: dfx.AbstractAdaptiveStepSizeController
    guard: Guard

    rtol = property(lambda self: self.controller.rtol)  # type: ignore[assignment]
    atol = property(lambda self: self.controller.atol)  # type: ignore[assignment]
    norm = property(lambda self: self.controller.norm)  # type: ignore[assignment]


def guarded(controller: dfx.AbstractStepSizeController, guard: Guard) -> Guarded:
    """The controller with a guard."""
    adaptive = isinstance(controller, dfx.AbstractAdaptiveStepSizeController)
    kind: Any = GuardedAdaptive if adaptive else Guarded
    return kind(controller, guard)
