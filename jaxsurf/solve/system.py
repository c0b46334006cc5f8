r"""The square system on fields of all points that a steady problem is solved through."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
from jaxtyping import Array, Float

from ..arguments import instance, real
from ..boundary import Closure, Restriction, check_border
from ..stencils.algebra import AbstractOperator, Composition
from ..stencils.stencil import Stencil
from .precondition import AbstractPreconditioner
from .reduced import check_kinds, free_operator, restriction_of


class System(eqx.Module):
    r"""$P A E + (1 - P) - \sigma\, p\, p^T / p^T p$ with $p = P 1$.

    Nonsingular where the problem has one solution (for an operator that annihilates the
    constants: one up to a constant). The last term is symmetric, and the constants are an
    eigenvector.

    Args:
        operator: A.
        closure: E, and P which keeps free points; None if all are free that are switched on.
        sigma: σ; None if the constants are not in the null space of P A E.
    """

    operator: AbstractOperator
    closure: Closure | None
    sigma: Float[Array, ""] | None = None

    @classmethod
    def of(cls, operator, closure, dtype, mean_zero: bool) -> System:
        plain = cls(operator, closure)
        if not mean_zero:
            return plain
        # σ of the size and sign that keep the new eigenvalue among the others.
        signs = plain.restriction(1.0 - 2.0 * (jnp.arange(operator.n) % 2).astype(dtype))
        size = -jnp.vdot(signs, plain.reduced(signs)) / jnp.vdot(signs, signs)
        return cls(operator, closure, jax.lax.stop_gradient(jnp.where(size == 0, 1, size)))

    @property
    def reduced(self) -> AbstractOperator:
        """P A E."""
        return free_operator(self.operator, self.closure)[0]

    @property
    def matrix(self) -> AbstractOperator:
        matrix, restriction = free_operator(self.operator, self.closure)
        if not restriction.all_free:
            matrix = matrix + (1 - restriction)
        return matrix if self.sigma is None else matrix - self.sigma * self.averaging

    def inverse(self, preconditioner: AbstractPreconditioner) -> AbstractOperator:
        """Of the matrix, approximately: exact on the constants of a mean-zero problem."""
        if self.sigma is None:
            return preconditioner
        off = 1 - self.averaging
        return off @ preconditioner @ off - (1 / self.sigma) * self.averaging

    @property
    def restriction(self) -> Restriction:
        """P."""
        return restriction_of(self.operator, self.closure)

    @property
    def averaging(self) -> Averaging:
        """p pᵀ / pᵀ p."""
        return Averaging(self.restriction)

    def spread(self) -> Float[Array, "*n"]:
        """One over half the row sums of moduli: the square of a distance for a Laplacian."""
        outer = self.operator
        while isinstance(outer, Composition):
            outer = outer.outer
        if not isinstance(outer, Stencil):
            return 1 / jnp.abs(jnp.asarray(self.sigma if self.sigma is not None else 1))
        half = jnp.sum(jnp.abs(outer.weights), axis=0) / 2
        return 1 / jnp.where(half > 0, half, 1)

    def constant(self, value, dtype):
        """p times a number."""
        return self.restriction(jnp.broadcast_to(jnp.asarray(value, dtype), self.operator.n))

    def mean(self, v):
        """Over free points."""
        return self.averaging.mean(v)

    @property
    def count(self):
        """Number of free points."""
        return self.restriction.count

    def shift(self, v):
        r"""$-\sigma$ times the mean: where the system holds, $P A E v = f - p\,$ shift(v)."""
        return jnp.zeros((), v.dtype) if self.sigma is None else -self.sigma * self.mean(v)


class Averaging(AbstractOperator):
    """The mean over the free points, at each of these: symmetric, of rank one."""

    restriction: Restriction
    in_shape = ()
    out_shape = ()

    n = property(lambda self: self.restriction.n)

    def mean(self, v):
        return jnp.sum(self.restriction(v)) / self.restriction.count

    def __call__(self, v):
        return self.restriction(jnp.broadcast_to(self.mean(v), v.shape))

    def transpose(self):
        return self


def check_system(operator, closure, preconditioner, solver, atol) -> None:
    """Refuse what is not of the kinds that a problem consists of."""
    check_kinds(operator, closure)
    if preconditioner is not None:
        hint = "js.multigrid(operator) makes one"
        instance(preconditioner, AbstractPreconditioner, "preconditioner", hint)
    if solver is not None:
        instance(solver, lx.AbstractLinearSolver, "solver", "js.BiCGStab() is one")
    real(atol, "atol", least=0)
    check_border(operator, closure)


def tolerance(rtol, dtype) -> float:
    """A relative tolerance, by the precision if it is None."""
    if rtol is None:
        return 1e-8 if jnp.finfo(dtype).eps < 1e-12 else 1e-4
    return float(real(rtol, "rtol", above=0, below=1))
