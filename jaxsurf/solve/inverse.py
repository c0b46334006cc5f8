r"""The inverse of a shifted sparse matrix, on the host: factorised, or by multigrid."""

from __future__ import annotations

import numpy as np
import scipy.sparse
from jaxtyping import Float
from scipy.sparse.linalg import splu


class Inverse:
    r"""$(M - \sigma)^{-1}$ for a real matrix M and a shift σ left of its spectrum.

    The pattern of a stencil's matrix is nearly symmetric and its diagonal large, so the
    factors are ordered by minimum degree, on one side only.
    """

    def __init__(self, matrix: scipy.sparse.csr_matrix, *, shift: float):
        self.shift = shift
        n = matrix.shape[0]
        shifted = (matrix - shift * scipy.sparse.eye_array(n)).tocsc()
        self._factors = splu(
            shifted,
            permc_spec="MMD_AT_PLUS_A",
            diag_pivot_thresh=0.01,
            options={"SymmetricMode": True},
        )
        self._trans = "N"

    def __call__(self, x: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
        if np.iscomplexobj(x):
            return self(x.real) + 1j * self(x.imag)
        return self._factors.solve(np.ascontiguousarray(x), self._trans)

    def transpose(self) -> Inverse:
        """The inverse of the transposed matrix, from the same factors."""
        other = object.__new__(Inverse)
        other.shift, other._factors = self.shift, self._factors
        other._trans = "T" if self._trans == "N" else "N"
        return other
