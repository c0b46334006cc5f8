"""Weights computed in parts, one or several for each core."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxsurf as js
from jaxsurf import build, cores, machine

N = 700


class Weighed(js.AbstractMethod):
    """A method with an array in it, which has no hash."""

    inner: js.GFDM
    factor: jax.Array

    def neighbor_count(self, dim):
        return self.inner.neighbor_count(dim)

    def basis_size(self, dim, target):
        return self.inner.basis_size(dim, target)

    def weights(self, neighborhood, target):
        weights, diagnostics = self.inner.weights(neighborhood, target)
        return self.factor * weights, diagnostics

    batch_size = 100


@pytest.fixture
def divided(monkeypatch):
    """Three cores and arrays that count as large; how many parts there were."""
    counted = []
    together = cores.side_by_side

    def watched(f, parts):
        counted.append(len(parts))
        return together(f, parts)

    monkeypatch.setattr(machine, "CPU", machine.CPU._replace(quick=1))
    monkeypatch.setattr(cores, "count_cores", lambda: 3)
    monkeypatch.setattr(build, "side_by_side", watched)
    return counted


def in_one_piece(monkeypatch, *args):
    with monkeypatch.context() as m:
        m.setattr(cores, "count_cores", lambda: 1)
        return build.stencil_weights(*args)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_parts_give_the_same_bits(divided, monkeypatch, dtype):
    """Also where settings are those of a thread: as 32 bits are here."""
    with jax.enable_x64(dtype == np.float64):
        on = jnp.arange(N) % 5 > 0
        sphere = js.sphere(N)
        points, normals = (np.asarray(a, dtype) for a in (sphere.points, sphere.normals))
        cloud = js.PointCloud(points, normals, active=on)
        near = js.find_neighbors(cloud, radius=0.45)
        asked = cloud, near, js.GFDM(degree=2), build.Laplacian()
        parts, whole = build.stencil_weights(*asked), in_one_piece(monkeypatch, *asked)
    assert divided == [3]
    assert parts[0].dtype == dtype and parts[0].shape == (near.k, N)
    jax.tree.map(np.testing.assert_array_equal, parts, whole)


def test_what_calls_a_library_runs_alone(divided):
    """Two such programs may wait for each other for ever."""
    cloud = js.sphere(N)
    for method in (js.RBFFD(degree=2), Weighed(js.GFDM(2), jnp.array(2.0))):
        js.laplace_beltrami(cloud, js.find_neighbors(cloud, 40), method=method)
    assert divided == []


def test_local_polynomials_call_no_library(divided):
    cloud = js.sphere(N)
    near = js.find_neighbors(cloud, 66)
    for method in (js.GFDM(degree=4), js.GFDM(degree=6), js.DCPSE(order=2), js.DCPSE(order=4)):
        js.laplace_beltrami(cloud, near, method=method)
    assert divided == [3, 3, 3, 3]


def test_few_rows_are_not_divided(monkeypatch):
    monkeypatch.setattr(cores, "count_cores", lambda: 3)
    assert len(cores.divided(10_000, 100, 1)) == 1
    many = cores.divided(10_000_000, 100, 10)
    assert len(many) == 6 and len(many[0]) * 10 >= machine.PART
    assert np.array_equal(np.unique(np.concatenate(many)), np.arange(10_000_000))


def test_many_rows_come_in_several_parts_for_each_core(divided, monkeypatch):
    """Each is given at least so many numbers as a part is to have."""
    monkeypatch.setattr(cores, "PART", 30 * 7 * 110)
    cloud = js.sphere(N)
    asked = cloud, js.find_neighbors(cloud, 30), js.GFDM(degree=2), build.Laplacian()
    parts, whole = build.stencil_weights(*asked), in_one_piece(monkeypatch, *asked)
    assert divided == [4]  # of 200 rows, in blocks of 100; three cores, twice
    jax.tree.map(np.testing.assert_array_equal, parts, whole)


def test_accelerators_are_not_divided(monkeypatch):
    assert cores.count_cores() >= 1
    monkeypatch.setattr(machine, "CPU", machine.ACCELERATOR)
    assert cores.count_cores() == 1
    assert len(cores.divided(10_000_000, 100, 10)) == 1


def test_what_calls_a_library_in_space_may_not_in_the_plane(divided, monkeypatch):
    """The answer for one dimension is not that for another."""
    monkeypatch.setattr(machine, "CPU", machine.CPU._replace(columns=27))
    method = js.DCPSE(order=3, width=0.31)
    for cloud in (js.sphere(N), js.circle(N), js.sphere(N)):
        near = js.find_neighbors(cloud, method.neighbor_count(cloud.dim))
        js.laplace_beltrami(cloud, near, method=method)
    assert divided == [3]
