r"""Invariant subspaces of a sparse matrix near zero, on the host, with NumPy and SciPy."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import scipy.linalg
import scipy.sparse
from jaxtyping import Complex, Float, Int
from scipy.sparse.linalg import ArpackNoConvergence, LinearOperator, eigs, gmres

from ..failures import raise_at
from .inverse import Inverse

# Up to this size all eigenvalues of the full matrix are computed.
_DENSE = 300
# Residual at which modes count as found, relative to the eigenvalue.
_CONVERGED = 1e-7


class Subspace(NamedTuple):
    r"""Right and left invariant subspaces of a matrix M for its K lowest eigenvalues, in groups.

    $M V = V B$, $W^T M = B W^T$, $W^T V = 1$, with B zero between groups. Columns of groups that
    are not complete are zero, and each is numbered as a group of its own, from K on.

    Args:
        values: real parts of the eigenvalues, ascending.
        imaginary: sizes of their imaginary parts.
        groups: number of the group of each, ascending.
        right: V, an orthonormal basis of every group but for a factor: mean square one.
        left: W; zero if it was not asked for.
        block: B.
        mix: right eigenvectors of B.
        unmix: its inverse.
        scale: a typical eigenvalue.
    """

    values: Float[Any, " K"]
    imaginary: Float[Any, " K"]
    groups: Int[Any, " K"]
    right: Float[Any, "n K"]
    left: Float[Any, "n K"]
    block: Float[Any, "K K"]
    mix: Complex[Any, "K K"]
    unmix: Complex[Any, "K K"]
    scale: Float[Any, ""]


def subspace(
    matrix: scipy.sparse.csr_matrix,
    reference: Float[np.ndarray, "n K"],
    k: int,
    degenerate: float,
    *,
    left: bool,
) -> Subspace:
    """The lowest K modes of a matrix whose spectrum lies to the right of zero.

    Args:
        matrix: `(n, n)`.
        reference: fixes the basis of a group (see `orthonormal`); its width is K.
        k: how many have to be in complete groups.
        degenerate: relative distance of neighbours in a group.
        left: whether left vectors are needed.
    """
    n, count = reference.shape
    bad = ~np.isfinite(matrix.data)
    raise_at(bad, "row {i} of the operator is not finite", points=matrix.tocoo().row)
    inverse = Inverse(matrix, shift=-_scale(matrix))
    eigenvalues, vectors = _lowest(matrix, count, inverse)
    groups = _groups(eigenvalues, degenerate, inverse.shift)
    if count < n:  # the next one might belong to the last group
        groups[groups == groups[-1]] = count
    if groups[k - 1] == count:
        first = int(np.argmax(groups == count))
        raise ValueError(
            f"the group of value {k} (counted from one) began at value {first + 1} and has not "
            f"ended at value {count}: ask for fewer or more modes, or lower degenerate = "
            f"{degenerate:g}"
        )
    complete = int(np.sum(groups < count))
    right = np.zeros((n, count))
    for group in _members(groups[:complete]):
        span = _real_basis(vectors[:, group])
        right[:, group] = orthonormal(span, reference[:, group])
    v = right[:, :complete]
    block, mix = np.zeros((count, count)), np.eye(count, dtype=complex)
    same = groups[:complete, None] == groups[:complete]
    action = matrix @ v
    block[:complete, :complete] = np.where(same, v.T @ action / n, 0)
    _check(action - v @ block[:complete, :complete], eigenvalues[:complete], inverse.shift)
    for group in _members(groups[:complete]):
        at = np.ix_(group, group)
        eigenvalues[group], mix[at] = _sorted_eigen(block[at])

    other = np.zeros((n, count))
    if left:
        found = _lowest(matrix.T.tocsr(), count, inverse.transpose())[1]
        other[:, :complete] = _biorthonormal(found[:, :complete], v)
        inner = np.where(same, other[:, :complete].T @ action, 0)
        block[:complete, :complete] = inner
    groups[complete:] = np.arange(complete, count) - complete + count
    return Subspace(
        eigenvalues.real,
        np.abs(eigenvalues.imag),
        groups,
        right,
        other,
        block,
        mix,
        np.linalg.inv(mix),
        np.asarray(np.abs(eigenvalues[:k]).mean() + abs(inverse.shift)),
    )


def orthonormal(
    span: Float[np.ndarray, "n m"], reference: Float[np.ndarray, "n m"]
) -> Float[np.ndarray, "n m"]:
    """An orthonormal basis of a space, of mean square one, that depends on the space alone.

    The reference fields are projected on the space and then orthogonalised in their order.
    """
    projected = span @ (span.T @ reference)
    q, r = np.linalg.qr(projected)
    return q * np.sign(np.diag(r)) * np.sqrt(len(span))


def sylvester(
    matrix: scipy.sparse.csr_matrix,
    space: Subspace,
    rhs: Float[np.ndarray, "n K"],
    *,
    rtol: float = 1e-12,
) -> Float[np.ndarray, "n K"]:
    r"""Solve $M X - X B + s V (W^T X)_{\text{group}} = R$.

    In the space V this is a small system. On the complement, with $T = (M - \sigma)^{-1}$, every
    column is $(1 - (\mu - \sigma) T) x = T r$: well conditioned, as the eigenvalues of M
    there are larger than $\mu$.
    """
    v, w = space.right, space.left
    mix, unmix, groups = space.mix, space.unmix, space.groups
    mu = np.diag(unmix @ space.block @ mix)
    same = groups[:, None] == groups
    known = w.T @ rhs
    # Columns without a right-hand side have no solution to be looked for.
    needed = np.any(rhs != 0, axis=0)
    outside = (rhs - v @ known) @ mix
    known = unmix @ known @ mix
    between = mu[:, None] - mu + np.where(same, space.scale, 0)
    complete = np.any(v != 0, axis=0)
    inside = np.where(complete[:, None] & complete, known / np.where(between == 0, 1, between), 0)
    solution = (v @ mix).astype(complex) @ inside

    inverse = Inverse(matrix, shift=-_scale(matrix))
    for j in np.flatnonzero(np.any(same[:, needed], axis=1)):
        column = outside[:, j]
        if not np.any(column):
            continue
        real = abs(mu[j].imag) == 0 and not np.any(column.imag)
        m, b = (mu[j].real, column.real) if real else (mu[j], column)
        solution[:, j] += _complement(inverse, m, b, v, w, rtol)
    return np.real(solution @ unmix)


def _complement(inverse, mu, rhs, v, w, rtol):
    def clean(x):
        return x - v @ (w.T @ x)

    def apply(x):
        return x - (mu - inverse.shift) * clean(inverse(x))

    start = clean(inverse(rhs))
    operator = LinearOperator((len(rhs), len(rhs)), apply, dtype=start.dtype)
    found, _ = gmres(operator, start, rtol=rtol, atol=0.0, restart=80, maxiter=5)
    reached = np.linalg.norm(apply(found) - start) / np.linalg.norm(start)
    if not reached < 1e3 * rtol:
        raise RuntimeError(
            f"the derivative of a mode has been found to a relative residual of {reached:.1e} "
            f"only, {rtol:.0e} is needed: are there more values close to {np.real(mu):g}?"
        )
    return clean(found)


def _scale(matrix) -> float:
    """About the distance of eigenvalues: the diagonal is as 1 / h², and n h² as the area."""
    return float(np.abs(matrix.diagonal()).mean() / matrix.shape[0])


def _lowest(matrix, count: int, inverse: Inverse):
    """Eigenvalues next to the shift and their vectors, by ascending real part, pairs together."""
    n = matrix.shape[0]
    if n <= _DENSE or count > n // 3:
        values, vectors = np.linalg.eig(matrix.toarray())
        nearest = np.argsort(np.abs(values - inverse.shift), kind="stable")[:count]
        values, vectors = values[nearest], vectors[:, nearest]
    else:
        start = np.random.default_rng(0).normal(size=n)
        operator = LinearOperator((n, n), inverse, dtype=float)
        try:
            values, vectors = eigs(matrix, count, sigma=inverse.shift, OPinv=operator, v0=start)
        except ArpackNoConvergence as error:
            found = len(error.eigenvalues)
            raise RuntimeError(f"{found} of {count} modes have converged") from error
    order = np.lexsort((np.abs(values.imag), values.real))
    return values[order].astype(complex), vectors[:, order]


def _groups(values, degenerate: float, shift: float) -> Int[np.ndarray, " K"]:
    size = np.maximum(np.abs(values[1:]), abs(shift))
    pair = (values.imag[1:] == -values.imag[:-1]) & (values.imag[1:] != 0)
    apart = (values.real[1:] - values.real[:-1] > degenerate * size) & ~pair
    return np.concatenate([[0], np.cumsum(apart)])


def _members(groups) -> list[Int[np.ndarray, " m"]]:
    return np.split(np.arange(len(groups)), np.flatnonzero(np.diff(groups)) + 1)


def _real_basis(vectors):
    """Orthonormal real basis of a space given by real vectors and conjugate pairs."""
    parts = np.concatenate([vectors.real, vectors.imag], axis=1)
    return scipy.linalg.svd(parts, full_matrices=False)[0][:, : vectors.shape[1]]


def _sorted_eigen(block):
    values, vectors = np.linalg.eig(block)
    order = np.argsort(values.real, kind="stable")
    return values[order], vectors[:, order]


def _biorthonormal(left, right):
    """Basis W of the space of left vectors with $W^T V = 1$."""
    left = _real_basis(left)
    return left @ np.linalg.inv(right.T @ left)


def _check(residual, values, shift) -> None:
    n = len(residual)
    size = np.maximum(np.abs(values), abs(shift))
    reached = np.linalg.norm(residual, axis=0) / np.sqrt(n) / size
    if reached.max() > _CONVERGED:
        i = int(reached.argmax())
        raise RuntimeError(
            f"mode {i} has a relative residual of {reached[i]:.1e}, {_CONVERGED:.0e} is needed"
        )
