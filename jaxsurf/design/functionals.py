r"""Numbers that belong to a shape: functions of a discretisation, differentiable in its geometry.

Many are a line with what a discretisation has already, and have no name here: the area
`surface.areas.sum()`, the total mean curvature `surface.integrate(surface.mean_curvature)`, and a
heat content is `surface.inner(w, u)` with u from `js.integrate`. Users' own are functions of a
discretisation too. Those that are energies, eigenvalues and compliance, are in `energies.py`.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.lax import stop_gradient
from jaxtyping import Array, Float, Int

from ..arguments import as_float, finite, instance, switched_off
from ..build import determined, residual_tolerance
from ..compiling import sized_jit
from ..curvature import mean_curvature
from ..discretization import Discretization
from ..failures import is_concrete, refuse, without_derivatives
from ..fits.monomials import polynomial_count
from ..frames import frames_of
from ..functions import constant
from ..interpolation import beyond, distance_and_reach, nearest_points, read_from
from ..motion import crossed
from ..stencils.gfdm import GFDM

# Neighbours for each unknown, without which polynomials of a higher degree are no better; and
# where all are on one side, without which they may not exist, as on lattices.
_ENOUGH, _ONE_SIDED = 2.5, 4.5
# Steps that lead to a foot, in the first of which the local polynomial is that of the point of the
# cloud next to it.
_STEPS, _FOLLOWED = 40, 10


def volume(surface: Discretization) -> Float[Array, ""]:
    r"""Volume inside a closed surface, $\frac1d \int_S (x - \bar x) \cdot n\,dS$; of a curve, area.

    Args:
        surface: from `js.discretize`, with normals outwards; negative where they point inwards.

    Accuracy: as `surface.integrate`, $O(h^{p+1})$; in float32 within 1 % on 60 points of a circle
        (`tests/test_functionals.py`).
    Differentiable: forward and reverse, in points and normals.
    Raises:
        TypeError: what is no discretisation.
        ValueError: a surface with a border.

    Example:
        >>> surface = js.discretize(js.sphere(500), method=js.GFDM(degree=4))
        >>> bool(abs(js.volume(surface) - 4 * jnp.pi / 3) < 1e-4)
        True
    """
    closed(surface)
    x, normals = surface.cloud.seen.points, surface.cloud.seen.normals
    height = jnp.sum((x - surface.mean(x)) * normals, axis=1)
    return surface.integrate(height) / surface.cloud.dim


def willmore_energy(surface: Discretization) -> Float[Array, ""]:
    r"""Willmore energy $\int_S H^2\,dS$, that of bending: $4\pi$ on spheres.

    Of a curve the integral of its squared curvature.

    With H of higher order than `surface.mean_curvature`. Curvature is a first derivative of the
    normals, and to these polynomials of even degree are no better on even points than those of
    the odd degree below: H comes from `GFDM` of the degree of the method, or one more if that is
    even, and there are neighbours for it (2.5 for each unknown, 4.5 on surfaces with a border; else
    as the method has it).

    Args:
        surface: from `js.discretize`.

    Accuracy: errors of value and derivative are $O(h^{p+1})$ with p that degree, or those of
        `surface.integrate`: with `js.GFDM(degree=4)` 1e-6 and 2.4e-5 on 2,000 points of a torus, a
        hundredth and a seventh of those of $H^2$ integrated
        (`tests/test_functionals.py::test_the_willmore_energy_on_the_torus`). In float32 as
        `volume`.
    Differentiable: forward and reverse, in points and normals.
    Raises:
        TypeError: what is no discretisation.
        ValueError: as `surface.areas` and `js.mean_curvature`.
    Source: Willmore 1965; as the energy of bending Helfrich 1973.

    Example:
        >>> surface = js.discretize(js.sphere(500), method=js.GFDM(degree=4))
        >>> bool(abs(js.willmore_energy(surface) - 4 * jnp.pi) < 1e-4)
        True
    """
    instance(surface, Discretization, "surface", "js.discretize(cloud) makes one")
    cloud, neighbors, degree = surface.cloud, surface.neighbors, surface.method.polynomial_degree
    odd = degree + 1 - degree % 2
    unknowns = polynomial_count(cloud.dim - 1, odd) - 1
    enough = _ENOUGH if surface.border is None else _ONE_SIDED
    if neighbors.k < enough * unknowns:
        return surface.integrate(surface.mean_curvature**2)
    return surface.integrate(mean_curvature(cloud, neighbors, method=GFDM(degree=odd)) ** 2)


def moments(surface: Discretization) -> tuple[Float[Array, " d"], Float[Array, "d d"]]:
    r"""Centroid $\bar x$ of a surface, and $\int_S (x - \bar x)(x - \bar x)^T dS$ about it.

    Args:
        surface: from `js.discretize`.

    Returns:
        Centroid `(d,)` in length, second moments `(d, d)` in length^(d+1). Divided by the area
        they are the covariance of a random point; $\operatorname{tr}(M) I - M$ is the tensor of
        inertia of a shell.

    Accuracy: as `surface.integrate`; in float32 as `volume` (`tests/test_functionals.py`).
    Differentiable: forward and reverse, in points and normals.
    Raises:
        TypeError: what is no discretisation.

    Example:
        >>> centroid, second = js.moments(js.discretize(js.sphere(500), method=js.GFDM(degree=4)))
        >>> bool(jnp.allclose(second, 4 * jnp.pi / 3 * jnp.eye(3), atol=1e-3))
        True
    """
    instance(surface, Discretization, "surface", "js.discretize(cloud) makes one")
    x = surface.cloud.seen.points
    centroid = surface.mean(x)
    about = x - centroid
    return centroid, surface.integrate(about[:, :, None] * about[:, None, :])


def chamfer_distance(surface: Discretization, targets: Float[Array, "m d"]) -> Float[Array, ""]:
    r"""Mean squared distances from the surface to the nearest of some points, and from these to it.

    $\frac1{|S|}\int_S \min_j |x - y_j|^2 dS + \frac1m \sum_j \min_i |x_i - y_j|^2$.

    Args:
        surface: from `js.discretize`.
        targets: points $y_j$, `(m, d)`.

    Accuracy: as `surface.integrate`; in float32 as `volume` (`tests/test_functionals.py`).
    Differentiable: forward and reverse, in points, normals and targets, for fixed nearest points.
    Raises:
        TypeError: what is no discretisation or array of numbers.
        ValueError: targets of another shape, none, or not finite.

    Example:
        >>> surface = js.discretize(js.sphere(500))
        >>> bool(js.chamfer_distance(surface, surface.cloud.points) == 0)
        True
    """
    instance(surface, Discretization, "surface", "js.discretize(cloud) makes one")
    targets = finite(as_float(targets, "targets", ("m", surface.cloud.dim)), "targets")
    if not len(targets):
        raise ValueError(f"targets have shape {targets.shape}, at least 1 point is needed")
    x, on = surface.cloud.points, surface.cloud.active
    seen = surface.cloud.seen.points
    there = seen - targets[nearest_points(targets, None, seen)]
    back = targets - x[nearest_points(x, on, targets)]
    squared = lambda v: jnp.sum(v**2, axis=1)
    return surface.mean(switched_off(on, squared(there))) + jnp.mean(squared(back))


def signed_distance(surface: Discretization, points: Float[Array, "m d"]) -> Float[Array, " m"]:
    r"""Distances of points from a closed surface, negative inside: $(y - f) \cdot n(f)$.

    The foot f of each point y is where $y - f$ is normal to the surface, next to the nearest point
    of the cloud; the surface there is a local polynomial, as by `surface.interpolate`. How far
    points are from a shape, `jnp.mean(js.signed_distance(surface, y) ** 2)` say, falls with the
    order of the operators, where `chamfer_distance` ends at the spacing.

    Args:
        surface: from `js.discretize`, closed, with normals outwards (inwards the sign turns).
        points: y, `(m, d)`, in the units of the surface. Their feet are found where they are
            nearer to the surface than to a centre of its curvature.

    Accuracy: error $O(h^{p+1})$ with p the polynomial degree of the method
        (`tests/test_functionals.py::test_signed_distances`); in float32 within 1e-5.
    Differentiable: forward and reverse, twice, in y and in points and normals of the surface, for
        fixed nearest points. The derivative in y is n.
    Raises:
        TypeError: what is no discretisation or array of numbers.
        ValueError: a surface with a border; points of another shape or not finite, or whose feet
            are not found (named by index): they lie farther from the cloud than its lists reach,
            or no way to the point is along the normal, as beyond a centre of curvature. Compiled,
            an error of the run time.

    Example:
        >>> surface = js.discretize(js.sphere(500), method=js.GFDM(degree=4))
        >>> found = js.signed_distance(surface, jnp.array([[0.0, 0.6, 0.8], [0.9, 0.0, 0.0]]))
        >>> bool(jnp.allclose(found, jnp.array([0.0, -0.1]), atol=1e-4))
        True
    """
    closed(surface)
    points = finite(as_float(points, "points", ("m", surface.cloud.dim)), "points")
    cloud, neighbors = surface.cloud.seen, surface.neighbors
    degree = surface.method.polynomial_degree
    known = (cloud, neighbors, points)
    seen = without_derivatives(known)
    fixed, lists, y = stop_gradient(seen if is_concrete(seen) else known)
    nearest = nearest_points(fixed.points, cloud.active, y)
    feet = constant(_feet(fixed, lists, y, nearest, degree))
    text = (
        "points: the foot of {i} is not found: it is {v:.3g} away from the nearest point of the "
        "cloud, whose neighbours reach {reach:.3g}"
    )
    points = refuse(
        points, beyond(feet.distance, feet.reach), text, feet.distance, reach=feet.reach
    )
    text = (
        "points: the foot of {i} is not found: the way to it leans {v:.3g} off the normal, at most "
        "{most:.1e} is allowed; it may be nearer to a centre of curvature than to the surface"
    )
    points = refuse(points, beyond(feet.left, feet.most), text, feet.left, most=feet.most)
    if is_concrete(known, feet):  # at the prompt nothing is read again
        return determined(feet.height, feet.residual, degree)
    f, n, tangents, _ = _above(cloud, neighbors, degree, feet.place, feet.center)
    # The place is fixed: what the way leans off the normal, zero here, has a second derivative.
    lean = jnp.einsum("mad,md->ma", tangents, points - f)
    return _along(points - f, n)[:, 0] + jnp.einsum("ma,mab,mb->m", lean, feet.bend, lean) / 2


class _Feet(NamedTuple):
    """Feet of points on a surface.

    Args:
        place: where they are looked up, over the tangent plane of a point of the cloud,
        center: this.
        left: how far the way to a point is off the normal at its foot, in length.
        most: what is allowed of it.
        distance: of a foot from the point of the cloud,
        reach: how far the list of that one reaches.
        residual: of the fit there.
        height: of the point above its foot.
        bend: second derivatives of the distance in what the way leans along the tangents.
    """

    place: Float[Array, "m d"]
    center: Int[Array, " m"]
    left: Float[Array, " m"]
    most: Float[Array, " m"]
    distance: Float[Array, " m"]
    reach: Float[Array, " m"]
    residual: Float[Array, " m"]
    height: Float[Array, " m"]
    bend: Float[Array, "m t t"]


@sized_jit
def _feet(cloud, neighbors, points, nearest, degree: int) -> _Feet:
    """By Newton's method over tangent planes, with differences of normals for the curvature."""
    small = jnp.finfo(points.dtype).eps ** (1 / 3)

    def nearer(state):
        feet, place, count = state
        # From one local polynomial to the next there is a step, over which feet may go for ever.
        again = nearest_points(cloud.points, cloud.active, place)
        center = jnp.where(count < _FOLLOWED, again, feet.center)
        tangents = _tangents(cloud, center)
        distance, reach = distance_and_reach(cloud, neighbors, place, center)
        beside = place + small * reach[:, None] * tangents
        look = lambda place: _above(cloud, neighbors, degree, place, center, check=False)
        # Together: what is looked up is compiled once.
        fs, ns, moved, residuals = jax.vmap(look)(jnp.concatenate([place[None], beside]))
        f, n, ns, moved, residual = fs[0], ns[0], ns[1:], moved[0], residuals[0]
        height = _along(points - f, n)
        off = points - f - height * n
        left = jnp.linalg.norm(off, axis=1)
        # The matrix of second derivatives of half the squared distance: positive at a minimum.
        bends = (ns - n) / (small * reach[:, None])
        matrix = jnp.einsum("amd,bmd->mab", bends, tangents) * height[:, :, None]
        matrix = matrix + jnp.eye(len(tangents), dtype=matrix.dtype)
        least = jnp.trace(matrix, axis1=1, axis2=2) > 0
        least &= jnp.linalg.det(matrix) > 0
        step = jnp.linalg.solve(matrix, jnp.einsum("amd,md->ma", tangents, off)[..., None])
        step = jnp.einsum("ma,amd->md", step[..., 0], tangents)
        step = jnp.where(least[:, None], step, off)
        length = jnp.linalg.norm(step, axis=1)
        step = step * (reach / jnp.maximum(length, reach))[:, None]
        # Fits that are not determined are refused where they are read.
        good = residual < residual_tolerance(residual.dtype)
        most = jnp.where(good, jnp.finfo(f.dtype).eps ** 0.5 * reach, jnp.inf)
        left = jnp.where(least, left, jnp.linalg.norm(points - f, axis=1))
        bend = _bend(moved, bends, height[:, :, None])
        found = _Feet(place, center, left, most, distance, reach, residual, height[:, 0], bend)
        done = (found.left <= most)[:, None]
        return found, jnp.where(done, place, f + step), count + 1

    def goes_on(state):
        feet, _, count = state
        return jnp.any(feet.left > feet.most) & (count < _STEPS)

    x = cloud.points[nearest]
    none = jnp.zeros_like(points[:, 0])
    count = points.shape[1] - 1
    bend = jnp.zeros((len(points), count, count), points.dtype)
    first = _Feet(points, nearest, none + jnp.inf, *(none,) * 5, bend)
    return jax.lax.while_loop(goes_on, nearer, (first, x, 0))[0]


def _tangents(cloud, center) -> Float[Array, "t m d"]:
    return jnp.moveaxis(frames_of(cloud.normals[center])[:, :-1], 1, 0)


def _bend(tangents, turns, height) -> Float[Array, "m t t"]:
    r"""$(g + h W)^{-1} W g^{-1}$ with g of the tangents, W of these and the turns of normals.

    A point at height h and, off its normal, at $\tau$ is $h + \tau^2 / (2 (R + h))$ from a ball.
    """
    g = jnp.einsum("mad,mbd->mab", tangents, tangents)
    w = jnp.einsum("mad,bmd->mab", tangents, turns)
    return jnp.linalg.solve(g + height * w, jnp.linalg.solve(g, w.mT).mT)


def _above(cloud, neighbors, degree: int, place, center, *, check: bool = True):
    """The surface over some places, its unit normals, its tangents, residuals of the fits."""
    x = cloud.points
    read = lambda q: read_from(cloud, neighbors, degree, q, center, x, check=check)
    along = lambda t: jax.jvp(read, (place,), (t,))
    (f, residual), (moved, _) = jax.vmap(along, out_axes=((None, None), (1, None)))(
        _tangents(cloud, center)
    )
    n = crossed(moved)
    return f, n / jnp.linalg.norm(n, axis=1, keepdims=True), moved, residual


def _along(v, n):
    return jnp.sum(v * n, axis=1, keepdims=True)


def closed(surface):
    """Refuse what is no discretisation of a closed surface."""
    instance(surface, Discretization, "surface", "js.discretize(cloud) makes one")
    if surface.border is not None:
        count = len(surface.border.points)
        raise ValueError(f"surface has {count} points on its border, expected a closed one")
