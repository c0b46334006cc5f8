"""Spectra of the default Laplacians: no eigenvalue with positive real part beyond round-off."""

import warnings

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg

import jaxsurf as js
from experiments import data

from .helpers import METHODS, check_derivatives, jittered_sphere, label, random_sphere

CLOUDS = {
    "fibonacci": js.sphere(800),
    "jittered": jittered_sphere(800),
    "random": random_sphere(800),
    "torus": js.torus(800, 1.0, 0.5),
}


@pytest.mark.parametrize("name", CLOUDS)
@pytest.mark.parametrize("method", METHODS, ids=label)
def test_spectrum(name, method):
    operator = js.laplace_beltrami(CLOUDS[name], method=method)
    values = scipy.linalg.eigvals(operator.to_scipy().toarray())
    assert values.real.max() < 1e-8 * np.abs(values).max()
    # One constant in the kernel, and on the sphere the first eigenvalue -2, three times.
    if name != "torus":
        lowest = np.sort(np.abs(values))[:4]
        assert lowest[0] < 1e-9
        np.testing.assert_allclose(lowest[1:], 2, rtol=0.1)


def test_irregular_points_get_larger_neighborhoods():
    """Of as many points, which reach farther."""
    method = js.GFDM(degree=2)
    even = js.choose_neighbors(CLOUDS["fibonacci"], method=method)
    random = js.choose_neighbors(CLOUDS["random"], method=method)
    nearest = js.find_neighbors(CLOUDS["random"], k=even.k)
    assert even.k == method.neighbor_count(3) == random.k and random.mask.all()
    usual = np.all(random.indices == nearest.indices, axis=1)
    assert 0.8 < np.mean(usual) < 1
    points = np.asarray(CLOUDS["random"].points)
    reach = [np.linalg.norm(points[a.indices[:, -1]] - points, axis=1) for a in (random, nearest)]
    farther = (reach[0] / reach[1])[~usual]
    assert farther.min() > 1 and farther.mean() > 1.05**0.5  # of a tenth more points at least
    adapted = js.laplace_beltrami(CLOUDS["random"], random, method=method).weights
    assert jnp.all(-adapted[0] > 0.2 * jnp.sum(jnp.abs(adapted[1:]), axis=0))
    plain = js.laplace_beltrami(CLOUDS["random"], nearest, method=method).weights
    assert jnp.any(plain[0] > 0)


def scan(read, n):
    try:
        return read(n)
    except FileNotFoundError as error:
        pytest.skip(str(error))


def test_folds_of_a_scan_get_smaller_neighborhoods():
    cloud = scan(data.bunny, 2_960)
    method = js.GFDM(degree=2)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # it bends within one stencil
        counts = np.asarray(js.choose_neighbors(cloud, method=method).mask.sum(axis=1))
        spectrum = js.spectral_estimate(js.laplace_beltrami(cloud, method=method))
    usual = method.neighbor_count(3)
    assert counts.min() < usual == counts.max()
    assert spectrum.abscissa < 1e-6 * spectrum.radius


def test_folds_that_no_neighbourhood_serves_get_positive_weights():
    """A dozen of rows in the folds of the Armadillo gave it modes that grow."""
    cloud = scan(data.armadillo, 10_000)
    method = js.GFDM(degree=4)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # it bends within one stencil
        operator = js.laplace_beltrami(cloud, method=method)
    told, weights = operator.diagnostics, np.asarray(operator.weights)
    # Beyond the range in which they take over.
    folds = np.asarray((told.dominance < method.least_dominance - 0.1) & (told.tube > 1.5))
    assert 0 < folds.sum() < 0.005 * cloud.n
    assert (weights[1:, folds] >= 0).all()
    squared = np.sum((cloud.points[operator.indices] - cloud.points) ** 2, axis=2)
    np.testing.assert_allclose((weights * squared).sum(axis=0)[folds], 4, rtol=1e-9)
    spectrum = js.spectral_estimate(operator)
    assert spectrum.abscissa < 1e-8 * spectrum.radius


def test_a_centre_of_the_wrong_sign_grows_nothing():
    """A single row, where the surface bends a little less than asked for, grew by itself."""
    cloud = scan(data.armadillo, 8_000)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # it bends within one stencil
        operator = js.laplace_beltrami(cloud, method=js.GFDM(degree=4))
    told = operator.diagnostics
    assert ((told.dominance < 0) & (told.tube < 1)).any()
    spectrum = js.spectral_estimate(operator)
    assert spectrum.abscissa < 1e-8 * spectrum.radius


class AsTheyAre(js.GFDM):
    """Keeps its weights, wherever the centre is not dominant."""

    least_dominance = -np.inf


def test_positive_weights_take_over_smoothly():
    """Weights between two kinds have the derivative of differences; others are what they were."""
    cloud = random_sphere(120)
    lists = js.find_neighbors(cloud, k=40, throw=False)
    built = lambda cloud, method: js.laplace_beltrami(cloud, lists, method=method, throw=False)
    own, blended = (np.asarray(built(cloud, m(degree=4)).weights) for m in (AsTheyAre, js.GFDM))
    between = (own != blended).any(axis=0)
    assert 5 < between.sum() < 30
    assert (own[1:, between] < 0).any(axis=0).all() and (blended[1:, between] < 0).any()
    field = jnp.sin(3 * cloud.points[:, 0]) + cloud.points[:, 1] ** 2
    partly = np.flatnonzero(between & (blended[1:] < 0).any(axis=0))[:4]

    def values(points, normals):
        return built(js.PointCloud(points, normals), js.GFDM(degree=4))(field)[partly]

    check_derivatives(values, cloud.points, cloud.normals, rtol=1e-5)


def test_no_heat_grows_at_a_rough_border():
    """One value that was extrapolated to the border of the bunny made it grow."""
    cloud = scan(data.bunny, 2_960)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # it bends within one stencil
        surface = js.discretize(cloud)
        closure = js.without_flux(surface)
        spectrum = js.spectral_estimate(closure.reduce(surface.laplacian))
    assert spectrum.abscissa < 1e-8 * spectrum.radius


def test_weights_of_one_sign_take_over_smoothly_at_a_border():
    bowl = lambda s: (jnp.sin(s), -jnp.cos(s))
    # Curvature times reach is 1.16 on its border: two thirds of the way from 1 to 1.25.
    cap = js.surface_of_revolution(bowl, 100)
    surface = js.discretize(cap, js.find_neighbors(cap, k=60))
    closure = js.without_flux(surface)
    assert (closure.weights < 0).any()

    def values(points, normals):
        moved = js.Discretization(
            js.PointCloud(points, normals), surface.neighbors, surface.method, surface.border
        )
        return js.without_flux(moved)(cap.points[:, 2])[closure.rows[:4]]

    check_derivatives(values, cap.points, cap.normals, rtol=1e-5)
