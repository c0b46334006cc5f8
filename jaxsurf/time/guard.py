r"""Step size controllers that stop where a solution leaves what it can be."""

from __future__ import annotations

from typing import Any, NamedTuple

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PyTree

from .stability import Watch
from .states import root_mean_square

# Where nothing bounds what a state may be, one that has grown by this factor is looked at.
GROWN = 100.0


class Guard(eqx.Module):
    """What no accepted state may be.

    Args:
        limit: the largest root mean square of a state; infinite for none.
        refused: True if no step is to be taken at all.
        watch: on steps whose lengths a controller chooses that knows no errors.
    """

    limit: Float[Array, ""]
    refused: Bool[Array, ""]
    watch: Watch | None = None

    def stops(self, y: PyTree[Array]) -> Bool[Array, ""]:
        """True if entries are not finite or too large together."""
        finite = [jnp.all(jnp.isfinite(leaf)) for leaf in jax.tree.leaves(y)]
        return ~(jnp.all(jnp.stack(finite)) & (root_mean_square(y) <= self.limit)) | self.refused


class _Seen(NamedTuple):
    """What is known of the steps that are watched.

    Args:
        state: of the controller.
        size: the root mean square at the start, of the first state that is not zero, times what the
            equation may have made of it since.
        excess: logarithm of how much steps have amplified a mode beyond that.
    """

    state: Any
    size: Float[Array, ""]
    excess: Float[Array, ""]

    def after(self, state, keep, y, dt, watch: Watch) -> _Seen:
        """A step."""
        excess, grown = (jnp.where(keep, a, 0) for a in watch.of(dt))
        size = jnp.where(keep & (self.size == 0), root_mean_square(y), self.size * jnp.exp(grown))
        return _Seen(state, size, self.excess + excess)

    def accuses(self, y: PyTree[Array]) -> Bool[Array, ""]:
        """True if the state has grown much, and not beyond what the steps may have made of it."""
        grown = root_mean_square(y) / jnp.where(self.size > 0, self.size, 1)
        return (grown > GROWN) & (self.excess > jnp.log(grown))


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
        end, state = self.controller.init(terms, t0, t1, y0, dt0, args, func, error_order)
        if self.guard.watch is not None:
            size = root_mean_square(y0)
            state = _Seen(state, size, jnp.zeros_like(size))
        return end, state

    def adapt_step_size(self, t0, t1, y0, y1_candidate, args, y_error, error_order, state):
        numbers = lambda y: jnp.where(jnp.isfinite(y), y, jnp.nan)
        tried = jax.tree.map(numbers, y1_candidate)
        watch, seen = self.guard.watch, state
        own = state if watch is None else seen.state
        keep, start, end, jump, new_state, result = self.controller.adapt_step_size(
            t0, t1, y0, tried, args, y_error, error_order, own
        )
        stop = keep & self.guard.stops(y1_candidate) | self.guard.refused
        if watch is not None:
            new_state = seen.after(new_state, keep, y1_candidate, t1 - t0, watch)
            stop = stop | keep & new_state.accuses(y1_candidate)
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
