"""Shapes with parameters: discretisations that follow them, harmonics, maps."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxsurf as js

from .helpers import central_difference, count_compilations

pytestmark = pytest.mark.slow

N = 300
BALL = jnp.zeros(25).at[0].set(np.sqrt(4 * np.pi))
STILL = (jnp.zeros(3), jnp.zeros(3))


@functools.cache
def ball():
    return js.discretize(js.sphere(N), method=js.GFDM(degree=2))


def random(tree, size, seed=0):
    """A direction: as the parameters, with entries of this size."""
    rng = np.random.default_rng(seed)
    return jax.tree.map(lambda a: jnp.asarray(size * rng.normal(size=jnp.shape(a))), tree)


def egg(x, axes):
    return jnp.sum((x / axes) ** 2) + 0.2 * jnp.sin(2 * x[0] + x[1]) - 1


def network():
    """A ball with a neural dent, and the parameters of the network."""
    mlp = eqx.nn.MLP(3, "scalar", 8, 2, activation=jnp.tanh, key=jax.random.key(0))
    theta, static = eqx.partition(mlp, eqx.is_inexact_array)
    theta = jax.tree.map(lambda a: a.astype(float), theta)
    return lambda x, theta: jnp.linalg.norm(x) - 1 + 0.1 * eqx.combine(theta, static)(x), theta


def affine(x, theta):
    return theta[0] @ js.rigid_motion(x, theta[1])


def cases():
    star = js.star_shape(ball(), 4)
    bumpy, axes = BALL.at[7].set(0.2), jnp.array([1.0, 0.95, 0.9])
    neural, weights = network()
    return {
        "level set": (js.LevelSetShape(egg, ball()), axes, 0.1),
        "neural level set": (js.LevelSetShape(neural, ball()), weights, 0.2),
        "star": (star, bumpy, 0.05),
        "map of a star": (js.MappedShape(affine, star), (bumpy, (jnp.eye(3), STILL)), 0.05),
        "free form": (
            js.NormalShape(ball()),
            0.1 * ball().cloud.points[:, 2],
            lambda theta: ball().cloud.points[:, 0] ** 2 + 0.5 * ball().cloud.points[:, 1],
        ),
    }


def numbers(surface):
    """Every operator and an integral, as numbers of the size of one."""
    x = ball().cloud.points
    u, w = jnp.exp(x[:, 0] + 0.5 * x[:, 1]), jnp.cos(x[:, 1] + 2 * x[:, 2]) + x[:, 0]
    return jnp.stack(
        [
            jnp.vdot(w, surface.laplacian(u)) / N,
            jnp.vdot(w, surface.gradient(u) @ jnp.array([1.0, 0.5, -0.3])) / N,
            jnp.vdot(w, surface.mean_curvature) / N,
            surface.integrate(w),
        ]
    )


@pytest.mark.parametrize(
    "name", ["level set", "neural level set", "star", "map of a star", "free form"]
)
def test_derivatives_are_differences_of_shapes_made_anew(name):
    """Operators and integrals in the parameters to 1e-6, on points that are projected again."""
    shape, theta, size = cases()[name]
    direction = size(theta) if callable(size) else random(theta, size)
    along = lambda t: numbers(shape(jax.tree.map(lambda a, b: a + t * b, theta, direction)))
    found = jax.jvp(along, (0.0,), (1.0,))[1]
    wanted = central_difference(along, 0.0, 1.0, step=1e-3)
    np.testing.assert_allclose(found, wanted, rtol=1e-6, atol=1e-7)


@pytest.mark.parametrize("method", [js.GFDM(degree=2), js.DCPSE(order=2)], ids=["GFDM", "DCPSE"])
def test_derivatives_of_every_operator_on_a_level_set(method):
    """Against differences of the same on points that are projected again, to 1e-6."""
    x = ball().cloud.points
    u, w = jnp.exp(x[:, 0] + 0.5 * x[:, 1]), jnp.cos(x[:, 1] + 2 * x[:, 2]) + x[:, 0]
    tangent = jnp.cross(jnp.array([0.3, -1.0, 0.5]), x)
    seen = {
        "Laplacian": lambda s: s.laplacian(u),
        "gradient": lambda s: s.gradient(u) @ jnp.array([1.0, 0.5, -0.3]),
        "divergence": lambda s: s.divergence(tangent),
        "direction": lambda s: s.directional_derivative(tangent)(u),
        "diffusion": lambda s: s.diffusion(1 + u**2)(w),
        "biharmonic": lambda s: s.biharmonic(u) / 100,
        "symmetric Laplacian": lambda s: s.symmetric_laplacian(u),
        "mean curvature": lambda s: s.mean_curvature,
        "Gauss curvature": lambda s: s.gauss_curvature,
        "principal curvatures": lambda s: jnp.sum(s.principal_curvatures[0] ** 3, axis=1),
        "areas": lambda s: N * s.areas,
        "cells": lambda s: N * s.cell_areas,
        "interpolation": lambda s: s.interpolate(u, s.cloud.points + 0.01 * tangent),
    }
    surface = js.discretize(js.sphere(N), method=method)
    shape, theta = js.LevelSetShape(egg, surface), jnp.array([1.0, 0.95, 0.9])
    direction = random(theta, 0.1)

    def along(t):
        moved = shape(theta + t * direction)
        return jnp.stack([jnp.vdot(w, f(moved)) / N for f in seen.values()])

    found = jax.jit(lambda: jax.jvp(along, (0.0,), (1.0,))[1])()
    wanted = central_difference(jax.jit(along), 0.0, 1.0, step=1e-3)
    off = np.abs(np.asarray(found - wanted))
    good = off <= 1e-6 * np.abs(np.asarray(wanted)) + 1e-7
    assert good.all(), dict(zip(seen, off))


def test_points_and_normals_are_those_of_the_shape():
    shape, theta, _ = cases()["level set"]
    cloud = shape(theta).cloud
    assert float(jnp.abs(jax.vmap(egg, (0, None))(cloud.points, theta)).max()) < 1e-14
    maps, (own, (matrix, motion)), _ = cases()["map of a star"]
    turn = (motion[0] + jnp.array([0.0, 0.0, jnp.pi / 2]), motion[1] + 1.0)
    before = maps.base(own).cloud
    after = maps((own, (2 * matrix, turn))).cloud
    x, y, z = before.points.T
    np.testing.assert_allclose(after.points, 2 * (jnp.stack([-y, x, z], 1) + 1), atol=1e-14)
    x, y, z = before.normals.T
    np.testing.assert_allclose(after.normals, jnp.stack([-y, x, z], 1), atol=1e-14)
    ellipsoid = js.MappedShape(lambda x, axes: axes * x, ball())(jnp.array([1.0, 0.8, 0.7])).cloud
    exact = js.level_set_normals(egg_without_dent, ellipsoid.points)
    np.testing.assert_allclose(ellipsoid.normals, exact, atol=1e-13)


def egg_without_dent(x):
    return jnp.sum((x / jnp.array([1.0, 0.8, 0.7])) ** 2) - 1


def test_compiled_once_mapped_and_on_the_same_lists():
    """Other parameters and weights compile nothing; a batch has what each has alone."""
    shape, theta, _ = cases()["neural level set"]
    program = jax.jit(lambda theta: shape(theta).laplacian(ball().cloud.points[:, 0]))
    other = jax.tree.map(lambda a: 1.1 * a, theta)
    found = [program(theta)]
    with count_compilations() as names:
        found.append(program(other))
    assert not names, names
    both = jax.tree.map(lambda a, b: jnp.stack([a, b]), theta, other)
    mapped = jax.vmap(lambda t: shape(t).laplacian(ball().cloud.points[:, 0]))(both)
    np.testing.assert_allclose(mapped, jnp.stack(found), rtol=1e-9, atol=1e-9)
    assert shape(theta).neighbors is ball().neighbors


def test_what_does_not_reach_the_level_set_has_a_code():
    shape = js.LevelSetShape(lambda x, level: x @ x + level, ball())
    assert set(np.asarray(jax.jit(lambda a: shape(a).code)(1.0))) == {1}
    assert set(np.asarray(jax.jit(lambda a: shape(a).code)(-1.5))) == {0}


def test_harmonics_are_orthonormal_and_harmonic():
    r"""By Gauss's quadrature; $r^l Y_{lm}$ is harmonic, at the poles too."""
    degree = 6
    z, weight = np.polynomial.legendre.leggauss(degree + 1)
    angle = np.arange(2 * degree + 2) * np.pi / (degree + 1)
    ring = np.sqrt(1 - z**2)[:, None]
    x = np.stack([ring * np.cos(angle), ring * np.sin(angle), z[:, None] + 0 * angle], axis=-1)
    y = np.asarray(js.spherical_harmonics(jnp.asarray(x), degree)).reshape(-1, (degree + 1) ** 2)
    area = np.repeat(weight * np.pi / (degree + 1), len(angle))
    np.testing.assert_allclose(y.T @ (area[:, None] * y), np.eye(y.shape[1]), atol=1e-13)

    def solid(x):
        r = jnp.linalg.norm(x)
        powers = np.repeat(np.arange(degree + 1), 2 * np.arange(degree + 1) + 1)
        return js.spherical_harmonics(x / r, degree) * r**powers

    for point in ([0.0, 0.0, 1.0], [0.3, -0.5, 0.8]):
        hessian = jax.jit(jax.hessian(solid))(jnp.array(point))
        assert float(jnp.abs(jnp.trace(hessian, axis1=1, axis2=2)).max()) < 1e-10


def padded():
    """The ball with 20 rows that are switched off, in which no number stands."""
    cloud, off = ball().cloud, jnp.full((20, 3), jnp.nan)
    rows = [jnp.concatenate([a, off]) for a in (cloud.points, cloud.normals)]
    return js.PointCloud(*rows, active=jnp.arange(N + 20) < N)


@pytest.mark.parametrize("name", ["star", "map", "level set"])
def test_switched_off_points_have_no_part_in_derivatives(name):
    """Whatever stands there, and where the map has none at the origin: those of the others."""
    cloud, part = ball().cloud, padded()
    unit = lambda x, a: a[0] * x / jnp.linalg.norm(x)
    make, theta = {
        "star": (lambda surface: js.star_shape(surface, 4), BALL.at[7].set(0.2)),
        "map": (lambda surface: js.MappedShape(unit, surface), jnp.array([1.5])),
        "level set": (lambda surface: js.LevelSetShape(egg, surface), jnp.array([1.0, 0.95, 0.9])),
    }[name]
    shape = lambda cloud: make(js.discretize(cloud, method=js.GFDM(degree=2)))
    slopes = lambda shape: jax.grad(lambda t: js.volume(shape(t)))(theta)
    found, wanted = slopes(shape(part)), slopes(shape(cloud))
    np.testing.assert_allclose(found, wanted, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("start", [None, 0.0])
def test_free_forms_have_no_derivative_in_displacements_of_switched_off_points(start):
    """Zero, not NaN: an optimisation of all rows could not begin."""
    far = 0.1 * ball().cloud.points[:, 2]
    surface = js.discretize(padded(), method=js.GFDM(degree=2))
    theta = jnp.concatenate([far, jnp.full(20, jnp.nan)])
    shape = js.NormalShape(surface, start if start is None else start * theta)
    slopes = lambda shape, theta: jax.grad(lambda t: js.volume(shape(t)))(theta)
    found, wanted = slopes(shape, theta), slopes(js.NormalShape(ball()), far)
    np.testing.assert_allclose(found[:N], wanted, rtol=1e-9, atol=1e-9)
    assert not found[N:].any()


def test_rotations_are_smooth_at_none():
    turn = lambda a: js.rigid_motion(jnp.array([1.0, 2.0, 3.0]), (a, jnp.zeros(3)))
    slope = jax.jacfwd(turn)(jnp.zeros(3))
    np.testing.assert_allclose(slope, [[0, 3, -2], [-3, 0, 1], [2, -1, 0]], atol=1e-14)
    plane = lambda a: js.rigid_motion(jnp.array([1.0, 0.0]), (a, jnp.zeros(2)))
    np.testing.assert_allclose(plane(jnp.array(np.pi / 3)), [0.5, np.sqrt(0.75)], atol=1e-14)
    both = jax.jit(jax.vmap(turn))(jnp.array([[0.0, 0.0, np.pi], [0.0, 0.0, 0.0]]))
    np.testing.assert_allclose(both, [[-1, -2, 3], [1, 2, 3]], atol=1e-14)


@pytest.mark.parametrize("angle", [1e3, 1e6, 1e9])
def test_rotations_by_many_turns(angle):
    x = jnp.array([1.0, 2.0, 3.0])
    turned = js.rigid_motion(x, (jnp.array([0.0, 0.0, angle]), jnp.zeros(3)))
    cos, sin = np.cos(angle), np.sin(angle)
    exact = [cos - 2 * sin, sin + 2 * cos, 3]
    # An angle is known to its round-off.
    np.testing.assert_allclose(turned, exact, atol=1e-14 * angle)


def test_single_precision():
    single = lambda tree: jax.tree.map(lambda a: a.astype(jnp.float32), tree)
    cloud = js.PointCloud(single(ball().cloud.points), single(ball().cloud.normals))
    surface = js.discretize(cloud, ball().neighbors, method=js.GFDM(degree=2))
    theta = single(BALL.at[7].set(0.2))
    star = js.star_shape(surface, 4)
    turned = js.MappedShape(js.rigid_motion, star)(((theta), single(STILL))).cloud
    level = js.LevelSetShape(egg, surface)(single(jnp.array([1.0, 0.95, 0.9]))).cloud
    free = js.NormalShape(surface)(jnp.full(N, 0.1, jnp.float32)).cloud
    for found, name in ((turned, "star"), (level, "level set")):
        shape, theta, _ = cases()[name]
        assert found.points.dtype == found.normals.dtype == jnp.float32
        np.testing.assert_allclose(found.points, shape(theta).cloud.points, atol=1e-5)
        np.testing.assert_allclose(found.normals, shape(theta).cloud.normals, atol=1e-5)
    assert free.points.dtype == jnp.float32
