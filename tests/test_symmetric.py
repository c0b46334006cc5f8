"""`surface.symmetric_laplacian`: what holds by construction, on any points, and its order."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.sparse
import scipy.sparse.linalg

import jaxsurf as js
from experiments import surfaces
from experiments.report import relative_l2

from .helpers import check_derivatives

pytestmark = [
    pytest.mark.slow,
    pytest.mark.filterwarnings("ignore:the surface bends"),
    pytest.mark.filterwarnings("ignore:no neighbourhood"),
]
METHOD = js.GFDM(degree=2)
N = 300


def made(kind, surface, method=METHOD, n=N):
    return js.discretize(surface.cloud(kind, n), method=method)


def form(surface):
    """The matrix of the bilinear form, dense."""
    masses = np.asarray(surface.cell_areas)
    return masses[:, None] * surface.symmetric_laplacian.to_scipy().toarray()


@pytest.mark.core
@pytest.mark.parametrize(
    ("kind", "of", "method"),
    [
        ("Poisson disk", surfaces.torus(), METHOD),
        ("random", surfaces.sphere(), METHOD),
        ("jittered", surfaces.ellipsoid(), js.DCPSE(order=2)),
    ],
    ids=["torus", "sphere", "ellipsoid"],
)
def test_symmetric_and_semidefinite_on_any_points(kind, of, method):
    surface = made(kind, of, method)
    matrix, masses = form(surface), np.asarray(surface.cell_areas)
    assert (masses > 0).all()
    np.testing.assert_allclose(masses.sum(), surface.areas.sum(), rtol=1e-12)
    size = np.abs(matrix).max()
    assert np.abs(matrix - matrix.T).max() < 1e-14 * size
    assert (matrix - np.diag(np.diag(matrix)) >= 0).all()
    assert np.abs(matrix.sum(axis=1)).max() < 1e-14 * size  # constants
    assert np.abs(matrix.sum(axis=0)).max() < 1e-14 * size  # mass
    values = np.linalg.eigvalsh(matrix / np.sqrt(masses)[:, None] / np.sqrt(masses))
    assert values[-1] < 1e-14 * -values[0]
    assert values[-2] < -0.05  # one part


def test_solutions_are_of_second_order():
    """In the mean; the largest error falls less evenly on jittered points."""
    of = surfaces.ellipsoid()

    def error(n):
        surface = made("jittered", of, n=n)
        u, laplacian = map(np.asarray, of.exact(surface.cloud))
        matrix = surface.symmetric_laplacian.to_scipy()
        one = scipy.sparse.eye_array(n)
        found = scipy.sparse.linalg.spsolve((one - matrix).tocsc(), u - laplacian)
        return relative_l2(found, u)

    coarse, fine = error(500), error(2_000)
    assert fine < 3e-3
    assert np.log2(coarse / fine) > 1.7


def test_derivatives():
    surface = js.discretize(js.ellipsoid(90, (1.0, 0.9, 0.8)), method=METHOD)
    x = surface.cloud.points
    weights = jnp.asarray(np.random.default_rng(1).normal(size=(2, 90)))

    def energy(points):
        moved = surface.moved(points)
        return weights[0] @ moved.symmetric_laplacian(weights[1])

    check_derivatives(energy, x, rtol=1e-5)


def test_heat_never_grows_and_waves_keep_their_energy():
    surface = made("random", surfaces.ellipsoid())
    operator, masses = surface.symmetric_laplacian, surface.cell_areas
    u = jnp.asarray(np.random.default_rng(2).normal(size=N))
    heat = js.integrate(js.AdvectionDiffusionReaction(operator), u, t1=2.0, rtol=1e-6).ys[-1]
    assert abs(masses @ heat - masses @ u) < 1e-12 * (masses @ jnp.abs(u))
    assert masses @ heat**2 < masses @ u**2
    assert u.min() <= heat.min() and heat.max() <= u.max()

    def energy(u, v):
        return masses @ (v**2 - u * operator(u)) / 2

    start = jnp.cos(surface.cloud.points[:, 0])
    end = js.integrate(js.WaveEquation(operator), (start, 0 * start), t1=5.0, rtol=1e-7).ys
    u, v = (a[-1] for a in end)
    assert abs(energy(u, v) / energy(start, 0 * start) - 1) < 1e-3


def test_natural_condition_at_a_border():
    def error(m):
        surface = js.discretize(js.graph(lambda x, y: 0 * x, (m, m)), method=METHOD)
        matrix, masses = form(surface), np.asarray(surface.cell_areas)
        assert np.abs(matrix - matrix.T).max() < 1e-14 * np.abs(matrix).max()
        values = np.linalg.eigvalsh(matrix / np.sqrt(masses)[:, None] / np.sqrt(masses))
        length = np.ptp(np.asarray(surface.cloud.points)[:, 0])
        return abs(values[-2] * (length / np.pi) ** 2 + 1)

    coarse, fine = error(10), error(20)
    assert fine < 0.01
    assert np.log2(coarse / fine) > 1.5


def test_points_that_are_off_have_no_part_in_it():
    cloud = js.sphere(200)
    on = np.ones(200, bool)
    on[[3, 90]] = False
    masked = js.PointCloud(cloud.points.at[3].set(jnp.nan), cloud.normals, active=jnp.asarray(on))
    small = js.PointCloud(cloud.points[on], cloud.normals[on])
    one, other = (js.discretize(c, method=METHOD) for c in (masked, small))
    u = cloud.points[:, 2] ** 2
    found = one.symmetric_laplacian(u)
    assert (found[~on] == 0).all() and (one.cell_areas[~on] == 0).all()
    np.testing.assert_allclose(found[on], other.symmetric_laplacian(u[on]), rtol=1e-7, atol=1e-7)


def test_single_precision():
    surface = js.discretize(js.sphere(200), method=METHOD)
    single = jax.tree.map(
        lambda a: a.astype(jnp.float32) if eqx.is_inexact_array(a) else a, surface
    )
    u = surface.cloud.points[:, 2]
    exact, found = surface.symmetric_laplacian(u), single.symmetric_laplacian(u.astype(jnp.float32))
    assert found.dtype == jnp.float32
    assert jnp.abs(found - exact).max() < 1e-3 * jnp.abs(exact).max()
