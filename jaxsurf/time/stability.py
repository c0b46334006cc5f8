r"""Whether explicit steps of a given length are stable, before they are taken.

A Runge–Kutta step makes $R(\Delta t\,\lambda)\,v$ of an eigenvector v of the right-hand side's
Jacobian J, where the equation makes $e^{\Delta t\,\lambda}\,v$ of it, with R the stability
polynomial of the method. Here both are taken of the Hessenberg matrix H of a few Arnoldi steps,
which has the outermost eigenvalues of J, and compared by their spectral radii. Of steps that are
partly implicit that is the space of the explicit part, and R is of both projected parts.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, PyTree

from ..functions import constant
from .implicit import IMEX
from .states import length, small

# Arnoldi steps; a run is refused in which a mode is amplified so many times beyond what it should.
_STEPS, _AMPLIFIED = 24, 2.0


class Tableau(eqx.Module):
    """The coefficients of an explicit Runge–Kutta method that its stability follows from.

    Args:
        rows: strictly lower, row by row.
        weights: of the result.
    """

    rows: tuple[tuple[float, ...], ...] = eqx.field(static=True)
    weights: tuple[float, ...] = eqx.field(static=True)

    def amplification(self, parts: Sequence, one: Any) -> Any:
        """R(z) of a matrix z, the only part; one is the identity."""
        (z,) = parts
        increments = [z]
        for row in self.rows:
            increments.append(z @ (one + sum(a * k for a, k in zip(row, increments))))
        return one + sum(b * k for b, k in zip(self.weights, increments))


class Additive(eqx.Module):
    """The coefficients of a method that treats one part explicitly and one implicitly.

    Args:
        explicit, implicit: strictly lower, row by row from the second on.
        gamma: of every implicit stage.
        weights: of the result.
    """

    explicit: tuple[tuple[float, ...], ...] = eqx.field(static=True)
    implicit: tuple[tuple[float, ...], ...] = eqx.field(static=True)
    gamma: float = eqx.field(static=True)
    weights: tuple[float, ...] = eqx.field(static=True)

    def amplification(self, parts: Sequence, one: Any) -> Any:
        """R of two matrices, explicit and implicit."""
        first, second = parts
        numbers = np if isinstance(one, np.ndarray) else jnp
        increments = [(first, second)]
        for rows in zip(self.explicit, self.implicit):
            known = one + sum(
                a * k for row, ks in zip(rows, zip(*increments)) for a, k in zip(row, ks)
            )
            y = numbers.linalg.solve(one - self.gamma * second, known)
            increments.append((first @ y, second @ y))
        return one + sum(b * (k + j) for b, (k, j) in zip(self.weights, increments))


def tableau_of(solver: dfx.AbstractSolver) -> Tableau | Additive | None:
    """That of an explicit Runge–Kutta method or of `IMEX`; None for another solver."""
    if isinstance(solver, IMEX):
        known = solver.tableau
        lower = lambda m: tuple(tuple(map(float, row[:i])) for i, row in enumerate(m) if i)
        explicit, implicit = lower(known.explicit), lower(known.implicit)
        return Additive(explicit, implicit, known.gamma, tuple(map(float, known.weights)))
    if isinstance(solver, dfx.Euler):
        return Tableau((), (1.0,))
    if isinstance(solver, dfx.AbstractERK):
        tableau: Any = solver.tableau
        rows = tuple(tuple(map(float, row)) for row in tableau.a_lower)
        return Tableau(rows, tuple(map(float, tableau.b_sol)))
    return None


class Verdict(eqx.Module):
    """What became of the check.

    Args:
        stable: False if a mode is amplified beyond what the equation makes of it.
        projected: H, or that of each part, in units of 1 / time.
        excess: logarithm of that amplification in one step.
    """

    stable: Array
    projected: tuple[Float[Array, "m m"], ...]
    excess: Array

    def longest(self, tableau: Tableau | Additive, dt: float, span: float) -> tuple[float, float]:
        """The longest stable step up to dt, and the spectral radius of the first part (host)."""
        parts = [np.asarray(part, float) for part in self.projected]
        one, exact = np.eye(len(parts[0])), np.linalg.eigvals(sum(parts)).real.max()
        radius = float(np.abs(np.linalg.eigvals(parts[0])).max())
        for step in dt * np.geomspace(1, 1e-8, 1000):
            with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
                found = tableau.amplification([step * part for part in parts], one)
                if not np.isfinite(found).all():
                    continue
                growth = np.log(np.abs(np.linalg.eigvals(found)).max()) - max(step * exact, 0)
            if growth * max(span / step, 1) <= np.log(_AMPLIFIED):
                return float(step), radius
        return 0.0, radius


def check_steps(
    tableau: Tableau | Additive, rates: Sequence[Callable], t, u: PyTree[Array], args, dt, span
) -> Verdict:
    """Compare what steps of length dt over a span of time do with what they should.

    Args:
        tableau: of the method.
        rates: (t, u, args) -> right-hand side, or its explicit and its implicit part.
        t, u, args: where they are linearised.
        dt, span: lengths in time.
    """
    parts = projected(rates, t, u, args)
    h = functools.reduce(jnp.add, parts)
    dt, span = constant((jnp.abs(dt), jnp.abs(span)))
    one = jnp.eye(len(h), dtype=h.dtype)
    z = dt * h
    size = jnp.maximum(jnp.max(jnp.sum(jnp.abs(z), axis=1)), 1)
    grown = jnp.maximum(size * _log_radius(_exponential(z / size)), 0)
    excess = _log_radius(tableau.amplification([dt * part for part in parts], one)) - grown
    steps = jnp.maximum(span / dt, 1)
    # What is not finite is for others to find.
    round_off = 50 * jnp.finfo(h.dtype).eps * size
    unstable = steps * (excess - round_off) > np.log(_AMPLIFIED)
    return Verdict(~unstable, parts, excess)


def projected(
    rates: Sequence[Callable], t, u: PyTree[Array], args
) -> tuple[Float[Array, "m m"], ...]:
    """The Jacobians of right-hand sides on the Krylov space of the first, of a random state."""
    rates, t, u, args = constant((rates, t, u, args))
    base, unravel = ravel_pytree(u)
    size = small(base)
    of = lambda rate, v: ravel_pytree(rate(t, unravel(v), args))[0]
    values = [of(rate, base) for rate in rates]

    def along(v):  # by differences: a right-hand side may have a rule for the reverse mode only
        near = base + size * v
        return jnp.stack([(of(f, near) - value) / size for f, value in zip(rates, values)])

    steps = min(_STEPS, base.size)
    start = jnp.asarray(np.random.default_rng(0).normal(size=base.size), base.dtype)
    space = jnp.zeros((steps + 1, base.size), base.dtype).at[0].set(start / length(start))

    def extend(space, j):
        images = along(space[j])
        image = v = images[0]
        for _ in range(2):
            v = v - space.T @ (space @ v)
        # Where only round-off is left, the space is complete: no further directions.
        left = length(v)
        fresh = left > 10 * jnp.sqrt(jnp.finfo(v.dtype).eps) * length(image)
        v = jnp.where(fresh, v / jnp.where(fresh, left, 1), 0)
        return space.at[j + 1].set(v), images

    space, images = jax.lax.scan(extend, space, jnp.arange(steps))
    return tuple(space[:steps] @ images[:, i].T for i in range(len(rates)))


def _exponential(matrix: Float[Array, "m m"]) -> Float[Array, "m m"]:
    """Of a matrix of norm at most one, by its series."""
    one = jnp.eye(len(matrix), dtype=matrix.dtype)
    further = lambda total, k: (one + matrix @ total / k, None)
    return jax.lax.scan(further, one, jnp.arange(18.0, 0.0, -1.0, dtype=matrix.dtype))[0]


def _log_radius(matrix: Float[Array, "m m"]) -> Array:
    """Logarithm of the spectral radius, by squaring over and over."""
    count = 30

    def square(carry, _):
        matrix, total, power = carry
        norm = jnp.sqrt(jnp.sum(matrix * matrix))
        norm = jnp.where(norm > 0, norm, 1)
        matrix = matrix / norm
        return (matrix @ matrix, total + jnp.log(norm) * power, power / 2), None

    start = (matrix, jnp.zeros((), matrix.dtype), jnp.ones((), matrix.dtype))
    (_, total, _), _ = jax.lax.scan(square, start, length=count)
    return total
