"""Neighbour searches: the sets themselves, both searches against each other, bad clouds."""

import warnings
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial import cKDTree

from jaxsurf.cells import SearchCapacity, allocate_search, search_neighbors
from jaxsurf.checks import two_sheets
from jaxsurf.cloud import PointCloud
from jaxsurf.curvature import tube_ratio
from jaxsurf.io import read
from jaxsurf.neighbors import find_neighbors, nearest_of
from jaxsurf.sheets import nearest

ARMADILLO = Path(__file__).parents[2] / "shared" / "data" / "armadillo.obj"


def fibonacci(n):
    i = np.arange(n) + 0.5
    z, angle = 1 - 2 * i / n, np.pi * (1 + 5**0.5) * i
    s = np.sqrt(1 - z * z)
    return np.stack([s * np.cos(angle), s * np.sin(angle), z], axis=1)


def random_sphere(n, seed=0):
    x = np.random.default_rng(seed).normal(size=(n, 3))
    return x / np.linalg.norm(x, axis=1, keepdims=True)


def jittered(n, seed=0):
    x = fibonacci(n) + 0.2 * spacing(n) * random_sphere(n, seed)
    return x / np.linalg.norm(x, axis=1, keepdims=True)


def plates(gap, shift=(0.0, 0.0), m=20):
    """Two parallel unit lattices, normals away from each other, turned out of the axes."""
    a = np.stack(np.meshgrid(np.arange(m), np.arange(m), indexing="ij"), -1).reshape(-1, 2)
    low = np.c_[a, np.zeros(m * m)]
    high = np.c_[a + np.asarray(shift), np.full(m * m, gap)]
    up = np.tile([0.0, 0.0, 1.0], (m * m, 1))
    turn = np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))[0]
    return np.r_[low, high] @ turn.T, np.r_[-up, up] @ turn.T


def brute_force(points, normals, row, k=None, radius=None):
    d = np.linalg.norm(points - points[row], axis=1)
    allowed = normals @ normals[row] >= 0
    found = [j for j in np.lexsort((np.arange(len(d)), d)) if allowed[j]]
    return found[:k] if radius is None else [j for j in found if d[j] <= radius]


def spacing(n):
    return np.sqrt(4 * np.pi / n)


def test_nearest_against_brute_force():
    x = random_sphere(400)
    neighbors = find_neighbors(PointCloud(x, x), 15)
    assert neighbors.indices.dtype == jnp.int32
    assert neighbors.radius is None
    assert bool(neighbors.mask.all())
    for row in range(0, 400, 7):
        assert neighbors.indices[row].tolist() == brute_force(x, x, row, k=15)


def test_radius_against_brute_force():
    x = random_sphere(400)
    radius = 0.4
    neighbors = find_neighbors(PointCloud(x, x), radius=radius)
    assert float(neighbors.radius) == radius
    assert int(neighbors.mask.sum(axis=1).max()) == neighbors.k
    for row in range(0, 400, 7):
        expected = brute_force(x, x, row, radius=radius)
        mask = np.asarray(neighbors.mask[row])
        assert np.asarray(neighbors.indices[row])[mask].tolist() == expected
        assert np.all(np.asarray(neighbors.indices[row])[~mask] == row)


def test_one_radius_per_point():
    x = random_sphere(300)
    radius = np.where(x[:, 2] > 0, 0.5, 0.35)
    neighbors = find_neighbors(PointCloud(x, x), radius=jnp.asarray(radius))
    for row in range(0, 300, 11):
        mask = np.asarray(neighbors.mask[row])
        expected = brute_force(x, x, row, radius=radius[row])
        assert np.asarray(neighbors.indices[row])[mask].tolist() == expected


def test_far_side_of_a_thin_plate_is_rejected():
    x, normals = plates(1.0)
    neighbors = find_neighbors(PointCloud(x, normals), 25)
    assert bool(neighbors.mask.all())  # more candidates were looked at
    side = np.arange(len(x)) < len(x) // 2
    assert np.all(side[np.asarray(neighbors.indices)] == side[:, None])
    everything = find_neighbors(PointCloud(x, normals), 25, min_cosine=-1)
    assert np.any(side[np.asarray(everything.indices)] != side[:, None])


def test_row_without_enough_acceptable_points_is_padded():
    x = fibonacci(200)
    normals = x.copy()
    # A speck of six points with normals of its own, far from all others.
    speck = np.array([[5.0, 0, 0]]) + 0.1 * fibonacci(6) * [1, 1, 0]
    cloud = PointCloud(np.r_[x, speck], np.r_[normals, np.tile([0.0, 0, 1], (6, 1))], active=None)
    neighbors = find_neighbors(cloud, 20, min_cosine=0.99)
    assert int(neighbors.mask[200].sum()) < 20
    padded = ~np.asarray(neighbors.mask[200])
    assert np.all(np.asarray(neighbors.indices[200])[padded] == 200)


def test_switched_off_points():
    x = random_sphere(300)
    active = np.arange(300) % 3 != 0
    points = x.copy()
    points[0] = np.nan  # whatever a switched-off row holds
    cloud = PointCloud(points, x, active=active)
    neighbors = find_neighbors(cloud, 10)
    mask, indices = np.asarray(neighbors.mask), np.asarray(neighbors.indices)
    assert not mask[~active].any()
    assert np.all(indices[~active] == np.flatnonzero(~active)[:, None])
    assert active[indices[active]].all()
    rest = find_neighbors(PointCloud(x[active], x[active]), 10)
    names = np.flatnonzero(active)
    assert np.array_equal(indices[active], names[np.asarray(rest.indices)])
    capacity = allocate_search(jnp.asarray(points), 0.5, active=jnp.asarray(active))
    found, _ = search_neighbors(
        jnp.asarray(points), radius=0.5, capacity=capacity, active=jnp.asarray(active)
    )
    host = find_neighbors(cloud, radius=0.5, capacity=capacity.k)
    assert np.array_equal(found.indices, host.indices)
    assert np.array_equal(found.mask, host.mask)


def test_search_of_some_rows_only():
    x, normals = plates(1.0)
    active = np.arange(len(x)) % 5 != 0
    rows = np.array([401, 2, 0, 799, 2, 5, 63])  # 0 and 5 are switched off, 2 comes twice
    for cloud in (PointCloud(x, normals), PointCloud(x, normals, active=active)):
        everything = find_neighbors(cloud, 40)
        indices, mask = nearest_of(cloud, rows, 40)
        assert np.array_equal(indices, everything.indices[rows])
        assert np.array_equal(mask, everything.mask[rows])
    assert mask.any(axis=1).tolist() == [True, True, False, True, True, False, True]
    with pytest.raises(ValueError, match="too few points: 640, with k = 641"):
        nearest_of(cloud, rows, 641)
    empty, _ = nearest_of(cloud, rows[:0], 40)
    assert empty.shape == (0, 40)


@pytest.mark.parametrize("shift", [0.0, 1e4])
@pytest.mark.parametrize("make", [fibonacci, random_sphere])
def test_both_searches_give_the_same_sets_on_spheres(make, shift):
    x = make(1500)
    points, normals = jnp.asarray(x + shift), jnp.asarray(x)
    radius = 3.2 * spacing(1500)
    capacity = allocate_search(points, radius)
    found, report = search_neighbors(points, radius=radius, capacity=capacity, normals=normals)
    host = find_neighbors(PointCloud(points, normals), radius=radius, capacity=capacity.k)
    assert not bool(report.overflow)
    assert np.array_equal(found.indices, host.indices)
    assert np.array_equal(found.mask, host.mask)
    found, _ = search_neighbors(
        points,
        radius=2 * radius,
        capacity=allocate_search(points, 2 * radius),
        normals=normals,
        k=20,
    )
    host = find_neighbors(PointCloud(points, normals), 20)
    assert np.array_equal(found.indices, host.indices)
    assert bool(found.mask.all())


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("gap", [0.5, 1.0, 2.0])
def test_both_searches_agree_on_ties_and_thin_parts(gap, dtype):
    # Lattices turned out of the axes: all distances tie, up to round-off.
    x, normals = plates(gap)
    points, normals = jnp.asarray(0.1 * x, dtype), jnp.asarray(normals, dtype)
    capacity = allocate_search(points, 0.3)  # exactly three spacings
    found, _ = search_neighbors(points, radius=0.3, capacity=capacity, normals=normals)
    host = find_neighbors(PointCloud(points, normals), radius=0.3, capacity=capacity.k)
    assert int(host.mask.sum(axis=1).max()) == 29
    assert np.array_equal(found.indices, host.indices)
    assert np.array_equal(found.mask, host.mask)
    nearest, _ = search_neighbors(
        points, radius=0.7, capacity=allocate_search(points, 0.7), normals=normals, k=11
    )
    assert np.array_equal(nearest.indices, find_neighbors(PointCloud(points, normals), 11).indices)


def test_both_searches_agree_on_curves():
    angle = 2 * np.pi * np.sort(np.random.default_rng(0).uniform(size=300))
    x = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    capacity = allocate_search(jnp.asarray(x), 0.2)
    found, _ = search_neighbors(jnp.asarray(x), radius=0.2, capacity=capacity)
    host = find_neighbors(PointCloud(x, x), radius=0.2, capacity=capacity.k)
    assert np.array_equal(found.indices, host.indices)


def test_a_stray_point_far_away_changes_nothing():
    x = fibonacci(800)
    stray = jnp.asarray(np.r_[x, [[3e12, -2e12, 1e12]]])
    radius = 3 * spacing(800)
    capacity = allocate_search(jnp.asarray(x), radius)
    alone, _ = search_neighbors(jnp.asarray(x), radius=radius, capacity=capacity)
    both, report = search_neighbors(stray, radius=radius, capacity=capacity)
    assert np.array_equal(both.indices[:800], alone.indices)
    assert int(report.candidates_needed) <= capacity.candidates
    assert int(both.mask[800].sum()) == 1


def test_search_under_jit_vmap_and_grad():
    x = jnp.asarray(fibonacci(500))
    radius = 3 * spacing(500)
    capacity = allocate_search(x, radius)
    traces = []

    @jax.jit
    def indices(x, radius):
        traces.append(None)
        return search_neighbors(x, radius=radius, capacity=capacity)[0].indices

    plain = search_neighbors(x, radius=radius, capacity=capacity)[0].indices
    assert np.array_equal(indices(x, radius), plain)
    indices(1.01 * x, 1.01 * radius)
    assert len(traces) == 1
    several = jax.vmap(lambda s: indices(s * x, s * radius))(jnp.array([1.0, 2.0]))
    assert np.array_equal(several[0], plain)
    assert np.array_equal(several[1], indices(2 * x, 2 * radius))

    def energy(x):
        found, _ = search_neighbors(x, radius=radius, capacity=capacity)
        d = jnp.where(found.mask[..., None], x[found.indices] - x[:, None], 0)
        return jnp.sum(d**2)

    slope, step = jax.grad(energy)(x), 1e-5 * jnp.asarray(random_sphere(500))
    change = energy(x + step) - energy(x - step)
    assert abs(float(jnp.vdot(slope, 2 * step) - change)) < 1e-7 * abs(float(change)) + 1e-13


def test_capacity_exceeded_gives_both_numbers():
    x = jnp.asarray(fibonacci(500))
    radius = 3 * spacing(500)
    exact = allocate_search(x, radius, margin=1)
    _, report = search_neighbors(x, radius=radius, capacity=exact)
    assert int(report.k_needed) == exact.k
    assert int(report.candidates_needed) == exact.candidates
    report.check()

    short = SearchCapacity(exact.k - 1, exact.candidates)
    _, report = search_neighbors(x, radius=radius, capacity=short, throw=False)
    assert bool(report.overflow)
    with pytest.raises(ValueError, match=f"{exact.k} neighbours.*capacity is {exact.k - 1}"):
        report.check()
    with pytest.raises(Exception, match=f"{exact.k - 1} slots"):
        search_neighbors(x, radius=radius, capacity=short)[0].indices.block_until_ready()

    short = SearchCapacity(exact.k, exact.candidates - 1)
    _, report = search_neighbors(x, radius=radius, capacity=short, throw=False)
    with pytest.raises(ValueError, match=f"{exact.candidates} points.*{exact.candidates - 1} cand"):
        report.check()

    _, report = search_neighbors(x, radius=radius, capacity=exact, k=40, throw=False)
    with pytest.raises(ValueError, match="40 are needed: enlarge the radius"):
        report.check()

    with pytest.raises(ValueError, match=r"point \d+ has \d+ neighbours.*capacity is 5"):
        find_neighbors(PointCloud(x, x), radius=radius, capacity=5)
    roomy = find_neighbors(PointCloud(x, x), radius=radius, capacity=exact.k + 3)
    assert roomy.k == exact.k + 3


def test_misuse_is_refused():
    x = fibonacci(100)
    cloud = PointCloud(x, x)
    with pytest.raises(ValueError, match="exactly one of k and radius"):
        find_neighbors(cloud)
    with pytest.raises(ValueError, match="exactly one of k and radius"):
        find_neighbors(cloud, 5, radius=1.0)
    with pytest.raises(ValueError, match="k = 1 neighbours"):
        find_neighbors(cloud, 1)
    with pytest.raises(ValueError, match="too few points: 100, with k = 101"):
        find_neighbors(cloud, 101)
    with pytest.raises(ValueError, match="too few points: 40, with k = 50"):
        find_neighbors(PointCloud(x, x, active=np.arange(100) < 40), 50)
    with pytest.raises(ValueError, match=r"radius of point 0 is -1\.0"):
        find_neighbors(cloud, radius=-1.0)
    with pytest.raises(ValueError, match=r"radius of point 0 is 0\.0"):
        find_neighbors(cloud, radius=0.0)
    with pytest.raises(ValueError, match="capacity belongs"):
        find_neighbors(cloud, 5, capacity=6)
    with pytest.raises(ValueError, match="search_neighbors"):
        jax.jit(lambda p: find_neighbors(PointCloud(p, x), 5).indices)(x)
    with pytest.raises(ValueError, match="outside jit"):
        jax.jit(lambda p: allocate_search(p, 1.0))(x)


def test_lone_points_and_duplicates_are_named():
    x = fibonacci(100)
    far = np.r_[x, [[9.0, 0, 0]]]
    with pytest.raises(ValueError, match=r"point 100 has no neighbour within its radius 0\.6"):
        find_neighbors(PointCloud(far, np.r_[x, [[1.0, 0, 0]]]), radius=0.6)
    double = x.copy()
    double[70] = double[20]
    with pytest.raises(ValueError, match=r"points 20 and 70 coincide \(distance 0"):
        find_neighbors(PointCloud(double, x), 8)
    double[70] = double[20] + 1e-12
    with pytest.raises(ValueError, match="points 20 and 70 coincide"):
        find_neighbors(PointCloud(double, x), 8)
    find_neighbors(PointCloud(double, x, active=np.arange(100) != 70), 8)


@pytest.mark.parametrize("make", [fibonacci, random_sphere])
@pytest.mark.parametrize("victim", [3, 500, 777])
def test_one_flipped_point_is_named(make, victim):
    x = make(1000)
    normals = x.copy()
    normals[victim] *= -1
    with pytest.raises(ValueError, match=rf"mixed orientation.*\b{victim}\b"):
        find_neighbors(PointCloud(x, normals), 12)


def test_half_flipped_surfaces_are_refused():
    for x in (fibonacci(1000), random_sphere(1000)):
        for axis in np.eye(3):
            normals = x * np.where(x @ axis > 0.01, 1, -1)[:, None]
            with pytest.raises(ValueError, match="mixed orientation"):
                find_neighbors(PointCloud(x, normals), 12)
    x, normals = plates(1.0)
    x, normals = x[:400], normals[:400] * np.where(np.arange(400) < 200, 1, -1)[:, None]
    with pytest.raises(ValueError, match="mixed orientation"):
        find_neighbors(PointCloud(x, normals), 12)
    angle = 2 * np.pi * np.arange(100) / 100
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    with pytest.raises(ValueError, match="mixed orientation"):
        find_neighbors(PointCloud(circle, circle * np.where(angle < 3, 1, -1)[:, None]), 5)


@pytest.mark.parametrize("gap", [0.12, 0.2, 0.3, 0.5, 1.0, 2.0])
@pytest.mark.parametrize("shift", [(0.0, 0.0), (0.5, 0.5), (0.3, 0.1)])
def test_thin_plates_are_accepted(gap, shift):
    x, normals = plates(gap, shift)
    assert bool(find_neighbors(PointCloud(x, normals), 20).mask.all())
    assert bool(find_neighbors(PointCloud(x, -normals), 20).mask.all())


@pytest.mark.parametrize("gap", [0.3, 0.5, 1.0, 2.0])
def test_concentric_spheres(gap):
    h = spacing(1000)
    inner = fibonacci(1000)
    for outer in (fibonacci(1000), jittered(1000), fibonacci(1100)):
        points = np.r_[inner, (1 + gap * h) * outer]
        cloud = PointCloud(points, np.r_[-inner, outer])
        neighbors = find_neighbors(cloud, 20)
        sheet = np.arange(len(points)) < 1000
        assert np.all(sheet[np.asarray(neighbors.indices)] == sheet[:, None])
    # With parallel normals nothing keeps the sheets apart.
    parallel = PointCloud(np.r_[inner, (1 + gap * h) * inner], np.r_[inner, inner])
    with pytest.raises(ValueError, match="two sheets of the same orientation"):
        find_neighbors(parallel, 20)
    assert find_neighbors(parallel, 20, throw=False).k == 20


@pytest.mark.parametrize("gap", [0.0, 0.02, 0.08])
def test_sheets_too_close_are_refused(gap):
    for shift in [(0.0, 0.0), (0.5, 0.5), (0.3, 0.1)]:
        x, normals = plates(gap, shift)
        with pytest.raises(ValueError, match=r"too close to be told|mixed orientation|coincide"):
            find_neighbors(PointCloud(x, normals), 20)


def test_flipped_points_of_thin_and_rough_sheets_are_named():
    x, normals = plates(0.2, (0.5, 0.5))
    normals[210] *= -1
    with pytest.raises(ValueError, match=r"\b210\b"):
        find_neighbors(PointCloud(x, normals), 12)
    rough = fibonacci(1000) * (1 + 0.1 * spacing(1000) * random_sphere(1000)[:, :1])
    normals = fibonacci(1000)
    find_neighbors(PointCloud(rough, normals), 12)
    for axis in np.eye(3):
        half = normals * np.where(normals @ axis > 0.01, 1, -1)[:, None]
        with pytest.raises(ValueError, match="mixed orientation"):
            find_neighbors(PointCloud(rough, half), 12)


def toes(gap, floor=False, thick=2.0, m=20):
    """Two slabs side by side on a lattice, and the ground that joins them if `floor`."""
    a = np.stack(np.meshgrid(np.arange(m), np.arange(m), indexing="ij"), -1).reshape(-1, 2)
    faces = [0, thick, thick + gap, 2 * thick + gap]
    x = np.concatenate([np.c_[np.full(m * m, f), a + 0.01 * i] for i, f in enumerate(faces)])
    normals = np.repeat([-1.0, 1.0, -1.0, 1.0], m * m)[:, None] * [1.0, 0.0, 0.0]
    sheet = np.repeat(np.arange(4), m * m)
    if floor:
        g = np.stack(np.meshgrid(np.arange(thick + 1, faces[3]), np.arange(m)), -1).reshape(-1, 2)
        x = np.r_[x, np.c_[g, np.full(len(g), -1.0)]]
        normals = np.r_[normals, np.tile([0.0, 0.0, 1.0], (len(g), 1))]
        sheet = np.r_[sheet, np.full(len(g), 4)]
    return x, normals, sheet


@pytest.mark.parametrize("gap", [1.0, 2.0, 3.0])
@pytest.mark.parametrize("thick", [1.5, 2.0])
def test_next_toe_is_rejected(gap, thick):
    """Right sides of two toes face the same way: only the gap keeps them apart."""
    x, normals, sheet = toes(gap, thick=thick)
    cloud = PointCloud(x, normals)
    neighbors = find_neighbors(cloud, 66)
    assert bool(neighbors.mask.all())  # filled up with further points of the same side
    assert np.all(sheet[np.asarray(neighbors.indices)] == sheet[:, None])
    row = 400 + 10 * 20 + 10
    d = np.linalg.norm(x - x[row], axis=1)
    own = [j for j in np.lexsort((np.arange(len(x)), np.round(d, 9))) if sheet[j] == 1]
    assert set(neighbors.indices[row].tolist()[:60]) <= set(own[:66])
    rows = np.array([row, 3, 1555])
    indices, mask = nearest_of(cloud, rows, 66)
    assert np.array_equal(indices, neighbors.indices[rows])
    assert np.array_equal(mask, neighbors.mask[rows])

    within = find_neighbors(cloud, radius=5.6)
    held, found = np.asarray(within.mask), np.asarray(within.indices)
    assert np.all(sheet[found] == sheet[:, None])
    assert set(found[row][held[row]]) == {j for j in own if d[j] <= 5.6}


def test_next_toe_is_rejected_though_the_ground_joins_them():
    x, normals, sheet = toes(2.0, floor=True)
    neighbors = find_neighbors(PointCloud(x, normals), 66)
    found = sheet[np.asarray(neighbors.indices)]
    right = (sheet == 1) & (x[:, 2] > 2)
    # At that height the ground is a detour of at least 10 for 4.
    assert np.all(found[right] != 3)
    low = np.flatnonzero((sheet == 1) & (x[:, 2] < 1))
    assert np.any(found[low] == 4)  # the ground itself stays


def test_parallel_spheres_are_kept_apart_by_a_gap():
    size = 1 + 3.2 * spacing(1000)
    inner, outer = fibonacci(1000), fibonacci(int(1000 * size**2))
    points, normals = np.r_[inner, size * outer], np.r_[inner, outer]
    sheet = np.arange(len(points)) < 1000
    neighbors = find_neighbors(PointCloud(points, normals), 50)
    assert bool(neighbors.mask.all())
    assert np.all(sheet[np.asarray(neighbors.indices)] == sheet[:, None])


@pytest.mark.skipif(not ARMADILLO.exists(), reason="armadillo.obj is not in ../shared/data")
def test_toes_of_the_armadillo():
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # a few points allow no fit
        cloud = read(ARMADILLO, n=10_000)
    neighbors = find_neighbors(cloud, 66)
    assert bool(neighbors.mask.all())
    x, normals = np.asarray(cloud.points), np.asarray(cloud.normals)

    def crossings(lists):
        return int(two_sheets(x, normals, np.asarray(lists), np.arange(cloud.n)).sum())

    slots, _ = nearest(x, normals, cKDTree(x), 66, 0.0)
    assert crossings(slots) > 150
    assert crossings(neighbors.indices) < 40  # steep steps of one side: a short way leads there


def test_tube_ratio_is_the_largest_curvature():
    x = fibonacci(2000)
    axes = np.array([1.0, 0.8, 0.5])
    normals = x / axes
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    cloud = PointCloud(x * axes, normals)
    ratio = np.asarray(tube_ratio(cloud, find_neighbors(cloud, 12)))
    tip = np.argmax(np.abs(x[:, 0]))  # principal curvatures a/c² = 4 and a/b² = 1.56
    assert abs(ratio[tip] - 4) < 0.25  # a neighbour is half a spacing away at best
    assert ratio.max() <= 4
    sphere = PointCloud(3 * x, x)
    neighbors = find_neighbors(sphere, 12)
    assert np.allclose(tube_ratio(sphere, neighbors), 1 / 3, atol=1e-12)
    slope = jax.grad(lambda s: tube_ratio(PointCloud(s * x, x), neighbors).sum())(3.0)
    assert abs(float(slope) + 2000 / 9) < 1e-8
