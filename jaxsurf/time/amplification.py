r"""What one step makes of a linear problem, $R(\Delta t\,J)$, for steps that may be unstable."""

from __future__ import annotations

import abc
from collections.abc import Sequence
from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import ArrayLike, Float

from ..compiling import AnyArray, namespace
from .bashforth import AdamsBashforth2
from .chebyshev import SAFETY, Step, nth_stage, stages_of
from .explicit import RKC2
from .implicit import IMEX, SDIRK

Rows = tuple[tuple[float, ...], ...]


class AbstractAmplification(eqx.Module):
    """A step as a matrix, in NumPy or in JAX."""

    @abc.abstractmethod
    def __call__(self, dt, parts: Sequence) -> Any:
        """What the state is multiplied by.

        Args:
            dt: length of the step.
            parts: matrices of the right-hand side, or of its explicit and its implicit part,
                times dt.

        Returns:
            As large as a part; of methods that keep several values, as large as all of them.
        """

    def growth(self, dt, parts: Sequence) -> Any:
        """Logarithm of what the mode that grows most is multiplied by."""
        return log_radius(self(dt, parts))


class Tableau(AbstractAmplification):
    """An explicit Runge–Kutta method.

    Args:
        rows: strictly lower, row by row.
        weights: of the result.
    """

    rows: Rows = eqx.field(static=True)
    weights: tuple[float, ...] = eqx.field(static=True)

    def __call__(self, dt, parts):
        (z,) = parts
        one = _one(z)
        increments = [z]
        for row in self.rows:
            increments.append(z @ (one + sum(a * k for a, k in zip(row, increments))))
        return one + sum(b * k for b, k in zip(self.weights, increments))


class Additive(AbstractAmplification):
    """A method that treats one part explicitly and one implicitly.

    Args:
        explicit, implicit: strictly lower, row by row from the second on.
        diagonal: of the implicit stages.
        weights: of the result, for each part.
    """

    explicit: Rows = eqx.field(static=True)
    implicit: Rows = eqx.field(static=True)
    diagonal: tuple[float, ...] = eqx.field(static=True)
    weights: Rows = eqx.field(static=True)

    def __call__(self, dt, parts):
        first, second = parts
        one = _one(first)
        increments = [(first, second)]
        for *rows, gamma in zip(self.explicit, self.implicit, self.diagonal):
            known = one + sum(
                a * k for row, ks in zip(rows, zip(*increments)) for a, k in zip(row, ks)
            )
            y = namespace(one).linalg.solve(one - gamma * second, known)
            increments.append((first @ y, second @ y))
        return one + sum(
            b * k for bs, ks in zip(self.weights, zip(*increments)) for b, k in zip(bs, ks)
        )


class Chebyshev(AbstractAmplification):
    """`RKC2`, with the stages that it takes where it estimates the radius well.

    Args:
        radius: the spectral radius that it was given, else None.
        max_stages: the largest number; nothing is known of a step that needs more.
    """

    radius: ArrayLike | None
    max_stages: int = eqx.field(static=True)

    def __call__(self, dt, parts):
        (z,) = parts
        numbers, one = namespace(z), _one(z)
        reach = SAFETY * numbers.exp(log_radius(z)) if self.radius is None else dt * self.radius
        stages, enough = stages_of(reach, self.max_stages)
        if isinstance(z, np.ndarray):
            found = nth_stage(lambda _, y: z @ y, one, z, stages, max_stages=self.max_stages)
        else:
            step = Step(lambda _, y: z @ y, lambda rate: rate, one, z, self.max_stages)
            found = step.turned(False, stages, stages, z)[0]
        return numbers.where(enough, found, numbers.nan)


class Leapfrog(AbstractAmplification):
    """The midpoint rule with two values: the state, and the one before."""

    def __call__(self, dt, parts):
        (z,) = parts
        one = _one(z)
        return namespace(z).block([[2 * z, one], [one, 0 * one]])


class Bashforth(AbstractAmplification):
    """Of steps of one length: the state, and the one before."""

    def __call__(self, dt, parts):
        (z,) = parts
        one = _one(z)
        return namespace(z).block([[one + 1.5 * z, -0.5 * z], [one, 0 * one]])


class Reversible(AbstractAmplification):
    """Heun's method in its reversible form: the state, and another beside it."""

    def __call__(self, dt, parts):
        (z,) = parts
        one = _one(z)
        return namespace(z).block([[one + z, z @ z / 2], [2 * one, z - one]])


class Halved(AbstractAmplification):
    """Two steps of half the length."""

    step: AbstractAmplification

    def __call__(self, dt, parts):
        half = self.step(dt / 2, [part / 2 for part in parts])
        return half @ half


# Steps of a solver that is not known, half of which are its start.
_MEASURED = 16


class Measured(AbstractAmplification):
    """A solver of one's own: its first step; in the end it grows as from the middle of some on."""

    solver: dfx.AbstractSolver

    def __call__(self, dt, parts):
        return _steps(self.solver, *jax.tree.map(jnp.asarray, (dt, list(parts))))[0]

    def growth(self, dt, parts):
        first, *later = _steps(self.solver, *jax.tree.map(jnp.asarray, (dt, list(parts))))
        half, end = map(log_radius, later)
        # Sixteen unstable steps may be beyond all numbers: the first one tells then.
        known = jnp.isfinite(half) & jnp.isfinite(end) & jnp.all(jnp.isfinite(later[1]))
        found = jnp.where(known, (end - half) / (_MEASURED // 2), log_radius(first))
        return float(found) if isinstance(parts[0], np.ndarray) else found


@eqx.filter_jit
def _steps(solver, dt, parts):
    """What one, half and all of these steps make of any state, which is a vector."""
    term_of = lambda z: dfx.ODETerm(lambda t, y, args: z @ y / dt)
    term = term_of(*parts) if len(parts) == 1 else dfx.MultiTerm(*map(term_of, parts))

    def made(y):
        def step(carry, i):
            y, state = carry
            y, _, _, state, _ = solver.step(term, i * dt, (i + 1) * dt, y, None, state, False)
            return (y, state), y

        start = y, solver.init(term, jnp.zeros_like(dt), dt, y, None)
        ys = jax.lax.scan(step, start, jnp.arange(_MEASURED, dtype=dt.dtype))[1]
        return ys[0], ys[_MEASURED // 2 - 1], ys[-1]

    return jax.vmap(made, in_axes=1, out_axes=1)(_one(parts[0]))


def _is_general(solver: dfx.AbstractSolver, parts: int) -> bool:
    """Whether a solver takes a step of any matrices; one that knows its problem may not."""
    z = jnp.zeros((3, 3))
    try:
        found = jax.eval_shape(_steps, solver, z[0, 0], [z] * parts)
    except Exception:  # whatever somebody else's step runs into
        return False
    return all(step.shape == z.shape for step in found)


def amplification_of(solver: dfx.AbstractSolver, parts: int = 1) -> AbstractAmplification | None:
    """That of a solver that is explicit, in part or whole, on so many parts of a right-hand side.

    None for an implicit one, and for one of one's own that is no function of what it is given.
    """
    # (A solver that wraps another says that it is of the kind of that.)
    if type(solver) is dfx.HalfSolver:
        step = amplification_of(solver.solver, parts)
        return None if step is None else Halved(step)
    if isinstance(solver, RKC2):
        return Chebyshev(solver.spectral_radius, solver.max_stages)
    if isinstance(solver, IMEX):
        known = solver.tableau
        lower = lambda m: _rows([row[:i] for i, row in enumerate(m) if i])
        return Additive(
            lower(known.explicit), lower(known.implicit), _numbers(known.diagonal[1:]),
            _rows(known.weights),
        )  # fmt: skip
    if isinstance(solver, dfx.Euler):
        return Tableau((), (1.0,))
    if isinstance(solver, AdamsBashforth2):
        return Bashforth()
    if isinstance(solver, dfx.LeapfrogMidpoint):
        return Leapfrog()
    if isinstance(solver, dfx.ReversibleHeun):
        return Reversible()
    tableau: Any = getattr(solver, "tableau", None)
    if isinstance(solver, dfx.AbstractERK):
        return Tableau(_rows(tableau.a_lower), _numbers(tableau.b_sol))
    both: Any = getattr(tableau, "tableaus", ())
    if len(both) == 2 and both[0].a_diagonal is None:
        explicit, implicit = both
        return Additive(
            _rows(explicit.a_lower), _rows(implicit.a_lower), _numbers(implicit.a_diagonal[1:]),
            (_numbers(explicit.b_sol), _numbers(implicit.b_sol)),
        )  # fmt: skip
    if isinstance(solver, dfx.AbstractImplicitSolver | SDIRK) or not _is_general(solver, parts):
        return None
    return Measured(solver)


def log_radius(matrix: Float[AnyArray, "m m"]) -> Any:
    """Logarithm of the spectral radius; in JAX by squaring over and over."""
    if isinstance(matrix, np.ndarray):
        if not np.isfinite(matrix).all():
            return np.inf
        with np.errstate(divide="ignore"):
            return np.log(np.abs(np.linalg.eigvals(matrix)).max())
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


def _one(z):
    return namespace(z).eye(len(z), dtype=z.dtype)


def _numbers(values) -> tuple[float, ...]:
    return tuple(map(float, values))


def _rows(rows) -> Rows:
    return tuple(map(_numbers, rows))
