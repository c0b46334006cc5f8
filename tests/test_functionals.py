"""Functionals of shapes and their derivatives in the geometry, against closed forms."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxsurf as js
from jaxsurf import failures

from .helpers import check_remainders

pytestmark = pytest.mark.slow

R, r = 1.0, 0.5
NAMES = ["area", "volume", "total mean curvature", "Willmore", "moment z", "moment x"]


@functools.cache
def reference(n):
    return js.discretize(js.torus(n, R, r), method=js.GFDM(degree=4))


def torus(n, radii):
    """The torus of these radii, with the points of the reference moved along."""
    surface = reference(n)
    x, normals = surface.cloud.points, surface.cloud.normals
    out = (x - r * normals) / R
    return surface.moved(radii[0] * out + radii[1] * normals, normals)


def functionals(surface):
    second = js.moments(surface)[1]
    h = surface.mean_curvature
    values = surface.areas.sum(), js.volume(surface), surface.integrate(h), surface.integrate(h**2)
    return jnp.stack([*values, second[2, 2], second[0, 0]])


def exact(radii):
    R, r = radii
    area, pi = 4 * jnp.pi**2 * R * r, jnp.pi
    willmore = pi**2 * R**2 / (r * jnp.sqrt(R**2 - r**2))
    values = area, 2 * pi**2 * R * r**2, 2 * pi**2 * R, willmore
    return jnp.stack([*values, area * r**2 / 2, area * (R**2 + 1.5 * r**2) / 2])


def errors(n):
    radii, dot = jnp.array([R, r]), jnp.array([0.3, 1.0])
    found = jax.jvp(lambda a: functionals(torus(n, a)), (radii,), (dot,))
    wanted = jax.jvp(exact, (radii,), (dot,))
    return np.array([np.abs(1 - np.asarray(a / b)) for a, b in zip(found, wanted)])


def test_values_and_shape_derivatives_on_the_torus():
    coarse, fine = errors(500), errors(2_000)
    bounds = np.array([[1e-5, 2e-5, 1e-4, 3e-4, 1e-5, 2e-5], [1e-5, 1e-5, 4e-4, 3e-4, 1e-5, 1e-5]])
    assert (fine < bounds).all(), fine
    # The order is 4 with curvatures, 6 without; at n = 1e4 all are below 1e-5.
    slopes = np.log2(coarse / fine)
    assert (slopes[:, [0, 1, 4, 5]] > 4.8).all() and (slopes > 3.3).all(), slopes


def test_the_willmore_energy_on_the_torus():
    """Value and derivative in both radii; as the plain integral where neighbours are too few."""

    def errors(n):
        radii = jnp.array([R, r])
        value, slopes = jax.value_and_grad(lambda a: js.willmore_energy(torus(n, a)))(radii)
        wanted, right = jax.value_and_grad(lambda a: exact(a)[3])(radii)
        return np.array([abs(value / wanted - 1), np.linalg.norm(slopes / right - 1)])

    coarse, fine = errors(500), errors(2_000)
    assert (fine < [2e-6, 4e-5]).all(), fine
    assert (np.log2(coarse / fine) > 4.8).all(), coarse / fine
    cloud = reference(500).cloud
    few = js.discretize(cloud, js.find_neighbors(cloud, k=40), method=js.GFDM(degree=4))
    assert js.willmore_energy(few) == few.integrate(few.mean_curvature**2)
    # On lattices that end at a border the higher degree asks for more than it does elsewhere.
    lattice = js.graph(lambda x, y: 0.2 * x * y, (20, 20))
    open_ = js.discretize(lattice, method=js.GFDM(degree=4))
    assert js.willmore_energy(open_) == open_.integrate(open_.mean_curvature**2)
    wide = js.discretize(lattice, js.find_neighbors(lattice, k=90), method=js.GFDM(degree=4))
    assert js.willmore_energy(wide) != wide.integrate(wide.mean_curvature**2)


@functools.cache
def ball():
    return js.discretize(js.sphere(400), method=js.GFDM(degree=2))


def stretched(axes):
    x = ball().cloud.points
    normals = x / axes
    return ball().moved(axes * x, normals / jnp.linalg.norm(normals, axis=1, keepdims=True))


def test_derivatives_in_the_geometry():
    """Of all functionals at once, on an ellipsoid whose axes change: nothing of first order."""
    x = ball().cloud.points
    load = jnp.exp(x[:, 0] + 0.5 * x[:, 1])
    targets = x[::20] * jnp.linspace(0.7, 1.4, 20)[:, None]

    def all_of_them(axes):
        surface = stretched(axes)
        centroid, second = js.moments(surface)
        values = [js.volume(surface), second[0, 1] + second[0, 0], centroid[2]]
        values += [js.chamfer_distance(surface, targets), js.compliance(surface, load)]
        values += [js.willmore_energy(surface)]
        return jnp.stack(values) @ jnp.array([1.0, -0.7, 2.0, 3.0, -1.0, 0.8])

    axes, direction = jnp.array([1.0, 0.9, 0.8]), jnp.array([0.3, -0.2, 0.4])
    # So short that no point changes the target nearest to it: the chamfer distance has kinks there
    # (the first between 3e-4 and 1e-3).
    steps = jnp.array([1e-4, 3e-5, 1e-5])
    found = js.taylor_remainders(all_of_them, axes, direction, steps=steps)
    assert abs(found.slope - 2) < 0.02, found


def test_derivatives_of_what_the_surface_does():
    """Of curvatures, eigenvalues, heat, repulsion and thickness: nothing of first order is left."""
    start = jnp.exp(ball().cloud.points[:, 0])

    def heat(surface):
        problem = js.AdvectionDiffusionReaction(surface.laplacian)
        u = js.integrate(problem, start, t1=0.1, rtol=1e-9, atol=1e-12).ys[-1]
        return surface.inner(surface.cloud.points[:, 2] ** 2, u)

    functionals = {
        "area": lambda s: s.areas.sum(),
        "mean curvature": lambda s: s.integrate(s.mean_curvature),
        "bending": lambda s: s.integrate(s.mean_curvature**2),
        "eigenvalues": lambda s: jnp.sum(js.eigenmodes(s.laplacian, 4).values),
        "eigenvalues of a surface": lambda s: jnp.sum(js.eigenvalues(s, 4)),
        "heat content": heat,
        "repulsion": js.tangent_point_energy,
        "thickness": lambda s: jnp.sum(js.medial_radius(s)),
    }
    check_remainders(functionals, stretched)


def test_a_volume_has_no_derivative_in_where_it_is():
    """Though on a coarse peanut normals do not add up to nothing: what is shifted is the same."""
    x = ball().cloud.points
    peanut = (0.7 + 0.6 * x[:, 2:] ** 2 + 0.2 * x[:, :1] * x[:, 1:2]) * x
    volume = lambda shift: js.volume(ball().moved(peanut + shift))
    slope = jax.jit(jax.grad(volume))(jnp.zeros(3))
    np.testing.assert_allclose(slope, 0, atol=1e-11)


def test_compliance_of_the_ball():
    r"""$4\pi a^2 / 3 / (2 / a^2 + \kappa)$ for the load z / a on a sphere of radius a."""
    z = ball().cloud.points[:, 2]
    for screening in (0.0, 3.0):
        found = js.compliance(ball().moved(2 * ball().cloud.points), 1 + z, screening=screening)
        mean = 16 * np.pi / screening if screening else 0.0
        np.testing.assert_allclose(found, 16 * np.pi / 3 / (0.5 + screening) + mean, rtol=3e-2)


def test_distances():
    """Each point is nearest to itself, 0.1 away, and the derivative is that of the squares."""
    x = ball().cloud.points
    distance = lambda size: js.chamfer_distance(ball(), size * x)
    found, slope = jax.value_and_grad(distance)(1.1)
    np.testing.assert_allclose([found, slope], [0.02, 0.4], rtol=1e-6)


def test_signed_distances():
    """Of points above and below a torus, by its order; the derivative in a point is the normal."""
    surfaces = [reference(n) for n in (500, 2_000)]
    x = js.torus(80, R, r)
    away = jnp.linspace(-0.25, 0.25, 80)
    points = x.points + away[:, None] * x.normals
    found = [js.signed_distance(surface, points) for surface in surfaces]
    errors = [float(jnp.abs(one - away).max()) for one in found]
    assert errors[1] < 2e-5 and np.log2(errors[0] / errors[1]) > 3.5, errors
    # The normal is a derivative of the polynomial: of one order less.
    slopes = [jax.grad(lambda y, s=s: js.signed_distance(s, y).sum())(points) for s in surfaces]
    off = [float(jnp.abs(slope - x.normals).max()) for slope in slopes]
    assert off[1] < 1e-3 and np.log2(off[0] / off[1]) > 2.8, off


@functools.cache
def egg():
    return js.discretize(js.ellipsoid(300, (1.0, 0.8, 0.7)), method=js.GFDM(degree=4))


def test_signed_distances_far_from_the_surface():
    """Beyond radii of curvature outside, and near to centres of curvature inside."""
    surface = egg()
    x, n = surface.cloud.points[::10], surface.cloud.normals[::10]
    for away in (-0.4, -0.2, 0.7, 1.0, 3.0, 1e3):
        found = js.signed_distance(surface, x + away * n)
        np.testing.assert_allclose(found, away, atol=2e-4)
    np.testing.assert_allclose(js.signed_distance(surface, jnp.zeros((1, 3))), -0.7, atol=1e-4)


def test_feet_that_are_not_found_are_refused():
    """Near to centres of curvature: by name, and where it is asked for by NaN."""
    cloud = js.ellipsoid(200, (1.0, 0.8, 0.7))
    surface = js.discretize(cloud, method=js.GFDM(degree=4))
    x, n = surface.cloud.points, surface.cloud.normals
    near = x[:40] - 0.5 * n[:40]
    words = "the foot of 31 is not found: the way to it leans .* off the normal, at most"
    with pytest.raises(ValueError, match=words):
        js.signed_distance(surface, near)
    with pytest.raises(ValueError, match=words):
        jax.grad(lambda y: js.signed_distance(surface, y).sum())(near)
    with pytest.raises(Exception, match="is not found"):
        jax.jit(lambda y: js.signed_distance(surface, y))(near)
    with failures.marking():
        found = jax.jit(lambda y: js.signed_distance(surface, y))(near)
    assert np.isnan(found).all()


def test_derivatives_of_signed_distances():
    """In the shape against differences, both modes, compiled and mapped, and in 32 bits."""
    targets = 0.9 * ball().cloud.points[::20]
    weights = jnp.sin(jnp.arange(20.0))
    value = lambda axes: weights @ js.signed_distance(stretched(axes), targets)
    axes, direction = jnp.array([1.0, 0.9, 0.8]), jnp.array([0.3, -0.2, 0.4])
    found = js.taylor_remainders(value, axes, direction, steps=jnp.array([1e-3, 3e-4, 1e-4]))
    assert abs(found.slope - 2) < 0.05, found
    forward = jax.jvp(value, (axes,), (direction,))[1]
    np.testing.assert_allclose(found.derivative, forward, rtol=1e-9)
    several = jax.jit(jax.vmap(value))(jnp.stack([axes, 1.05 * axes]))
    np.testing.assert_allclose(several[0], value(axes), rtol=1e-9)
    single = lambda a: a.astype(jnp.float32)
    cloud = js.PointCloud(single(ball().cloud.points), single(ball().cloud.normals))
    less = js.discretize(cloud, ball().neighbors, method=js.GFDM(degree=2))
    found = js.signed_distance(less, single(targets))
    assert found.dtype == jnp.float32
    np.testing.assert_allclose(found, js.signed_distance(ball(), targets), atol=1e-5)


def test_second_derivatives_of_signed_distances():
    r"""In a point 1 / (R + h) along the tangents of a ball; in the shape beside differences."""
    x, size = ball().cloud.points[7], 1.3
    distance = lambda y: js.signed_distance(ball(), y[None])[0]
    found = jax.jit(jax.hessian(distance))(size * x)
    np.testing.assert_allclose(found, (jnp.eye(3) - jnp.outer(x, x)) / size, atol=2e-2)
    targets = 1.3 * ball().cloud.points[::40]
    value = lambda a: jnp.sum(
        js.signed_distance(stretched(a * jnp.array([1.0, 0.9, 0.8])), targets)
    )
    slope = jax.jit(lambda a: jax.jvp(jax.grad(value), (a,), (1.0,)))
    near = [slope(1.0 + step)[0] for step in (1e-4, -1e-4)]
    np.testing.assert_allclose(slope(1.0)[1], (near[0] - near[1]) / 2e-4, rtol=1e-5)


def test_curves_compiled_mapped_and_in_single_precision():
    angle = np.linspace(0, 2 * np.pi, 60, endpoint=False)
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=1).astype(np.float32)
    cloud = js.PointCloud(jnp.asarray(circle), jnp.asarray(circle))
    surface = js.discretize(cloud, js.find_neighbors(cloud, k=9), method=js.GFDM(degree=2))

    @jax.jit
    @jax.vmap
    def values(radius):
        moved = surface.moved(radius * cloud.points, cloud.normals)
        near = js.chamfer_distance(moved, jnp.array([[0.0, 3.0]], jnp.float32))
        load = cloud.points[:, 0]
        work = js.compliance(moved, load)
        bending = js.willmore_energy(moved)
        return jnp.stack([js.volume(moved), js.moments(moved)[1][0, 0], near, work, bending])

    radii = jnp.array([1.0, 2.0], jnp.float32)
    found, pi = values(radii), np.pi
    assert found.dtype == jnp.float32
    a = np.array([1.0, 2.0])
    near = a**2 + 9 + (3 - a) ** 2
    wanted = np.stack([pi * a**2, pi * a**3, near, pi * a**3, 2 * pi / a], axis=1)
    np.testing.assert_allclose(found, wanted, rtol=1e-2)
