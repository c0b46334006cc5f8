r"""Ghost points: the surface continued across its border by mirror images.

A point at distance s inside the border has an image at distance s outside. The condition
$a\,u + b\,\partial_\nu u = g$ at the foot between them, with the mean of both for u and their
difference over 2 s for $\partial_\nu u$, gives the value of the image,

$$u' = \frac{(b/2s - a/2)\,u + g}{b/2s + a/2}:$$

even images for Neumann conditions, odd ones for Dirichlet.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import compress
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .arguments import instance
from .borders.border import Border, checked_border
from .borders.order import find_border
from .boundary import Closure, Source, check_pivots
from .cloud import PointCloud
from .compiling import at_once
from .conditions import Condition, checked_conditions
from .failures import is_concrete, needs_values, raise_at
from .images import apart, reach_of, reflected
from .stencils.method import AbstractMethod
from .stencils.usual import USUAL


def with_ghosts(
    cloud: PointCloud,
    conditions: Condition | Sequence[Condition],
    *,
    method: AbstractMethod = USUAL,
    depth: float | None = None,
    border: Border | None = None,
    throw: bool = True,
) -> tuple[PointCloud, Closure]:
    r"""A cloud continued across its border, with the values that the conditions give there.

    Points near the border are reflected at the plane through their foot point on it and normal
    to its conormal, normals along with them: planes, spheres and cylinders continue exactly,
    any surface to second order. At a right-angled corner images are reflected again. Operators
    on the enlarged cloud have full stencils up to the border. Border points under a Neumann or
    Robin condition stay free, those under a Dirichlet condition are bound to its value.

    Args:
        cloud: n points with `boundary`, concrete.
        conditions: as for `eliminate`; points off the border take Dirichlet conditions only. Parts
            of the border under no condition get no images.
        method: of the operators to come: its neighbourhoods decide how deep the images reach.
        depth: how deep, in the units of the points; by the method if None.
        border: from `find_border`; found if None.
        throw: check the factors of the images.

    Returns:
        The enlarged cloud, its first n points the old ones, the ghosts its new border (with what
        is left of the old one under no condition), and the closure for its fields
        (`Closure.extend` fills in a field of the n points).

    Accuracy: images are off by O(h³) (Neumann, Robin with b ≠ 0) and O(h²) (Dirichlet), so that
    solutions converge with second order whatever the method (`tests/test_boundary.py`); exact
    to the method's order only where the solution itself has the symmetry. In float32 images are
    within 3e-5 of their places with `DCPSE(order=2)`, and extended values within 1e-4 of their
    size and 2e-4 (`tests/test_boundary.py`).
    Differentiable: in values, a and b; not in the points, whose images are found on the host.
    Raises:
        ValueError: as `eliminate` and `find_border`; a Neumann or Robin condition off the border;
            no border point under any condition; b/s + a near zero (a Robin condition of the
            wrong sign), with the point.
    Source: the method of images of Singh et al. 2023, Section 4.5.

    Example:
        >>> square = js.graph(lambda x, y: 0.0 * x, (11, 11))
        >>> wide, closure = js.with_ghosts(square, js.neumann(square.boundary))
        >>> x = wide.points[:, 0]
        >>> even = closure.extend(square.points[:, 0] ** 2)
        >>> bool(jnp.allclose(even, jnp.minimum(abs(x), 2 - abs(x)) ** 2))
        True
    """
    instance(cloud, PointCloud, "cloud")
    instance(method, AbstractMethod, "method", "as js.GFDM(degree=2)")
    needs_values("cloud", cloud, instead="images are found on the host")
    conditions, owned = checked_conditions(cloud, conditions)
    with at_once():  # of the points alone; values may be traced
        border = find_border(cloud) if border is None else checked_border(border, cloud)
    _check_places(conditions, owned, border)
    declared = np.zeros(cloud.n, bool)
    for condition in conditions:
        declared[condition.where] = True
    binding = [not condition.is_free for condition in conditions]
    conditions, owned = list(compress(conditions, binding)), list(compress(owned, binding))
    owner, place = np.full(cloud.n, -1), np.zeros(cloud.n, int)
    for number, (condition, own) in enumerate(zip(conditions, owned)):
        owner[condition.where[own]], place[condition.where[own]] = number, np.flatnonzero(own)
    with at_once():
        images = reflected(cloud, border, owner, reach_of(cloud, border, method, depth))
    if not len(images.parent):
        raise ValueError("no border point is under a condition: there is nothing to reflect")
    images = images.only(apart(cloud, images), cloud.n)
    bare = np.zeros(cloud.n, bool) if cloud.boundary is None else np.asarray(cloud.boundary)
    bare = bare & (owner < 0)  # remains a border
    rows, indices, weights, sources = _values(cloud, images, conditions, owned, place, throw)
    grown = lambda mask: jnp.asarray(np.pad(mask, (0, len(images.parent)), constant_values=True))
    wide = _joined(cloud, images, grown(bare))
    return wide, Closure(wide.n, rows, indices, weights, sources, grown(declared))


def _check_places(conditions, owned, border) -> None:
    on_border = np.asarray(border.points)
    for number, (condition, own) in enumerate(zip(conditions, owned)):
        off = np.setdiff1d(condition.where[own], on_border)
        raise_at(
            np.full(off.shape, condition.b is not None),
            f"condition {number} takes a derivative at point {{v}}, which is not on the border"
            "{more}: images need a border",
            off,
        )


def _values(cloud, images, conditions, owned, place, throw):
    """Rows, indices, weights and sources of the closure."""
    n, m, dtype = cloud.n, len(images.parent), cloud.points.dtype
    second, parent, root = images.ancestors(n)

    weight, inverse = _factors(images, conditions, place, root, dtype, throw)
    chosen = np.where if is_concrete(weight) else jnp.where
    total = chosen(second, weight * weight[parent], weight)

    fixed = [c.where[own] if c.b is None else c.where[:0] for c, own in zip(conditions, owned)]
    rows = np.concatenate([*fixed, n + np.arange(m)])
    first = len(rows) - m
    bound = np.full(n, -1)
    sources, start = [], 0
    for number, (condition, points) in enumerate(zip(conditions, fixed)):
        entries = _Entries(dtype)
        if len(points):
            a = _on_host(jnp.broadcast_to(condition.a, condition.m))[place[points]]
            entries.add(start + np.arange(len(points)), 1 / a, place[points])
            bound[points] = number
            start += len(points)
        here = np.flatnonzero(images.condition == number)
        entries.add_carried(images, place, first + here, inverse[here], here)
        child = np.flatnonzero(second & (images.condition[parent] == number))
        above = parent[child]
        entries.add_carried(images, place, first + child, weight[child] * inverse[above], above)
        sources.append(entries)
    # Images of points of known value.
    for number, condition in enumerate(conditions):
        here = np.flatnonzero(bound[root] == number)
        if here.size:
            a = _on_host(jnp.broadcast_to(condition.a, condition.m))[place[root[here]]]
            sources[number].add(first + here, total[here] / a, place[root[here]])
    free = int(np.argmax((bound < 0) & cloud.host_active))
    depends = np.where(bound[root] < 0, root, free)
    total = total * (bound[root] < 0)

    indices = jnp.asarray(np.concatenate([np.full(first, free), depends]).astype(np.int32))
    weights = _concatenated([np.zeros(first, dtype), total]).astype(dtype)
    given = tuple(entries.source(c) for entries, c in zip(sources, conditions) if entries.slots)
    return jnp.asarray(rows.astype(np.int32)), indices[None], weights[None], given


def _factors(images, conditions, place, root, dtype, throw) -> Any:
    """The value of an image is `weight` u + `inverse` g; conditions are carried to the feet."""
    start = np.cumsum([0, *(c.m for c in conditions)])
    pick = start[images.condition][:, None] + place[images.carriers]
    every = [
        jnp.concatenate([_each(x, c, dtype) for c, x in zip(conditions, xs)])
        for xs in zip(*((c.a, c.b) for c in conditions))
    ]
    a, b = map(_on_host, _carried(*every, pick, images.shares, images.distance))
    if throw and is_concrete(a, b):
        check_pivots(a + b, abs(a) + abs(b), root, "image of point {i}: a/2 + b/2s")
    with np.errstate(divide="ignore", invalid="ignore"):
        return (b - a) / (a + b), 1 / (a + b)


def _on_host(x) -> Any:
    """Where it is concrete: new sizes compile nothing there."""
    return np.asarray(x) if is_concrete(x) else x


def _concatenated(parts) -> Array:
    return jnp.asarray(np.concatenate(parts)) if is_concrete(*parts) else jnp.concatenate(parts)


def _each(x, condition, dtype) -> Float[Array, " m"]:
    """A factor at all points of a condition; none counts as zero."""
    return jnp.broadcast_to(jnp.zeros((), dtype) if x is None else x.astype(dtype), condition.m)


@jax.jit
def _carried(a, b, pick, shares, distance):
    """The terms a/2 and b/2s of all images."""
    return tuple(jnp.sum(shares * x[pick], axis=1) / 2 / s for x, s in ((a, 1), (b, distance)))


class _Entries:
    """The places where the values of one condition enter."""

    def __init__(self, dtype):
        self.dtype = dtype
        self.slots: list[np.ndarray] = []
        self.factors: list[Array] = []
        self.picks: list[np.ndarray] = []

    def add(self, slots, factors, picks):
        self.slots.append(np.asarray(slots))
        self.factors.append(factors)
        self.picks.append(np.asarray(picks))

    def add_carried(self, images, place, slots, factors, which):
        """Values carried to the feet of some images."""
        share = images.shares[which]
        i, r = np.nonzero(share)
        self.add(slots[i], factors[i] * share[i, r], place[images.carriers[which][i, r]])

    def source(self, condition) -> Source:
        slots, picks = (jnp.asarray(np.concatenate(x)) for x in (self.slots, self.picks))
        return Source(slots, _concatenated(self.factors).astype(self.dtype), picks, condition)


def _joined(cloud, images, border) -> PointCloud:
    m = len(images.parent)
    pad = lambda x, value: None if x is None else jnp.concatenate([x, jnp.full(m, value, x.dtype)])
    root = images.ancestors(cloud.n)[2]
    spacing = cloud.spacing
    return PointCloud(
        jnp.concatenate([cloud.points, jnp.asarray(images.points, cloud.points.dtype)]),
        jnp.concatenate([cloud.normals, jnp.asarray(images.normals, cloud.points.dtype)]),
        boundary=border,
        active=pad(cloud.active, True),
        spacing=None if spacing is None else jnp.concatenate([spacing, spacing[root]]),
    )
