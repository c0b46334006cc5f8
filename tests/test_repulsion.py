"""Balls that touch a surface: repulsion of a surface from itself, least size of features."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxsurf as js

from .helpers import central_difference

pytestmark = pytest.mark.slow

_GAPS = 0.3, 0.15, 0.075


@functools.cache
def surface(n=400, *radii):
    cloud = js.torus(n, *radii) if radii else js.sphere(n)
    return js.discretize(cloud, method=js.GFDM(degree=2))


def moved(s, map):
    x = s.cloud.points
    return s.moved(jax.vmap(map)(x))


@pytest.mark.parametrize("power", [4, 6])
def test_energy_of_spheres(power):
    """Every ball through two points of a sphere that touches it there is the sphere itself."""
    for n, a in ((200, 1.0), (800, 1.5)):
        ball = surface(n).moved(a * surface(n).cloud.points, surface(n).cloud.normals)
        found = js.tangent_point_energy(ball, power=power) * (2 * a) ** power
        area, cells = 4 * np.pi * a**2, float(jnp.sum(ball.areas**2))
        np.testing.assert_allclose(found, ball.areas.sum() ** 2 - cells, rtol=1e-9)
        np.testing.assert_allclose(found, area**2, rtol=1.2 / n)


def test_energy_of_a_torus_is_of_second_order():
    """Against the trapezoidal rule on a fine grid of angles, seen from one meridian."""
    R, r, m = 1.0, 0.5, 400
    u, v = np.meshgrid(2 * np.pi * (np.arange(m) + 0.5) / m, 2 * np.pi * np.arange(m) / m)
    point = lambda u, v: (
        (R + r * np.cos(v)) * np.cos(u),
        (R + r * np.cos(v)) * np.sin(u),
        r * np.sin(v),
    )
    y, weight = np.stack(point(u, v), -1), r * (R + r * np.cos(v)) * (2 * np.pi / m) ** 2
    exact = 0.0
    for angle in 2 * np.pi * np.arange(m)[::4] / m:
        x = np.array(point(0.0, angle))
        normal = np.array([np.cos(angle), 0, np.sin(angle)])
        ratio = ((x - y) @ normal) ** 2 / np.sum((x - y) ** 2, -1) ** 2
        exact += np.sum(ratio**3 * weight) * r * (R + r * np.cos(angle)) * 4 * 2 * np.pi / m
    exact *= 2 * np.pi
    errors = np.array([
        abs(js.tangent_point_energy(surface(n, R, r)) / exact - 1) for n in (500, 2_000)
    ])  # fmt: skip
    assert errors[1] < 5e-3 and np.log2(errors[0] / errors[1]) > 1.6, errors


def test_energy_grows_as_a_surface_comes_to_touch_itself():
    """A torus whose hole closes to a half, twice: in the end the energy is as its width ** -3."""
    wide, narrow, slit = (js.tangent_point_energy(surface(3_000, 1.0, 1 - g)) for g in _GAPS)
    assert narrow > 4 * wide and slit > 5 * narrow, (wide, narrow, slit)


def test_medial_radii_in_closed_form():
    """Of a torus the tube, or half of its hole; of spheroids the smallest radius of curvature."""
    for n, bound in ((500, 0.06), (2_000, 0.03)):
        for radii, exact in (((1.0, 0.4), 0.4), ((1.0, 0.7), 0.3)):
            found = float(js.medial_radius(surface(n, *radii)).min())
            assert exact * (1 - 1e-9) <= found <= exact * (1 + bound), (n, radii, found)
    axes = jnp.array([1.0, 1.0, 1.5])
    x = surface(1_000).cloud.points
    normals = x / axes
    spheroid = surface(1_000).moved(
        axes * x, normals / jnp.linalg.norm(normals, axis=1, keepdims=True)
    )
    found = js.medial_radius(spheroid)
    tip = jnp.argmax(jnp.abs(x[:, 2]))
    np.testing.assert_allclose(found[tip], 1 / 1.5, rtol=0.03)


def test_gaps_between_parts_count_on_both_sides():
    x, normals = surface().cloud.points, surface().cloud.normals
    two = js.PointCloud(
        jnp.concatenate([x, x + jnp.array([2.3, 0, 0])]), jnp.concatenate([normals, normals])
    )
    found = js.medial_radius(js.discretize(two, method=js.GFDM(degree=2)))
    assert 0.15 <= float(found.min()) < 0.17 and float(found.max()) <= 1 + 1e-9


def numbers(points):
    s = surface().moved(points)
    return jnp.stack([js.tangent_point_energy(s), jnp.mean(1 / js.medial_radius(s)[::3])])


def test_derivatives():
    """In points and the normals that they carry, both modes, beside differences."""
    x = surface().cloud.points * jnp.array([1.0, 0.9, 1.2])
    direction = jnp.stack([jnp.sin(2 * x[:, 1]), x[:, 0] * x[:, 2], jnp.cos(x[:, 0])], axis=1)
    along = lambda t: numbers(x + t * direction)
    forward = jax.jvp(along, (0.0,), (1.0,))[1]
    wanted = central_difference(along, 0.0, 1.0, step=1e-5)
    np.testing.assert_allclose(forward, wanted, rtol=1e-6)
    weights = jnp.array([0.3, 1.0])
    reverse = jax.grad(lambda points: weights @ numbers(points))(x)
    np.testing.assert_allclose(jnp.vdot(reverse, direction), weights @ forward, rtol=1e-9)


def test_compiled_mapped_and_in_single_precision():
    sizes = jnp.array([1.0, 2.0])
    x = surface().cloud.points
    both = jax.jit(jax.vmap(lambda a: numbers(a * x)))(sizes)
    alone = jnp.stack([numbers(a * x) for a in sizes])
    np.testing.assert_allclose(both, alone, rtol=1e-9)
    np.testing.assert_allclose(both[0], both[1] * jnp.array([4.0, 2.0]), rtol=1e-6)
    single = lambda a: a.astype(jnp.float32)
    cloud = js.PointCloud(single(x), single(surface().cloud.normals))
    ball = js.discretize(cloud, surface().neighbors, method=js.GFDM(degree=2))
    found = jnp.stack([js.tangent_point_energy(ball), jnp.mean(1 / js.medial_radius(ball)[::3])])
    assert found.dtype == jnp.float32
    np.testing.assert_allclose(found, numbers(x), rtol=1e-3)


def test_switched_off_points_have_no_part():
    cloud = surface().cloud
    on = jnp.arange(400) % 3 > 0
    masked = js.PointCloud(jnp.where(on[:, None], cloud.points, jnp.nan), cloud.normals, active=on)
    alone = js.PointCloud(cloud.points[on], cloud.normals[on])
    masked, alone = (js.discretize(c, method=js.GFDM(degree=2)) for c in (masked, alone))
    np.testing.assert_allclose(
        js.tangent_point_energy(masked), js.tangent_point_energy(alone), rtol=1e-9
    )
    radii = js.medial_radius(masked)
    np.testing.assert_allclose(radii[on], js.medial_radius(alone), rtol=1e-12)
    assert bool(jnp.isinf(radii[~on]).all())


def test_no_part_of_the_plane_bends():
    flat = js.graph(lambda x, y: 0 * x, 200)
    s = js.discretize(flat, method=js.GFDM(degree=2))
    assert bool(jnp.isinf(js.medial_radius(s)).all()) and js.tangent_point_energy(s) == 0
