r"""The inverse of a shifted sparse matrix, on the host: factorised, or by multigrid."""

from __future__ import annotations

import numpy as np
import scipy.sparse
from jaxtyping import Float
from scipy.sparse.linalg import bicgstab, splu

# Beyond this size the factors of a fourth-order stencil no longer pay.
_FACTORISED = 20_000


class Inverse:
    r"""$(M - \sigma)^{-1}$ for a real matrix M and a shift σ left of its spectrum.

    Small matrices are factorised: the pattern of a stencil's matrix is nearly symmetric and its
    diagonal large, so an ordering by minimum degree serves rows and columns. For large ones
    it is BiCGStab, preconditioned by smoothed aggregation.

    Args:
        matrix: `(n, n)`.
        shift: σ.
        rtol: relative residual of the iteration.
    """

    def __init__(self, matrix: scipy.sparse.csr_matrix, *, shift: float, rtol: float = 1e-12):
        n = matrix.shape[0]
        self.shift, self._rtol = shift, rtol
        self._matrix = (matrix - shift * scipy.sparse.eye_array(n)).tocsr()
        self._factors, self._multigrid, self._trans = None, None, "N"
        if n <= _FACTORISED:
            self._factors = splu(
                self._matrix.tocsc(),
                permc_spec="MMD_AT_PLUS_A",
                diag_pivot_thresh=0.01,
                options={"SymmetricMode": True},
            )
        else:
            self._multigrid = _multigrid(self._matrix)

    def __call__(self, x: np.ndarray) -> np.ndarray:
        """Solve for one real or complex right-hand side, `(n,)`."""
        if np.iscomplexobj(x):
            return self(x.real) + 1j * self(x.imag)
        if self._factors is not None:
            return self._factors.solve(np.ascontiguousarray(x), self._trans)
        return self._iterate(x)

    def transpose(self) -> Inverse:
        """The inverse of the transposed matrix; factors are used again."""
        other = object.__new__(Inverse)
        other.shift, other._rtol = self.shift, self._rtol
        other._matrix, other._factors = self._matrix.T.tocsr(), self._factors
        other._trans = "T" if self._trans == "N" else "N"
        other._multigrid = None if self._factors is not None else _multigrid(other._matrix)
        return other

    def _iterate(self, b: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
        if not b.any():  # one part of a complex right-hand side
            return np.zeros_like(b)
        x, _ = bicgstab(self._matrix, b, rtol=self._rtol, M=self._multigrid, maxiter=300)
        reached = np.linalg.norm(self._matrix @ x - b) / np.linalg.norm(b)
        if not reached < 100 * self._rtol:
            raise RuntimeError(
                f"the shifted system of {len(b)} points has been solved to a relative residual of "
                f"{reached:.1e} only, {self._rtol:.0e} is needed"
            )
        return x


def _multigrid(matrix):
    try:
        import pyamg
    except ImportError as error:
        raise ImportError(
            f"modes of more than {_FACTORISED:,} points need the package pyamg: "
            "pip install 'jaxsurf[multigrid]'"
        ) from error
    # Strength 0.08: half the steps of the default on stencils of second and fourth order.
    return pyamg.smoothed_aggregation_solver(
        matrix,
        symmetry="nonsymmetric",
        strength=("symmetric", {"theta": 0.08}),
        improve_candidates=None,
    ).aspreconditioner()
