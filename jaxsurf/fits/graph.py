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

    def by_degree(self) -> Expansion:
        """Its coefficients and those of its slopes, degree by degree."""
        last = [polynomial_count(self.dim, g) for g in range(self.degree + 1)]
        heights = jnp.split(self.coefficients, [count - 1 for count in last[1:-1]])
        parts = [slice(start, stop) for start, stop in zip([0, *last], last[:-1])]
        matrices = differentiation(self.dim, self.degree)[:, :, 1:]
        slopes = [
            [_places(matrix[part], self.coefficients) for part in parts] for matrix in matrices
        ]
        return Expansion(heights, slopes, self.degree)


class Expansion(eqx.Module):
    """A graph with all that it takes to evaluate it, by degree.

    Args:
        heights: coefficients of degree 1 to `degree`.
        slopes: those of the derivatives along each axis, of degree 0 to `degree` - 1.
    """

    heights: list[Float[Array, "_ *p"]]
    slopes: list[list[Float[Array, "_ *p"]]]
    degree: int = eqx.field(static=True)

    @property
    def dim(self) -> int:
        """Of the tangent plane."""
        return len(self.slopes)

    def at(self, q):
        """Heights and slopes."""
        rows = monomials_by_degree(q, self.degree)
        slopes = jnp.stack([polynomial(c, rows) for c in self.slopes])
        return polynomial(self.heights, rows[1:]), slopes


def polynomial(coefficients: list[Array], rows: list[Array]) -> Array:
    """Sum over all degrees, kept apart: to put slices together again takes longer than all else."""
    shaped = lambda c, row: c.reshape(len(c), *(1,) * (row.ndim - c.ndim), *c.shape[1:])
    parts = [jnp.sum(shaped(c, row) * row, axis=0) for c, row in zip(coefficients, rows)]
    return functools.reduce(jnp.add, parts)


def _places(matrix: np.ndarray, a):
    """A matrix with one entry in a row times a vector over the basis."""
    power = matrix.max(axis=1).reshape(-1, *(1,) * (a.ndim - 1)).astype(a.dtype)
    return a[matrix.argmax(axis=1)] * power
