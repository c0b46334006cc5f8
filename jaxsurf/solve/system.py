r"""The square system on fields of all points that a steady problem is solved through."""

from __future__ import annotations

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
from jaxtyping import Array, Float

from ..arguments import count_on, instance, real, switched_off
from ..boundary import Closure, check_border
from ..stencils.stencil import AbstractOperator, Composition, Stencil, check_scalar
from .padded import Layout, adjoint
from .precondition import AbstractPreconditioner


class Square(lx.AbstractLinearOperator):
    """A linear map of fields for lineax, of which nothing but products is known."""

    def out_structure(self):
        return self.in_structure()

    def as_matrix(self):
        raise NotImplementedError("an n x n array is what these operators avoid")


def matrix_free(kind):
    """Tell lineax that a class of `Square` operators has no properties to make use of."""
    lx.linearise.register(kind, lambda operator: operator)
    lx.conj.register(kind, lambda operator: operator)
    for has_property in (
        lx.is_symmetric,
        lx.is_diagonal,
        lx.is_tridiagonal,
        lx.is_lower_triangular,
        lx.is_upper_triangular,
        lx.is_positive_semidefinite,
        lx.is_negative_semidefinite,
        lx.has_unit_diagonal,
    ):
        has_property.register(kind, lambda operator: False)
    return kind


class Linearised(AbstractOperator):
    """An operator plus a linear map of which only products are known.

    Args:
        operator: L.
        slope: the derivative of a reaction.
    """

    operator: AbstractOperator
    slope: Callable
    in_shape = ()
    out_shape = ()

    @property
    def n(self):
        return self.operator.n

    @property
    def active(self):
        return self.operator.active

    def __call__(self, u):
        return self.operator(u) + self.slope(u)

    def transpose(self):
        raise NotImplementedError("see `_adjoint`")

    def to_scipy(self):
        raise NotImplementedError("the matrix of a derivative is not at hand")


class _Turned(eqx.Module):
    """The transpose of a linearised operator; with the plain one's, where that is known."""

    operator: Linearised
    plain: Callable | None

    def __call__(self, v):
        turned = lambda f: jax.linear_transpose(f, v)(v)[0]
        plain = turned(self.operator.operator) if self.plain is None else self.plain(v)
        return plain + turned(self.operator.slope)


def _adjoint(operator, layout) -> Callable | None:
    """The transposed operator; None where a layout is lacking."""
    if isinstance(operator, Linearised):
        return _Turned(operator, adjoint(operator.operator, layout))
    return adjoint(operator, layout)


@matrix_free
class System(Square):
    r"""$P A E + (1 - P) - \sigma\, p\, p^T / p^T p$ with $p = P 1$.

    Nonsingular where the problem has one solution (for an operator that annihilates the
    constants: one up to a constant). The last term is symmetric, and the constants are an
    eigenvector.

    Args:
        operator: A.
        conditions: E, and P which keeps free points; None if all are free that are switched on.
        sigma: σ; None if the constants are not in the null space of P A E.
        layout: of the transpose of A, if known.
        dtype: of the fields.
    """

    operator: AbstractOperator
    conditions: Closure | None
    sigma: Float[Array, ""] | None
    layout: Layout
    dtype: np.dtype = eqx.field(static=True)

    @classmethod
    def of(cls, operator, conditions, layout, dtype, mean_zero: bool) -> System:
        plain = cls(operator, conditions, None, layout, np.dtype(dtype))
        if not mean_zero:
            return plain
        # σ of the size and sign that keep the new eigenvalue among the others.
        signs = plain.free(1.0 - 2.0 * (jnp.arange(operator.n) % 2).astype(dtype))
        size = -jnp.vdot(signs, plain.mv(signs)) / jnp.vdot(signs, signs)
        sigma = jax.lax.stop_gradient(jnp.where(size == 0, 1, size))
        return cls(operator, conditions, sigma, layout, np.dtype(dtype))

    def mv(self, vector):
        u = vector if self.conditions is None else self.conditions.homogeneous(vector)
        return self.free(self.operator(u)) + self.rest(vector)

    def products(self, fields: Float[Array, "n c"]) -> Float[Array, "n c"]:
        """P A E of several fields at once."""
        if self.conditions is None:
            return self.free(self.operator(fields))
        return self.free(self.operator(self.conditions.homogeneous(fields)))

    def spread(self) -> Float[Array, "*n"]:
        """One over half the row sums of moduli: the square of a distance for a Laplacian."""
        outer = self.operator
        while isinstance(outer, Composition):
            outer = outer.outer
        if not isinstance(outer, Stencil):
            return 1 / jnp.abs(jnp.asarray(self.sigma if self.sigma is not None else 1))
        half = jnp.sum(jnp.abs(outer.weights), axis=0) / 2
        return 1 / jnp.where(half > 0, half, 1)

    def rest(self, v):
        """What is added to P A E."""
        return v - self.free(v) + self.constant(self.shift(v))

    def free(self, v):
        """P v."""
        v = switched_off(self.operator.active, v)
        return v if self.conditions is None else self.conditions.restrict(v)

    def constant(self, value):
        """p times a number."""
        return self.free(jnp.broadcast_to(jnp.asarray(value, self.dtype), self.operator.n))

    def mean(self, v):
        """Over free points."""
        return jnp.sum(self.free(v)) / self.count

    @property
    def count(self):
        """Number of free points."""
        bound = 0 if self.conditions is None else self.conditions.m
        return count_on(self.operator.active, self.operator.n) - bound

    def shift(self, v):
        r"""$-\sigma$ times the mean: where the system holds, $P A E v = f - p\,$ shift(v)."""
        return jnp.zeros((), self.dtype) if self.sigma is None else -self.sigma * self.mean(v)

    def transpose(self):
        return Transposed(self, _adjoint(self.operator, self.layout))

    def in_structure(self):
        return jax.ShapeDtypeStruct((self.operator.n,), self.dtype)


@matrix_free
class Transposed(Square):
    """The transpose of a system, the weights of its operator gathered once."""

    system: System
    adjoint: Callable | None

    def mv(self, vector):
        system, shape = self.system, self.in_structure()
        v = system.free(vector)
        if self.adjoint is None:
            (v,) = jax.linear_transpose(system.operator, shape)(v)
        else:
            v = switched_off(system.operator.active, self.adjoint(v))
        if system.conditions is not None:
            v = _turned(system.conditions, v)
        return v + system.rest(vector)

    def transpose(self):
        return self.system

    def in_structure(self):
        return self.system.in_structure()


def check_system(operator, conditions, preconditioner, solver, atol) -> None:
    """Refuse what is not of the kinds that a problem consists of."""
    instance(operator, AbstractOperator, "operator", "js.laplace_beltrami(cloud) makes one")
    check_scalar(operator)
    if conditions is not None:
        hint = "js.close(cloud, conditions) makes one of conditions"
        instance(conditions, Closure, "conditions", hint)
        if conditions.n != operator.n:
            raise ValueError(f"conditions for {conditions.n} points, the operator has {operator.n}")
    if preconditioner is not None:
        hint = "js.multigrid(operator) makes one"
        instance(preconditioner, AbstractPreconditioner, "preconditioner", hint)
    if solver is not None:
        instance(solver, lx.AbstractLinearSolver, "solver", "js.BiCGStab() is one")
    real(atol, "atol", least=0)
    check_border(operator, conditions)


def tolerance(rtol, dtype) -> float:
    """A relative tolerance, by the precision if it is None."""
    if rtol is None:
        return 1e-8 if jnp.finfo(dtype).eps < 1e-12 else 1e-4
    return float(real(rtol, "rtol", above=0, below=1))


@matrix_free
class Inverse(Square):
    """A preconditioner for a system: exact on the constants of a mean-zero problem."""

    preconditioner: AbstractPreconditioner
    system: System

    def mv(self, vector):
        system = self.system
        if system.sigma is None:
            return self.preconditioner(vector).astype(vector.dtype)
        off = lambda v: v - system.constant(system.mean(v))
        inner = off(self.preconditioner(off(vector)).astype(vector.dtype))
        return inner - system.constant(system.mean(vector) / system.sigma)

    def transpose(self):
        return Inverse(self.preconditioner.transpose(), self.system)

    def in_structure(self):
        return self.system.in_structure()


def _turned(conditions, v):
    """Eᵀ v: what a bound value came from gets its share; only free points are left."""
    shares = conditions.weights * v[conditions.rows]
    return conditions.restrict(v.at[conditions.indices].add(shares))
