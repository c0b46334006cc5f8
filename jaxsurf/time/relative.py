r"""Linear solvers for the systems of a step, whose tolerance is relative to the right-hand side."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
from jaxtyping import Array, PyTree

from ..solve.krylov import BiCGStab
from .states import dtype_of, root_mean_square


class Relative(lx.AbstractLinearSolver):
    """A linear solver whose tolerance is relative to the norm of the right-hand side.

    That of `js.BiCGStab` is. Krylov solvers of lineax weigh the residual point by point with the
    right-hand side, which may vanish somewhere; for them it is brought to norm one, and the
    residual is then computed afresh, because the recursions of BiCGStab may lose it. Systems that
    are not solved give NaN: nobody looks at the result codes of those that derivatives solve.

    Args:
        solver: does the work.
        tolerance: largest residual.
        partial: give what there is where a system is not solved.
    """

    solver: lx.AbstractLinearSolver
    tolerance: Any
    partial: bool = eqx.field(static=True, default=False)

    def init(self, operator, options):
        return self.solver.init(operator, options), operator

    def compute(self, state, vector, options):
        krylov, operator = state
        if isinstance(self.solver, BiCGStab):
            x, result, stats = self.solver.compute(krylov, vector, options)
            good = result == lx.RESULTS.successful
        else:
            x, result, stats, good = self._at_norm_one(krylov, operator, vector, options)
        # Too many steps of this solver are not to be mistaken for too many steps in time.
        mild = (result == lx.RESULTS.successful) | (result == lx.RESULTS.max_steps_reached)
        result = lx.RESULTS.where(
            good, lx.RESULTS.successful, lx.RESULTS.where(mild, lx.RESULTS.stagnation, result)
        )
        x = jax.tree.map(lambda x: jnp.where(good | self.partial, x, jnp.nan), x)
        return x, result, stats

    def _at_norm_one(self, krylov, operator, vector, options):
        norm = root_mean_square(vector)
        scale = jnp.where(norm > 0, norm, 1)
        unit = jax.tree.map(lambda v: v / scale, vector)
        x, result, stats = self.solver.compute(krylov, unit, options)
        missed = lambda image: root_mean_square(jax.tree.map(jnp.subtract, image, unit))
        # Where a multiple of the right-hand side solves the system (zero, constants, eigenvectors),
        # BiCGStab divides zero by zero.
        image = operator.mv(unit)
        inner = lambda a, b: sum(jnp.vdot(*pair) for pair in zip(*map(jax.tree.leaves, (a, b))))
        length = inner(image, image)
        factor = inner(unit, image) / jnp.where(length > 0, length, 1)
        simple = missed(jax.tree.map(lambda a: factor * a, image)) <= self.tolerance
        x = jax.tree.map(lambda x, u: jnp.where(simple, factor * u, x), x, unit)
        good = missed(operator.mv(x)) <= 10 * self.tolerance
        return jax.tree.map(lambda x: scale * x, x), result, stats, good

    def transpose(self, state, options):
        inner, operator = state
        inner, options = self.solver.transpose(inner, options)
        return (inner, operator.transpose()), options

    def conj(self, state, options):
        inner, operator = state
        inner, options = self.solver.conj(inner, options)
        return (inner, lx.conj(operator)), options

    def assume_full_rank(self):
        return True


def relative(
    solver: lx.AbstractLinearSolver | None, tolerance, y: PyTree[Array], partial: bool = False
) -> Relative:
    tolerance = tolerance_of(tolerance, y)
    if solver is None:
        solver = BiCGStab(rtol=tolerance, max_steps=_KRYLOV_STEPS)
    return Relative(solver, tolerance, partial)


# A system that needs more Krylov steps than this wants a preconditioner or a shorter step.
_KRYLOV_STEPS = 500


def tolerance_of(tolerance, y: PyTree[Array]):
    return float(jnp.finfo(dtype_of(y)).eps) ** 0.6 if tolerance is None else tolerance
