r"""Multigrid for $1 - g A$ with any g, as implicit steps of changing length need it."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import scipy.sparse
from jaxtyping import Array, ArrayLike, Float

from ..boundary import Closure
from ..compiling import sized_jit
from ..stencils.algebra import AbstractOperator
from ..stencils.padded import PaddedMatrix
from ..stencils.stencil import Stencil
from . import aggregation, renewal
from .precondition import USED, Level, VCycle
from .reduced import check_kinds, free_matrix, free_operator

# The coarsest system has at most this many unknowns; its inverse is computed for every g.
_COARSEST = 100


class _Pair(eqx.Module):
    """A level of the identity M and of A, with one layout.

    Args:
        mass, stiff: M and A; M is None on the finest level of a renewed hierarchy.
        mass_transposed, stiff_transposed: their transposes; None there.
        mass_diagonal, stiff_diagonal: what to divide by; safe for rows of both signs.
        restrict, prolong: to and from the next coarser level.
        radius: of either after division by its diagonal, the larger.
    """

    mass: PaddedMatrix | None
    stiff: Any
    mass_transposed: PaddedMatrix | None
    stiff_transposed: Any
    mass_diagonal: Float[Array, " m"]
    stiff_diagonal: Float[Array, " m"]
    restrict: PaddedMatrix
    prolong: PaddedMatrix
    radius: Float[Array, ""]

    @property
    def patterns(self) -> tuple[PaddedMatrix, PaddedMatrix]:
        """Both matrices added in modulus, and the transpose of that."""
        both = (self.mass, self.stiff), (self.mass_transposed, self.stiff_transposed)
        return tuple(renewal.moduli(mass).minus(-1, renewal.moduli(stiff)) for mass, stiff in both)

    def at(self, g) -> Level:
        inverse = 1 / (self.mass_diagonal - g * self.stiff_diagonal)
        if self.mass is None or self.mass_transposed is None:
            matrix, transposed = 1 - g * self.stiff, None
        else:
            matrix = self.mass.minus(g, self.stiff)
            transposed = self.mass_transposed.minus(g, self.stiff_transposed)
        return Level(
            matrix,
            transposed,
            inverse,
            self.restrict,
            self.prolong,
            # Its roots are of double precision, the cycle is not.
            tuple(x.astype(self.radius.dtype) for x in aggregation.chebyshev(self.radius)),
        )


class ShiftedMultigrid(eqx.Module):
    """Multigrid hierarchies for all $1 - g A$, g ≥ 0: made by `shifted_multigrid`.

    Args:
        pairs: levels, from fine to coarse.
        mass, stiff: the coarsest level, dense.
        plan: what `renewed` needs of each level.
    """

    pairs: tuple[_Pair, ...]
    mass: Float[Array, "m m"]
    stiff: Float[Array, "m m"]
    plan: tuple[renewal.Coarsening, ...] | None = None

    def at(self, g: ArrayLike) -> VCycle:
        """The V-cycle for one g, which may be traced."""
        g = jnp.asarray(g).astype(self.mass.dtype)
        levels = tuple(pair.at(g) for pair in self.pairs)
        return VCycle(False, levels, jnp.linalg.inv(self.mass - g * self.stiff))

    def renewed(
        self, operator: AbstractOperator, *, closure: Closure | None = None
    ) -> ShiftedMultigrid:
        """The hierarchies of another operator on the same points, as `VCycle.renewed`."""
        n = len(self.pairs[0].stiff_diagonal if self.pairs else self.stiff)
        return _renewed(*renewal.check_renewal(self.plan, n, operator, closure))


def shifted_multigrid(
    operator: AbstractOperator, *, closure: Closure | None = None, renewable: bool = False
) -> ShiftedMultigrid:
    r"""Set up smoothed aggregation for $1 - g A$ once, for all g ≥ 0.

    The aggregates and the prolongation are those of A. On every level M, the identity restricted,
    and A restricted are kept apart, so that $M - g A$ is a sum of two arrays.

    Args:
        operator: A, scalar, with concrete arrays and eigenvalues of real part ≤ 0.
        closure: from `js.eliminate` or `js.with_ghosts`.
        renewable: keep what `ShiftedMultigrid.renewed` needs.

    Returns:
        Whose `at(g)` is a preconditioner.

    Raises:
        ImportError: pyamg is not installed (extra `multigrid`).
        ValueError: an operator that is traced, not finite, or has components.
    """
    check_kinds(operator, closure)
    stiff = free_matrix(operator, closure)
    mass = scipy.sparse.identity(stiff.shape[0], stiff.dtype, format="csr")
    constant = np.ones(stiff.shape[0])
    width = USED * operator.k if isinstance(operator, Stencil) else None
    room, on = stiff.shape[0], operator.active
    pairs, made = [], []
    while room > _COARSEST:
        found = aggregation.aggregate(stiff, constant)
        if found is None:
            break
        tentative, constant = found
        coarse = aggregation.room_for(tentative.shape[1], room)
        pair, prolong, mass, stiff = _pair(mass, stiff, tentative, room, coarse, width, on)
        pairs.append(pair)
        made.append((tentative, prolong, abs(mass) + abs(stiff), pair))
        room, width, on = coarse, None, None
    # The unknowns that fill it up have the equation x = 0.
    mass, stiff = _dense(mass, room, 1), _dense(stiff, room, 0)
    plan = None
    if renewable:
        plan = renewal.plan_of(made, [pair.patterns for pair in pairs])
    return ShiftedMultigrid(tuple(pairs), jnp.asarray(mass), jnp.asarray(stiff), plan)


def _dense(matrix, room: int, diagonal: float) -> np.ndarray:
    dense = np.diag(np.full(room, diagonal, np.float32))
    size = matrix.shape[0]
    dense[:size, :size] = matrix.toarray()
    return dense


def _pair(mass, stiff, tentative, room: int, coarse: int, width, on):
    """A level, and M and A on the next one."""
    below, beside = aggregation.divisor(stiff), aggregation.divisor(mass)
    inverse = np.divide(1, below, out=np.zeros_like(below), where=below != 0)
    radius = aggregation.jacobi_radius(stiff, inverse, on)
    prolong = aggregation.smoothed(stiff, tentative, inverse, radius)
    restrict = prolong.T.tocsr()
    # In one complex matrix both get one layout.
    both = (mass + 1j * stiff).tocsr()
    single = np.dtype(np.float32)
    pad = lambda a: PaddedMatrix.from_scipy(a.tocsr(), single, rows=room, width=width)
    transposed = both.T.tocsr()
    padded = pad(both.real)
    pair = _Pair(
        padded,
        pad(both.imag),
        pad(transposed.real),
        pad(transposed.imag),
        aggregation.filled(beside.astype(single), room, 1),
        aggregation.filled(below.astype(single), room),
        *aggregation.transfers(padded, restrict, prolong, coarse),
        jnp.asarray(max(radius, aggregation.jacobi_radius(mass, 1 / beside)), single),
    )
    coarser = ((restrict @ (a @ prolong)).tocsr() for a in (mass, stiff))
    return pair, prolong, *coarser


@sized_jit
def _renewed(plan, operator, closure) -> ShiftedMultigrid:
    stiff, restriction = free_operator(operator, closure)
    below, free = renewal.free_divisor(operator, stiff, restriction)
    matrices = stiff, lambda x: x
    found, (stiff, mass), _ = renewal.renewed_levels(plan, matrices, below, free, operator.active)
    pairs = []
    for depth, v in enumerate(found):
        (A, M), (A_T, M_T) = v.matrices, v.transposed
        beside, radius = jnp.ones_like(v.divisor), jnp.ones(())
        if depth == 0:
            M = None
        else:
            size = renewal.divisor_of(M)
            radius = renewal.radius_of(M, renewal.inverted(size), size != 0)
            beside = jnp.where(size == 0, 1, size)
        radius = jnp.maximum(v.radius, radius)
        pairs.append(_Pair(M, A, M_T, A_T, beside, v.divisor, v.restrict, v.prolong, radius))
    # The unknowns that fill it up have the equation x = 0.
    mass = mass + jnp.diag(jnp.where(jnp.diagonal(mass) == 0, 1, 0))
    return renewal.narrowed(ShiftedMultigrid(tuple(pairs), mass, stiff), np.dtype(np.float32))
