"""Outermost and rightmost eigenvalues against those of the matrix."""

import functools
import warnings

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.sparse

import jaxsurf as js

from .helpers import METHODS, count_compilations, jittered_sphere, label

N = 400


class Matrix(js.AbstractOperator):
    """A user's operator."""

    matrix: np.ndarray

    n = property(lambda self: len(self.matrix))
    in_shape = ()
    out_shape = ()

    def __call__(self, u):
        return jnp.asarray(self.matrix) @ u

    def transpose(self):
        return Matrix(self.matrix.T)

    def to_scipy(self):
        return scipy.sparse.csr_matrix(self.matrix)


@functools.cache
def laplacian():
    return js.laplace_beltrami(js.sphere(N))


@functools.cache
def growing():
    """One row with the wrong sign: an eigenvalue of +74 beside a radius of 100."""
    return jnp.ones(N).at[100].set(-1.0) * laplacian()


@functools.cache
def exact_growing():
    return np.linalg.eigvals(growing().to_scipy().toarray())


def check(operator, *, rtol=1e-8, exact=None, **settings):
    """Radius within a per cent, abscissa within `rtol` of the radius."""
    if exact is None:
        exact = np.linalg.eigvals(operator.to_scipy().toarray().astype(float))
    radius, abscissa = np.abs(exact).max(), exact.real.max()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = js.spectral_estimate(operator, **settings)
    assert abs(found.radius - radius) <= 0.015 * radius
    assert abs(found.abscissa - abscissa) <= rtol * radius
    assert found.residual <= 1e-8 * radius
    return found


@pytest.mark.parametrize("method", METHODS, ids=label)
def test_stable_operators(method):
    operator = js.laplace_beltrami(jittered_sphere(N), method=method)
    estimate = check(operator)
    assert abs(estimate.abscissa) < 1e-10 * estimate.radius


@pytest.mark.parametrize("steps", [10, 20, 40, 60, 80, 120])
def test_a_growing_mode_is_found(steps):
    exact = exact_growing().real.max()
    assert exact > 10
    found = js.spectral_estimate(growing(), steps=steps)
    np.testing.assert_allclose(found.abscissa, exact, rtol=1e-7)


@pytest.mark.parametrize("degree", [1, 6, 60])
def test_any_degree_serves(degree):
    check(growing(), degree=degree, exact=exact_growing())


def test_perturbed_and_permuted():
    """Nothing hangs on the last bit, or on the order of a sum."""
    matrix = growing().to_scipy().toarray()
    exact = exact_growing()
    rng = np.random.default_rng(5)
    for steps in (20, 40, 60, 80, 120):
        order = rng.permutation(N)
        turned = matrix[order][:, order] * (1 + 1e-15 * rng.normal(size=matrix.shape))
        check(Matrix(turned), exact=exact, steps=steps)


@pytest.mark.parametrize("growth", [1e-6, 1e-4, 1e-2, 1.0, 1e2, 1e6])
def test_growing_modes_of_every_size_in_skew_bases(growth):
    n, rng = 300, np.random.default_rng(3)
    values = -1000 * np.linspace(0, 1, n) ** 2
    values[5] = growth * 1000
    turn = lambda: np.linalg.qr(rng.normal(size=(n, n)))[0]
    basis = turn() @ np.diag(np.geomspace(1, 10, n)) @ turn()
    check(Matrix(basis @ np.diag(values) @ np.linalg.inv(basis)), exact=values + 0j)


@pytest.mark.parametrize("shift", [1e-5, 1e-2, 1.0, 1e3])
def test_one_point_that_grows(shift):
    found = check(laplacian() + jnp.zeros(N).at[100].set(shift))
    assert found.abscissa > 0


@pytest.mark.parametrize("factor", [0.0, -1e-4, -1e-2])
def test_values_that_are_held(factor):
    """Half of the rows are zero, and one of the others may make a mode that grows."""
    z = js.sphere(N).points[:, 2]
    rows = jnp.where(z > 0, 1.0, 0.0).at[jnp.argmax(z)].multiply(factor if factor else 1)
    check(rows * laplacian())


@pytest.mark.parametrize("real,imaginary", [(1e-3, 0.3), (1e-2, 0.5), (0.1, 0.9), (1, 2)])
def test_growing_oscillations(real, imaginary):
    matrix = np.diag(-1000 * np.linspace(0, 1, 300) ** 2)
    matrix[10:12, 10:12] = 1000 * np.array([[real, imaginary], [-imaginary, real]])
    found = check(Matrix(matrix))
    assert found.abscissa == pytest.approx(1000 * real, rel=1e-6)


@pytest.mark.parametrize("growth", [0.0, 20.0])
def test_waves(growth):
    """All eigenvalues on the imaginary axis but for one pair."""
    zero, frequency = np.zeros((150, 150)), np.diag(np.linspace(0, 1000, 150))
    matrix = np.block([[zero, frequency], [-frequency, zero]])
    matrix[7, 7] = matrix[157, 157] = growth
    found = check(Matrix(matrix))
    assert found.abscissa == pytest.approx(growth, abs=1e-6)


def test_many_eigenvalues_of_one_real_part_are_told():
    frequency = np.linspace(0, 1000, 510)
    off = scipy.sparse.diags(frequency)
    matrix = scipy.sparse.bmat([[None, off], [-off, None]]).toarray()
    with pytest.warns(UserWarning, match=r"abscissa .* residual of .* steps = 40"):
        found = js.spectral_estimate(Matrix(matrix))
    assert found.residual > 1e-6
    assert abs(found.radius / 1000 - 1) < 0.015
    assert abs(found.abscissa) < 1e-6


def test_defective_matrices():
    """A Jordan block of size two: its eigenvalue has an error of the root of the residual's."""
    matrix = np.diag(-np.arange(400.0) - 1)
    matrix[3:5, 3:5] = [[50, 30], [0, 50]]
    check(Matrix(matrix), exact=np.append(np.diag(matrix), 50) + 0j, rtol=1e-5)


def test_matrices_of_noise():
    check(Matrix(np.random.default_rng(1).normal(size=(300, 300))))
    check(Matrix(-np.eye(300)))
    assert js.spectral_estimate(Matrix(np.zeros((300, 300)))) == (0, 0, 0)


@pytest.mark.parametrize("n", [1, 2, 3, 50, 151])
def test_few_points(n):
    check(Matrix(np.random.default_rng(n).normal(size=(n, n))))


@pytest.mark.parametrize("scale", [1e-290, 1e290])
def test_any_units(scale):
    plain, scaled = (js.spectral_estimate(a) for a in (growing(), scale * growing()))
    np.testing.assert_allclose(np.array(scaled) / scale, plain, rtol=1e-6, atol=1e-6)


def test_single_precision():
    """The weights decide, not the precision in which the operator would be applied."""
    worse = growing()
    single = js.Stencil(worse.indices, worse.weights.astype(jnp.float32))
    found = check(single)
    np.testing.assert_allclose(found.abscissa, js.spectral_estimate(worse).abscissa, rtol=1e-5)


def test_compositions_and_components():
    cloud = js.sphere(N)
    check(js.biharmonic(cloud))
    with pytest.raises(ValueError, match=r"not from \(\) to \(3,\) components"):
        js.spectral_estimate(js.surface_gradient(cloud))


def test_nothing_is_compiled():
    operator = laplacian()
    with count_compilations() as names:
        js.spectral_estimate(operator)
    assert names == []
