"""Distances by the heat method: exact ones on the sphere, several sources, gradients, misuse."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxsurf as js
from experiments import data

from .helpers import check_derivative, count_compilations, jittered_sphere, relative_error

# Minutes in all.
pytestmark = pytest.mark.slow

pytest.importorskip("pyamg")


def exact_on_sphere(cloud, sources):
    cosine = jnp.clip(cloud.points @ cloud.points[sources].T, -1, 1)
    return jnp.min(jnp.arccos(cosine), axis=1).at[sources].set(0)


@pytest.mark.parametrize("method", [js.GFDM(degree=2), js.DCPSE(order=2)], ids=str)
def test_sphere(method):
    cloud = js.sphere(10_000)
    source = jnp.array([1234])
    distance = js.geodesic_distance(cloud, source, method=method)
    assert relative_error(distance, exact_on_sphere(cloud, source)) < 4e-3
    assert float(distance[1234]) == 0


def test_coarse_points():
    """Arcs between neighbours, not chords, with which the error is 1.1e-2 for 1,000 points."""
    for n, bound in ((1_000, 6e-3), (4_000, 3.5e-3)):
        cloud, source = js.sphere(n), jnp.array([n // 8])
        distance = js.geodesic_distance(cloud, source)
        assert relative_error(distance, exact_on_sphere(cloud, source)) < bound


@pytest.mark.parametrize("every", [1, 3])
def test_sources_everywhere(every):
    """A bare error of linear algebra: where all points are sources or beside one, none is left."""
    cloud = js.sphere(600)
    sources = np.arange(0, 600, every)
    distance = js.geodesic_distance(cloud, sources)
    exact = exact_on_sphere(cloud, sources)
    np.testing.assert_allclose(distance, exact, atol=1e-12)
    slope = jax.grad(
        lambda x: js.geodesic_distance(
            js.PointCloud(x, cloud.normals), sources, neighbors=js.find_neighbors(cloud, k=20)
        ).sum()
    )(cloud.points)
    assert bool(jnp.isfinite(slope).all())


def test_normals_that_are_rough():
    """Distances were 1.4e-2 too short: chords lean out of tangent planes that are tilted."""
    cloud, source = js.sphere(2_500), jnp.array([0])
    tilted = cloud.normals + 0.2 * np.random.default_rng(0).normal(size=cloud.points.shape)
    tilted = tilted / jnp.linalg.norm(tilted, axis=1, keepdims=True)
    distance = js.geodesic_distance(js.PointCloud(cloud.points, tilted), source)
    assert relative_error(distance, exact_on_sphere(cloud, source)) < 5e-3


def test_ways_that_are_shorter_than_straight_lines_are_told():
    """Nothing was said where texture finer than the points makes distances a tenth too short."""
    try:
        cloud = data.armadillo(10_000)
    except FileNotFoundError as error:
        pytest.skip(str(error))
    with pytest.warns(UserWarning, match=r"distances of \d+ points are shorter .* 0.9\d of it"):
        distance = js.geodesic_distance(cloud, jnp.array([0]))
    straight = jnp.linalg.norm(cloud.points - cloud.points[0], axis=1)
    assert int(jnp.sum(distance < 0.95 * straight)) < 400


def test_borders_and_random_points():
    """Several times less accurate than on even points without a border."""
    tube = js.surface_of_revolution(lambda s: (1 + 0 * s, 2 * s), 2_000)
    angle = jnp.arctan2(tube.points[:, 1], tube.points[:, 0])
    for height, bound in ((1.0, 2e-2), (0.0, 5e-2)):
        source = jnp.argmin((tube.points[:, 2] - height) ** 2 + angle**2)[None]
        turn = jnp.abs(angle - angle[source])
        turn = jnp.minimum(turn, 2 * jnp.pi - turn)
        exact = jnp.hypot(turn, tube.points[:, 2] - tube.points[source, 2])
        assert relative_error(js.geodesic_distance(tube, source), exact) < bound
    points = np.random.default_rng(0).normal(size=(2_000, 3))
    points = jnp.asarray(points / np.linalg.norm(points, axis=1)[:, None])
    random, source = js.PointCloud(points, points), jnp.array([0])
    distance = js.geodesic_distance(random, source)
    assert relative_error(distance, exact_on_sphere(random, source)) < 3e-2


def test_first_order_where_fronts_meet():
    def error(n):
        cloud = js.sphere(n)
        sources = jnp.asarray(np.random.default_rng(0).choice(n, 5, replace=False))
        return relative_error(js.geodesic_distance(cloud, sources), exact_on_sphere(cloud, sources))

    assert np.log2(error(2_500) / error(10_000)) > 0.8


def test_fronts_that_meet():
    cloud = jittered_sphere(3_000)
    sources = jnp.array([0, 1_500, 2_700])
    exact = exact_on_sphere(cloud, sources)
    distance = js.geodesic_distance(cloud, sources)
    assert relative_error(distance, exact) < 2e-2
    mask = jnp.zeros(cloud.n, bool).at[sources].set(True)
    np.testing.assert_array_equal(js.geodesic_distance(cloud, mask), distance)


def test_a_region_as_source():
    """The distance from a cap, whose points are all sources."""
    cloud = js.sphere(4_000)
    angle = jnp.arccos(jnp.clip(cloud.points[:, 2], -1, 1))
    distance = js.geodesic_distance(cloud, angle < 0.6)
    exact = jnp.maximum(angle - angle[angle < 0.6].max(), 0)
    assert relative_error(distance, exact) < 2e-2


def test_scale_and_far_points():
    """Over 250 spacings heat falls by more than 200 powers of ten."""
    angle = 2 * jnp.pi * jnp.arange(1_000) / 1_000
    points = jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=1)
    circle = js.PointCloud(points, points)
    exact = jnp.minimum(angle, 2 * jnp.pi - angle)
    distance = js.geodesic_distance(circle, jnp.array([0]))
    assert relative_error(distance, exact) < 3e-3
    large = js.PointCloud(1e3 * points, points)
    found = js.geodesic_distance(large, jnp.array([0]))
    np.testing.assert_allclose(found, 1e3 * distance, rtol=1e-6)


@pytest.mark.parametrize("n", [100, 400, 3_000])
def test_uneven_points_on_a_curve(n):
    """An ellipse with half the spacing at its ends; from 3,000 points heat leaves all numbers."""
    t = 2 * np.pi * np.arange(100 * n) / (100 * n)
    x, normals = np.stack([2 * np.cos(t), np.sin(t)], 1), np.stack([np.cos(t), 2 * np.sin(t)], 1)
    normals = normals / np.linalg.norm(normals, axis=1)[:, None]
    arc = np.cumsum(np.linalg.norm(np.roll(x, -1, axis=0) - x, axis=1))
    along, length = np.concatenate([[0], arc[99:-1:100]]), arc[-1]
    cloud = js.PointCloud(x[::100], normals[::100])
    for source in (0, n // 4):
        exact = np.abs(along - along[source])
        exact = np.minimum(exact, length - exact)
        found = js.geodesic_distance(cloud, jnp.array([source]))
        assert relative_error(found, exact) < 1.4 / n


def test_graded_points():
    """From where points are wide apart to where they are dense: 10 times too far before."""
    side = np.linspace(0, 1, 40)
    side = np.expm1(0.01 * side) / np.expm1(0.01)  # one per cent wider on the right
    x, y = (c.ravel() for c in np.meshgrid(side, side, indexing="ij"))
    points = np.stack([x, y, 0 * x], axis=1)
    border = (x == 0) | (x == 1) | (y == 0) | (y == 1)
    square = js.PointCloud(points, np.tile([0.0, 0, 1], (1_600, 1)), boundary=border)
    exact = np.linalg.norm(points - points[-1], axis=1)
    assert relative_error(js.geodesic_distance(square, jnp.array([1_599])), exact) < 2e-2

    sphere = js.sphere(3_000)
    angle = jnp.arccos(sphere.points[:, 2])
    turned = jnp.arctan(3 * jnp.tan(angle / 2)) - angle / 2  # half of it: nine times as dense below
    axis = jnp.stack([-sphere.points[:, 1], sphere.points[:, 0], 0 * angle], axis=1)
    axis = axis / jnp.linalg.norm(axis, axis=1, keepdims=True)
    points = sphere.points * jnp.cos(2 * turned)[:, None]
    points = points + jnp.cross(axis, sphere.points) * jnp.sin(2 * turned)[:, None]
    graded = js.PointCloud(points, points)
    for source in (jnp.argmax(points[:, 2])[None], jnp.argmin(points[:, 2])[None]):
        distance = js.geodesic_distance(graded, source)
        assert relative_error(distance, exact_on_sphere(graded, source)) < 1.5e-2


def test_what_is_not_found():
    """In single precision 800 points in a row are too many for the tolerance."""
    circle = js.circle(800)
    circle = js.PointCloud(circle.points.astype("float32"), circle.normals.astype("float32"))
    with pytest.raises(RuntimeError, match=r"^distances have not been found to a relative toler"):
        js.geodesic_distance(circle, jnp.array([0]))


def test_gradient_in_points_and_normals():
    cloud = js.ellipsoid(500, (1.0, 0.8, 0.65))
    method = js.GFDM(degree=2)
    neighbors = js.choose_neighbors(cloud, method=method)
    weight = jnp.asarray(np.random.default_rng(2).normal(size=cloud.n))

    def observed(both):
        normals = both[1] / jnp.linalg.norm(both[1], axis=1, keepdims=True)
        moved = js.PointCloud(both[0], normals)
        distance = js.geodesic_distance(
            moved, np.array([0, 250]), neighbors=neighbors, method=method, rtol=1e-12
        )
        return weight @ distance

    check_derivative(observed, jnp.stack([cloud.points, cloud.normals]), step=1e-4)


def test_vmap_over_geometries():
    """A sphere and an ellipsoid at once, as one after the other."""
    sphere, method = js.sphere(300), js.GFDM(degree=2)
    neighbors = js.find_neighbors(sphere, method.neighbor_count(3))

    def measured(stretch):
        axes = jnp.array([1.0, 1.0, stretch])
        normals = sphere.points / axes
        normals = normals / jnp.linalg.norm(normals, axis=1, keepdims=True)
        cloud = js.PointCloud(sphere.points * axes, normals)
        how = {"neighbors": neighbors, "method": method, "rtol": 1e-12}
        return js.geodesic_distance(cloud, np.array([10, 200]), **how)

    stretches = jnp.array([1.0, 1.3])
    one = jax.jit(measured)
    alone = jnp.stack([one(s) for s in stretches])
    assert relative_error(alone[1], alone[0]) > 0.05  # there are two of them
    np.testing.assert_allclose(jax.jit(jax.vmap(measured))(stretches), alone, atol=1e-9)
    assert relative_error(alone[0], exact_on_sphere(sphere, jnp.array([10, 200]))) < 5e-2


def test_another_geometry_compiles_nothing():
    method = js.GFDM(degree=2)

    def measured(cloud, source):
        neighbors = js.find_neighbors(cloud, method.neighbor_count(3))
        js.laplace_beltrami(cloud, neighbors, method=method)
        js.surface_gradient(cloud, neighbors, method=method)
        with count_compilations() as names:
            js.geodesic_distance(cloud, np.array([source]), neighbors=neighbors, method=method)
        return names

    names = measured(js.sphere(900), 125)
    assert names.count("jit(_distances)") == 1 and len(names) < 12, names
    assert not measured(js.ellipsoid(900, (1.0, 0.9, 0.8)), 800)
    assert not measured(js.ellipsoid(900, (1.0, 0.5, 0.5)), 3)
    assert not measured(js.torus(900, 1.0, 0.7), 7)


def test_a_border():
    """Straight ways in a square with marked border, also from its corner and along its sides."""
    cloud = js.graph(lambda x, y: 0 * x, (32, 32))
    for source in (0, 16, 528):
        distance = js.geodesic_distance(cloud, np.array([source]))
        exact = jnp.linalg.norm(cloud.points - cloud.points[source], axis=1)
        assert relative_error(distance, exact) < 2.5e-2


def test_single_precision():
    """JAX's default; within 1e-4 of what double precision gives."""
    cloud = js.sphere(1_000)
    exact = np.asarray(js.geodesic_distance(cloud, np.array([125])))
    points, normals = np.asarray(cloud.points), np.asarray(cloud.normals)
    with jax.enable_x64(False):
        single = js.PointCloud(jnp.asarray(points), jnp.asarray(normals))
        distance = js.geodesic_distance(single, np.array([125]))
        assert distance.dtype == jnp.float32
        with pytest.raises(ValueError, match=r"allows at least 4\.8e-07: .*jax_enable_x64"):
            js.geodesic_distance(single, np.array([125]), rtol=1e-12)
    assert relative_error(np.asarray(distance, float), exact) < 1e-4


@pytest.mark.core
def test_misuse():
    cloud = js.sphere(300)
    with pytest.raises(ValueError, match="no sources"):
        js.geodesic_distance(cloud, jnp.array([], int))
    with pytest.raises(ValueError, match="source 300 is not among the points 0 to 299"):
        js.geodesic_distance(cloud, jnp.array([0, 300]))
    with pytest.raises(ValueError, match=r"mask of sources has shape \(7,\), expected \(300,\)"):
        js.geodesic_distance(cloud, jnp.zeros(7, bool))
    with pytest.raises(ValueError, match="sources must be concrete"):
        jax.jit(lambda s: js.geodesic_distance(cloud, s))(jnp.array([0]))
    with pytest.raises(ValueError, match=r"make them with np\.array"):
        jax.jit(lambda: js.geodesic_distance(cloud, jnp.array([0])))()
    apart = cloud.points + jnp.array([10.0, 0, 0])
    both = js.PointCloud(
        jnp.concatenate([cloud.points, apart]), jnp.concatenate([cloud.normals] * 2)
    )
    with pytest.raises(ValueError, match=r"no path .* to point 300 \(and 299 more\)"):
        js.geodesic_distance(both, jnp.array([0]))
