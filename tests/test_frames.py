"""Tangent frames, and normals estimated from points: accuracy, signs, derivatives, bad clouds."""

import warnings
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxsurf as js
from jaxsurf.cloud import PointCloud
from jaxsurf.frames import tangent_frames
from jaxsurf.neighbors import Neighbors, find_neighbors
from jaxsurf.normals import estimate_normals, from_points, refit_normals

from .helpers import check_derivatives

DATA = Path(__file__).parents[2] / "shared" / "data"


def fibonacci(n):
    i = np.arange(n) + 0.5
    z, angle = 1 - 2 * i / n, np.pi * (1 + 5**0.5) * i
    s = np.sqrt(1 - z * z)
    return np.stack([s * np.cos(angle), s * np.sin(angle), z], axis=1)


def unit(x):
    return x / np.linalg.norm(x, axis=-1, keepdims=True)


def jittered(n, seed=0):
    step = 0.25 * np.sqrt(4 * np.pi / n)
    rng = np.random.default_rng(seed)
    return unit(fibonacci(n) + step * unit(rng.normal(size=(n, 3))) * rng.uniform(size=(n, 1)))


def ellipsoid(n, axes=(1.0, 0.8, 0.6), make=jittered):
    x = make(n)
    return x * axes, unit(x / axes)


def angle(a, b):
    """Largest angle between normals; signs matter."""
    a, b = np.asarray(a, float), np.asarray(b, float)
    return float(np.linalg.norm(unit(a) - unit(b), axis=1).max())


# --- frames --------------------------------------------------------------------------------


@pytest.mark.parametrize("dim", [2, 3])
def test_frames_are_rotations(dim):
    normals = unit(np.random.default_rng(0).normal(size=(500, dim)))
    normals = np.r_[normals, np.eye(dim), -np.eye(dim)]
    frames = tangent_frames(jnp.asarray(normals))
    assert np.array_equal(frames[:, -1], normals)
    gram = np.einsum("nij,nkj->nik", frames, frames)
    assert np.abs(gram - np.eye(dim)).max() < 1e-14
    assert np.abs(np.linalg.det(np.asarray(frames)) - 1).max() < 1e-14
    assert tangent_frames(jnp.asarray(normals, jnp.float32)).dtype == jnp.float32


def test_frames_under_jit_vmap_and_grad():
    normals = jnp.asarray(unit(np.random.default_rng(1).normal(size=(50, 3))))
    plain = tangent_frames(normals)
    assert np.allclose(jax.jit(tangent_frames)(normals), plain, atol=1e-15)
    assert np.allclose(jax.vmap(tangent_frames)(normals), plain, atol=1e-15)
    step = 1e-7 * jnp.asarray(np.random.default_rng(2).normal(size=(50, 3)))
    slope = jax.jvp(tangent_frames, (normals,), (step,))[1]
    change = (tangent_frames(normals + step) - tangent_frames(normals - step)) / 2
    assert float(jnp.abs(slope - change).max()) < 1e-7 * 1e-5
    assert bool(jnp.isfinite(jax.grad(lambda n: tangent_frames(n)[..., 0].sum())(normals)).all())


# --- accuracy ------------------------------------------------------------------------------


@pytest.mark.parametrize(("degree", "bound"), [(2, 3e-3), (3, 1.5e-3), (4, 2e-4)])
def test_refit_order(degree, bound):
    errors = []
    for n in (1000, 4000):
        points, exact = ellipsoid(n)
        errors.append(angle(estimate_normals(points, degree=degree), exact))
    assert np.log2(errors[0] / errors[1]) > degree - 0.2
    assert errors[1] < bound


def test_ten_thousand_points_on_the_sphere():
    x = fibonacci(10_000)
    assert angle(estimate_normals(x), x) < 3e-8
    x = jittered(10_000)
    assert angle(estimate_normals(x), x) < 1e-7


def test_purely_random_points():
    x = unit(np.random.default_rng(0).normal(size=(4000, 3)))
    assert angle(estimate_normals(x), x) < 3e-5


def test_single_precision():
    x = fibonacci(4000)
    normals = estimate_normals(x.astype(np.float32))
    assert normals.dtype == jnp.float32
    assert angle(normals, x) < 1e-5


@pytest.mark.parametrize(("degree", "bound"), [(2, 4e-3), (4, 1e-4)])
def test_plane_curves(degree, bound):
    errors = []
    for n in (100, 200):
        t = 2 * np.pi * (np.arange(n) + 0.2 * np.sin(np.arange(n))) / n
        points = np.stack([2 * np.cos(t), np.sin(t)], axis=1)
        exact = unit(np.stack([np.cos(t), 2 * np.sin(t)], axis=1))
        errors.append(angle(estimate_normals(points, degree=degree), exact))
    assert errors[1] < bound
    assert np.log2(errors[0] / errors[1]) > degree - 0.2


def test_borders():
    x = fibonacci(6000)
    x = x[x[:, 2] > -0.3]
    cloud = from_points(x, boundary=x[:, 2] < -0.28)
    assert angle(cloud.normals, x) < 5e-6
    assert int(cloud.boundary.sum()) > 10


def test_moving_rotating_and_scaling():
    points, _ = ellipsoid(1500)
    normals = estimate_normals(points)
    # Coordinates rounded at 2,000 diameters: 1e-13 in a spacing of 0.08.
    assert angle(estimate_normals(points + np.array([4e3, -2e3, 1e3])), normals) < 1e-9
    turn = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    assert angle(estimate_normals(points @ turn.T), normals @ turn.T) < 1e-9
    assert angle(estimate_normals(1e-6 * points), normals) < 1e-9
    order = np.random.default_rng(0).permutation(1500)
    assert angle(estimate_normals(points[order]), normals[order]) < 1e-9


# --- signs ---------------------------------------------------------------------------------


def test_outward_on_every_surface_of_a_scene():
    x = fibonacci(1500)
    t = np.linspace(0, 2 * np.pi, 60, endpoint=False)
    s, t = (a.ravel() for a in np.meshgrid(t[::3], t))
    ring = np.stack(
        [(2 + 0.5 * np.cos(s)) * np.cos(t), (2 + 0.5 * np.cos(s)) * np.sin(t), 0.5 * np.sin(s)], 1
    )
    ring_normals = np.stack([np.cos(s) * np.cos(t), np.cos(s) * np.sin(t), np.sin(s)], 1)
    points = np.r_[x, 1.4 * x, ring + np.array([0, 0, 5.0])]  # a sphere in a sphere, and a torus
    normals = estimate_normals(points, degree=2)
    assert angle(normals, np.r_[x, x, ring_normals]) < 0.05


def pancake(thickness, radius=10.0):
    """A thin disk with a round rim: points a unit apart, and the normals of the smooth body."""
    rng = np.random.default_rng(0)
    a = np.stack(np.meshgrid(np.arange(-11, 12), np.arange(-11, 12)), -1).reshape(-1, 2)
    points, normals = [], []
    for side in (-1, 1):
        b = a + 0.15 * side
        b = b[np.linalg.norm(b, axis=1) < radius - 0.3]
        b = b + 0.1 * rng.normal(size=b.shape)
        points.append(np.c_[b, np.full(len(b), side * thickness / 2)])
        normals.append(np.tile([0, 0, 1.0 * side], (len(b), 1)))
    rows = round(np.pi * thickness / 2)
    for row in range(rows):
        up = ((row + 0.5) / rows - 0.5) * np.pi
        r = radius + thickness / 2 * np.cos(up)
        count = round(2 * np.pi * r)
        t = 2 * np.pi * (np.arange(count) + row / 2) / count
        n = np.stack(
            [np.cos(up) * np.cos(t), np.cos(up) * np.sin(t), np.full(count, np.sin(up))], 1
        )
        points.append(radius * np.stack([np.cos(t), np.sin(t), 0 * t], 1) + thickness / 2 * n)
        normals.append(n)
    return np.concatenate(points), np.concatenate(normals)


@pytest.mark.parametrize("thickness", [1.5, 2.0, 3.0])
def test_thin_parts(thickness):
    points, expected = pancake(thickness)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the rim is one or two points wide
        normals = np.asarray(estimate_normals(points, degree=2, k=12))
    cosine = np.einsum("nd,nd->n", normals, expected)
    assert np.all(cosine > 0)
    inside = np.linalg.norm(points[:, :2], axis=1) < 6
    assert np.abs(cosine[inside] - 1).max() < 1e-12


@pytest.mark.parametrize("thickness", [2.0, 2.5])
def test_plates_without_a_rim_face_away_from_each_other(thickness):
    a = np.stack(np.meshgrid(np.arange(20), np.arange(20)), -1).reshape(-1, 2)
    a = a + 0.1 * np.random.default_rng(0).normal(size=a.shape)
    points = np.r_[np.c_[a, np.zeros(400)], np.c_[a + 0.3, np.full(400, thickness)]]
    z = np.asarray(estimate_normals(points, degree=2, k=12))[:, 2]
    assert np.abs(z - np.repeat([-1, 1], 400)).max() < 1e-12


@pytest.mark.parametrize("gap", [4.0, 5.0])
def test_plates_that_face_the_same_way_are_told_apart(gap):
    """Fits near their edges took points of the other plate: normals were up to 18 degrees off."""
    a = np.stack(np.meshgrid(np.arange(30), np.arange(30)), -1).reshape(-1, 2)
    points = np.r_[np.c_[a, np.zeros(900)], np.c_[a, np.full(900, gap)]]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        z = np.asarray(estimate_normals(points))[:, 2]
    assert np.abs(np.abs(z) - 1).max() < 1e-12


def test_flat_sheet_is_accepted():
    a = np.random.default_rng(0).uniform(size=(500, 2))
    normals = estimate_normals(np.c_[a, np.zeros(500)], degree=2)
    assert angle(normals, np.tile([0.0, 0, 1], (500, 1))) < 1e-12


def read_mesh(name):
    path = DATA / name
    if not path.exists():
        pytest.skip(f"{name} is not in ../shared/data")
    vertices, faces = [], []
    for line in path.read_text().splitlines():
        word, *rest = line.split() or [""]
        if word == "v":
            vertices.append([float(t) for t in rest[:3]])
        elif word == "f":
            faces.append([int(t.split("/")[0]) - 1 for t in rest])
    vertices, faces = np.array(vertices), np.array(faces)
    used, faces = np.unique(faces, return_inverse=True)
    vertices, faces = vertices[used], faces.reshape(-1, 3)
    corners = vertices[faces]
    area = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals = np.zeros_like(vertices)
    for c in range(3):
        np.add.at(normals, faces[:, c], area)
    return vertices, unit(normals)


@pytest.mark.parametrize(
    ("name", "degree", "wrong"),
    # The one that is wrong lies in a crease that degree 4 cannot follow.
    [
        ("stanford-bunny.obj", 2, 0),
        ("armadillo.obj", 2, 0),
        ("armadillo.obj", 4, 1),
    ],
)
def test_scanned_surfaces_are_oriented_like_their_meshes(name, degree, wrong):
    points, expected = read_mesh(name)
    with pytest.warns(UserWarning, match=r"not resolved at \d+ of"):
        normals = estimate_normals(points, degree=degree)
    cosine = np.einsum("nd,nd->n", normals, expected)
    assert np.sum(cosine < 0) <= wrong
    assert np.sum(cosine < 0.5) < 20
    assert np.median(cosine) > 0.99
    find_neighbors(PointCloud(points, normals), 32)  # and pass the checks made there


# --- derivatives ---------------------------------------------------------------------------


@pytest.fixture(scope="module")
def settled():
    points, _ = ellipsoid(1000)
    normals = estimate_normals(points)
    neighbors = find_neighbors(PointCloud(points, normals), 40)
    points = jnp.asarray(points)
    return points, refit_normals(points, normals, neighbors, degree=4, iterations=8), neighbors


def test_refit_derivative(settled):
    points, normals, neighbors = settled
    rng = np.random.default_rng(0)
    step = 0.01 * jnp.asarray(rng.normal(size=points.shape))
    cotangent = jnp.asarray(rng.normal(size=points.shape))

    def refit(iterations, x):
        return refit_normals(x, normals, neighbors, degree=4, iterations=iterations)

    three, fixed_point = partial(refit, 3), partial(refit, 10)
    forward = jax.jit(lambda x: jax.jvp(three, (x,), (step,))[1])(points)
    size = float(jnp.abs(forward).max())
    for f, tolerance in ((three, 1e-8), (fixed_point, 2e-6)):
        change = (f(points + 1e-5 * step) - f(points - 1e-5 * step)) / 2e-5
        assert float(jnp.abs(forward - change).max()) < tolerance * size
    backward = jax.jit(jax.grad(lambda x: jnp.vdot(cotangent, three(x))))(points)
    product = float(jnp.vdot(cotangent, forward))
    assert abs(float(jnp.vdot(backward, step)) - product) < 1e-12 * abs(product) + 1e-12


def test_refit_derivative_in_the_normals(settled):
    points, normals, neighbors = settled
    tilted = normals + 0.05 * jnp.asarray(np.random.default_rng(0).normal(size=normals.shape))
    tilted /= jnp.linalg.norm(tilted, axis=1, keepdims=True)

    def f(m):
        return refit_normals(points, m, neighbors, degree=4, iterations=1)

    step = jnp.cross(tilted, jnp.ones(3))
    forward = jax.jvp(f, (tilted,), (step,))[1]
    change = (f(tilted + 1e-5 * step) - f(tilted - 1e-5 * step)) / 2e-5
    assert float(jnp.abs(forward - change).max()) < 1e-7 * max(1, float(jnp.abs(forward).max()))


def test_refit_under_jit_vmap_and_padding(settled):
    points, normals, neighbors = settled
    f = partial(refit_normals, degree=2)
    plain = f(points, normals, neighbors)
    assert np.allclose(jax.jit(f)(points, normals, neighbors), plain, atol=1e-14)
    two = jax.vmap(lambda s: f(s * points, normals, neighbors))(jnp.array([1.0, 3.0]))
    assert np.allclose(two, plain, atol=1e-13)
    own = jnp.tile(jnp.arange(len(points), dtype=jnp.int32)[:, None], 7)
    padded = Neighbors(
        jnp.concatenate([neighbors.indices, own], axis=1),
        jnp.concatenate([neighbors.mask, jnp.zeros(own.shape, bool)], axis=1),
    )
    assert np.allclose(f(points, normals, padded), plain, atol=1e-14)
    slope = jax.jit(jax.grad(lambda x, nb: f(x, normals, nb)[:, 0].sum()))
    assert np.allclose(slope(points, padded), slope(points, neighbors), atol=1e-11)


def test_switched_off_rows_keep_their_normals_and_gradients_are_finite(settled):
    points, normals, _ = settled
    active = jnp.arange(len(points)) % 5 != 0
    for search in ({"k": 15}, {"radius": 0.35}):
        neighbors = find_neighbors(PointCloud(points, normals, active=active), **search)
        f = partial(refit_normals, normals=normals, neighbors=neighbors, degree=2)
        result = f(points)
        assert np.array_equal(result[~active], normals[~active])
        assert angle(result[active], normals[active]) < 0.05
        slope = jax.jit(jax.grad(lambda x, f=f: jnp.sum(f(x) ** 3)))(points)
        assert bool(jnp.isfinite(slope).all())
        assert bool((slope[~active] == 0).all())


# --- bad clouds ----------------------------------------------------------------------------


def moebius(around, across):
    t = 2 * np.pi * np.arange(around) / around
    s = np.linspace(-0.4, 0.4, across)
    t, s = (a.ravel() for a in np.meshgrid(t, s, indexing="ij"))
    r = 1 + s * np.cos(t / 2)
    return np.stack([r * np.cos(t), r * np.sin(t), s * np.sin(t / 2)], axis=1)


def test_moebius_strip_is_refused():
    with pytest.raises(ValueError, match=r"points \d+ and \d+ got opposite normals.*one side"):
        estimate_normals(moebius(90, 12), degree=2)
    half = moebius(90, 12)[: 45 * 12]  # cut open it is a surface like any other
    assert estimate_normals(half, degree=2).shape == half.shape


def test_points_that_determine_no_normal_are_named():
    t = np.linspace(0, 1, 60)
    with pytest.raises(ValueError, match=r"around point 0 lie on a line \(and 59 more\)"):
        estimate_normals(np.stack([t, 2 * t, -t], axis=1), degree=2)
    # Ten lines: enough points for a plane, not for a parabola across.
    a = np.stack(np.meshgrid(np.arange(200.0), [0.0, 3.0], [0.0]), -1).reshape(-1, 3)
    a[:, 0] += 0.01 * np.random.default_rng(0).normal(size=len(a))
    with pytest.raises(ValueError, match=r"of point \d+ do not determine a polynomial of degree 2"):
        estimate_normals(a, degree=2)


def test_misuse_is_refused():
    x = fibonacci(300)
    with pytest.raises(ValueError, match="k = 12 neighbours, degree 4 needs at least 15"):
        estimate_normals(x, degree=4, k=12)
    with pytest.raises(ValueError, match="degree = 0"):
        estimate_normals(x, degree=0)
    with pytest.raises(ValueError, match="too few points: 30, with k = 45"):
        estimate_normals(x[:30])
    with pytest.raises(ValueError, match="refit_normals"):
        jax.jit(estimate_normals)(x)
    with pytest.raises(ValueError, match="shape"):
        estimate_normals(np.zeros((10, 4)))
    bad = x.copy()
    bad[17] = np.nan
    with pytest.raises(ValueError, match="point 17 is not finite"):
        estimate_normals(bad)
    bad[17] = x[5]
    with pytest.raises(ValueError, match="points 5 and 17 coincide"):
        estimate_normals(bad)
    neighbors = find_neighbors(PointCloud(x, x), 12)
    with pytest.raises(ValueError, match="k = 12 neighbours, degree 4 needs at least 15"):
        refit_normals(jnp.asarray(x), jnp.asarray(x), neighbors, degree=4)
    few = find_neighbors(PointCloud(x, x), radius=0.45)
    assert few.k > 15
    mask = few.mask.at[9, 14:].set(False)
    with pytest.raises(ValueError, match="point 9 has 14 neighbours, degree 4 needs at least 15"):
        refit_normals(
            jnp.asarray(x), jnp.asarray(x), Neighbors(few.indices, mask, few.radius), degree=4
        )


def test_resolved_surfaces_do_not_warn():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        estimate_normals(ellipsoid(1000)[0])


def test_a_normal_that_its_fit_turns_over():
    """Noise far above what the points resolve: named, not returned."""
    x = np.asarray(js.sphere(300).points)
    rough = x * (1 + 0.3 * np.random.default_rng(0).uniform(-1, 1, (300, 1)))
    neighbors = find_neighbors(PointCloud(x, x), 24)
    with pytest.raises(ValueError, match=r"turned the normal of point \d+ over \(cosine -"):
        refit_normals(jnp.asarray(rough), jnp.asarray(x), neighbors, degree=4)


# --- under jit, on curves, last bits ---------------------------------------------------------


def test_what_is_refused_is_nan_under_jit():
    """Too few neighbours, and a normal turned over: marked at their points, not elsewhere."""
    x = jnp.asarray(fibonacci(300))
    neighbors = find_neighbors(PointCloud(x, x), 24)
    refit = jax.jit(partial(refit_normals, degree=4))
    poor = Neighbors(neighbors.indices, neighbors.mask.at[9, 14:].set(False))
    lost = np.isnan(np.asarray(refit(x, x, poor))).any(axis=1)
    assert np.flatnonzero(lost).tolist() == [9]
    rough = x * (1 + 0.3 * np.random.default_rng(0).uniform(-1, 1, (300, 1)))
    lost = np.isnan(np.asarray(refit(rough, x, neighbors))).any(axis=1)
    assert 0 < lost.sum() < 100
    with pytest.raises(ValueError, match=rf"turned the normal of point {np.argmax(lost)} over"):
        refit_normals(rough, x, neighbors, degree=4)


def test_gradients_on_plane_curves():
    t = 2 * np.pi * (np.arange(40) + 0.2 * np.sin(np.arange(40))) / 40
    points = jnp.asarray(np.stack([2 * np.cos(t), np.sin(t)], axis=1))
    normals = jnp.asarray(unit(np.stack([np.cos(t), 2 * np.sin(t)], axis=1)))
    neighbors = find_neighbors(PointCloud(points, normals), 9)
    weights = jnp.asarray(np.random.default_rng(0).normal(size=(40, 2)))

    def value(points, normals):
        normals = normals / jnp.linalg.norm(normals, axis=1, keepdims=True)
        fitted = refit_normals(points, normals, neighbors, degree=4, iterations=1)
        return jnp.vdot(weights, fitted) + jnp.sum(tangent_frames(fitted)[:, 0] ** 3)

    check_derivatives(value, points, normals + 0.05 * weights / 3)


def test_gradient_of_frames():
    normals = jnp.asarray(unit(np.random.default_rng(1).normal(size=(20, 3))))
    weights = jnp.asarray(np.random.default_rng(2).normal(size=(20, 3, 3)))

    def value(x):
        return jnp.vdot(weights, tangent_frames(x / jnp.linalg.norm(x, axis=1, keepdims=True)))

    check_derivatives(value, normals)


def test_single_precision_without_x64():
    """Refitted normals to 1e-5 at 1,000 points, with JAX as it comes."""
    x = fibonacci(1_000)
    with jax.enable_x64(False):
        cloud = from_points(x)
        neighbors = find_neighbors(cloud, 45)
        refitted = refit_normals(cloud.points, cloud.normals, neighbors, degree=4)
        assert refitted.dtype == cloud.normals.dtype == jnp.float32
    assert angle(cloud.normals, x) < 2e-5
    assert angle(refitted, x) < 2e-5


def saddle(n=15):
    a = np.linspace(-1, 1, n)
    x, y = (g.ravel() for g in np.meshgrid(a, a))
    return np.stack([x, y, 0.3 * (x * x - y * y)], axis=1)


def helicoid(n=15):
    s, t = (g.ravel() for g in np.meshgrid(np.linspace(-1, 1, n), np.linspace(-3, 3, 3 * n)))
    return np.stack([s * np.cos(t), s * np.sin(t), t], axis=1)


@pytest.mark.parametrize("make", [saddle, helicoid, lambda: fibonacci(200)])
def test_signs_do_not_hang_on_the_last_bit(make):
    """Sheets that enclose nothing, and lattices full of ties: changed by 1e-15, and reordered."""
    points, rng = make(), np.random.default_rng(0)
    normals = np.asarray(estimate_normals(points, degree=2))
    for _ in range(4):
        moved = points * (1 + 1e-15 * rng.normal(size=points.shape))
        assert angle(estimate_normals(moved, degree=2), normals) < 1e-9
        # Of neighbours at the same distance those with the lower numbers are taken.
        order = rng.permutation(len(points))
        assert angle(estimate_normals(moved[order], degree=2), normals[order]) < 1e-3
