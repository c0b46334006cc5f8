"""Operators in every form: at the prompt, in single precision, mapped, on curves, made by users."""

import functools
import re
import tempfile
from pathlib import Path

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import optimistix as optx
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import jaxsurf as js
from jaxsurf.compiling import sized_jit

from .helpers import (
    check_derivatives,
    count_compilations,
    exponential,
    jittered_sphere,
    random_sphere,
    relative_error,
)

pytestmark = pytest.mark.slow

N, METHOD = 200, js.GFDM(degree=2)
CLOUD = jittered_sphere(N)
LISTS = js.find_neighbors(CLOUD, k=24)
ARGS = {"neighbors": LISTS, "method": METHOD}
U, GRADIENT, LAPLACIAN = exponential(CLOUD.points, (0.5, 1.0, 0.7))
TENSOR = jnp.eye(3) * (2 + U)[:, None, None]

OPERATORS = {
    "laplace_beltrami": js.laplace_beltrami,
    "surface_gradient": js.surface_gradient,
    "surface_divergence": js.surface_divergence,
    "biharmonic": js.biharmonic,
    "diffusion": lambda c, **a: js.diffusion(c, (1 + c.points[:, 2] ** 2), **a),
    "tensor": lambda c, **a: js.diffusion(c, c.points[:, :, None] * c.points[:, None], **a),
    "directional_derivative": lambda c, **a: js.directional_derivative(c, c.points[:, ::-1], **a),
}  # fmt: skip
CURVATURES = {
    "shape_tensor": js.shape_tensor,
    "mean_curvature": js.mean_curvature,
    "gauss_curvature": js.gauss_curvature,
    "principal_curvatures": lambda c, **a: js.principal_curvatures(c, **a)[0],
    "mean_curvature_vector": js.mean_curvature_vector,
    "tube_ratio": lambda c, neighbors, **_: js.tube_ratio(c, neighbors),
}


def values(name, cloud, lists=LISTS, method=METHOD):
    """What an operator makes of a field of the cloud, or a curvature."""
    args = {"neighbors": lists, "method": method}
    if name in CURVATURES:
        return CURVATURES[name](cloud, **args)
    operator = OPERATORS[name](cloud, **args)
    u = jnp.sin(cloud.points @ jnp.asarray([1.0, 2.0, 1.5], cloud.points.dtype))
    return operator(jnp.stack([u, u**2, jnp.cos(u)], axis=1) if operator.in_shape else u)


def squeezed(points):
    """Points of an ellipsoid and normals, both functions of the points of the sphere."""
    axes = jnp.asarray([1.0, 1.2, 1.5], points.dtype)
    normals = points / axes
    return js.PointCloud(points * axes, normals / jnp.linalg.norm(normals, axis=1, keepdims=True))


each = pytest.mark.parametrize("name", [*OPERATORS, *CURVATURES])


@each
def test_mapped(name):
    """Under vmap as in a loop."""
    scales = jnp.array([1.0, 1.3])

    def f(scale):
        cloud = squeezed(CLOUD.points)
        return values(name, js.PointCloud(scale * cloud.points, cloud.normals))

    expected = jnp.stack([f(s) for s in scales])
    size = jnp.abs(expected).max()
    # What is compiled within is shared by all of these tests; under jit of its own, nothing is.
    np.testing.assert_allclose(jax.vmap(f)(scales), expected, atol=1e-10 * size)


@pytest.mark.core
def test_under_jit():
    """All in one program."""

    def everything(points):
        return {name: values(name, squeezed(points)) for name in (*OPERATORS, *CURVATURES)}

    plain, found = everything(CLOUD.points), jax.jit(everything)(CLOUD.points)
    for name, expected in plain.items():
        size = float(jnp.abs(expected).max())
        np.testing.assert_allclose(found[name], expected, atol=1e-10 * size, err_msg=name)


# Largest errors in single precision, as shares of the largest value: 1e-7 amplified by 1 / h for
# every derivative, h = 0.25, and by the cancellation in a row.
SINGLE = {"biharmonic": 2e-3}


@each
def test_single_precision(name):
    """Without x64, JAX's default: nothing leaves float32."""
    exact = values(name, squeezed(CLOUD.points))
    with jax.enable_x64(False):
        cloud = squeezed(jnp.asarray(np.asarray(CLOUD.points), jnp.float32))
        lists = jax.tree.map(lambda a: jnp.asarray(np.asarray(a)), LISTS)
        found = values(name, cloud, lists)
        assert found.dtype == jnp.float32
        error = (
            np.abs(np.asarray(found) - np.asarray(exact)).max() / np.abs(np.asarray(exact)).max()
        )
    assert error < SINGLE.get(name, 2e-4), error


BORDERED = js.graph(lambda x, y: 0.3 * x * y, (14, 14))
BORDER, NEAR = js.find_border(BORDERED), js.find_neighbors(BORDERED, k=24)
SOURCE = np.array([7])


def refitted(points, lists, _):
    return js.refit_normals(points, squeezed(points).normals, lists, degree=2, iterations=3)


def solved(points, lists, _):
    """In the points of the operator and of its right-hand side."""
    screened = 1 - js.laplace_beltrami(squeezed(points), lists, method=METHOD)
    preconditioner = js.jacobi(screened)
    return js.solve(screened, points[:, 2], preconditioner=preconditioner, mean_zero=False).value


def closed(points, _, near):
    """In the points of a border and of those near it, through fluxes along conormals."""
    bent = jnp.stack([points[:, 0], points[:, 1], 0.3 * points[:, 0] * points[:, 1]], axis=1)
    normals = jnp.stack([-0.3 * points[:, 1], -0.3 * points[:, 0], 1 + 0 * points[:, 0]], axis=1)
    normals = normals / jnp.linalg.norm(normals, axis=1, keepdims=True)
    cloud = js.PointCloud(bent, normals, boundary=BORDERED.boundary)
    # Of the degree that is usual in either precision.
    options = dict(neighbors=near, border=BORDER, method=js.GFDM(degree=2))
    closure = js.eliminate(cloud, js.neumann(BORDERED.boundary), **options)
    return closure(jnp.sin(bent @ jnp.asarray([1.0, 2.0, 1.5], points.dtype)))


def distances(points, lists, _):
    return js.geodesic_distance(squeezed(points), SOURCE, neighbors=lists, method=METHOD)


def integral(points, lists, _):
    surface = js.discretize(squeezed(points), lists, method=METHOD)
    return surface.integrate(points[:, 2] ** 2)


def in_time(points, lists, _):
    laplacian = js.laplace_beltrami(squeezed(points), lists, method=METHOD)
    problem = js.AdvectionDiffusionReaction(laplacian)
    return js.integrate(problem, points[:, 2], t1=0.1, solver=js.RKC2(), dt0=0.05).ys[-1]


def modes(points, lists, _):
    return js.eigenmodes(js.laplace_beltrami(squeezed(points), lists, method=METHOD), 4).values


OTHERS = {f.__name__: f for f in (refitted, solved, closed, distances, integral, in_time, modes)}
# Largest errors of gradients, relative to the gradient in double precision.
SINGLE_GRADIENTS = {"laplace_beltrami": 1e-3}


@pytest.mark.parametrize(
    "cloud, method",
    [(CLOUD, METHOD), (js.circle(40), js.DCPSE(order=2))],
    ids=["GFDM", "DCPSE"],
)
def test_reverse_over_reverse_is_forward_over_reverse(cloud, method):
    """It ended in an error of JAX: reverse mode forgets rules of derivatives in what it keeps."""
    surface = js.discretize(cloud, method=method)
    along, u = jnp.cos(3 * cloud.points), cloud.points[:, 0] ** 2

    def objective(x):
        there = surface.moved(x)
        return jnp.mean(there.laplacian(u) ** 2) + there.integrate(u * there.mean_curvature)

    slope = jax.grad(objective)
    twice = jax.jit(jax.grad(lambda x: jnp.vdot(slope(x), along)))(cloud.points)
    expected = jax.jit(lambda x: jax.jvp(slope, (x,), (along,))[1])(cloud.points)
    np.testing.assert_allclose(twice, expected, atol=1e-11 * float(jnp.abs(expected).max()))


@pytest.mark.parametrize("name", [*OPERATORS, *CURVATURES, *OTHERS])
def test_gradients_in_single_precision(name):
    """In the points (and normals that follow them), to 1e-2 of the gradient in 64 bits."""
    points = BORDERED.points if name == "closed" else CLOUD.points

    def total(points, lists, near):
        if name in OTHERS:
            found = OTHERS[name](points, lists, near)
        else:
            found = values(name, squeezed(points), lists)
        return jnp.vdot(jnp.cos(jnp.arange(found.size)).astype(found.dtype), found.ravel())

    exact = jax.grad(total)(points, LISTS, NEAR)
    with jax.enable_x64(False):
        lists, near = jax.tree.map(lambda a: jnp.asarray(np.asarray(a)), (LISTS, NEAR))
        found = jax.grad(total)(jnp.asarray(np.asarray(points), jnp.float32), lists, near)
        assert found.dtype == jnp.float32
    assert jnp.linalg.norm(exact) > 1e-2  # there is something to differentiate
    error = relative_error(np.asarray(found, float), exact)
    assert error < SINGLE_GRADIENTS.get(name, 1e-2), error


def test_precision_may_be_switched():
    """Stencils of small and of large systems in 64 bits, in 32 after that, and in 64 again."""
    for method in (js.GFDM(degree=2), js.DCPSE(order=2)):
        lists = js.find_neighbors(CLOUD, k=36)

        def laplacian(points, lists, method=method):
            return values("laplace_beltrami", squeezed(points), lists, method)

        exact = laplacian(CLOUD.points, lists)
        with jax.enable_x64(False):
            narrow = jax.tree.map(lambda a: jnp.asarray(np.asarray(a)), lists)
            found = laplacian(jnp.asarray(np.asarray(CLOUD.points), jnp.float32), narrow)
            assert found.dtype == jnp.float32
        assert relative_error(np.asarray(found, float), exact) < 1e-3, method
        again = laplacian(jnp.array(CLOUD.points), lists)
        assert relative_error(again, exact) < 1e-12, method


@pytest.mark.core
def test_the_second_call_compiles_nothing():
    """At the prompt: fields, batches, derivatives, transposes; another operator of these sizes."""
    other = js.find_neighbors(jittered_sphere(N, seed=5), k=24)
    found = [
        (js.laplace_beltrami(c, n, method=METHOD), js.surface_gradient(c, n, method=METHOD))
        for c, n in ((CLOUD, LISTS), (jittered_sphere(N, seed=5), other))
    ]

    def use(laplacian, gradient):
        vectors = gradient(U)
        laplacian(U), laplacian(vectors), (laplacian @ laplacian)(U)
        laplacian.T(U), gradient.T(vectors)
        laplacian.diagonal, 2 * laplacian, laplacian - 1
        jax.jvp(laplacian, (U,), (U,)), jax.vjp(gradient, U)[1](vectors)
        jax.grad(lambda u: jnp.sum(laplacian(u) ** 2))(U)

    use(*found[0])
    with count_compilations() as names:
        use(*found[0])
        use(*found[1])
    assert not names, names


@pytest.mark.core
def test_another_geometry_compiles_nothing():
    """Nor another coefficient, radius, or number of points whose neighbourhoods are adapted."""

    def use(seed):
        cloud = random_sphere(N, seed)
        lists = js.choose_neighbors(cloud, method=METHOD)
        fixed = js.find_neighbors(cloud, k=24)
        for name in (*OPERATORS, *CURVATURES):
            values(name, cloud, fixed)
        radius = 0.5 + 0.01 * seed
        js.search_neighbors(cloud.points, radius=radius, capacity=js.SearchCapacity(60, 150))
        usual = js.find_neighbors(cloud, k=36)
        return lists.k, int(np.sum(np.any(lists.indices != usual.indices, axis=1)))

    first = use(1)
    with count_compilations() as names:
        second = use(2)
    assert first[1] != second[1]  # so many were adapted
    # Lists of another width are copied to the device by a program that does nothing else.
    assert not set(names) - {"jit(stage)"}, names


def test_another_number_of_points_shares_the_long_program():
    """What gathers for it, and sorts its results, is done by NumPy."""
    clouds = [jittered_sphere(n) for n in (N - 17, N - 18)]
    lists = [js.find_neighbors(cloud, k=24) for cloud in clouds]
    js.laplace_beltrami(clouds[0], lists[0], method=METHOD)
    with count_compilations() as names:
        js.laplace_beltrami(clouds[1], lists[1], method=METHOD)
    assert len(names) < 8 and not {"jit(_weights_of_blocks)", "jit(blocks_of)"} & set(names), names


def test_small_programs_are_the_same_in_every_form():
    """What is compiled with fewer optimisations at the prompt, against jit, grad and vmap."""
    program = sized_jit(lambda x, power, parts: x**power + parts["a"])
    x, parts = jnp.linspace(0.1, 1, 7), {"a": jnp.ones(7), "b": None}
    expected = np.asarray(x) ** 3 + 1
    np.testing.assert_allclose(program(x, 3, parts), expected, rtol=1e-14)
    np.testing.assert_allclose(jax.jit(lambda: program(x, 3, parts))(), expected, rtol=1e-14)
    slope = jax.grad(lambda x: jnp.sum(program(x, 3, parts)))(x)
    np.testing.assert_allclose(slope, 3 * np.asarray(x) ** 2, rtol=1e-14)
    mapped = jax.vmap(lambda x: program(x, 3, {"a": 1.0}))(x)
    np.testing.assert_allclose(mapped, expected, rtol=1e-14)


@pytest.mark.core
@pytest.mark.parametrize(
    "method", [make(degree=p) for make in (js.GFDM, js.RBFFD) for p in range(2, 7)], ids=str
)
def test_every_polynomial_of_the_basis_is_exact(method):
    """On a plane, all monomials up to the degree: Laplacian and gradient."""
    degree = method.degree
    a = np.stack(np.meshgrid(*[np.linspace(-1, 1, 14)] * 2), axis=-1).reshape(-1, 2)
    a = a + np.random.default_rng(degree).uniform(-0.03, 0.03, a.shape)
    up = np.tile([0.0, 0.0, 1.0], (len(a), 1))
    cloud = js.PointCloud(np.c_[a, 0 * a[:, 0]], up)
    lists = js.find_neighbors(cloud, k=method.neighbor_count(3))
    laplacian = js.laplace_beltrami(cloud, lists, method=method)
    check_monomials(laplacian, a, degree, second=True)


@pytest.mark.parametrize("order", range(1, 6))
def test_every_polynomial_of_the_surface_basis_is_exact(order):
    """DC-PSE on a plane: the Laplacian of all monomials of the tangents up to degree order + 1."""
    method = js.DCPSE(order=order)
    a = np.stack(np.meshgrid(*[np.linspace(-1, 1, 12)] * 2), axis=-1).reshape(-1, 2)
    a = a + np.random.default_rng(order).uniform(-0.03, 0.03, a.shape)
    up = np.tile([0.0, 0.0, 1.0], (len(a), 1))
    cloud = js.PointCloud(np.c_[a, 0 * a[:, 0]], up)
    lists = js.find_neighbors(cloud, k=method.neighbor_count(3))
    check_monomials(js.laplace_beltrami(cloud, lists, method=method), a, order + 1, second=True)


@pytest.mark.parametrize(
    "method, degree", [(js.DCPSE(order=6), 7), (js.GFDM(degree=7), 7), (js.GFDM(degree=8), 8)]
)
def test_every_polynomial_of_high_degree_is_exact_inside(method, degree):
    """Where points lie all around: one-sided stencils of these degrees are refused at corners."""
    a = np.stack(np.meshgrid(*[np.linspace(-1, 1, 14)] * 2), axis=-1).reshape(-1, 2)
    a = a + np.random.default_rng(degree).uniform(-0.03, 0.03, a.shape)
    up = np.tile([0.0, 0.0, 1.0], (len(a), 1))
    cloud = js.PointCloud(np.c_[a, 0 * a[:, 0]], up)
    lists = js.find_neighbors(cloud, k=100)
    inside = np.abs(a).max(axis=1) < 0.35
    operator = js.laplace_beltrami(cloud, lists, method=method, throw=False)
    assert operator.diagnostics.residual[inside].max() < 1e-8  # the bound of what is refused
    check_monomials(operator, a, degree, second=True, at=inside)


def check_monomials(operator, a, degree, *, second, at=slice(None)):
    x, y = a.T
    size = np.abs(np.asarray(operator.weights)).sum(axis=0)[at].max()
    for p in range(degree + 1):
        for q in range(degree + 1 - p):
            exact = p * (p - 1) * x ** max(p - 2, 0) * y**q + q * (q - 1) * x**p * y ** max(
                q - 2, 0
            )
            error = np.abs(np.asarray(operator(x**p * y**q)) - exact)[at].max()
            assert error < 1e-10 * size, (p, q, error, size)


def test_gradients_of_diffusion_in_each_argument():
    """Scalar and tensor diffusivity, points, normals and field."""
    points = CLOUD.points * jnp.array([1.0, 1.2, 1.5])

    def total(points, normals, d, scale, u):
        cloud = js.PointCloud(points, normals)
        tensor = TENSOR * scale[:, None, None]
        parts = [js.diffusion(cloud, coefficient, **ARGS)(u) for coefficient in (d, tensor)]
        return sum(jnp.sum(jnp.cos(jnp.arange(N)) * part) for part in parts) / 100

    check_derivatives(
        total, points, CLOUD.normals, 1.5 + U, 1 + 0 * U, U, step=1e-4, compiled=False
    )


def test_gradients_on_plane_curves():
    """Operators and curvature of a curve, in its points (normals follow) and in the field."""
    angle = jnp.linspace(0, 2 * jnp.pi, 60, endpoint=False) + 0.02 * jnp.sin(7 * jnp.arange(60.0))
    circle = jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=1)
    args = {"neighbors": js.find_neighbors(circle, k=9), "method": METHOD}

    def total(points, u):
        normals = points / jnp.array([1.0, 1.5]) ** 2
        cloud = js.PointCloud(points, normals / jnp.linalg.norm(normals, axis=1, keepdims=True))
        gradient = js.surface_gradient(cloud, **args)(u)
        parts = [
            js.laplace_beltrami(cloud, **args)(u),
            js.surface_divergence(cloud, **args)(gradient),
            js.diffusion(cloud, 2 + u, **args)(u),
            js.directional_derivative(cloud, points, **args)(u),
            js.mean_curvature(cloud, **args),
        ]
        return sum(jnp.sum(jnp.cos(jnp.arange(60)) * part) for part in parts) / 100

    check_derivatives(
        total, circle * jnp.array([1.0, 1.5]), jnp.sin(3 * angle), step=1e-4, compiled=False
    )


class NearestPair(js.AbstractMethod):
    """A user's own method: inverse squared distances, of no great accuracy."""

    scale: float = eqx.field(static=True, default=4.0)

    def neighbor_count(self, dim):
        return 7

    def basis_size(self, dim, target):
        return 3

    @property
    def batch_size(self):
        return 64

    def weights(self, neighborhood, target):
        r2 = neighborhood.squared
        on = neighborhood.mask & (r2 > 0)
        w = jnp.where(on, self.scale / jnp.where(on, r2, 1), 0) / jnp.sum(on, axis=0)
        w = w.at[0].set(-jnp.sum(w[1:], axis=0))
        zero = jnp.zeros(r2.shape[1:], r2.dtype)
        support = jnp.sqrt(jnp.max(r2, axis=0))
        return w, js.Diagnostics.of(neighborhood, zero + 1, zero, support, 0)


def test_a_users_own_method():
    operator = js.laplace_beltrami(CLOUD, method=NearestPair())
    assert jnp.abs(operator(jnp.ones(N))).max() < 1e-10
    z = CLOUD.points[:, 2]
    mask = js.find_neighbors(CLOUD, k=7)
    others = np.asarray(mask.indices)[:, 1:]
    r2 = np.sum((np.asarray(CLOUD.points)[others] - np.asarray(CLOUD.points)[:, None]) ** 2, axis=2)
    by_hand = np.mean(4 * (np.asarray(z)[others] - np.asarray(z)[:, None]) / r2, axis=1)
    np.testing.assert_allclose(operator(z), by_hand, rtol=1e-9, atol=1e-9)
    slope = jax.grad(
        lambda s: js.laplace_beltrami(
            js.PointCloud(s * CLOUD.points, CLOUD.normals), mask, method=NearestPair()
        )(z)[0]
    )(1.0)
    np.testing.assert_allclose(slope, -2 * operator(z)[0], rtol=1e-9)


def test_a_users_own_method_in_other_forms():
    """Under vmap, where weights go with the inverse square of the size; in float32 to 1e-5."""
    lists, z = js.find_neighbors(CLOUD, k=7), CLOUD.points[:, 2]

    def applied(size, cloud=CLOUD, lists=lists, z=z):
        scaled = js.PointCloud(size * cloud.points, cloud.normals)
        operator = js.laplace_beltrami(scaled, lists, method=NearestPair())
        return operator(z), operator.diagnostics

    (found, told), (plain, diagnostics) = jax.vmap(applied)(jnp.array([1.0, 2.0])), applied(1.0)
    np.testing.assert_allclose(found, jnp.stack([plain, plain / 4]), atol=1e-10)
    check_diagnostics(told, diagnostics)
    # The farthest, whose distance is the support, is within it, whatever rounding does.
    assert (np.asarray(diagnostics.count) == 7).all()
    with jax.enable_x64(False):
        same = lambda tree: jax.tree.map(lambda a: jnp.asarray(np.asarray(a)), tree)
        found = applied(1.0, same(CLOUD), same(lists), same(z))[0]
        assert found.dtype == jnp.float32
    np.testing.assert_allclose(found, plain, atol=1e-5 * float(jnp.abs(plain).max()))


def check_diagnostics(found, plain):
    """Those of a cloud and of it twice as large: lengths are doubled, all else is the same."""
    for name in ("condition", "count", "layers", "tube"):
        one = np.asarray(getattr(plain, name))
        np.testing.assert_allclose(getattr(found, name), np.stack([one, one]), rtol=1e-9)
    support = np.asarray(plain.support)
    np.testing.assert_allclose(found.support, np.stack([support, 2 * support]), rtol=1e-12)
    assert found.residual.max() < 1e-10


def test_diagnostics_in_other_forms():
    """Under vmap; in float32, in which a residual of 1e-5 is round-off, to 1e-3."""

    def told(size, cloud=CLOUD, lists=LISTS):
        scaled = js.PointCloud(size * cloud.points, cloud.normals)
        return js.laplace_beltrami(scaled, lists, method=METHOD).diagnostics

    plain = told(1.0)
    check_diagnostics(jax.vmap(told)(jnp.array([1.0, 2.0])), plain)
    with jax.enable_x64(False):
        same = lambda tree: jax.tree.map(lambda a: jnp.asarray(np.asarray(a)), tree)
        found = told(1.0, same(CLOUD), same(LISTS))
        assert found.condition.dtype == found.support.dtype == jnp.float32
    for name in ("condition", "count", "support", "layers", "tube"):
        np.testing.assert_allclose(getattr(found, name), getattr(plain, name), rtol=1e-3)
    assert found.residual.max() < 1e-5


@pytest.mark.parametrize("scale", [1e-120, 1e120])
def test_units_of_any_size(scale):
    """Points of size 1e120 or 1e-120, beyond what their third powers can hold."""
    cloud = js.PointCloud(scale * CLOUD.points, CLOUD.normals)
    lists = js.find_neighbors(cloud, k=24)
    operator = js.laplace_beltrami(cloud, lists, method=METHOD)
    plain = js.laplace_beltrami(CLOUD, LISTS, method=METHOD)(U)
    np.testing.assert_allclose(scale * operator(scale * U), plain, rtol=1e-9, atol=1e-9)


def test_round_off_of_the_input_does_not_matter():
    """Points moved by 1e-15 and in another order of summation: the same up to round-off."""
    lattice = js.sphere(N)  # many distances tie
    moved = np.asarray(lattice.points) * (1 + 1e-15 * np.random.default_rng(0).normal(size=(N, 1)))
    clouds = lattice, js.PointCloud(moved, lattice.normals)
    lists = [js.choose_neighbors(cloud, method=METHOD) for cloud in clouds]
    assert np.array_equal(lists[0].indices, lists[1].indices)
    first, second = (js.laplace_beltrami(c, n, method=METHOD)(U) for c, n in zip(clouds, lists))
    np.testing.assert_allclose(first, second, atol=1e-10 * float(jnp.abs(first).max()))


def test_stencils_are_shifted_at_their_own_points():
    """Slot 0 of a stencil need not be the point itself; a row may lack its own point."""
    operator = js.laplace_beltrami(CLOUD, LISTS, method=METHOD)
    operator = js.Stencil(operator.indices[::-1], operator.weights[::-1])
    np.testing.assert_allclose((operator + 3)(U), operator(U) + 3 * U, atol=1e-9)
    ring = js.Stencil((jnp.arange(5)[None] + 1) % 5, jnp.ones((1, 5)))
    u = jnp.arange(5.0)
    np.testing.assert_allclose((ring + u)(u), jnp.roll(u, -1) + u * u)
    np.testing.assert_allclose(jax.jit(lambda s: (s + 1)(u))(ring), jnp.roll(u, -1) + u)


def test_partial_derivatives_in_other_forms():
    """Flat derivatives under vmap, and in single precision to 1e-4."""
    a = np.stack(np.meshgrid(*[np.linspace(0, 1, 9)] * 2), axis=-1).reshape(-1, 2)
    a = a + np.random.default_rng(0).uniform(-0.02, 0.02, a.shape)
    lists = js.find_neighbors(a, k=20)
    u = np.sin(a[:, 0] + 2 * a[:, 1])

    def f(scale, a=a, u=u, lists=lists):
        points = scale * jnp.asarray(a, jnp.asarray(u).dtype)
        return js.partial_derivative(points, (1, 0), neighbors=lists)(u)

    plain = f(1.0)
    np.testing.assert_allclose(jax.vmap(f)(jnp.array([1.0, 2.0])), [plain, plain / 2], atol=1e-10)
    with jax.enable_x64(False):
        here = jax.tree.map(lambda a: jnp.asarray(np.asarray(a)), lists)
        found = f(1.0, u=jnp.asarray(u, jnp.float32), lists=here)
        assert found.dtype == jnp.float32
    np.testing.assert_allclose(found, plain, atol=1e-4)


def test_where_no_neighbourhood_serves():
    """Points on two close circles: no size gives the centre a share, and the user is told."""
    cloud = js.sphere(14)
    text = r"for \d+ points no size of neighbourhood serves _Flat.*point \d+"
    with pytest.warns(UserWarning, match=text):
        js.choose_neighbors(cloud, method=_Flat())


def test_a_border_that_is_not_marked_is_named():
    """Of a bowl whose border nothing told of, the warning spoke of neighbourhoods only."""
    bowl = js.surface_of_revolution(lambda s: (jnp.sin(s), -jnp.cos(s)), 400)
    bare = js.PointCloud(bowl.points, bowl.normals)
    rim = int(bowl.boundary.sum())
    for method in (js.GFDM(degree=2), js.GFDM(degree=4)):
        with pytest.warns(UserWarning, match=rf"{rim} of them have .* one side only.*boundary="):
            js.choose_neighbors(bare, method=method)


class _Flat(NearestPair):
    """Its centre has no weight whatever the neighbours."""

    def weights(self, neighborhood, target):
        w, diagnostics = super().weights(neighborhood, target)
        return w.at[0].set(0), diagnostics


@pytest.mark.core
def test_representations():
    marked = js.PointCloud(CLOUD.points, CLOUD.normals, boundary=np.arange(N) < 9)
    assert repr(CLOUD).startswith("PointCloud(200 points in 3-d, float64, spacing 0.")
    assert repr(CLOUD).endswith(", closed)") and "9 on the border" in repr(marked)
    assert repr(LISTS) == "Neighbors(200 points, 24 slots, 24 neighbours each)"
    operator = js.surface_gradient(CLOUD, **ARGS)
    assert repr(operator).startswith("Stencil(200 points, scalar to vector fields, 24 slots (")
    assert "Composition(200 points, scalar to scalar fields" in repr(js.biharmonic(CLOUD, **ARGS))
    jax.eval_shape(lambda c: repr(c) and c.points, CLOUD)  # traced ones have one too


def test_what_came_of_it_is_said_in_a_line():
    """Solutions have sizes, steps, residual and outcome in their repr, and nothing else changed."""
    laplacian, z = js.laplace_beltrami(CLOUD, **ARGS), CLOUD.points[:, 2]
    shifted = 1 - laplacian
    found = js.solve(shifted, jnp.stack([z, z**2], axis=1))
    assert isinstance(found, lx.Solution)
    assert re.fullmatch(
        r"LinearSolution\(200 points, 2 columns, float64; \d+( to \d+)? steps, "
        r"relative residual \S+e-\d+; successful\)",
        repr(found),
    )
    assert "1 of 2 failed" in repr(
        js.solve(laplacian, jnp.stack([0 * z, 1 + z], axis=1), throw=False)
    )
    cubic = js.solve_nonlinear(laplacian - 1, lambda u, args: -(u**3), z, rhs=-z)
    assert isinstance(cubic, optx.Solution)
    assert re.fullmatch(r"NonlinearSolution\(200 .*; \d+ steps, .*; successful\)", repr(cubic))
    heat = js.AdvectionDiffusionReaction(laplacian)
    saves = dfx.SaveAt(ts=jnp.linspace(0, 0.1, 3))
    run = js.integrate(heat, z, t1=0.1, saveat=saves)
    assert isinstance(run, dfx.Solution) and run.ys.shape == (3, 200)
    assert re.fullmatch(
        r"TimeSolution\(float64 \(3, 200\) at t = 0 to 0.1 \(3 times\); "
        r"\w+: \d+ steps \(\d+ refused\) to t = 0.1; successful\)",
        repr(run),
    )
    short = js.integrate(heat, z, t1=0.1, max_steps=2, throw=False)
    assert "of 0.1" in repr(short) and "maximum number" in repr(short)
    eqx.filter_eval_shape(lambda s: repr(s) and s.ys, run)  # traced ones have one too


# --- properties ------------------------------------------------------------------------------

few = settings(max_examples=8, derandomize=True, deadline=None, database=None)


@few
@given(seed=st.integers(0, 1000), k=st.integers(2, 12))
def test_lists_follow_the_points(seed, k):
    """Turned, moved, scaled or in another order, points have the same neighbours."""
    rng = np.random.default_rng(seed)
    x = np.asarray(random_sphere(40, seed).points)
    lists = js.find_neighbors(js.PointCloud(x, x), k=k, throw=False)
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    scale = 10.0 ** rng.uniform(-6, 6)
    cloud = js.PointCloud(scale * (x @ turn.T), x @ turn.T)
    assert np.array_equal(js.find_neighbors(cloud, k=k, throw=False).indices, lists.indices)
    order = rng.permutation(40)
    mixed = js.find_neighbors(js.PointCloud(x, x).permuted(order), k=k, throw=False)
    assert np.array_equal(order[np.asarray(mixed.indices)], np.asarray(lists.indices)[order])


@st.composite
def stencils(draw):
    rng = np.random.default_rng(draw(st.integers(0, 1000)))
    out, given_ = draw(st.sampled_from([((), ()), ((3,), ()), ((), (3,)), ((2,), (3,))]))
    weights = rng.normal(size=(4, *out, *given_, 7))
    return js.Stencil(jnp.asarray(rng.integers(0, 7, (4, 7))), jnp.asarray(weights), out, given_)


@few
@given(operator=stencils(), seed=st.integers(0, 1000))
def test_stencils_are_matrices(operator, seed):
    """Linear, equal to the SciPy matrix, adjoint to the transpose, the same after save and load."""
    rng = np.random.default_rng(seed)
    u, w = (jnp.asarray(rng.normal(size=(7, *operator.in_shape))) for _ in range(2))
    v = jnp.asarray(rng.normal(size=(7, *operator.out_shape)))
    near = functools.partial(np.testing.assert_allclose, rtol=1e-10, atol=1e-12)
    near(operator(2 * u - w), 2 * operator(u) - operator(w))
    near(operator.to_scipy() @ np.ravel(u), np.ravel(operator(u)))
    near(jnp.vdot(v, operator(u)), jnp.vdot(operator.transpose()(v), u))
    with tempfile.TemporaryDirectory() as folder:
        operator.save(Path(folder) / "a.npz")
        assert eqx.tree_equal(js.Stencil.load(Path(folder) / "a.npz"), operator)


@few
@given(seed=st.integers(0, 1000), scale=st.floats(1e-6, 1e6))
def test_clouds_keep_what_they_are_given(seed, scale):
    rng = np.random.default_rng(seed)
    x = np.asarray(random_sphere(20, seed).points)
    cloud = js.PointCloud(scale * x, x, boundary=rng.uniform(size=20) < 0.3)
    order = rng.permutation(20)
    again = cloud.permuted(order).permuted(np.argsort(order))
    assert eqx.tree_equal(again, cloud) and np.array_equal(cloud.points, scale * x)
