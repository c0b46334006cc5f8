"""Surfaces as polynomials over their tangent planes."""

from __future__ import annotations

import equinox as eqx
from jaxtyping import Array, Float

from . import systems
from .monomials import differentiation, multi_indices, polynomial_count
from .plane import Neighborhood, TangentPlane
from .sums import spread


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

    def repeated(self, size: int) -> list[Float[Array, "r *p"]]:
        """The coefficients one by one, each so many times along a new axis."""
        return spread(systems.entries(self.coefficients), 0, size)

    def by_degree(self, coefficients, rows):
        """What each degree adds to the height and to the slopes where monomials have values."""
        degrees = multi_indices(self.dim, 0, self.degree).sum(axis=1).tolist()
        lower = polynomial_count(self.dim, self.degree - 1)
        matrices = differentiation(self.dim, self.degree)[:, :lower, 1:]
        slopes = [_grouped(systems.transform(d, coefficients), rows, degrees) for d in matrices]
        return _grouped(coefficients, rows[1:], degrees[1:]), slopes


def _grouped(coefficients, rows, degrees: list[int]) -> list[Array]:
    """Sums of terms, one for each degree."""
    found: dict[int, Array] = {}
    for c, row, degree in zip(coefficients, rows, degrees):
        found[degree] = found[degree] + c * row if degree in found else c * row
    return list(found.values())
