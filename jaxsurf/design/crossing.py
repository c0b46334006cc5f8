r"""Whether a surface passes through itself.

A closed one is asked how often it winds around its own points: of a surface that does not cross,
the angle under which it is seen from one of its points is half of all,
$\int n(y)\cdot(y - x) / |y - x|^d\,dy = |S^{d-1}| / 2$; where a part lies inside another, all of
them more. One with a border is asked whether a way from a point to one next to it leads through
the tangent plane of a point of another part, close to that.
"""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Bool

from ..arguments import switched_off
from ..cloud import PointCloud
from ..compiling import in_batches
from ..machine import PAIRS, block_of_pairs
from ..neighbors import Neighbors

# So many points are looked from, evenly over the list, in blocks of so many.
_PROBES = 1_000
# Neighbours that tell the spacing at a point.
_RING = 6
# How far from a half, in turns: less than one, and more than errors of the sum. A sheet that does
# not cross has to come as near as a third of the spacing for that.
_OFF = 0.75
# A way leads through a sheet where it comes so near to one of its points, in units of the spacing
# there, and rises over its plane by such a share of its length: sheets side by side do not cross.
_CLOSE, _STEEP = 0.75, 0.2


def crosses(cloud: PointCloud, neighbors: Neighbors) -> Bool[Array, ""]:
    """Whether points of a closed surface lie inside others of its parts, under `jit` too.

    Where fewer than about one in a thousand do, it may not be seen. Areas are known up to a factor
    only, from the distances of neighbours; the median of all points, a half, makes up for it.
    """
    seen, on = cloud.seen, cloud.active
    x, normals = seen.points, seen.normals
    areas = switched_off(on, _spacing_squared(x, neighbors) ** ((cloud.dim - 1) / 2))

    def turns(i):
        apart, distance, same = _apart(x, i)
        angles = jnp.sum(normals * apart, axis=1) / jnp.where(same, 1, distance) ** (cloud.dim / 2)
        return areas @ jnp.where(same, 0, angles)

    found = _looked_from(turns, cloud.n)
    if on is not None:
        found = switched_off(_probes(on), found, jnp.nan)
    turned = found / (2 * jnp.nanmedian(found))
    return jnp.any(jnp.abs(turned - 0.5) > _OFF)


def pierces(cloud: PointCloud, neighbors: Neighbors) -> Bool[Array, ""]:
    """Whether ways from point to point lead through other parts of a surface, under `jit` too.

    Its border may lie anywhere. What is in the list of a point is of the same part as that. Sheets
    at an angle below about ten degrees do not count as crossing; where fewer than about one point
    in a thousand is next to the crossing, it may not be seen.
    """
    seen, on, neighbors = cloud.seen, cloud.active, neighbors.nearest
    x, normals = seen.points, seen.normals
    spacing = _spacing_squared(x, neighbors)

    def through(i):
        _, distance, same = _apart(x, i)
        other = ~same.at[neighbors.indices[i]].set(True)
        other = other if on is None else other & on
        j = jnp.argmin(jnp.where(other, distance, jnp.inf))
        start = x[i] - x[j]
        ways = x[_ring(neighbors.indices)[i]] - x[i]
        above, rise = start @ normals[j], ways @ normals[j]
        share = -above / jnp.where(rise == 0, 1, rise)
        steep = rise**2 > _STEEP**2 * jnp.sum(ways**2, axis=1)
        hit = start + share[:, None] * ways
        close = jnp.sum(hit**2, axis=1) < _CLOSE**2 * spacing[j]
        within = (share >= 0) & (share <= 1)
        used = _ring(neighbors.mask)[i]
        return jnp.any(other) & jnp.any(used & steep & within & close)

    return jnp.any(_looked_from(through, cloud.n))


def _ring(slots):
    return slots[:, 1 : _RING + 1]


def _spacing_squared(x, neighbors):
    near, mask = _ring(neighbors.indices), _ring(neighbors.mask)
    squared = jnp.sum((x[near] - x[:, None]) ** 2, axis=2)
    return jnp.sum(jnp.where(mask, squared, 0), axis=1) / jnp.maximum(jnp.sum(mask, axis=1), 1)


def _apart(x, i):
    """Ways from a point to all, their squared lengths, and which of them lead nowhere."""
    apart = x - x[i]
    squared = jnp.sum(apart**2, axis=1)
    # Not by distance alone: the compiler may find a point twice, and differently rounded.
    return apart, squared, (jnp.arange(len(x)) == i) | (squared == 0)


def _probes(rows):
    return rows[:: max(1, -(-len(rows) // _PROBES))]


def _looked_from(look, n: int):
    """What is seen from some points, evenly over the list."""
    return in_batches(look, _probes(jnp.arange(n)), block_of_pairs(PAIRS))
