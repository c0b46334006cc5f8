"""Polynomial fits over tangent planes: what they see of a neighbourhood, and with which weights."""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ..frames import tangent_frames
from .kernels import gaussian, support
from .moments import polynomial_fit


class Neighborhood(eqx.Module):
    """What the stencils of a block of points see: offsets and normals of the neighbours.

    The centre comes first. The last axis, `*p`, is the points of the block; without it, all
    that is made of a neighbourhood is for a single point.
    """

    offsets: Float[Array, "k d *p"]
    normals: Float[Array, "k d *p"]
    mask: Bool[Array, "k *p"]
    radius: Float[Array, "*p"] | None

    def support(self, dim: int, given: float | None) -> Float[Array, "*p"]:
        """Support radius of a method: the given one, that of the search, or a length filled."""
        radius = self.radius if given is None else given
        return support(self.squared, self.mask, dim=dim, radius=radius)

    @property
    def squared(self) -> Float[Array, "k *p"]:
        """Squared distances from the centre."""
        return dot(self.offsets, self.offsets)


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


def _width(degree: int) -> float:
    return 0.36 if degree <= 2 else 0.315


def dot(a: Float[Array, "k d *p"], b: Float[Array, "#k d *p"]) -> Float[Array, "k *p"]:
    """Scalar products; written out, as sums over an axis between others are slow."""
    return sum((a[:, i] * b[:, i] for i in range(1, a.shape[1])), a[:, 0] * b[:, 0])
