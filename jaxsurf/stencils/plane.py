"""Polynomial fits over tangent planes: what they see of a neighbourhood, and with which weights."""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..frames import tangent_frames
from .kernels import gaussian
from .method import Neighborhood, dot
from .moments import polynomial_fit
from .monomials import polynomial_count
from .targets import AbstractTarget


class TangentPlane(eqx.Module):
    """A neighbourhood seen from the tangent plane of its centre, in units of the kernel.

    Args:
        tangents: orthonormal directions of the plane.
        points: coordinates of the neighbours along the tangents.
        heights: their coordinates along the normal.
        weights: of the fit.
        width: the unit of length.
        radius: where the weights vanish.
    """

    tangents: Float[Array, "t d *p"]
    points: Float[Array, "t k *p"]
    heights: Float[Array, "k *p"]
    weights: Float[Array, "k *p"]
    width: Float[Array, "*p"]
    radius: Float[Array, "*p"]

    @classmethod
    def of(
        cls, around: Neighborhood, degree: int, *, width: float | None = None, support=None
    ) -> TangentPlane:
        """With the kernel that suits polynomials of a degree, or another (see `GFDM`)."""
        radius = around.support(around.offsets.shape[1] - 1, support)
        unit = radius * (_width(degree) if width is None else width)
        frame = jnp.moveaxis(tangent_frames(around.normals[0].T), 0, -1)
        along = [dot(around.offsets, axis[None]) / unit for axis in frame]
        weights = gaussian(around.squared, unit, radius, around.mask)
        points = jnp.stack(along[:-1])
        return cls(frame[:-1], points, along[-1], weights, unit, radius)

    def surface(self, degree: int) -> Float[Array, "m *p"]:
        """Coefficients of the surface as a graph over the plane, of degrees 1 to `degree`."""
        return polynomial_fit(self.points, self.weights, self.heights[None], 1, degree)[:, 0]


def needed_polynomials(degree: int, dim: int, target: AbstractTarget) -> int:
    """Polynomials of a degree over the tangents, for methods that are exact on all of these.

    Raises:
        ValueError: a degree below the order of the derivatives.
    """
    if degree < target.order:
        raise ValueError(
            f"degree = {degree}: polynomials of degree at least {target.order} are needed "
            f"for derivatives of order {target.order}, and so for the Laplacian by which "
            "neighbours are chosen"
        )
    return polynomial_count(dim - 1, degree)


def _width(degree: int) -> float:
    return 0.36 if degree <= 2 else 0.315
