"""No answer hangs on the last bit of its input or on the order of a sum.

Every function is given points and fields, the same with a relative perturbation of 1e-15, and
the same in another order; answers agree to a tolerance set by how its error is amplified, far
below the error of the discretisation.
"""

import functools

import jax.numpy as jnp
import numpy as np
import pytest

import jaxsurf as js

from .helpers import jittered_sphere, random_sphere
from .test_meshes import ball_mesh

N = 300
ORDER = np.random.default_rng(7).permutation(N)


def lattice():
    """A square of points, of which many are at the same distance from each other."""
    x, y = np.meshgrid(np.arange(20.0), np.arange(15.0))
    points = np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], axis=1) / 10
    return js.PointCloud(points, np.tile([0.0, 0.0, 1.0], (N, 1)))


CLOUDS = {"jittered": jittered_sphere(N), "random": random_sphere(N), "lattice": lattice()}


@functools.cache
def variant(name: str, which: str) -> js.PointCloud:
    cloud = CLOUDS[name]
    points, normals = np.asarray(cloud.points), np.asarray(cloud.normals)
    if which == "permuted":
        return js.PointCloud(points[ORDER], normals[ORDER])
    if which.startswith("perturbed"):
        rng = np.random.default_rng(int(which[-1]))
        shaken = lambda a: a * (1 + 1e-15 * rng.uniform(-1, 1, size=a.shape))
        return js.PointCloud(shaken(points), shaken(normals))
    return cloud


METHODS = {"dcpse": js.DCPSE(order=2), "gfdm": js.GFDM(degree=2)}


@functools.cache
def neighbors(name: str, which: str, method: str) -> js.Neighbors:
    return js.choose_neighbors(variant(name, which), method=METHODS[method])


def field(points):
    return jnp.exp(points @ jnp.array([1.0, 2.0, 1.5]) / 2)


def smooth(points):
    return jnp.sin(points[:, 0] + 2 * points[:, 1] - points[:, 2])


class Problem:
    """A variant of a cloud, its lists and operators."""

    def __init__(self, name, which, method):
        self.cloud = variant(name, which)
        self.method = METHODS[method]
        self.given = dict(neighbors=neighbors(name, which, method), method=self.method)
        self.u = field(self.cloud.points)

    @functools.cached_property
    def laplacian(self):
        return js.laplace_beltrami(self.cloud, **self.given)

    @functools.cached_property
    def conditions(self):
        """Values are given in a cap, or along a side of the square."""
        at = self.cloud.points[:, 0] > 0.85 * float(self.cloud.points[:, 0].max())
        value = smooth(self.cloud.points)[at]
        return js.eliminate(self.cloud, [js.dirichlet(at, value)], **self.given)


@functools.cache
def problem(name, which, method):
    return Problem(name, which, method)


def tensor(cloud):
    a = jnp.array([[2.0, 0.5, 0.0], [0.5, 1.0, 0.3], [0.0, 0.3, 1.5]])
    return jnp.broadcast_to(a, (N, 3, 3)) * (2 + cloud.points[:, 0])[:, None, None]


ALONG = jnp.array([0.0, 0.0, 1.0])


def heat(p, **solver):
    equation = js.AdvectionDiffusionReaction(p.laplacian, diffusivity=0.1)
    return js.integrate(equation, smooth(p.cloud.points), t1=0.1, **solver).ys[-1]


def listed(p):
    """Which points are neighbours, as a matrix."""
    near = np.zeros((N, N))
    found = p.given["neighbors"]
    rows = np.broadcast_to(np.arange(N)[:, None], found.indices.shape)
    near[rows[found.mask], np.asarray(found.indices)[found.mask]] = 1
    return near


# Functions of a problem with a value for every point, the clouds that they are tried on, and how
# far answers may be apart, as a share of the largest.
EVEN, UNEVEN = ("jittered", "gfdm"), [("random", "dcpse"), ("lattice", "gfdm")]
POINTWISE = {
    "laplace_beltrami": (lambda p: p.laplacian(p.u), UNEVEN, 1e-11),
    "surface_gradient": (lambda p: js.surface_gradient(p.cloud, **p.given)(p.u), UNEVEN, 1e-12),
    "surface_divergence": (
        lambda p: js.surface_divergence(p.cloud, **p.given)(p.cloud.points * p.u[:, None]),
        UNEVEN,
        1e-12,
    ),
    "directional_derivative": (
        lambda p: js.directional_derivative(p.cloud, p.cloud.points[:, ::-1], **p.given)(p.u),
        UNEVEN,
        1e-12,
    ),
    "diffusion": (lambda p: js.diffusion(p.cloud, 1 + p.u, **p.given)(p.u), UNEVEN, 1e-11),
    "diffusion, tensor": (
        lambda p: js.diffusion(p.cloud, tensor(p.cloud), **p.given)(p.u),
        UNEVEN,
        1e-11,
    ),
    "biharmonic": (lambda p: js.biharmonic(p.cloud, **p.given)(p.u), UNEVEN, 1e-9),
    "partial_derivative": (
        lambda p: js.partial_derivative(p.cloud.points[:, :2], (2, 0))(p.u),
        UNEVEN[1:],
        1e-10,
    ),
    "mean_curvature": (lambda p: js.mean_curvature(p.cloud, **p.given), UNEVEN[:1], 1e-12),
    "gauss_curvature": (lambda p: js.gauss_curvature(p.cloud, **p.given), UNEVEN[:1], 1e-12),
    "mean_curvature_vector": (
        lambda p: js.mean_curvature_vector(p.cloud, **p.given),
        UNEVEN[:1],
        1e-11,
    ),
    "refit_normals": (
        lambda p: js.refit_normals(p.cloud.points, p.cloud.normals, p.given["neighbors"], degree=2),
        UNEVEN[:1],
        1e-11,
    ),
    "estimate_normals": (
        lambda p: js.estimate_normals(p.cloud.points, degree=2),
        [EVEN, *UNEVEN],
        1e-11,
    ),
    "detect_boundary": (lambda p: js.detect_boundary(p.cloud).astype(float), UNEVEN, 0),
    "eliminate": (lambda p: p.conditions(smooth(p.cloud.points) * p.u), [EVEN, *UNEVEN], 1e-12),
    "solve": (
        lambda p: (
            js.solve(p.laplacian, smooth(p.cloud.points), closure=p.conditions, rtol=1e-12).value
        ),
        [EVEN],
        1e-10,
    ),
    "geodesic_distance": (
        lambda p: js.geodesic_distance(p.cloud, jnp.argmax(p.u)[None], **p.given),
        [EVEN],
        1e-10,
    ),
    "areas": (
        lambda p: js.discretize(p.cloud, p.given["neighbors"], method=p.method).areas,
        [EVEN],
        1e-11,
    ),
    "conservative_weights": (lambda p: js.conservative_weights(p.laplacian, 1.0), [EVEN], 1e-9),
    "upwind_viscosity": (
        lambda p: js.upwind_viscosity(p.cloud, jnp.cross(p.cloud.points, ALONG), **p.given)(p.u),
        UNEVEN[:1],
        1e-11,
    ),
    "solve_nonlinear": (
        lambda p: (
            js.solve_nonlinear(
                p.laplacian - 1, lambda u, args: -(u**3), 0 * p.u, rhs=-p.u, rtol=1e-11
            ).value
        ),
        [EVEN],
        1e-9,
    ),
    "RBFFD": (
        lambda p: js.laplace_beltrami(p.cloud, p.given["neighbors"], method=js.RBFFD(degree=2))(
            p.u
        ),
        UNEVEN[:1],
        1e-10,
    ),
    "GFDM(degree=4)": (
        lambda p: js.laplace_beltrami(p.cloud, method=js.GFDM(degree=4))(p.u),
        [EVEN],
        1e-10,
    ),
    "integrate, by default": (heat, [EVEN], 1e-12),
    "integrate, implicit": (lambda p: heat(p, solver=js.SDIRK()), [EVEN], 1e-8),
}
# Functions with one value for all points, in units of the operator.
VALUES = {
    "spectral_estimate": (
        lambda p: jnp.array(js.spectral_estimate(p.laplacian)[:2]),
        [EVEN, *UNEVEN[:1]],
        1e-2,
    ),
    "abscissa": (
        lambda p: jnp.array(
            [100 + js.spectral_estimate(p.laplacian + (p.u - p.u.mean())).abscissa]
        ),
        [EVEN, *UNEVEN[:1]],
        1e-9,
    ),
    "eigenmodes": (
        lambda p: js.eigenmodes(p.laplacian, 6, closure=p.conditions).values,
        [EVEN],
        1e-10,
    ),
}
OTHERS = ["perturbed 1", "perturbed 2", "permuted"]


def cases(table):
    return [
        pytest.param(function, *place, bound, id=f"{name}: {place[0]}")
        for name, (function, places, bound) in table.items()
        for place in places
    ]


def apart(one, two):
    return np.abs(one - two).max() / (np.abs(one).max() or 1)


@pytest.mark.parametrize("function,cloud,method,bound", cases(POINTWISE))
def test_values_at_points(function, cloud, method, bound):
    plain, *others = (
        np.asarray(function(problem(cloud, which, method))) for which in ("plain", *OTHERS)
    )
    found = [apart(plain, other) for other in others[:2]] + [apart(plain[ORDER], others[2])]
    assert max(found) <= bound, found


@pytest.mark.parametrize("function,cloud,method,bound", cases(VALUES))
def test_values_of_the_whole(function, cloud, method, bound):
    plain, *others = (
        np.asarray(function(problem(cloud, which, method))) for which in ("plain", *OTHERS)
    )
    found = [apart(plain, other) for other in others]
    assert max(found) <= bound, found


@pytest.mark.parametrize("cloud,method", [EVEN, *UNEVEN[:1]])
def test_neighbors(cloud, method):
    """The same lists; on the lattice ties may fall otherwise, with weights that vanish there."""
    plain, *others = (listed(problem(cloud, which, method)) for which in ("plain", *OTHERS))
    for other in others[:2]:
        np.testing.assert_array_equal(plain, other)
    np.testing.assert_array_equal(plain[ORDER][:, ORDER], others[2])


@pytest.mark.parametrize("cloud", CLOUDS)
def test_search_on_the_device(cloud):
    """No two points of these are as far apart as the radius."""

    def found(which):
        points = variant(cloud, which).points
        capacity = js.allocate_search(points, 0.25)
        lists = js.search_neighbors(points, radius=0.25, capacity=capacity)[0]
        near = np.zeros((N, N), bool)
        np.add.at(near, (np.nonzero(lists.mask)[0], lists.indices[lists.mask]), True)
        return near

    plain, *others = map(found, ("plain", *OTHERS))
    assert plain.sum() > 3 * N
    for other in others[:2]:
        np.testing.assert_array_equal(plain, other)
    np.testing.assert_array_equal(plain[ORDER][:, ORDER], others[2])


@pytest.mark.parametrize("seed", [1, 2])
def test_sampling(seed):
    """The same points of level sets and Poisson disks, in the same order."""
    shift = 1 + 1e-15 * seed

    def egg(factor):
        phi = lambda x: factor * (x[0] ** 2 + 2 * x[1] ** 2 + x[2] ** 2 * (1.2 + 0.2 * x[0]) - 1)
        box = ((-1.5,) * 3, (1.5,) * 3)
        return np.asarray(js.level_set(phi, bounds=box, n=150, resolution=16).points)

    np.testing.assert_allclose(egg(shift), egg(1.0), atol=1e-9)
    candidates = np.asarray(random_sphere(2_000).points)
    chosen = [js.poisson_disk(a, 0.3) for a in (candidates, candidates * shift)]
    np.testing.assert_array_equal(*chosen)
    mesh = ball_mesh(300, axes=(1, 0.8, 0.6))
    shifted = js.TriangleMesh(mesh.vertices * shift, mesh.triangles)
    clouds = [js.sample_mesh(part, n=200) for part in (mesh, shifted)]
    np.testing.assert_allclose(*(cloud.points for cloud in clouds), atol=1e-9)
