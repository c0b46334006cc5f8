"""Closed formulas and level sets: exact counts, normals and curvature, evenness, derivatives."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxsurf.shapes.analytic import (
    circle,
    ellipsoid,
    ellipsoid_projection,
    sphere,
    sphere_projection,
    torus,
    torus_projection,
)
from jaxsurf.shapes.implicit import level_set_curvature, level_set_normals, project_to_level_set
from jaxsurf.shapes.level_sets import double_torus, level_set
from jaxsurf.shapes.parametric import graph, surface_of_revolution
from jaxsurf.shapes.spacing import ideal_spacing, measure_quality

from .helpers import check_derivatives, count_compilations


def sphere_phi(x):
    return x @ x - 1


def torus_phi(x):
    # Not `jnp.hypot`: its derivative asks which of the two is the greater of them, and is wrong
    # where the compiler computes the greater one again and rounds it differently.
    return (3 - jnp.sqrt(x[0] ** 2 + x[1] ** 2)) ** 2 + x[2] ** 2 - 1


def ellipsoid_phi(axes):
    return lambda x: jnp.sum((x / jnp.asarray(axes)) ** 2) - 1


def ellipsoid_area(axes):
    # Mean of |cofactor(A) n| over the sphere, by Gauss and trapezoid: converged to 1e-12.
    z, w = np.polynomial.legendre.leggauss(200)
    t = 2 * np.pi * np.arange(400) / 400
    x = np.stack(
        [
            np.sqrt(1 - z[:, None] ** 2) * np.cos(t),
            np.sqrt(1 - z[:, None] ** 2) * np.sin(t),
            z[:, None] + 0 * t,
        ],
        -1,
    )
    stretch = np.prod(axes) * np.linalg.norm(x / np.asarray(axes), axis=-1)
    return float((w[:, None] * stretch).sum() * 2 * np.pi / 400)


def dense_sphere(m):
    x = np.random.default_rng(7).normal(size=(m, 3))
    return x / np.linalg.norm(x, axis=1, keepdims=True)


ANALYTIC = {
    "sphere": (lambda n: sphere(n, radius=2.0), lambda x: x @ x - 4, 16 * np.pi),
    "ellipsoid": (
        lambda n: ellipsoid(n, (1, 0.8, 0.75)),
        ellipsoid_phi((1, 0.8, 0.75)),
        ellipsoid_area((1, 0.8, 0.75)),
    ),
    "long": (
        lambda n: ellipsoid(n, (1, 2, 4)),
        ellipsoid_phi((1, 2, 4)),
        ellipsoid_area((1, 2, 4)),
    ),
    "flat": (
        lambda n: ellipsoid(n, (1, 1, 0.25)),
        ellipsoid_phi((1, 1, 0.25)),
        ellipsoid_area((1, 1, 0.25)),
    ),
    "torus": (lambda n: torus(n, 3, 1), torus_phi, 12 * np.pi**2),
}
PROJECT = {
    "sphere": sphere_projection(2.0),
    "ellipsoid": ellipsoid_projection((1, 0.8, 0.75)),
    "long": ellipsoid_projection((1, 2, 4)),
    "flat": ellipsoid_projection((1, 1, 0.25)),
    "torus": torus_projection(3, 1),
}


@pytest.mark.parametrize("name", ANALYTIC)
@pytest.mark.parametrize("n", [97, 2_003])
def test_analytic_points_and_normals_are_exact(name, n):
    make, phi, _ = ANALYTIC[name]
    cloud = make(n)
    assert cloud.n == n and cloud.boundary is None
    assert float(jnp.abs(jax.vmap(phi)(cloud.points)).max()) < 1e-12
    np.testing.assert_allclose(cloud.normals, level_set_normals(phi, cloud.points), atol=1e-12)
    np.testing.assert_array_equal(cloud.points, make(n).points)


@pytest.mark.parametrize("name", ANALYTIC)
def test_analytic_points_are_even(name):
    make, _, area = ANALYTIC[name]
    cloud = make(4_000)
    axes = {"sphere": (2, 2, 2), "ellipsoid": (1, 0.8, 0.75), "long": (1, 2, 4)}
    if name == "torus":
        probes = np.asarray(torus(60_000, 3, 1).points)
    else:
        probes = PROJECT[name](dense_sphere(60_000) * axes.get(name, (1, 1, 0.25)))[0]
    quality = measure_quality(cloud.points, measure=area, probes=probes)
    least, hole = (0.75, 0.88) if name == "long" else (0.85, 0.78)
    assert quality.smallest > least and quality.hole < hole
    steps = np.linalg.norm(np.diff(np.asarray(cloud.points), axis=0), axis=1)
    assert steps.mean() < 2 * quality.spacing


@pytest.mark.parametrize("name", PROJECT)
def test_projections_return_the_closest_point(name):
    make = ANALYTIC[name][0]
    foot = make(500)
    offset = np.random.default_rng(0).uniform(-0.05, 0.05, (500, 1))
    onto, normals = PROJECT[name](np.asarray(foot.points) + offset * np.asarray(foot.normals))
    np.testing.assert_allclose(onto, foot.points, atol=1e-12)
    np.testing.assert_allclose(normals, foot.normals, atol=1e-11)


def test_circle_is_equispaced_in_order():
    cloud = circle(50, radius=2.0)
    steps = np.linalg.norm(np.roll(cloud.points, -1, axis=0) - cloud.points, axis=1)
    np.testing.assert_allclose(steps, 4 * np.sin(np.pi / 50), rtol=1e-12)
    np.testing.assert_allclose(cloud.normals, cloud.points / 2, atol=1e-15)


def test_hemisphere_has_a_border_and_outward_normals():
    cloud = surface_of_revolution(
        lambda s: (jnp.sin(s), -jnp.cos(s)), 3_000, interval=(0.0, np.pi / 2)
    )
    assert cloud.n == 3_000
    np.testing.assert_allclose(cloud.normals, cloud.points, atol=1e-14)
    rim = np.asarray(cloud.boundary)
    np.testing.assert_allclose(cloud.points[rim, 2], 0, atol=1e-14)
    assert float(cloud.points[~rim, 2].max()) < -0.5 * ideal_spacing(2 * np.pi, 3_000)
    assert abs(rim.sum() - 2 * np.pi / ideal_spacing(2 * np.pi, 3_000)) < 4
    assert measure_quality(cloud.points, measure=2 * np.pi).smallest > 0.8


def test_revolution_closed_either_way_round_and_with_two_borders():
    up = surface_of_revolution(lambda s: (jnp.sin(s), -jnp.cos(s)), 500, interval=(0, np.pi))
    down = surface_of_revolution(lambda s: (jnp.sin(s), jnp.cos(s)), 500, interval=(0, np.pi))
    for cloud in (up, down):
        assert cloud.boundary is None
        np.testing.assert_allclose(cloud.normals, cloud.points, atol=1e-14)
    tube = surface_of_revolution(lambda s: (1.0 + 0 * s, s), 3_000, interval=(0.0, 2.0))
    z = np.asarray(tube.points[:, 2])
    np.testing.assert_array_equal(np.asarray(tube.boundary), (z == 0) | (z == 2))
    assert measure_quality(tube.points, measure=4 * np.pi).smallest > 0.95


def test_graph_is_a_regular_grid_with_upward_normals():
    def f(x, y):
        return x**2 + 3 * y

    cloud = graph(f, (31, 21), bounds=((-1.0, 0.0), (2.0, 2.0)))
    x, y, z = np.asarray(cloud.points).T
    np.testing.assert_allclose(z, x**2 + 3 * y, atol=1e-14)
    expected = np.stack([-2 * x, -3 + 0 * x, 1 + 0 * x], 1)
    expected /= np.linalg.norm(expected, axis=1, keepdims=True)
    np.testing.assert_allclose(cloud.normals, expected, atol=1e-14)
    assert len(np.unique(x.round(9))) == 31 and len(np.unique(y.round(9))) == 21
    edge = (x == -1) | (x == 2) | (y == 0) | (y == 2)
    np.testing.assert_array_equal(np.asarray(cloud.boundary), edge)


@pytest.mark.parametrize("n", [100, 10_000, 1_009])
def test_graph_of_n_points(n):
    cloud = graph(lambda x, y: 0 * x, n)
    assert cloud.n == n
    h = 2 / (np.sqrt(n) - 1)
    assert measure_quality(cloud.points, measure=h * h * n).smallest > 0.9


def test_curvature_is_exact():
    points = sphere(200, radius=2.0).points
    mean, gauss = level_set_curvature(lambda x: jnp.log(x @ x / 4), points)
    np.testing.assert_allclose(mean, 0.5, rtol=1e-13)
    np.testing.assert_allclose(gauss, 0.25, rtol=1e-13)
    points = torus(500, 3, 1).points
    mean, gauss = jax.jit(lambda p: level_set_curvature(torus_phi, p))(points)
    cosine = jnp.hypot(points[:, 0], points[:, 1]) - 3
    np.testing.assert_allclose(mean, (3 + 2 * cosine) / (2 * (3 + cosine)), atol=1e-12)
    np.testing.assert_allclose(gauss, cosine / (3 + cosine), atol=1e-12)
    mean, gauss = level_set_curvature(sphere_phi, circle(20).points * 4)
    np.testing.assert_allclose(mean, 0.25, rtol=1e-13)
    np.testing.assert_allclose(gauss, 0, atol=1e-15)


def test_level_set_is_even():
    phi, bounds = double_torus()
    cloud = level_set(phi, n=3_000, bounds=bounds)
    assert cloud.n == 3_000
    assert float(jnp.abs(jax.vmap(phi)(cloud.points)).max()) < 1e-13
    np.testing.assert_array_equal(cloud.normals, level_set_normals(phi, cloud.points))
    area, probes = 28.90, level_set(phi, n=15_000, bounds=bounds, steps=0).points
    quality = measure_quality(cloud.points, measure=area, normals=cloud.normals, probes=probes)
    assert quality.smallest > 0.75 and quality.mean > 0.9 and quality.hole < 0.9
    steps = np.linalg.norm(np.diff(np.asarray(cloud.points), axis=0), axis=1)
    assert steps.mean() < 2 * quality.spacing
    # Gauss–Bonnet: the mean of K times the area is 4 pi (1 - genus), genus two.
    gauss = level_set_curvature(phi, cloud.points)[1]
    assert abs(1 - float(gauss.mean()) * area / (4 * np.pi) - 2) < 0.05


def test_level_set_repeats_itself_for_a_seed():
    box = ((-1.2,) * 3, (1.2,) * 3)
    first, same, other = (level_set(sphere_phi, n=200, bounds=box, seed=s) for s in (1, 1, 2))
    np.testing.assert_array_equal(first.points, same.points)
    assert not np.array_equal(first.points, other.points)


def test_double_torus_is_resolved_by_ten_thousand_points():
    h = ideal_spacing(28.90, 10_000)
    phi, bounds = double_torus()
    cloud = level_set(phi, n=2_000, bounds=bounds)
    points, normals = np.asarray(cloud.points), np.asarray(cloud.normals)
    chord = points[None] - points[:, None]
    rise = np.abs(np.einsum("ijk,ik->ij", chord, normals))
    with np.errstate(divide="ignore", invalid="ignore"):
        # Federer: the reach is the least radius of a ball that touches and meets the surface.
        balls = np.sum(chord**2, axis=-1) / (2 * rise)
    assert np.nanmin(balls[~np.eye(len(points), dtype=bool)]) > 6 * h


def test_level_set_with_spacing_and_of_a_curve():
    cloud = level_set(sphere_phi, spacing=0.1, bounds=((-1.3,) * 3, (1.2,) * 3))
    assert abs(cloud.n - 4 * np.pi / 0.01) < 0.01 * cloud.n
    curve = level_set(sphere_phi, n=200, bounds=((-1.3,) * 2, (1.2,) * 2))
    angle = np.sort(np.arctan2(*np.asarray(curve.points).T))
    gaps = np.diff(np.append(angle, angle[0] + 2 * np.pi)) / (2 * np.pi / 200)
    assert curve.n == 200 and gaps.min() > 0.75 and gaps.max() < 1.3
    np.testing.assert_allclose(curve.normals, curve.points, atol=1e-13)


def test_level_set_refuses_bad_input():
    box = ((-1.2,) * 3, (1.2,) * 3)
    with pytest.raises(ValueError, match="no zero within the bounds: it goes from 1"):
        level_set(lambda x: x @ x + 1, n=100, bounds=box)
    with pytest.raises(ValueError, match="leaves the bounds through the upper side of axis 0"):
        level_set(sphere_phi, n=100, bounds=((-1.2, -1.2, -1.2), (0.5, 1.2, 1.2)))
    with pytest.raises(ValueError, match="leaves the bounds"):  # a tiny cap is cut off
        level_set(sphere_phi, n=100, bounds=((-1.2, -1.2, -1.2), (0.9999, 1.2, 1.2)))
    with pytest.raises(ValueError, match="exactly one of n and spacing"):
        level_set(sphere_phi, n=100, spacing=0.1, bounds=box)
    with pytest.raises(ValueError, match="n = 2 points, needs at least 4"):
        level_set(sphere_phi, n=2, bounds=box)
    with pytest.raises(ValueError, match="spacing = -1, expected above 0"):
        level_set(sphere_phi, spacing=-1, bounds=box)
    with pytest.raises(ValueError, match="must exceed lower corner"):
        level_set(sphere_phi, n=100, bounds=((1.0,) * 3, (0.0,) * 3))
    with pytest.raises(ValueError, match=r"bounds have shape \(2, 4\)"):
        level_set(sphere_phi, n=100, bounds=((0.0,) * 4, (1.0,) * 4))
    with pytest.raises(ValueError, match="phi is not a number"):
        level_set(lambda x: jnp.log(x[0]), n=100, bounds=box)


def test_makers_refuse_bad_input():
    with pytest.raises(ValueError, match="n = 3 points, needs at least 4"):
        sphere(3)
    with pytest.raises(ValueError, match="n = 2 points, needs at least 3"):
        circle(2)
    with pytest.raises(ValueError, match="radius = 0, expected above 0"):
        sphere(10, radius=0)
    with pytest.raises(ValueError, match="axis 1 is -2"):
        ellipsoid(100, (1, -2, 3))
    with pytest.raises(ValueError, match=r"axes have shape \(2,\), expected \(3,\)"):
        ellipsoid(100, (1, 2))
    with pytest.raises(ValueError, match=r"r = 1.5 must be less than R = 1"):
        torus(100, 1, 1.5)
    with pytest.raises(ValueError, match="three on each ring"):
        surface_of_revolution(lambda s: (0.01 + 0 * s, s), 30)
    with pytest.raises(ValueError, match="profile meets the axis inside"):
        surface_of_revolution(lambda s: (jnp.abs(s - 0.5), s), 300)
    with pytest.raises(ValueError, match="2 points in each of 5 rows"):
        graph(lambda x, y: x, (2, 5))
    with pytest.raises(
        ValueError, match=r"thickness = 0\.1, expected at least 0\.3 and at most 0\.55"
    ):
        double_torus(0.1)


def test_projection_moves_along_the_gradient_at_the_start():
    start = 1.1 * np.asarray(ellipsoid(100, (1, 2, 3)).points)
    phi = ellipsoid_phi((1, 2, 3))
    found = project_to_level_set(phi, start)
    assert float(jnp.abs(jax.vmap(phi)(found)).max()) < 1e-14
    move = np.asarray(found) - start
    along = np.asarray(level_set_normals(phi, start))
    np.testing.assert_allclose(move, along * np.sum(move * along, 1, keepdims=True), atol=1e-14)
    again = project_to_level_set(phi, found)
    np.testing.assert_allclose(again, found, atol=1e-15)


def difference(f, x, eps=1e-5):
    return (f(x + eps) - f(x - eps)) / (2 * eps)


def test_derivatives_of_the_projection():
    # Half of the points on the surface, half of them off it.
    cloud = torus(40, 3, 1)
    points = cloud.points + jnp.repeat(jnp.array([0.0, 0.1]), 20)[:, None] * cloud.normals
    rng = np.random.default_rng(0)
    weights, move = jnp.asarray(rng.normal(size=(2, 40, 3)))

    def value(bump, start):
        def phi(x):
            return torus_phi(x) - bump * jnp.sin(2 * x[0]) * x[2]

        found = project_to_level_set(phi, start)
        return jnp.sum(weights * (found + level_set_normals(phi, found)) ** 2)

    plain, slope_at = jax.jit(value), jax.jit(jax.grad(value))
    slope = slope_at(0.1, points)
    np.testing.assert_allclose(slope, difference(lambda t: plain(t, points), 0.1), rtol=1e-7)
    np.testing.assert_allclose(jax.grad(value)(0.1, points), slope, rtol=1e-10)
    np.testing.assert_allclose(jax.jit(jax.jacfwd(value))(0.1, points), slope, rtol=1e-10)
    # Several parameters at once.
    several = jax.jit(jax.vmap(jax.grad(value), in_axes=(0, None)))(jnp.array([0.1, 0.2]), points)
    np.testing.assert_allclose(several[0], slope, rtol=1e-10)
    # In the starting points too.
    by_points = jnp.sum(jax.jit(jax.grad(value, argnums=1))(0.1, points) * move)
    expected = difference(lambda t: plain(0.1, points + t * move), 0.0)
    np.testing.assert_allclose(by_points, expected, rtol=1e-6)
    # To second order.
    second = jax.jit(jax.grad(jax.grad(value)))(0.1, points)
    expected = difference(lambda t: slope_at(t, points), 0.1)
    np.testing.assert_allclose(second, expected, rtol=1e-6)


def test_derivative_of_the_double_torus_with_its_curvature():
    phi, bounds = double_torus(0.4)
    points = level_set(phi, n=60, bounds=bounds).points

    @jax.jit
    def value(thickness):
        phi = double_torus(thickness)[0]
        found = project_to_level_set(phi, points)
        mean, gauss = level_set_curvature(phi, found)
        return jnp.sum(found**2) + jnp.sum(mean * gauss)

    slope = jax.jit(jax.grad(value))(0.4)
    np.testing.assert_allclose(slope, difference(value, 0.4), rtol=1e-7)


def test_double_tori_of_several_thicknesses_at_once():
    points = level_set(double_torus(0.4)[0], n=60, bounds=double_torus(0.4)[1]).points

    def moved(thickness):
        phi = double_torus(thickness)[0]
        found = project_to_level_set(phi, points)
        return found, jax.vmap(phi)(found)

    thicknesses = jnp.array([0.4, 0.45])
    found, values = jax.jit(jax.vmap(moved))(thicknesses)
    assert jnp.abs(values).max() < 1e-13
    alone = jax.jit(lambda t: moved(t)[0])
    np.testing.assert_allclose(found, jnp.stack([alone(t) for t in thicknesses]), atol=1e-13)
    assert jnp.abs(found[0] - found[1]).max() > 0.02


def test_projection_follows_the_parameters_of_a_module():
    import equinox as eqx

    network = eqx.nn.MLP(3, "scalar", 8, 2, activation=jnp.tanh, key=jax.random.key(0))
    points = sphere(30).points

    @eqx.filter_jit
    def total(module):
        found = project_to_level_set(lambda x: x @ x - 1 + 0.1 * module(x), points)
        return jnp.sum(found[:, 0] ** 2)

    slope = eqx.filter_grad(total)(network).layers[-1].bias

    def shifted(eps):
        bias = network.layers[-1].bias + eps
        return total(eqx.tree_at(lambda m: m.layers[-1].bias, network, bias))

    np.testing.assert_allclose(slope, (shifted(1e-5) - shifted(-1e-5)) / 2e-5, rtol=1e-7)


def test_projection_reports_failure():
    points = jnp.array([[1.1, 0.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 3.0]])

    def bowl(x):  # its gradient vanishes at the origin
        return x @ x - 1

    with pytest.raises(ValueError, match="projection of point 1 did not converge"):
        project_to_level_set(bowl, points)
    found = project_to_level_set(bowl, points, throw=False)
    np.testing.assert_array_equal(np.isnan(found).any(axis=1), [False, True, False])
    with pytest.raises(ValueError, match="point 0 did not converge"):
        project_to_level_set(lambda x: x @ x + 1, points[:1])
    traced = jax.jit(lambda p: project_to_level_set(bowl, p))(points)
    np.testing.assert_array_equal(np.isnan(traced).any(axis=1), [False, True, False])
    with pytest.raises(ValueError, match="gradient of phi at point 1 has length 0"):
        level_set_normals(bowl, points)


def test_single_precision():
    start = torus(300, 3, 1)
    points = (start.points + 0.05 * start.normals).astype(jnp.float32)
    found = project_to_level_set(torus_phi, points)
    assert found.dtype == jnp.float32
    assert level_set_normals(torus_phi, found).dtype == jnp.float32
    assert float(jnp.abs(jax.vmap(torus_phi)(found.astype(float))).max()) < 3e-6


# --- where phi is no number, last bits, compilations, precision ------------------------------


def star(x):
    r = jnp.sqrt(x @ x)
    return r - 1 - 0.2 * x[0] * x[1] / r**2  # 0/0 at the centre


def test_a_star_shape_whose_centre_is_a_node_of_the_grid():
    assert np.isnan(star(jnp.zeros(3)))
    cloud = level_set(star, n=300, bounds=((-1.3,) * 3, (1.3,) * 3))
    assert cloud.n == 300
    assert float(jnp.abs(jax.vmap(star)(cloud.points)).max()) < 1e-13
    assert measure_quality(cloud.points, measure=4 * np.pi * 1.01).smallest > 0.7


def test_other_parameters_and_the_same_code_compile_nothing():
    def every(thickness, shift):
        phi, bounds = double_torus(thickness)
        points = level_set(phi, n=100, bounds=bounds, resolution=16, steps=5).points
        level_set_normals(phi, points)
        level_set_curvature(phi, points)
        project_to_level_set(phi, 1.01 * points)
        ball = level_set(lambda x: x @ x - shift, n=60, bounds=((-2,) * 2, (2,) * 2), steps=3)
        torus(60, 3.0, thickness)
        surface_of_revolution(lambda s: (shift + s, s), 60)
        graph(lambda x, y: shift * x * y, 60)
        sphere(60, radius=thickness), circle(60), ellipsoid(60, (1, 2, 1 + thickness), steps=2)
        return ball

    every(0.4, jnp.asarray(1.0))
    with count_compilations() as names:
        every(0.45, jnp.asarray(1.1))
    assert not names, names


def ellipsoid_of(axes):
    return lambda x: jnp.sum((x / axes) ** 2) - 1


@pytest.mark.parametrize("function", ["normals", "curvature"])
def test_gradients_in_points_and_parameters(function):
    """Normals and curvatures against central differences; jit and vmap against the plain loop."""
    axes = jnp.array([1.0, 1.3, 0.8])
    points = ellipsoid(6, (1.0, 1.3, 0.8), steps=0).points + 0.05
    weights = jnp.asarray(np.random.default_rng(0).normal(size=(2, 6, 3)))

    def value(axes, points):
        if function == "normals":
            return jnp.sum(weights[0] * level_set_normals(ellipsoid_of(axes), points))
        mean, gauss = level_set_curvature(ellipsoid_of(axes), points)
        return weights[0, :, 0] @ mean + weights[1, :, 0] @ gauss

    check_derivatives(value, axes, points)
    two = jnp.stack([points, 1.1 * points])
    mapped = jax.jit(jax.vmap(value, in_axes=(None, 0)))(axes, two)
    np.testing.assert_allclose(mapped, [value(axes, x) for x in two], rtol=1e-12)


def test_level_sets_in_single_precision():
    """Points within 3e-6 of the surface, normals to 1e-5, curvatures to 1e-4."""
    with jax.enable_x64(False):
        cloud = level_set(sphere_phi, n=300, bounds=((-1.2,) * 3, (1.2,) * 3))
        mean, gauss = level_set_curvature(sphere_phi, cloud.points)
        assert {a.dtype for a in (cloud.points, cloud.normals, mean)} == {jnp.dtype("float32")}
        others = (sphere(50), circle(50), torus(60, 3.0, 1.0), ellipsoid(50, (1, 2, 3)))
        assert all(c.points.dtype == jnp.float32 for c in others)
        bump = graph(lambda x, y: x * y, 50)
        vase = surface_of_revolution(lambda s: (1 + s, s), 60)
        assert bump.points.dtype == vase.points.dtype == jnp.float32
        phi, _ = double_torus()
        assert level_set_normals(phi, jnp.array([[0.0, 0.3, 0.9]])).dtype == jnp.float32
    points = np.asarray(cloud.points, float)
    assert np.abs(np.linalg.norm(points, axis=1) - 1).max() < 3e-6
    assert np.abs(np.asarray(cloud.normals) - points).max() < 1e-5
    assert np.abs(np.asarray(mean) - 1).max() < 1e-4 and np.abs(np.asarray(gauss) - 1).max() < 1e-4
    torus_points = np.asarray(others[2].points, float)
    assert np.abs(jax.vmap(torus_phi)(jnp.asarray(torus_points))).max() < 1e-5


def test_last_bits_move_no_point_to_another_place():
    """Radii that are changed by 1e-15 give the same rings, counts and order."""
    rng = np.random.default_rng(0)
    for make, size in (
        (lambda a: surface_of_revolution(lambda s: (1.0 + 0 * s, jnp.asarray(a) * s), 1_005), 1.0),
        (lambda a: torus(500, 3.0, a), 1.0),
        (lambda a: ellipsoid(200, (0.3 * a, 0.6 * a, 1.2 * a), steps=3), 1.0),
        (lambda a: graph(lambda x, y: jnp.asarray(a) * x * y, (16, 16)), 1.0),
        (lambda a: sphere(300, radius=a), 1.0),
    ):
        first = np.asarray(make(size).points)
        for _ in range(3):
            other = make(size * (1 + 1e-15 * rng.normal())).points
            assert np.abs(np.asarray(other) - first).max() < 1e-12
