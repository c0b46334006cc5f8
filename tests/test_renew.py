"""Neighbours of moved points in compiled code: the lists, sizes and operators of the host."""

import dataclasses
import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg

import jaxsurf as js
from jaxsurf.nearest import Grid, nearest_in
from jaxsurf.renew import Tier

from .helpers import check_derivatives, count_compilations, jittered_sphere, random_sphere

pytestmark = [
    pytest.mark.slow,
    pytest.mark.filterwarnings("ignore:the surface bends", "ignore:no neighbourhood"),
]

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


def taken(motion, cloud):
    """The same; rows that are off have no position."""
    there, on = carried(motion, cloud), cloud.active
    if on is None:
        return there
    points = jnp.where(on[:, None], there.points, jnp.nan)
    normals = jnp.where(on[:, None], there.normals, cloud.normals)
    return js.PointCloud(points, normals, active=on)


@functools.partial(jax.jit, static_argnums=2)
def found(surface, cloud, search):
    moved = surface.moved(cloud.points, cloud.normals, search=search)
    return moved, moved.laplacian, moved.code


def roomiest(searches):
    """One with room for all: a program for several clouds."""
    tiers = [Tier(*map(max, zip(*same))) for same in zip(*(search.tiers for search in searches))]
    return dataclasses.replace(searches[0], tiers=tuple(tiers))


@functools.cache
def room():
    clouds = jittered_sphere(600), js.torus(600, 1.0, 0.4)
    surfaces = [js.discretize(c, js.find_neighbors(c, 36), method=METHOD) for c in clouds]
    return roomiest([surface.search(margin=3) for surface in surfaces])


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


def moves(moving, move):
    """What a move makes of a surface, and compiles (from the second on nothing), and `found`."""
    cloud, motions = moving
    surface, search = js.discretize(cloud, js.find_neighbors(cloud, 36), method=METHOD), room()
    for i, motion in enumerate(motions):
        there = taken(motion, cloud)
        with count_compilations() as names:
            made = jax.block_until_ready(move(surface, there, search))
        assert not (i and names), names
        yield there, made, names, functools.partial(found, surface, there, search)


def test_lists_sizes_and_operators_of_the_host(moving):
    for there, (moved, laplacian, code), *_ in moves(moving, found):
        anew = js.choose_neighbors(there, method=METHOD)
        assert lists(moved.neighbors) == lists(anew)
        assert not code.any()
        expected = js.laplace_beltrami(there, anew, method=METHOD, throw=False)
        on = there.host_active
        wanted, width = np.asarray(expected.weights)[:, on], anew.k
        given = np.asarray(laplacian.weights)[:, on]
        np.testing.assert_allclose(given[:width], wanted, atol=1e-11 * np.abs(wanted).max())
        assert not given[width:].any()


def test_known_points_are_searched_by_a_tree(moving):
    """With the lists, operators and codes of compiled code, and nothing to compile for it."""
    for _, made, names, again in moves(moving, found.__wrapped__):
        compiled = again()
        assert "usual_lists" not in names and "_adapted" not in names
        for one, other in zip(jax.tree.leaves(made), jax.tree.leaves(compiled)):
            assert jax.typeof(one) == jax.typeof(other)  # neither compiles users' programs anew
        (known, laplacian, code), (moved, expected, _) = made, compiled
        assert lists(known.neighbors) == lists(moved.neighbors) and not code.any()
        size = jnp.abs(expected.weights).max()
        np.testing.assert_allclose(laplacian.weights, expected.weights, atol=1e-11 * size)


def test_constants_are_searched_in_the_program_that_they_are_in():
    cloud = jittered_sphere(600)
    surface = js.discretize(cloud, js.find_neighbors(cloud, 36), method=METHOD)
    search, x, normals = room(), 1.1 * surface.cloud.points, surface.cloud.normals
    moved = lambda u: surface.moved(x, normals, search=search).laplacian(u)
    u = x[:, 0] * x[:, 1]
    np.testing.assert_allclose(jax.jit(moved)(u), moved(u), atol=1e-10)


def test_points_that_coincide_are_named():
    cloud = jittered_sphere(600)
    surface = js.discretize(cloud, js.find_neighbors(cloud, 36), method=METHOD)
    x = surface.cloud.points
    with pytest.raises(ValueError, match="points 5 and 6 coincide"):
        surface.moved(x.at[5].set(x[6]), search=room())
    with pytest.raises(ValueError, match="points is not finite at point 3"):
        surface.moved(x.at[3].set(jnp.nan), search=room())


def test_lists_may_have_more_slots_than_are_filled():
    cloud = random_sphere(600)
    surface = js.discretize(cloud, js.find_neighbors(cloud, 45), method=METHOD)
    search = surface.search(margin=3)
    assert search.slots == 45 > search.k
    there = taken(functools.partial(smooth, seed=0, size=0.05), cloud)
    moved, _, code = found(surface, there, search)
    known = surface.moved(there.points, there.normals, search=search)
    assert not code.any() and lists(moved.neighbors) == lists(known.neighbors)
    near = js.find_neighbors(there, search.k, throw=False)
    assert lists(near) != lists(known.neighbors)  # some are adapted


def toes(m=10, gap=2.4, thick=1.6):
    """Two slabs side by side on a lattice: right sides of both face the same way."""
    a = np.stack(np.meshgrid(np.arange(m), np.arange(m), indexing="ij"), -1).reshape(-1, 2)
    faces = [0, thick, thick + gap, 2 * thick + gap]
    x = np.concatenate([np.c_[np.full(m * m, f), a + 0.01 * i] for i, f in enumerate(faces)])
    normals = np.repeat([-1.0, 1.0, -1.0, 1.0], m * m)[:, None] * [1.0, 0.0, 0.0]
    return js.PointCloud(0.1 * x, normals), np.repeat(np.arange(4), m * m)


def test_sheets_are_told_apart_as_on_the_host():
    cloud, sheet = toes()
    surface = js.discretize(cloud, method=METHOD)
    search = surface.search(margin=2)
    for seed in (0, 1):
        there = carried(functools.partial(smooth, seed=seed, size=0.02), cloud)
        moved, _, code = found(surface, there, search)
        anew = js.choose_neighbors(there, method=METHOD)
        held = np.asarray(moved.neighbors.mask)
        assert np.all((sheet[np.asarray(moved.neighbors.indices)] == sheet[:, None]) | ~held)
        good = np.asarray(code) < 4
        same = np.array([a == b for a, b in zip(lists(moved.neighbors), lists(anew))])
        assert same[good].all()
        assert good.all(), np.flatnonzero(~good)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_nearest_of_curves_and_of_lattices(dtype):
    """Ties, up to round-off, are broken by the number of the point, in either precision."""
    cloud, _ = toes(gap=5.0)
    turn = np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))[0]
    angle = 2 * np.pi * np.sort(np.random.default_rng(0).uniform(size=300))
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    for points, normals, k, reach in (
        (cloud.points @ turn, cloud.normals @ turn, 20, 0.5),
        (circle, circle, 9, 0.4),
    ):
        points, normals = jnp.asarray(points, dtype), jnp.asarray(normals, dtype)
        rows = jnp.arange(len(points), dtype=jnp.int32)
        host = js.find_neighbors(js.PointCloud(points, normals), k, throw=False)

        @functools.partial(jax.jit, static_argnums=2)
        def search(points, normals, few, rows=rows, k=k, reach=reach):
            grid = Grid.of(points, normals, rows >= 0, jnp.asarray(reach, points.dtype))
            return nearest_in(grid, rows, k, reach=1, count=400, few=few)

        for few in (False, True):
            result = search(points, normals, few)
            assert not result.crowded.any() and result.mask.all()
            np.testing.assert_array_equal(result.indices.T, host.indices)


def test_what_has_no_room_or_is_out_of_reach_has_a_code():
    cloud = jittered_sphere(600)
    surface = js.discretize(cloud, method=METHOD)
    rough = random_sphere(600)
    narrow = js.discretize(rough, js.find_neighbors(rough, 36), method=METHOD)
    normals, search = cloud.normals, narrow.search(margin=2)
    moved = jax.jit(lambda surface, x, n: surface.moved(x, n, search=search))
    call = functools.partial(moved, surface)
    code = jax.jit(lambda s: s.code)
    still = call(cloud.points, normals)
    assert not code(still).any()
    # Ten times as many points within a cell, on a part of the surface.
    near = (cloud.points[:, 2] > 0.5)[:, None]
    top = jnp.array([0.0, 0.0, 1.0])
    crowd = js.PointCloud(jnp.where(near, top + 0.2 * (cloud.points - top), cloud.points), normals)
    crowded = call(crowd.points, normals)
    assert (code(crowded) == 5).any()
    kept = np.asarray(code(crowded)) == 5
    usual = np.asarray(still.neighbors.indices)
    np.testing.assert_array_equal(np.asarray(crowded.neighbors.indices)[kept][:, :36],
                                  np.asarray(surface.neighbors.indices)[kept])  # fmt: skip
    assert usual.shape == crowded.neighbors.indices.shape
    with pytest.raises(
        ValueError, match=r"point \d+: more neighbours than there is room for.*search"
    ):
        crowded.check()
    # One point alone, far from all others.
    lost = code(call(cloud.points.at[7].set(jnp.array([9.0, 0, 0])), normals))
    assert lost[7] == 4 and (np.asarray(lost) > 0).sum() < 60
    folded = cloud.points * jnp.where(cloud.points[:, :1] > 0, 1, -1) * jnp.array([1.0, 0.2, 1.0])
    turned = jnp.where(cloud.points[:, :1] > 0, 1, -1) * normals
    assert (code(call(folded, turned)) == 2).any()
    assert code(call(cloud.points.at[3].set(jnp.nan), normals))[3] == 1


def test_what_finds_no_wider_list_keeps_that_of_before_and_its_stencil():
    """Where the usual list, found before that, does not serve it."""
    rough = random_sphere(900)
    before = js.discretize(rough, js.find_neighbors(rough, 36), method=METHOD)
    search = before.search(margin=2)
    *others, wide = search.tiers
    cramped = dataclasses.replace(search, tiers=(*others, wide._replace(candidates=wide.k)))
    there = carried(lambda x: smooth(x, 2, 0.15), rough)
    moved, laplacian, code = found(before, there, cramped)
    kept = np.asarray(code) == 5
    assert 10 < kept.sum() < 300
    old = np.asarray(before.neighbors.indices)
    np.testing.assert_array_equal(np.asarray(moved.neighbors.indices)[kept][:, :36], old[kept])
    usual = np.asarray(js.find_neighbors(there, 36).indices)
    assert np.mean(np.any(np.sort(usual) != np.sort(old), axis=1)[kept]) > 0.5
    stencil = js.laplace_beltrami(there, moved.neighbors, method=METHOD, throw=False)
    np.testing.assert_allclose(
        laplacian.weights, stencil.weights, atol=1e-9 * np.abs(stencil.weights).max()
    )


def test_kept_lists_reach_as_long_as_the_surface_is_not_stretched_one_way():
    cloud = js.sphere(600)
    surface = js.discretize(cloud, method=METHOD)
    code = jax.jit(lambda x, n: surface.moved(x, n).code)

    def stretched(factor):
        return carried(lambda x: x * jnp.array([1.0, 1.0, factor]), cloud)

    for there in (stretched(1.6), js.PointCloud(7 * cloud.points, cloud.normals)):
        assert not code(there.points, there.normals).any()
    # Along the equator, points come nearer across the stretched direction.
    there = stretched(4.0)
    equator = jnp.abs(cloud.points[:, 2]) < 0.3
    assert (code(there.points, there.normals) == 4)[equator].all()
    with pytest.raises(ValueError, match=r"point \d+: its list of neighbours no longer reaches"):
        surface.moved(there.points, there.normals)
    # In steps, each of which is short: what counts is where the lists were found.
    step = surface
    for factor in (1.6, 2.5):
        there = stretched(factor)
        step = eqx.filter_jit(lambda s, c: s.moved(c.points, c.normals))(step, there)
    assert (step.code == 4).any()
    # A search finds what is nearer now.
    search = step.search(margin=6)
    moved, _, now = found(step, there, search)
    assert not now.any()
    assert lists(moved.neighbors) == lists(js.choose_neighbors(there, method=METHOD))


def test_mapped():
    """Also rows that are treated in loops: those of random points are adapted."""
    cloud = random_sphere(600)
    surface = js.discretize(cloud, js.find_neighbors(cloud, 36), method=METHOD)
    search = surface.search(margin=2)

    def lists_of(there):
        moved = surface.moved(there.points, there.normals, search=search)
        return moved.neighbors, moved.code

    several = [carried(functools.partial(smooth, seed=2, size=s), cloud) for s in (0.0, 0.08)]
    together, codes = jax.jit(jax.vmap(lists_of))(jax.tree.map(lambda *a: jnp.stack(a), *several))
    assert not codes.any()
    for i, there in enumerate(several):
        one = jax.tree.map(lambda a, i=i: a[i], together)
        assert lists(one) == lists(js.choose_neighbors(there, method=METHOD))


def test_derivatives_with_lists_that_are_found():
    """In points and normals, of two surfaces one after the other: some lists of one are adapted."""
    clouds = [jittered_sphere(600), random_sphere(600)]
    surfaces = [js.discretize(c, js.find_neighbors(c, 36), method=METHOD) for c in clouds]
    search = surfaces[1].search(margin=2)
    usual = [
        lists(s.neighbors) == lists(js.choose_neighbors(s.cloud, method=METHOD)) for s in surfaces
    ]
    assert usual == [True, False]
    surfaces, clouds = (jax.tree.map(lambda *a: jnp.stack(a), *x) for x in (surfaces, clouds))

    def energy(surface, points, normals):
        normals = normals / jnp.linalg.norm(normals, axis=1, keepdims=True)
        moved = surface.moved(points, normals, search=search)
        u = jnp.sin(surface.cloud.points[:, 0])
        return jnp.stack([jnp.vdot(u, moved.laplacian(u)), jnp.sum(moved.gradient(u) ** 2)])

    energies = lambda *moved: jax.lax.map(lambda one: energy(*one), (surfaces, *moved))
    check_derivatives(energies, clouds.points, clouds.normals, step=2e-4)


def test_single_precision():
    double = jittered_sphere(600)
    cloud = js.PointCloud(*(jnp.asarray(a, jnp.float32) for a in (double.points, double.normals)))
    surface = js.discretize(cloud, method=METHOD)
    moved = surface.moved(2 * cloud.points, search=surface.search())
    assert moved.laplacian.weights.dtype == jnp.float32
    there = js.PointCloud(2 * cloud.points, cloud.normals)
    assert lists(moved.neighbors) == lists(js.choose_neighbors(there, method=METHOD))


@pytest.mark.parametrize("degree", [2, 4])
def test_a_moved_cloud_is_as_stable_as_a_new_one(degree):
    """No growing modes after smooth deformations of the stability study's clouds."""
    method = js.GFDM(degree=degree)
    many = random_sphere(2_000)
    spread = js.poisson_disk(many.points, 0.17, normals=many.normals)
    disk = js.PointCloud(many.points[spread], many.normals[spread])
    # As many points, lists as long and one search: one program.
    starts = [disk, jittered_sphere(disk.n), random_sphere(disk.n)]
    k = method.neighbor_count(3)
    surfaces = [js.discretize(c, js.find_neighbors(c, k), method=method) for c in starts]
    search = roomiest([surface.search(margin=3) for surface in surfaces])
    for start, surface in zip(starts, surfaces):
        for seed in (0, 1):
            there = carried(functools.partial(smooth, seed=seed, size=0.1), start)
            _, laplacian, code = found(surface, there, search)
            assert not code.any()
            for operator in (laplacian, js.laplace_beltrami(there, method=method)):
                values = scipy.linalg.eigvals(operator.to_scipy().toarray())
                assert values.real.max() < 1e-8 * np.abs(values).max(), (seed, operator)


def test_the_search_is_made_on_the_host():
    surface = js.discretize(js.sphere(300), method=METHOD)
    with pytest.raises(ValueError, match="the surface must be concrete"):
        eqx.filter_jit(lambda s: s.search())(surface)
