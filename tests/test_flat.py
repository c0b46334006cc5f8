"""Flat DC-PSE (Singh et al. 2023, Section 2): reproduction, slopes, borders."""

import jax.numpy as jnp
import numpy as np
import pytest

import jaxsurf as js

from .helpers import check_derivative, relative_error

pytestmark = pytest.mark.slow


def square(m, dim=2, seed=0):
    """A jittered grid on the unit square or cube."""
    axis = (np.arange(m) + 0.5) / m
    grid = np.stack(np.meshgrid(*[axis] * dim, indexing="ij"), axis=-1).reshape(-1, dim)
    return jnp.asarray(grid + np.random.default_rng(seed).uniform(-0.2, 0.2, grid.shape) / m)


@pytest.mark.parametrize("alpha", [(1, 0), (0, 2), (1, 1), (2, 1), (2, 2), (1, 0, 1), (0, 0, 3)])
@pytest.mark.parametrize("order", [2, 3])
def test_polynomials_are_exact(alpha, order):
    """All monomials up to degree |alpha| + r - 1, also in one-sided stencils at the border."""
    dim = len(alpha)
    points = square(14 if dim == 2 else 8, dim)
    operator = js.partial_derivative(points, alpha, method=js.FlatDCPSE(order=order))
    degree = sum(alpha) + order - 1
    rng = np.random.default_rng(1)
    direction = rng.normal(size=dim) / 2
    s = points @ direction
    factor = np.prod([d**a for d, a in zip(direction, alpha)])
    falling = np.prod([degree - i for i in range(sum(alpha))])
    exact = factor * falling * s ** (degree - sum(alpha))
    size = float(jnp.sum(jnp.abs(operator.weights), axis=0).max())
    np.testing.assert_allclose(operator(s**degree), exact, atol=1e-11 * size)


@pytest.mark.parametrize("alpha", [(1, 0), (2, 0), (1, 1)])
@pytest.mark.parametrize("order, bound", [(2, 2e-2), (4, 5e-4)])
def test_convergence(alpha, order, bound):
    errors = []
    for m in (20, 40):
        points = square(m)
        x, y = points.T
        operator = js.partial_derivative(points, alpha, method=js.FlatDCPSE(order=order))
        derivative = {
            (1, 0): 2 * jnp.cos(2 * x + y),
            (2, 0): -4 * jnp.sin(2 * x + y),
            (1, 1): -2 * jnp.sin(2 * x + y),
        }[alpha]
        errors.append(relative_error(operator(jnp.sin(2 * x + y)), derivative))
    assert errors[1] < bound
    assert np.log2(errors[0] / errors[1]) > order - 0.2, errors


def test_odd_operators_are_conservative_on_symmetric_points():
    """On a grid the weights are odd: central differences, without the centre."""
    axis = np.arange(9.0)
    points = jnp.asarray(np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2))
    whole_shells = js.find_neighbors(points, k=21)
    operator = js.partial_derivative(points, (1, 0), neighbors=whole_shells)
    middle = operator.weights[:, 40]
    offsets = points[operator.indices[:, 40]] - points[40]
    for w, offset in zip(middle, offsets):
        mirror = jnp.argmin(jnp.linalg.norm(offsets + offset, axis=1))
        np.testing.assert_allclose(middle[mirror], -w, atol=1e-12)


def test_derivative_in_points():
    points = square(8)
    neighbors = js.find_neighbors(points, k=30)
    u = jnp.sin(points[:, 0] * 3 + points[:, 1])

    def total(points):
        return jnp.sum(jnp.sin(js.partial_derivative(points, (1, 1), neighbors=neighbors)(u)))

    check_derivative(total, points)


def test_bad_multi_index():
    with pytest.raises(ValueError, match=r"alpha = \(1, -1\)"):
        js.partial_derivative(square(6), (1, -1))
    with pytest.raises(ValueError, match=r"alpha = \(1,\) is no derivative in 2"):
        js.partial_derivative(square(6), (1,))
