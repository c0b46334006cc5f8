r"""Curvature flows beside that by mean curvature, and sums of motions."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import jaxsurf as js
from jaxsurf.moving.problem import Moving

METHOD = js.GFDM(degree=4)
FLOWS = {"diffusion": js.SurfaceDiffusionFlow(), "Willmore": js.WillmoreFlow()}


def bumpy(n, bump, degree):
    """The sphere with r = 1 + bump times the second Legendre polynomial of z."""
    sphere = js.sphere(n)
    points = sphere.points * (1 + bump * legendre(sphere.points))[:, None]
    neighbors = js.find_neighbors(sphere, k=30)
    normals = js.refit_normals(points, sphere.normals, neighbors, degree=degree)
    return js.PointCloud(points, normals)


def legendre(points):
    z = points[:, 2] / jnp.linalg.norm(points, axis=1)
    return (3 * z**2 - 1) / 2


def bump_of(cloud):
    """Radius and bump, fitted to the points."""
    columns = jnp.stack([jnp.ones(cloud.n), legendre(cloud.points)], axis=1)
    return np.asarray(jnp.linalg.lstsq(columns, jnp.linalg.norm(cloud.points, axis=1))[0])


def bending(surface):
    curvature = jnp.sum(surface.laplacian(surface.cloud.points) * surface.cloud.normals, axis=1) / 2
    return float(surface.integrate(curvature**2))


@pytest.mark.slow
@pytest.mark.parametrize("name", FLOWS)
def test_bumps_decay_as_the_linear_theory_says(name):
    r"""Both at the rate $\lambda(\lambda - 2)/2 = 12$ of degree 2, but for the bump squared."""
    bump, t = 0.01, 0.05
    run = js.evolve(FLOWS[name], bumpy(400, bump, 4), t1=t, method=METHOD)
    assert run.stats["solver"].startswith("IMEX") and run.stats["steps"] < 20
    radius, left = bump_of(run.clouds[-1])
    assert abs(np.log(bump / left) / t / 12 - 1) < 0.03
    assert abs(radius - 1) < 3 * bump**2


@pytest.mark.slow
def test_curves():
    """A circle grows as r⁴ = 1 + t by one, and an ellipse becomes one of its area by the other."""
    run = js.evolve(FLOWS["Willmore"], js.circle(50), t1=1.0, method=METHOD)
    radii = np.linalg.norm(run.clouds[-1].points, axis=1)
    np.testing.assert_allclose(radii, 2**0.25, rtol=1e-4)
    angle = 2 * np.pi * np.arange(80) / 80
    ellipse = np.stack([1.3 * np.cos(angle), np.sin(angle)], axis=1)
    run = js.evolve(FLOWS["diffusion"], js.from_points(ellipse), t1=1.5, method=METHOD)
    radii = np.linalg.norm(run.clouds[-1].points, axis=1)
    np.testing.assert_allclose(radii, 1.3**0.5, rtol=1e-3)


def test_curvature_smoothed():
    r"""Of a mode of the sphere by $e^{-\lambda h^2 / 4}$; its mean curvature not at all."""
    h, bump = 0.15, 1e-3
    surface = js.discretize(bumpy(1_000, bump, 4), method=METHOD)
    outward = lambda flow: jnp.sum(
        flow.velocity(0.0, surface, (), None) * surface.cloud.normals, axis=1
    )
    modes = jnp.stack([jnp.ones(surface.n), legendre(surface.cloud.points)], axis=1)
    fitted = lambda flow: np.asarray(jnp.linalg.lstsq(modes, outward(flow))[0])
    plain, smooth = fitted(js.MeanCurvatureFlow()), fitted(js.MeanCurvatureFlow(smoothing=h))
    assert abs(smooth[0] / plain[0] - 1) < 1e-4
    assert abs(smooth[1] / plain[1] / np.exp(-6 * h**2 / 4) - 1) < 2e-3
    kept = fitted(js.MeanCurvatureFlow(keep_volume=True, smoothing=h))
    assert abs(kept[0]) < 1e-4 and abs(kept[1] / smooth[1] - 1) < 1e-3


def on_tori(ratio, willmore):
    """The velocity at an angle, of a torus with the radii `ratio` and 1."""
    around = lambda a: ratio + jnp.cos(a)
    mean = lambda a: (ratio + 2 * jnp.cos(a)) / (2 * around(a))
    flux = lambda a: around(a) * jax.grad(mean)(a)

    def velocity(a):
        gauss = jnp.cos(a) / around(a)
        lower = 2 * mean(a) * (mean(a) ** 2 - gauss)
        return jax.grad(flux)(a) / around(a) + willmore * lower

    return jax.vmap(velocity)


@pytest.mark.slow
@pytest.mark.parametrize("name", FLOWS)
def test_velocities_on_tori(name):
    """Of fourth order by GFDM(4); Clifford's torus, R/r = √2, stands still by Willmore's flow."""
    angles = jnp.linspace(0, 6, 20)
    if name == "Willmore":
        np.testing.assert_allclose(on_tori(2**0.5, 1)(angles), 0, atol=1e-14)
    errors = []
    for n in (800, 1_600):
        surface = js.discretize(js.torus(n, 2.0, 1.0), method=METHOD)
        x, y, z = surface.cloud.points.T
        exact = on_tori(2.0, name == "Willmore")(jnp.arctan2(z, jnp.hypot(x, y) - 2))
        found = FLOWS[name].velocity(0.0, surface, (), None)
        wrong = found - exact[:, None] * surface.cloud.normals
        errors.append(float(jnp.linalg.norm(wrong) / jnp.linalg.norm(exact)))
    assert errors[1] < 0.012 and 2 * np.log2(errors[0] / errors[1]) > 3.3


@pytest.mark.slow
@pytest.mark.parametrize("name", FLOWS)
def test_energies_fall_on_the_way_to_a_sphere(name):
    cloud = js.ellipsoid(500, (1.5, 1.0, 1.0))
    run = js.evolve(FLOWS[name], cloud, t1=0.3, saveat=[0.0, 0.02], method=METHOD, rtol=1e-4)
    energies = [bending(surface) for surface in run.surfaces]
    assert np.all(np.diff(energies) < 0) and abs(energies[-1] / (4 * np.pi) - 1) < 0.01
    if name == "diffusion":
        assert np.all(np.diff(run.history["area"]) < 0)
        np.testing.assert_allclose(run.history["volume"], run.history["volume"][0], rtol=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("degree", [2, 4])
@pytest.mark.parametrize("name", FLOWS)
def test_no_displacement_of_single_points_grows(name, degree):
    """The derivative of the velocity in all positions, whose true eigenvalues are at most 0."""
    cloud = js.sphere(150)
    moving = Moving.of(js.discretize(cloud, method=js.GFDM(degree=degree)), FLOWS[name], None)
    rate = lambda x: moving.rate(0.0, (x.reshape(-1, 3),), None)[0].ravel()
    modes = np.linalg.eigvals(jax.jit(jax.jacfwd(rate))(cloud.points.ravel()))
    assert modes.real.max() < 2e-3 * np.abs(modes).max()


@pytest.mark.slow
def test_motions_are_added_and_multiplied():
    """A field that drives growth against curvature: r' = b u - a / r, u diluted as r."""
    grow = js.Motion(lambda t, s, u, b: b * u[:, None] * s.cloud.normals)
    motion = 0.25 * (2 * js.MeanCurvatureFlow() + grow) + grow
    assert motion.derivatives == 2 and (grow * 2 + grow).derivatives == 0
    assert repr(motion).startswith(
        "0.5 * MeanCurvatureFlow(keep_volume=False, smoothing=None) + 0.25"
    )
    cloud = js.circle(80)
    heat = lambda surface: js.AdvectionDiffusionReaction(surface.laplacian)
    given = dict(problem=heat, method=METHOD, args=1.2, rtol=1e-6, t1=0.4)
    rate = lambda t, r: 1.25 * 1.2 / r - 0.25 / r
    wanted = solve_ivp(rate, (0, 0.4), [1.0], rtol=1e-10, atol=1e-10).y[0, -1]
    for solver in (None, js.IMEX(order=3)):
        run = js.evolve(motion, cloud, fields=jnp.ones(80), solver=solver, **given)
        radii = np.linalg.norm(run.clouds[-1].points, axis=1)
        np.testing.assert_allclose(radii, wanted, rtol=3e-5)
        np.testing.assert_allclose(run.fields[-1], 1 / wanted, rtol=3e-5)


@pytest.mark.slow
def test_derivatives_through_a_flow():
    """In a factor and in points, against differences, by fixed steps."""
    angle = 2 * jnp.pi * jnp.arange(40) / 40
    ellipse = js.from_points(jnp.stack([1.2 * jnp.cos(angle), jnp.sin(angle)], axis=1))
    surface = js.discretize(ellipse, method=METHOD)
    way = 0.1 * jnp.exp(surface.cloud.points)
    grow = js.Motion(lambda t, s, u, b: s.cloud.points)

    def f(a, b):
        cloud = dataclasses.replace(surface.cloud, points=surface.cloud.points + b * way)
        start = js.Discretization(cloud, surface.neighbors, METHOD)
        motion = a * js.SurfaceDiffusionFlow() + grow
        end = js.evolve(motion, start, t1=0.01, solver=js.IMEX(order=2), dt0=0.005, rtol=1e-3)
        return jnp.sum(end.clouds[-1].points[:, 0] ** 4)

    run, at, h = jax.jit(jax.value_and_grad(f, argnums=(0, 1))), (1.0, 0.0), 1e-4
    for i, slope in enumerate(run(*at)[1]):
        above, below = (run(*(a + e * (i == j) for j, a in enumerate(at)))[0] for e in (h, -h))
        assert abs(float(slope) / float((above - below) / (2 * h)) - 1) < 1e-5


@pytest.mark.slow
def test_in_single_precision():
    circle = js.circle(40)
    single = js.PointCloud(*(a.astype(jnp.float32) for a in (circle.points, circle.normals)))
    found = js.evolve(FLOWS["Willmore"], single, t1=1.0, method=METHOD).clouds[-1].points
    assert found.dtype == jnp.float32
    np.testing.assert_allclose(jnp.linalg.norm(found, axis=1), 2**0.25, rtol=1e-3)
