"""Sums, products, multiples and transposes of operators: what matrices do, without them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxsurf as js
from jaxsurf.solve.newton import Map
from jaxsurf.stencils.algebra import Transposed

from .helpers import check_derivatives

CLOUD = js.ellipsoid(200, (1.0, 0.9, 0.8))
LISTS = js.find_neighbors(CLOUD, k=20)
METHOD = js.GFDM(degree=2)
L = js.laplace_beltrami(CLOUD, LISTS, method=METHOD)
M = js.directional_derivative(CLOUD, jnp.eye(3)[0], neighbors=LISTS, method=METHOD)
G = js.surface_gradient(CLOUD, LISTS, method=METHOD)
D = js.surface_divergence(CLOUD, LISTS, method=METHOD)
F, U = jnp.asarray(np.random.default_rng(0).normal(size=(2, CLOUD.n)))
FIELD = np.asarray(F)
DENSE = {"L": L.to_scipy().toarray(), "M": M.to_scipy().toarray()}
ONE = np.eye(CLOUD.n)
# Sliced backwards, a row's own slot is the last one.
BACKWARDS = js.Stencil(L.indices[::-1], L.weights[::-1])

EXPRESSIONS = {
    "-L + 1": (lambda: -L + 1, lambda L, M: ONE - L, True),
    "1 - L": (lambda: 1 - L, lambda L, M: ONE - L, True),
    "2 * L - L / 4": (lambda: 2 * L - L / 4, lambda L, M: 1.75 * L, True),
    "L * 2": (lambda: L * np.float32(2), lambda L, M: 2 * L, True),
    "f * L": (lambda: F * L, lambda L, M: FIELD[:, None] * L, True),
    "NumPy's f * L": (lambda: FIELD * L, lambda L, M: FIELD[:, None] * L, True),
    "L + f": (lambda: L + F, lambda L, M: L + np.diag(FIELD), True),
    "NumPy's f - L": (lambda: FIELD - L, lambda L, M: np.diag(FIELD) - L, True),
    "L + M, of one geometry": (lambda: L + M, lambda L, M: L + M, True),
    "backwards": (lambda: BACKWARDS - 3 * L, lambda L, M: -2 * L, False),
    "backwards + f": (lambda: BACKWARDS + F, lambda L, M: L + np.diag(FIELD), False),
    "L @ L": (lambda: L @ L, lambda L, M: L @ L, False),
    "M - 0.1 * L @ L": (lambda: M - 0.1 * L @ L, lambda L, M: M - 0.1 * L @ L, False),
    "L.T + 1": (lambda: L.T + 1, lambda L, M: L.T + ONE, False),
    "(L @ M + f).T": (lambda: (L @ M + F).T, lambda L, M: (L @ M + np.diag(FIELD)).T, False),
    "L.T.T": (lambda: L.T.T, lambda L, M: L, True),
    "L @ Diagonal(f)": (lambda: L @ js.Diagonal(F), lambda L, M: L * FIELD, False),
    "f * (L @ L)": (lambda: F * (L @ L), lambda L, M: FIELD[:, None] * (L @ L), False),
    "identity": (lambda: 3 * js.identity(CLOUD.n) - L, lambda L, M: 3 * ONE - L, False),
}  # fmt: skip


@pytest.mark.parametrize("name", EXPRESSIONS)
def test_operators_are_added_and_multiplied_as_matrices(name):
    make, dense, is_stencil = EXPRESSIONS[name]
    operator, expected = make(), dense(**DENSE)
    size = 1e-12 * np.abs(expected).max() * np.sqrt(CLOUD.n)
    near = lambda a, b: np.testing.assert_allclose(a, b, atol=size, rtol=1e-12)
    assert isinstance(operator, js.Stencil) == is_stencil  # what one set of slots can hold
    assert (operator.n, operator.in_shape, operator.out_shape) == (CLOUD.n, (), ())
    near(operator.to_scipy().toarray(), expected)
    near(operator @ U, expected @ U)
    near(operator(jnp.stack([U, F], axis=1)), expected @ np.stack([U, F], axis=1))
    near(operator.T @ U, expected.T @ U)
    near(operator.T.to_scipy().toarray(), expected.T)
    near(jax.jit(lambda operator, u: operator @ u)(operator, U), expected @ U)
    near(jax.jit(lambda operator, u: operator.T @ u)(operator, U), expected.T @ U)
    single = operator(U.astype(jnp.float32))
    assert single.dtype == jnp.float64  # that of the weights


@pytest.mark.parametrize("operator", [L, G, D, D @ G, (2 * G).T + D], ids=repr)
def test_transposes_with_components(operator):
    matrix = operator.to_scipy().toarray()
    rng = np.random.default_rng(1)
    u = jnp.asarray(rng.normal(size=(CLOUD.n, *operator.in_shape)))
    v = jnp.asarray(rng.normal(size=(CLOUD.n, 2, *operator.out_shape)))
    np.testing.assert_allclose(np.ravel(operator(u)), matrix @ np.ravel(u), atol=1e-10)
    for turned in (operator.T, Transposed(operator)):  # by gathers, and by JAX
        expected = [matrix.T @ np.ravel(v[:, c]) for c in range(2)]
        found = [np.ravel(turned(v)[:, c]) for c in range(2)]
        np.testing.assert_allclose(found, expected, atol=1e-10)
        assert (turned.in_shape, turned.out_shape) == (operator.out_shape, operator.in_shape)


def test_what_is_known_of_parts_is_known_of_the_whole():
    dense = DENSE["L"]
    np.testing.assert_allclose((L.T + F).diagonal, np.diag(dense) + F, rtol=1e-12)
    np.testing.assert_allclose((F * (BACKWARDS - 1)).diagonal, F * (np.diag(dense) - 1), rtol=1e-12)
    with pytest.raises(ValueError, match="diagonal of a Composition"):
        _ = (L @ L).diagonal
    marked = js.Stencil(L.indices, L.weights, border=jnp.arange(CLOUD.n) < 3)
    for operator in (marked + L, marked.T, F + marked @ L, L - 2 * marked):
        assert int(operator.border.sum()) == 3
    assert (L @ L + 1).border is None
    slope = Map(lambda u: 3 * u, CLOUD.n)
    np.testing.assert_allclose((L + slope).T @ U, DENSE["L"].T @ U + 3 * U, atol=1e-10)
    with pytest.raises(ValueError, match="matrix of a Map"):
        (L + slope).to_scipy()
    assert repr(L @ L - L.T).startswith("Sum(200 points, scalar to scalar fields, of Composition(")


def test_derivatives_in_factors_and_terms():
    check_derivatives(lambda f, u: jnp.sum(jnp.sin((f * L - f) @ u)), F, U)
    check_derivatives(lambda f, u: jnp.sum(jnp.sin((f * (L @ L) + f).T @ u)), 1 + 0 * F, 1e-2 * U)
    mapped = jax.vmap(lambda s: (s * L - s) @ U)(jnp.arange(3.0))
    np.testing.assert_allclose(mapped[2], 2 * (L(U) - U), rtol=1e-12)


def test_numbers_leave_the_precision_of_a_field():
    u = U.astype(jnp.float32)
    weights = L.weights.astype(jnp.float32)
    single = js.Stencil(L.indices, weights)
    for operator in (2 * single - 1, single @ single + 1, js.identity(CLOUD.n) / 3, (single + 1).T):
        assert operator(u).dtype == jnp.float32
