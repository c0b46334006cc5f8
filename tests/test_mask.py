"""Points that are switched off have no part in anything.

Every public function is called on a cloud a third of whose rows are switched off and hold NaN, as
do the fields given there, and on the cloud without those rows: results agree on the others to
round-off, and are zero on those.
"""

import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxsurf as js

from .helpers import count_compilations, jittered_sphere
from .masked import (
    ALL,
    BESIDE,
    CLOSED,
    EXACT,
    EXEMPT,
    METHOD,
    ON,
    SOLVED,
    TABLE,
    Case,
    L,
    N,
    adapted,
    diffused,
    files,
    given,
    modes,
    nonlinear,
    opened,
    parted,
    saved,
    smooth,
)


def cases():
    for name, row in TABLE.items():
        marks = [] if row.core else [pytest.mark.slow]
        yield pytest.param(name, marks=marks, id=name)


@pytest.mark.parametrize("name", list(cases()))
def test_rows_that_are_off_have_no_part(name, tmp_path):
    row = TABLE[name]
    more = (tmp_path,) if row.call in (saved, files, parted) else ()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of few points
        plain, spread = (row.call(case, *more) for case in (opened() if row.open else CLOSED))
    expected, found = jax.tree.leaves_with_path(plain), jax.tree.leaves(spread)
    assert len(expected) == len(found)
    for (path, want), have in zip(expected, found):
        where = f"{name}{jax.tree_util.keystr(path)}"
        want, have = np.asarray(want), np.asarray(have)
        if have.shape[:1] == (ALL,) and want.shape[:1] == (N,):
            if row.zero:
                assert not have[~ON].any(), f"{where} is not zero where points are off"
            have = have[ON]
        assert have.shape == want.shape, where
        size = np.abs(want).max(initial=0)
        assert np.isfinite(size), where
        np.testing.assert_allclose(have, want, rtol=0, atol=row.rtol * size, err_msg=where)


def test_stencils_keep_the_mask_in_files(tmp_path):
    plain, spread = (saved(case, tmp_path) for case in CLOSED)
    np.testing.assert_allclose(spread[ON], plain, rtol=1e-9)
    assert not spread[~ON].any()


def test_every_public_name_is_tried():
    public = {name for name, value in vars(js).items() if callable(value)}
    exempt = set().union(*EXEMPT.values())
    tried = (set(TABLE) | set(BESIDE)) & public
    assert public == tried | exempt, public ^ (tried | exempt)
    assert not tried & exempt
    assert set(BESIDE.values()) <= set(TABLE)


# --- derivatives ----------------------------------------------------------------------------------


def total(x):
    return jnp.sum(jnp.sin(x))


def solved(cloud, lists, u, c):
    operator = L(cloud, lists, method=METHOD)
    jacobi = js.jacobi(operator)
    found = js.solve(operator, u, preconditioner=jacobi, mean_zero=True, project=True, rtol=1e-11)
    return total(found.value)


def diffuses(cloud, lists, u, c):
    problem = js.AdvectionDiffusionReaction(L(cloud, lists, method=METHOD))
    solver = js.RKC2(spectral_radius=300.0)
    return total(js.integrate(problem, u, t1=0.02, dt0=0.01, solver=solver).ys[-1])


def slope(cloud, lists):
    return js.surface_gradient(cloud, lists, method=METHOD)


DERIVED = {
    "operators": (
        lambda cloud, lists, u, c: (
            total(L(cloud, lists, method=METHOD)(u)) + total(slope(cloud, lists)(u))
        ),
        True,
    ),
    "curvature": (
        lambda cloud, lists, u, c: total(js.gauss_curvature(cloud, lists, method=METHOD)), False
    ),
    "integral": (
        lambda cloud, lists, u, c: js.Discretization(cloud, lists, METHOD).integrate(u), False
    ),
    "interpolation": (
        lambda cloud, lists, u, c: total(
            js.Discretization(cloud, lists, METHOD).interpolate(u, 1.01 * c.x[::9])
        ),
        False,
    ),
    "motion": (
        lambda cloud, lists, u, c: total(
            js.Discretization(cloud, lists, METHOD).moved(2 * cloud.points).laplacian(u)
        ),
        False,
    ),
    "bending": (lambda cloud, lists, u, c: total(js.tube_ratio(cloud, lists)), False),
    "normals": (
        lambda cloud, lists, u, c: total(
            js.refit_normals(cloud.points, cloud.normals, lists, degree=2)[c.rows]
        ),
        False,
    ),
    "upwind_viscosity": (
        lambda cloud, lists, u, c: total(
            js.upwind_viscosity(cloud, cloud.points, neighbors=lists, method=METHOD)(u)
        ),
        False,
    ),
    "solution": (solved, True),
    "modes": (
        lambda cloud, lists, u, c: total(js.eigenmodes(L(cloud, lists, method=METHOD), 4).values),
        False,
    ),
    "distances": (
        lambda cloud, lists, u, c: total(
            js.geodesic_distance(cloud, c.names([3]), neighbors=lists, rtol=1e-11)
        ),
        False,
    ),
    "time": (diffuses, False),
}  # fmt: skip


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=[] if core else [pytest.mark.slow], id=name)
        for name, (_, core) in DERIVED.items()
    ],
)
def test_derivatives_are_zero_where_points_are_off(name):
    f = DERIVED[name][0]

    def slopes(c: Case):
        def value(points, normals, u):
            cloud = js.PointCloud(points, normals, active=c.cloud.active)
            return f(cloud, lists, u, c)

        lists = c.neighbors
        return jax.grad(value, (0, 1, 2))(c.cloud.points, c.cloud.normals, c.u)

    plain, spread = (slopes(case) for case in CLOSED)
    for want, have in zip(plain, spread):
        assert not have[~ON].any()
        size = float(jnp.abs(want).max())
        np.testing.assert_allclose(have[ON], want, rtol=0, atol=1e-7 * size + 1e-12)
    assert max(float(jnp.abs(want).max()) for want in plain) > 1e-3


RETURNED = {
    "solution": lambda s, u, c: js.solve(
        1 - s.laplacian, u, mean_zero=False, preconditioner=js.jacobi(1 - s.laplacian), rtol=1e-11
    ).value,
    "nonlinear": lambda s, u, c: js.solve_nonlinear(
        s.laplacian, lambda v, u: u - v - v**3, jnp.zeros(s.n), args=u,
        preconditioner=js.jacobi(1 - s.laplacian), rtol=1e-11,
    ).value,
    "mode": lambda s, u, c: js.eigenmodes(s.laplacian, 4).functions[:, 1] ** 2,
    "distances": lambda s, u, c: js.geodesic_distance(
        s.cloud, c.names([3]), neighbors=s.neighbors, rtol=1e-11
    ),
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("name", list(RETURNED))
def test_what_comes_back_from_there_in_reverse_has_no_part(name):
    """NaN, where a result is multiplied by a field that has it there."""

    def slopes(c: Case):
        def value(points, u):
            cloud = js.PointCloud(points, c.cloud.normals, active=c.cloud.active)
            surface = js.Discretization(cloud, c.neighbors, METHOD)
            return surface.integrate(c.u * RETURNED[name](surface, u, c))

        return jax.grad(value, (0, 1))(c.cloud.points, c.u)

    plain, spread = (slopes(case) for case in CLOSED)
    for want, have in zip(plain, spread):
        assert not have[~ON].any()
        size = float(jnp.abs(want).max())
        np.testing.assert_allclose(have[ON], want, rtol=0, atol=1e-7 * size)
    assert plain[0].any()


# --- compilation ----------------------------------------------------------------------------------


def masked(seed, count):
    x = np.asarray(jittered_sphere(ALL, fraction=0.1).points)
    active = np.zeros(ALL, bool)
    active[np.random.default_rng(seed).permutation(ALL)[:count]] = True
    return Case(js.PointCloud(x, x, active=active), np.flatnonzero(active))


def sources(c: Case):
    return c.names([5])


COMPILED = {
    "operators": (lambda c: (c.laplacian(c.u), (c.laplacian @ c.laplacian)(c.u)), True),
    "curvatures": (lambda c: js.principal_curvatures(c.cloud, c.neighbors, method=METHOD), True),
    "integrals": (lambda c: (c.surface.areas, c.surface.mean(c.u)), True),
    "interpolation": (lambda c: c.surface.interpolate(c.u, c.x[:20]), False),
    "solve": (lambda c: js.solve(c.laplacian, given(c), project=True).value, True),
    "newton": (nonlinear, False),
    "weights": (lambda c: js.conservative_weights(c.laplacian, 1.0), False),
    "modes": (modes, False),
    "distance": (lambda c: js.geodesic_distance(c.cloud, sources(c)), False),
    "explicit steps": (lambda c: diffused(c, solver=js.RKC2()), False),
    "implicit steps": (lambda c: diffused(c, solver=js.IMEX(order=2)), False),
    "adapted steps": (adapted, True),
}


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=[] if core else [pytest.mark.slow], id=name)
        for name, (_, core) in COMPILED.items()
    ],
)
def test_another_mask_compiles_nothing(name):
    f = COMPILED[name][0]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of few points
        jax.block_until_ready(f(masked(1, N)))
        if name == "integrals":  # cells of uneven points have a program of their own
            jax.block_until_ready(f(masked(4, N + 10)))
        with count_compilations() as names:
            for seed, count in ((3, N), (2, N + 10), (5, N + 5)):
                jax.block_until_ready(f(masked(seed, count)))
    assert not names, names


def test_the_mask_may_be_traced():
    """One program for all masks, of lists that were made for all points."""
    cloud = masked(1, ALL).cloud
    lists = js.find_neighbors(js.PointCloud(cloud.points, cloud.normals), 56)
    traced = []

    @jax.jit
    def apply(active, u):
        traced.append(active)
        part = js.PointCloud(cloud.points, cloud.normals, active=active)
        return L(part, lists, method=METHOD)(u)

    for seed in (1, 2):
        c = masked(seed, N)
        found = apply(c.cloud.active, c.u)
        short = js.PointCloud(c.x, c.x)
        # The same points of each list.
        place = np.cumsum(c.cloud.host_active) - 1
        indices, mask = (
            np.asarray(lists.indices)[c.rows],
            c.cloud.host_active[lists.indices][c.rows],
        )
        own = np.arange(N)[:, None]
        same = js.Neighbors(
            jnp.asarray(np.where(mask, place[indices], own).astype(np.int32)), jnp.asarray(mask)
        )
        want = L(short, same, method=METHOD)(smooth(c.x))
        size = float(jnp.abs(want).max())
        np.testing.assert_allclose(found[c.rows], want, rtol=0, atol=EXACT * size)
        assert not np.delete(found, c.rows).any()
    assert len(traced) == 1


def test_a_hierarchy_made_in_compiled_code_has_the_identity_where_points_are_off():
    """Also of few unknowns: gradients in solutions reach rows that are off, solutions do not."""
    c = masked(1, N)
    screened = 1 - 0.1 * js.discretize(c.cloud, c.neighbors, method=METHOD).laplacian
    hierarchy = js.multigrid(screened, renewable=True, mean_zero=False)
    residual = jnp.asarray(np.random.default_rng(0).normal(size=ALL))
    want, have = hierarchy(residual), hierarchy.renewed(screened)(residual)
    size = float(jnp.abs(want).max())
    np.testing.assert_allclose(have, want, rtol=0, atol=1e-5 * size)  # in single precision


def test_gradients_of_compiled_solutions_reach_no_row_that_is_off():
    c = masked(1, N)
    surface = js.discretize(c.cloud, c.neighbors, method=METHOD)
    alone = js.PointCloud(c.x, c.x)
    part = js.discretize(alone, js.find_neighbors(alone, c.neighbors.k), method=METHOD)

    def gradient(surface, u):
        def total(points):  # of all rows alike
            screened = 1 - 0.1 * surface.moved(points).laplacian
            return jnp.sum(js.solve(screened, u, mean_zero=False, rtol=1e-11).value)

        return jax.jit(jax.grad(total))(surface.cloud.points)

    have, want = gradient(surface, c.u), gradient(part, smooth(c.x))
    size = float(jnp.abs(want).max())
    np.testing.assert_allclose(have[c.rows], want, rtol=0, atol=SOLVED * size)
    assert not np.delete(have, c.rows, axis=0).any()


@pytest.mark.slow
def test_multigrid_with_levels():
    """Of more unknowns than are solved for at once."""
    x = np.asarray(jittered_sphere(480, fraction=0.1).points)
    rows = np.sort(np.random.default_rng(0).permutation(720)[:480])

    def found(n, rows):
        points = np.full((n, 3), np.nan)
        points[rows] = x
        cloud = js.PointCloud(points, points, active=np.isin(np.arange(n), rows))
        operator = 0.1 - L(cloud, js.find_neighbors(cloud, 36), method=METHOD)
        hierarchy = js.multigrid(operator)
        assert len(hierarchy.levels) == 1
        u = np.full(n, np.nan)
        u[rows] = smooth(x)
        solution = js.solve(operator, jnp.asarray(u), preconditioner=hierarchy, rtol=1e-11)
        assert solution.stats["num_steps"] < 12
        return solution.value

    want, have = found(480, np.arange(480)), found(720, rows)
    size = float(jnp.abs(want).max())
    np.testing.assert_allclose(have[rows], want, rtol=0, atol=SOLVED * size)
    assert not np.delete(have, rows).any()
