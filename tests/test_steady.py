"""Steady linear problems: known solutions, the mean-zero sense, gradients, failures."""

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import pytest

import jaxsurf as js
from jaxsurf.solve.system import System

from .helpers import check_derivatives, count_compilations, exponential, relative_error


@pytest.fixture(scope="module")
def sphere():
    cloud = js.sphere(1_000)
    laplacian = js.laplace_beltrami(cloud)
    return cloud, laplacian, js.multigrid(laplacian)


def _mean_free(u):
    return u - jnp.mean(u)


@pytest.mark.parametrize(
    "method, order, bound",
    [(js.DCPSE(order=2), 2, 4e-3), (js.DCPSE(order=4), 4, 5e-6), (js.GFDM(degree=3), 2, 5.2e-3)],
)
def test_poisson_on_the_closed_sphere_converges(method, order, bound):
    sizes, errors = ([2_000, 8_000] if order == 4 else [500, 2_000]), []
    for n in sizes:
        cloud = js.sphere(n)
        u, _, f = exponential(cloud.points)
        found = js.solve(js.laplace_beltrami(cloud, method=method), f, rtol=1e-10)
        errors.append(relative_error(_mean_free(found.value), _mean_free(u)))
    assert errors[1] < bound
    assert np.log(errors[0] / errors[1]) / np.log(2) > order - 0.2


def test_screened_anisotropic_and_helmholtz(sphere):
    cloud, laplacian, _ = sphere
    u, gradient, lu = exponential(cloud.points)
    found = js.solve(2 - laplacian, 2 * u - lu)
    assert relative_error(found.value, u) < 1e-2
    # div(D grad u) with D = 1 + z/2: grad D is the tangential part of (0, 0, 1/2).
    z = cloud.points[:, 2]
    f = (1 + z / 2) * lu + gradient[:, 2] / 2
    found = js.solve(js.diffusion(cloud, 1 + z / 2), f)
    assert relative_error(_mean_free(found.value), _mean_free(u)) < 2e-2
    # Indefinite: κ² = 4 lies between the eigenvalues 2 and 6.
    precondition = js.multigrid(laplacian - 4)
    found = js.solve(laplacian + 4, lu + 4 * u, preconditioner=precondition)
    assert relative_error(found.value, u) < 2e-2
    assert float(found.stats["relative_residual"]) < 1.5e-8


def test_biharmonic(sphere):
    cloud, laplacian, _ = sphere
    z = cloud.points[:, 2]
    found = js.solve(laplacian @ laplacian, 4 * z)
    assert relative_error(found.value, z) < 5e-3


def test_mean_zero_sense(sphere):
    cloud, laplacian, preconditioner = sphere
    z = cloud.points[:, 2]
    found = js.solve(laplacian, -2 * z + 3.0, preconditioner=preconditioner, project=True)
    # The incompatible part is reported, and the rest is solved for.
    assert abs(float(found.stats["incompatible"]) - 3) < 1e-8
    assert abs(float(jnp.mean(found.value))) < 1e-14
    left = laplacian(found.value) - (-2 * z + 3.0) + found.stats["incompatible"]
    assert float(jnp.linalg.norm(left)) < 1.5e-8 * float(jnp.linalg.norm(-2 * z + 3.0))
    # The sign of the operator does not matter, nor does the preconditioner.
    other = js.solve(
        -laplacian,
        2 * z - 3.0,
        preconditioner=js.jacobi(-laplacian),
        project=True,
    )
    np.testing.assert_allclose(other.value, found.value, atol=1e-6)
    assert abs(float(other.stats["incompatible"]) + 3) < 1e-6


def test_conditions_are_met_and_equations_hold_elsewhere(sphere):
    cloud, laplacian, _ = sphere
    z = cloud.points[:, 2]
    band = np.flatnonzero(np.abs(z) < 0.05)
    conditions = js.eliminate(cloud, js.dirichlet(band, z[band] + 1.0))
    found = js.solve(laplacian, -2 * z, closure=conditions, rtol=1e-10)
    assert float(jnp.abs(found.value - z - 1)[band].max()) < 1e-14
    assert float(jnp.abs(found.value - z - 1).max()) < 2e-3
    free = ~np.asarray(conditions.bound)
    left = (laplacian(found.value) + 2 * z)[free]
    assert float(jnp.linalg.norm(left)) < 1e-7 * float(jnp.linalg.norm(z))
    # Values of the right-hand side at bound points do not count.
    again = js.solve(laplacian, (-2 * z).at[band].set(1e3), closure=conditions, rtol=1e-10)
    np.testing.assert_allclose(again.value, found.value, atol=1e-9)


def test_each_right_hand_side_has_its_own_values_of_conditions(sphere):
    cloud, laplacian, _ = sphere
    f, rows = cloud.points[:, :2], np.arange(20)
    values = jnp.stack([1 + cloud.points[:20, 2], jnp.full(20, -2.0)], axis=1)
    closed = lambda v: js.eliminate(cloud, js.dirichlet(rows, v))
    together = js.solve(laplacian - 1, f, closure=closed(values))
    for i in range(2):
        one = js.solve(laplacian - 1, f[:, i], closure=closed(values[:, i]))
        np.testing.assert_allclose(together.value[:, i], one.value, atol=1e-8)
    same = js.solve(laplacian - 1, f, closure=closed(values[:, 0]))
    np.testing.assert_allclose(same.value[:, 0], together.value[:, 0], atol=1e-8)
    for rhs in (f[:, 0], jnp.zeros((cloud.n, 3))):
        with pytest.raises(ValueError, match=r"values for 2 components, the right-hand side has"):
            js.solve(laplacian - 1, rhs, closure=closed(values))


def test_several_right_hand_sides_and_transformations(sphere):
    cloud, laplacian, preconditioner = sphere
    f = jnp.stack([cloud.points[:, 2], cloud.points[:, 0] * cloud.points[:, 1]], axis=1)
    together = js.solve(laplacian, f, preconditioner=preconditioner)
    assert together.value.shape == f.shape and together.stats["num_steps"].shape == (2,)
    solve = lambda f: js.solve(laplacian, f, preconditioner=preconditioner).value
    one = solve(f[:, 1])
    np.testing.assert_allclose(together.value[:, 1], one, atol=1e-8)
    np.testing.assert_allclose(jax.jit(solve)(f[:, 1]), one, atol=1e-12)
    np.testing.assert_allclose(jax.vmap(solve, 1, 1)(f), together.value, atol=1e-12)


def test_no_retracing_for_other_values(sphere):
    cloud, laplacian, preconditioner = sphere
    traces = 0

    @jax.jit
    def solve(weights, f):
        nonlocal traces
        traces += 1
        operator = eqx.tree_at(lambda o: o.weights, laplacian, weights)
        return js.solve(operator, f, preconditioner=preconditioner).value

    solve(laplacian.weights, cloud.points[:, 0])
    solve(2 * laplacian.weights, cloud.points[:, 1])
    assert traces == 1


def test_derivatives_in_weights_and_right_hand_side(sphere):
    cloud, laplacian, preconditioner = sphere
    z = cloud.points[:, 2]
    _, _, f = exponential(cloud.points)
    weight = jnp.sin(3 * z)

    def total(f, scale):
        # Row sums stay zero along w -> w s_i, as they do for a moving geometry.
        operator = eqx.tree_at(lambda o: o.weights, laplacian, laplacian.weights * scale)
        # Scaled rows ask for another mean of f.
        found = js.solve(operator, f, preconditioner=preconditioner, rtol=1e-13, project=True)
        return jnp.sum(weight * found.value**2)

    check_derivatives(total, f, 1 + 0.3 * z, step=1e-3)


def test_derivative_in_the_geometry():
    cloud = js.sphere(800)
    neighbors, method = js.find_neighbors(cloud, k=24), js.DCPSE(order=2)
    normals = cloud.normals
    preconditioner = js.jacobi(js.laplace_beltrami(cloud, neighbors, method=method))

    def total(points):
        moved = js.PointCloud(points, normals)
        operator = js.laplace_beltrami(moved, neighbors, method=method)
        f = points[:, 0] * points[:, 1] + points[:, 2]
        given = dict(preconditioner=preconditioner, mean_zero=True, rtol=1e-12)
        found = js.solve(operator, f, **given)
        return jnp.sum(found.value**2)

    check_derivatives(total, cloud.points, step=1e-4)


def test_derivatives_with_conditions_and_jacobi(sphere):
    cloud, laplacian, _ = sphere
    z = cloud.points[:, 2]
    cap = np.flatnonzero(z > 0.7)
    operator = 1 - laplacian

    def total(values, f, weights):
        conditions = js.eliminate(cloud, js.dirichlet(cap, values))
        moved = eqx.tree_at(lambda o: o.weights, operator, weights)
        found = js.solve(
            moved, f, closure=conditions, mean_zero=False, rtol=1e-13,
            preconditioner=js.jacobi(moved, closure=conditions),
        )  # fmt: skip
        return jnp.sum(found.value**3)

    check_derivatives(total, z[cap] + 1, 3 * z, operator.weights, step=1e-2)


def test_the_transposed_system_with_flux_conditions():
    # A patch of the sphere with no-flux borders: bound values depend on free ones.
    cloud = js.sphere(1_200)
    keep = np.flatnonzero(cloud.points[:, 2] > 0.2)
    points = cloud.points[keep]
    border = points[:, 2] < 0.28
    patch = js.PointCloud(points, points)
    down = jnp.array([0.0, 0.0, -1.0])
    conormals = down - points[border] * (points[border] @ down)[:, None]
    conormals = conormals / jnp.linalg.norm(conormals, axis=1, keepdims=True)
    conditions = js.eliminate(patch, js.neumann(border, 0.0, conormals=conormals))
    laplacian = js.laplace_beltrami(patch, throw=False)
    preconditioner = js.multigrid(laplacian, closure=conditions)
    assert preconditioner.mean_zero
    system = System.of(laplacian, conditions, jnp.float64, True)
    u, v = jnp.asarray(np.random.default_rng(0).normal(size=(2, patch.n)))
    one, other = jnp.vdot(v, system.matrix @ u), jnp.vdot(system.matrix.T @ v, u)
    np.testing.assert_allclose(one, other, rtol=1e-11)
    inverse = system.inverse(js.multigrid(laplacian, closure=conditions, single=False))
    one, other = jnp.vdot(v, inverse @ u), jnp.vdot(inverse.T @ v, u)
    np.testing.assert_allclose(one, other, rtol=1e-11)

    found = js.solve(
        laplacian, points[:, 0], closure=conditions, preconditioner=preconditioner, project=True
    )
    assert abs(float(jnp.mean(found.value))) < 1e-13
    total = lambda f: jnp.sum(
        js.solve(
            laplacian,
            f,
            closure=conditions,
            preconditioner=preconditioner,
            rtol=1e-12,
            project=True,
        ).value
        ** 2
    )
    check_derivatives(total, points[:, 0] + points[:, 1] ** 2, step=1e-2)


def test_no_square_array(sphere):
    cloud, laplacian, preconditioner = sphere
    n = cloud.n

    def total(weights, f):
        operator = eqx.tree_at(lambda o: o.weights, laplacian, weights)
        return jnp.sum(js.solve(operator, f, preconditioner=preconditioner).value ** 2)

    jaxpr = jax.make_jaxpr(jax.grad(total, argnums=(0, 1)))(laplacian.weights, cloud.points[:, 0])
    assert f"{n},{n}" not in str(jaxpr)


@pytest.mark.parametrize("n", [1_500, 6_000])
def test_steps_hardly_grow(n):
    cloud = js.sphere(n)
    neighbors = js.find_neighbors(cloud, k=20, throw=False)
    laplacian = js.laplace_beltrami(cloud, neighbors, method=js.GFDM(degree=2))
    found = js.solve(laplacian, exponential(cloud.points)[2])
    assert int(found.stats["num_steps"]) <= 8
    assert float(found.stats["relative_residual"]) < 1.5e-8


def test_a_solver_of_lineax(sphere):
    cloud, laplacian, preconditioner = sphere
    z = cloud.points[:, 2]
    gmres = lx.GMRES(rtol=1e-10, atol=1e-10, norm=lx.internal.two_norm)
    found = js.solve(laplacian, -2 * z, preconditioner=preconditioner, solver=gmres)
    assert relative_error(found.value, z) < 2e-3
    # It says that it is done; the residual says otherwise.
    loose = lx.BiCGStab(rtol=1e-1, atol=1e-1)
    with pytest.raises(RuntimeError, match="relative residual"):
        js.solve(laplacian, -2 * z, preconditioner=preconditioner, solver=loose)


def test_failures_speak(sphere):
    cloud, laplacian, preconditioner = sphere
    z = cloud.points[:, 2]
    with pytest.raises(RuntimeError, match=r"relative residual .* after 1 steps, wanted rtol"):
        js.solve(laplacian, z, max_steps=1)
    kept = js.solve(laplacian, z, max_steps=1, throw=False)
    assert kept.result == lx.RESULTS.max_steps_reached
    assert 1e-8 < float(kept.stats["relative_residual"]) < 1
    with pytest.raises(RuntimeError, match="for right-hand side 1"):
        js.solve(laplacian, jnp.stack([0 * z, z], axis=1), max_steps=1)
    # A tolerance below round-off.
    with pytest.raises(RuntimeError, match="below round-off"):
        js.solve(laplacian, z, rtol=1e-18)
    # Under jit the same is an error of the compiled program.
    with pytest.raises(Exception, match=r"did not reach its tolerance"):
        solve = eqx.filter_jit(
            lambda f: js.solve(laplacian, f, preconditioner=preconditioner, max_steps=1).value
        )
        solve(z).block_until_ready()


def test_a_singular_system_is_an_error(sphere):
    cloud, laplacian, _ = sphere
    # One equation twice, in place of another: no null vector that could be known beforehand.
    weights = laplacian.weights.at[:, 1].set(0.0).at[0, 1].set(1.0).at[0, 0].add(1.0)
    indices = laplacian.indices.at[:, 1].set(laplacian.indices[:, 0])
    weights = weights.at[:, 1].set(weights[:, 0])
    singular = js.Stencil(indices, weights)
    f = cloud.points[:, 2] + 1.0
    with pytest.raises(RuntimeError, match="may be singular"):
        js.solve(singular, f, preconditioner=js.jacobi(laplacian), max_steps=200)


def test_bad_input(sphere):
    cloud, laplacian, preconditioner = sphere
    z = cloud.points[:, 2]
    with pytest.raises(ValueError, match="right-hand side is not finite at point 9"):
        js.solve(laplacian, z.at[9].set(jnp.nan))
    with pytest.raises(ValueError, match=r"shape \(3,\), expected \(1000,\) or \(1000, c\)"):
        js.solve(laplacian, jnp.zeros(3))
    with pytest.raises(ValueError, match=r"components"):
        js.solve(js.surface_gradient(cloud), z)
    with pytest.raises(ValueError, match="outside jit"):
        jax.jit(lambda operator: js.solve(operator, z).value)(laplacian)
    with pytest.raises(ValueError, match="mean_zero=True or False"):
        jax.jit(
            lambda w: (
                js.solve(
                    js.Stencil(laplacian.indices, w), z, preconditioner=js.jacobi(laplacian)
                ).value
            )
        )(laplacian.weights)
    solve = lambda f: js.solve(laplacian, f, preconditioner=preconditioner, throw=False)
    assert jax.jit(lambda f: solve(f).result)(z.at[9].set(jnp.nan)) == lx.RESULTS.nonfinite_input


def test_no_preconditioner_need_be_made_for_gradients(sphere):
    """Under grad, and twice, as with one made outside; so for reactions."""
    cloud, laplacian, preconditioner = sphere
    z = cloud.points[:, 2]

    def total(s, **given):
        found = js.solve(s * laplacian, laplacian(z), rtol=1e-12, **given).value
        return jnp.sum(found * z)

    for derivative in (jax.grad(total), jax.grad(jax.grad(total))):
        plain, given = derivative(2.0), derivative(2.0, preconditioner=preconditioner)
        np.testing.assert_allclose(plain, given, rtol=1e-9)

    def settled(a):
        reaction = lambda u, a: u + a * u**3
        found = js.solve_nonlinear(-laplacian, reaction, 0 * z, args=a, rhs=3 * z, rtol=1e-11)
        return jnp.sum(found.value * z)

    difference = (settled(1.0 + 1e-4) - settled(1.0 - 1e-4)) / 2e-4
    np.testing.assert_allclose(jax.grad(settled)(1.0), difference, rtol=1e-6)


def test_a_preconditioner_of_other_neighbours_does_not_spoil_the_gradient(sphere):
    cloud, laplacian, _ = sphere
    z = cloud.points[:, 2]
    k = laplacian.k
    shuffled = js.Stencil(
        jnp.concatenate([laplacian.indices[:1], laplacian.indices[:0:-1]]),
        jnp.concatenate([laplacian.weights[:1], laplacian.weights[:0:-1]]),
    )
    assert shuffled.k == k
    preconditioner = js.multigrid(shuffled)
    total = lambda f: jnp.sum(js.solve(laplacian, f, preconditioner=preconditioner).value ** 2)
    exact = lambda f: jnp.sum(js.solve(laplacian, f).value ** 2)
    f = z + z**2 - 1 / 3
    expected = jax.grad(
        lambda f: jnp.sum(js.solve(laplacian, f, preconditioner=js.multigrid(laplacian)).value ** 2)
    )(f)
    assert abs(float(total(f) - exact(f))) < 1e-6 * float(exact(f))
    np.testing.assert_allclose(jax.grad(total)(f), expected, atol=1e-6)


def test_single_precision():
    cloud = js.sphere(1_000)
    single = js.PointCloud(cloud.points.astype(jnp.float32), cloud.normals.astype(jnp.float32))
    operator = 1 - js.laplace_beltrami(single)
    z = single.points[:, 2]
    found = js.solve(operator, 3 * z, rtol=1e-4)
    assert found.value.dtype == jnp.float32
    assert float(jnp.abs(found.value - z).max()) < 5e-3


def test_what_is_incompatible_is_an_error(sphere):
    """On a closed surface the mean of f has to vanish, as far as the points resolve f."""
    cloud, laplacian, preconditioner = sphere
    z = cloud.points[:, 2]
    solve = lambda f, **options: js.solve(laplacian, f, preconditioner=preconditioner, **options)
    for f in (-2 * z + 0.05, jnp.ones(cloud.n), z**2, exponential(cloud.points)[0]):
        with pytest.raises(ValueError, match=r"mean is .* explains .* at most.*project=True"):
            solve(f)
        kept = solve(f, throw=False)
        assert kept.result == lx.RESULTS.singular
        assert abs(kept.stats["incompatible"]) > 2 * kept.stats["compatible_within"]
        assert solve(f, project=True).result == lx.RESULTS.successful
    # Compatible ones are far from the bound, whatever the scale.
    for f in (-2 * z, exponential(cloud.points)[2], -30 * z * (5 * z**2 - 3)):
        stats = solve(f).stats
        assert abs(stats["incompatible"]) < 0.2 * stats["compatible_within"]


def test_numbers_of_any_size(sphere):
    cloud, laplacian, preconditioner = sphere
    f = -2 * cloud.points[:, 2]
    one = js.solve(laplacian, f, preconditioner=preconditioner)
    for size in (1e-300, 1e300):
        found = js.solve(laplacian, size * f, preconditioner=preconditioner)
        np.testing.assert_allclose(found.value / size, one.value, atol=1e-9)
        assert int(found.stats["num_steps"]) == int(one.stats["num_steps"])
    assert (
        float(jnp.abs(js.solve(laplacian, 0 * f, preconditioner=preconditioner).value).max()) == 0
    )


def test_other_operators_and_tolerances_compile_nothing(sphere):
    cloud, laplacian, _ = sphere
    f = -2 * cloud.points[:, 2]
    js.solve(laplacian, f)
    other = js.ellipsoid(cloud.n, (1.0, 0.8, 0.6))
    neighbors = js.find_neighbors(other, laplacian.k)
    moved = js.laplace_beltrami(other, neighbors)
    with count_compilations() as names:
        js.solve(moved, f, project=True)
        js.solve(laplacian, f, rtol=1e-6)
        js.solve(laplacian, 2 * f, atol=1e-3, max_steps=50)
        js.solve(3 * laplacian, f, solver=js.BiCGStab(1e-9))
    assert not [name for name in names if "solve" in name], names


def test_default_tolerance_in_single_precision():
    """JAX's default: the plain problem is solved, and what cannot be names the cure."""
    cloud = js.sphere(1_000)
    double = js.solve(js.laplace_beltrami(cloud, method=js.GFDM(degree=2)), -2 * cloud.points[:, 2])
    single = js.PointCloud(cloud.points.astype(jnp.float32), cloud.normals.astype(jnp.float32))
    with jax.enable_x64(False):
        laplacian = js.laplace_beltrami(single, method=js.GFDM(degree=2))
        z = single.points[:, 2]
        found = js.solve(laplacian, -2 * z)
        assert found.value.dtype == jnp.float32
        assert np.abs(np.asarray(found.value) - np.asarray(double.value)).max() < 1e-3
        with pytest.raises(RuntimeError, match=r"below round-off.*float32.*jax_enable_x64"):
            js.solve(laplacian, -2 * z, rtol=1e-9)
