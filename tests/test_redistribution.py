"""Points that slide along a surface until they are even."""

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxsurf as js

METHOD = js.GFDM(degree=4)
SLIDE = js.Redistribution(0.5)
pytestmark = pytest.mark.slow


def crowded(n, offset=0.3):
    """The unit sphere with points that crowd at its top."""
    x = js.sphere(n).points + jnp.array([0, 0, offset])
    x = x / jnp.linalg.norm(x, axis=1, keepdims=True)
    return js.discretize(js.PointCloud(x, x), method=METHOD)


def circle(bump, n=60):
    angle = 2 * jnp.pi * jnp.arange(n) / n
    angle = angle + bump * jnp.sin(angle)
    x = jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=1)
    return js.discretize(js.PointCloud(x, x), method=METHOD)


def spread(values):
    return float(jnp.std(values) / jnp.mean(values))


def test_density_diffuses_and_all_else_stays():
    r"""By $\partial_t \rho = D \Delta \rho$ the mean of z over points falls as exp(-2 D t)."""
    surface = crowded(1_000)
    x, _, z = surface.cloud.points.T
    fields = x * z, jnp.stack([x, z], axis=1)
    run = js.evolve(SLIDE, surface, t1=4.0, fields=fields, saveat=[0.5])
    assert run.stats["solver"].startswith("RKC2")
    fell = float(jnp.mean(run.clouds[0].points[:, 2]) / jnp.mean(z))
    assert abs(fell / np.exp(-0.5) - 1) < 0.03
    for end, (product, both), bound in zip(run.surfaces, run.fields, (4e-5, 2e-4)):
        np.testing.assert_allclose(jnp.linalg.norm(end.cloud.points, axis=1), 1, atol=bound)
        x, _, z = end.cloud.points.T
        np.testing.assert_allclose(product, x * z, atol=bound)
        np.testing.assert_allclose(both, jnp.stack([x, z], axis=1), atol=bound)
    uneven = [spread(s.cell_areas) for s in (surface, *run.surfaces)]
    assert uneven[1] < 0.65 * uneven[0] and uneven[2] < 0.05 * uneven[0]


def test_heat_is_as_on_points_at_rest():
    """Its integral too, though each point leaves its own behind."""
    surface = crowded(500)
    heat = lambda surface: js.AdvectionDiffusionReaction(surface.laplacian)
    z = surface.cloud.points[:, 2]
    run = js.evolve(SLIDE, surface, t1=0.5, fields=z + 2, problem=heat, rtol=1e-6, saveat=[0.0])
    np.testing.assert_array_equal(run.clouds[0].points, surface.cloud.points)
    np.testing.assert_allclose(run.clouds[0].normals, surface.cloud.normals, atol=1e-15)
    error = lambda u, z: float(jnp.abs(u - np.exp(-1) * z - 2).max())
    rest = js.integrate(heat(surface), z + 2, t1=0.5, rtol=1e-6).ys[-1]
    assert error(run.fields[-1], run.clouds[-1].points[:, 2]) < 1.2 * error(rest, z)
    lost = lambda mass: abs(float(mass / run.history["mass"][0]) - 1)
    assert lost(run.history["mass"][-1]) < 1.2 * lost(surface.integrate(rest))


def test_curves_and_spacings_that_vary():
    gaps = lambda x: jnp.linalg.norm(jnp.roll(x, -1, axis=0) - x, axis=1)
    even = js.evolve(js.Redistribution(1.0), circle(0.5), t1=4.0).clouds[-1].points
    assert spread(gaps(circle(0.5).cloud.points)) > 0.3 and spread(gaps(even)) < 0.01
    wanted = lambda x: 1 + 0.4 * x[:, 0]
    slide = js.Redistribution(1.0, lambda t, surface, fields, args: wanted(surface.cloud.points))
    x = js.evolve(slide, circle(0.0), t1=4.0).clouds[-1].points
    between = (x + jnp.roll(x, -1, axis=0)) / 2
    assert spread(gaps(x)) > 0.25 and spread(gaps(x) / wanted(between)) < 0.02


def test_a_flow_with_it_has_the_same_surface_even_points_and_fewer_steps():
    """Of Willmore's flow points move along normals, and crowd where an ellipsoid draws together."""
    surface = js.discretize(js.ellipsoid(400, (1.5, 1.0, 1.0)), method=METHOD)
    flow, given = js.WillmoreFlow(), dict(t1=0.2, rtol=1e-4)
    alone, both = (js.evolve(m, surface, **given) for m in (flow, flow + js.Redistribution(1.0)))
    for name in ("area", "volume"):
        np.testing.assert_allclose(both.history[name], alone.history[name], rtol=2e-3)
    uneven, steps = (
        [of(run) for run in (alone, both)]
        for of in (lambda r: spread(r.surfaces[-1].cell_areas), lambda r: r.stats["steps"])
    )
    assert uneven[1] < 0.75 * uneven[0] and steps[1] < steps[0]


def test_derivatives_and_single_precision():
    """In the diffusivity, the points and a field, against differences; two at once."""
    surface = circle(0.3, 40)
    points, normals = surface.cloud.points, surface.cloud.normals
    way = 0.1 * jnp.sin(2 * points[:, ::-1])
    weights = jnp.exp(points[:, 1])

    def f(diffusivity, points, u):
        start = js.Discretization(js.PointCloud(points, normals), surface.neighbors, METHOD)
        slide = js.Redistribution(diffusivity)
        given = dict(fields=u, solver=dfx.Heun(), dt0=0.002, t1=0.004)
        end = js.evolve(slide, start, **given)
        return jnp.vdot(end.fields[-1], weights * jnp.exp(end.clouds[-1].points[:, 0]))

    at, ways = (jnp.asarray(0.5), points, points[:, 1]), (1.0, way, points[:, 0])
    run, h = jax.jit(jax.value_and_grad(f, argnums=(0, 1, 2))), 1e-4
    for i, slope in enumerate(run(*at)[1]):
        above, below = (
            run(*(a + e * ways[j] * (i == j) for j, a in enumerate(at)))[0] for e in (h, -h)
        )
        difference = float((above - below) / (2 * h))
        assert abs(float(jnp.vdot(slope, ways[i])) - difference) < 1e-6 * abs(difference) + 1e-8
    two = jax.jit(jax.vmap(f, (0, None, None)))(jnp.array([0.5, 0.25]), *at[1:])
    np.testing.assert_allclose(two, [run(a, *at[1:])[0] for a in (0.5, 0.25)], rtol=1e-12)
    single = js.PointCloud(*(a.astype(jnp.float32) for a in (points, normals)))
    ends = [js.evolve(SLIDE, cloud, t1=0.1, rtol=1e-4) for cloud in (single, surface.cloud)]
    one, other = (end.clouds[-1].points for end in ends)
    assert one.dtype == jnp.float32
    np.testing.assert_allclose(one, other, atol=1e-4)
