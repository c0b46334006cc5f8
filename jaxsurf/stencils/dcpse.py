r"""Discretisation-corrected particle strength exchange, flat and on surfaces.

Singh, Foggia, Incardona, Sbalzarini, J. Sci. Comput. 96:89 (2023): Section 2 for flat space,
Section 3 (Algorithms 1 and 2) for surfaces.
"""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..compiling import first, stored
from ..fits.kernels import gaussian, taper
from ..fits.lines import line_solve
from ..fits.moments import moment_solve
from ..fits.monomials import polynomial_count
from ..fits.plane import dot
from ..frames import axes_of
from .method import AbstractMethod, Diagnostics, Neighborhood, check_positive, with_center
from .targets import AbstractTarget, Laplacian


class DCPSE(AbstractMethod):
    r"""Surface DC-PSE of a given order of convergence.

    Every neighbour is copied along its normal, $x_s + m\,\delta_n n_s$ with
    $|m| \le N_n$; on this narrow band, where fields are constant along the normals, the
    derivatives of the embedding space are those of the surface (eq. 9). The kernel is a
    polynomial times $e^{-|x/\epsilon|^2}$ (eq. 5) whose moments up to degree
    $|\alpha| + r - 1$ are prescribed (eq. 6), and its values on the copies of one point are
    summed to a single weight (eq. 10), so that the copies are never stored.

    Args:
        order: order of convergence r.
        width: $\epsilon$ in units of the support radius.
        layers: number $N_n$ of copies on either side.
        layer_spacing: distance $\delta_n$ between copies, in the units of the points; by
            default chosen per point so that the layers fill the support.
        support: support radius $r_c$, in the units of the points; by default the radius of the
            neighbour search, or for the k nearest a length that those k neighbours fill.

    Raises:
        ValueError: an order below 1, a width, number of layers or length that is not positive.

    Example:
        >>> cloud = js.sphere(300)
        >>> z = cloud.points[:, 2]
        >>> operator = js.laplace_beltrami(cloud, method=js.DCPSE(order=4))
        >>> bool(jnp.abs(operator(z) + 2 * z).max() < 0.02)
        True
    """

    order: int = eqx.field(static=True, default=2)
    width: float | None = eqx.field(static=True, default=None, kw_only=True)
    layers: int | None = eqx.field(static=True, default=None, kw_only=True)
    layer_spacing: float | None = eqx.field(static=True, default=None, kw_only=True)
    support: float | None = eqx.field(static=True, default=None, kw_only=True)

    def __check_init__(self):
        check_positive(
            self, order=True, width=False, layers=True, layer_spacing=False, support=False
        )

    def neighbor_count(self, dim):
        return _SURFACE_COUNT[min(self.order, 6)] if dim == 3 else 7 + 2 * self.order

    def basis_size(self, dim, target):
        # Fields are constant along the normal, so that only the polynomials of the tangent
        # directions count.
        _, high = _degrees(target.order, self.order)
        return polynomial_count(dim - 1, high)

    # The systems of a block stay in the second-level cache.
    batch_size = property(lambda self: 48 if self.order < 5 else 8)
    polynomial_degree = property(lambda self: max(self.order, 2))

    def weights(self, neighborhood: Neighborhood, target: AbstractTarget):
        dim = neighborhood.offsets.shape[1]
        radius = neighborhood.support(dim - 1, self.support)
        share = _width(self.order) if self.width is None else self.width
        width = radius * share
        count = _layers(self.order) if self.layers is None else self.layers
        # In units of the width, as all that follows.
        step: Array | float = 1 / (share * (count + 0.5))
        if self.layer_spacing is not None:
            step = self.layer_spacing / width

        # Along the axes of the tangent frame, in which the lines of copies are steep. Any rotated
        # axes give the same weights: these have no derivative.
        normal = jax.lax.stop_gradient(neighborhood.normals[0])
        length = jnp.sqrt(jnp.sum(normal**2, axis=0))
        normal = normal / jnp.where(length > 0, length, 1)
        frame = axes_of(normal)
        offsets, normals = (
            jnp.stack([dot(a, axis[None]) for axis in frame])
            for a in (neighborhood.offsets, neighborhood.normals)
        )
        never = first(width) < 0
        offsets, along = stored(offsets / width, never), step * normals
        x = jnp.stack([offsets + m * along for m in range(-count, count + 1)], 1)
        x = stored(x, never)
        # On the hollow side copies are nearer than their point, so the point itself has to fade
        # as it leaves the support.
        fade = jnp.where(neighborhood.mask, taper(neighborhood.squared / radius**2), 0)
        low, high = _degrees(target.order, self.order)
        squared = stored(jnp.sum(x**2, axis=0), never)
        w = stored(fade * gaussian(squared, 1.0, 1 / share), never)
        b = jnp.asarray(target.moments(dim, low, high), w.dtype)
        eta, condition, residual = line_solve(x, w, b, low, high)
        diagnostics = Diagnostics.of(neighborhood, condition, residual, radius, count)
        eta = eta / width**target.order
        return target.assemble(_with_center(eta, target), frame), diagnostics


class FlatDCPSE(AbstractMethod):
    r"""DC-PSE in flat space, of a given order of convergence.

    The kernel is a polynomial times $e^{-|x/\epsilon|^2}$ (eq. 5) with the moments of eq. (6).

    Args:
        order: order of convergence r.
        width: $\epsilon$ in units of the support radius.
        support: support radius $r_c$, in the units of the points; by default the radius of the
            neighbour search, or for the k nearest a length that those k neighbours fill.

    Raises:
        ValueError: an order below 1, a width or support that is not positive.

    Example:
        >>> x = np.stack(np.meshgrid(*2 * [np.linspace(0, 1, 15)]), axis=-1).reshape(-1, 2)
        >>> slope = js.partial_derivative(x, (1, 0), method=js.FlatDCPSE(order=2))
        >>> bool(jnp.abs(slope(x[:, 0] ** 2) - 2 * x[:, 0]).max() < 1e-9)
        True
    """

    order: int = eqx.field(static=True, default=2)
    width: float | None = eqx.field(static=True, default=None, kw_only=True)
    support: float | None = eqx.field(static=True, default=None, kw_only=True)

    def __check_init__(self):
        check_positive(self, order=True, width=False, support=False)

    def neighbor_count(self, dim, target: AbstractTarget = Laplacian()):
        return 3 * self.basis_size(dim, target)

    def basis_size(self, dim, target):
        _, high = _degrees(target.order, self.order)
        return polynomial_count(dim, high)

    batch_size = 64

    def weights(self, neighborhood: Neighborhood, target: AbstractTarget):
        x = jnp.swapaxes(neighborhood.offsets, 0, 1)
        radius = neighborhood.support(len(x), self.support)
        share = _width(self.order) if self.width is None else self.width
        width = radius * share
        x = x / width
        low, high = _degrees(target.order, self.order)
        w = gaussian(jnp.sum(x**2, axis=0), 1.0, 1 / share, neighborhood.mask)
        b = jnp.asarray(target.moments(len(x), low, high), x.dtype)
        eta, condition, residual = moment_solve(x, w, b, low, high)
        diagnostics = Diagnostics.of(neighborhood, condition, residual, radius, 0)
        return target.components(_with_center(eta / width**target.order, target)), diagnostics


# Neighbours to look for on a surface, by order; see `experiments` (stability study).
_SURFACE_COUNT = {1: 24, 2: 36, 3: 45, 4: 66, 5: 80, 6: 100}


def _width(order: int) -> float:
    return 0.41 if order <= 2 else 0.3


def _layers(order: int) -> int:
    return 2 if order <= 2 else 3


def _degrees(derivative: int, order: int) -> tuple[int, int]:
    r"""$\beta_{\min}$ and $|\alpha| + r - 1$ of eq. (6)."""
    return 1 - derivative % 2, derivative + order - 1


def _with_center(eta: Float[Array, "c k *p"], target: AbstractTarget):
    """Weights on the values themselves, from those on sums and differences with the centre.

    For even derivatives the kernel acts on differences (eq. 4), which takes the sum of all
    weights from the centre. For odd ones that sum is zero already: it is the moment of degree 0.
    """
    return eta if target.order % 2 else with_center(eta)
