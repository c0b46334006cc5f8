"""Gradients that are smooth along a surface."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

import jaxsurf as js

from .helpers import count_compilations

pytestmark = pytest.mark.slow


@functools.cache
def ball(n=400):
    return js.discretize(js.sphere(n), method=js.GFDM(degree=2))


def smoothed(surface, g, length):
    transformation = js.sobolev_gradient(surface, length)
    return transformation.update(g, transformation.init(g))[0]


def test_harmonics_fall_by_their_eigenvalues():
    r"""Y of degree l becomes $Y / (1 + \ell^2 l (l + 1))$, of second order in the spacing."""
    length, errors = 0.5, []
    for n in (400, 1_600):
        x, mass = ball(n).cloud.points, ball(n).cell_areas
        y = js.spherical_harmonics(x, 3)[:, [2, 6, 12]]
        exact = y / (1 + length**2 * np.array([2.0, 6.0, 12.0]))
        found = smoothed(ball(n), mass[:, None] * y, length)
        errors.append(float(jnp.linalg.norm(found - exact) / jnp.linalg.norm(exact)))
    assert errors[1] < 5e-3 and np.log2(errors[0] / errors[1]) > 1.6, errors


def test_it_is_the_gradient_in_the_sobolev_inner_product():
    r"""$\sum m (s v - \ell^2 s \Delta v) = \sum g v$ for any v, so s points downhill."""
    rng = np.random.default_rng(0)
    g, v = jnp.asarray(rng.normal(size=(2, 400)))
    length = 0.4
    s = smoothed(ball(), g, length)
    mass, laplacian = ball().cell_areas, ball().symmetric_laplacian
    np.testing.assert_allclose(mass @ (s * (v - length**2 * laplacian(v))), g @ v, rtol=1e-4)
    assert float(g @ s) > 0


def test_points_are_held():
    """The gradient among fields that are zero there; a mode of a square, zero on its rim."""
    square = js.discretize(js.graph(lambda x, y: 0 * x, (21, 21)), method=js.GFDM(degree=2))
    x, y, _ = np.asarray(square.cloud.points).T
    border, length = np.asarray(square.cloud.boundary), 0.4
    side = x.max() - x.min()
    mode = jnp.asarray(np.cos(np.pi * x / side) * np.cos(np.pi * y / side))
    hold = lambda held: js.sobolev_gradient(square, length, held=held)
    smooth = hold(border)
    s, _ = smooth.update(square.cell_areas * mode, smooth.init(mode))
    np.testing.assert_array_equal(s[border], 0)
    np.testing.assert_allclose(s, mode / (1 + 2 * (length * np.pi / side) ** 2), atol=5e-3)
    rng = np.random.default_rng(0)
    g, v = jnp.asarray(rng.normal(size=(2, square.n)))
    some = np.flatnonzero(border & (x < 0))
    for held in (border, some):
        smooth = hold(held)
        s, _ = smooth.update(g, smooth.init(g))
        v = v.at[held].set(0)
        product = square.cell_areas @ (s * (v - length**2 * square.symmetric_laplacian(v)))
        np.testing.assert_allclose(product, g @ v, rtol=1e-4)
        assert float(g @ s) > 0


def test_a_held_border_needs_no_halved_steps():
    """Least area over a saddle's border, from a bump: steps that a projection makes go uphill."""
    surface = js.discretize(js.graph(lambda x, y: 0.2 * x * y, (15, 15)), method=js.GFDM(degree=2))
    x, y, _ = surface.cloud.points.T
    border = np.asarray(surface.cloud.boundary)
    bump = 0.05 * jnp.cos(np.pi * x / (2 * x.max())) * jnp.cos(np.pi * y / (2 * y.max()))
    smooth = js.sobolev_gradient(surface, 0.3, held=border)
    found = js.optimize_shape(
        lambda surface: surface.areas.sum(),
        js.NormalShape(surface),
        jnp.where(border, 0, bump),
        optimizer=optax.chain(smooth, optax.sgd(0.05)),
        project=lambda theta: jnp.where(border, 0, theta),
        steps=30,
        throw=False,
    )
    assert found.history["refused"].sum() == 0 and (np.diff(found.history["objective"]) < 0).all()
    np.testing.assert_array_equal(found.theta[border], 0)


def area_and_volume(surface):
    return surface.areas.sum() + 30 * (js.volume(surface) / (4 * jnp.pi / 3) - 1) ** 2


def test_bumps_are_smoothed_in_free_form_and_nothing_is_compiled_between_steps():
    """Least area with a penalty on the volume: a ball, wherever its centre has come to."""
    x = ball().cloud.points
    start = 0.1 * jnp.sin(4 * x[:, 0]) * jnp.cos(3 * x[:, 1])
    seen = []
    with count_compilations() as names:
        found = js.optimize_shape(
            area_and_volume,
            js.NormalShape(ball()),
            start,
            optimizer=optax.chain(js.sobolev_gradient(ball(), 0.3), optax.sgd(0.05)),
            steps=60,
            callback=lambda now: seen.append(len(names)),
            throw=False,
        )
    points = found.surface.cloud.points
    radii = jnp.linalg.norm(points - found.surface.mean(points), axis=1)
    assert found.converged and float(radii.std()) < 0.02 * float(start.std()), (found, radii.std())
    assert found.history["refused"].sum() == 0
    assert seen[-1] == seen[0], "a program is compiled between steps"


def test_steps_do_not_depend_on_the_number_of_points():
    sizes = []
    for n in (400, 1_600):
        x = ball(n).cloud.points
        value = lambda u, n=n, x=x: ball(n).integrate(u * x[:, 2] + 0.5 * u**2)
        g = jax.grad(value)(x[:, 0])
        s = smoothed(ball(n), g, 0.5)
        sizes.append(float(jnp.abs(s).max()))
    np.testing.assert_allclose(sizes[0], sizes[1], rtol=2e-2)


def test_single_precision_and_fields_with_components():
    single = lambda a: a.astype(jnp.float32)
    cloud = js.PointCloud(single(ball().cloud.points), single(ball().cloud.normals))
    surface = js.discretize(cloud, ball().neighbors, method=js.GFDM(degree=2))
    g = ball().cell_areas[:, None] * ball().cloud.points
    found = smoothed(surface, {"a": single(g)}, 0.5)["a"]
    assert found.dtype == jnp.float32 and found.shape == (400, 3)
    np.testing.assert_allclose(found, smoothed(ball(), g, 0.5), atol=1e-3)


def test_switched_off_points_have_no_part():
    cloud, on = ball().cloud, jnp.arange(400) % 3 > 0
    masked = js.PointCloud(cloud.points, cloud.normals, active=on)
    alone = js.PointCloud(cloud.points[on], cloud.normals[on])
    g = jnp.sin(3 * cloud.points[:, 0]) / 400
    some = js.discretize(masked, method=js.GFDM(degree=2))
    found = smoothed(some, jnp.where(on, g, jnp.nan), 0.5)
    wanted = smoothed(js.discretize(alone, method=js.GFDM(degree=2)), g[on], 0.5)
    np.testing.assert_allclose(found[on], wanted, rtol=1e-4)
    assert bool((found[~on] == 0).all())
