"""Sampling and ordering: exact counts, evenness in absolute numbers, determinism."""

import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial import cKDTree

from jaxsurf.cloud import PointCloud
from jaxsurf.shapes.analytic import sphere, sphere_projection
from jaxsurf.shapes.order import sort_cloud, sort_points
from jaxsurf.shapes.sampling import jitter, quasi_uniform, relax
from jaxsurf.shapes.spacing import ideal_spacing, measure_quality
from jaxsurf.shapes.thinning import poisson_disk, thin

SPHERE = 4 * np.pi


def random_sphere(m, seed=0):
    x = np.random.default_rng(seed).normal(size=(m, 3))
    return x / np.linalg.norm(x, axis=1, keepdims=True)


@pytest.mark.parametrize(("dim", "bits"), [(2, 5), (3, 3)])
def test_hilbert_order_visits_a_grid_by_unit_steps(dim, bits):
    side = 2**bits
    grid = np.stack(np.meshgrid(*[np.arange(side)] * dim, indexing="ij"), -1).reshape(-1, dim)
    shuffled = np.random.default_rng(0).permutation(grid)
    path = shuffled[sort_points(shuffled)]
    assert sorted(map(tuple, path)) == sorted(map(tuple, grid))
    np.testing.assert_array_equal(np.abs(np.diff(path, axis=0)).sum(axis=1), 1)


def test_sorted_neighbours_are_close():
    points = random_sphere(20_000)
    steps = np.linalg.norm(np.diff(points[sort_points(points)], axis=0), axis=1)
    h = ideal_spacing(SPHERE, 20_000)
    assert steps.mean() < 2 * h  # unsorted: 4/3, that is 53 h
    assert np.quantile(steps, 0.99) < 10 * h


def test_sort_is_unmoved_by_translation_and_scaling_and_takes_degenerate_points():
    points = random_sphere(500)
    order = sort_points(points)
    np.testing.assert_array_equal(order, sort_points(4 * points + 2.0**10))
    np.testing.assert_array_equal(sort_points(np.ones((3, 2))), [0, 1, 2])
    assert sort_points(np.zeros((0, 3))).size == 0
    assert sort_points(np.zeros((1, 3))).tolist() == [0]


def test_sort_cloud_carries_fields_in_and_out_and_keeps_inactive_rows_last():
    points = random_sphere(50)
    active = np.arange(50) % 5 != 0
    points[~active] = np.nan
    normals = np.where(active[:, None], points, 0.0)
    cloud = PointCloud(points, normals, boundary=np.arange(50) < 7, active=active)
    tidy, order = sort_cloud(cloud)
    assert sorted(order.tolist()) == list(range(50))
    np.testing.assert_array_equal(tidy.points, points[order])
    np.testing.assert_array_equal(tidy.boundary, cloud.boundary[order])
    assert bool(tidy.active[:40].all()) and not bool(tidy.active[40:].any())
    field = np.arange(50.0)
    np.testing.assert_array_equal(field[order][np.argsort(order)], field)


def test_sort_refuses_what_it_cannot_sort():
    with pytest.raises(ValueError, match="point 1 is not finite"):
        sort_points(np.array([[0.0, 0.0], [np.inf, 0.0]]))
    with pytest.raises(ValueError, match=r"shape \(4, 5\), expected \(n, 2\) or \(n, 3\)"):
        sort_points(np.zeros((4, 5)))
    with pytest.raises(ValueError, match="concrete"):
        jax.jit(lambda p: sort_cloud(PointCloud(p, p))[0].points)(jnp.asarray(random_sphere(9)))


def test_poisson_disk_is_apart_and_maximal():
    candidates, radius = random_sphere(20_000), 0.1
    kept = poisson_disk(candidates, radius, seed=3)
    distance = cKDTree(candidates[kept]).query(candidates, k=2)[0]
    assert distance[kept, 1].min() >= radius
    assert distance[:, 0].max() < radius  # no candidate could be added
    np.testing.assert_array_equal(kept, poisson_disk(candidates, radius, seed=3))
    assert not np.array_equal(kept, poisson_disk(candidates, radius, seed=4))
    with pytest.raises(ValueError, match="radius = 0, expected above 0"):
        poisson_disk(candidates, 0)


@pytest.mark.parametrize("n", [1, 7, 100, 2_000])
def test_thin_is_a_disk_sample(n):
    candidates = random_sphere(max(6 * n, 50))
    kept = thin(candidates, n)
    assert len(set(kept.tolist())) == n
    if n >= 100:
        assert measure_quality(candidates[kept], measure=SPHERE).smallest > 0.65


def test_thin_of_a_curve():
    angle = 2 * np.pi * np.random.default_rng(0).random(3_000)
    kept = thin(np.stack([np.cos(angle), np.sin(angle)], 1), 500)
    gaps = np.diff(np.sort(angle[kept])) / (2 * np.pi / 500)
    assert len(kept) == 500 and gaps.min() > 0.6 and gaps.max() < 2.8


def test_thin_needs_enough_candidates():
    with pytest.raises(ValueError, match="n = 11 of 10"):
        thin(random_sphere(10), 11)
    np.testing.assert_array_equal(thin(random_sphere(10), 10), np.arange(10))


@pytest.mark.parametrize("n", [300, 10_000])
def test_relaxed_points_are_even(n):
    begin = time.process_time()
    points, normals = quasi_uniform(
        random_sphere(6 * n), n, sphere_projection(), measure=SPHERE, seed=1
    )
    seconds = time.process_time() - begin
    quality = measure_quality(points, measure=SPHERE, probes=random_sphere(100_000, seed=9))
    assert points.shape == (n, 3)
    assert quality.smallest > 0.75 and quality.mean > 0.9 and quality.hole < 0.9
    np.testing.assert_allclose(normals, points, atol=1e-14)
    assert seconds < 6  # about 1 s for 10,000 points on a free core


def test_thin_shell_is_sampled_as_two_surfaces():
    # Two spheres 0.02 apart, facing opposite ways, spacing 0.11: each must be even by itself.
    n, inner, m = 2_000, 0.98, 6_000

    def project(x):
        length = np.linalg.norm(x, axis=1, keepdims=True)
        out = length > (1 + inner) / 2
        return np.where(out, 1, inner) * x / length, np.where(out, 1, -1) * x / length

    candidates = random_sphere(2 * m) * np.repeat([1, inner], m)[:, None]
    candidates, sides = project(candidates)
    measure = SPHERE * (1 + inner**2)
    points, normals = quasi_uniform(candidates, n, project, measure=measure, normals=sides)
    assert measure_quality(points, measure=measure, normals=normals).smallest > 0.7
    outer = np.sum(points * normals, axis=1) > 0
    assert abs(outer.sum() - n / (1 + inner**2)) < 0.02 * n
    for sheet, radius in ((points[outer], 1), (points[~outer], inner)):
        probes = radius * random_sphere(30_000, seed=2)
        h = ideal_spacing(SPHERE * radius**2, len(sheet))
        assert cKDTree(sheet).query(probes)[0].max() < 0.95 * h
    # Were the normals ignored, points would be kept apart across the gap.
    blind = measure_quality(points, measure=measure)
    assert blind.smallest < 0.4


def test_fixed_points_stay_first_and_unmoved():
    n = 800
    angle = 2 * np.pi * np.arange(50) / 50
    ring = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    points, normals = quasi_uniform(
        random_sphere(6 * n), n, sphere_projection(), measure=SPHERE, fixed=(ring, ring)
    )
    np.testing.assert_array_equal(points[:50], ring)
    np.testing.assert_array_equal(normals[:50], ring)
    assert len(points) == n
    assert measure_quality(points, measure=SPHERE).smallest > 0.7
    with pytest.raises(ValueError, match="50 fixed points leave none of n = 40"):
        quasi_uniform(
            random_sphere(600), 40, sphere_projection(), measure=SPHERE, fixed=(ring, ring)
        )


def test_relax_names_a_point_that_cannot_be_projected():
    points = random_sphere(20)
    points[4] = 0
    with np.errstate(invalid="ignore"), pytest.raises(ValueError, match="failed for point 4"):
        relax(points, sphere_projection(), spacing=0.5)
    with pytest.raises(ValueError, match="spacing = 0, expected above 0"):
        relax(random_sphere(20), sphere_projection(), spacing=0)


def test_jitter_is_uniform_in_a_ball_and_back_on_the_surface():
    cloud = sphere(20_000)
    h = ideal_spacing(SPHERE, 20_000)
    moved = jitter(cloud, sphere_projection(), spacing=h, seed=5)
    np.testing.assert_allclose(np.linalg.norm(moved.points, axis=1), 1, rtol=1e-14)
    np.testing.assert_allclose(moved.normals, moved.points, atol=1e-14)
    distance = np.linalg.norm(moved.points - cloud.points, axis=1) / (h / 4)
    assert 0.98 < distance.max() < 1.01
    # The tangential part of a uniform point in the unit ball has mean square 2/5.
    assert abs(np.mean(distance**2) - 0.4) < 0.01
    again = jitter(cloud, sphere_projection(), spacing=h, seed=5)
    np.testing.assert_array_equal(moved.points, again.points)
    other = jitter(cloud, sphere_projection(), spacing=h, seed=6)
    assert not np.array_equal(moved.points, other.points)


def test_jitter_leaves_the_boundary_and_switched_off_rows():
    x = random_sphere(100)
    cloud = PointCloud(x, x, boundary=np.arange(100) < 10, active=np.arange(100) < 90)
    moved = jitter(cloud, sphere_projection(), spacing=0.3)
    same = np.all(np.asarray(moved.points) == x, axis=1)
    np.testing.assert_array_equal(same, (np.arange(100) < 10) | (np.arange(100) >= 90))
    assert moved.boundary is not None and moved.active is not None
