r"""Preconditioners: algebraic multigrid set up on the host, its cycle in JAX; and Jacobi's."""

from __future__ import annotations

import abc

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse
from jaxtyping import Array, Float

from ..arguments import instance, switched_off
from ..boundary import Closure
from ..stencils.algebra import AbstractOperator, Composition, check_scalar
from ..stencils.padded import PaddedMatrix
from ..stencils.stencil import Stencil
from .reduced import annihilates_constants, free_points, reduced_matrix

# The coarsest system has at most this many unknowns and is solved by a dense inverse.
_COARSEST = 400
# Room on the next level: one unknown for so many; a tenth to a twentieth are used as a rule.
_COARSENING = 8
# Share of a stencil's slots that lie within its support, at most.
USED = 0.85
# A connection counts as strong from this share of the geometric mean of both diagonal entries.
_STRENGTH = 0.05
# The smoother damps the part of the spectrum from this share of its end upwards.
_SMOOTHED = 0.25


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


class Jacobi(AbstractPreconditioner):
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

    @property
    def n(self):
        return len(self.divisor)

    def __call__(self, r):
        return r / self.divisor

    def transpose(self):
        return self


class Level(eqx.Module):
    """One level of a multigrid hierarchy, filled up with unknowns that stay zero.

    Args:
        matrix: the operator on this level.
        turned: its transpose.
        inverse: of the diagonal.
        restrict: to the next coarser level.
        prolong: from there.
        damping: factors of the smoothing steps.
    """

    matrix: PaddedMatrix
    turned: PaddedMatrix
    inverse: Float[Array, " n"]
    restrict: PaddedMatrix
    prolong: PaddedMatrix
    damping: tuple[Float[Array, ""], ...]

    @property
    def n(self) -> int:
        return self.inverse.shape[0]

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


class Multigrid(AbstractPreconditioner):
    """A V-cycle of smoothed aggregation: made by `multigrid`.

    Args:
        levels: from fine to coarse.
        coarsest: inverse of the coarsest operator.

    Example:
        >>> cycle = js.multigrid(js.laplace_beltrami(js.sphere(300)))
        >>> cycle(jnp.ones(300)).shape
        (300,)
    """

    levels: tuple[Level, ...]
    coarsest: Float[Array, "m m"]

    @property
    def n(self):
        return self.sizes[0]

    @property
    def sizes(self) -> tuple[int, ...]:
        """Room on every level, from fine to coarse: what it is padded to."""
        return (*(level.n for level in self.levels), len(self.coarsest))

    def __repr__(self):
        sizes = " > ".join(map(str, self.sizes))
        where = ", singular: constants" if self.mean_zero else ""
        return f"Multigrid({sizes} unknowns, {self.coarsest.dtype.name}{where})"

    def __call__(self, r):
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
        # The prolongation is the transposed restriction: both stay. So do polynomials in
        # D⁻¹A times D⁻¹, with A transposed.
        levels = tuple(
            Level(v.turned, v.matrix, v.inverse, v.restrict, v.prolong, v.damping)
            for v in self.levels
        )
        return Multigrid(self.mean_zero, levels, self.coarsest.T)


class _Product(AbstractPreconditioner):
    """One preconditioner after another, for a composition of operators."""

    outer: AbstractPreconditioner
    inner: AbstractPreconditioner

    @classmethod
    def of(cls, outer, inner):
        mean_zero = bool(outer.mean_zero or inner.mean_zero)
        return cls(mean_zero, outer, inner)

    @property
    def n(self):
        return self.outer.n

    def __call__(self, r):
        return self.inner(self.outer(r))

    def transpose(self):
        return _Product.of(self.inner.transpose(), self.outer.transpose())


def jacobi(operator: AbstractOperator, *, conditions: Closure | None = None) -> Jacobi:
    r"""The diagonal of an operator as a preconditioner.

    Needs no optional package and no concrete arrays, but takes of the order of $1/h$ steps:
    for small systems, small time steps, and strongly screened problems.

    Args:
        operator: a stencil from scalar fields to scalar fields; may be traced.
        conditions: from `js.close` or `js.with_ghosts`.

    Returns:
        To be passed to `js.solve`.

    Raises:
        ValueError: a composition of operators, or one with components.

    Example:
        >>> screened = 1 - js.laplace_beltrami(js.sphere(500))
        >>> bool((js.jacobi(screened).divisor > 0).all())
        True
    """
    _check_kinds(operator, conditions)
    diagonal = operator.diagonal
    diagonal = switched_off(operator.active, diagonal, 1)
    if conditions is not None:
        diagonal = jnp.where(conditions.bound, 1, diagonal)
    return Jacobi(None, jax.lax.stop_gradient(diagonal))


def multigrid(
    operator: AbstractOperator,
    *,
    conditions: Closure | None = None,
    single: bool = True,
) -> AbstractPreconditioner:
    r"""Smoothed-aggregation multigrid (Vaněk, Mandel and Brezina 1996) as a preconditioner.

    Aggregates are found on the host by pyamg. The cycle, one V with Chebyshev smoothing and a
    dense coarsest solve, is plain JAX on padded arrays: it runs under `jit` and `vmap`, and its
    exact transpose serves adjoint solves. It is a constant for derivatives; a hierarchy made
    for one operator serves nearby ones too (other weights on the same neighbours), at the
    price of more steps.

    Args:
        operator: scalar, with concrete arrays. For an indefinite Helmholtz operator
            $\Delta + \kappa^2$ pass $\Delta - \kappa^2$ here.
        conditions: from `js.close` or `js.with_ghosts`; the same as for `js.solve`.
        single: hold and run the cycle in single precision, which halves its time. The solution
            is not affected: its residual is computed in the precision of the operator.

    Returns:
        To be passed to `js.solve`. A composition gets one hierarchy for each factor.

    Raises:
        ImportError: pyamg is not installed (extra `multigrid`).
        ValueError: an operator that is traced, not finite, or has components or zero rows; a
            part of the points that nothing ties to the rest and on which constants are
            undetermined.

    Example:
        >>> laplacian = js.laplace_beltrami(js.sphere(2_000))
        >>> len(js.multigrid(laplacian).levels)
        1
    """
    _check_kinds(operator, conditions)
    if isinstance(operator, Composition) and conditions is None:
        return _Product.of(*(multigrid(o, single=single) for o in (operator.outer, operator.inner)))
    return _hierarchy(operator, conditions, single)


def _check_kinds(operator, conditions) -> None:
    instance(operator, AbstractOperator, "operator", "js.laplace_beltrami(cloud) makes one")
    check_scalar(operator)
    if conditions is not None:
        hint = "js.close(cloud, conditions) makes one of conditions"
        instance(conditions, Closure, "conditions", hint)


def _hierarchy(operator, conditions, single: bool) -> Multigrid:
    matrix = reduced_matrix(operator, conditions)
    free = free_points(operator, conditions)
    mean_zero = annihilates_constants(matrix, free)
    dtype = np.dtype(np.float32) if single else matrix.dtype
    width = USED * operator.k if isinstance(operator, Stencil) else None
    levels = []
    constant = free.astype(float)
    fine, room, on = matrix, matrix.shape[0], operator.active
    while room > _COARSEST:
        found = aggregate(fine, constant)
        if found is None:
            break
        tentative, constant = found
        coarse = room_for(tentative.shape[1], room)
        level, fine = _level(fine, tentative, dtype, room, coarse, width, on)
        levels.append(level)
        room, width, on = coarse, None, None
    if fine.shape[0] > 4 * _COARSEST:
        raise ValueError(
            f"coarsening stopped at {fine.shape[0]} unknowns: too few strong connections"
        )
    coarsest = np.zeros((room, room), dtype)
    part = slice(fine.shape[0])
    coarsest[part, part] = _inverse(fine, constant if mean_zero else None)
    return Multigrid(mean_zero, tuple(levels), jnp.asarray(coarsest))


# --- set-up on the host --------------------------------------------------------------------


def room_for(unknowns: int, finer: int) -> int:
    """What a level is padded to: a share of the room on the finer one, so that few sizes occur."""
    room = -(-finer // _COARSENING)
    while room < unknowns:
        room *= 2
    return room


def filled(a: np.ndarray, room: int, value: float = 0.0) -> Array:
    """The array with values appended."""
    return jnp.asarray(np.append(a, np.full(room - len(a), value, a.dtype)))


def aggregate(matrix, constant):
    """Tentative prolongation and the coarse constants; None if nothing can be aggregated."""
    try:
        from pyamg.aggregation import fit_candidates, standard_aggregation
        from pyamg.strength import symmetric_strength_of_connection
    except ImportError as error:
        raise ImportError(
            "js.multigrid needs pyamg: pip install 'jaxsurf[multigrid]'. Without it pass "
            "preconditioner=js.jacobi(operator), which takes more steps"
        ) from error
    strong = symmetric_strength_of_connection(matrix, theta=_STRENGTH)
    aggregates = standard_aggregation(strong)[0]
    if aggregates.shape[1] == 0 or aggregates.shape[1] > 0.8 * matrix.shape[0]:
        return None
    tentative, coarse = fit_candidates(aggregates, constant[:, None])
    return scipy.sparse.csr_matrix(tentative), coarse[:, 0]


def _level(matrix, tentative, dtype, room: int, coarse: int, width, on):
    """A level, and the operator on the next one."""
    diagonal = matrix.diagonal()
    if np.any(diagonal == 0):
        i = int(np.flatnonzero(diagonal == 0)[0])
        raise ValueError(f"the diagonal of the operator is zero in row {i}: nothing to smooth with")
    inverse = 1 / divisor(matrix)
    radius = jacobi_radius(matrix, inverse, on)
    prolong = smoothed(matrix, tentative, inverse, radius)
    restrict = prolong.T.tocsr()
    pad = lambda a, rows, width: PaddedMatrix.from_scipy(a, dtype, rows=rows, width=width)
    padded = pad(matrix, room, width)
    level = Level(
        padded,
        pad(matrix.T.tocsr(), room, width),
        filled(inverse.astype(dtype), room),
        *transfers(padded, restrict, prolong, coarse),
        tuple(jnp.asarray(x, dtype) for x in chebyshev(radius)),
    )
    return level, (restrict @ (matrix @ prolong)).tocsr()


def transfers(padded, restrict, prolong, coarse: int) -> tuple[PaddedMatrix, PaddedMatrix]:
    """Restriction and prolongation next to a level's matrix, as padded arrays."""
    # About as wide as they are on surfaces.
    (k, rows), dtype = padded.indices.shape, padded.weights.dtype
    return (
        PaddedMatrix.from_scipy(restrict, dtype, rows=coarse, width=2.2 * k + 12),
        # Few slots: rather some too many than another number on the next surface.
        PaddedMatrix.from_scipy(prolong, dtype, rows=rows, width=0.16 * k + 2, step=0.5),
    )


def divisor(matrix) -> np.ndarray:
    """What Jacobi's steps divide by.

    At points with a small diagonal (few, badly placed neighbours) plain ones would diverge. Half
    the sum of a row's moduli, the diagonal where weights are of one sign, keeps the row sums of
    D⁻¹A below 2.
    """
    diagonal = matrix.diagonal()
    return np.sign(diagonal) * np.maximum(
        np.abs(diagonal), abs(matrix) @ np.full(len(diagonal), 0.5)
    )


def smoothed(matrix, tentative, inverse, radius) -> scipy.sparse.csr_matrix:
    """Prolongation after a step of Jacobi's, (I - w D⁻¹ A) T."""
    damped = matrix.copy()
    damped.data *= np.repeat(-4 / 3 / radius * inverse, np.diff(matrix.indptr))
    return (tentative + damped @ tentative).tocsr()


def jacobi_radius(matrix, inverse, on=None, steps: int = 8) -> float:
    """Spectral radius of D⁻¹A, of the points that are on, by the power method.

    A few per cent too small.
    """
    v = np.zeros(matrix.shape[0])
    rows = slice(None) if on is None else np.flatnonzero(np.asarray(on))
    v[rows] = np.random.default_rng(0).normal(size=v[rows].size)
    for _ in range(steps):
        v = inverse * (matrix @ v)
        size = np.sqrt(np.sum(v * v))
        v /= size
    return float(size)


def chebyshev(radius, degree: int = 2) -> tuple:
    """Step sizes at the roots of the Chebyshev polynomial on the upper part of the spectrum."""
    low, high = _SMOOTHED * radius, 1.1 * radius
    roots = np.cos(np.pi * (np.arange(degree) + 0.5) / degree)
    return tuple(1 / ((low + high) / 2 + (high - low) / 2 * roots))


def _inverse(matrix, constant) -> np.ndarray:
    """Dense inverse; on the complement of the constants where these are in the null space."""
    dense = matrix.toarray()
    if constant is None:
        return np.linalg.inv(dense)
    border = constant[:, None] * np.abs(dense).max() / np.linalg.norm(constant)
    bordered = np.block([[dense, border], [border.T, np.zeros((1, 1))]])
    return np.linalg.inv(bordered)[:-1, :-1]
