"""Surfaces that pass through themselves."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

import jaxsurf as js
from jaxsurf.design.crossing import crosses
from jaxsurf.design.shape import unchecked_surface

pytestmark = pytest.mark.slow

METHOD = js.GFDM(degree=2)


@functools.cache
def rod():
    return js.discretize(js.ellipsoid(800, (0.35, 0.35, 2.0)), method=METHOD)


@functools.cache
def pair():
    """Two unit balls, a gap of 0.6 between them."""
    x = js.sphere(300).points
    shift = jnp.array([1.3, 0.0, 0.0])
    points, normals = jnp.concatenate([x - shift, x + shift]), jnp.concatenate([x, x])
    return js.discretize(js.PointCloud(points, normals), method=METHOD)


def bent(x, angle):
    """Along an arc: past a full turn the ends meet, and pass through each other."""
    radius = 4 / angle
    turn, out = x[2] / radius, radius - x[0]
    return jnp.array([radius - out * jnp.cos(turn), x[1], out * jnp.sin(turn)])


def nearer(x, theta):
    return x - jnp.sign(x[0]) * theta * jnp.array([1.0, 0.0, 0.0])


def crossed(f, surface, theta):
    cloud = unchecked_surface(js.MappedShape(f, surface), theta).cloud
    return bool(jax.jit(crosses)(cloud, surface.neighbors))


def test_what_crosses_and_what_is_only_near():
    for angle, found in ((1.0, False), (5.0, False), (5.8, False), (7.0, True), (8.9, True)):
        assert crossed(bent, rod(), jnp.array(angle)) == found, angle
    # Gaps of 0.6 less twice theta; the spacing is 0.2.
    for theta, found in ((0.0, False), (0.2, False), (0.25, False), (0.5, True), (0.9, True)):
        assert crossed(nearer, pair(), jnp.array(theta)) == found, theta


@pytest.mark.parametrize("turned", [False, True], ids=["outwards", "inwards"])
def test_closed_surfaces_do_not_cross(turned):
    phi, bounds = js.double_torus()
    double = js.level_set(phi, n=1_000, bounds=bounds)
    angle = np.linspace(0, 2 * np.pi, 80, endpoint=False)
    ring = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    curve = js.PointCloud(ring * (1 + 0.4 * np.cos(2 * angle))[:, None], ring)
    for cloud in (js.torus(600, 1.0, 0.7), double, js.circle(60), curve):
        near = js.find_neighbors(cloud, k=8)
        normals = -cloud.normals if turned else cloud.normals
        assert not bool(crosses(js.PointCloud(cloud.points, normals), near))


def test_switched_off_points_do_not_count():
    cloud = pair().cloud
    on = cloud.points[:, 0] < 0
    moved = jnp.where(on[:, None], cloud.points, cloud.points - jnp.array([1.5, 0.0, 0.0]))
    both, one = (js.PointCloud(moved, cloud.normals, active=a) for a in (None, on))
    assert bool(crosses(both, pair().neighbors)) and not bool(crosses(one, pair().neighbors))


def test_steps_that_cross_are_halved_and_the_last_good_shape_is_kept():
    """The tips of a rod want to go on past each other."""
    tips = jnp.argmax(rod().cloud.points[:, 2]), jnp.argmin(rod().cloud.points[:, 2])
    past = lambda s: s.cloud.points[tips[0], 2] - s.cloud.points[tips[1], 2]
    with pytest.raises(js.OptimizationError, match="passes through itself: the last good") as error:
        js.optimize_shape(
            past, js.MappedShape(bent, rod()), 4.0, optimizer=optax.sgd(0.3), steps=60
        )
    kept = error.value.solution
    assert not bool(crosses(kept.surface.cloud, kept.shape.base.neighbors))
    assert 5.5 < float(kept.theta) < 7.0


def test_a_start_that_crosses_is_refused():
    shape = js.MappedShape(nearer, pair())
    with pytest.raises(ValueError, match="at the first theta the surface passes through itself"):
        js.optimize_shape(
            lambda s: jnp.mean(s.cloud.points**2), shape, 0.7, optimizer=optax.sgd(0.1)
        )
