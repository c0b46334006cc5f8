r"""The stages of a Runge–Kutta–Chebyshev step and their derivative.

Stages follow from the two before them, as Chebyshev polynomials do,

$$Y_j = (1 - \mu_j - \nu_j) Y_0 + \mu_j Y_{j-1} + \nu_j Y_{j-2}
      + \tilde\mu_j K(c_{j-1}, Y_{j-1}) + \tilde\gamma_j K_0,$$

K the increment Δt f. Their number is a value, so this is a loop that JAX cannot turn round.
Here its reverse is written out: stages are kept at intervals of about the square root of the
largest number, and in between computed again.

A turn of the loop makes a stage and then the rate there, that of the last one being the rate at
the end of the step; power iterations for the spectral radius are turns of the same loop, and so is
the rate at the start where it is not known. So a rate, which may take seconds to compile, is
compiled once.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from typing import Literal, NamedTuple

import equinox as eqx
import equinox.internal as eqxi
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PyTree

from ..compiling import AnyArray
from ..functions import constant
from .states import added, dtype_of, length, small

Loop = Literal["checkpointed", "lax", "bounded"]

# Damping of the stability polynomial: the strip around the negative real axis that it covers.
_DAMPING = 2 / 13
# Columns of the table.
_MU, _NU, _MU_K, _GAMMA_K, _NODE = range(5)
# A power iteration sees the radius from below.
SAFETY = 1.2


@functools.cache
def table(max_stages: int) -> np.ndarray:
    """Coefficients `(s, j, 5)` of stage j of s, for every s up to the largest.

    Columns: μ, ν, μ̃, γ̃, and the node c of stage j. (Sommeijer, Shampine and Verwer 1998,
    eqs. 2.4 to 2.8.) The first two stages name Y_0 and K_0 as such, not as stages before them.
    """
    rows = np.zeros((max_stages + 1, max_stages + 1, 5))
    for s in range(2, max_stages + 1):
        w0 = 1 + _DAMPING / s**2
        t = np.zeros((3, s + 1))  # Chebyshev polynomials at w0, first and second derivatives
        t[:, 0], t[:, 1] = (1, 0, 0), (w0, 1, 0)
        for j in range(2, s + 1):
            chain = np.array([0, 2 * t[0, j - 1], 4 * t[1, j - 1]])
            t[:, j] = 2 * w0 * t[:, j - 1] - t[:, j - 2] + chain
        w1 = t[1, s] / t[2, s]
        b = np.empty(s + 1)
        b[2:] = t[2, 2:] / t[1, 2:] ** 2
        b[:2] = b[2]
        c = np.zeros(s + 1)
        c[2:] = w1 * t[2, 2:] / t[1, 2:]
        c[1] = c[2] / t[1, 2]
        rows[s, 1, _GAMMA_K] = b[1] * w1
        rows[s, 2 : s + 1, _MU] = 2 * b[2:] * w0 / b[1:-1]
        rows[s, 3 : s + 1, _NU] = -b[3:] / b[1:-2]
        rows[s, 2 : s + 1, _MU_K] = 2 * b[2:] * w1 / b[1:-1]
        rows[s, 2 : s + 1, _GAMMA_K] = -(1 - b * t[0])[1:-1] * rows[s, 2 : s + 1, _MU_K]
        rows[s, 1 : s + 1, _NODE] = (*c[1:s], 1)
    return rows


class Radius(NamedTuple):
    """What is known of the spectral radius of the Jacobian, a constant to differentiation.

    Args:
        value: an estimate.
        direction: field that the Jacobian stretches most; None where the value is given.
        turns: of power iterations, before the stages.
    """

    value: Float[Array, ""]
    direction: PyTree[Array] | None = None
    turns: Int[Array, ""] | int = 0


def stages_of(need, max_stages: int):
    """How many stages there are for Δt times the radius; 2, and False, where more are needed."""
    numbers = np if isinstance(need, np.ndarray | np.generic) else jnp
    stages = 1 + numbers.floor(numbers.sqrt(1 + 1.54 * need))
    enough = stages <= max_stages  # also False for a radius that is not finite
    return numbers.where(enough, stages, 2).astype(numbers.int32), enough


class End(NamedTuple):
    """What a step ends with.

    Args:
        rate0: the right-hand side at its start.
        y, rate: the last stage and the right-hand side there.
        radius: of which the last two follow.
        stages, enough: see `stages_of`.
    """

    rate0: PyTree[Array]
    y: PyTree[Array]
    rate: PyTree[Array]
    radius: Radius
    stages: Int[Array, ""]
    enough: Bool[Array, ""]


class Step(eqx.Module):
    """One step, whose rate stands at one place of the program.

    Args:
        rate: (c, y) -> right-hand side at the time t + c Δt.
        weigh: right-hand side -> increment.
        y0, rate0: the state, and the right-hand side there, or what has its shape.
        max_stages: the largest number of stages.
    """

    rate: Callable
    weigh: Callable
    y0: PyTree[AnyArray]
    rate0: PyTree[AnyArray]
    max_stages: int = eqx.field(static=True)

    def __call__(self, dt, radius: Radius, fresh, loop: Loop) -> End:
        """The end of the step, of length dt.

        Args:
            radius: what is known of it.
            fresh: whether the rate at the start is still to be found.
            loop: how it can be differentiated, see `RKC2`.
        """
        dt, radius = constant((jnp.abs(dt), radius))
        # With what they hang on, which also is to be constant in power iterations.
        rate = eqx.filter_closure_convert(self.rate, dt, self.y0)
        weigh = eqx.filter_closure_convert(self.weigh, self.rate0)
        if loop == "checkpointed":
            start = (rate, weigh), self.y0, self.rate0
            return _end(start, dt, radius, fresh, self.max_stages)
        rate0 = jax.lax.cond(fresh, lambda: rate(0 * dt, self.y0), lambda: self.rate0)
        step = Step(rate, weigh, self.y0, rate0, self.max_stages)
        if radius.direction is not None:
            fixed = constant(step)
            start = added(fixed.rate0, radius.direction)
            _, rate, stretched = fixed.turned(True, 0, radius.turns, start)
            radius = constant(fixed.seen(radius, rate, stretched, radius.turns > 0))
        stages, enough = stages_of(dt * radius.value, self.max_stages)
        y, rate, _ = step.turned(False, stages, stages, step.rate0, loop)
        return End(step.rate0, y, rate, radius, stages, enough)

    def with_rate(self, rate0: PyTree[AnyArray]) -> Step:
        """The same step from another rate."""
        return Step(self.rate, self.weigh, self.y0, rate0, self.max_stages)

    def end(self, dt, radius: Radius, fresh) -> End:
        """The same by one loop, of at most three turns: the rate at the start, power iterations,
        stages."""
        further = jnp.where(jnp.asarray(radius.turns) > 0, 1, 2)

        def phase(carry):
            i, end = carry
            step, radius, start = self.with_rate(end.rate0), end.radius, end.rate0
            if radius.direction is not None:
                start = added(start, radius.direction)
            turns = jnp.stack([jnp.ones_like(end.stages), radius.turns, end.stages])[i]
            stages = jnp.where(i == 2, end.stages, 0)
            y, rate, stretched = step.turned(i == 1, stages, turns, start)
            if radius.direction is not None:
                radius = step.seen(radius, rate, stretched, i == 1)
            rate0 = jax.tree.map(lambda new, old: jnp.where(i == 0, new, old), rate, end.rate0)
            stages, enough = stages_of(dt * radius.value, self.max_stages)
            i = jnp.where(i == 0, further, i + 1)
            return i, End(rate0, y, rate, radius, stages, enough)

        stages, enough = stages_of(dt * radius.value, self.max_stages)
        known = End(self.rate0, self.y0, self.rate0, radius, stages, enough)
        start = jnp.where(fresh, 0, further), known
        return jax.lax.while_loop(lambda carry: carry[0] < 3, phase, start)[1]

    def turned(self, power, stages, turns, rate: PyTree[Array], loop: Loop = "lax"):
        """The last of so many turns, the rate there, and how far that is from the rate at the start
        where it is of a power iteration.

        Args:
            power: whether turns are power iterations.
            stages: of the step whose stages they are; 0 where they are none.
            rate: for power iterations, the rate at the start and a direction added to it.
        """
        rows = jnp.asarray(table(self.max_stages), dtype_of(self.y0))[stages]
        # Constants, as the radius: at the start one is zero, where a length has no derivative.
        size = small(constant(self.y0))
        away = lambda rate: length(constant(jax.tree.map(jnp.subtract, rate, self.rate0)))

        def turn(carry):
            j, last, before, rate, stretched = carry
            row = rows[j]
            scale = jnp.where(power & (stretched > 0), size / stretched, 0)
            y = self.stage(row, last, before, rate)
            y = jax.tree.map(lambda y, a, b: y + scale * (a - b), y, rate, self.rate0)
            rate = self.rate(row[_NODE], y)
            stretched = jax.lax.cond(power, away, lambda _: stretched, rate)
            return j + 1, y, last, rate, stretched

        turns = jnp.asarray(turns)
        start = jnp.asarray(1, turns.dtype), self.y0, self.y0, rate, away(rate)
        unfinished = lambda carry: carry[0] <= turns
        if loop == "lax":
            _, y, _, rate, stretched = jax.lax.while_loop(unfinished, turn, start)
        else:
            most = self.max_stages
            end = eqxi.while_loop(unfinished, turn, start, max_steps=most, kind=loop)
            _, y, _, rate, stretched = end
        return y, rate, stretched

    def seen(self, radius: Radius, rate: PyTree[Array], stretched, power) -> Radius:
        """What power iterations tell, if there were any."""
        keep = power & (stretched > 0)
        value = jnp.where(power, SAFETY * stretched / small(self.y0), radius.value)
        direction = jax.tree.map(
            lambda a, b, d: jnp.where(keep, a - b, d), rate, self.rate0, radius.direction
        )
        return Radius(value, direction, radius.turns)

    def stage(self, row, last, before, rate) -> PyTree[Array]:
        """A stage from the two before it and the rate at the last."""
        mu, nu = row[_MU], row[_NU]
        push = jax.tree.map(lambda a, b: row[_MU_K] * a + row[_GAMMA_K] * b, rate, self.rate0)
        return jax.tree.map(
            lambda y0, y, z, k: (1 - mu - nu) * y0 + mu * y + nu * z + k,
            self.y0, last, before, self.weigh(push),
        )  # fmt: skip


def nth_stage(increment, y0, k0, stages, *, max_stages: int):
    """The last of so many stages, on the host."""
    forward = _Forward(increment, y0, k0, table(max_stages)[stages])
    pair = forward.first()
    for j in range(2, stages + 1):
        pair = forward.next(j, pair)
    return pair[0]


class _Forward(eqx.Module):
    """One stage from the two before it."""

    increment: Callable
    y0: PyTree[AnyArray]
    k0: PyTree[AnyArray]
    rows: Float[AnyArray, "stages 5"]

    def first(self) -> tuple[PyTree[AnyArray], PyTree[AnyArray]]:
        """Stages 1 and 0."""
        factor = self.rows[1, _GAMMA_K]
        return jax.tree.map(lambda y, k: y + factor * k, self.y0, self.k0), self.y0

    def next(self, j, pair) -> tuple[PyTree[AnyArray], PyTree[AnyArray]]:
        """Stages j and j - 1 from j - 1 and j - 2."""
        last, before = pair
        row = self.rows[j]
        mu, nu = row[_MU], row[_NU]
        k = self.increment(self.rows[j - 1, _NODE], last)
        new = jax.tree.map(
            lambda y0, y, z, k, k0: (
                (1 - mu - nu) * y0 + mu * y + nu * z + row[_MU_K] * k + row[_GAMMA_K] * k0
            ),
            self.y0, last, before, k, self.k0,
        )  # fmt: skip
        return new, last

    def upto(self, start, pair, end):
        """Stages `end` and before, from `start` and before."""
        return jax.lax.while_loop(
            lambda carry: carry[0] < end,
            lambda carry: (carry[0] + 1, self.next(carry[0] + 1, carry[1])),
            (start, pair),
        )[1]


@eqx.filter_custom_vjp
def _end(inputs, dt, radius, fresh, max_stages):
    (rate, weigh), y0, rate0 = inputs
    return Step(rate, weigh, y0, rate0, max_stages).end(dt, radius, fresh)


@_end.def_fwd
def _end_forward(perturbed, inputs, dt, radius, fresh, max_stages):
    end = _end(inputs, dt, radius, fresh, max_stages)
    return end, (end.stages, end.rate0, end.y)


@_end.def_bwd
def _end_reverse(residuals, cotangent, perturbed, inputs, dt, radius, fresh, max_stages):
    functions, y0, _ = inputs
    stages, rate0, y1 = residuals
    parameters, fixed = eqx.partition(functions, perturbed[0])
    rows = jnp.asarray(table(max_stages), dtype_of(y0))[stages]
    rate, weigh = functions
    forward = _Forward(lambda c, y: weigh(rate(c, y)), y0, weigh(rate0), rows)
    interval_length = math.isqrt(max_stages) + 1  # stages of an interval
    one = jnp.asarray(1, stages.dtype)

    def pulled(j, y, c):
        """Cotangents of the parameters and of y for one of the increment at stage j - 1."""

        def moved(parameters, y):
            rate, weigh = eqx.combine(parameters, fixed)
            return weigh(rate(rows[j - 1, _NODE], y))

        return jax.vjp(moved, parameters, y)[1](c)

    # Stages before 1, 1 + length, 1 + 2 length, ...: where the intervals start.
    intervals = (stages - 2) // interval_length  # whole ones before the last
    starts = _room(interval_length, (y0, y0))

    def note(i, carry):
        pair, starts = carry
        starts = _put(starts, i, pair)
        return forward.upto(1 + i * interval_length, pair, 1 + (i + 1) * interval_length), starts

    pair, starts = jax.lax.fori_loop(0 * one, intervals, note, (forward.first(), starts))
    starts = _put(starts, intervals, pair)

    def interval(carry):
        i, pair_bar, sums = carry
        first = 1 + i * interval_length
        count = jnp.minimum(stages - first, interval_length)

        def keep(m, carry):
            pair, kept = carry
            return forward.next(first + m + 1, pair), _put(kept, m, pair[0])

        start = (_get(starts, i), _room(interval_length, y0))
        kept = jax.lax.fori_loop(0 * one, count, keep, start)[1]

        def back(m, carry):
            (y_bar, z_bar), (w_bar, y0_bar, k0_bar) = carry
            m = count - 1 - m
            j = first + m + 1
            row = rows[j]
            mu, nu = row[_MU], row[_NU]
            w_part, y_part = pulled(j, _get(kept, m), _scaled(row[_MU_K], y_bar))
            sums = (
                added(w_bar, w_part),
                added(y0_bar, _scaled(1 - mu - nu, y_bar)),
                added(k0_bar, _scaled(row[_GAMMA_K], y_bar)),
            )
            last = jax.tree.map(lambda z, y, p: z + mu * y + p, z_bar, y_bar, y_part)
            return (last, _scaled(nu, y_bar)), sums

        pair_bar, sums = jax.lax.fori_loop(0 * one, count, back, (pair_bar, sums))
        return i - 1, pair_bar, sums

    zero = lambda tree: jax.tree.map(jnp.zeros_like, tree)
    filled = lambda bar, like: jax.tree.map(
        lambda b, y: jnp.zeros_like(y) if b is None else b, bar, like, is_leaf=lambda b: b is None
    )
    # The rate at the end is that of the last stage.
    ending = lambda parameters, y: eqx.combine(parameters, fixed)[0](rows[stages, _NODE], y)
    w_bar, y1_bar = jax.vjp(ending, parameters, y1)[1](filled(cotangent.rate, rate0))
    y1_bar = added(filled(cotangent.y, y0), y1_bar)
    carry = (intervals, (y1_bar, zero(y0)), (w_bar, zero(y0), zero(y0)))
    _, (y1_bar, start_bar), (w_bar, y0_bar, k0_bar) = jax.lax.while_loop(
        lambda carry: carry[0] >= 0, interval, carry
    )
    y0_bar = added(y0_bar, start_bar, y1_bar)
    k0_bar = added(k0_bar, _scaled(rows[1, _GAMMA_K], y1_bar))
    start = lambda parameters, rate0: eqx.combine(parameters, fixed)[1](rate0)
    w_part, rate0_bar = jax.vjp(start, parameters, rate0)[1](k0_bar)
    w_bar, rate0_bar = added(w_bar, w_part), added(rate0_bar, filled(cotangent.rate0, rate0))
    # That at the start, where it was found here, is one more function of the state.
    first = lambda parameters, y: eqx.combine(parameters, fixed)[0](rows[0, _NODE], y)
    found = lambda: jax.vjp(first, parameters, y0)[1](rate0_bar)
    w_part, y0_part = jax.lax.cond(fresh, found, lambda: (zero(parameters), zero(y0)))
    w_bar, y0_bar = added(w_bar, w_part), added(y0_bar, y0_part)
    rate0_bar = jax.tree.map(lambda bar: jnp.where(fresh, 0, bar), rate0_bar)
    return w_bar, eqx.filter(y0_bar, perturbed[1]), eqx.filter(rate0_bar, perturbed[2])


def _scaled(factor, y: PyTree[Array]) -> PyTree[Array]:
    return jax.tree.map(lambda y: factor * y, y)


def _room(count: int, tree: PyTree[Array]) -> PyTree[Array]:
    return jax.tree.map(lambda y: jnp.zeros((count, *y.shape), y.dtype), tree)


def _put(room: PyTree[Array], i, tree: PyTree[Array]) -> PyTree[Array]:
    return jax.tree.map(lambda r, y: r.at[i].set(y), room, tree)


def _get(room: PyTree[Array], i) -> PyTree[Array]:
    return jax.tree.map(lambda r: r[i], room)
