"""Operators: consistency, form, and agreement under jit, vmap, permutation and rigid motion."""

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import pytest
import scipy.spatial.transform

import jaxsurf as js
from jaxsurf import operators
from jaxsurf.fits.plane import Neighborhood
from jaxsurf.stencils.targets import Laplacian

from .helpers import KINDS, METHODS, exponential, jittered_sphere, label, made_in, relative_error

CLOUD = jittered_sphere(1500)
U, GRADIENT, LAPLACIAN = exponential(CLOUD.points)

each_method = pytest.mark.parametrize("method", METHODS, ids=label)
each_kind = pytest.mark.parametrize("method", KINDS, ids=label)


def test_what_is_known_is_built_at_once_in_compiled_code():
    cloud = js.sphere(600)
    z = cloud.points[:, 2]
    apply = jax.jit(lambda u: js.laplace_beltrami(cloud)(u))
    np.testing.assert_allclose(apply(z), js.laplace_beltrami(cloud)(z), atol=1e-9)
    weights = jax.jit(lambda a: js.diffusion(cloud, a).weights)(1 + z**2)
    np.testing.assert_allclose(weights, js.diffusion(cloud, 1 + z**2).weights, atol=1e-8)


@each_method
def test_constants_are_annihilated(method):
    neighbors = js.choose_neighbors(CLOUD, method=method)
    one = jnp.ones(CLOUD.n)
    for make in (js.laplace_beltrami, js.surface_gradient):
        operator = make(CLOUD, neighbors, method=method)
        size = jnp.max(jnp.sum(jnp.abs(operator.weights), axis=0))
        assert jnp.abs(operator(one)).max() < 1e-13 * size


@each_method
def test_quadratics_on_a_plane_are_exact(method):
    x, y = jnp.meshgrid(jnp.linspace(-1, 1, 15), jnp.linspace(-1, 1, 15))
    rng = np.random.default_rng(0)
    xy = jnp.stack([x.ravel(), y.ravel()], axis=1) + rng.uniform(-0.02, 0.02, (225, 2))
    points = jnp.concatenate([xy, jnp.zeros((225, 1))], axis=1)
    cloud = js.PointCloud(points, jnp.tile(jnp.array([0.0, 0.0, 1.0]), (225, 1)))
    neighbors = js.find_neighbors(cloud, k=method.neighbor_count(3))
    x, y = xy.T
    u = 3 * x**2 - x * y + 2 * y**2 + x - 1
    laplacian = js.laplace_beltrami(cloud, neighbors, method=method)
    gradient = js.surface_gradient(cloud, neighbors, method=method)
    divergence = js.surface_divergence(cloud, neighbors, method=method)
    np.testing.assert_allclose(laplacian(u), 10, atol=1e-8)
    exact = jnp.stack([6 * x - y + 1, 4 * y - x, 0 * x], axis=1)
    np.testing.assert_allclose(gradient(u), exact, atol=1e-9)
    np.testing.assert_allclose(divergence(exact), 10, atol=1e-8)
    along = js.directional_derivative(
        cloud, jnp.array([0.0, 2.0, 5.0]), neighbors=neighbors, method=method
    )
    np.testing.assert_allclose(along(u), 2 * exact[:, 1], atol=1e-9)
    d = jnp.diag(jnp.array([2.0, 3.0, 7.0])) + jnp.zeros((225, 1, 1))
    anisotropic = js.diffusion(cloud, d, neighbors=neighbors, method=method)
    np.testing.assert_allclose(anisotropic(u), 2 * 6 + 3 * 4, atol=1e-8)


@each_method
def test_inhomogeneous_diffusion(method):
    x = CLOUD.points
    d = 1.5 + x[:, 0] * x[:, 1]
    slope = jnp.stack([x[:, 1], x[:, 0], 0 * x[:, 0]], axis=1)
    exact = d * LAPLACIAN + jnp.sum(slope * GRADIENT, axis=1)
    bound = {"DCPSE2": 2e-2, "DCPSE4": 7e-4, "GFDM2": 2e-2, "GFDM4": 5e-4, "RBFFD4": 1.3e-3}[
        label(method)
    ]
    scalar = js.diffusion(CLOUD, d, method=method)
    assert relative_error(scalar(U), exact) < bound
    tensor = js.diffusion(CLOUD, d[:, None, None] * jnp.eye(3), method=method)
    assert relative_error(tensor(U), exact) < 2 * bound


def test_anisotropic_diffusion_around_the_axis():
    # D = t t with t = e_z x x: only the second derivative in longitude is left.
    x = CLOUD.points
    t = jnp.stack([-x[:, 1], x[:, 0], 0 * x[:, 0]], axis=1)
    u = x[:, 0] * x[:, 1] * (1 + x[:, 2])
    for method, bound in zip(METHODS, (3e-2, 3e-3, 2e-2, 2e-3, 2e-3)):
        operator = js.diffusion(CLOUD, t[:, :, None] * t[:, None], method=method)
        assert relative_error(operator(u), -4 * u) < bound, method


def test_biharmonic():
    x = js.sphere(4000).points
    cloud = js.PointCloud(x, x)
    z = x[:, 2]
    u = 5 * z**3 - 3 * z  # degree 3: eigenvalue -12
    operator = js.biharmonic(cloud)
    assert relative_error(operator(u), 144 * u) < 4e-4
    np.testing.assert_allclose(operator.to_scipy() @ np.asarray(u), operator(u), rtol=1e-7)


@each_method
def test_curves(method):
    angle = jnp.linspace(0, 2 * jnp.pi, 200, endpoint=False)
    angle = angle + 0.004 * jnp.sin(37 * angle)
    points = jnp.stack([2 * jnp.cos(angle), 2 * jnp.sin(angle)], axis=1)
    cloud = js.PointCloud(points, points / 2)
    u = jnp.sin(3 * angle)
    bound = {"DCPSE2": 8e-3, "DCPSE4": 2e-4, "GFDM2": 2e-2, "GFDM4": 2e-4, "RBFFD4": 2e-4}[
        label(method)
    ]
    assert relative_error(js.laplace_beltrami(cloud, method=method)(u), -9 * u / 4) < bound
    tangent = jnp.stack([-points[:, 1], points[:, 0]], axis=1) / 2
    exact = 3 * jnp.cos(3 * angle)[:, None] * tangent / 2
    assert relative_error(js.surface_gradient(cloud, method=method)(u), exact) < bound
    np.testing.assert_allclose(js.mean_curvature(cloud, method=method), 0.5, rtol=bound)


def test_batched_and_vector_fields():
    neighbors = js.find_neighbors(CLOUD, k=36)
    laplacian = js.laplace_beltrami(CLOUD, neighbors)
    gradient = js.surface_gradient(CLOUD, neighbors)
    divergence = js.surface_divergence(CLOUD, neighbors)
    fields = jnp.stack([U, U**2, jnp.sin(U)], axis=1)
    for operator in (laplacian, gradient):
        expected = jnp.stack([operator(c) for c in fields.T], axis=1)
        np.testing.assert_allclose(operator(fields), expected, rtol=1e-12, atol=1e-9)
    assert gradient(fields).shape == (CLOUD.n, 3, 3)
    vectors = gradient(fields)
    expected = jnp.stack([divergence(vectors[:, c]) for c in range(3)], axis=1)
    np.testing.assert_allclose(divergence(vectors), expected, rtol=1e-12, atol=1e-9)
    with pytest.raises(ValueError, match=r"field has shape \(7,\)"):
        laplacian(jnp.ones(7))


def test_matrix_transpose_and_lineax_agree():
    neighbors = js.find_neighbors(CLOUD, k=36)
    rng = np.random.default_rng(0)
    for make in (js.laplace_beltrami, js.surface_gradient, js.surface_divergence):
        operator = make(CLOUD, neighbors)
        u = jnp.asarray(rng.normal(size=(CLOUD.n, *operator.in_shape)))
        v = jnp.asarray(rng.normal(size=(CLOUD.n, *operator.out_shape)))
        matrix = operator.to_scipy()
        np.testing.assert_allclose(matrix @ np.ravel(u), np.ravel(operator(u)), atol=1e-9)
        transpose = operator.transpose()
        np.testing.assert_allclose(jnp.vdot(v, operator(u)), jnp.vdot(transpose(v), u), rtol=1e-9)
        assert abs(matrix.T - transpose.to_scipy()).max() < 1e-12
        linear = operator.to_lineax()
        np.testing.assert_allclose(linear.mv(u), operator(u))
        np.testing.assert_allclose(linear.T.mv(v), transpose(v), atol=1e-9)
    biharmonic = js.biharmonic(CLOUD, neighbors, method=js.GFDM(degree=2))
    u, v = jnp.asarray(rng.normal(size=(2, CLOUD.n)))
    lhs, rhs = jnp.vdot(v, biharmonic(u)), jnp.vdot(biharmonic.transpose()(v), u)
    np.testing.assert_allclose(lhs, rhs, rtol=1e-8)
    system = lx.FunctionLinearOperator(
        lambda u: u - 1e-3 * operator_l(u), jax.eval_shape(lambda: U)
    )
    solution = lx.linear_solve(system, U, lx.BiCGStab(rtol=1e-10, atol=1e-10))
    np.testing.assert_allclose(system.mv(solution.value), U, rtol=1e-7)


operator_l = js.laplace_beltrami(CLOUD, js.find_neighbors(CLOUD, k=36))


def test_save_and_load(tmp_path):
    operator = js.surface_gradient(CLOUD, js.find_neighbors(CLOUD, k=36))
    operator.save(tmp_path / "gradient.npz")
    again = js.Stencil.load(tmp_path / "gradient.npz")
    assert eqx.tree_equal(operator, again)
    (tmp_path / "bad.npz").write_bytes(b"not an archive")
    with pytest.raises(ValueError, match=r"bad\.npz does not hold a stencil"):
        js.Stencil.load(tmp_path / "bad.npz")
    (tmp_path / "empty.npz").write_bytes(b"")
    with pytest.raises(ValueError, match=r"empty\.npz does not hold a stencil"):
        js.Stencil.load(tmp_path / "empty.npz")


@each_kind
def test_jit_and_vmap_equal_the_plain_call(method):
    neighbors = js.choose_neighbors(CLOUD, method=method)

    def apply(scale):
        cloud = js.PointCloud(scale * CLOUD.points, CLOUD.normals)
        return js.laplace_beltrami(cloud, neighbors, method=method)(U)

    plain = apply(1.25)
    np.testing.assert_allclose(jax.jit(apply)(1.25), plain, rtol=1e-9, atol=1e-9)
    batch = jax.vmap(apply)(jnp.array([1.25, 2.0]))
    np.testing.assert_allclose(batch[0], plain, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(batch[1] * 4, plain * 1.25**2, rtol=1e-9, atol=1e-9)


def test_same_shapes_do_not_retrace():
    neighbors = js.find_neighbors(CLOUD, k=36)
    count = 0

    @jax.jit
    def apply(points):
        nonlocal count
        count += 1
        return js.laplace_beltrami(js.PointCloud(points, CLOUD.normals), neighbors)(U)

    for scale in (1.0, 1.1, 1.2):
        apply(scale * CLOUD.points)
    assert count == 1


@each_kind
def test_extra_padding_changes_nothing(method):
    neighbors = js.find_neighbors(CLOUD, k=method.neighbor_count(3))
    own = jnp.arange(CLOUD.n, dtype=jnp.int32)[:, None]
    padded = js.Neighbors(
        jnp.concatenate([neighbors.indices, jnp.tile(own, 9)], axis=1),
        jnp.pad(neighbors.mask, ((0, 0), (0, 9))),
    )

    def total(points, neighbors):
        cloud = js.PointCloud(points, CLOUD.normals)
        return jnp.sum(js.laplace_beltrami(cloud, neighbors, method=method)(U) ** 2)

    for f in (total, jax.grad(total)):
        short, long = f(CLOUD.points, neighbors), f(CLOUD.points, padded)
        np.testing.assert_allclose(long, short, rtol=1e-9, atol=1e-9 * jnp.abs(short).max())


@each_method
def test_rigid_motion_scaling_and_order(method):
    def apply(cloud, u):
        return js.laplace_beltrami(cloud, method=method)(u)

    plain = apply(CLOUD, U)
    size = float(jnp.abs(plain).max())
    turn = scipy.spatial.transform.Rotation.from_rotvec([0.3, -1.1, 0.7]).as_matrix()
    turned = js.PointCloud(CLOUD.points @ turn.T, CLOUD.normals @ turn.T)
    np.testing.assert_allclose(apply(turned, U), plain, atol=1e-10 * size)
    bigger = js.PointCloud(1e3 * CLOUD.points, CLOUD.normals)
    np.testing.assert_allclose(1e6 * apply(bigger, U), plain, atol=1e-9 * size)
    order = np.random.default_rng(0).permutation(CLOUD.n)
    shuffled = apply(CLOUD.permuted(order), U[order])
    np.testing.assert_allclose(shuffled, plain[order], atol=1e-9 * size)
    # Far away, the coordinates themselves are rounded to 1000 diameters x 1e-16; the Laplacian
    # amplifies that by 1 / h^2, nothing more.
    offset = 2000 * jnp.array([0.6, 0.0, 0.8])
    far = js.PointCloud(CLOUD.points + offset, CLOUD.normals)
    rounded = js.PointCloud((CLOUD.points + offset) - offset, CLOUD.normals)
    neighbors = js.choose_neighbors(CLOUD, method=method)
    away = js.laplace_beltrami(far, neighbors, method=method)
    here = js.laplace_beltrami(rounded, neighbors, method=method)
    np.testing.assert_allclose(away(U), here(U), atol=1e-11 * size)


def test_switched_off_points_take_no_part():
    keep = np.random.default_rng(0).uniform(size=CLOUD.n) < 0.9
    rubbish = jnp.where(keep[:, None], CLOUD.points, jnp.nan)
    masked = js.PointCloud(rubbish, CLOUD.normals, active=keep)
    small = js.PointCloud(CLOUD.points[keep], CLOUD.normals[keep])
    for method in KINDS:
        expected = js.laplace_beltrami(small, method=method)(U[keep])
        operator = js.laplace_beltrami(masked, method=method)
        result = operator(jnp.where(keep, U, 0.0))
        np.testing.assert_allclose(result[keep], expected, rtol=1e-8, atol=1e-8)


@pytest.mark.parametrize("method", [*METHODS[:3], js.RBFFD(degree=4)])
def test_single_precision(method):
    cloud = jax.tree.map(lambda a: a.astype(jnp.float32), CLOUD)
    operator = js.laplace_beltrami(cloud, method=method)
    assert operator.weights.dtype == jnp.float32
    exact = js.laplace_beltrami(CLOUD, method=method)(U)
    assert relative_error(operator(U.astype(jnp.float32)), exact) < 2e-3


@pytest.mark.parametrize(
    "bad,text",
    [
        (-0.5, "diffusivity of point .* at least 0"),
        (jnp.nan, "diffusivity of point .* at least 0"),
        (np.diag([1.0, 1.0, -0.5]), "has the eigenvalue"),
        (np.eye(3) + np.eye(3, k=1), "not symmetric"),
    ],
    ids=["negative", "NaN", "indefinite", "asymmetric"],
)
def test_traced_diffusivities_are_looked_at(bad, text):
    cloud = jittered_sphere(200)
    given = {"neighbors": js.find_neighbors(cloud, 15), "throw": False}
    good = jnp.ones(200) if np.ndim(bad) == 0 else jnp.tile(jnp.eye(3), (200, 1, 1))
    wrong = good.at[7].set(bad)
    total = lambda d: jnp.sum(js.diffusion(cloud, d, **given)(cloud.points[:, 2]))
    compiled = eqx.filter_jit(total)
    assert jnp.isfinite(compiled(good))
    with pytest.raises(eqx.EquinoxRuntimeError, match=text):
        compiled(wrong)
    # What is differentiated is known, and named; under `vmap` one bad one is enough.
    with pytest.raises(ValueError, match=r"diffusivity.* point 7 "):
        jax.grad(total)(wrong)
    if np.ndim(bad) == 0:
        with pytest.raises(eqx.EquinoxRuntimeError, match=text):
            eqx.filter_jit(jax.vmap(total))(jnp.stack([good, wrong]))


def test_tensor_diffusion_is_small_and_stays_in_single_precision():
    """Of its stencils of second derivatives it makes no copy, and no `(k, n, d, d)` array."""
    cloud = jittered_sphere(200)
    single = js.PointCloud(*(jnp.asarray(a, jnp.float32) for a in (cloud.points, cloud.normals)))
    neighbors = js.find_neighbors(cloud, 15)
    d = jnp.tile(jnp.diag(jnp.array([1.0, 2.0, 3.0])), (200, 1, 1))  # in double precision
    make = lambda c, d: js.diffusion(c, d, neighbors=neighbors, throw=False).weights
    found = list(made_in(jax.make_jaxpr(make)(single, d).jaxpr))
    assert not [shape for shape, _ in found if shape in ((15, 200, 3, 3), (200, 15, 3, 3))]
    wide = {shape for shape, dtype in found if dtype == jnp.float64}
    assert not [shape for shape in wide if 15 in shape], wide  # nothing of a stencil's size
    assert js.diffusion(single, d, neighbors=neighbors, throw=False).weights.dtype == jnp.float32
    hessian = jnp.ones((15, 3, 3, 200), jnp.float32)
    later = jax.make_jaxpr(operators._tensor_weights)(
        d.astype(jnp.float32), single.normals, neighbors.indices.T, hessian
    )
    assert max(np.prod(shape) for shape, _ in made_in(later.jaxpr)) <= 15 * 200


def test_compiled_builds_store_no_neighbourhoods():
    """They are read block by block; before, where there are derivatives: with the same results."""
    cloud = js.sphere(3_000)
    lists = js.find_neighbors(cloud, k=36)

    def weights(x):
        moved = js.PointCloud(x, cloud.normals)
        return js.laplace_beltrami(moved, lists, method=js.GFDM(degree=2)).weights

    program = jax.jit(weights).lower(cloud.points).compile()
    stored = program.memory_analysis().temp_size_in_bytes
    neighbourhoods = lists.indices.size * 6 * cloud.points.dtype.itemsize
    assert stored < neighbourhoods / 2
    forward = jax.jit(lambda x: jax.jvp(weights, (x,), (x,)))
    primal, slope = forward(cloud.points)
    found = program(cloud.points)
    np.testing.assert_allclose(primal, found, rtol=1e-9, atol=1e-9 * float(jnp.abs(found).max()))
    # Points and normals that are stretched alike would be of degree -2; these normals stay.
    np.testing.assert_allclose(slope, -2 * found, atol=1e-6 * float(jnp.abs(found).max()))


@pytest.mark.parametrize("method", [js.DCPSE(order=2), js.GFDM(degree=2)])
def test_a_neighbourhood_may_be_that_of_one_point(method):
    cloud = js.sphere(300)
    lists = np.asarray(js.find_neighbors(cloud, k=40).indices[:4]).T
    columns = [list(np.asarray(a).T) for a in (cloud.points, cloud.normals)]

    @jax.jit
    def weights(points, normals):
        mask = jnp.ones(points[0].shape, bool)
        around = Neighborhood.of(points, normals, mask, None, None)
        return method.weights(around, Laplacian())[0]

    read = lambda lists: [[jnp.asarray(x[lists]) for x in vectors] for vectors in columns]
    block, one = weights(*read(lists)), weights(*read(lists[:, 0]))
    assert one.shape == (40,)
    np.testing.assert_allclose(one, block[:, 0], atol=1e-12 * float(abs(block).max()))
