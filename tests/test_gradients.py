"""Every operator and curvature against central differences: points, normals, fields."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxsurf as js

from .helpers import KINDS, METHODS, check_derivatives, jittered_sphere, label

CLOUD = jittered_sphere(300, seed=1)
FIELD = jnp.sin(CLOUD.points @ jnp.array([1.0, 2.0, 1.5]))
VECTOR = jnp.stack([FIELD, FIELD**2, jnp.cos(FIELD)], axis=1)
# The programs that operators are made of are shared by these tests; under jit nothing would be.
check_derivative = functools.partial(check_derivatives, compiled=False)
each_method = pytest.mark.parametrize("method", METHODS, ids=label)
each_kind = pytest.mark.parametrize("method", KINDS, ids=label)
# Splines have no cut-off: RBF-FD is smooth for fixed neighbours only.
each_with_support = pytest.mark.parametrize("method", KINDS[:2], ids=label)


def smooth(values):
    """A scalar that weighs all entries differently."""
    weights = jnp.cos(jnp.arange(values.size, dtype=values.dtype)).reshape(values.shape)
    return jnp.sum(weights * values) / 100


def cloud_of(points):
    """Points near the sphere with the normals of the sphere through each: both depend on them."""
    return js.PointCloud(points, points / jnp.linalg.norm(points, axis=1, keepdims=True))


@each_method
def test_operators_in_points_and_normals(method):
    neighbors = js.choose_neighbors(CLOUD, method=method)

    def total(points):
        surface = js.Discretization(cloud_of(points), neighbors, method)
        return smooth(surface.laplacian(FIELD)) + smooth(surface.divergence(VECTOR))

    check_derivative(total, CLOUD.points * jnp.array([1.0, 1.2, 1.5]), step=1e-4)


def test_other_operators_and_curvature():
    args = dict(neighbors=js.choose_neighbors(CLOUD), method=js.DCPSE(order=2))

    def derivatives(cloud):
        yield js.surface_gradient(cloud, **args)(FIELD)
        yield js.directional_derivative(cloud, VECTOR, **args)(FIELD)
        yield js.diffusion(cloud, VECTOR[:, :, None] * VECTOR[:, None], **args)(FIELD)
        yield js.biharmonic(cloud, **args)(FIELD)

    def curvatures(cloud):
        yield js.shape_tensor(cloud, **args)
        yield js.mean_curvature(cloud, **args)
        yield js.gauss_curvature(cloud, **args)
        yield js.mean_curvature_vector(cloud, **args)
        yield from js.principal_curvatures(cloud, **args)

    # Off the sphere, so that the principal curvatures differ.
    points = CLOUD.points * jnp.array([1.0, 1.2, 1.5])
    for outputs in (derivatives, curvatures):
        check_derivative(
            lambda p, outputs=outputs: sum(smooth(v) for v in outputs(cloud_of(p))),
            points,
            step=1e-4,
        )


@each_kind
def test_normals_alone(method):
    neighbors = js.choose_neighbors(CLOUD, method=method)

    def total(normals):
        return smooth(
            js.laplace_beltrami(js.PointCloud(CLOUD.points, normals), neighbors, method=method)(
                FIELD
            )
        )

    check_derivative(total, CLOUD.normals, step=1e-4)


def test_field_and_coefficients():
    neighbors = js.choose_neighbors(CLOUD)
    laplacian = js.laplace_beltrami(CLOUD, neighbors)
    gradient = js.surface_gradient(CLOUD, neighbors)
    check_derivative(lambda u: smooth(laplacian(u) ** 2) + smooth(gradient(u) ** 2), FIELD)
    check_derivative(
        lambda d: smooth(js.diffusion(CLOUD, d, neighbors=neighbors)(FIELD) ** 2), 1.5 + FIELD
    )
    check_derivative(
        lambda a: smooth(js.directional_derivative(CLOUD, a, neighbors=neighbors)(FIELD) ** 2),
        VECTOR,
    )
    check_derivative(lambda s: smooth((s * laplacian).T(FIELD)), 1.0 + FIELD**2)


@each_with_support
def test_a_neighbor_crosses_the_edge_of_the_support(method):
    """A search by radius: the lists change within the difference, the weights must not jump."""
    radius = 0.62 if label(method).endswith("4") else 0.5
    points = np.array(CLOUD.points)
    others = np.linalg.norm(points - points[0], axis=1)
    j = int(np.argmin(np.where(others > 0.8 * radius, others, np.inf)))
    direction = (points[j] - points[0]) / others[j]
    start = points[j] + (radius - others[j]) * direction

    def value(step, search_at=None):
        moved = jnp.asarray(points).at[j].set(jnp.asarray(start) + step * direction)
        cloud = js.PointCloud(moved, CLOUD.normals)
        where = cloud if search_at is None else search_at
        neighbors = js.find_neighbors(where, radius=radius, throw=False)
        return smooth(js.laplace_beltrami(cloud, neighbors, method=method)(FIELD))

    at_edge = js.PointCloud(jnp.asarray(points).at[j].set(start), CLOUD.normals)
    derivative = jax.grad(lambda s: value(s, at_edge))(0.0)
    h = 1e-5
    difference = (float(value(h)) - float(value(-h))) / (2 * h)
    assert abs(difference) > 1e-3  # other rows still depend on the point
    np.testing.assert_allclose(derivative, difference, rtol=1e-6)


@each_with_support
def test_the_nearest_change(method):
    """The k nearest: a point that enters the list has no weight yet."""
    k = method.neighbor_count(3)
    points = np.array(CLOUD.points)
    order = np.argsort(np.linalg.norm(points - points[0], axis=1))
    inner, outer = order[k - 1], order[k]
    target = np.linalg.norm(points[outer] - points[0])
    direction = (points[inner] - points[0]) / np.linalg.norm(points[inner] - points[0])

    def row(distance):
        moved = points.copy()
        moved[inner] = points[0] + distance * direction
        cloud = js.PointCloud(moved, CLOUD.normals)
        neighbors = js.find_neighbors(cloud, k=k, throw=False)
        operator = js.laplace_beltrami(cloud, neighbors, method=method, throw=False)
        return bool((neighbors.indices[0] == inner).any()), float(operator(FIELD)[0])

    (listed, before), (gone, after) = row(target * (1 - 1e-9)), row(target * (1 + 1e-9))
    assert listed and not gone
    np.testing.assert_allclose(before, after, rtol=1e-6)


def test_padded_and_switched_off_rows_have_finite_gradients():
    keep = np.arange(CLOUD.n) % 10 != 0
    cloud = js.PointCloud(CLOUD.points, CLOUD.normals, active=keep)
    for method in (js.DCPSE(order=2), js.GFDM(degree=2), js.RBFFD(degree=2)):
        neighbors = js.choose_neighbors(cloud, method=method)

        def total(points, neighbors=neighbors, method=method):
            cloud = js.PointCloud(points, CLOUD.normals, active=keep)
            return smooth(js.laplace_beltrami(cloud, neighbors, method=method)(FIELD))

        gradient = jax.jit(jax.grad(total))(CLOUD.points)
        assert jnp.isfinite(gradient).all()
        assert jnp.abs(gradient[~keep]).max() == 0 < jnp.abs(gradient[keep]).max()


def test_compiled_tangents_of_splines():
    """In one program with the derivative, distances are computed more than once: see `_power`."""
    method = js.RBFFD(degree=2)
    neighbors = js.find_neighbors(CLOUD, k=14)
    points = CLOUD.points * jnp.array([1.0, 1.2, 1.5])

    def weights(points):
        return js.laplace_beltrami(cloud_of(points), neighbors, method=method).weights

    direction = jnp.sin(jnp.arange(points.size, dtype=points.dtype)).reshape(points.shape)
    values, tangents = jax.jit(lambda p: jax.jvp(weights, (p,), (direction,)))(points)
    expected = weights(points), jax.jvp(weights, (points,), (direction,))[1]
    for found, plain in zip((values, tangents), expected):
        np.testing.assert_allclose(found, plain, atol=1e-9 * jnp.abs(plain).max())


def test_neighbors_are_found_under_grad():
    """For the values that are differentiated: as with lists made outside, in every way to ask."""
    method = js.GFDM(degree=2)
    lists = js.choose_neighbors(CLOUD, method=method)

    def total(points, find):
        cloud = cloud_of(points)
        return smooth(find(cloud)(FIELD))

    given = jax.grad(total)(CLOUD.points, lambda c: js.laplace_beltrami(c, lists, method=method))
    for find in (
        lambda c: js.laplace_beltrami(c, method=method),
        lambda c: js.laplace_beltrami(c, js.choose_neighbors(c, method=method), method=method),
        lambda c: js.discretize(c, method=method).laplacian,
    ):
        found = jax.grad(total)(CLOUD.points, find)
        np.testing.assert_allclose(found, given, rtol=1e-9, atol=1e-12)
    with pytest.raises(ValueError, match="under jit and vmap"):
        jax.jit(total, static_argnums=1)(CLOUD.points, lambda c: js.laplace_beltrami(c))


def test_gradient_under_vmap():
    neighbors = js.choose_neighbors(CLOUD)

    def total(scale):
        return smooth(js.laplace_beltrami(cloud_of(scale * CLOUD.points), neighbors)(FIELD))

    scales = jnp.array([0.9, 1.0, 1.3])
    batch = jax.vmap(jax.grad(total))(scales)
    # total is proportional to scale^-2
    np.testing.assert_allclose(batch, -2 * jax.vmap(total)(scales) / scales, rtol=1e-8)


def test_gradient_through_estimated_normals():
    neighbors = js.choose_neighbors(CLOUD, method=js.GFDM(degree=4))

    def total(points):
        normals = js.refit_normals(points, CLOUD.normals, neighbors, degree=4)
        cloud = js.PointCloud(points, normals)
        return smooth(js.laplace_beltrami(cloud, neighbors, method=js.GFDM(degree=4))(FIELD))

    check_derivative(total, CLOUD.points, step=1e-5)


def test_second_derivatives_in_the_geometry():
    """By Euler's identity: a step along the axes only scales."""
    surface = js.discretize(js.sphere(200), method=js.GFDM(degree=2))
    x, normals = surface.cloud.points, surface.cloud.normals
    z = x[:, 2]

    def f(axes):
        scaled = normals / axes
        scaled = scaled / jnp.linalg.norm(scaled, axis=1, keepdims=True)
        return z @ surface.moved(axes * x, scaled).laplacian(z**2)

    axes = jnp.array([1.0, 1.1, 1.25])
    slope, turned = jax.jvp(jax.grad(f), (axes,), (axes,))
    # The Laplacian is of degree -2, so its derivative of degree -3.
    np.testing.assert_allclose(turned, -3 * slope, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize(
    "of",
    [lambda s, z: z @ s.laplacian(z**2), lambda s, z: z**2 @ s.areas],
    ids=["laplacian", "areas"],
)
def test_second_derivatives_along_a_line(of):
    """Forward over reverse, against differences; cells change their shape too."""
    surface = js.discretize(js.sphere(200), method=js.GFDM(degree=2))
    x, normals = surface.cloud.points, surface.cloud.normals

    def f(axes):
        scaled = normals / axes
        scaled = scaled / jnp.linalg.norm(scaled, axis=1, keepdims=True)
        return of(surface.moved(axes * x, scaled), x[:, 2])

    gradient = jax.jit(jax.grad(f))
    axes, along = jnp.array([1.0, 1.1, 1.25]), jnp.array([1.0, -0.5, 0.3])
    _, turned = jax.jvp(gradient, (axes,), (along,))
    step = 1e-5
    difference = (gradient(axes + step * along) - gradient(axes - step * along)) / (2 * step)
    np.testing.assert_allclose(turned, difference, rtol=1e-6, atol=1e-8)
