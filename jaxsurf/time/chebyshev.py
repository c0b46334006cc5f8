r"""The stages of a Runge–Kutta–Chebyshev step and their derivative.

Stages follow from the two before them, as Chebyshev polynomials do,

$$Y_j = (1 - \mu_j - \nu_j) Y_0 + \mu_j Y_{j-1} + \nu_j Y_{j-2}
      + \tilde\mu_j K(c_{j-1}, Y_{j-1}) + \tilde\gamma_j K_0,$$

K the increment Δt f. Their number is a value, so this is a loop that JAX cannot turn round.
Here its reverse is written out: stages are kept at intervals of about the square root of the
largest number, and in between computed again.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from typing import Literal

import equinox as eqx
import equinox.internal as eqxi
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PyTree

from .states import added, dtype_of

Loop = Literal["checkpointed", "lax", "bounded"]

# Damping of the stability polynomial: the strip around the negative real axis that it covers.
_DAMPING = 2 / 13
# Columns of the table.
_MU, _NU, _MU_K, _GAMMA_K, _NODE = range(5)


@functools.cache
def table(max_stages: int) -> np.ndarray:
    """Coefficients `(s, j, 5)` of stage j of s, for every s up to the largest.

    Columns: μ, ν, μ̃, γ̃, and the node c of stage j - 1. (Sommeijer, Shampine and Verwer 1998,
    eqs. 2.4 to 2.8.)
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
        rows[s, 1, _MU_K] = b[1] * w1
        rows[s, 1, _MU] = 1
        rows[s, 2 : s + 1, _MU] = 2 * b[2:] * w0 / b[1:-1]
        rows[s, 2 : s + 1, _NU] = -b[2:] / b[:-2]
        rows[s, 2 : s + 1, _MU_K] = 2 * b[2:] * w1 / b[1:-1]
        rows[s, 2 : s + 1, _GAMMA_K] = -(1 - b * t[0])[1:-1] * rows[s, 2 : s + 1, _MU_K]
        rows[s, 2 : s + 1, _NODE] = c[1:-1]
    return rows


def last_stage(
    increment: Callable[[Array, PyTree], PyTree],
    y0: PyTree[Array],
    k0: PyTree[Array],
    stages: Int[Array, ""],
    *,
    max_stages: int,
    loop: Loop,
) -> PyTree[Array]:
    """The last of the stages of one step.

    Args:
        increment: (c, y) -> Δt times the right-hand side at t + c Δt.
        y0, k0: the state, and its increment.
        stages: how many, at least 2.
        max_stages: the largest number there may be.
        loop: how it can be differentiated, see `RKC2`.
    """
    rows = jnp.asarray(table(max_stages), dtype_of(y0))[stages]
    if loop == "checkpointed":
        increment = eqx.filter_closure_convert(increment, rows[0, _NODE], y0)
        return _last((increment, y0, k0), rows, stages)
    forward = _Forward(increment, y0, k0, rows)
    carry = (jnp.asarray(2, stages.dtype), forward.first())
    unfinished = lambda carry: carry[0] <= stages
    step = lambda carry: (carry[0] + 1, forward.next(*carry))
    return eqxi.while_loop(unfinished, step, carry, max_steps=max_stages, kind=loop)[1][0]


class _Forward(eqx.Module):
    """One stage from the two before it."""

    increment: Callable
    y0: PyTree[Array]
    k0: PyTree[Array]
    rows: Float[Array, "stages 5"]

    def first(self) -> tuple[PyTree[Array], PyTree[Array]]:
        """Stages 1 and 0."""
        factor = self.rows[1, _MU_K]
        return jax.tree.map(lambda y, k: y + factor * k, self.y0, self.k0), self.y0

    def next(self, j, pair) -> tuple[PyTree[Array], PyTree[Array]]:
        """Stages j and j - 1 from j - 1 and j - 2."""
        last, before = pair
        row = self.rows[j]
        mu, nu = row[_MU], row[_NU]
        k = self.increment(row[_NODE], last)
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
def _last(inputs, rows, stages):
    increment, y0, k0 = inputs
    forward = _Forward(increment, y0, k0, rows)
    return forward.upto(jnp.asarray(1, stages.dtype), forward.first(), stages)[0]


@_last.def_fwd
def _last_forward(perturbed, inputs, rows, stages):
    return _last(inputs, rows, stages), None


@_last.def_bwd
def _last_reverse(residuals, cotangent, perturbed, inputs, rows, stages):
    increment, y0, k0 = inputs
    parameters, fixed = eqx.partition(increment, perturbed[0])
    forward = _Forward(increment, y0, k0, rows)
    length = math.isqrt(rows.shape[0] - 1) + 1  # stages of an interval
    one = jnp.asarray(1, stages.dtype)

    def pulled(j, y, c):
        """Cotangents of the parameters and of y for one of the increment at stage j - 1."""

        def moved(parameters, y):
            return eqx.combine(parameters, fixed)(rows[j, _NODE], y)

        return jax.vjp(moved, parameters, y)[1](c)

    # Stages before 1, 1 + length, 1 + 2 length, ...: where the intervals start.
    intervals = (stages - 2) // length  # whole ones before the last
    starts = _room(length, (y0, y0))

    def note(i, carry):
        pair, starts = carry
        starts = _put(starts, i, pair)
        return forward.upto(1 + i * length, pair, 1 + (i + 1) * length), starts

    pair, starts = jax.lax.fori_loop(0 * one, intervals, note, (forward.first(), starts))
    starts = _put(starts, intervals, pair)

    def interval(carry):
        i, pair_bar, sums = carry
        first = 1 + i * length
        count = jnp.minimum(stages - first, length)

        def keep(m, carry):
            pair, kept = carry
            return forward.next(first + m + 1, pair), _put(kept, m, pair[0])

        start = (_get(starts, i), _room(length, y0))
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
    cotangent = jax.tree.map(
        lambda c, y: jnp.zeros_like(y) if c is None else c,
        cotangent, y0, is_leaf=lambda c: c is None,
    )  # fmt: skip
    carry = (intervals, (cotangent, zero(y0)), (zero(parameters), zero(y0), zero(k0)))
    _, (y1_bar, start_bar), (w_bar, y0_bar, k0_bar) = jax.lax.while_loop(
        lambda carry: carry[0] >= 0, interval, carry
    )
    y0_bar = added(y0_bar, start_bar, y1_bar)
    k0_bar = added(k0_bar, _scaled(rows[1, _MU_K], y1_bar))
    return w_bar, eqx.filter(y0_bar, perturbed[1]), eqx.filter(k0_bar, perturbed[2])


def _scaled(factor, y: PyTree[Array]) -> PyTree[Array]:
    return jax.tree.map(lambda y: factor * y, y)


def _room(count: int, tree: PyTree[Array]) -> PyTree[Array]:
    return jax.tree.map(lambda y: jnp.zeros((count, *y.shape), y.dtype), tree)


def _put(room: PyTree[Array], i, tree: PyTree[Array]) -> PyTree[Array]:
    return jax.tree.map(lambda r, y: r.at[i].set(y), room, tree)


def _get(room: PyTree[Array], i) -> PyTree[Array]:
    return jax.tree.map(lambda r: r[i], room)
