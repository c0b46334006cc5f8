"""The method of Adams and Bashforth of second order, by which the paper moves points."""

from __future__ import annotations

from typing import ClassVar, NamedTuple

import diffrax as dfx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from .states import dtype_of, zeros_like_result


class _State(NamedTuple):
    """What one step hands to the next.

    Args:
        rate: at the current state.
        before: at that before.
        length: of the step between them; zero where there was none.
    """

    rate: PyTree[Array]
    before: PyTree[Array]
    length: Float[Array, ""]


class AdamsBashforth2(dfx.AbstractSolver):
    r"""Steps of second order with one evaluation of the rate, from that of the step before.

    $x^+ = x + \Delta t\,v + \tfrac12 \Delta t^2\,(v - v^-) / \Delta t^-$, with the rate $v^-$ and
    the length $\Delta t^-$ of the step before; the first step, and one after a jump, is Heun's, so
    that the order is kept from the start. Lengths may differ from step to step, but nothing is
    estimated that would choose them: pass `dt0` to `js.integrate` or `js.evolve`.

    Accuracy: second order (`tests/test_time_explicit.py`); in float32 to its round-off. Undamped
    oscillations grow slowly, with the fourth power of the step.
    Differentiable: forward and reverse, in the state and everything the rate depends on.
    Raises:
        ValueError: by `js.integrate` and `js.evolve`, where no length of the steps is given, or one
            that is unstable.
    Source: Suchde and Kuhnert 2019, eq. (3), who begin with a step of Euler's.

    Example:
        >>> spin = js.Motion(lambda t, surface, fields, args: jnp.cross(
        ...     jnp.array([0.0, 0.0, 1.0]), surface.cloud.points))
        >>> x = js.sphere(300)
        >>> end = js.evolve(spin, x, t1=2 * jnp.pi, solver=js.AdamsBashforth2(), dt0=0.05)
        >>> bool(jnp.abs(end.clouds[-1].points - x.points).max() < 0.01)
        True
    """

    term_structure: ClassVar = dfx.AbstractTerm
    interpolation_cls: ClassVar = dfx.ThirdOrderHermitePolynomialInterpolation

    def order(self, terms):
        return 2

    def func(self, terms, t0, y0, args):
        return terms.vf(t0, y0, args)

    def init(self, terms, t0, t1, y0, args):
        # The first step finds it, where all others do.
        none = zeros_like_result(lambda: terms.vf(t0, y0, args))
        return _State(none, none, jnp.zeros((), dtype_of(y0)))

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        """One loop, in which a rate stands once: after a jump it is found at the start, and ahead
        by a step of Euler's, with which it is averaged; and at the end at all times."""
        length = jnp.asarray(t1 - t0, solver_state.length.dtype)
        first = jnp.asarray(made_jump) | (solver_state.length == 0)
        span = terms.contr(t0, t1)
        ratio = jnp.where(first, -0.5, length / jnp.where(first, 1, solver_state.length) / 2)

        def turn(carry, i):
            rate, other, _, _ = carry
            extrapolate = jnp.where(i == 2, ratio, 0)
            slope = jax.tree.map(lambda a, b: a + extrapolate * (a - b), rate, other)
            step = terms.prod(slope, span)
            y = jax.tree.map(lambda y, k: jnp.where(i == 0, y, y + k), y0, step)
            kept = lambda: jax.tree.map(lambda a, b: jnp.where(i == 0, a, b), rate, other)
            found = lambda: terms.vf(jnp.where(i == 0, t0, t1), y, args)
            new = jax.lax.cond(first | (i == 2), found, kept)
            put = lambda at, old: jax.tree.map(lambda a, b: jnp.where(i == at, a, b), new, old)
            return (put(0, rate), put(1, other), y, new), None

        start = (solver_state.rate, solver_state.before, y0, solver_state.rate)
        (rate, _, y1, after), _ = jax.lax.scan(turn, start, jnp.arange(3))
        dense = dict(y0=y0, y1=y1, k0=terms.prod(rate, span), k1=terms.prod(after, span))
        return y1, None, dense, _State(after, rate, length), dfx.RESULTS.successful
