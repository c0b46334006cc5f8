r"""How near a surface comes to itself: what keeps it from touching, and parts from becoming thin.

Both look at the balls that touch the surface at one point x and pass through another, y. Their
radius is $|x - y|^2 / (2\,|n(x) \cdot (x - y)|)$, small where the surface bends and where y is
close to x but far along it.
"""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
from jax.lax import stop_gradient
from jaxtyping import Array, Float

from ..arguments import instance, switched_off, whole
from ..compiling import in_batches
from ..discretization import Discretization
from ..machine import PAIRS, block_of_pairs


def tangent_point_energy(surface: Discretization, *, power: int = 6) -> Float[Array, ""]:
    r"""Repulsion of a surface from itself, $\iint \bigl(|n(x)\cdot(x-y)| / |x-y|^2\bigr)^p dy\,dx$.

    Each pair of points counts by the p-th power of half the curvature of the ball that touches the
    surface at x and passes through y. In space for $p \ge 6$, in the plane for $p \ge 4$, the
    energy grows without bound as the surface comes to touch itself, so that a search that minimises
    it beside something else never does. It costs $n^2$ operations.

    Args:
        surface: from `js.discretize`.
        power: p, even, at least 2.

    Returns:
        In length^(2(d-1) - p); of a sphere of radius a $(4\pi a^2)^2 / (2a)^p$.

    Accuracy: error $O(h^2)$, for want of the pairs within one cell (1/n of the whole on a sphere);
        in float32 as there (`tests/test_repulsion.py`).
    Differentiable: forward and reverse, in points and normals; reverse mode goes block by block.
    Raises:
        TypeError: what is no discretisation, a power that is no whole number.
        ValueError: a power below 2 or odd.
    Source: Yu, Brakensiek, Schumacher and Crane 2021, Repulsive Surfaces, eq. 2.

    Example:
        >>> surface = js.discretize(js.sphere(500), method=js.GFDM(degree=2))
        >>> bool(abs(js.tangent_point_energy(surface) / (jnp.pi**2 / 4) - 1) < 0.01)
        True
    """
    instance(surface, Discretization, "surface", "js.discretize(cloud) makes one")
    if whole(power, "power", least=2) % 2:
        raise ValueError(f"power = {power}, an even number is needed")
    seen = surface.cloud.seen
    return _energy(seen.points, seen.normals, surface.areas, int(power))


@functools.partial(jax.jit, static_argnums=3)
def _energy(x, normals, areas, power: int):
    def seen_from(one):
        i, point, normal, area = one
        return area * (_bends(i, point, normal, x) ** (power // 2) @ areas)

    # Recomputed in reverse mode: nothing of the size of all pairs is kept.
    each = (jnp.arange(len(x)), x, normals, areas)
    rows = in_batches(jax.checkpoint(seen_from), each, block_of_pairs(PAIRS))
    return jnp.sum(rows) / 2**power


def medial_radius(surface: Discretization) -> Float[Array, " n"]:
    r"""Radius of the largest balls that touch a surface at each point and hold none of it inside.

    $r(x) = \min_y |x - y|^2 / (2\,|n(x)\cdot(x - y)|)$, on either side. Their centres are the
    medial axis; the least r is the reach: less than any radius of curvature and than half of any
    gap or thickness. As a constraint it sets a least size of features:

        inequalities={"thick": lambda surface: 1 - js.medial_radius(surface) / 0.1}

    Args:
        surface: from `js.discretize`.

    Returns:
        `(n,)` in units of length; infinite where all of a surface with a border lies in the tangent
        plane, and at switched-off points. It costs $n^2$ operations.

    Accuracy: never less than that of the surface, as y is one of the points; more by $O(h)$
        (`tests/test_repulsion.py`). In float32 within 1e-3 of that in double precision.
    Differentiable: forward and reverse, in points and normals, for fixed y.
    Raises:
        TypeError: what is no discretisation.
    Source: Federer 1959, Curvature Measures, theorem 4.18 (the reach).

    Example:
        >>> surface = js.discretize(js.torus(1_000, 1.0, 0.4), method=js.GFDM(degree=2))
        >>> bool(abs(js.medial_radius(surface).min() - 0.4) < 0.01)
        True
    """
    instance(surface, Discretization, "surface", "js.discretize(cloud) makes one")
    on, seen = surface.cloud.active, surface.cloud.seen
    radius = _radius(seen.points, seen.normals, on)
    return switched_off(on, radius, jnp.inf)


@jax.jit
def _radius(x, normals, on):
    fixed = stop_gradient(x)
    other = lambda one: jnp.argmax(switched_off(on, _bends(one[0], one[1], one[2], fixed), -1))
    each = (jnp.arange(len(x)), fixed, stop_gradient(normals))
    apart = x[in_batches(other, each, block_of_pairs(PAIRS))] - x
    squared = _squared(jnp.sum(apart * normals, axis=1), jnp.sum(apart**2, axis=1))
    plane = squared == 0
    return jnp.where(plane, jnp.inf, 1 / jnp.sqrt(jnp.where(plane, 1, squared)))


def _bends(i, point, normal, x) -> Float[Array, " n"]:
    """Squares of the curvatures of balls that touch at point i and pass through others."""
    apart = x - point
    # Not by distance: the compiler may find the same point twice, and differently rounded.
    same = jnp.arange(len(x)) == i
    return jnp.where(same, 0, _squared(apart @ normal, jnp.sum(apart**2, axis=1)))


def _squared(height, distance):
    """Of the curvature of a ball; 0 where there is none, in switched-off rows say."""
    here = distance == 0
    return jnp.where(here, 0, (2 * height / jnp.where(here, 1, distance)) ** 2)
