r"""Preconditioners: algebraic multigrid set up on the host, its cycle in JAX; and Jacobi's."""

from __future__ import annotations

import abc
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..arguments import instance, switched_off
from ..boundary import Closure
from ..compiling import at_once, sized_jit
from ..failures import is_concrete, needs_values, without_derivatives
from ..stencils.algebra import AbstractOperator, Composition
from ..stencils.padded import PaddedMatrix
from ..stencils.stencil import Stencil
from . import aggregation, renewal
from .reduced import (
    annihilates_constants,
    check_kinds,
    free_operator,
    reduced_matrix,
    restriction_of,
    stand_in,
)

# The coarsest system has at most this many unknowns and is solved by a dense inverse.
_COARSEST = 400
# Share of a stencil's slots that lie within its support, at most.
USED = 0.85


class AbstractPreconditioner(AbstractOperator):
    """A cheap approximation of the inverse of an operator.

    Args:
        mean_zero: the operator annihilates the constants; None if unknown.

    Example:
        >>> laplacian = js.laplace_beltrami(js.sphere(300))
        >>> isinstance(js.multigrid(laplacian), js.AbstractPreconditioner)
        True
    """

    mean_zero: bool | None = eqx.field(static=True)
    in_shape = ()
    out_shape = ()

    @abc.abstractmethod
    def __call__(self, r: Float[Array, " n"]) -> Float[Array, " n"]:
        """An approximate solution u of A u = r; linear in r."""


class JacobiPreconditioner(AbstractPreconditioner):
    """Division by the diagonal. Needs no set-up, and works on traced operators.

    Args:
        divisor: the diagonal of the operator, `(n,)`.

    Example:
        >>> laplacian = js.laplace_beltrami(js.sphere(300))
        >>> r = jnp.ones(300)
        >>> bool(jnp.all(js.jacobi(laplacian)(r) == r / laplacian.diagonal))
        True
    """

    divisor: Float[Array, " n"]

    n = property(lambda self: len(self.divisor))

    def __call__(self, r):
        return r / self.divisor

    def transpose(self):
        return self


class Level(eqx.Module):
    """One level of a multigrid hierarchy, filled up with unknowns that stay zero.

    Args:
        matrix: the operator on this level.
        transposed: its transpose; None where that is at hand.
        inverse: of the diagonal.
        restrict: to the next coarser level.
        prolong: from there.
        damping: factors of the smoothing steps.
    """

    matrix: PaddedMatrix | AbstractOperator
    transposed: PaddedMatrix | AbstractOperator | None
    inverse: Float[Array, " n"]
    restrict: PaddedMatrix
    prolong: PaddedMatrix
    damping: tuple[Float[Array, ""], ...]

    n = property(lambda self: self.inverse.shape[0])

    def smooth(self, x, b):
        """The smoother from x. Its steps are a loop: the matrix is compiled once."""
        step = lambda x, factor: (x + factor * self.inverse * (b - self.matrix(x)), None)
        return jax.lax.scan(step, x, jnp.stack(self.damping))[0]

    def presmooth(self, b):
        """The smoother from zero, and the residual that it leaves."""

        def step(carry, factor):
            x, r = carry
            x = x + factor * self.inverse * r
            return (x, b - self.matrix(x)), None

        return jax.lax.scan(step, (jnp.zeros_like(b), b), jnp.stack(self.damping))[0]

    @property
    def T(self) -> Level:
        # The prolongation is the transposed restriction: both stay. So do polynomials in
        # D⁻¹A times D⁻¹, with A transposed.
        matrix = self.matrix.T if self.transposed is None else self.transposed  # type: ignore[union-attr]
        return Level(matrix, self.matrix, self.inverse, self.restrict, self.prolong, self.damping)


class VCycle(AbstractPreconditioner):
    """A V-cycle of smoothed aggregation: made by `multigrid`.

    Args:
        levels: from fine to coarse.
        coarsest: inverse of the coarsest operator.
        plan: what `renewed` needs of each level.

    Example:
        >>> cycle = js.multigrid(js.laplace_beltrami(js.sphere(300)))
        >>> cycle(jnp.ones(300)).shape
        (300,)
    """

    levels: tuple[Level, ...]
    coarsest: Float[Array, "m m"]
    plan: tuple[renewal.Coarsening, ...] | None = None

    n = property(lambda self: self.sizes[0])

    @property
    def sizes(self) -> tuple[int, ...]:
        """Room on every level, from fine to coarse: what it is padded to."""
        return (*(level.n for level in self.levels), len(self.coarsest))

    def __repr__(self):
        sizes = " > ".join(map(str, self.sizes))
        where = ", singular: constants" if self.mean_zero else ""
        return f"VCycle({sizes} unknowns, {self.coarsest.dtype.name}{where})"

    def __call__(self, r):
        # At the prompt its loops would be compiled anew at every call.
        return (_cycled if is_concrete(self, r) else VCycle._scaled)(self, r)

    def _scaled(self, r):
        # The cycle is linear, so that a residual of any size can be brought to size one,
        # where single precision is safe.
        size = jnp.max(jnp.abs(r))
        scale = jnp.where(size > 0, size, 1)
        cycled = self._cycle(0, (r / scale).astype(self.coarsest.dtype))
        return cycled.astype(r.dtype) * scale

    def _cycle(self, depth, b):
        if depth == len(self.levels):
            return self.coarsest @ b
        level = self.levels[depth]
        x, r = level.presmooth(b)
        x = x + level.prolong(self._cycle(depth + 1, level.restrict(r)))
        return level.smooth(x, b)

    def transpose(self):
        return VCycle(self.mean_zero, tuple(v.T for v in self.levels), self.coarsest.T)

    def renewed(self, operator: AbstractOperator, *, closure: Closure | None = None) -> VCycle:
        r"""The hierarchy of another operator on the same points: same aggregates, other numbers.

        Runs under `jit`, `vmap` and `grad`, for traced weights and neighbours, closure and
        masks; other values compile nothing. A constant for derivatives. Where neighbours are
        not those of the first operator, entries that its patterns do not hold are lumped.

        Args:
            operator: scalar; one of which the diagonal is known. It annihilates the constants if
                the first one did.
            closure: from `js.eliminate` or `js.with_ghosts`; if there were some at first.

        Raises:
            TypeError: what is no operator or closure.
            ValueError: a hierarchy made without `renewable=True`; an operator for another number
                of points, with components, or of unknown diagonal.

        Example:
            >>> laplacian = js.laplace_beltrami(js.sphere(500))
            >>> cycle = js.multigrid(laplacian, renewable=True)
            >>> rhs = laplacian(jnp.arange(500.0))
            >>> @jax.jit
            ... def solved(factor):
            ...     operator = factor * laplacian
            ...     return js.solve(operator, rhs, preconditioner=cycle.renewed(operator)).value
            >>> bool(jnp.allclose(solved(2.0), solved(1.0) / 2))
            True
        """
        problem = renewal.check_renewal(self.plan, self.n, operator, closure)
        return _renewed(*problem, bool(self.mean_zero), self.coarsest.dtype)


_cycled = eqx.filter_jit(VCycle._scaled)


class _Product(AbstractPreconditioner):
    """One preconditioner after another, for a composition of operators."""

    outer: Any
    inner: Any

    n = property(lambda self: self.outer.n)

    def __call__(self, r):
        return self.inner(self.outer(r))

    def transpose(self):
        return _Product(self.mean_zero, self.inner.T, self.outer.T)

    def renewed(self, operator, *, closure=None):
        instance(operator, Composition, "operator", "as the hierarchy was made for")
        pairs = (self.outer, operator.outer), (self.inner, operator.inner)
        both = (p.renewed(o, closure=closure) for p, o in pairs)
        return _Product(self.mean_zero, *both)


def jacobi(operator: AbstractOperator, *, closure: Closure | None = None) -> JacobiPreconditioner:
    r"""The diagonal of an operator as a preconditioner.

    Needs no optional package and no concrete arrays, but takes of the order of $1/h$ steps:
    for small systems, small time steps, and strongly screened problems.

    Args:
        operator: a stencil from scalar fields to scalar fields; may be traced.
        closure: from `js.eliminate` or `js.with_ghosts`.

    Returns:
        To be passed to `js.solve`.

    Raises:
        ValueError: a composition of operators, or one with components.

    Example:
        >>> screened = 1 - js.laplace_beltrami(js.sphere(500))
        >>> bool((js.jacobi(screened).divisor > 0).all())
        True
    """
    check_kinds(operator, closure)
    diagonal = operator.diagonal
    diagonal = switched_off(operator.active, diagonal, 1)
    if closure is not None:
        diagonal = jnp.where(closure.bound, 1, diagonal)
    return JacobiPreconditioner(None, jax.lax.stop_gradient(diagonal))


def multigrid(
    operator: AbstractOperator,
    *,
    closure: Closure | None = None,
    single: bool = True,
    renewable: bool = False,
    mean_zero: bool | None = None,
) -> AbstractPreconditioner:
    r"""Smoothed-aggregation multigrid (Vaněk, Mandel and Brezina 1996) as a preconditioner.

    Aggregates are found on the host by pyamg. The cycle, one V with Chebyshev smoothing and a
    dense coarsest solve, is plain JAX on padded arrays: it runs under `jit` and `vmap`, and its
    exact transpose serves adjoint solves. It is a constant for derivatives; a hierarchy made
    for one operator serves nearby ones too (other weights on the same neighbours), at the
    price of more steps, or is renewed. Under `jit` and `vmap`, where the neighbours are known and
    the weights are not, as on `surface.moved(points)`, aggregates are found by the neighbours and
    the numbers computed in compiled code (not of sums with compositions, as `1 + L @ L`).

    Args:
        operator: scalar, with concrete neighbours. For an indefinite Helmholtz operator
            $\Delta + \kappa^2$ pass $\Delta - \kappa^2$ here.
        closure: from `js.eliminate` or `js.with_ghosts`; the same as for `js.solve`.
        single: hold and run the cycle in single precision, which halves its time. The solution
            is not affected: its residual is computed in the precision of the operator.
        renewable: keep what `VCycle.renewed` needs to serve other weights in compiled code.
        mean_zero: whether an operator of traced weights annihilates the constants; of concrete
            ones it is seen.

    Returns:
        To be passed to `js.solve`. A composition gets one hierarchy for each factor.

    Raises:
        ImportError: pyamg is not installed (extra `multigrid`).
        ValueError: an operator whose neighbours are traced, that is not finite, or has components
            or zero rows; traced weights without `mean_zero`; a part of the points that nothing
            ties to the rest and on which constants are undetermined.

    Example:
        >>> laplacian = js.laplace_beltrami(js.sphere(2_000))
        >>> len(js.multigrid(laplacian).levels)
        1
    """
    check_kinds(operator, closure)
    if isinstance(operator, Composition) and closure is None:
        make = lambda o: multigrid(o, single=single, renewable=renewable, mean_zero=mean_zero)
        outer, inner = make(operator.outer), make(operator.inner)
        return _Product(bool(outer.mean_zero or inner.mean_zero), outer, inner)
    known = without_derivatives((operator, closure))
    if is_concrete(known):
        return _hierarchy(operator, closure, single, renewable)
    with at_once():
        alike = stand_in(*known)
        if mean_zero is None:
            needs_values("operator and closure", known, instead="pass mean_zero=True or False")
        made = _hierarchy(alike[0], alike[1], single, True, mean_zero)
    return made.renewed(operator, closure=closure)


def _hierarchy(operator, closure, single, renewable, mean_zero=None) -> VCycle:
    fine = reduced_matrix(operator, closure)
    free = restriction_of(operator, closure).on_host
    mean_zero = annihilates_constants(fine, free) if mean_zero is None else mean_zero
    dtype = np.dtype(np.float32) if single else fine.dtype
    width = USED * operator.k if isinstance(operator, Stencil) else None
    levels, made = [], []
    constant = free.astype(float)
    room, on = fine.shape[0], operator.active
    while room > _COARSEST:
        found = aggregation.aggregate(fine, constant)
        if found is None:
            break
        tentative, constant = found
        coarse = aggregation.room_for(tentative.shape[1], room)
        level, prolong, fine = _level(fine, tentative, dtype, room, coarse, width, on)
        levels.append(level)
        made.append((tentative, prolong, fine, level))
        room, width, on = coarse, None, None
    size = fine.shape[0]
    if size > 4 * _COARSEST:
        raise ValueError(f"coarsening stopped at {size} unknowns: too few strong connections")
    dense = np.zeros((room, room), fine.dtype)
    dense[:size, :size] = fine.toarray()
    constant = np.append(constant, np.zeros(room - size))
    used = np.arange(room) < size
    coarsest = aggregation.dense_inverse(dense, used, constant if mean_zero else None).astype(dtype)
    plan = renewal.plan_of(made, [(v.matrix, v.transposed) for v in levels]) if renewable else None
    return VCycle(mean_zero, tuple(levels), jnp.asarray(coarsest), plan)


def _level(matrix, tentative, dtype, room: int, coarse: int, width, on):
    """A level, its prolongation, and the operator on the next one."""
    diagonal = matrix.diagonal()
    if np.any(diagonal == 0):
        i = int(np.flatnonzero(diagonal == 0)[0])
        raise ValueError(f"the diagonal of the operator is zero in row {i}: nothing to smooth with")
    inverse = 1 / aggregation.divisor(matrix)
    radius = aggregation.jacobi_radius(matrix, inverse, on)
    prolong = aggregation.smoothed(matrix, tentative, inverse, radius)
    restrict = prolong.T.tocsr()
    pad = lambda a, rows, width: PaddedMatrix.from_scipy(a, dtype, rows=rows, width=width)
    padded = pad(matrix, room, width)
    level = Level(
        padded,
        pad(matrix.T.tocsr(), room, width),
        aggregation.filled(inverse.astype(dtype), room),
        *aggregation.transfers(padded, restrict, prolong, coarse),
        tuple(jnp.asarray(x, dtype) for x in aggregation.chebyshev(radius)),
    )
    return level, prolong, (restrict @ (matrix @ prolong)).tocsr()


@sized_jit
def _renewed(plan, operator, closure, mean_zero: bool, dtype) -> VCycle:
    matrix, restriction = free_operator(operator, closure)
    below, free = renewal.free_divisor(operator, matrix, restriction)
    if not restriction.all_free:
        matrix, below = matrix + (1 - restriction), below + (1 - free)
    found, (dense,), constant = renewal.renewed_levels(
        plan, (matrix,), below, free, operator.active
    )
    levels = tuple(
        Level(
            v.matrices[0],
            v.transposed[0],
            renewal.inverted(v.divisor),
            v.restrict,
            v.prolong,
            aggregation.chebyshev(v.radius),
        )
        for v in found
    )
    # Rows beyond the last aggregate are zero; those of points that are not free have the identity.
    used = jnp.any(dense != 0, axis=1)
    coarsest = aggregation.dense_inverse(dense, used, constant if mean_zero else None)
    return VCycle(mean_zero, renewal.narrowed(levels, dtype), coarsest.astype(dtype))
