"""Slopes and absolute errors; the long sweeps are in `experiments`."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxsurf as js

from .helpers import (
    check_derivatives,
    exponential,
    jittered_sphere,
    random_sphere,
    relative_error,
)


def error(cloud, method):
    u, gradient, laplacian = exponential(cloud.points)
    surface = js.discretize(cloud, method=method)
    return [
        relative_error(surface.laplacian(u), laplacian),
        relative_error(surface.gradient(u), gradient),
        relative_error(surface.divergence(gradient), laplacian),
    ]


# Errors of Laplacian, gradient and divergence at n = 8,000, about 1.3 times those measured,
# and the least slope of each from 2,000 to 8,000.
_CASES = {
    "DCPSE2": (js.DCPSE(order=2), (3.5e-3, 5.5e-3, 6.5e-3), (1.8, 1.8, 1.8)),
    "DCPSE3": (js.DCPSE(order=3), (1e-4, 6e-5, 8e-5), (2.8, 2.8, 2.8)),
    "DCPSE4": (js.DCPSE(order=4), (1.1e-5, 2.1e-5, 2.9e-5), (3.8, 3.8, 3.8)),
    "GFDM3": (js.GFDM(degree=3), (2.5e-3, 2e-5, 5e-5), (1.8, 2.8, 2.8)),
    "GFDM4": (js.GFDM(degree=4), (2e-5, 8e-6, 3e-5), (2.8, 3.8, 3.8)),
    "RBFFD4": (js.RBFFD(degree=4), (3.3e-5, 2.8e-6, 1.03e-5), (2.8, 3.8, 3.8)),
}
_SLOW = ("DCPSE3", "GFDM3")  # on the harder points only


@pytest.mark.parametrize(
    "points, method, bounds, slopes",
    [
        *[
            pytest.param(js.sphere, *case, id=f"fibonacci-{name}")
            for name, case in _CASES.items()
            if name not in _SLOW
        ],
        *[
            pytest.param(
                jittered_sphere,
                *case,
                id=f"jittered-{name}",
                marks=[pytest.mark.slow] * (name in _SLOW),
            )
            for name, case in _CASES.items()
        ],
    ],
)
def test_convergence_on_the_sphere(points, method, bounds, slopes):
    coarse, fine = error(points(2000), method), error(points(8000), method)
    measured = np.log2(np.array(coarse) / np.array(fine))
    assert np.all(np.array(fine) < bounds), fine
    assert np.all(measured > slopes), measured


def test_circle_with_the_papers_parameters():
    """Singh et al. 2023, Fig. 2c: second order with a support just below two spacings."""
    errors = []
    for n in (80, 160, 320):
        cloud, step = js.circle(n), 3 / (n - 1)
        neighbors = js.find_neighbors(cloud, radius=4.1 * step)
        method = js.DCPSE(order=2, layers=4, layer_spacing=step)
        u = cloud.points[:, 0] + cloud.points[:, 1]
        laplacian = js.laplace_beltrami(cloud, neighbors, method=method, throw=False)
        errors.append(float(jnp.abs(laplacian(u) + u).max()))
    assert errors[-1] < 2.5e-4
    assert np.all(np.log2(np.divide(errors[:-1], errors[1:])) > 1.95), errors


@pytest.mark.parametrize("order, spacings, bound", [(2, 1.0, 5.7e-2), (4, 1.15, 3.8e-5)])
def test_sphere_with_the_papers_parameters(order, spacings, bound):
    """Singh et al. 2023, Fig. 3c, at N = 16,000: the largest error for Y40."""
    n = 16_000
    cloud, step = js.sphere(n), 0.8 / (n ** (1 / 3) - 1)
    # Our cut-off is smooth and at one half where the paper's kernel ends.
    support = 2.9 * step / 0.76
    width = spacings * (4 * np.pi / n) ** 0.5 / support
    method = js.DCPSE(order=order, layers=2, layer_spacing=step, width=width)
    laplacian = js.laplace_beltrami(cloud, js.find_neighbors(cloud, radius=support), method=method)
    z = cloud.points[:, 2]
    u = 3 / 16 / jnp.sqrt(jnp.pi) * (35 * z**4 - 30 * z**2 + 3)
    assert jnp.abs(laplacian(u) + 20 * u).max() < bound


def test_layers_of_the_papers_default():
    """Mean distance between layers: enough at order 2, not at order 4, where ours are denser."""
    cloud = jittered_sphere(2000)
    u, _, exact = exponential(cloud.points)
    errors = {}
    for order in (2, 4):
        method = js.DCPSE(order=order)
        neighbors = js.find_neighbors(cloud, k=method.neighbor_count(3))
        ours = js.laplace_beltrami(cloud, neighbors, method=method)
        support = ours.diagnostics.support[:, None]
        distance = jnp.linalg.norm(cloud.points[neighbors.indices] - cloud.points[:, None], axis=2)
        inside = (distance > 0) & (distance < support)
        mean = float(jnp.sum(distance * inside) / jnp.sum(inside))
        paper = js.DCPSE(
            order=order, layer_spacing=mean, layers=round(float(support.mean()) / mean)
        )
        theirs = js.laplace_beltrami(cloud, neighbors, method=paper, throw=False)
        errors[order] = [relative_error(operator(u), exact) for operator in (ours, theirs)]
    assert errors[2][1] < 1.1 * errors[2][0] < 1.3e-2
    assert errors[4][0] < 2e-4 and errors[4][1] > 0.1


@pytest.mark.parametrize("method", [js.GFDM(degree=2), js.GFDM(degree=4)], ids=str)
@pytest.mark.parametrize("points", [random_sphere, jittered_sphere], ids=["random", "jittered"])
def test_expected_error_is_near_the_error(points, method):
    """Of 300 and 1,500 points, on which they differ by factors; on a plane it is round-off."""
    expected, seen = [], []
    for n in (300, 1_500):
        surface = js.discretize(points(n), method=method)
        u, _, exact = exponential(surface.cloud.points)
        expected.append(float(surface.expected_error))
        seen.append(relative_error(surface.laplacian(u), exact))
    ratio = np.array(expected) / np.array(seen)
    assert np.all((ratio > 0.2) & (ratio < 4)), (expected, seen)
    assert expected[1] < expected[0] / 3


def test_expected_error_in_single_precision():
    """It stays in it, with the values and derivatives of double precision."""
    cloud, method = jittered_sphere(300), js.GFDM(degree=4)
    less = js.PointCloud(*(x.astype(jnp.float32) for x in (cloud.points, cloud.normals)))
    surface = js.discretize(cloud, method=method)
    single = js.discretize(less, surface.neighbors, method=method)
    assert single.expected_error.dtype == jnp.float32
    np.testing.assert_allclose(single.expected_error, surface.expected_error, atol=1e-5)
    slopes = [
        jax.grad(lambda x, s=s: s.moved(x, s.cloud.normals).expected_error)(s.cloud.points)
        for s in (single, surface)
    ]
    assert slopes[0].dtype == jnp.float32
    off = np.abs(slopes[0] - slopes[1]).max()
    assert off < 1e-2 * np.abs(slopes[1]).max(), off


def test_derivatives_of_the_expected_error():
    cloud, method = jittered_sphere(150), js.GFDM(degree=2)
    neighbors = js.find_neighbors(cloud, method.neighbor_count(3))

    def expected(points, normals):
        cloud = js.PointCloud(points, normals / jnp.linalg.norm(normals, axis=1, keepdims=True))
        return js.discretize(cloud, neighbors, method=method).expected_error

    check_derivatives(expected, cloud.points, cloud.normals)


def test_expected_error_of_a_plane_in_units_of_its_size():
    flat = np.stack(np.meshgrid(*(np.linspace(0, 1e-3, 15),) * 2), axis=2).reshape(-1, 2)
    cloud = js.PointCloud(np.c_[flat, 0 * flat[:, 0]], np.tile([[0.0, 0, 1]], (225, 1)))
    surface = js.discretize(cloud, method=js.GFDM(degree=2))
    assert surface.expected_error < 1e-9
