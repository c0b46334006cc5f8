"""Sheets told apart in compiled code: what a short way over the surface leads to.

On the host `sheets` does the same.
"""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from .cells import distance_key
from .checks import DETOUR, LINK, RINGS, ring_size
from .nearest import Grid, Nearest
from .sheets import cosine_slack


class Rings(eqx.Module):
    """Which steps over the surface lead away from each point: to so many neighbours, so far.

    Args:
        length: of the longest step.
        key: of the distance to the last neighbour that one may lead to.
        index: its number.
    """

    length: Float[Array, " n"]
    key: Int[Array, " n"]
    index: Int[Array, " n"]

    @classmethod
    def of(cls, grid: Grid, found: Nearest) -> Rings:
        d = len(grid.cells)
        count = min(len(found.indices), 2 * RINGS)
        x = jnp.stack(grid.given[:d])

        def squared(slot):
            return jnp.sum((x[:, found.indices[slot]] - x) ** 2, axis=0)

        key = distance_key(squared(count - 1))
        key = jnp.where(found.mask[count - 1], key, jnp.iinfo(key.dtype).max)
        length = LINK * jnp.sqrt(squared(min(ring_size(d), count) - 1))
        return cls(length, key, found.indices[count - 1])


def without_islands(points, normals, rings, k: int, row, found, good):
    """What a short way over the surface leads to, of the candidates of one row."""
    x, normal = points[found], normals[found]
    d = x - x[:, None]
    squared = jnp.sum(d * d, axis=2)
    length = jnp.sqrt(squared)
    both = normal + normal[:, None]
    # A chord of a smooth curve makes equal angles with the normals at its ends.
    rise = jnp.abs(jnp.sum(d * both, axis=2))
    along = rise <= 0.5 * length * jnp.sqrt(jnp.sum(both * both, axis=2))
    key, last = distance_key(squared), rings.key[found][:, None]
    among = (key < last) | ((key == last) & (found <= rings.index[found][:, None]))
    accepted = normal @ normal.T >= -cosine_slack(x.dtype)
    step = along & among & accepted & (length > 0) & (length <= rings.length[found][:, None])
    link = jnp.where(step & good & good[:, None], length, jnp.inf)
    link = jnp.minimum(link, link.T)

    def longer(ways):
        return ways[1], jnp.minimum(ways[1], jnp.min(ways[1][:, None] + link, axis=0))

    start = jnp.where(jnp.arange(len(found)) == 0, 0, link[0])
    none = jnp.full_like(start, jnp.nan)
    way = jax.lax.while_loop(lambda ways: jnp.any(ways[0] != ways[1]), longer, (none, start))[1]
    kept = good & (way <= DETOUR * jnp.sqrt(jnp.sum((x - points[row]) ** 2, axis=1)))
    order = jnp.argsort(~kept, stable=True)[:k]
    mask = kept[order]
    return jnp.where(mask, found[order], row), mask
