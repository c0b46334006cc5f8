"""Misuse and degenerate points: named, with the number there was and the number needed."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxsurf as js

from .helpers import METHODS, label

SPHERE = js.sphere(300)


def changed(values, i, new):
    values = np.array(values)
    values[i] = new
    return values


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_points_that_are_not_finite(bad):
    with pytest.raises(ValueError, match="point 7 is not finite"):
        js.PointCloud(changed(SPHERE.points, (7, 1), bad), SPHERE.normals)
    with pytest.raises(ValueError, match="normal 7 has length"):
        js.PointCloud(SPHERE.points, changed(SPHERE.normals, (7, 1), bad))


@pytest.mark.parametrize("length", [0.0, 0.99, 2.0])
def test_normals_of_the_wrong_length(length):
    normals = changed(SPHERE.normals, 4, length * np.asarray(SPHERE.normals[4]))
    with pytest.raises(ValueError, match=rf"normal 4 has length {length}.*expected 1"):
        js.PointCloud(SPHERE.points, normals)


def test_wrong_shapes():
    with pytest.raises(ValueError, match=r"\(5, 4\), expected \(n, 2\) or \(n, 3\)"):
        js.PointCloud(np.ones((5, 4)), np.ones((5, 4)))
    with pytest.raises(ValueError, match=r"normals have shape \(299, 3\), expected \(300, 3\)"):
        js.PointCloud(SPHERE.points, SPHERE.normals[1:])
    with pytest.raises(ValueError, match=r"spacing has shape \(2,\)"):
        js.PointCloud(SPHERE.points, SPHERE.normals, spacing=np.ones(2))
    with pytest.raises(ValueError, match=r"spacing of point 3 is -1\.0"):
        js.PointCloud(SPHERE.points, SPHERE.normals, spacing=changed(np.ones(300), 3, -1))


def test_duplicates():
    points = changed(SPHERE.points, 20, SPHERE.points[100])
    cloud = js.PointCloud(points, changed(SPHERE.normals, 20, SPHERE.normals[100]))
    with pytest.raises(ValueError, match="points 20 and 100 coincide"):
        js.laplace_beltrami(cloud)


def test_mixed_orientation():
    cloud = js.PointCloud(SPHERE.points, changed(SPHERE.normals, 9, -SPHERE.normals[9]))
    with pytest.raises(ValueError, match="mixed orientation"):
        js.laplace_beltrami(cloud)


@pytest.mark.parametrize("method", METHODS, ids=label)
def test_too_few_neighbors(method):
    neighbors = js.find_neighbors(SPHERE, k=6 if label(method).endswith("4") else 5)
    need = {"DCPSE2": 10, "DCPSE4": 21, "GFDM2": 6, "GFDM4": 15, "RBFFD4": 15}[label(method)]
    with pytest.raises(
        ValueError, match=rf"k = \d neighbours, {type(method).__name__}.*least {need}"
    ):
        js.laplace_beltrami(SPHERE, neighbors, method=method)


def test_too_few_points():
    with pytest.raises(ValueError, match=r"k = 12 neighbours, GFDM\(degree=4\) needs at least 15"):
        small = js.sphere(12)
        js.laplace_beltrami(small, js.find_neighbors(small, k=12, throw=False), method=js.GFDM(4))


@pytest.mark.parametrize("method", METHODS, ids=label)
def test_points_on_a_line(method):
    x = jnp.linspace(0, 1, 100)
    points = jnp.stack([x, 0 * x, 0 * x], axis=1)
    cloud = js.PointCloud(points, jnp.tile(jnp.array([0.0, 0.0, 1.0]), (100, 1)))
    neighbors = js.find_neighbors(cloud, k=method.neighbor_count(3))
    with pytest.raises(ValueError, match=r"degenerate stencil at point \d+: relative moment"):
        js.laplace_beltrami(cloud, neighbors, method=method)
    operator = js.laplace_beltrami(cloud, neighbors, method=method, throw=False)
    assert operator.diagnostics.residual.min() > 1e-3
    assert jnp.isfinite(operator.diagnostics.residual).all()


def test_one_point_whose_support_is_too_small():
    """A masked row names the point, the number it has and the number needed."""
    neighbors = js.find_neighbors(SPHERE, k=30)
    poor = js.Neighbors(neighbors.indices, neighbors.mask.at[42, 5:].set(False))
    with pytest.raises(ValueError, match=r"point 42: .* with \d points within .* at least 10"):
        js.laplace_beltrami(SPHERE, poor, method=js.DCPSE(order=2))


def test_a_surface_that_bends_within_one_stencil():
    cloud = js.torus(200, 1.0, 0.25)
    with pytest.warns(UserWarning, match="bends within one stencil: support x curvature"):
        lists = js.find_neighbors(cloud, k=30, throw=False)
        js.laplace_beltrami(cloud, lists, method=js.DCPSE(order=2))


def test_neighbors_of_another_cloud():
    with pytest.raises(ValueError, match="neighbours of 300 points, the cloud has 200"):
        js.laplace_beltrami(js.sphere(200), js.find_neighbors(SPHERE, k=30))


def test_a_surface_in_place_of_its_cloud():
    surface = js.discretize(SPHERE)
    for function in (js.laplace_beltrami, js.mean_curvature, js.sort_cloud, js.discretize):
        with pytest.raises(TypeError, match=r"Discretization, expected .*: its \.cloud is one"):
            function(surface)
    with pytest.raises(TypeError, match=r"cloud is a Discretization, .*: its \.cloud is one"):
        js.find_neighbors(surface, k=9)
    for solves in (lambda: js.solve(surface, jnp.ones(300)), lambda: js.spectral_estimate(surface)):
        with pytest.raises(TypeError, match=r"operator is a Disc.*: surface\.laplacian is one"):
            solves()


@pytest.mark.parametrize("function", [js.laplace_beltrami, js.discretize])
def test_a_method_in_place_of_neighbors(function):
    with pytest.raises(TypeError, match=r"neighbors is GFDM.*: a method is given by name"):
        function(SPHERE, js.GFDM(degree=2))


def test_functions_of_one_point_that_are_written_for_many():
    box = ((-2.0,) * 3, (2.0,) * 3)
    with pytest.raises(ValueError) as caught:
        js.level_set(lambda x: jnp.sum(x**2, axis=1) - 1, n=100, bounds=box)
    assert any("phi was called with (3,)" in note for note in caught.value.__notes__)


def test_settings_that_make_no_sense():
    with pytest.raises(ValueError, match="DCPSE: order = 0"):
        js.DCPSE(order=0)
    with pytest.raises(ValueError, match="DCPSE: layer_spacing = -1"):
        js.DCPSE(layer_spacing=-1)
    with pytest.raises(ValueError, match="GFDM: degree = 0"):
        js.GFDM(degree=0)
    with pytest.raises(ValueError, match="diffusivity has shape"):
        js.diffusion(SPHERE, jnp.ones((300, 2)))
    with pytest.raises(ValueError, match="direction has shape"):
        js.directional_derivative(SPHERE, jnp.ones((300, 2)))


@pytest.mark.parametrize(
    "bad,text", [((5, 3, 300), "name point"), ((5, 3, -1), "name point"), ((5, 0, 6), "slot 0")]
)
def test_traced_indices_that_are_no_points(bad, text):
    """Where they are traced the program raises; programs on lists that exist look at none again."""
    cloud = js.sphere(300)
    found = js.find_neighbors(cloud, k=15)
    row, slot, value = bad
    wrong = found.indices.at[row, slot].set(value)
    given = jnp.ones(300)

    @eqx.filter_jit
    def apply(indices):
        neighbors = js.Neighbors(indices, found.mask)
        return js.laplace_beltrami(cloud, neighbors, throw=False)(given)

    @eqx.filter_jit
    def total(indices):
        return js.Stencil(indices.T, jnp.ones((15, 300)))(given)

    np.testing.assert_allclose(total(found.indices), 15)
    assert jnp.abs(apply(found.indices)).max() < 1e-10
    with pytest.raises(eqx.EquinoxRuntimeError, match=text):
        apply(wrong)
    if text == "name point":
        with pytest.raises(eqx.EquinoxRuntimeError, match=text):
            total(wrong)
        with pytest.raises(eqx.EquinoxRuntimeError, match=text):
            eqx.filter_jit(jax.vmap(total))(jnp.stack([found.indices, wrong]))

    known = eqx.filter_jit(lambda n, c: js.laplace_beltrami(c, n, throw=False)(given))
    assert "callback" in apply.lower(wrong).as_text()
    assert "callback" not in known.lower(found, cloud).as_text()


def test_traced_masks_that_leave_nothing():
    found = js.find_neighbors(SPHERE, k=6)
    counted = eqx.filter_jit(lambda mask: js.Neighbors(found.indices, mask).mask.sum())
    assert counted(found.mask) == 1800
    with pytest.raises(eqx.EquinoxRuntimeError, match="mask is False in all 1800 slots"):
        counted(jnp.zeros_like(found.mask))
    with pytest.raises(eqx.EquinoxRuntimeError, match="leaves out the point itself"):
        counted(found.mask.at[5, 0].set(False))


def test_warnings_name_the_line_that_led_to_them():
    """Through properties, compiled functions and whatever else stands between."""
    x = np.asarray(js.ellipsoid(300, (1.0, 1.0, 0.2)).points)
    cloud = js.PointCloud(x, np.asarray(js.ellipsoid(300, (1.0, 1.0, 0.2)).normals))
    calls = {
        "a function": lambda: js.laplace_beltrami(cloud),
        "a property": lambda: js.discretize(cloud, method=js.GFDM(degree=2)).laplacian,
        "a function of functions": lambda: js.mean_curvature(cloud),
    }
    for name, call in calls.items():
        with pytest.warns(UserWarning, match="bends within one stencil") as seen:
            call()
        assert {warning.filename for warning in seen} == {__file__}, name
