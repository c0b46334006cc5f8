r"""Generalised finite differences in the tangent plane.

Suchde, Kuhnert, J. Comput. Phys. (2019), Section 4.1, eqs. (18) to (27).
"""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp

from ..fits.moments import moment_solve
from ..fits.plane import TangentPlane
from .method import (
    AbstractMethod,
    Diagnostics,
    Neighborhood,
    check_positive,
    needed_polynomials,
    with_center,
)
from .targets import AbstractTarget


class GFDM(AbstractMethod):
    r"""Tangent-plane GFDM of a given polynomial degree.

    The neighbours are projected on the tangent plane; of all weights that differentiate the
    monomials up to the degree exactly there (eqs. 18, 26), those with least
    $\sum_j c_j^2 / W_j^2$ are taken (eqs. 19, 27). The weight of the centre itself is left free
    ($W_i = \infty$), which makes it as dominant as the conditions allow. Derivatives along the
    tangents are rotated back to space (eqs. 20, 21); as the normal is exact to the order of the
    method, the Laplacian of the tangent plane is the Laplace-Beltrami operator.

    Args:
        degree: polynomial degree p; gradients then converge like $h^p$ and the Laplacian like
            $h^{p-1}$, or $h^p$ for even p on even points.
        width: length of the Gaussian $W^2 = e^{-r^2/\epsilon^2}$ in units of the support radius.
        support: support radius, in the units of the points; by default the radius of the
            neighbour search, or for the k nearest a length that those k neighbours fill.

    Raises:
        ValueError: a degree below 1, a width or support that is not positive.

    Example:
        >>> cloud = js.sphere(300)
        >>> z = cloud.points[:, 2]
        >>> operator = js.laplace_beltrami(cloud, method=js.GFDM(degree=4))
        >>> bool(jnp.abs(operator(z) + 2 * z).max() < 0.02)
        True
    """

    degree: int = eqx.field(static=True, default=2)
    width: float | None = eqx.field(static=True, default=None, kw_only=True)
    support: float | None = eqx.field(static=True, default=None, kw_only=True)

    def __check_init__(self):
        check_positive(self, degree=True, width=False, support=False)

    def neighbor_count(self, dim):
        return _SURFACE_COUNT[min(self.degree, 6)] if dim == 3 else 5 + 2 * self.degree

    def basis_size(self, dim, target):
        return needed_polynomials(self.degree, dim, target)

    # Columns a power of two apart share lines of a cache: at 256 derivatives took twice as long.
    batch_size = 100
    polynomial_degree = property(lambda self: max(self.degree, 2))
    # Of degree 1 there is no Laplacian that a gradient could come with.
    shares_moments = property(lambda self: self.degree > 1)

    def weights(self, neighborhood: Neighborhood, target: AbstractTarget):
        plane = TangentPlane.of(neighborhood, self.degree, width=self.width, support=self.support)
        b = jnp.asarray(target.moments(len(plane.points), 1, self.degree), plane.points.dtype)
        eta, condition, residual = moment_solve(plane.points, plane.weights, b, 1, self.degree)
        eta = with_center(target.in_units(eta, plane.width, len(plane.points)))
        diagnostics = Diagnostics.of(neighborhood, condition, residual, plane.radius, 0)
        return target.assemble(eta, plane.tangents), diagnostics


# Neighbours to look for on a surface, by degree; see `experiments` (stability study).
_SURFACE_COUNT = {1: 16, 2: 36, 3: 42, 4: 60, 5: 66, 6: 90}
