r"""Whether explicit steps of a given length are stable, before they are taken.

A Runge–Kutta step makes $R(\Delta t\,\lambda)\,v$ of an eigenvector v of the right-hand side's
Jacobian J, where the equation makes $e^{\Delta t\,\lambda}\,v$ of it, with R the stability
polynomial of the method. Here both are taken of the Hessenberg matrix H of a few Arnoldi steps,
which has the outermost eigenvalues of J, and compared by their spectral radii.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, PyTree

from ..functions import constant
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

    def amplification(self, z: Any, one: Any) -> Any:
        """R(z): of a number with one = 1, or of a matrix with one = the identity."""
        increments = [z]
        for row in self.rows:
            increments.append(z @ (one + sum(a * k for a, k in zip(row, increments))))
        return one + sum(b * k for b, k in zip(self.weights, increments))


def tableau_of(solver: dfx.AbstractSolver) -> Tableau | None:
    """That of an explicit Runge–Kutta method; None for another solver."""
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
        projected: H, in units of 1 / time.
        excess: logarithm of that amplification in one step.
    """

    stable: Array
    projected: Float[Array, "m m"]
    excess: Array

    def longest(self, tableau: Tableau, dt: float, span: float) -> tuple[float, float]:
        """The longest stable step up to dt, and the spectral radius of J (on the host)."""
        eigenvalues = np.linalg.eigvals(np.asarray(self.projected, float))
        matrix = lambda z: z[:, None, None]
        for step in dt * np.geomspace(1, 1e-8, 1000):
            z = step * eigenvalues
            with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
                size = np.abs(tableau.amplification(matrix(z), np.eye(1)))[:, 0, 0]
                growth = np.log(size) - np.maximum(z.real, 0)
            if np.nanmax(growth) * max(span / step, 1) <= np.log(_AMPLIFIED):
                return float(step), float(np.abs(eigenvalues).max())
        return 0.0, float(np.abs(eigenvalues).max())


def check_steps(tableau: Tableau, rate: Callable, t, u: PyTree[Array], args, dt, span) -> Verdict:
    """Compare what steps of length dt over a span of time do with what they should.

    Args:
        tableau: of the method.
        rate: (t, u, args) -> right-hand side.
        t, u, args: where it is linearised.
        dt, span: lengths in time.
    """
    h = projected(rate, t, u, args)
    dt, span = constant((jnp.abs(dt), jnp.abs(span)))
    one = jnp.eye(len(h), dtype=h.dtype)
    z = dt * h
    size = jnp.maximum(jnp.max(jnp.sum(jnp.abs(z), axis=1)), 1)
    grown = jnp.maximum(size * _log_radius(_exponential(z / size)), 0)
    excess = _log_radius(tableau.amplification(z, one)) - grown
    steps = jnp.maximum(span / dt, 1)
    # What is not finite is for others to find.
    round_off = 50 * jnp.finfo(h.dtype).eps * size
    unstable = steps * (excess - round_off) > np.log(_AMPLIFIED)
    return Verdict(~unstable, h, excess)


def projected(rate: Callable, t, u: PyTree[Array], args) -> Float[Array, "m m"]:
    """The Jacobian of the right-hand side on the Krylov space of a random state."""
    rate, t, u, args = constant((rate, t, u, args))
    base, unravel = ravel_pytree(u)
    value, size = ravel_pytree(rate(t, u, args))[0], small(base)

    def along(v):  # by differences: a right-hand side may have a rule for the reverse mode only
        return (ravel_pytree(rate(t, unravel(base + size * v), args))[0] - value) / size

    steps = min(_STEPS, base.size)
    start = jnp.asarray(np.random.default_rng(0).normal(size=base.size), base.dtype)
    space = jnp.zeros((steps + 1, base.size), base.dtype).at[0].set(start / length(start))

    def extend(space, j):
        image = along(space[j])
        v = image
        for _ in range(2):
            v = v - space.T @ (space @ v)
        # Where only round-off is left, the space is complete: no further directions.
        left = length(v)
        fresh = left > 10 * jnp.sqrt(jnp.finfo(v.dtype).eps) * length(image)
        v = jnp.where(fresh, v / jnp.where(fresh, left, 1), 0)
        return space.at[j + 1].set(v), image

    space, images = jax.lax.scan(extend, space, jnp.arange(steps))
    return space[:steps] @ images.T


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
