"""Eigenmodes: values, groups, bases, conditions, and derivatives against central differences."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxsurf as js
from jaxsurf.solve import inverse

from .helpers import check_derivative, jittered_sphere

# Minutes in all.
pytestmark = pytest.mark.slow

_SPHERE = np.repeat([0.0, 2.0, 6.0, 12.0, 20.0], [1, 3, 5, 7, 9])


@functools.cache
def laplacian(n, order=4):
    """Of the sphere; few sizes, as each takes seconds to compile."""
    return js.laplace_beltrami(js.sphere(n), method=js.DCPSE(order=order))


@pytest.fixture(scope="module")
def sphere_modes():
    cloud = js.sphere(2_000)
    return cloud, js.eigenmodes(laplacian(cloud.n), 25)


@pytest.mark.core
def test_groups_of_the_sphere(sphere_modes):
    _, modes = sphere_modes
    np.testing.assert_allclose(modes.values, _SPHERE, rtol=2e-4, atol=1e-10)
    assert np.all(np.diff(modes.values) >= 0)
    np.testing.assert_array_equal(modes.groups, np.repeat(range(5), [1, 3, 5, 7, 9]))
    assert modes.imaginary.max() < 1e-10
    assert modes.residuals.max() < 1e-8


@pytest.mark.core
def test_functions_of_the_sphere(sphere_modes):
    cloud, modes = sphere_modes
    np.testing.assert_allclose(modes.functions[:, 0], 1, atol=1e-10)
    # The first group spans the coordinates, up to the order of the method.
    basis = modes.functions[:, 1:4]
    np.testing.assert_allclose(basis.T @ basis / cloud.n, np.eye(3), atol=1e-12)
    rest = cloud.points - basis @ (basis.T @ cloud.points) / cloud.n
    assert jnp.abs(rest).max() < 1e-4


def test_a_basis_belongs_to_its_space_alone(sphere_modes):
    """Neither noise in the operator nor the number of modes asked for turns the functions."""
    cloud, modes = sphere_modes
    operator = laplacian(cloud.n)
    noise = jnp.asarray(np.random.default_rng(0).normal(size=cloud.n))
    again = js.eigenmodes((1 + 1e-9 * noise) * operator, 18)
    np.testing.assert_allclose(again.functions[:, :9], modes.functions[:, :9], atol=1e-6)


def test_values_converge_at_the_order_of_the_method():
    def error(n, order):
        values = js.eigenmodes(laplacian(n, order), 9).values
        return np.abs(values[1:] / _SPHERE[1:9] - 1).max()

    # Fourth order is not seen before 1,500 points.
    for order, coarse, bound in ((2, 500, 6e-3), (4, 1_500, 1.5e-5)):
        fine = error(4 * coarse, order)
        assert fine < bound
        assert np.log2(error(coarse, order) / fine) > order - 0.2


def test_dirichlet_conditions():
    """Half a sphere with the equator held: the odd harmonics, 2, 6, 6, 12, 12, 12."""
    cloud = js.sphere(2_400)
    below = cloud.points[:, 2] < 0
    cloud = js.PointCloud(cloud.points[~below], cloud.normals[~below])
    edge = jnp.arange(200) * jnp.pi / 100
    ring = jnp.stack([jnp.cos(edge), jnp.sin(edge), 0 * edge], axis=1)
    keep = cloud.points[:, 2] > 0.02
    points = jnp.concatenate([cloud.points[keep], ring])
    bound = jnp.arange(len(points)) >= len(points) - 200
    cloud = js.PointCloud(points, points, boundary=bound)
    conditions = js.eliminate(cloud, [js.dirichlet(bound)])
    modes = js.eigenmodes(js.laplace_beltrami(cloud), 6, closure=conditions)
    np.testing.assert_allclose(modes.values, [2, 6, 6, 12, 12, 12], rtol=2e-2)
    assert jnp.abs(modes.functions[bound]).max() == 0
    z = cloud.points[:, 2]
    first = modes.functions[:, 0] / jnp.vdot(modes.functions[:, 0], z) * jnp.vdot(z, z)
    assert jnp.linalg.norm(first - z) < 1e-2 * jnp.linalg.norm(z)


@pytest.mark.core
def test_conjugate_pairs():
    r"""On a circle $u'' + c u'$ has the eigenvalues $-m^2 \pm i c m$."""
    n, c = 64, 0.05
    indices = jnp.stack([(jnp.arange(n) + s) % n for s in (0, 1, -1)])
    h = 2 * jnp.pi / n

    def operator(c):
        weights = jnp.array([-2 / h**2, 1 / h**2 + c / 2 / h, 1 / h**2 - c / 2 / h])
        return js.Stencil(indices, jnp.broadcast_to(weights[:, None], (3, n)))

    modes = js.eigenmodes(operator(c), 5)
    m = np.array([0, 1, 1, 2, 2])
    np.testing.assert_allclose(modes.values, (2 - 2 * np.cos(m * h)) / h**2, atol=1e-9)
    np.testing.assert_allclose(modes.imaginary, c * np.sin(m * h) / h, atol=1e-9)
    np.testing.assert_array_equal(modes.groups, m)
    assert modes.residuals.max() < 1e-9
    scaled = jax.grad(lambda s: jnp.sum(js.eigenmodes(s * operator(c), 5).values))(1.0)
    assert abs(scaled / modes.values.sum() - 1) < 1e-10


# --- derivatives ----------------------------------------------------------------------------

_METHOD = js.DCPSE(order=2)
_ELLIPSOID = js.ellipsoid(350, (1.0, 0.8, 0.65))
_NEIGHBORS = js.choose_neighbors(_ELLIPSOID, method=_METHOD)


def _moved(cloud, neighbors, points):
    return js.laplace_beltrami(js.PointCloud(points, cloud.normals), neighbors, method=_METHOD)


def test_derivatives_of_simple_modes():
    weight = jnp.array([0.0, 1.0, -2.0, 3.0, 0.5, 1.0])
    probe = jnp.asarray(np.random.default_rng(1).normal(size=(_ELLIPSOID.n, 4)))

    def observed(points):
        modes = js.eigenmodes(_moved(_ELLIPSOID, _NEIGHBORS, points), 6)
        functions = modes.functions[:, :4]
        return jnp.stack(
            [weight @ modes.values, jnp.sum(probe * functions) + jnp.sum(functions**3)]
        )

    check_derivative(observed, _ELLIPSOID.points, step=1e-4)


def test_derivatives_of_what_belongs_to_a_group():
    """Symmetric functions of its values, and the projection on its space, which turns smoothly.

    The modes in it need not. In a factor for each row, as the operator moves with the points above.
    """
    cloud = jittered_sphere(500)
    operator = js.laplace_beltrami(cloud, method=_METHOD)
    field = jnp.exp(cloud.points @ jnp.array([1.0, 2.0, 1.5]))

    def observed(noise):
        modes = js.eigenmodes((1 + noise) * operator, 9, degenerate=0.1)
        values, functions = modes.values, modes.functions[:, 1:4]
        symmetric = values[1:4].sum() + jnp.prod(values[4:9]) ** 0.2 + jnp.sum(values[4:9] ** 2)
        return jnp.stack([symmetric, jnp.sum((functions.T @ field / cloud.n) ** 2)])

    check_derivative(observed, jnp.zeros(cloud.n), step=1e-3)


@pytest.mark.core
def test_exactly_equal_values():
    """Fibonacci points and order 4 split the values by 1e-5; here they are not split at all."""
    n = 48
    indices = jnp.stack([(jnp.arange(n) + s) % n for s in (0, 1, -1)])
    other = jnp.asarray(np.random.default_rng(0).normal(size=n))

    def total(s):
        weights = jnp.array([[-2.0], [1.0], [1.0]]) * (1 + s * other)
        return jnp.sum(js.eigenmodes(js.Stencil(indices, weights), 5).values[1:3] * 100)

    step = 1e-4
    expected = float(total(step) - total(-step)) / (2 * step)
    np.testing.assert_allclose(jax.grad(total)(0.0), expected, rtol=1e-6)


def test_derivative_in_the_conditions():
    cloud = js.graph(lambda x, y: 0.2 * x * y, (16, 18))
    operator = js.laplace_beltrami(cloud, method=js.GFDM(degree=2))
    closure = js.eliminate(cloud, [js.robin(cloud.boundary, 0.0, a=1.0, b=0.5)])

    def value(weights):
        conditions = eqx.tree_at(lambda c: c.weights, closure, weights)
        modes = js.eigenmodes(operator, 2, closure=conditions)
        return modes.values[0] + jnp.mean(modes.functions[:, 1] ** 4)

    check_derivative(value, closure.weights, step=1e-4)


def test_second_derivatives_are_refused():
    def value(s):
        return js.eigenmodes(_moved(_ELLIPSOID, _NEIGHBORS, s * _ELLIPSOID.points), 3).values[1]

    with pytest.raises(TypeError, match="differentiated once only"):
        jax.grad(jax.grad(value))(1.0)


# --- transformations, precision, size -------------------------------------------------------


def test_under_jit_and_vmap():
    operator = laplacian(500, 2)
    modes = js.eigenmodes(operator, 4)
    traced = jax.jit(lambda o: js.eigenmodes(o, 4))(operator)
    np.testing.assert_allclose(traced.values, modes.values, atol=1e-10)
    np.testing.assert_allclose(traced.functions, modes.functions, atol=1e-10)
    scales = jnp.array([1.0, 4.0])
    values = jax.vmap(lambda s: js.eigenmodes(s * operator, 4).values)(scales)
    np.testing.assert_allclose(values, scales[:, None] * modes.values, atol=1e-9)


def test_no_full_matrix_in_the_derivative():
    n = _ELLIPSOID.n

    def values(points):
        modes = js.eigenmodes(_moved(_ELLIPSOID, _NEIGHBORS, points), 4)
        return modes.values.sum() + modes.functions.sum()

    assert f"{n},{n}" not in str(jax.make_jaxpr(jax.grad(values))(_ELLIPSOID.points))


def test_single_precision():
    operator = laplacian(500, 2)
    single = jax.tree.map(lambda a: a.astype(jnp.float32) if a.dtype == float else a, operator)
    modes = js.eigenmodes(single, 4)
    assert modes.values.dtype == modes.functions.dtype == jnp.float32
    np.testing.assert_allclose(modes.values, js.eigenmodes(operator, 4).values, atol=1e-3)


def test_multigrid_takes_a_right_hand_side_without_imaginary_part(monkeypatch):
    """Its relative residual was no number, and an error."""
    pytest.importorskip("pyamg")
    monkeypatch.setattr(inverse, "_FACTORISED", 100)
    z = np.asarray(js.sphere(500).points[:, 2])
    operator = js.laplace_beltrami(js.sphere(500), method=js.GFDM(degree=2))
    inverted = inverse.Inverse(-operator.to_scipy().tocsr(), shift=-1.0)
    np.testing.assert_array_equal(inverted(z + 0j), inverted(z))
    np.testing.assert_allclose(inverted(z), z / 3, atol=0.02)


def test_multigrid_gives_the_same(monkeypatch):
    pytest.importorskip("pyamg")
    operator = laplacian(500, 2)
    probe = jnp.asarray(np.random.default_rng(0).normal(size=operator.n))

    def observed(scale):
        modes = js.eigenmodes((1 + scale * probe) * operator, 2, degenerate=0.1)
        return modes.values.sum() + modes.functions[:, 1] @ probe

    expected = jax.value_and_grad(observed)(0.0)
    monkeypatch.setattr(inverse, "_FACTORISED", 100)
    np.testing.assert_allclose(jax.value_and_grad(observed)(0.0), expected, rtol=1e-8)


# --- misuse ---------------------------------------------------------------------------------


def test_misuse():
    cloud = js.sphere(500)
    operator = laplacian(cloud.n, 2)
    with pytest.raises(ValueError, match=r"not from \(\) to \(3,\) components"):
        js.eigenmodes(js.surface_gradient(cloud), 3)
    with pytest.raises(ValueError, match="k = 0 modes, between 1 and n / 2 = 250"):
        js.eigenmodes(operator, 0)
    with pytest.raises(ValueError, match="began at value 2 and has not ended"):
        js.eigenmodes(operator, 4, degenerate=0.9)
    broken = jnp.ones(cloud.n).at[7].set(jnp.nan) * operator
    with pytest.raises(ValueError, match="row 7 of the operator is not finite"):
        js.eigenmodes(broken, 4)
