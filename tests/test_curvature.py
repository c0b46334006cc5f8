import jax.numpy as jnp
import numpy as np
import pytest

import jaxsurf as js

from .helpers import METHODS, label, relative_error


def torus_curvature(points, big=3.0):
    rho = jnp.linalg.norm(points[:, :2], axis=1)
    across = (rho - big) / rho  # principal curvatures 1 and cos(theta) / rho
    return (1 + across) / 2, across


@pytest.mark.parametrize("method", METHODS, ids=label)
def test_torus(method):
    cloud = js.torus(6000, 3.0, 1.0)
    surface = js.discretize(cloud, method=method)
    mean, gauss = torus_curvature(cloud.points)
    bound = {"DCPSE2": 8e-3, "DCPSE4": 1.5e-4, "GFDM2": 6e-3, "GFDM4": 2e-4, "RBFFD4": 2e-4}[
        label(method)
    ]
    assert relative_error(surface.mean_curvature, mean) < bound
    assert relative_error(surface.gauss_curvature, gauss) < 2 * bound
    curvatures, directions = surface.principal_curvatures
    assert relative_error(curvatures, jnp.stack([gauss, jnp.ones(cloud.n)], axis=1)) < bound
    np.testing.assert_allclose(
        jnp.cross(directions[:, 0], directions[:, 1]), cloud.normals, atol=1e-9
    )
    # The direction of the smaller curvature runs around the axis.
    around = jnp.stack([-cloud.points[:, 1], cloud.points[:, 0], 0 * mean], axis=1)
    around /= jnp.linalg.norm(around, axis=1, keepdims=True)
    assert jnp.abs(jnp.abs(jnp.sum(around * directions[:, 0], axis=1)) - 1).max() < 10 * bound
    vector = js.mean_curvature_vector(cloud, surface.neighbors, method=method)
    # Twice the mean curvature by the Laplacian, which of RBF-FD is less accurate than the gradient.
    times = 10 if isinstance(method, js.RBFFD) else 3
    assert relative_error(vector, -2 * mean[:, None] * cloud.normals) < times * bound
    tensor = surface.shape_tensor
    np.testing.assert_allclose(jnp.einsum("nab,nb->na", tensor, cloud.normals), 0, atol=1e-12)


def test_ellipsoid_converges_at_second_order():
    """Singh et al. 2023, Fig. 4c (E6), with our defaults."""
    axes = (1.0, 0.8, 0.75)
    errors = []
    for n in (2000, 8000):
        cloud = js.ellipsoid(n, axes)
        exact = js.level_set_curvature(
            lambda x: jnp.sum((x / jnp.array(axes)) ** 2) - 1, cloud.points
        )
        values = js.mean_curvature(cloud), js.gauss_curvature(cloud)
        errors.append([float(jnp.abs(v - e).max()) for v, e in zip(values, exact)])
    assert np.all(np.log2(np.divide(*errors)) > 1.7), errors
    assert errors[1][0] < 7e-3 and errors[1][1] < 2.4e-2, errors


def test_spheres_are_umbilic():
    cloud = js.sphere(500, radius=2.0)
    curvatures, directions = js.principal_curvatures(cloud, method=js.GFDM(degree=2))
    np.testing.assert_allclose(curvatures, 0.5, rtol=1e-10)
    np.testing.assert_allclose(jnp.linalg.norm(directions, axis=2), 1)


def test_curves_have_no_gauss_curvature():
    with pytest.raises(ValueError, match="the cloud has 2"):
        js.gauss_curvature(js.circle(30))
