"""Surfaces as polynomials over their tangent planes."""

from __future__ import annotations

import functools

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .monomials import differentiation, monomials_by_degree, polynomial_count
from .plane import Neighborhood, TangentPlane


class Graph(eqx.Module):
    """The surface as a polynomial over the tangent plane.

    Args:
        coefficients: of degree 1 to `degree`.
    """

    coefficients: Float[Array, "m *p"]
    degree: int = eqx.field(static=True)
    dim: int = eqx.field(static=True)

    @classmethod
    def of(cls, around: Neighborhood, degree: int) -> tuple[TangentPlane, Graph]:
        """The tangent plane of a neighbourhood, and the surface over it."""
        plane = TangentPlane.of(around, degree)
        return plane, cls(plane.surface(1, degree)[0], degree, len(plane.points))

    @property
    def slopes(self) -> list[list[Array]]:
        """Coefficients of the derivatives along the axes, by degree from 0 to `degree` - 1."""
        matrices = differentiation(self.dim, self.degree)[:, :, 1:]
        return [
            [_places(matrix[part], self.coefficients) for part in self.parts[:-1]]
            for matrix in matrices
        ]

    @property
    def parts(self) -> list[slice]:
        """Which of all monomials are of each degree."""
        last = [polynomial_count(self.dim, g) for g in range(self.degree + 1)]
        return [slice(start, stop) for start, stop in zip([0, *last], last)]

    def at(self, q):
        """Heights and slopes."""
        rows = monomials_by_degree(q, self.degree)
        own = [self.coefficients[part.start - 1 : part.stop - 1] for part in self.parts[1:]]
        slopes = jnp.stack([polynomial(c, rows) for c in self.slopes])
        return polynomial(own, rows[1:]), slopes


def polynomial(coefficients: list[Array], rows: list[Array]) -> Array:
    """Sum over all degrees, kept apart: to put slices together again takes longer than all else."""
    parts = [jnp.sum(c[:, None] * row, axis=0) for c, row in zip(coefficients, rows)]
    return functools.reduce(jnp.add, parts)


def _places(matrix: np.ndarray, a):
    """A matrix with one entry in a row times a vector over the basis."""
    power = matrix.max(axis=1).reshape(-1, *(1,) * (a.ndim - 1)).astype(a.dtype)
    return a[matrix.argmax(axis=1)] * power
