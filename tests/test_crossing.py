"""Surfaces that pass through themselves."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

import jaxsurf as js
from jaxsurf.design.crossing import crosses, pierces
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


@functools.cache
def sheet():
    """A long strip with a border, along z."""
    side = np.linspace(-0.5, 0.5, 11)
    x, z = np.meshgrid(side, np.linspace(-3, 3, 61), indexing="ij")
    inner = np.zeros(x.shape, bool)
    inner[1:-1, 1:-1] = True
    shake = np.random.default_rng(0).uniform(-0.02, 0.02, (2, *x.shape)) * inner
    points = np.stack([0 * x, x + shake[0], z + shake[1]], axis=-1).reshape(-1, 3)
    normals = np.broadcast_to([1.0, 0.0, 0.0], points.shape)
    cloud = js.PointCloud(points, normals, boundary=~inner.ravel())
    return js.discretize(cloud, method=METHOD)


def looped(x, turn):
    """The middle half along an arc, the ends straight on: past half a turn they draw nearer."""
    radius = 3 / turn
    along = jnp.clip(x[2], -1.5, 1.5)
    angle, on = along / radius, x[2] - along
    cos, sin = jnp.cos(angle), jnp.sin(angle)
    return jnp.array([radius * cos - on * sin, x[1], radius * sin + on * cos])


def rolled(x, turn):
    """Along an arc: after a full turn the two ends meet."""
    radius = 6 / turn
    return jnp.array([radius * jnp.cos(x[2] / radius), x[1], radius * jnp.sin(x[2] / radius)])


def test_borders_may_lie_anywhere_and_what_they_bound_cross():
    def pierced(f, theta):
        cloud = unchecked_surface(js.MappedShape(f, sheet()), jnp.array(theta)).cloud
        return bool(jax.jit(pierces)(cloud, sheet().neighbors))

    # The ends meet at 4.07; the spacing is 0.1.
    for turn, found in ((0.1, False), (3.5, False), (4.0, False), (4.3, True), (5.5, True)):
        assert pierced(looped, turn) == found, turn
    # Gaps of 1.5 to 0.05, side by side.
    for gap in (1.5, 0.5, 0.2, 0.1, 0.05):
        assert not pierced(rolled, 2 * np.pi * (1 - gap / 6)), gap


def test_steps_that_take_a_bordered_surface_through_itself_are_halved():
    gap = lambda s: s.cloud.points[60, 2] - s.cloud.points[0, 2]
    with pytest.raises(js.OptimizationError, match="passes through itself: the last good") as error:
        js.optimize_shape(
            gap, js.MappedShape(looped, sheet()), 3.0, optimizer=optax.sgd(0.1), steps=60
        )
    assert 3.5 < float(error.value.solution.theta) < 4.2
