"""Neighbours of moved points in compiled code: the lists, sizes and operators of the host."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg

import jaxsurf as js
from jaxsurf.nearest import Grid, nearest_in

from .helpers import check_derivatives, count_compilations, jittered_sphere, random_sphere

pytestmark = pytest.mark.slow

METHOD = js.GFDM(degree=2)


def smooth(x, seed, size):
    """A deformation by a few long waves in random directions."""
    rng = np.random.default_rng(seed)
    ways, phases = rng.normal(size=(4, 3)), rng.uniform(0, 2 * np.pi, 4)
    return x + size * jnp.sin(x @ ways.T + phases) @ jnp.asarray(rng.normal(size=(4, 3)))


def twisted(x, rate):
    a = rate * x[..., 2]
    turned = [jnp.cos(a) * x[..., 0] - jnp.sin(a) * x[..., 1],
              jnp.sin(a) * x[..., 0] + jnp.cos(a) * x[..., 1]]  # fmt: skip
    return jnp.stack([*turned, x[..., 2]], axis=-1)


def carried(motion, cloud):
    """Where a motion takes points and normals."""
    jacobian = jax.vmap(jax.jacfwd(motion))(cloud.points)
    normals = jnp.einsum("nji,nj->ni", jnp.linalg.inv(jacobian), cloud.normals)
    normals = normals / jnp.linalg.norm(normals, axis=1, keepdims=True)
    points = motion(cloud.points)
    return js.PointCloud(points, normals, boundary=cloud.boundary, active=cloud.active)


@functools.partial(jax.jit, static_argnums=2)
def found(surface, cloud, search):
    moved = surface.moved(cloud.points, cloud.normals, search=search)
    return moved, moved.laplacian, moved.code


def lists(neighbors):
    """Each as the numbers in it, in their order."""
    return [
        row[used].tolist()
        for row, used in zip(np.asarray(neighbors.indices), np.asarray(neighbors.mask))
    ]


@pytest.fixture(params=["smooth", "twisted", "masked"])
def moving(request):
    if request.param == "twisted":
        return js.torus(600, 1.0, 0.4), [functools.partial(twisted, rate=r) for r in (0.2, 0.5)]
    cloud = jittered_sphere(600)
    if request.param == "masked":
        off = np.random.default_rng(5).permutation(600) < 200
        points = jnp.where(off[:, None], jnp.nan, cloud.points)
        cloud = js.PointCloud(points, cloud.normals, active=~off)
    return cloud, [functools.partial(smooth, seed=s, size=0.1) for s in (0, 1)]


@pytest.mark.filterwarnings("ignore:the surface bends", "ignore:no neighbourhood")
def test_lists_sizes_and_operators_of_the_host(moving):
    cloud, motions = moving
    surface = js.discretize(cloud, method=METHOD)
    search = surface.search(margin=3, slots=122)
    for i, motion in enumerate(motions):
        there = carried(motion, cloud)
        if cloud.active is not None:
            there = js.PointCloud(
                jnp.where(cloud.active[:, None], there.points, jnp.nan),
                jnp.where(cloud.active[:, None], there.normals, cloud.normals),
                active=cloud.active,
            )
        with count_compilations() as names:
            moved, laplacian, code = found(surface, there, search)
        assert not (i and names), names
        anew = js.choose_neighbors(there, method=METHOD)
        assert lists(moved.neighbors) == lists(anew)
        assert not code.any()
        expected = js.laplace_beltrami(there, anew, method=METHOD, throw=False)
        size = float(jnp.abs(expected.weights).max())
        width = anew.k
        np.testing.assert_allclose(
            laplacian.weights[:width], expected.weights, atol=1e-11 * size, rtol=1e-9
        )
        assert not laplacian.weights[width:].any()
