"""Sheets that meet: necks pinch off, drops become one, others are kept apart."""

import warnings

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial import cKDTree

import jaxsurf as js
from jaxsurf.moving.contact import chambers, facing, turned_over, watched, without_other_parts
from jaxsurf.moving.surgery import HermiteSurface, rejoined

from .helpers import killed

METHOD = js.GFDM(degree=2)
RNG = np.random.default_rng(3)


def spheres(n, centers, radii):
    x = np.asarray(js.sphere(n).points)
    turned = (x, x[:, [1, 0, 2]])
    points = [c + r * y for c, r, y in zip(centers, radii, turned)]
    return js.PointCloud(np.concatenate(points), np.concatenate(turned))


def closed(surface):
    """Number of parts, from their total curvature 4 pi each, and from their lists."""
    parts = chambers(surface.cloud, surface.neighbors)
    with warnings.catch_warnings(action="ignore"):  # new parts bend within few spacings
        total = float(surface.integrate(surface.gauss_curvature)) / (4 * np.pi)
    return total, parts.max() + 1


def test_a_hermite_surface_meets_its_conditions_and_a_sphere():
    x = np.asarray(js.sphere(60).points)
    surface = HermiteSurface(x, x, np.zeros((1, 3)), np.array([-0.5]), 0.4)
    value, slope = surface(x)
    assert np.abs(value).max() < 1e-10 and np.abs(slope - x).max() < 1e-9
    assert abs(surface(np.zeros((1, 3)))[0][0] + 0.5) < 1e-10
    y = RNG.normal(size=(200, 3))
    y /= np.linalg.norm(y, axis=1, keepdims=True)
    value, slope = surface(y)
    assert np.abs(value).max() < 5e-3
    ahead, h = RNG.normal(size=3), 1e-5
    difference = (surface(y + h * ahead)[0] - surface(y - h * ahead)[0]) / (2 * h)
    np.testing.assert_allclose(slope @ ahead, difference, atol=1e-7)


def test_what_faces_what():
    """Two spheres by their outsides, one that is small by its inside, as a search of all tells."""
    cloud = spheres(300, ([-1.1, 0, 0], [0.2, 0, 0]), (1.0, 0.2))
    found = facing(cloud, 0.45)
    x, n = cloud.points, cloud.normals
    way = x[:, None] - x
    gap = np.linalg.norm(way, axis=2)
    ups = np.einsum("ijd,jd->ij", way, n) / np.where(gap > 0, gap, 1)
    good = (n @ n.T < -0.05) & (np.abs(ups) > 0.6) & (np.abs(ups.T) > 0.6)
    good &= (gap < 0.45) & (gap < 0.45 * 1.18 * np.sqrt((1 - n @ n.T) / 2))
    good &= ups * ups.T > 0
    wanted = np.argwhere(np.triu(good))
    assert {tuple(p) for p in found.pairs.tolist()} == {tuple(p) for p in wanted.tolist()}
    both_small = np.all(found.pairs >= 300, axis=1)
    np.testing.assert_array_equal(found.inside, both_small)
    assert both_small.any() and not both_small.all()
    np.testing.assert_allclose(found.gap, gap[*found.pairs.T])


@pytest.mark.parametrize("inside", [False, True])
def test_corners_that_fold(inside):
    """An angle of 60 degrees, and one of 90 in which a point was left behind; not one of 90."""

    def bent(angle, *more):
        s = np.arange(-10, 10) + 0.5
        across, up = np.sin(np.radians(angle / 2)), np.cos(np.radians(angle / 2))
        x = np.stack([s * across, np.abs(s) * up], axis=1)
        n = np.stack([-np.sign(s) * up, across + 0 * s], axis=1)
        x, n = np.concatenate([x, *more[:1]]), np.concatenate([n, *more[1:]])
        cloud = js.PointCloud(x, -n if inside else n)
        # As those that were found before it folded.
        near = jnp.asarray(cKDTree(x).query(x, 9)[1], jnp.int32)
        return turned_over(cloud, js.Neighbors(near, jnp.ones(near.shape, bool)))

    folds = bent(60)
    assert [9, 10] in folds.pairs.tolist() and np.all(np.abs(folds.pairs - 9.5) < 3)
    assert np.all(folds.inside == inside)
    sphere = js.sphere(80)
    assert not len(bent(90).pairs)
    assert not len(turned_over(sphere, js.find_neighbors(sphere, k=15)).pairs)
    behind = bent(90, [[0.4, -0.5]], [[-np.sqrt(0.5), np.sqrt(0.5)]])
    assert (behind.pairs[:, 1] == 20).all() and 10 in behind.pairs[:, 0]
    assert np.all(behind.inside == inside)


def with_a_waist(width, spacing=0.07):
    phi = lambda x: x[0] ** 2 + x[1] ** 2 - (1 - x[2] ** 2) * (width**2 + x[2] ** 2)
    return js.level_set(phi, spacing=spacing, bounds=((-0.7, -0.7, -1.1), (0.7, 0.7, 1.1)))


@pytest.mark.parametrize("kind", ["pinched", "joined"])
def test_a_cut_leaves_closed_surfaces(kind):
    pinched = kind == "pinched"
    if pinched:
        cloud, distance = with_a_waist(0.12), 0.25
    else:
        cloud, distance = spheres(800, ([-0.55, 0, 0], [0.55, 0, 0]), (0.5, 0.5)), 0.2
    surface, h, u = js.discretize(cloud, method=METHOD), 0.07, cloud.points[:, 2]
    assert closed(surface)[1] == 2 - pinched
    cut, (v,), found = rejoined(surface, (u,), distance, np.full(cloud.n, h), None)
    assert (found.pinched, found.joined, found.vanished) == (pinched, not pinched, 0)
    smooth = js.adapt_points(cut, js.Adaptation(h)).surface
    total, parts = closed(smooth)
    assert parts == 1 + pinched and abs(total - parts) < 0.15
    assert not len(facing(smooth.cloud, distance).pairs)
    # Other points are as they were, new ones carry what is around them.
    on = np.flatnonzero(cut.cloud.host_active)
    x, v = np.asarray(cut.cloud.points)[on], np.asarray(v)[on]
    away = cKDTree(cloud.points).query(x)[0]
    assert np.all(away[np.linalg.norm(x, axis=1) > 0.5] == 0) and away.max() > h / 2
    assert np.all(v[away == 0] == x[away == 0, 2]) and np.abs(v - x[:, 2]).max() < 0.12


def test_plane_curves_pinch_too():
    angle = 2 * np.pi * np.arange(160) / 160
    width = 0.1 + 0.9 * np.abs(np.cos(angle)) ** 2
    x = np.stack([np.cos(angle), width * np.sin(angle)], axis=1)
    tangent = np.roll(x, -1, axis=0) - np.roll(x, 1, axis=0)
    normals = np.stack([tangent[:, 1], -tangent[:, 0]], axis=1)
    cloud = js.PointCloud(x, normals / np.linalg.norm(normals, axis=1, keepdims=True))
    cloud = js.PointCloud(
        cloud.points,
        js.refit_normals(cloud.points, cloud.normals, js.find_neighbors(cloud, k=9), degree=4),
    )
    surface = js.discretize(cloud, method=METHOD)
    cut, _, found = rejoined(surface, (), 0.25, np.full(160, 0.04), None)
    assert (found.pinched, found.joined) == (1, 0)
    smooth = js.adapt_points(cut, js.Adaptation(0.04)).surface
    assert chambers(smooth.cloud, smooth.neighbors).max() == 1
    turning = smooth.integrate(smooth.mean_curvature)
    assert abs(float(turning) / (2 * np.pi) - 2) < 0.1


def test_a_part_of_too_few_points_vanishes():
    """Though nothing of it faces anything: no stencil has room on it."""
    few = METHOD.neighbor_count(3) - 1
    x = [np.asarray(js.sphere(n).points) for n in (300, few)]
    cloud = js.PointCloud(np.concatenate([x[0], 0.3 * x[1] + [2.0, 0, 0]]), np.concatenate(x))
    neighbors = js.find_neighbors(cloud, METHOD.neighbor_count(3))
    surface = js.Discretization(cloud, neighbors, METHOD)
    assert not len(facing(cloud, 0.2).pairs)
    after, _, found = rejoined(surface, (), 0.2, np.full(cloud.n, 0.2), None)
    assert (found.pinched, found.joined, found.vanished) == (0, 0, 1)
    np.testing.assert_array_equal(after.cloud.host_active, np.arange(cloud.n) < 300)


def shrinking(t, surface, fields, args):
    return -surface.cloud.normals


@pytest.mark.slow
def test_parts_vanish_and_a_run_ends_with_the_last():
    cloud = spheres(250, ([-1, 0, 0], [1, 0, 0]), (0.3, 0.4))
    given = dict(adapt=js.Adaptation(0.08, capacity=550), contact=js.Contact(0.32), method=METHOD)
    run = js.evolve(js.Motion(shrinking), cloud, t1=0.4, saveat=[0.1, 0.2, 0.35], **given)
    # They are as thick as the distance at 0.14 and 0.24.
    np.testing.assert_array_equal(run.ts, [0.1, 0.2])
    assert np.asarray(run.clouds[0].points)[:, 0].min() < -1
    assert np.asarray(run.clouds[1].points)[:, 0].min() > 0.8
    events = run.history["events"]
    gone = events["t"][events["vanished"] > 0]
    np.testing.assert_array_equal(events["vanished"][events["vanished"] > 0], 1)
    np.testing.assert_allclose(gone, [0.14, 0.24], atol=0.016)
    assert not events["pinched"].any() and not events["joined"].any()


@pytest.mark.slow
def test_a_run_may_end_before_anything_was_saved():
    """A circle is as thick as the distance, or 1.2 times so, when its radius is 0.3 or 0.25."""
    inward = js.Motion(lambda t, surface, fields, args: -surface.cloud.normals)
    given = dict(adapt=js.Adaptation(0.16, capacity=60), contact=js.Contact(0.5))
    run = js.evolve(inward, js.circle(40), t1=2.0, method=js.GFDM(degree=2), **given)
    assert "nothing was left" in repr(run) and not run.clouds
    history = run.history
    assert all(history[name].shape == (0,) for name in ("t", "n", "area", "volume", "mass"))
    assert history["events"]["vanished"].sum() == 1 and 0.7 < history["events"]["t"][-1] < 0.75


@pytest.mark.slow
def test_a_waist_that_is_squeezed_pinches_off(tmp_path, monkeypatch):
    """And a run that was killed ends in the same bits."""
    start = with_a_waist(0.28, 0.1)

    def squeezed(t, surface, fields, args):
        x = surface.cloud.points
        return -x * jnp.array([1.0, 1, 0]) * jnp.exp(-((x[:, 2:] / 0.3) ** 2))

    def run(name):
        given = dict(fields=jnp.ones(start.n), adapt=js.Adaptation(0.1, capacity=start.n + 100))
        given |= dict(checkpoint=js.Checkpoint(tmp_path / name, every=0.6), method=METHOD)
        return js.evolve(js.Motion(squeezed), start, t1=0.8, contact=js.Contact(0.4), **given)

    whole = run("whole")
    events, end = whole.history["events"], whole.surfaces[-1]
    assert events["pinched"].sum() == 1 and events["joined"].sum() == 0
    # Its radius falls as exp(-t); between 1 and 0.85 of its width is looked at, and sheets may
    # come nearer by a fifth of the distance between two looks.
    pinched = float(events["t"][events["pinched"] > 0][0])
    assert np.log(0.85 * 0.28 / 0.2) < pinched < np.log(0.28 / (0.8 * 0.2))
    assert chambers(end.cloud, end.neighbors).max() == 1
    assert np.abs(whole.fields[-1] - 1).max() < 1e-12
    assert np.abs(end.cloud.points[:, 2]).min() > 0.1

    again = killed(run, monkeypatch)
    np.testing.assert_array_equal(again.changes, whole.changes)
    np.testing.assert_array_equal(again.clouds[-1].points, whole.clouds[-1].points)


def test_the_distance_of_curved_sheets():
    """Two unit spheres; by planes in place of quadratic fits it is five times as far off."""
    errors = []
    for n in (500, 2000):
        cloud = spheres(n, ([0, 0, -1.1], [0, 0, 1.1]), (1.0, 1.0))
        surface = js.discretize(cloud, js.find_neighbors(cloud, k=9))
        contact, new = js.Contact(0.2, kind="non-penetration"), np.full(cloud.n, -1)
        apart = watched(contact, cloud, surface.neighbors, new)[1]
        x, low = cloud.points, np.arange(cloud.n)[:, None] < n
        bends = jnp.eye(3) - cloud.normals[:, :, None] * cloud.normals[:, None]
        gap, out, _ = apart.gap(x, cloud.normals, bends)
        way = np.asarray(x) + np.where(low, -1, 1) * [0, 0, 1.1]
        exact = np.linalg.norm(way, axis=1)
        near = np.asarray(apart.mask[:, 0]) & (exact < 1.4)
        assert near.sum() > 50
        errors.append(np.abs(gap - (exact - 1))[near].max())
        by_planes = apart.gap(x, cloud.normals, 0 * bends)[0]
        assert np.abs(by_planes - (exact - 1))[near].max() > 5 * errors[-1]
        assert np.abs(out - way / exact[:, None])[near].max() < 5e-4
    assert errors[0] < 3e-3 and errors[1] < 0.35 * errors[0]


def test_points_far_from_a_small_sheet_are_free():
    """In its radii a fit of second order tells any distance."""
    centers, radii, d = np.array([[0, 0, 0], [1.9, 0.3, 0.2]]), (1.0, 0.6), 0.3
    cloud = spheres(400, centers, radii)
    surface = js.discretize(cloud, js.find_neighbors(cloud, k=9))
    contact, new = js.Contact(d, kind="merge"), np.full(cloud.n, -1)
    apart = watched(contact, cloud, surface.neighbors, new)[1]
    part = np.repeat([0, 1], 400)
    bends = jnp.eye(3) - cloud.normals[:, :, None] * cloud.normals[:, None]
    bends = bends / np.array(radii)[part][:, None, None]
    velocity = jnp.asarray(np.array([[0, 0, 0], [-1.2, -0.2, 0]])[part])
    change = apart.kept_apart(cloud.points, cloud.normals, bends, velocity) - velocity
    change = np.linalg.norm(change, axis=1)
    away = np.linalg.norm(np.asarray(cloud.points) - centers[1 - part], axis=1)
    away -= np.array(radii)[1 - part]
    watching, far = np.asarray(apart.mask[:, 0]), away > 2.1 * d
    assert (watching & far).sum() > 100 and (away < 1.5 * d).sum() > 20
    np.testing.assert_array_equal(change[far], 0)
    assert change[away < 1.2 * d].min() > 0.4


@pytest.mark.slow
def test_sheets_are_kept_apart():
    """Plates whose normals point the same way, some points off; spheres are in E11."""
    d = 0.2
    flat = np.stack(np.meshgrid(*(np.linspace(-0.5, 0.5, 10),) * 2), axis=2).reshape(-1, 2)
    x = np.c_[np.concatenate([flat, flat + 0.02]), np.repeat([-0.3, 0.3], 100)]
    off = np.arange(200) % 50 == 34
    cloud = js.PointCloud(x, np.tile([[0.0, 0, 1]], (200, 1)), active=~off)
    up = np.sign(x[:, 2:]) * np.array([0.0, 0, 1])
    meet = js.Motion(lambda t, surface, fields, args: -jnp.asarray(up))
    given = dict(method=METHOD, contact=js.Contact(d, kind="non-penetration"))
    run = js.evolve(meet, cloud, t1=0.5, saveat=[0.08], **given)
    # Without contact they would have met at 0.3. At first the other one is too far.
    free, end = (np.asarray(surface.cloud.points) for surface, _ in run.rows)
    assert [one.n for one in run.clouds] == [(~off).sum()] * 2
    np.testing.assert_allclose((free - x)[~off], -0.08 * up[~off], atol=1e-12)
    low = up[:, 2] < 0
    gap = cKDTree(end[low & ~off]).query(end[~low & ~off])[0]
    assert 0.95 * d < gap.min() and np.median(gap) < 1.3 * d
    np.testing.assert_array_equal(run.rows[-1][0].cloud.points[off], x[off])


@pytest.mark.slow
def test_surfaces_stay_apart_though_they_are_near():
    """A ball in a shell, both with normals outwards, stretches it until spacings there are half of
    the way between. (They came to share neighbours, saw each other no longer, and crossed.)"""
    cloud = spheres(600, ([0, 0, 0], [0.1, 0.05, 0]), (1.0, 0.5))
    ahead = jnp.array([1.0, 0.3, 0.2]) * (jnp.arange(1_200) >= 600)[:, None]
    motion = js.Motion(lambda t, surface, fields, args: ahead)
    contact = js.Contact(0.2, kind="non-penetration")
    run = lambda t1: js.evolve(motion, cloud, t1=t1, method=METHOD, contact=contact).clouds[-1]
    x = np.asarray(run(0.9).points)
    assert cKDTree(x[:600]).query(x[600:])[0].min() > 0.2
    with pytest.raises(ValueError, match=r"t = 0\.9.* two sheets of the same orientation"):
        run(1.0)


@pytest.mark.slow
def test_surfaces_stay_apart_where_points_are_added(tmp_path, monkeypatch):
    """Two that grow towards each other; there are more rows in the end, also of a run that was
    killed."""
    cloud = spheres(200, ([-1.0, 0, 0], [1.0, 0, 0]), (0.7, 0.7))
    grow = js.Motion(lambda t, surface, fields, args: surface.cloud.normals)
    contact, adapt = js.Contact(0.36, kind="non-penetration"), js.Adaptation(0.18)

    def run(name):
        checkpoint = js.Checkpoint(tmp_path / name, every=0.3)
        given = dict(method=METHOD, contact=contact, adapt=adapt, checkpoint=checkpoint)
        return js.evolve(grow, cloud, t1=0.35, **given)

    end = run("whole").surfaces[-1]
    again = killed(run, monkeypatch).surfaces[-1]
    np.testing.assert_array_equal(again.cloud.points, end.cloud.points)
    parts, x = chambers(end.cloud, end.neighbors), np.asarray(end.cloud.points)
    assert end.n > 600 and parts.max() == 1
    low, high = (x[parts == label] for label in (parts[x[:, 0].argmin()], parts[x[:, 0].argmax()]))
    assert low[:, 0].max() < 0 < high[:, 0].min() and cKDTree(low).query(high)[0].min() > 0.36


def test_parts_stay_what_they_were():
    """Also where lists are of both, which hold no points of the other part then."""
    surface = js.discretize(js.sphere(300), method=METHOD)
    before = np.where(np.asarray(surface.cloud.points[:, 0]) > 0, 1, 0)
    new = np.arange(300) % 30 == 7
    contact = js.Contact(0.1, kind="non-penetration")
    with pytest.warns(UserWarning, match="distance = 0.1 is shorter than points are apart"):
        parts = watched(contact, surface.cloud, surface.neighbors, np.where(new, -1, before))[2]
    np.testing.assert_array_equal(parts[~new], before[~new])
    x = np.asarray(surface.cloud.points)
    nearest = cKDTree(x[~new]).query(x[new])[1]
    np.testing.assert_array_equal(parts[new], before[~new][nearest])
    lists = without_other_parts(surface, contact, parts).neighbors
    held, mask = parts[np.asarray(lists.indices)], np.asarray(lists.mask)
    assert (held == parts[:, None])[mask].all()
    assert mask.sum() < np.asarray(surface.neighbors.mask).sum()
    assert without_other_parts(surface, js.Contact(0.1), parts) is surface


@pytest.mark.slow
def test_sheets_that_merge_move_as_one():
    """They approach and slide until 0.3; then one is at rest, the other drawn away and on."""
    d, n = 0.2, 100
    flat = np.stack(np.meshgrid(*(np.linspace(-0.5, 0.5, 10),) * 2), axis=2).reshape(-1, 2)
    x = np.c_[np.tile(flat, (2, 1)), np.repeat([-0.2, 0.2], n)]
    low = np.arange(2 * n) < n
    cloud = js.PointCloud(x, np.where(low, -1, 1)[:, None] * np.array([[0.0, 0, 1]]))
    meet, part = jnp.array([0.0, 0, 1]), jnp.array([0.3, 0, 0.5])

    def velocity(t, surface, fields, args):
        return jnp.where(t < 0.6, jnp.where(low, 1, -1)[:, None] * meet, ~low[:, None] * part)

    def moved(kind):
        given = dict(method=METHOD, contact=js.Contact(d, kind=kind), rtol=1e-6)
        run = js.evolve(js.Motion(velocity), cloud, t1=1.6, saveat=[0.6], **given)
        # The middle of plates: at rims the other has points to one side only.
        middle = np.abs(x[:, :2]).max(axis=1) < 0.3
        ways = [np.asarray(b.points - a.points) for a, b in zip(run.clouds, run.clouds[1:])]
        return (way[middle & rows].mean(axis=0) for way in ways for rows in (low, ~low))

    below, above = moved("merge")
    np.testing.assert_allclose(below, above, atol=0.02)
    np.testing.assert_allclose(below, [0.15, 0, 0.25], atol=0.02)
    below, above = moved("non-penetration")
    np.testing.assert_allclose(below, 0, atol=1e-9)
    np.testing.assert_allclose(above, [0.3, 0, 0.5], atol=1e-9)


def test_in_single_precision():
    """The same sheets face each other; velocities and what closes the cut are within 1e-5."""
    cloud, found, values, velocity = with_a_waist(0.12), [], [], []
    middle, y = np.zeros((1, 3)), RNG.uniform(-0.2, 0.2, (100, 3))
    near = np.abs(np.linalg.norm(cloud.points, axis=1) - 0.6) < 0.2
    for dtype in (jnp.float64, jnp.float32):
        x, n = cloud.points.astype(dtype), cloud.normals.astype(dtype)
        found.append(facing(js.PointCloud(x, n), 0.25))
        x, n = (np.asarray(a, float)[near] for a in (x, n))
        values.append(HermiteSurface(x, n, middle, np.array([0.25]), 0.07)(y)[0])
    np.testing.assert_array_equal(found[0].pairs, found[1].pairs)
    one = spheres(60, ([0, 0, -1.3], [0, 0, 1.3]), (1.0, 1.0))
    for dtype in (jnp.float64, jnp.float32):
        x, n = one.points.astype(dtype), one.normals.astype(dtype)
        near = js.PointCloud(x, n)
        contact = js.Contact(0.5, kind="non-penetration")
        apart = watched(contact, near, js.find_neighbors(near, k=9), np.full(near.n, -1))[1]
        bends = jnp.eye(3, dtype=dtype) - n[:, :, None] * n[:, None]
        velocity.append(apart.kept_apart(x, n, bends, -x))
    assert velocity[1].dtype == jnp.float32 and np.abs(velocity[0] - velocity[1]).max() < 1e-5
    assert np.abs(velocity[0] + one.points).max() > 0.1
    assert len(found[0].pairs) and np.abs(values[0] - values[1]).max() < 1e-5
