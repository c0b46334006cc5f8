r"""Multigrid for $1 - g A$ with any g, as implicit steps of changing length need it."""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import scipy.sparse
from jaxtyping import Array, ArrayLike, Float

from ..boundary import Closure
from ..stencils.algebra import AbstractOperator, check_scalar
from ..stencils.padded import PaddedMatrix
from ..stencils.stencil import Stencil
from .precondition import (
    USED,
    Level,
    Multigrid,
    aggregate,
    chebyshev,
    divisor,
    filled,
    jacobi_radius,
    room_for,
    smoothed,
    transfers,
)
from .reduced import free_matrix

# The coarsest system has at most this many unknowns; its inverse is computed for every g.
_COARSEST = 100


class _Pair(eqx.Module):
    """A level of the identity M and of A, with one layout.

    Args:
        mass, stiff: M and A.
        mass_turned, stiff_turned: their transposes.
        mass_diagonal, stiff_diagonal: what to divide by; safe for rows of both signs.
        restrict, prolong: to and from the next coarser level.
        radius: of either after division by its diagonal, the larger.
    """

    mass: PaddedMatrix
    stiff: PaddedMatrix
    mass_turned: PaddedMatrix
    stiff_turned: PaddedMatrix
    mass_diagonal: Float[Array, " m"]
    stiff_diagonal: Float[Array, " m"]
    restrict: PaddedMatrix
    prolong: PaddedMatrix
    radius: Float[Array, ""]

    def at(self, g) -> Level:
        inverse = 1 / (self.mass_diagonal - g * self.stiff_diagonal)
        return Level(
            self.mass.minus(g, self.stiff),
            self.mass_turned.minus(g, self.stiff_turned),
            inverse,
            self.restrict,
            self.prolong,
            # Its roots are of double precision, the cycle is not.
            tuple(x.astype(self.radius.dtype) for x in chebyshev(self.radius)),
        )


class ShiftedMultigrid(eqx.Module):
    """Multigrid hierarchies for all $1 - g A$, g ≥ 0: made by `shifted_multigrid`.

    Args:
        pairs: levels, from fine to coarse.
        mass, stiff: the coarsest level, dense.
    """

    pairs: tuple[_Pair, ...]
    mass: Float[Array, "m m"]
    stiff: Float[Array, "m m"]

    def at(self, g: ArrayLike) -> Multigrid:
        """The V-cycle for one g, which may be traced."""
        g = jnp.asarray(g).astype(self.mass.dtype)
        levels = tuple(pair.at(g) for pair in self.pairs)
        return Multigrid(False, levels, jnp.linalg.inv(self.mass - g * self.stiff))


def shifted_multigrid(
    operator: AbstractOperator, *, conditions: Closure | None = None
) -> ShiftedMultigrid:
    r"""Set up smoothed aggregation for $1 - g A$ once, for all g ≥ 0.

    The aggregates and the prolongation are those of A. On every level M, the identity restricted,
    and A restricted are kept apart, so that $M - g A$ is a sum of two arrays.

    Args:
        operator: A, scalar, with concrete arrays and eigenvalues of real part ≤ 0.
        conditions: from `js.close` or `js.with_ghosts`.

    Returns:
        Whose `at(g)` is a preconditioner.

    Raises:
        ImportError: pyamg is not installed (extra `multigrid`).
        ValueError: an operator that is traced, not finite, or has components.
    """
    check_scalar(operator)
    stiff = free_matrix(operator, conditions)
    mass = scipy.sparse.identity(stiff.shape[0], stiff.dtype, format="csr")
    constant = np.ones(stiff.shape[0])
    width = USED * operator.k if isinstance(operator, Stencil) else None
    room, on = stiff.shape[0], operator.active
    pairs = []
    while room > _COARSEST:
        found = aggregate(stiff, constant)
        if found is None:
            break
        tentative, constant = found
        coarse = room_for(tentative.shape[1], room)
        pair, mass, stiff = _pair(mass, stiff, tentative, room, coarse, width, on)
        pairs.append(pair)
        room, width, on = coarse, None, None
    # The unknowns that fill it up have the equation x = 0.
    mass, stiff = _dense(mass, room, 1), _dense(stiff, room, 0)
    return ShiftedMultigrid(tuple(pairs), jnp.asarray(mass), jnp.asarray(stiff))


def _dense(matrix, room: int, diagonal: float) -> np.ndarray:
    dense = np.diag(np.full(room, diagonal, np.float32))
    size = matrix.shape[0]
    dense[:size, :size] = matrix.toarray()
    return dense


def _pair(mass, stiff, tentative, room: int, coarse: int, width, on):
    """A level, and M and A on the next one."""
    below, beside = divisor(stiff), divisor(mass)
    inverse = np.divide(1, below, out=np.zeros_like(below), where=below != 0)
    radius = jacobi_radius(stiff, inverse, on)
    prolong = smoothed(stiff, tentative, inverse, radius)
    restrict = prolong.T.tocsr()
    # In one complex matrix both get one layout.
    both = (mass + 1j * stiff).tocsr()
    single = np.dtype(np.float32)
    pad = lambda a: PaddedMatrix.from_scipy(a.tocsr(), single, rows=room, width=width)
    turned = both.T.tocsr()
    padded = pad(both.real)
    pair = _Pair(
        padded,
        pad(both.imag),
        pad(turned.real),
        pad(turned.imag),
        filled(beside.astype(single), room, 1),
        filled(below.astype(single), room),
        *transfers(padded, restrict, prolong, coarse),
        jnp.asarray(max(radius, jacobi_radius(mass, 1 / beside)), single),
    )
    return pair, (restrict @ (mass @ prolong)).tocsr(), (restrict @ (stiff @ prolong)).tocsr()
