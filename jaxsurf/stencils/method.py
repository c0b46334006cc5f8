"""What every kind of stencil offers, and what is known of each stencil afterwards."""

from __future__ import annotations

import abc

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from ..arguments import as_float, real, whole
from ..fits.kernels import gaussian, taper
from ..fits.monomials import polynomial_count
from ..fits.plane import Neighborhood, dot
from ..fits.sums import sums, total
from .targets import AbstractTarget, Joint, Laplacian


class Diagnostics(eqx.Module):
    """Per point, how well its stencil is determined.

    Args:
        condition: condition number of the equilibrated moment matrix (an estimate from below).
        residual: largest error of a moment condition, relative to the moments wanted.
        count: neighbours within the support, the point itself included.
        support: support radius, in the units of the points.
        layers: normal copies used on either side; 0 for methods without.
        tube: support radius times the largest normal curvature seen within it. Above 1 the
            tube of that radius around the surface intersects itself: copies along the normals
            cross, and the surface is no graph over the tangent plane.
        dominance: share of the centre among the absolute weights of the others, in the Laplacian
            that the method makes; -inf where there are no others. Where it falls below
            `least_dominance` and the surface bends within the stencil, the Laplacian goes over
            to positive weights. None for other operators.

    Example:
        >>> found = js.laplace_beltrami(js.sphere(300)).diagnostics
        >>> found.count.shape, bool(found.residual.max() < 1e-8)
        ((300,), True)
    """

    condition: Float[Array, "*n"]
    residual: Float[Array, "*n"]
    count: Int[Array, "*n"]
    support: Float[Array, "*n"]
    layers: Int[Array, "*n"]
    tube: Float[Array, "*n"]
    dominance: Float[Array, "*n"] | None = None

    @classmethod
    def of(cls, around: Neighborhood, condition, residual, support, layers: int) -> Diagnostics:
        """Diagnostics of one stencil: what the solve tells, and what its geometry does."""
        r2 = around.squared
        # The farthest too, where a method takes its distance as the support.
        inside = around.mask & (r2 < (1 + 8 * jnp.finfo(r2.dtype).eps) * support**2)
        return cls(
            condition,
            residual,
            total(inside),
            support,
            jnp.full(support.shape, layers, jnp.int32),
            jnp.max(jnp.where(inside, _bend(around, r2), 0), axis=0) * support,
        )


def _bend(around: Neighborhood, r2) -> Float[Array, "k *p"]:
    """Normal curvature on the way to each neighbour, as the normals tell it."""
    turn = dot(around.offsets, around.normals - around.normals[0])
    return jnp.where(r2 > 0, jnp.abs(turn) / jnp.where(r2 > 0, r2, 1), 0)


class AbstractMethod(eqx.Module):
    """A way to compute the weights of stencils.

    Example:
        >>> isinstance(js.GFDM(degree=2), js.AbstractMethod)
        True
    """

    @abc.abstractmethod
    def neighbor_count(self, dim: int) -> int:
        """How many neighbours (the point itself counts) to look for in d-dimensional space."""

    @abc.abstractmethod
    def basis_size(self, dim: int, target: AbstractTarget) -> int:
        """Polynomials along the surface that a stencil is exact on: the points it needs."""

    @abc.abstractmethod
    def weights(
        self, neighborhood: Neighborhood, target: AbstractTarget
    ) -> tuple[Float[Array, "... k *p"] | tuple[Float[Array, "... k *p"], ...], Diagnostics]:
        """Weights of stencils, `(*components, k, *p)`, in units of length to the minus order.

        As `target.assemble` gives them: of a `Joint` those of each of its operators.
        """

    @property
    def polynomial_degree(self) -> int:
        """Degree of the local polynomials that fields are integrated and interpolated by."""
        return 2

    @property
    def shares_moments(self) -> bool:
        """Whether derivatives of different order come from the same moments (see `Joint`)."""
        return False

    @property
    def least_dominance(self) -> float:
        """Share of the centre among the Laplacian's weights below which a point is adapted."""
        return 0.2

    @property
    @abc.abstractmethod
    def batch_size(self) -> int:
        """How many stencils are computed at once: enough to be fast, few enough for the cache."""


def weights_by(method: AbstractMethod, around: Neighborhood, target: AbstractTarget):
    """Those of a method, which may be a user's own, if they are what they have to be.

    Returns:
        Weights `(*components, k, *p)`, of a `Joint` those of each of its operators; diagnostics.

    Raises:
        TypeError, ValueError: they are not.
    """
    name, want = f"weights of {type(method).__name__}", around.mask.shape
    found = method.weights(around, target)
    if not (isinstance(found, tuple) and len(found) == 2 and isinstance(found[1], Diagnostics)):
        kinds = type(found).__name__
        raise TypeError(f"{name} returns a {kinds}, expected an array and Diagnostics")
    joint = isinstance(target, Joint)
    targets = target.targets if isinstance(target, Joint) else (target,)
    parts = found[0] if joint else found[:1]
    if not (isinstance(parts, tuple) and len(parts) == len(targets)):
        kinds = f"a tuple of {len(targets)} arrays, as target.assemble gives them"
        raise TypeError(f"{name} of several operators are {type(parts).__name__}, expected {kinds}")
    values = [as_float(part, name) for part in parts]
    for part in values:
        if part.shape[part.ndim - len(want) :] != want:
            raise ValueError(
                f"{name} has shape {part.shape}, expected (*components, {str(want)[1:]}"
            )
    diagnostics = jax.tree.map(jax.lax.stop_gradient, found[1])
    if isinstance(targets[0], Laplacian):
        values[0], share = _calmed(method, around, values[0], found[1].support)
        share = jax.lax.stop_gradient(share)
        diagnostics = eqx.tree_at(
            lambda d: d.dominance, diagnostics, share, is_leaf=lambda leaf: leaf is None
        )
    return tuple(values) if joint else values[0], diagnostics


# Positive weights have taken over where the share of the centre has fallen so far below what is
# needed, and support times curvature risen so far above one; or above half, as the share, so far
# from nothing, falls to that: what a centre of the wrong sign makes grow nothing else holds. Not on
# a border: of one side only positive weights are no Laplacian, and no centre is dominant there.
_SHORT, _BEYOND = 0.1, 0.25


def _calmed(method: AbstractMethod, around: Neighborhood, weights, support):
    """The Laplacian's weights, positive where the surface bends and the centre is not dominant.

    There no polynomial is of use, and a few such rows give an operator growing modes. Weights of
    one sign are inaccurate, but let nothing grow. Also the share of the centre.
    """
    others = total(jnp.abs(weights[1:]))
    share = jnp.where(others > 0, -weights[0] / jnp.where(others > 0, others, 1), -jnp.inf)
    short = ramp((method.least_dominance - share) / _SHORT)
    squared = around.squared  # found already; within the branch it would be once more

    @jax.checkpoint
    def calmed():
        # Without a jump where neighbours enter the support.
        s = squared / support**2
        tube = power_mean(support * _bend(around, squared), jnp.where(around.mask, taper(s), 0))
        early = ramp(1 - share / _SHORT) / 2
        if around.border is not None:
            early = jnp.where(around.border, 0, early)
        bends = 1 - early
        part = short * ramp((tube - bends) / _BEYOND)
        blend = weights + part * (_positive(around, s) / support**2 - weights)
        return jnp.where(part > 0, blend, weights)

    # Few blocks have a point without a dominant centre.
    return jax.lax.cond(jnp.any(short > 0), calmed, lambda: weights), share


@jax.custom_jvp
def power_mean(values: Float[Array, "k *p"], counted: Float[Array, "k *p"]) -> Float[Array, "*p"]:
    """Nearly the largest, and no more than it; smooth also where several are the largest."""
    return _power_mean(values, counted)[0]


def _power_mean(values, counted):
    """The mean; and what its derivative needs: shares of the largest, and sums, 1 for none."""
    largest = jnp.max(values, axis=0)
    unit = jnp.where(largest > 0, largest, 1)
    share = values / unit
    powers, count = sums([counted * share**_POWER, counted], 0)
    found = powers > 0
    powers, count = (jnp.where(found, a, 1) for a in (powers, count))
    mean = jnp.where(found, unit * (powers / count) ** (1 / _POWER), 0)
    return mean, (unit, share, powers, count)


@power_mean.defjvp
def _power_mean_jvp(primals, tangents):
    (_, counted), (moved, more) = primals, tangents
    mean, (unit, share, powers, count) = _power_mean(*primals)
    below = share ** (_POWER - 1)
    grown, more = sums([below * (share * more + counted * _POWER * (moved / unit)), more], 0)
    return mean, mean / _POWER * (grown / powers - more / count)


_POWER = 32


@jax.custom_jvp
def ramp(x):
    """From 0 at 0 to 1 at 1, with two continuous derivatives."""
    x = jnp.clip(x, 0, 1)
    return x**3 * (10 - 15 * x + 6 * x**2)


@ramp.defjvp
def _ramp_jvp(primals, tangents):
    x = jnp.clip(primals[0], 0, 1)
    return ramp(primals[0]), 30 * (x * (1 - x)) ** 2 * tangents[0]


# Length of the kernel of positive weights in units of the support: about one spacing.
_NEAR = 0.3


def _positive(around: Neighborhood, s) -> Float[Array, "k *p"]:
    """Multiples of a kernel that give the squared distance the Laplacian it has in the plane.

    Args:
        s: squared distances in units of the support, which is the unit of length.
    """
    kernel, flat = gaussian(s, _NEAR, 1.0, around.mask), around.offsets.shape[1] - 1
    second = total(kernel * s)
    eta = 2 * flat * kernel / jnp.where(second > 0, second, 1)
    return with_center(eta[None])[0]


def check_positive(method: AbstractMethod, **least: bool) -> None:
    """Raise unless these settings are positive numbers (True: whole ones), or None where they may.

    Raises:
        TypeError: no number, or not a whole one.
        ValueError: not positive or not finite.
    """
    for name, counted in least.items():
        value, label = getattr(method, name), f"{type(method).__name__}: {name}"
        if value is None and name not in ("order", "degree"):
            continue
        if counted:
            whole(value, label, least=1)
        else:
            real(value, label, above=0)


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


def with_center(eta: Float[Array, "c k *p"]) -> Float[Array, "c k *p"]:
    """Weights that sum to zero: those of the neighbours as given, the centre's made up."""
    others = eta[:, 1:]
    return jnp.concatenate([-total(others, axis=1)[:, None], others], axis=1)
