"""Level sets whose parts meet, are born and vanish while they are optimised."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

import jaxsurf as js
from jaxsurf.shapes.level_sets import double_torus, watched
from jaxsurf.shapes.topology import Sides

from .helpers import count_compilations

pytestmark = pytest.mark.slow

METHOD = js.GFDM(degree=2)
BOX = ((-3.0, -1.8, -1.8), (3.0, 1.8, 1.8))
AXIS = jnp.array([1.0, 0.0, 0.0])


def metaballs(x, apart):
    """Two, that are one where their centres are near."""
    ball = lambda middle: jnp.exp(-2 * (jnp.sum((x - middle) ** 2) - 1))
    return 1 - ball(apart * AXIS) - ball(-apart * AXIS)


def family(x, growth):
    """A ball of radius 1 + growth / 4, and beside it one of radius growth, if that is positive."""
    ball = lambda middle, radius: jnp.linalg.norm(x - middle) - radius
    return jnp.minimum(ball(-1.5 * AXIS, 1 + growth / 4), ball(1.5 * AXIS, growth))


@functools.cache
def sampled(phi, theta, n=400):
    cloud = js.level_set(lambda x: phi(x, theta), n=n, bounds=BOX)
    return js.discretize(cloud, method=METHOD)


def width(surface):
    return surface.mean(surface.cloud.points[:, 0] ** 2)


def area(surface):
    return surface.areas.sum()


def sheets(phi, theta):
    values = watched(lambda x: phi(x, theta), 3)[0]
    return Sides.of(values, np.array(BOX), 48).sheets()


@pytest.mark.parametrize("optimizer", [optax.sgd(0.1), optax.lbfgs()])
def test_two_that_meet_become_one(optimizer):
    """Width and area are those of the level set that is found, sampled far finer."""
    shape = js.LevelSetShape(metaballs, sampled(metaballs, 1.6), BOX)
    found = js.optimize_shape(
        lambda surface: (width(surface) - 0.9) ** 2, shape, 1.6, optimizer=optimizer
    )
    assert found.converged and found.history["rebuilt"].sum() >= 1
    assert "1 rebuilt" in repr(found)
    assert len(sheets(metaballs, 1.6).share) == 2 and len(sheets(metaballs, found.theta).share) == 1
    surface, fine = found.surface, sampled(metaballs, float(found.theta), 2_000)
    phi = jax.vmap(metaballs, (0, None))(surface.cloud.points, found.theta)
    assert float(jnp.abs(phi).max()) < 1e-13 and surface.n == 400
    np.testing.assert_allclose(area(surface), area(fine), rtol=2e-3)
    np.testing.assert_allclose(width(fine), 0.9, rtol=5e-3)


def turned(x, size):
    return size * x[jnp.array([2, 0, 1])]


def test_two_that_meet_become_one_under_a_map_as_well():
    """In three times the size, turned: points, and neighbours, are those of the level set."""
    shape = js.LevelSetShape(metaballs, sampled(metaballs, 1.6), BOX)
    width = lambda surface: surface.mean(surface.cloud.points[:, 1] ** 2) / 9
    found = js.optimize_shape(
        lambda surface: (width(surface) - 0.9) ** 2,
        js.MappedShape(lambda x, nothing: turned(x, 3.0), shape), (1.6, 0.0),
        optimizer=optax.sgd(0.1),
    )  # fmt: skip
    assert found.converged and found.history["rebuilt"].sum() == 1
    theta, fine = found.theta[0], sampled(metaballs, float(found.theta[0]), 2_000)
    np.testing.assert_allclose(area(found.surface), 9 * area(fine), rtol=2e-3)
    assert found.shape.base.topology.tolist() == [1, 0]
    before = js.MappedShape(turned, shape)
    apart = (1.6, jnp.array([3.0, 0.5, 1.0]))
    known = before.rebuilt(apart)
    assert known.rebuilt(apart) is known and known.base.topology.tolist() == [2, 0]
    lists = lambda shape: shape.base.surface.neighbors.indices
    assert np.array_equal(lists(known), lists(before)), "only topology was to be noted"
    there = theta, apart[1]
    one = known.rebuilt(there)
    wanted = js.choose_neighbors(one(there).cloud, method=METHOD)
    rows = [map(set, indices.tolist()) for indices in (lists(one), wanted.indices)]
    assert np.mean([len(a & b) / len(b) for a, b in zip(*rows)]) > 0.99


def test_one_that_is_born_counts():
    """The area that is reached is that of both; without bounds only the first would be seen."""
    wanted = 4 * np.pi * (1.2**2 + 0.8**2)
    away = lambda surface: (area(surface) / wanted - 1) ** 2
    shape = js.LevelSetShape(family, sampled(family, -0.1), BOX)
    found = js.optimize_shape(away, shape, -0.1, optimizer=optax.sgd(0.5))
    assert found.converged and found.history["rebuilt"].sum() >= 1
    np.testing.assert_allclose(found.theta, 0.8, atol=5e-3)
    assert 72 <= int(jnp.sum(found.surface.cloud.points[:, 0] > 0)) < 200
    alone = js.LevelSetShape(family, sampled(family, -0.1))(found.theta)
    np.testing.assert_allclose(area(alone), 4 * np.pi * 1.2**2, rtol=5e-3)


def test_one_that_vanishes_leaves_its_points_to_the_other():
    wanted = 4 * np.pi * 0.95**2
    shape = js.LevelSetShape(family, sampled(family, 0.5), BOX)
    found = js.optimize_shape(
        lambda surface: (area(surface) / wanted - 1) ** 2, shape, 0.5, optimizer=optax.sgd(0.5)
    )
    assert found.converged and found.history["rebuilt"].sum() >= 1
    np.testing.assert_allclose(4 * np.pi * (1 + found.theta / 4) ** 2, wanted, rtol=2e-3)
    assert float(found.surface.cloud.points[:, 0].max()) < 0 and found.surface.n == 400


def test_other_points_compile_nothing():
    """The first rebuild and renewal compile a search; others, and steps, nothing."""
    shape = js.LevelSetShape(metaballs, sampled(metaballs, 1.6), BOX)
    seen = []
    with count_compilations() as names:
        found = js.optimize_shape(
            lambda surface, wanted: (width(surface) - wanted) ** 2,
            shape,
            1.6,
            optimizer=optax.sgd(0.05),
            args=(jnp.asarray(0.9),),
            rtol=1e-3,
            callback=lambda now: seen.append(len(names)),
        )
    rows = found.history
    first = max(int(np.flatnonzero(rows[name])[0]) for name in ("rebuilt", "renewed"))
    assert seen[-1] == seen[first - 1], names[seen[first - 1] :]
    search, apart = found.surface.search(), jnp.full_like(found.theta, 1.6)
    with count_compilations() as names:
        again = found.shape.rebuilt(apart, search)
    assert not names, names
    assert again.rebuilt(apart, search) is again is not found.shape
    assert again.topology.tolist() == [2, 0] and found.shape.topology.tolist() == [1, 0]


def test_a_run_goes_on_from_its_file_with_the_points_it_had(tmp_path):
    def run(**options):
        shape = js.LevelSetShape(metaballs, sampled(metaballs, 1.6), BOX)
        optimizer = optax.sgd(0.05)
        return js.optimize_shape(
            _narrow, shape, 1.6, optimizer=optimizer, steps=8, rtol=0, throw=False, **options
        )

    def interrupt(now):
        if now.history["rebuilt"].sum():
            raise KeyboardInterrupt

    whole, parts = run(), js.Checkpoint(tmp_path / "run.npz", every=1)
    with pytest.raises(KeyboardInterrupt):
        run(checkpoint=parts, callback=interrupt)
    again = run(checkpoint=parts)
    assert np.array_equal(again.surface.cloud.points, whole.surface.cloud.points)
    for name in set(whole.history) - {"seconds"}:
        np.testing.assert_array_equal(again.history[name], whole.history[name])


def _narrow(surface):
    return (width(surface) - 0.9) ** 2


def test_what_leaves_the_box_or_is_no_more_is_told():
    """At the start, and later with the last good shape."""
    ball = lambda x, radius: jnp.linalg.norm(x) - radius
    surface = js.discretize(js.sphere(200), method=METHOD)
    shape = js.LevelSetShape(ball, surface, ((-1.5,) * 3, (1.5,) * 3))
    radius = lambda surface: jnp.mean(jnp.linalg.norm(surface.cloud.points, axis=1))
    run = lambda f, radius: js.optimize_shape(f, shape, radius, optimizer=optax.sgd(0.2))
    with pytest.raises(ValueError, match="leaves the bounds"):
        run(radius, 1.6)
    with pytest.raises(ValueError, match="phi has no zero within the bounds"):
        run(radius, -0.5)
    with pytest.raises(js.OptimizationError, match="12 times, and still the level set leaves") as e:
        run(lambda surface: -radius(surface), 1.0)
    assert 1.4 < float(e.value.solution.theta) < 1.5
    what = "12 times, and still the level set vanishes"
    with pytest.raises(js.OptimizationError, match=what) as e:
        run(radius, 1.0)
    assert 0 < float(e.value.solution.theta) < 0.1


@pytest.mark.parametrize("centre", [0.0, 0.031])
def test_a_ball_vanishes_around_a_node_of_the_grid_as_elsewhere(centre):
    """A node within it would be seen however small it is."""
    ball = lambda x, radius: jnp.sum((x - centre) ** 2) - radius**2
    cloud = js.sphere(200)
    cloud = js.PointCloud(cloud.points + centre, cloud.normals)
    surface = js.discretize(cloud, method=METHOD)
    shape = js.LevelSetShape(ball, surface, ((-1.5,) * 3, (1.5,) * 3))
    what = "the level set vanishes" if centre == 0 else "phi has no zero"
    with pytest.raises(js.OptimizationError, match=f"12 times, and still {what}") as e:
        js.optimize_shape(lambda s: s.areas.sum(), shape, 1.0, optimizer=optax.sgd(0.03), steps=60)
    assert 0.02 < float(e.value.solution.theta) < 0.1


@pytest.mark.parametrize(
    "phi, parts, tunnels",
    [
        (double_torus(0.4)[0], 1, 2),
        (lambda x: -double_torus(0.4)[0](x), 1, 2),
        (lambda x: jnp.abs(jnp.linalg.norm(x) - 1) - 0.3, 2, 0),
        (lambda x: metaballs(x, 1.6), 2, 0),
        (lambda x: jnp.abs(jnp.hypot(jnp.hypot(x[0], x[1]) - 1, x[2]) - 0.4) - 0.15, 2, 2),
    ],
)
def test_parts_and_tunnels(phi, parts, tunnels):
    """Two tori, one within the other, enclose a shell that both their tunnels go through."""
    found = sheets(lambda x, _: phi(x), None)
    assert len(found.share) == parts and found.tunnels == tunnels


def test_curves():
    """In the plane."""
    phi = lambda x, apart: metaballs(jnp.array([x[0], x[1], 0.0]), apart)
    box = ((-3.0, -1.8), (3.0, 1.8))
    points = lambda apart: js.level_set(lambda x: phi(x, apart), n=80, bounds=box)
    shape = js.LevelSetShape(phi, js.discretize(points(1.6), method=METHOD), box)
    shape = shape.rebuilt(1.6)
    assert shape.rebuilt(1.5) is shape
    one = shape.rebuilt(0.7)
    assert one is not shape and one.topology.tolist() == [1, 0]
    np.testing.assert_allclose(
        one(0.7).areas.sum(), js.discretize(points(0.7)).areas.sum(), rtol=1e-3
    )
