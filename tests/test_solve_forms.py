"""Solves and modes in their other forms: images, a user's preconditioner, float32, vmap, prompt."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest

import jaxsurf as js

from .helpers import central_difference, check_derivatives, count_compilations

pytestmark = pytest.mark.slow

METHOD = js.DCPSE(order=2)
GFDM = js.GFDM(degree=2)


def single(tree):
    """The same arrays in single precision, to be called where x64 is off."""

    def one(a):
        a = np.asarray(a)
        return jnp.asarray(a.astype(np.float32) if a.dtype == np.float64 else a)

    return jax.tree.map(one, tree)


@pytest.fixture(scope="module")
def screened():
    """-Δ + 1 on the sphere."""
    cloud = js.sphere(320)
    operator = 1 - js.laplace_beltrami(cloud, method=METHOD)
    return cloud, operator


@pytest.fixture(scope="module", params=["neumann", "dirichlet"])
def mirrored(request):
    """The square [-1, 1]² continued by images, and its exact modes: cosines or sines."""
    cloud = js.graph(lambda x, y: 0 * x, (19, 19))
    even = request.param == "neumann"
    wide, closure = js.with_ghosts(cloud, getattr(js, request.param)(cloud.boundary))
    operator = js.laplace_beltrami(wide, method=GFDM)
    x, y = wide.points[:, 0], wide.points[:, 1]
    wave = jnp.cos if even else jnp.sin
    first = wave(jnp.pi * (x + 1) / 2) * wave(jnp.pi * (y + 1))
    numbers = np.array([0, 1, 1, 2] if even else [2, 5, 5, 8])
    return cloud, operator, closure, first, numbers * np.pi**2 / 4


# --- at the prompt --------------------------------------------------------------------------


def test_modes_of_another_operator_compile_nothing():
    cloud = js.sphere(330)
    operators = [s * js.laplace_beltrami(cloud, method=METHOD) for s in (1.0, 2.0)]
    cap = cloud.points[:, 2] > 0.8
    closures = [js.eliminate(cloud, js.dirichlet(cap, value)) for value in (0.0, 1.0)]

    def programs(operator, closure=None):
        with count_compilations() as names:
            js.eigenmodes(operator, 4, closure=closure)
        return names

    first = programs(operators[0])
    assert len(first) <= 4, first  # 19 when every step was a program of its own
    assert not (again := programs(operators[1])), again
    first = programs(operators[0], closures[0])
    assert len(first) <= 4, first
    assert not (again := programs(operators[1], closures[1])), again


# --- derivatives ----------------------------------------------------------------------------


def test_gradient_of_values_in_normals():
    cloud = js.ellipsoid(320, (1.0, 0.8, 0.65))
    neighbors = js.choose_neighbors(cloud, method=METHOD)
    weight = jnp.array([0.0, 1.0, -2.0, 3.0])

    @jax.jit
    def operator(normals):
        normals = normals / jnp.linalg.norm(normals, axis=1, keepdims=True)
        return js.laplace_beltrami(js.PointCloud(cloud.points, normals), neighbors, method=METHOD)

    def total(normals):
        return weight @ js.eigenmodes(operator(normals), 4).values

    direction = jnp.asarray(np.random.default_rng(0).normal(size=cloud.normals.shape))
    direction = direction / jnp.linalg.norm(direction)
    expected = central_difference(total, cloud.normals, direction, 1e-3)
    found = float(jnp.vdot(jax.grad(total)(cloud.normals), direction))
    np.testing.assert_allclose(found, expected, rtol=1e-6)


def test_other_reactions_compile_nothing(screened):
    """Other numbers and new lambdas of the same code; what a lambda closes over is a number too."""
    cloud, operator = screened
    z, preconditioner = cloud.points[:, 2], js.jacobi(operator)

    def total(strength, rate):
        reaction = lambda u, a: strength * u + a * u**3
        options = {"args": rate, "rhs": z, "preconditioner": preconditioner, "rtol": 1e-12}
        return jnp.sum(js.solve_nonlinear(operator, reaction, 0 * z, **options).value ** 2)

    total(1.0, 2.0)
    with count_compilations() as names:
        low, high = (total(1.1 + change, 2.1) for change in (-1e-4, 1e-4))
    assert not names
    slope = jax.grad(total)(1.1, 2.1)
    assert float(slope) == pytest.approx(float(high - low) / 2e-4, rel=1e-6)


# --- images ---------------------------------------------------------------------------------


def test_solve_with_images(mirrored):
    cloud, operator, closure, exact, _ = mirrored
    screened = 1 - operator
    rhs = (1 + 5 * np.pi**2 / 4) * exact
    found = js.solve(screened, rhs, closure=closure)
    error = jnp.linalg.norm((found.value - exact)[: cloud.n]) / jnp.linalg.norm(exact[: cloud.n])
    assert error < 0.05


def test_modes_with_images(mirrored):
    cloud, operator, closure, _, exact = mirrored
    modes = js.eigenmodes(operator, 4, closure=closure)
    np.testing.assert_allclose(modes.values, exact, rtol=0.06, atol=1e-8)
    assert modes.imaginary.max() < 1e-8
    if exact[0] > 0:
        x, y = cloud.points[:, 0], cloud.points[:, 1]
        lowest = jnp.cos(jnp.pi * x / 2) * jnp.cos(jnp.pi * y / 2)
        inside = modes.functions[: cloud.n, 0]
        scale = jnp.vdot(inside, lowest) / jnp.vdot(lowest, lowest)
        assert jnp.abs(inside / scale - lowest).max() < 0.02


# --- a user's own preconditioner ------------------------------------------------------------


class TwoSweeps(js.AbstractPreconditioner):
    """Two sweeps of Jacobi's iteration, D⁻¹ (2 - A D⁻¹): what a user may write."""

    operator: js.AbstractOperator
    inverse: jax.Array

    @property
    def n(self):
        return self.operator.n

    def __call__(self, r):
        x = self.inverse * r
        return 2 * x - self.inverse * self.operator(x)


def test_a_preconditioner_of_ones_own(screened):
    cloud, operator = screened
    z = cloud.points[:, 2]
    rhs = jnp.exp(z)
    expected = js.solve(operator, rhs, preconditioner=js.jacobi(operator), rtol=1e-11)
    # The operator is well conditioned here: with h² = 0.04 its diagonal is below 200.
    own = TwoSweeps(False, operator, 1 / operator.diagonal)
    found = js.solve(operator, rhs, preconditioner=own, rtol=1e-11)
    np.testing.assert_allclose(found.value, expected.value, rtol=1e-9)
    assert found.stats["num_steps"] < expected.stats["num_steps"]

    def total(weights, f):
        moved = eqx.tree_at(lambda o: o.weights, operator, weights)
        return jnp.sum(js.solve(moved, f, preconditioner=own, rtol=1e-13).value ** 3)

    check_derivatives(total, operator.weights, rhs, step=1e-2)


# --- several at once ------------------------------------------------------------------------


def test_vmap_over_weights_and_right_hand_sides(screened):
    cloud, operator = screened
    f = jnp.stack([cloud.points[:, 2], jnp.exp(cloud.points[:, 0])])
    weights = jnp.stack([operator.weights, (operator + 2).weights])
    preconditioner = js.jacobi(operator)

    @jax.jit
    def one(weights, f):
        moved = eqx.tree_at(lambda o: o.weights, operator, weights)
        options = {"preconditioner": preconditioner, "mean_zero": False, "rtol": 1e-11}
        return js.solve(moved, f, **options).value

    alone = jnp.stack([one(weights[0], f[0]), one(weights[1], f[1])])
    np.testing.assert_allclose(jax.vmap(one)(weights, f), alone, atol=1e-9)
    np.testing.assert_allclose(jax.vmap(one, (None, 0))(weights[0], f)[0], alone[0], atol=1e-9)
    # z is a harmonic, -Δ z = 2 z: shifts of 1 and 3.
    z = cloud.points[:, 2]
    many = jax.vmap(one, (0, None))(weights, z)
    np.testing.assert_allclose(many, jnp.stack([z / 3, z / 5]), atol=2e-3)


def test_vmap_of_reactions(screened):
    cloud, operator = screened
    z = cloud.points[:, 2]
    preconditioner = js.jacobi(operator)

    def one(strength):
        rhs = 3 * z + strength * z**3
        return js.solve_nonlinear(
            operator, lambda u, a: a * u**3, 0 * z, args=strength, rhs=rhs,
            preconditioner=preconditioner,
        ).value  # fmt: skip

    found = jax.jit(jax.vmap(one))(jnp.array([0.5, 2.0]))
    np.testing.assert_allclose(found, jnp.stack([z, z]), atol=5e-3)
    jitted = (
        js.jacobi(operator).divisor,
        jax.vmap(lambda w: js.jacobi(w * operator).divisor),
    )
    np.testing.assert_allclose(jitted[1](jnp.array([1.0, 2.0]))[1], 2 * jitted[0], rtol=1e-12)


# --- single precision -----------------------------------------------------------------------


def test_single_precision(screened):
    """With x64 off, JAX's default, nothing is in double precision: bounds of 1e-4 of double's."""
    cloud, operator = screened
    modes = js.eigenmodes(-operator, 4)
    reaction = lambda u, a: a * u**3
    z = cloud.points[:, 2]
    rhs = 3 * z + z**3
    preconditioner = js.jacobi(operator)
    options = {"args": 1.0, "rhs": rhs, "preconditioner": preconditioner}
    exact = js.solve_nonlinear(operator, reaction, 0 * z, **options).value

    def strength_to_total(a, operator, z, rhs, preconditioner):
        options = {"args": a, "rhs": rhs, "preconditioner": preconditioner}
        return jnp.sum(js.solve_nonlinear(operator, reaction, 0 * z, **options).value * z)

    expected = jax.grad(strength_to_total)(1.0, operator, z, rhs, preconditioner)
    with jax.enable_x64(False):
        operator, z, rhs = single((operator, z, rhs))
        found = js.eigenmodes(-operator, 4)
        assert found.values.dtype == found.functions.dtype == jnp.float32
        np.testing.assert_allclose(found.values, modes.values, rtol=1e-4)
        np.testing.assert_allclose(found.functions[:, 0], modes.functions[:, 0], atol=1e-3)
        preconditioner = js.jacobi(operator)
        assert preconditioner.divisor.dtype == jnp.float32
        options = {"args": 1.0, "rhs": rhs, "preconditioner": preconditioner}
        u = js.solve_nonlinear(operator, reaction, 0 * z, **options)
        assert u.result == optx.RESULTS.successful
        assert u.value.dtype == jnp.float32
        np.testing.assert_allclose(u.value, exact, atol=1e-4)
        # Both differentiate there as well.
        slope = jax.grad(strength_to_total)(jnp.float32(1), operator, z, rhs, preconditioner)
        change = jax.grad(lambda s: js.eigenmodes(-s * operator, 4).values[0])(1.0)
        assert slope.dtype == change.dtype == jnp.float32
        np.testing.assert_allclose(change, modes.values[0], rtol=1e-3)
    assert slope == pytest.approx(float(expected), rel=1e-3)


def test_conditions_made_in_compiled_code():
    """Who is bound and by whom is known there: a factor of a condition can be an unknown."""
    patch = js.discretize(js.graph(lambda x, y: 0.3 * x * y, (12, 12)), method=GFDM)
    points, border = patch.cloud.points, np.flatnonzero(patch.cloud.boundary)

    def heat(kind):
        def observed(a, stretch):
            surface = patch.moved(stretch * points)
            closures = {
                "robin": lambda: js.eliminate(surface, js.robin(border, 1.0, a=a, b=1.0)),
                "dirichlet": lambda: js.eliminate(surface, js.dirichlet(border, a)),
                "without_flux": lambda: js.without_flux(surface),
            }
            operator, closure = a - surface.laplacian, closures[kind]()
            u = js.solve(operator, points[:, 0] ** 2, closure=closure, mean_zero=False, rtol=1e-11)
            return u.value @ points[:, 1] ** 2

        return observed

    for kind in ("robin", "dirichlet", "without_flux"):
        plain, both = heat(kind), jax.value_and_grad(heat(kind), argnums=(0, 1))
        found, slopes = jax.jit(both)(0.7, 1.1)
        np.testing.assert_allclose(found, plain(0.7, 1.1), rtol=1e-9)
        for slope, difference in zip(
            slopes,
            (
                central_difference(lambda a, f=plain: f(a, 1.1), 0.7, 1.0, 1e-4),
                central_difference(lambda s, f=plain: f(0.7, s), 1.1, 1.0, 1e-4),
            ),
        ):
            np.testing.assert_allclose(slope, difference, rtol=1e-5)
