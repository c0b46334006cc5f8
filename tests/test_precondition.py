"""The multigrid cycle as a linear map: its transpose, its factor, what it refuses."""

import sys

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxsurf as js
from jaxsurf.solve.reduced import annihilates_constants, reduced_matrix, restriction_of
from jaxsurf.stencils.padded import PaddedMatrix
from jaxsurf.stencils.stencil import prepared

from .helpers import count_compilations, random_sphere

# Minutes in all.
pytestmark = pytest.mark.slow


def _fields(n, count=2, seed=0):
    return [jnp.asarray(v) for v in np.random.default_rng(seed).normal(size=(count, n))]


@pytest.fixture(scope="module")
def screened():
    # Random points: neighbourhoods of very different sizes, unsymmetric.
    return 1 - js.laplace_beltrami(random_sphere(1_500))


def test_padded_matrix_with_uneven_rows():
    rng = np.random.default_rng(0)
    dense = rng.normal(size=(60, 40)) * (rng.random((60, 40)) < 0.1)
    dense[7] = rng.normal(size=40)  # one long row goes to the list
    dense[8] = 0
    import scipy.sparse

    matrix = PaddedMatrix.from_scipy(scipy.sparse.csr_matrix(dense), np.float64)
    assert matrix.indices.shape[0] < 40 and matrix.extra[0].size > 0
    x = rng.normal(size=40)
    np.testing.assert_allclose(matrix(jnp.asarray(x)), dense @ x, atol=1e-13)


@pytest.mark.core
def test_adjoint_by_gathers_is_the_transpose(screened):
    u, v = _fields(screened.n)
    for operator in (screened, screened @ screened, screened @ screened + screened - 2):
        np.testing.assert_allclose(jnp.vdot(v, operator(u)), jnp.vdot(operator.T(v), u), rtol=1e-12)
    # No scatter of the size of the stencil: only the diagonal, and what stuck out of the slots.
    jaxpr = str(jax.make_jaxpr(lambda v: screened.T(v))(v))
    assert jaxpr.count("scatter") - jaxpr.count("scatter_") <= 2
    # Where indices are an argument, the table comes along.
    transposed = lambda operator: jax.jit(lambda operator, v: operator.T(v))(operator, v)
    np.testing.assert_allclose(transposed(prepared(screened)), screened.T(v), rtol=1e-11)
    np.testing.assert_allclose(transposed(screened), screened.T(v), rtol=1e-11, atol=1e-11)


@pytest.mark.core
def test_cycle_is_linear_and_its_transpose_exact(screened):
    u, v = _fields(screened.n)
    cycle = js.multigrid(screened, single=False)
    assert len(cycle.levels) >= 1
    np.testing.assert_allclose(cycle(2 * u + v), 2 * cycle(u) + cycle(v), atol=1e-12)
    np.testing.assert_allclose(jnp.vdot(v, cycle(u)), jnp.vdot(cycle.transpose()(v), u), rtol=1e-12)
    single = js.multigrid(screened)
    assert single.coarsest.dtype == np.float32
    np.testing.assert_allclose(single(u), cycle(u), atol=1e-5 * float(jnp.abs(cycle(u)).max()))
    # The scale of a residual does not matter in single precision either.
    np.testing.assert_allclose(single(1e-60 * u) * 1e60, single(u), rtol=1e-5, atol=1e-9)


@pytest.mark.core
def test_one_cycle_damps_every_error():
    # Spectral radius of I - M A, by the power method.
    screened = 1 - js.laplace_beltrami(js.sphere(3_000))
    cycle = js.multigrid(screened, single=False)
    step = jax.jit(lambda e: e - cycle(screened(e)))
    (e,) = _fields(screened.n, 1)
    for _ in range(30):
        e, last = step(e), jnp.linalg.norm(e)
        ratio = float(jnp.linalg.norm(e) / last)
        e = e / jnp.linalg.norm(e)
    assert ratio < 0.4


@pytest.mark.parametrize("transform", ["jit", "vmap"])
def test_cycle_under_transformations(screened, transform):
    cycle = js.multigrid(screened)
    u, v = _fields(screened.n)
    if transform == "jit":
        together = jnp.stack([jax.jit(lambda m, u: m(u))(cycle, u), cycle(v)])
    else:
        together = jax.vmap(cycle)(jnp.stack([u, v]))
    np.testing.assert_allclose(together, jnp.stack([cycle(u), cycle(v)]), rtol=1e-4, atol=1e-7)


def test_no_square_array_in_the_cycle(screened):
    cycle = js.multigrid(screened)
    (u,) = _fields(screened.n, 1)
    n = screened.n
    text = str(jax.make_jaxpr(lambda m, u: (m(u), m.transpose()(u)))(cycle, u))
    assert f"{n},{n}" not in text


def test_very_many_neighbours():
    """No connection is strong by itself: none were found, and the coarsest matrix was singular."""
    cloud = js.sphere(700)
    lists = js.find_neighbors(cloud, k=200, throw=False)
    operator = 1 - js.laplace_beltrami(cloud, lists, method=js.GFDM(degree=2))
    solution = js.solve(operator, 3 * cloud.points[:, 2])
    assert solution.stats["num_steps"] < 15
    assert jnp.abs(solution.value - cloud.points[:, 2]).max() < 0.2


def test_jacobi_is_the_diagonal():
    cloud = js.sphere(300)
    operator = js.laplace_beltrami(cloud) - 3
    diagonal = operator.to_scipy().diagonal()
    np.testing.assert_allclose(js.jacobi(operator).divisor, diagonal, rtol=1e-12)
    bound = jnp.arange(300) < 10
    conditions = js.eliminate(cloud, js.dirichlet(bound, 0.0))
    with_conditions = js.jacobi(operator, closure=conditions).divisor
    np.testing.assert_allclose(with_conditions, jnp.where(bound, 1, diagonal), rtol=1e-12)
    with pytest.raises(ValueError, match="Composition"):
        js.jacobi(operator @ operator)


def test_constants_are_recognised():
    cloud = js.sphere(400)
    laplacian = js.laplace_beltrami(cloud)
    pinned = js.eliminate(cloud, js.dirichlet(np.array([3]), 1.0))

    def singular(operator, closure=None):
        matrix = reduced_matrix(operator, closure)
        free = restriction_of(operator, closure).on_host
        return annihilates_constants(matrix, free)

    assert singular(laplacian) and singular(-2 * laplacian)
    assert singular(laplacian @ laplacian)
    assert not singular(laplacian - 1e-6)
    assert not singular(laplacian, pinned)


def test_separate_parts_are_singular_and_named():
    one = js.sphere(300)
    apart = jnp.concatenate([one.points, one.points + 10])
    two = js.PointCloud(apart, jnp.concatenate([one.normals] * 2))
    laplacian = js.laplace_beltrami(two)
    with pytest.raises(ValueError, match=r"2 parts .* 300 points around point 0"):
        js.multigrid(laplacian)
    # A value on one of them leaves the other.
    pinned = js.eliminate(two, js.dirichlet(np.array([0]), 0.0))
    with pytest.raises(ValueError, match=r"300 points around point 300"):
        js.multigrid(laplacian, closure=pinned)


def test_bad_operators_are_refused():
    cloud = js.sphere(300)
    laplacian = js.laplace_beltrami(cloud)
    with pytest.raises(ValueError, match=r"from \(\) to \(3,\) components"):
        js.multigrid(js.surface_gradient(cloud))
    spoiled = laplacian.weights.at[2, 17].set(jnp.nan)
    broken = eqx.tree_at(lambda s: s.weights, laplacian, spoiled)  # by hand it is refused at once
    with pytest.raises(ValueError, match="not finite, first at point 17"):
        js.multigrid(broken)
    empty = js.Stencil(laplacian.indices, laplacian.weights.at[:, 5].set(0.0))
    with pytest.raises(ValueError, match="row 5 of the operator is zero"):
        js.multigrid(empty)
    with pytest.raises(ValueError, match="outside jit"):
        jax.jit(lambda operator: js.multigrid(operator).coarsest)(laplacian)
    with pytest.raises(ValueError, match="pass mean_zero=True or False"):
        jax.jit(lambda w: js.multigrid(js.Stencil(laplacian.indices, w)).coarsest)(
            laplacian.weights
        )


def test_cycles_at_the_prompt_compile_once():
    laplacian = js.laplace_beltrami(js.sphere(600))
    z, cycle = jnp.arange(600.0), js.multigrid(laplacian)
    made = js.step_preconditioner(js.AdvectionDiffusionReaction(laplacian), z)
    cycle(z), made(0.1).mv(z)
    with count_compilations() as names:
        cycle(z), made(0.1).mv(z)
    assert not names, names


def test_steps_on_another_surface_compile_nothing():
    """Where its coarsest levels have a few long rows more, too."""

    def use(factors):
        axes = jnp.array(factors)
        normals = js.sphere(2_500).points / axes
        normals = normals / jnp.linalg.norm(normals, axis=1, keepdims=True)
        cloud = js.PointCloud(axes * js.sphere(2_500).points, normals)
        problem = js.AdvectionDiffusionReaction(js.laplace_beltrami(cloud))
        u = cloud.points[:, 0]
        with count_compilations() as names:
            js.step_preconditioner(problem, u)(0.1).mv(u)
        return names

    use((1.0, 1.0, 1.0))
    names = [use(factors) for factors in ((1.1, 1.0, 0.9), (1.3, 1.0, 0.8), (1.0, 1.0, 1.05))]
    assert not any(names), names


def test_without_pyamg_the_extra_and_the_alternative_are_named(monkeypatch):
    operator = js.laplace_beltrami(js.sphere(1_000)) - 1
    for name in ("pyamg", "pyamg.aggregation", "pyamg.strength"):
        monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(ImportError, match=r"jaxsurf\[multigrid\].*js\.jacobi"):
        js.multigrid(operator)
