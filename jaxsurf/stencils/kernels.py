r"""Weight functions of a neighbourhood, and the length scale they are stretched by.

All of them vanish at the support radius with two continuous derivatives, so that weights do
not jump when a neighbour enters or leaves.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float


def taper(s: Float[Array, "*q"]) -> Float[Array, "*q"]:
    r"""Cut-off $(1 - s^4)^3$ for $s = r^2/\rho^2 < 1$, else 0: flat inside, twice differentiable."""
    inside = s < 1
    s = jnp.where(inside, s, 0)
    return jnp.where(inside, (1 - s**4) ** 3, 0)


def gaussian(r2: Float[Array, "*q"], width, radius) -> Float[Array, "*q"]:
    r"""$e^{-r^2/\epsilon^2}$ (Singh et al. 2023, eq. 5), tapered to zero at the radius."""
    return jnp.exp(-r2 / width**2) * taper(r2 / radius**2)


def soft_count(r2: Float[Array, " k"], mask: Bool[Array, " k"], radius) -> Float[Array, ""]:
    """Number of points within the radius, as a twice differentiable function of the distances."""
    return jnp.sum(jnp.where(mask, taper(r2 / radius**2), 0))


# Of k listed neighbours the support takes in so many, softly counted, that on even points it
# ends well before the last of the list: the mean of the taper over a disc is 0.66, so that
# about three quarters of the list lie within.
_SOFT_FRACTION = 0.5


def support(
    r2: Float[Array, " k"],
    mask: Bool[Array, " k"],
    *,
    dim: int,
    radius: Float[Array, ""] | float | None = None,
) -> Float[Array, ""]:
    r"""Support radius $\rho$ of one neighbourhood: the given one, or one that the points fill.

    Without a given radius it is the length at which the soft count of neighbours reaches a
    fixed share of the list. That is a smooth function of the distances, and points near the end
    of the list have no say in it, so that it does not jump when the list changes there.

    Args:
        r2: squared distances to the neighbours, the point itself first.
        mask: which of them count.
        dim: dimension of the set that the points sample (1: curve, 2: surface, 3: volume).
        radius: a given support.

    Differentiable: forward and reverse; the root by the implicit function theorem.
    """
    if radius is None:
        return _soft_radius(r2, mask, _SOFT_FRACTION * jnp.maximum(jnp.sum(mask), 2), dim)
    return jnp.asarray(radius, r2.dtype)


def _soft_radius(r2, mask, target, dim):
    frozen = jax.lax.stop_gradient(r2)
    mask = mask.at[0].set(True)  # the point itself, also in rows that are switched off

    def count_and_slope(t):
        count, slope = jax.value_and_grad(lambda t: soft_count(frozen, mask, jnp.exp(t)))(t)
        # In an even set log(count) grows like dim * t; a slope far below that is a plateau.
        return count, jnp.maximum(slope, 0.2 * dim * count)

    def newton(_, t):
        count, slope = count_and_slope(t)
        return t + jnp.log(target / count) * count / slope

    farthest = jnp.max(jnp.where(mask, frozen, 0))
    start = 0.5 * jnp.log(jnp.where(farthest > 0, farthest, 1))
    t = jax.lax.fori_loop(0, 10, newton, start)
    # One more step, the only one that is differentiated: the implicit function theorem.
    _, slope = count_and_slope(t)
    return jnp.exp(t + (target - soft_count(r2, mask, jnp.exp(t))) / slope)
