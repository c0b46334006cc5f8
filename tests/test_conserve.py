"""`js.conservative_weights`: the left null vector of a Laplacian, as a quadrature and as a mass."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxsurf as js

from .helpers import check_derivatives

pytestmark = pytest.mark.slow

METHOD = js.GFDM(degree=2)


def surface(n=400, method=METHOD):
    return js.discretize(js.torus(n, 1.0, 0.4), method=method)


SURFACE = surface()
CYCLE = js.multigrid(SURFACE.laplacian)


def left(weights, operator):
    """Largest product with a column of the operator, of the largest part of one."""
    matrix, m = operator.to_scipy(), np.asarray(weights, float)
    return np.abs(matrix.T @ m).max() / np.abs(matrix.diagonal() * m).max()


@pytest.mark.core
def test_nothing_is_left_and_weights_are_positive():
    for made in (SURFACE, js.discretize(js.sphere(500))):
        areas = made.areas
        weights = js.conservative_weights(made.laplacian, areas.sum())
        assert left(areas, made.laplacian) > 1e-3  # there is something to do
        assert left(weights, made.laplacian) < 1e-14
        assert (weights > 0).all()
        np.testing.assert_allclose(weights, areas, rtol=0.1)
        np.testing.assert_allclose(weights.sum(), areas.sum(), rtol=1e-14)


@pytest.mark.filterwarnings("ignore:the surface bends")
@pytest.mark.parametrize(
    ("method", "bound"), [(METHOD, 6e-4), (js.GFDM(degree=4), 4e-5)], ids=["2", "4"]
)
def test_they_are_a_quadrature_of_the_order_of_the_operator(method, bound):
    def error(n):
        made = surface(n, method)
        x, y, z = made.cloud.points.T
        u = jnp.exp(x) * (1 + z**2) + y
        weights = js.conservative_weights(made.laplacian, made.areas.sum())
        # The areas are of a higher order.
        return abs(weights @ u - made.integrate(u)) / made.integrate(u)

    coarse, fine = error(1_000), error(4_000)
    assert fine < bound
    assert np.log2(coarse / fine) > method.degree - 0.3


def test_mass_is_conserved_to_round_off():
    u = 2 + jnp.cos(jnp.arange(400.0))
    problem = js.AdvectionDiffusionReaction(SURFACE.laplacian)
    end = js.integrate(problem, u, t1=1.0).ys[-1]
    areas = SURFACE.areas
    weights = js.conservative_weights(SURFACE.laplacian, areas.sum())
    drift = lambda m: float(abs(m @ (end - u)) / (m @ u))
    assert drift(areas) > 1e-6 and drift(weights) < 1e-13


def test_derivatives():
    """In the points, through weights of the operator, and in the total.

    Those of areas and of normals carried along: `test_discretization.py`.
    """
    probe, normals = jnp.cos(jnp.arange(400.0)), SURFACE.cloud.normals

    def f(points):
        moved = SURFACE.moved(points, normals)
        total = jnp.sum(points[:, 1] ** 2)
        m = js.conservative_weights(moved.laplacian, total, preconditioner=CYCLE)
        return jnp.vdot(probe * points[:, 2], m)

    check_derivatives(f, SURFACE.cloud.points, step=1e-4)


def test_under_jit_and_vmap():
    scales = jnp.array([1.0, 1.3])

    def f(scale):
        operator = (1 + 0.1 * scale * jnp.cos(jnp.arange(400.0))) * SURFACE.laplacian
        return js.conservative_weights(operator, scale, preconditioner=CYCLE)

    expected = jnp.stack([f(s) for s in scales])
    assert not np.allclose(expected[0] * 1.3, expected[1], rtol=1e-3)
    np.testing.assert_allclose(jax.jit(jax.vmap(f))(scales), expected, rtol=1e-10)


def test_single_precision():
    weights = js.conservative_weights(SURFACE.laplacian, SURFACE.areas.sum())
    single = jax.tree.map(
        lambda a: jnp.asarray(np.asarray(a), jnp.float32) if a.dtype == float else a,
        SURFACE.laplacian,
    )
    with jax.enable_x64(False):
        found = js.conservative_weights(single, np.float32(SURFACE.areas.sum()))
        assert found.dtype == jnp.float32
    assert left(found, single) < 1e-5
    np.testing.assert_allclose(found, weights, rtol=1e-4)


def test_what_has_no_such_weights():
    screened = SURFACE.laplacian - 1
    with pytest.raises(ValueError, match="does not annihilate the constants"):
        js.conservative_weights(screened, 1.0)
    with pytest.raises(ValueError, match=r"outside jit and vmap"):
        jax.jit(lambda o: js.conservative_weights(o, 1.0))(SURFACE.laplacian)
    # Two spheres, each with a factor of its own.
    ball = js.sphere(300)
    two = js.PointCloud(
        jnp.concatenate([ball.points, ball.points + 5]), jnp.concatenate([ball.normals] * 2)
    )
    operator = js.laplace_beltrami(two, method=METHOD)
    with pytest.raises((ValueError, RuntimeError)):
        js.conservative_weights(operator, 1.0)
    torn = eqx.tree_at(lambda o: o.weights, SURFACE.laplacian, jnp.nan * SURFACE.laplacian.weights)
    with pytest.raises(ValueError, match=r"not finite|nan"):
        js.conservative_weights(torn, 1.0)
