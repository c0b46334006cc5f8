"""One measurement per function; each runs in a process of its own, so that its memory counts."""

from __future__ import annotations

import os
import time
from concurrent.futures import ThreadPoolExecutor

import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse

import jaxsurf as js

from ..data import bunny
from ..report import relative_l2
from .baselines import numpy_gfdm, plain_jax_gfdm
from .timing import first_and_median, peak_gib, side_by_side

METHODS = {
    "GFDM(degree=2)": (js.GFDM(degree=2), 20),
    "GFDM(degree=4)": (js.GFDM(degree=4), 37),
    "DCPSE(order=2)": (js.DCPSE(order=2), 26),
    "DCPSE(order=4)": (js.DCPSE(order=4), 47),
}


def sphere(n: int, k: int):
    cloud = js.sphere(n)
    return cloud, js.find_neighbors(cloud, k=k, throw=False)


def laplacian(cloud, neighbors, method):
    return js.laplace_beltrami(cloud, neighbors, method=method, throw=False)


def bandwidth() -> dict:
    """Memory bandwidth: two threads, each adding two arrays of 128 MiB into a third in place."""
    arrays = [[np.ones(2**24) for _ in range(3)] for _ in range(2)]
    with ThreadPoolExecutor(2) as pool:
        add = lambda trio: np.add(trio[0], trio[1], out=trio[2])
        _, seconds = first_and_median(lambda: list(pool.map(add, arrays)))
    return {"GB/s": sum(a.nbytes for trio in arrays for a in trio) / seconds / 1e9}


def apply(n: int, k: int) -> dict:
    """Applying a Laplacian, beside the product with SciPy's CSR matrix and the bandwidth."""
    cloud, neighbors = sphere(n, k)
    operator = laplacian(cloud, neighbors, js.GFDM(degree=2))
    # All k entries of a row, as the operator has them; those beyond the support are zero, and
    # SciPy is also shown without them.
    columns, data = (np.asarray(a).T.ravel() for a in (operator.indices, operator.weights))
    matrix = scipy.sparse.csr_matrix((data, columns, k * np.arange(n + 1)), shape=(n, n))
    trimmed = operator.to_scipy()
    u = jnp.sin(cloud.points @ jnp.array([1.0, 2.0, 1.5]))
    u_host = np.asarray(u)
    call = jax.jit(lambda operator, u: operator(u))
    ours, scipys, ratio = side_by_side(
        lambda: call(operator, u), lambda: matrix @ u_host, 15, calls=10
    )
    _, without_zeros, _ = side_by_side(
        lambda: call(operator, u), lambda: trimmed @ u_host, 15, calls=10
    )
    np.testing.assert_allclose(call(operator, u), matrix @ u_host, atol=1e-6)
    moved = operator.weights.nbytes + operator.indices.nbytes + 2 * u.nbytes
    rate = moved / ours / 1e9
    return {"ours ms": 1e3 * ours, "SciPy CSR ms": 1e3 * scipys, "ratio": ratio,
            "SciPy without zeros ms": 1e3 * without_zeros,
            "GB/s": rate, "share of bandwidth": rate / bandwidth()["GB/s"]}  # fmt: skip


def build(name: str, n: int) -> dict:
    """Building the Laplacian for given neighbours; the first call compiles."""
    method, k = METHODS[name]
    cloud, neighbors = sphere(n, k)
    before = peak_gib()
    first, seconds = first_and_median(
        lambda: laplacian(cloud, neighbors, method).weights, 3 if n > 2e5 else 5
    )
    return {"build s": seconds, "first call s": first - seconds,
            "peak GiB": peak_gib(), "GiB before": before}  # fmt: skip


def scan_beside_sphere(name: str, n: int) -> dict:
    """The bunny's stencils with the lists chosen for it, beside those of a sphere, in turn."""
    method, _ = METHODS[name]
    clouds = bunny(n), js.sphere(n)
    lists = [js.choose_neighbors(cloud, method=method) for cloud in clouds]
    operators = [laplacian(*both, method) for both in zip(clouds, lists)]
    u = [jnp.sin(cloud.points @ jnp.array([1.0, 2.0, 1.5])) for cloud in clouds]

    def total(points, cloud, neighbors, u):
        cloud = js.PointCloud(points, cloud.normals)
        return jnp.sum(laplacian(cloud, neighbors, method)(u) ** 2)

    apply, slope = jax.jit(lambda operator, u: operator(u)), jax.jit(jax.grad(total))
    transposed = [operator.T for operator in operators]
    calls = {
        "build": lambda i: laplacian(clouds[i], lists[i], method).weights,
        "apply": lambda i: apply(operators[i], u[i]),
        "apply transposed": lambda i: apply(transposed[i], u[i]),
        "gradient": lambda i: slope(clouds[i].points, clouds[i], lists[i], u[i]),
    }
    beside = lambda call: side_by_side(lambda: call(0), lambda: call(1))[2]
    return {what: beside(call) for what, call in calls.items()}


def build_beside_numpy(degree: int, k: int, n: int) -> dict:
    """The same GFDM stencil by batched NumPy, all points at once and in blocks, in turn."""
    cloud, neighbors = sphere(n, k)
    points, normals, index = (
        np.asarray(a) for a in (cloud.points, cloud.normals, neighbors.indices)
    )
    ours = lambda: laplacian(cloud, neighbors, js.GFDM(degree=degree)).weights
    expected = numpy_gfdm(points, normals, index, degree)
    np.testing.assert_allclose(ours().T, expected, rtol=1e-6, atol=1e-8 * np.abs(expected).max())
    found = {}
    for name, block in (("NumPy", n), ("NumPy in blocks", 1024)):
        seconds, theirs, ratio = side_by_side(
            ours, lambda block=block: numpy_gfdm(points, normals, index, degree, block), 7
        )
        found |= {"ours s": seconds, f"{name} s": theirs, f"{name} / ours": 1 / ratio}
    return found


def build_beside_compadre(degree: int, threads: int, n: int) -> dict:
    """GFDM and DC-PSE beside Compadre's moving least squares on manifolds, in turn, in one process.

    Compadre is given its usual window of 1.6 times the distance to as many points as it has
    unknowns; it fits its own frames and searches its own neighbours, neither of which is timed.

    Args:
        threads: that Compadre may use.
    """
    os.environ["OMP_NUM_THREADS"] = str(threads)
    import pycompadre

    points = np.array(js.sphere(n).points)  # Compadre wants to be able to write
    a = np.array([1.0, 2.0, 1.5])
    s = points @ a
    u, exact = np.exp(s), np.exp(s) * (a @ a - s**2 - 2 * s)
    kokkos = pycompadre.KokkosParser()
    target = pycompadre.TargetOperation.LaplacianOfScalarPointEvaluation
    gmls = pycompadre.GMLS(degree, 3, "QR", "MANIFOLD", "NO_CONSTRAINT", degree)
    gmls.setWeightingParameter(3)
    gmls.setWeightingType("power")
    helper = pycompadre.ParticleHelper(gmls)
    helper.generateKDTree(points)
    gmls.addTargets(target)
    helper.generateNeighborListsFromKNNSearchAndSet(points, degree, 2, 1.6)
    values = jnp.asarray(u)

    def beside(name: str) -> dict:
        method, k = METHODS[name]
        cloud, neighbors = sphere(n, k)
        ours = lambda: laplacian(cloud, neighbors, method)
        seconds, theirs, ratio = side_by_side(
            lambda: ours().weights, lambda: gmls.generateAlphas(1, False), 3
        )
        operator, call = ours(), jax.jit(lambda operator, u: operator(u))
        their_values = lambda: helper.applyStencil(u[:, None], target)
        *_, apply_ratio = side_by_side(lambda: call(operator, values), their_values, 5)
        return {
            "ours s": seconds, "Compadre s": theirs, "ours / Compadre": ratio,
            "applying, ours / Compadre": apply_ratio,
            "error": relative_l2(operator(values), exact),
            "Compadre error": relative_l2(np.ravel(their_values()), exact),
        }  # fmt: skip

    found = {name: beside(name) for name in (f"GFDM(degree={degree})", f"DCPSE(order={degree})")}
    gmls = helper = None  # let go in this order, as Compadre asks for
    del kokkos
    return found


def build_beside_plain_jax(n: int) -> dict:
    """GFDM of degree 2 in a few lines of plain JAX: building, and the gradient in the points."""
    cloud, neighbors = sphere(n, 20)
    u = jnp.sin(cloud.points @ jnp.array([1.0, 2.0, 1.5]))
    index = neighbors.indices

    def total_ours(x):
        cloud_x = js.PointCloud(x, cloud.normals)
        return jnp.sum(laplacian(cloud_x, neighbors, js.GFDM(degree=2))(u) ** 2)

    def total_plain(x):
        weights = plain_jax_gfdm(x, cloud.normals, index, 2)
        return jnp.sum(jnp.sum(weights * u[index], axis=1) ** 2)

    plain = jax.jit(lambda: plain_jax_gfdm(cloud.points, cloud.normals, index, 2))
    build_ours, build_plain, _ = side_by_side(
        lambda: laplacian(cloud, neighbors, js.GFDM(degree=2)).weights, plain, 5
    )
    ours, theirs = (jax.jit(jax.grad(f)) for f in (total_ours, total_plain))
    grad_ours, grad_plain, _ = side_by_side(
        lambda: ours(cloud.points), lambda: theirs(cloud.points), 5
    )
    return {"ours s": build_ours, "plain JAX s": build_plain,
            "gradient ours s": grad_ours, "gradient plain JAX s": grad_plain}  # fmt: skip


def gradient(name: str, n: int, reverse: bool) -> dict:
    """A scalar of the operator, or its gradient in points and normals."""
    method, k = METHODS[name]
    cloud, neighbors = sphere(n, k)
    u = jnp.sin(cloud.points @ jnp.array([1.0, 2.0, 1.5]))

    def total(points, normals):
        operator = laplacian(js.PointCloud(points, normals), neighbors, method)
        return jnp.sum(operator(u) ** 2)

    f = jax.jit(jax.grad(total, argnums=(0, 1)) if reverse else total)
    before = peak_gib()
    start = time.perf_counter()
    compiled = f.lower(cloud.points, cloud.normals).compile()
    compile_seconds = time.perf_counter() - start
    memory = compiled.memory_analysis()
    _, seconds = first_and_median(lambda: compiled(cloud.points, cloud.normals), 5)
    return {"s": seconds, "compile s": compile_seconds, "peak GiB": peak_gib(),
            "GiB before": before, "temporary MiB": memory.temp_size_in_bytes / 2**20}  # fmt: skip


def retraces() -> dict:
    """How often two calls of the same shape trace the operator."""
    cloud, neighbors = sphere(2000, 26)
    count = 0

    @jax.jit
    def apply(points):
        nonlocal count
        count += 1
        return laplacian(js.PointCloud(points, cloud.normals), neighbors, js.DCPSE())(points)

    apply(cloud.points)
    apply(1.1 * cloud.points)
    return {"traces": count}
