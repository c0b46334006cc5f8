r"""Weight functions of a neighbourhood, and the length scale they are stretched by.

All of them vanish at the support radius with two continuous derivatives, so that weights do
not jump when a neighbour enters or leaves.
"""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ..compiling import kept
from .sums import sums, total


def taper(s: Float[Array, "*q"]) -> Float[Array, "*q"]:
    r"""Cut-off $(1 - s^4)^3$ for $s = r^2/\rho^2 < 1$, else 0: twice differentiable."""
    inside = s < 1
    s = jnp.where(inside, s, 0)
    return jnp.where(inside, (1 - s**4) ** 3, 0)


@jax.custom_jvp
def gaussian(r2: Float[Array, "*q"], width, radius, on=True) -> Float[Array, "*q"]:
    r"""$e^{-r^2/\epsilon^2}$ (Singh et al. 2023, eq. 5), tapered to zero at the radius.

    Zero also where `on` is False, whatever stands there.
    """
    s = r2 / radius**2
    return jnp.where(on & (s < 1), jnp.exp(-r2 / width**2) * taper(s), 0)


@gaussian.defjvp
def _gaussian_jvp(primals, tangents):
    # That of the logarithm, as the exponential is there already.
    lengths, on = primals[:-1], primals[-1]

    def logarithm(r2, width, radius):
        s = r2 / radius**2
        inside = on & (s < 1)
        return jnp.where(inside, 3 * jnp.log(1 - jnp.where(inside, s, 0) ** 4) - r2 / width**2, 0)

    value = gaussian(*primals)
    return value, value * jax.jvp(logarithm, lengths, tangents[:-1])[1]


# Of k listed neighbours the support takes in about three quarters on even points, so that it
# ends well before the last of the list also where points are uneven.
_SHARE = 0.76
# Mean over the unit ball of the weight that counts a neighbour, (1 - s)^3, by dimension.
_MEAN_WEIGHT = {1: 16 / 35, 2: 1 / 4, 3: 16 / 105}


def support(
    r2: Float[Array, "k *p"],
    mask: Bool[Array, "k *p"],
    *,
    dim: int,
    radius: Float[Array, "*p"] | float | None = None,
) -> Float[Array, "*p"]:
    r"""Support radius $\rho$ of one neighbourhood: the given one, or one that the points fill.

    Without a given radius it is the length at which the neighbours, counted with weights that
    vanish there, reach a fixed share of the list. That is a smooth function of the distances,
    and points near the end of the list have no say in it, so that it does not jump when the
    list changes there.

    Args:
        r2: squared distances to the neighbours, the point itself first.
        mask: which of them count.
        dim: dimension of the set that the points sample (1: curve, 2: surface, 3: volume).
        radius: a given support.

    Differentiable: forward and reverse; the root by the implicit function theorem.
    """
    if radius is None:
        # The point itself counts, also in rows that are switched off.
        mask = jnp.concatenate([jnp.ones_like(mask[:1]), mask[1:]])
        return jnp.exp(_log_radius(r2, mask, _SHARE * _MEAN_WEIGHT[dim]))
    return jnp.broadcast_to(jnp.asarray(radius, r2.dtype), r2.shape[1:])


@functools.partial(jax.custom_jvp, nondiff_argnums=(2,))
def _log_radius(r2, mask, share):
    """Where the weights `_counted` add up to a share of the points; any derivative, in r2."""

    # Reverse mode takes the rule below off what it keeps. To be differentiated once more, that is a
    # step from where the loop ends, which is no function of anything.
    still = jax.lax.stop_gradient(r2)
    count, squared = sums([mask.astype(r2.dtype), jnp.where(mask, still, 0)], 0)
    target = jnp.maximum(share * count, 1.2)

    def newton(state):
        # In an even set log(count) is a straight line in t = log(radius), nearly; where a step
        # leaves the bracket, it is halved instead.
        (low, high, t), _, steps = state
        value, slope = _counted(still, mask, t)
        low, high = jnp.where(value < target, t, low), jnp.where(value < target, high, t)
        step = t + jnp.log(target / value) * value / jnp.maximum(slope, 1e-3 * value)
        inside = (step >= low) & (step <= high)
        new = jnp.where(inside, step, (low + high) / 2)
        # One array, and a product for a maximum: fewer kernels to compile.
        return jnp.stack([low, high, new]), jnp.vdot(new - t, new - t), steps + np.uint32(1)

    def moving(state):
        # The last step below is one more, and squares what error is left.
        return (state[1] > jnp.finfo(r2.dtype).eps) & (state[2] < 50)

    # A disc that is filled evenly out to the radius R has a mean r^2 of R^2 / 2, a ball of any
    # dimension about that; the share of the list that is wanted takes part of it.
    start = 0.5 * jnp.log(jnp.where(squared > 0, 2 * _SHARE * squared / count, 1))
    # Where most of the list is far from the few that reach the target, far below.
    bracket = jnp.stack([start - 20, start + 5, start])
    infinite = jnp.asarray(jnp.inf, r2.dtype)
    t = jax.lax.while_loop(moving, newton, (bracket, infinite, np.uint32(0)))[0][2]
    value, slope = _counted(r2, mask, t)
    return t + (target - value) / jnp.maximum(slope, 1e-3)


@_log_radius.defjvp
def _log_radius_jvp(share, primals, tangents):
    # The implicit function theorem; the target is a number of points.
    r2, mask = primals
    t = kept(_log_radius(r2, mask, share))
    _, slope = _counted(r2, mask, t)
    unit = jnp.exp(-2 * t)
    s = jnp.minimum(r2 * unit, 1)
    lost = total(jnp.where(mask, 3 * (1 - s) ** 2 * tangents[0], 0)) * unit
    return t, lost / jnp.maximum(slope, 1e-3)


def _counted(r2, mask, t):
    """The weights $(1 - s)^3$ of all points, $s = r^2 / e^{2t}$, and their derivative in t."""
    s = jnp.where(mask, jnp.minimum(r2 * jnp.exp(-2 * t), 1), 1)
    return sums([(1 - s) ** 3, 6 * s * (1 - s) ** 2], 0)


def enclosing(r2: Float[Array, "k *p"], mask: Bool[Array, "k *p"]) -> Float[Array, "*p"]:
    """Smooth stand-in for the largest squared distance, never below it; 1 in rows that are off."""
    scale = jnp.where(mask[0], jax.lax.stop_gradient(jnp.max(r2, axis=0)), 1)
    total = jnp.sum(jnp.where(mask, r2 / scale, 0) ** 8, axis=0)
    return jnp.where(mask[0], scale * jnp.where(mask[0], total, 1) ** (1 / 8), 1)


def bell(s: Float[Array, "*q"]) -> Float[Array, "*q"]:
    r"""$e^{-2s}(1 - s)^3$ for $s = r^2/\rho^2 < 1$, else 0: wide, for fits that average."""
    return jnp.exp(-2 * s) * jnp.maximum(1 - s, 0) ** 3
