"""A surface at other points: its normals there, and what has gone wrong with it."""

from __future__ import annotations

import contextlib
import contextvars
import functools
from collections.abc import Callable, Iterator

import jax
import jax.numpy as jnp
import numpy as np

from .arguments import finite, switched_off
from .build import residual_tolerance
from .cloud import PointCloud
from .compiling import host_jit, namespace, sized_jit
from .failures import raise_at
from .frames import frames_of
from .neighbors import first_ring

# What a code says of a point.
CODES = {
    1: "its position or normal is not finite",
    2: "the normal of a neighbour next to it points to the other side: a fold, or another sheet",
    3: "its stencil is degenerate",
    4: "its list of neighbours no longer reaches",
    5: "more neighbours than there is room for, which `surface.search(margin=...)` makes",
}
# Points outside a list may come as near as this share of the way to the farthest one in it.
_SKIN = 0.5

_judging = contextvars.ContextVar("judging", default=True)

# Each brings normals closer to where a rigid motion takes them, by the error of the gradient.
_TURNS = 5


@contextlib.contextmanager
def unjudged() -> Iterator[None]:
    """Surfaces that are moved within it raise no error for their code: they are moved on.

    Their lists may be those of where they are moved to, and not reach before.
    """
    token = _judging.set(False)
    try:
        yield
    finally:
        _judging.reset(token)


def is_judged() -> bool:
    return _judging.get()


def moved_cloud(cloud: PointCloud, points, normals, gradient: Callable[[], Callable]) -> PointCloud:
    """A cloud with its points elsewhere: normals follow if None, the spacing with the area.

    Args:
        gradient: gives that of fields on the cloud as it was, if it is needed.
    """
    on = cloud.active
    only = lambda new, old: new if on is None else jnp.where(on[:, None], new, old)
    points, spacing = only(points, cloud.points), cloud.spacing
    finite(points, "points", on)
    if normals is None or spacing is not None:
        ahead, stretch = carried(gradient(), cloud.normals, cloud.points, points)
        normals = only(ahead, cloud.normals) if normals is None else normals
        spacing = None if spacing is None else spacing * stretch ** (1 / (cloud.dim - 1))
    return PointCloud(points, normals, boundary=cloud.boundary, active=on, spacing=spacing)


@sized_jit
def carried(gradient, normals, before, after):
    """Normals carried along by a motion of the points, and the factor it stretches areas by.

    The gradient of the positions takes a tangent to itself but for its error, $F_0 t = A t + s n$.
    So does that of the new positions, with the images in place of t and n; which A and s then tell.
    """
    on, dim = gradient.active, normals.shape[1]
    normals = switched_off(on, normals, np.eye(dim)[0])
    tangents = frames_of(normals)[:, :-1]
    # Far from the origin round-off would be of the size of the way there.
    at = 0 if on is None else jnp.argmax(on)
    points = jnp.stack([x - jax.lax.stop_gradient(x[at]) for x in (before, after)], axis=1)
    along = lambda a, b: jnp.sum(a * b, axis=-1)
    images = along(gradient(switched_off(on, points))[:, :, None], tangents[:, None, :, None])
    # A switched-off point stays as it is.
    image, new = (switched_off(on, images[:, i], tangents) for i in (0, 1))
    a = along(image[:, :, None], tangents[:, None])
    s = along(image, normals[:, None])
    # The normal of the tangents $A^{-1} (t - s n)$ there is linear in n.
    if dim == 2:
        size = a[:, 0, 0]
        lean = lambda n: -s * crossed(n[:, None])
    else:
        size = a[:, 0, 0] * a[:, 1, 1] - a[:, 0, 1] * a[:, 1, 0]
        axis = s[:, :1] * new[:, 1] - s[:, 1:] * new[:, 0]
        lean = lambda n: jnp.cross(axis, n)
    upright = crossed(new)

    # Where nothing moves they stay as they are, however large that error is.
    def turn(_, found):
        normal, length = found
        ahead = normal * (length if dim == 2 else jnp.sqrt(length))[:, None]
        normal = (upright + lean(ahead)) / size[:, None]
        length = jnp.sqrt(jnp.sum(normal**2, axis=1))
        return normal / jnp.where(length > 0, length, 1)[:, None], length

    start = normals.astype(jnp.result_type(normals, upright)), jnp.ones_like(size)
    return jax.lax.fori_loop(0, _TURNS, turn, start)


def crossed(tangents):
    """The normal of a plane or line of tangents, as long as they are large."""
    if tangents.shape[1] == 1:
        return jnp.stack([-tangents[:, 0, 1], tangents[:, 0, 0]], axis=1)
    return jnp.cross(tangents[:, 0], tangents[:, 1])


@host_jit
def judged(cloud, neighbors, residual):
    """Codes of points: not finite, folded, degenerate."""
    xp = namespace(residual)
    ill = ~xp.all(xp.isfinite(cloud.points) & xp.isfinite(cloud.normals), axis=1)
    poor = ~(residual < residual_tolerance(residual.dtype))
    code = xp.where(ill, 1, xp.where(folded(cloud, neighbors), 2, xp.where(poor, 3, 0)))
    return xp.where(neighbors.mask[:, 0], code, 0)


@host_jit
def folded(cloud, neighbors):
    """Whether the normal of a neighbour next to a point points to the other side."""
    normals, xp = cloud.normals, namespace(cloud.normals)

    def opposite(found, slot):
        index, used = slot
        return found | (used & (xp.sum(normals[index] * normals, axis=1) < 0))

    # Of those farther away, other lists would leave out what has turned.
    ring = first_ring(neighbors, cloud.points.shape[1])
    return _over_slots(opposite, xp.zeros(len(normals), bool), ring)


def _over_slots(f: Callable, start, lists):
    """What is left of a start after all slots of the lists, one after another."""
    slots = (lists.indices.T, lists.mask.T)
    if namespace(lists.mask) is np:
        return functools.reduce(f, zip(*slots), start)
    return jax.lax.scan(lambda found, slot: (f(found, slot), None), start, slots)[0]


@host_jit
def unreached(before, after, neighbors, share=_SKIN):
    """Whether points outside a list may have come nearer than a share of the way to its farthest.

    They were at least as far as the farthest of the list. They came nearer by no other factor
    than those that are nearly as far, if the motion is smooth.
    """
    xp = namespace(after)

    def distances(slot):
        index, used = slot
        return tuple(xp.where(used, xp.sqrt(_squared(x, index)), 0) for x in (before, after))

    slots = (neighbors.indices.T, neighbors.mask.T)
    old, new = distances(slots) if xp is np else jax.lax.map(distances, slots)
    farthest = xp.max(old, axis=0)
    outer = (old > 0.5 * farthest) & (old > 0)
    stretch = xp.min(xp.where(outer, new / xp.where(outer, old, 1), xp.inf), axis=0)
    return stretch * farthest < share * xp.max(new, axis=0)


def _squared(x, index):
    """Squares of distances to other points, `(*slots, n)`."""
    if namespace(x) is np:  # which goes through long axes much faster than through short ones
        return sum((a[index] - a) ** 2 for a in np.ascontiguousarray(x.T))
    return jnp.sum((x[index] - x) ** 2, axis=-1)


@host_jit
def code_of(cloud, neighbors, found_at, found, residual):
    """Codes of points, also of lists that no longer reach and of what was found with these."""
    xp, code = namespace(residual), judged(cloud, neighbors, residual)
    if found_at is not None:
        code = xp.where((code == 0) & unreached(found_at, cloud.points, neighbors), 4, code)
    if found is not None:
        code = xp.where((found > 0) & ((code == 0) | (code > 2)), found, code)
    return code


@sized_jit
def stretch(before, after, neighbors):
    """By which factor neighbourhoods have grown, and the least by which two points came apart.

    The root of mean squared distances, and the least of all; 1 of points without neighbours.
    """

    def squared(found, slot):
        index, used = slot
        old, new = (jnp.sum((x[index] - x) ** 2, axis=1) for x in (before, after))
        sums = (sum_ + jnp.where(used, d, 0) for sum_, d in zip(found, (old, new)))
        least = jnp.where(used & (old > 0), new / jnp.where(old > 0, old, 1), 1)
        return (*sums, jnp.minimum(found[2], least)), None

    zero = jnp.zeros(len(after), after.dtype)
    slots = (neighbors.indices.T, neighbors.mask.T)
    old, new, least = jax.lax.scan(squared, (zero, zero, zero + 1), slots)[0]
    grown = jnp.where(old > 0, jnp.sqrt(new / jnp.where(old > 0, old, 1)), 1)
    return grown, jnp.sqrt(least)


def raise_for(code: np.ndarray) -> None:
    """Raise a ValueError that names the first point of the least code above 0."""
    least = np.min(code, where=code > 0, initial=max(CODES))
    raise_at(code == least, f"point {{i}}: {CODES[int(least)]}", code)
