"""Larger neighbourhoods represented by points that are spread evenly over them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxsurf as js
from jaxsurf.adapt import represented

from .helpers import random_sphere
from .test_robustness import lattice

N, K, WIDE = 300, 20, 60


def lists(cloud):
    found = js.find_neighbors(cloud, k=WIDE)
    return np.asarray(cloud.points), np.asarray(found.indices), np.asarray(found.mask)


def gaps(points, indices):
    """The least distance between the points of each list."""
    x = points[indices]
    d = np.linalg.norm(x[:, :, None] - x[:, None], axis=-1)
    return np.where(np.eye(x.shape[1], dtype=bool), np.inf, d).min(axis=(1, 2))


@pytest.mark.parametrize("cloud", [random_sphere(N), lattice()], ids=["random", "lattice"])
def test_spread_over_the_neighbourhood(cloud):
    """Farther apart than the nearest (on a lattice by sqrt 2), nearest first, as on the device."""
    points, indices, mask = lists(cloud)
    chosen, held = represented(points, indices, mask, WIDE, K)
    assert (
        chosen.shape == (cloud.n, K) and held.all() and (chosen[:, 0] == np.arange(cloud.n)).all()
    )
    assert all(set(row) <= set(all_) for row, all_ in zip(chosen, indices))
    far = np.linalg.norm(points[chosen] - points[:, None], axis=2)
    assert (np.diff(far, axis=1) > -1e-12).all()
    assert np.mean(gaps(points, chosen) / gaps(points, indices[:, :K])) > 1.35
    on_device = jax.jit(
        lambda size: represented(*map(jnp.asarray, (points, indices, mask)), size, K)
    )
    for size in (K // 2, 40, WIDE):
        for one, other in zip(represented(points, indices, mask, size, K), on_device(size)):
            np.testing.assert_array_equal(one, other)


def test_smaller_and_short_lists_are_whole():
    points, indices, mask = lists(random_sphere(N))
    chosen, held = represented(points, indices, mask, 12, K)
    np.testing.assert_array_equal(chosen[:, :12], indices[:, :12])
    np.testing.assert_array_equal(held, np.tile(np.arange(K) < 12, (N, 1)))
    mask = mask & (np.arange(WIDE) < 15)
    chosen, held = represented(points, indices, mask, WIDE, K)
    np.testing.assert_array_equal(chosen[:, :15], indices[:, :15])
    assert (held.sum(axis=1) == 15).all() and (chosen[:, 15:] == np.arange(N)[:, None]).all()
    # Sizes of their own.
    sizes = np.where(np.arange(N) % 2, WIDE, 12)[:, None]
    both, _ = represented(points, indices, mask, sizes, K)
    np.testing.assert_array_equal(both[1::2], chosen[1::2])


def test_borders_have_no_smaller_lists():
    """Fewer than usual would have a dominant centre there, but no polynomial to spare."""
    method = js.GFDM(degree=2)
    lying = js.surface_of_revolution(lambda s: (jnp.cos(s), jnp.sin(s)), 600, interval=(0.0, 1.5))
    # Stretched along the axis, as what moves is until points are added.
    wide = jnp.array([1.0, 1.0, 1.5])
    normals = lying.normals / wide
    normals = normals / jnp.linalg.norm(normals, axis=1, keepdims=True)
    cloud = js.PointCloud(lying.points * wide, normals, boundary=lying.boundary)
    usual = method.neighbor_count(3)
    surface = js.discretize(cloud, method=method)
    count = np.asarray(surface.neighbors.mask).sum(axis=1)
    assert count[np.asarray(cloud.boundary)].min() == usual
    again = surface.moved(cloud.points, cloud.normals, search=surface.search())
    assert jnp.array_equal(again.neighbors.mask, surface.neighbors.mask)
    squeezed = surface.moved(surface.cloud.points * jnp.array([1.0, 1.0, 0.8]))
    assert int(squeezed.code.max()) == 0
