"""Polynomial fits over tangent planes: what they see of a neighbourhood, and with which weights."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ..compiling import AnyArray, first, namespace, stored
from ..frames import axes_of
from ..kept import Kept, once
from .kernels import gaussian, support
from .moments import polynomial_fit


class Neighborhood(eqx.Module):
    """What the stencils of a block of points see: offsets and normals of the neighbours.

    The centre comes first. The last axis, `*p`, is the points of the block; without it, all
    that is made of a neighbourhood is for a single point. On a marked `border` is the centre.
    """

    offsets: Float[Array, "k d *p"]
    normals: Float[Array, "k d *p"]
    mask: Bool[Array, "k *p"]
    radius: Float[Array, "*p"] | None
    border: Bool[Array, "*p"] | None = None

    @classmethod
    def of(cls, points, normals, mask, radius, border) -> Neighborhood:
        """From the coordinates of the neighbours and of their normals, axis by axis."""
        # The point itself stands in slot 0. Stored, as the derivative of a whole stencil would be
        # found again for each coordinate. (No component of a unit normal is 2.)
        offsets = stored(jnp.stack([x - x[0] for x in points], axis=1), first(normals[0]) > 2)
        return cls(offsets, jnp.stack(normals, axis=1), mask, radius, border)

    def support(self, dim: int, given: float | None) -> Float[Array, "*p"]:
        """Support radius of a method: the given one, that of the search, or a length filled."""
        radius = self.radius if given is None else given
        return support(self.squared, self.mask, dim=dim, radius=radius)

    @Kept
    def squared(self) -> Float[Array, "k *p"]:
        """Squared distances from the centre.

        Stored, as those that are found again may differ in the last bit: the derivative of the
        largest looks for that which is equal to it.
        """
        return stored(dot(self.offsets, self.offsets), first(self.normals) > 2)


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

    tangents: Float[AnyArray, "t d *p"]
    points: Float[AnyArray, "t k *p"]
    heights: Float[AnyArray, "k *p"]
    weights: Float[AnyArray, "k *p"]
    width: Float[AnyArray, "*p"]
    radius: Float[AnyArray, "*p"]

    @classmethod
    def of(
        cls, around: Neighborhood, degree: int, *, width: float | None = None, support=None
    ) -> TangentPlane:
        """With the kernel that suits polynomials of a degree, or another (see `GFDM`)."""
        width = _width(degree) if width is None else width

        def seen() -> TangentPlane:
            radius = around.support(around.offsets.shape[1] - 1, support)
            unit = radius * width
            # The compiler would find the factors again for every use of their product.
            weights = stored(gaussian(around.squared, unit, radius, around.mask), first(unit) < 0)
            plane = cls.at(around.normals[0], around.offsets, weights, unit, radius)
            # For accelerators: on a CPU the compiler looks through it.
            return jax.lax.optimization_barrier(plane)

        return once(around, (width, support), seen)

    @classmethod
    def at(cls, normal, offsets, weights, width, radius) -> TangentPlane:
        """With weights of its own, perpendicular to a normal `(d, *p)`; also in NumPy."""
        xp = namespace(normal)
        frame = axes_of(normal)
        along = [dot(offsets, axis[None]) / width for axis in frame]
        return cls(frame[:-1], xp.stack(along[:-1]), along[-1], weights, width, radius)

    def surface(self, low: int, high: int) -> tuple[Float[AnyArray, "m *p"], Float[AnyArray, "*p"]]:
        """The surface as a graph over the plane: coefficients of degrees `low` to `high`.

        With the condition number of the fit, see `polynomial_fit`.
        """
        fitted, condition = polynomial_fit(self.points, self.weights, self.heights[None], low, high)
        return fitted[:, 0], condition

    def tilted(self, normal, slopes) -> Float[AnyArray, "d *p"]:
        """Unit normal of a graph over the plane with this normal, `(d, *p)`, and these slopes."""
        new = normal - sum(slope * axis for slope, axis in zip(slopes, self.tangents))
        return new / namespace(new).sqrt(sum(x * x for x in new))


def _width(degree: int) -> float:
    return 0.36 if degree <= 2 else 0.315


def dot(a: Float[AnyArray, "k d *p"], b: Float[AnyArray, "#k d *p"]) -> Float[AnyArray, "k *p"]:
    """Scalar products; written out, as sums over an axis between others are slow."""
    return _dot(a, b) if namespace(a) is jnp else _written_out(a, b)


def _written_out(a, b):
    first, *more = (a[:, i] * b[:, i] for i in range(a.shape[1]))
    return sum(more, first)


_dot = jax.custom_jvp(_written_out)


@_dot.defjvp
def _dot_jvp(primals, tangents):
    # As a sum, which transposed is one product for all axes.
    (a, b), (da, db) = primals, tangents
    return _dot(a, b), jnp.sum(da * b + a * db, axis=1)
