"""Modes at the prompt, and their derivatives in the normals."""

import jax
import jax.numpy as jnp
import numpy as np

import jaxsurf as js

from .helpers import central_difference, count_compilations

METHOD = js.DCPSE(order=2)


# --- at the prompt --------------------------------------------------------------------------


def test_modes_of_another_operator_compile_nothing():
    cloud = js.sphere(330)
    operators = [js.laplace_beltrami(cloud, method=METHOD).scaled(s) for s in (1.0, 2.0)]
    cap = cloud.points[:, 2] > 0.8
    closures = [js.close(cloud, js.dirichlet(cap, value)) for value in (0.0, 1.0)]

    def programs(operator, closure=None):
        with count_compilations() as names:
            js.eigenmodes(operator, 4, conditions=closure)
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
