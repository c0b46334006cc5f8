r"""Curvature from the shape tensor $\nabla_S n$, the surface gradient of the normals.

Signs: on the unit sphere with outward normals the principal curvatures are +1.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .arguments import as_many, count_on, instance, switched_off
from .cloud import PointCloud
from .compiling import sized_jit
from .frames import frames_of
from .neighbors import Neighbors, switched_on
from .operators import laplace_beltrami, surface_gradient
from .stencils.method import AbstractMethod
from .stencils.usual import USUAL


def shape_tensor(
    cloud: PointCloud,
    neighbors: Neighbors | None = None,
    *,
    method: AbstractMethod = USUAL,
) -> Float[Array, "n d d"]:
    r"""Shape tensor $\nabla_S n$ in the coordinates of space (Singh et al. 2023, Section 4.3).

    It is symmetric and maps normals to zero; the discrete one is made so.

    Args:
        cloud: n points in d dimensions with unit normals.
        neighbors: from `find_neighbors`; chosen by `choose_neighbors` if None (not under `jit`).
        method: how derivatives are computed.

    Returns:
        One tensor per point, `(n, d, d)`, in units of 1 / length.

    Accuracy: that of `surface_gradient` for exact normals (`tests/test_curvature.py`). In float32
    values are within 2e-4 of the largest on 200 points, gradients in the points within 1 %
    (`tests/test_forms.py`).
    Differentiable: forward and reverse, in points and normals, for fixed neighbours.
    Raises:
        ValueError: as `surface_gradient`.

    Example:
        >>> cloud = js.sphere(300, radius=2.0)
        >>> normal = cloud.normals[0]
        >>> tangent = jnp.eye(3) - jnp.outer(normal, normal)
        >>> bool(jnp.abs(js.shape_tensor(cloud)[0] - 0.5 * tangent).max() < 0.02)
        True
    """
    return tensor_of(surface_gradient(cloud, neighbors, method=method), cloud.normals)


@sized_jit
def tensor_of(gradient, n):
    """The shape tensor: the gradient of the normals, made symmetric and tangential."""
    n = switched_off(gradient.active, n)
    tensor = gradient(n)
    project = jnp.eye(n.shape[1], dtype=n.dtype) - n[:, :, None] * n[:, None]
    tensor = jnp.einsum("nab,nbc,ncd->nad", project, tensor, project)
    return (tensor + tensor.mT) / 2


def mean_curvature(
    cloud: PointCloud,
    neighbors: Neighbors | None = None,
    *,
    method: AbstractMethod = USUAL,
) -> Float[Array, " n"]:
    r"""Mean curvature $H = \tfrac{1}{d-1} \nabla_S\cdot n$: half the trace of the shape tensor.

    For curves in the plane (d = 2) it is their curvature.

    Args:
        cloud, neighbors, method: as for `shape_tensor`.

    Returns:
        `(n,)`, in units of 1 / length; +1 on the unit sphere with outward normals.

    Accuracy: that of `surface_gradient` for exact normals (`tests/test_curvature.py`). In float32
    values are within 2e-4 of the largest on 200 points, gradients in the points within 1 %
    (`tests/test_forms.py`).
    Differentiable: forward and reverse, in points and normals, for fixed neighbours.
    Raises:
        ValueError: as `surface_gradient`.

    Example:
        >>> bool(jnp.abs(js.mean_curvature(js.sphere(2_000, radius=2.0)) - 0.5).max() < 0.01)
        True
    """
    return mean_of(shape_tensor(cloud, neighbors, method=method))


@jax.jit
def mean_of(tensor):
    """Mean curvature from the shape tensor."""
    return jnp.trace(tensor, axis1=1, axis2=2) / (tensor.shape[1] - 1)


def gauss_curvature(
    cloud: PointCloud,
    neighbors: Neighbors | None = None,
    *,
    method: AbstractMethod = USUAL,
) -> Float[Array, " n"]:
    r"""Gauss curvature, the product of the principal curvatures.

    Args:
        cloud, neighbors, method: as for `shape_tensor`, d = 3.

    Returns:
        `(n,)`, in units of 1 / length².

    Accuracy: that of `surface_gradient` for exact normals (`tests/test_curvature.py`). In float32
    values are within 2e-4 of the largest on 200 points, gradients in the points within 1 %
    (`tests/test_forms.py`).
    Differentiable: forward and reverse, in points and normals, for fixed neighbours.
    Raises:
        ValueError: as `surface_gradient`; a curve.

    Example:
        >>> bool(jnp.abs(js.gauss_curvature(js.sphere(300, radius=2.0)) - 0.25).max() < 0.02)
        True
    """
    return gauss_of(_in_tangent_plane(cloud, neighbors, method)[0])


@jax.jit
def gauss_of(a):
    """Gauss curvature from the shape tensor along two tangents."""
    return a[:, 0, 0] * a[:, 1, 1] - a[:, 0, 1] ** 2


def principal_curvatures(
    cloud: PointCloud,
    neighbors: Neighbors | None = None,
    *,
    method: AbstractMethod = USUAL,
) -> tuple[Float[Array, "n 2"], Float[Array, "n 2 3"]]:
    r"""Principal curvatures and directions: eigenvalues and eigenvectors of the shape tensor.

    Args:
        cloud, neighbors, method: as for `shape_tensor`, d = 3.

    Returns:
        The curvatures, smaller first, `(n, 2)`, and the unit directions, one per row,
        `(n, 2, 3)`, with $t_1 \times t_2 = n$.

    Accuracy: curvatures as `mean_curvature`; directions lose accuracy near umbilics, where
    they are not defined. In float32 values are within 2e-4 of the largest on 200 points, gradients
    in the points within 1 % (`tests/test_forms.py`).
    Differentiable: away from umbilics (at equal curvatures the derivative is taken as that of
    the mean curvature).
    Raises:
        ValueError: as `surface_gradient`; a curve.

    Example:
        >>> values, directions = js.principal_curvatures(js.sphere(300, radius=2.0))
        >>> bool(jnp.abs(values - 0.5).max() < 0.02), directions.shape
        (True, (300, 2, 3))
    """
    return principal_of(*_in_tangent_plane(cloud, neighbors, method))


@jax.jit
def principal_of(a, tangents):
    """Principal curvatures and directions from the shape tensor along two tangents."""
    mean, half = (a[:, 0, 0] + a[:, 1, 1]) / 2, (a[:, 0, 0] - a[:, 1, 1]) / 2
    square = half**2 + a[:, 0, 1] ** 2
    umbilic = square == 0
    radius = jnp.where(umbilic, 0, jnp.sqrt(jnp.where(umbilic, 1, square)))
    # Twice the angle from t1 to the direction of the larger curvature.
    angle = jnp.arctan2(a[:, 0, 1], jnp.where(umbilic, 1, half)) / 2
    c, s = jnp.cos(angle)[:, None], jnp.sin(angle)[:, None]
    t1, t2 = tangents[:, 0], tangents[:, 1]
    directions = jnp.stack([s * t1 - c * t2, c * t1 + s * t2], axis=1)
    return jnp.stack([mean - radius, mean + radius], axis=1), directions


def mean_curvature_vector(
    cloud: PointCloud,
    neighbors: Neighbors | None = None,
    *,
    method: AbstractMethod = USUAL,
) -> Float[Array, "n d"]:
    r"""Mean curvature vector $\Delta_S x = -(d-1) H n$, the Laplacian of the positions.

    Args:
        cloud, neighbors, method: as for `shape_tensor`.

    Returns:
        `(n, d)`, in units of 1 / length; it points to the inside of a sphere.

    Accuracy: that of `laplace_beltrami`. In float32 values are within 2e-4 of the largest on 200
    points, gradients in the points within 1 % (`tests/test_forms.py`).
    Differentiable: forward and reverse, in points and normals, for fixed neighbours.
    Raises:
        ValueError: as `laplace_beltrami`.

    Example:
        >>> cloud = js.sphere(300)
        >>> bool(jnp.abs(js.mean_curvature_vector(cloud) + 2 * cloud.normals).max() < 0.1)
        True
    """
    instance(cloud, PointCloud, "cloud")
    return laplace_beltrami(cloud, neighbors, method=method)(_centred(cloud.points, cloud.active))


@jax.jit
def _centred(points, active):
    return points - switched_off(active, points).sum(0) / count_on(active, len(points))


def _in_tangent_plane(cloud, neighbors, method):
    instance(cloud, PointCloud, "cloud")
    check_surface(cloud)
    return along_tangents(shape_tensor(cloud, neighbors, method=method), cloud)


def check_surface(cloud: PointCloud) -> None:
    """Refuse plane curves."""
    if cloud.dim != 3:
        raise ValueError(f"a surface in 3 dimensions is needed, the cloud has {cloud.dim}")


@jax.jit
def along_tangents(tensor, cloud):
    """The shape tensor as a symmetric 2 x 2 matrix, and the tangents that it refers to."""
    tangents = switched_off(cloud.active, frames_of(cloud.seen.normals)[:, :2])
    return jnp.einsum("nap,npq,nbq->nab", tangents, tensor, tangents), tangents


def tube_ratio(cloud: PointCloud, neighbors: Neighbors) -> Float[Array, " n"]:
    r"""Largest normal curvature that each point sees among its neighbours.

    $\max_j |(x_j-x_i)\cdot(n_j-n_i)|\,/\,|x_j-x_i|^2$. Times the radius of the support it says
    how far the surface bends within one stencil: above 1 the lines along the normals meet
    within the support, and points copied along them land among each other.

    Args:
        cloud: n points with unit normals.
        neighbors: which points to compare with.

    Returns:
        One number per point, `(n,)`, in 1 / length; 0 for a point without neighbours.

    Accuracy: in float32 within 2e-4 of the largest on 200 points (`tests/test_forms.py`).
    Differentiable: forward and reverse, in points and normals, for fixed neighbours.

    Example:
        >>> angle = 2 * jnp.pi * jnp.arange(50) / 50
        >>> circle = jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=1)
        >>> cloud = js.PointCloud(2 * circle, circle)
        >>> float(js.tube_ratio(cloud, js.find_neighbors(cloud, k=5)).max().round(6))
        0.5
    """

    instance(cloud, PointCloud, "cloud")
    instance(neighbors, Neighbors, "neighbors", "see find_neighbors")
    as_many("neighbors", neighbors.n, "the cloud", cloud.n)
    cloud, neighbors = cloud.seen, switched_on(cloud, neighbors)
    return _bend(cloud.points, cloud.normals, neighbors.indices.T, neighbors.mask.T)


@jax.jit
def _bend(points, normals, slots, masks):
    # One column of neighbours at a time: nothing of size (n, k, d) is stored.
    def bend(column):
        slot, mask = column
        d = points[slot] - points
        squared = jnp.sum(d * d, axis=1)
        used = mask & (squared > 0)
        turn = jnp.sum(d * (normals[slot] - normals), axis=1)
        return jnp.where(used, jnp.abs(turn) / jnp.where(used, squared, 1), 0)

    return jnp.max(jax.lax.map(bend, (slots, masks)), axis=0)


def expected_error(cloud: PointCloud, laplacian, mean) -> Float[Array, ""]:
    r"""$\|\Delta_S x + (d - 1) H n\|$ of all points over $\|(d - 1) H n\|$."""
    on, cloud = cloud.active, cloud.seen
    bent = (cloud.dim - 1) * mean[:, None] * cloud.normals
    norm = lambda v: jnp.sqrt(jnp.sum(switched_off(on, v) ** 2))
    # A plane has no curvature: there round-off is told in units of the size.
    least = norm(jnp.ones_like(cloud.points[:, 0]) / jnp.ptp(cloud.points))
    return norm(laplacian(cloud.points) + bent) / jnp.maximum(norm(bent), least)
