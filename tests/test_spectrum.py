import jax.numpy as jnp
import numpy as np
import pytest

import jaxsurf as js

from .helpers import METHODS, jittered_sphere, label


@pytest.mark.parametrize("method", METHODS, ids=label)
def test_stable_operators(method):
    operator = js.laplace_beltrami(jittered_sphere(500), method=method)
    exact = np.linalg.eigvals(operator.to_scipy().toarray())
    estimate = js.spectral_estimate(operator)
    assert 0.95 < estimate.radius / np.abs(exact).max() < 1.001
    assert abs(estimate.abscissa) < 1e-6 * estimate.radius


def test_a_growing_mode_is_found():
    operator = js.laplace_beltrami(js.sphere(500))
    worse = operator.scaled(jnp.ones(500).at[100].set(-1.0))
    exact = np.linalg.eigvals(worse.to_scipy().toarray()).real.max()
    assert exact > 10
    assert abs(js.spectral_estimate(worse).abscissa / exact - 1) < 0.02


def test_compositions_and_components():
    cloud = js.sphere(400)
    bilaplacian = js.biharmonic(cloud)
    exact = np.abs(np.linalg.eigvals(bilaplacian.to_scipy().toarray())).max()
    assert 0.9 < js.spectral_estimate(bilaplacian).radius / exact < 1.001
    with pytest.raises(ValueError, match=r"not from \(\) to \(3,\) components"):
        js.spectral_estimate(js.surface_gradient(cloud))
