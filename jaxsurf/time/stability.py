r"""Whether explicit steps of a given length are stable, before they are taken.

A Runge–Kutta step makes $R(\Delta t\,\lambda)\,v$ of an eigenvector v of the right-hand side's
Jacobian J, where the equation makes $e^{\Delta t\,\lambda}\,v$ of it, with R the stability
polynomial of the method. Here both are taken of the Hessenberg matrix H of a few Arnoldi steps,
which has the outermost eigenvalues of J, and compared by their spectral radii. Of steps that are
partly implicit that is done in the space of as many steps for each part, and R is of both projected
parts. Where J depends on time, it is done at several times.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, PyTree

from ..functions import constant
from .amplification import AbstractAmplification, log_radius
from .states import length, small

# Arnoldi steps; a run is refused in which a mode is amplified so many times beyond what it should.
_STEPS, _AMPLIFIED = 24, 2.0
# Where a rate that depends on time is looked at: of no period in common.
_PLACES = (0.0, 0.14, 0.33, 0.59, 0.83, 1.0)
# And how many where a state has grown.
_MANY = 128


class Verdict(eqx.Module):
    """What became of the check.

    Args:
        stable: False if a mode is amplified beyond what the equation makes of it.
        time: where it is amplified most.
        projected: H there, or that of each part, in units of 1 / time.
        excess: logarithm of that amplification in one step.
    """

    stable: Array
    time: Array
    projected: tuple[Float[Array, "m m"], ...]
    excess: Array

    def longest(self, step: AbstractAmplification, dt: float, span: float) -> tuple[float, float]:
        """The longest stable step up to dt, and the spectral radius of the first part (host).

        Of steps in which the equation itself makes at most e of a mode.
        """
        parts = [np.asarray(part, float) for part in self.projected]
        exact = np.linalg.eigvals(sum(parts)).real.max()
        radius = float(np.exp(log_radius(parts[0])))

        def stable(shorter) -> bool:
            with np.errstate(all="ignore"):
                growth = step.growth(shorter, [shorter * part for part in parts])
            beyond = growth - max(shorter * exact, 0)
            return bool(beyond * max(span / shorter, 1) <= np.log(_AMPLIFIED))

        dt = min(dt, 1 / exact) if exact > 0 else dt
        found, longer = 0.0, dt
        for ratio in np.geomspace(1, 1e-8, 60):  # then between the last two
            if stable(dt * ratio):
                found = dt * ratio
                break
            longer = dt * ratio
        for between in np.geomspace(longer, found, 25)[1:-1] if 0 < found < dt else ():
            if stable(between):
                return float(between), radius
        return float(found), radius


class Watch(eqx.Module):
    """For steps whose lengths are not known before they are taken.

    Args:
        step: of the method.
        projected: as in `Verdict`, at several times: `(times, m, m)`.
    """

    step: AbstractAmplification
    projected: tuple[Float[Array, "t m m"], ...]

    @classmethod
    def over(cls, step, rates, t0, u, args, span, changes: bool) -> Watch:
        """Of a run; see `check_steps`."""
        rates, t0, u, args, span = constant((rates, t0, u, args, span))
        at = lambda t: _onward(rates, t, u, args, span)
        places = jnp.asarray(_PLACES if changes else _PLACES[:1], t0.dtype)
        return cls(constant(step), jax.lax.map(at, t0 + span * places))

    def of(self, dt) -> tuple[Array, Array]:
        """Logarithms of what a step may make of a mode, at worst: beyond the equation, and that."""
        found = jax.lax.map(lambda parts: _excess(self.step, jnp.abs(dt), parts), self.projected)
        excess, round_off, grown = found
        return jnp.maximum(jnp.max(excess - round_off), 0), jnp.max(grown)


def _excess(step: AbstractAmplification, dt, parts) -> tuple[Array, Array, Array]:
    """Logarithm of what a step makes of a mode beyond the equation, its round-off, and of that."""
    z = dt * functools.reduce(jnp.add, parts)
    size = jnp.maximum(jnp.max(jnp.sum(jnp.abs(z), axis=1)), 1)
    grown = jnp.maximum(size * log_radius(_exponential(z / size)), 0)
    excess = step.growth(dt, [dt * part for part in parts]) - grown
    return excess, 50 * jnp.finfo(z.dtype).eps * size, grown


def check_steps(
    step: AbstractAmplification,
    rates: Sequence[Callable],
    t0,
    u: PyTree[Array],
    args,
    dt,
    span,
    changes: bool,
    closely: bool = False,
) -> Verdict:
    """Compare what steps of length dt over a span of time do with what they should.

    Args:
        step: of the method.
        rates: (t, u, args) -> right-hand side, or its explicit and its implicit part.
        t0, u, args: where they are linearised.
        dt, span: in time, of either sign.
        changes: whether a rate depends on time.
        closely: look at more times then.
    """
    step, rates, t0, u, args, dt, span = constant((step, rates, t0, u, args, dt, span))
    dt, length = jnp.abs(dt), jnp.abs(span)

    def at(t):
        parts = _onward(rates, t, u, args, span)
        excess, round_off, _ = _excess(step, dt, parts)
        # What is not finite is for others to find.
        unstable = jnp.maximum(length / dt, 1) * (excess - round_off) > np.log(_AMPLIFIED)
        return Verdict(~unstable, t, parts, excess)

    if not changes:
        return at(t0)

    def worse(worst, t):
        found = at(t)
        replace = found.excess > worst.excess
        return jax.tree.map(lambda new, old: jnp.where(replace, new, old), found, worst), None

    none = jnp.zeros((_rank(u, len(rates)),) * 2, t0.dtype)
    fine = Verdict(jnp.asarray(True), t0, (none,) * len(rates), jnp.full_like(t0, -jnp.inf))
    places = np.linspace(0, 1, _MANY) if closely else _PLACES
    return jax.lax.scan(worse, fine, t0 + span * jnp.asarray(places, t0.dtype))[0]


def _onward(rates, t, u, args, span) -> tuple[Float[Array, "m m"], ...]:
    """`projected`, in the direction of time of a run."""
    return tuple(jnp.sign(span) * part for part in projected(rates, t, u, args))


def _rank(u: PyTree[Array], count: int) -> int:
    """Of the space for so many parts."""
    return min(_STEPS * count, sum(leaf.size for leaf in jax.tree.leaves(u)))


def projected(
    rates: Sequence[Callable], t, u: PyTree[Array], args
) -> tuple[Float[Array, "m m"], ...]:
    """The Jacobians of right-hand sides on the sum of their Krylov spaces, of random states."""
    base, unravel = ravel_pytree(u)
    size, count = small(base), len(rates)
    steps = _rank(u, count)
    # Row 0 is no direction: there the rates themselves are computed, by the same program. Then come
    # random starts, which are left out of the space: what no part stretches (the points of a
    # surface, beside fields whose rate hangs on them much) would hide the outermost eigenvalues.
    random = np.random.default_rng(0).normal(size=(count, base.size)) / base.size**0.5
    space = jnp.zeros((1 + count + steps, base.size), base.dtype)
    space = space.at[1 : 1 + count].set(jnp.asarray(random, base.dtype))
    left_out = jnp.arange(len(space))[:, None] <= count

    def extend(carry, j):
        space, values = carry
        state = unravel(base + size * space[j])
        found = jnp.stack([ravel_pytree(rate(t, state, args))[0] for rate in rates])
        values = jnp.where(j > 0, values, found)
        # By differences: a right-hand side may have a rule for the reverse mode only.
        images = (found - values) / size
        image = v = images[(j - 1) % count]
        basis = jnp.where(left_out, 0, space)
        for _ in range(2):
            v = v - basis.T @ (basis @ v)
        # Where only round-off is left, the space is complete: no further directions.
        left = length(v)
        fresh = (left > 10 * jnp.sqrt(jnp.finfo(v.dtype).eps) * length(image)) & (j > 0)
        v = jnp.where(fresh, v / jnp.where(fresh, left, 1), 0)
        return (space.at[j + count].add(v, mode="drop"), values), images

    none = jnp.zeros((count, base.size), base.dtype)
    (space, _), images = jax.lax.scan(extend, (space, none), jnp.arange(len(space)))
    return tuple(space[1 + count :] @ images[1 + count :, i].T for i in range(count))


def _exponential(matrix: Float[Array, "m m"]) -> Float[Array, "m m"]:
    """Of a matrix of norm at most one, by its series."""
    one = jnp.eye(len(matrix), dtype=matrix.dtype)
    further = lambda total, k: (one + matrix @ total / k, None)
    return jax.lax.scan(further, one, jnp.arange(18.0, 0.0, -1.0, dtype=matrix.dtype))[0]
