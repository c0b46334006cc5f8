"""Set-up of smoothed aggregation on the host: aggregates, prolongation, what smoothing needs."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import scipy.sparse
from jaxtyping import Array

from ..compiling import namespace
from ..stencils.padded import PaddedMatrix

# Room on the next level: one unknown for so many; a tenth to a twentieth are used as a rule.
_COARSENING = 8
# A connection counts as strong from this share of the geometric mean of both diagonal entries.
_STRENGTH = 0.05
# Share of the points that may be left without strong connections.
_ALONE = 0.2
# The smoother damps the part of the spectrum from this share of its end upwards.
_SMOOTHED = 0.25


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
    # Rows of points that are switched off have none at all.
    connected = abs(matrix).sum(axis=1).ravel() > abs(matrix.diagonal())
    # Of very many neighbours none is strong beside the centre: then what is strong is weaker.
    for theta in _STRENGTH / 2.0 ** np.arange(8):
        strong = symmetric_strength_of_connection(matrix, theta=theta)
        aggregates = standard_aggregation(strong)[0]
        alone = connected & (np.diff(aggregates.indptr) == 0)
        if np.sum(alone) <= _ALONE * np.sum(connected):
            break
    if aggregates.shape[1] == 0 or aggregates.shape[1] > 0.8 * matrix.shape[0]:
        return None
    tentative, coarse = fit_candidates(aggregates, constant[:, None])
    return scipy.sparse.csr_matrix(tentative), coarse[:, 0]


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
    """What Jacobi's steps divide by."""
    diagonal = matrix.diagonal()
    return stretched(diagonal, abs(matrix) @ np.full(len(diagonal), 0.5))


def stretched(diagonal, half):
    """Diagonals with the modulus of half the sum of a row's moduli, if that is more.

    At points with a small diagonal (few, badly placed neighbours) plain Jacobi steps would
    diverge. Half the sum, the diagonal where weights are of one sign, keeps the row sums of D⁻¹A
    below 2.
    """
    xp = namespace(diagonal)
    return xp.sign(diagonal) * xp.maximum(xp.abs(diagonal), half)


def smoothed(matrix, tentative, inverse, radius) -> scipy.sparse.csr_matrix:
    """Prolongation after a step of Jacobi's, (I - w D⁻¹ A) T."""
    damped = matrix.copy()
    damped.data *= np.repeat(damped_step(inverse, radius), np.diff(matrix.indptr))
    return (tentative + damped @ tentative).tocsr()


def damped_step(inverse, radius):
    """-w D⁻¹."""
    return -4 / 3 / radius * inverse


def jacobi_radius(matrix, inverse, on=None, steps: int = 8) -> float:
    """Spectral radius of D⁻¹A, of the points that are on, by the power method.

    A few per cent too small.
    """
    v = np.zeros(matrix.shape[0])
    rows = slice(None) if on is None else np.flatnonzero(np.asarray(on))
    v[rows] = noise(np.arange(v[rows].size))
    for _ in range(steps):
        v = inverse * (matrix @ v)
        size = np.sqrt(np.sum(v * v))
        v /= size
    return float(size)


def noise(i):
    """Numbers that look random, of integers: the same on host and device."""
    xp = namespace(i)
    i = i.astype(xp.uint32)
    return (i * i * xp.uint32(2654435769)).astype(xp.float32) / 2**32 - 0.5


def chebyshev(radius, degree: int = 2) -> tuple:
    """Step sizes at the roots of the Chebyshev polynomial on the upper part of the spectrum."""
    low, high = _SMOOTHED * radius, 1.1 * radius
    roots = np.cos(np.pi * (np.arange(degree) + 0.5) / degree)
    return tuple(1 / ((low + high) / 2 + (high - low) / 2 * roots))


def dense_inverse(dense, used, constant):
    """Dense inverse; on the complement of the constants where these are in the null space.

    Rows that are not used are zero.
    """
    xp, room, size = namespace(dense), len(dense), abs(dense).max()
    whole = dense + xp.diag(xp.where(used, 0, size))
    if constant is not None:
        border = constant[:, None] * size / xp.linalg.norm(constant)
        whole = xp.block([[whole, border], [border.T, xp.zeros((1, 1), dense.dtype)]])
    return xp.where(used, xp.linalg.inv(whole)[:room, :room], 0)
