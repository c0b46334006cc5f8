r"""Discretisation-corrected particle strength exchange, flat and on surfaces.

Singh, Foggia, Incardona, Sbalzarini, J. Sci. Comput. 96:89 (2023): Section 2 for flat space,
Section 3 (Algorithms 1 and 2) for surfaces.
"""

from __future__ import annotations

import math

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from .kernels import gaussian, support, taper
from .method import AbstractMethod, Diagnostics, Neighborhood, check_positive
from .moments import moment_solve
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
    """

    order: int = eqx.field(static=True, default=2)
    width: float | None = eqx.field(static=True, default=None, kw_only=True)
    layers: int | None = eqx.field(static=True, default=None, kw_only=True)
    layer_spacing: float | None = eqx.field(static=True, default=None, kw_only=True)
    support: float | None = eqx.field(static=True, default=None, kw_only=True)

    def __check_init__(self):
        check_positive(self, "order", "width", "layers", "layer_spacing", "support")

    def neighbor_count(self, dim):
        return _SURFACE_COUNT[min(self.order, 6)] if dim == 3 else 7 + 2 * self.order

    def basis_size(self, dim, target):
        # Fields are constant along the normal, so that only the polynomials of the tangent
        # directions count.
        _, high = _degrees(target.order, self.order)
        return math.comb(dim - 1 + high, high)

    @property
    def batch_size(self):
        return 64 if self.order < 3 else 32

    def weights(self, neighborhood: Neighborhood, target: AbstractTarget):
        offsets, normals, mask = neighborhood.offsets, neighborhood.normals, neighborhood.mask
        k, dim = offsets.shape
        r2 = jnp.sum(offsets**2, axis=1)
        given = neighborhood.radius if self.support is None else self.support
        radius = support(r2, mask, dim=dim - 1, radius=given)
        width = radius * (_width(self.order) if self.width is None else self.width)
        count = _layers(self.order) if self.layers is None else self.layers
        step = radius / (count + 0.5) if self.layer_spacing is None else self.layer_spacing

        heights = step * jnp.arange(-count, count + 1)
        copies = offsets[:, None] + heights[:, None] * normals[:, None]
        copies = copies.reshape(k * (2 * count + 1), dim)
        # On the hollow side copies are nearer than their point, so the point itself has to fade
        # as it leaves the support.
        fade = jnp.where(mask, taper(r2 / radius**2), 0)
        fade = jnp.repeat(fade, 2 * count + 1)
        eta, condition, residual = _kernel(copies, fade, width, radius, target, self.order)
        eta = jnp.sum(eta.reshape(-1, k, 2 * count + 1), axis=2)
        diagnostics = Diagnostics.of(neighborhood, condition, residual, radius, count)
        return target.assemble(
            _with_center(eta, target.order), jnp.eye(dim, dtype=eta.dtype)
        ), diagnostics


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
    """

    order: int = eqx.field(static=True, default=2)
    width: float | None = eqx.field(static=True, default=None, kw_only=True)
    support: float | None = eqx.field(static=True, default=None, kw_only=True)

    def __check_init__(self):
        check_positive(self, "order", "width", "support")

    def neighbor_count(self, dim, target: AbstractTarget = Laplacian()):
        return 3 * self.basis_size(dim, target)

    def basis_size(self, dim, target):
        _, high = _degrees(target.order, self.order)
        return math.comb(dim + high, high)

    @property
    def batch_size(self):
        return 64

    def weights(self, neighborhood: Neighborhood, target: AbstractTarget):
        offsets, mask = neighborhood.offsets, neighborhood.mask
        dim = offsets.shape[1]
        given = neighborhood.radius if self.support is None else self.support
        radius = support(jnp.sum(offsets**2, axis=1), mask, dim=dim, radius=given)
        width = radius * (_width(self.order) if self.width is None else self.width)
        eta, condition, residual = _kernel(
            offsets, mask.astype(offsets.dtype), width, radius, target, self.order
        )
        diagnostics = Diagnostics.of(neighborhood, condition, residual, radius, 0)
        weights = _with_center(eta, target.order)
        return target.assemble(weights, jnp.eye(dim, dtype=weights.dtype)), diagnostics


# Neighbours to look for on a surface, by order; see `experiments` (stability study).
_SURFACE_COUNT = {1: 24, 2: 36, 3: 45, 4: 66, 5: 80, 6: 100}


def _width(order: int) -> float:
    return 0.41 if order <= 2 else 0.3


def _layers(order: int) -> int:
    return 2 if order <= 2 else 3


def _degrees(derivative: int, order: int) -> tuple[int, int]:
    r"""$\beta_{\min}$ and $|\alpha| + r - 1$ of eq. (6)."""
    return 1 - derivative % 2, derivative + order - 1


def _kernel(x, factor, width, radius, target, order):
    """DC-PSE kernel (eqs. 5 to 7) at the points x, of weight Gaussian times a given factor."""
    low, high = _degrees(target.order, order)
    scaled = x / width
    r2 = jnp.sum(x**2, axis=1)
    w = factor * gaussian(r2, width, radius)
    b = jnp.asarray(target.moments(x.shape[1], low, high), x.dtype)
    eta, condition, residual = moment_solve(scaled.T, w, b, low, high)
    return eta / width**target.order, condition, residual


def _with_center(eta: Float[Array, "c k"], derivative: int) -> Float[Array, "c k"]:
    """Weights on the values themselves, from those on sums and differences with the centre.

    For even derivatives the kernel acts on differences (eq. 4), which takes the sum of all
    weights from the centre. For odd ones that sum is zero already: it is the moment of degree 0.
    """
    if derivative % 2:
        return eta
    others = eta.at[:, 0].set(0)
    return others.at[:, 0].set(-jnp.sum(others, axis=1))
