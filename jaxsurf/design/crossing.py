r"""Whether a closed surface passes through itself, by how often it winds around its own points.

Of a surface that does not, the angle under which it is seen from one of its points is half of all,
$\int n(y)\cdot(y - x) / |y - x|^d\,dy = |S^{d-1}| / 2$; where a part lies inside another, all of
them more.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool

from ..arguments import switched_off
from ..cloud import PointCloud
from ..machine import PAIRS, block_of_pairs
from ..neighbors import Neighbors

# So many points are looked from, evenly over the list, in blocks of so many.
_PROBES = 1_000
# Neighbours that tell the spacing at a point.
_RING = 6
# How far from a half, in turns: less than one, and more than errors of the sum. A sheet that does
# not cross has to come as near as a third of the spacing for that.
_OFF = 0.75


def crosses(cloud: PointCloud, neighbors: Neighbors) -> Bool[Array, ""]:
    """Whether points of a closed surface lie inside others of its parts, under `jit` too.

    Where fewer than about one in a thousand do, it may not be seen. Areas are known up to a factor
    only, from the distances of neighbours; the median of all points, a half, makes up for it.
    """
    seen, on = cloud.seen, cloud.active
    x, normals = seen.points, seen.normals
    near, mask = neighbors.indices[:, 1 : _RING + 1], neighbors.mask[:, 1 : _RING + 1]
    squared = jnp.sum((x[near] - x[:, None]) ** 2, axis=2)
    spacing = jnp.sum(jnp.where(mask, squared, 0), axis=1) / jnp.maximum(jnp.sum(mask, axis=1), 1)
    areas = switched_off(on, spacing ** ((cloud.dim - 1) / 2))

    def turns(one):
        i, point = one
        apart = x - point
        distance = jnp.sum(apart**2, axis=1)
        # Not by distance alone: the compiler may find a point twice, and differently rounded.
        same = (jnp.arange(cloud.n) == i) | (distance == 0)
        angles = jnp.sum(normals * apart, axis=1) / jnp.where(same, 1, distance) ** (cloud.dim / 2)
        return areas @ jnp.where(same, 0, angles)

    probes = slice(None, None, max(1, -(-cloud.n // _PROBES)))
    found = jax.lax.map(
        turns, (jnp.arange(cloud.n)[probes], x[probes]), batch_size=block_of_pairs(PAIRS)
    )
    if on is not None:
        found = switched_off(on[probes], found, jnp.nan)
    turned = found / (2 * jnp.nanmedian(found))
    return jnp.any(jnp.abs(turned - 0.5) > _OFF)
