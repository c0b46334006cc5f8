r"""Differential operators on point clouds: on surfaces, and in flat space."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .arguments import POINTS, as_float, finite, instance, switched_off, whole
from .build import build
from .cloud import PointCloud
from .failures import is_concrete, refuse, without_derivatives
from .neighbors import Neighbors, find_neighbors
from .stencils.algebra import Composition
from .stencils.dcpse import FlatDCPSE
from .stencils.gathers import take
from .stencils.method import AbstractMethod
from .stencils.stencil import Stencil
from .stencils.targets import Gradient, Hessian, Laplacian, Partial
from .stencils.usual import USUAL


def laplace_beltrami(
    cloud: PointCloud,
    neighbors: Neighbors | None = None,
    *,
    method: AbstractMethod = USUAL,
    throw: bool = True,
) -> Stencil:
    r"""Laplace–Beltrami operator of a point-cloud surface.

    $(\Delta_S u)_i \approx \sum_j w_{ij}\,u_j$ with $\sum_j w_{ij} = 0$ (Singh et al. 2023,
    eq. 11; Suchde and Kuhnert 2019, eqs. 25 to 27).

    Args:
        cloud: n points in d dimensions with unit normals.
        neighbors: from `find_neighbors`; chosen by `choose_neighbors` if None (not under `jit`).
        method: how the weights are computed.
        throw: raise on a degenerate stencil; if False, see `Stencil.diagnostics`. Under `jit`,
            `vmap` and `grad` nothing is raised: the diagnostics are the result code.

    Returns:
        Operator mapping `(n,)` or `(n, c)` fields to the same shape, in units of
        field / length². The eigenvalues of the surface's operator are real and ≤ 0; those of this
        one, which is not symmetric, approximate them, and a few of large size may come out with
        a positive real part where points are few or uneven: `js.spectral_estimate` tells.

    Accuracy: error $O(h^r)$ for `DCPSE(order=r)`, $O(h^{p-1})$ for `GFDM(degree=p)` and
    `RBFFD(degree=p)` (`tests/test_accuracy.py`). In float32 round-off is amplified by $1/h^2$: on
    200 points the values are within 2e-4 of the largest, gradients in the points within 1e-3
    (`tests/test_forms.py::test_single_precision`).
    Differentiable: forward and reverse, in points, normals and field, for fixed neighbours.
    Raises:
        TypeError: no cloud, neighbours or method.
        ValueError: fewer neighbours than basis functions (both numbers given), or a stencil
            whose conditions cannot be met (point, residual and count given).

    Example:
        >>> cloud = js.sphere(2_000)
        >>> z = cloud.points[:, 2]
        >>> bool(jnp.abs(js.laplace_beltrami(cloud)(z) + 2 * z).max() < 0.05)
        True
    """
    return build(cloud, neighbors, method, Laplacian(), throw)


def surface_gradient(
    cloud: PointCloud,
    neighbors: Neighbors | None = None,
    *,
    method: AbstractMethod = USUAL,
    throw: bool = True,
) -> Stencil:
    r"""Gradient along the surface, $\nabla_S u$, as a vector in space.

    (Singh et al. 2023, eqs. 9 and 11; Suchde and Kuhnert 2019, eqs. 16 to 21.)

    Args:
        cloud, neighbors, method, throw: as for `laplace_beltrami`.

    Returns:
        Operator mapping `(n, *c)` fields to `(n, *c, d)`, in units of field / length.

    Accuracy: error $O(h^r)$ for `DCPSE(order=r)`, $O(h^p)$ for `GFDM(degree=p)` and
    `RBFFD(degree=p)`; in float32 round-off is amplified by 1/h
    (`tests/test_forms.py::test_single_precision`). Values are then within 2e-4 of the largest on
    200 points, gradients in the points within 1 %.
    Differentiable: forward and reverse, in points, normals and field, for fixed neighbours.
    Raises:
        ValueError: as `laplace_beltrami`.

    Example:
        >>> cloud = js.sphere(2_000)
        >>> x, z = cloud.points, cloud.points[:, 2]
        >>> exact = jnp.array([0.0, 0.0, 1.0]) - z[:, None] * x
        >>> bool(jnp.abs(js.surface_gradient(cloud)(z) - exact).max() < 0.01)
        True
    """
    return build(cloud, neighbors, method, Gradient(), throw)


def surface_divergence(
    cloud: PointCloud,
    neighbors: Neighbors | None = None,
    *,
    method: AbstractMethod = USUAL,
    throw: bool = True,
) -> Stencil:
    r"""Divergence along the surface, $\nabla_S \cdot v = \sum_a (\nabla_S v_a)_a$.

    (Suchde and Kuhnert 2019, eq. 24.) A normal part of v contributes
    $(\nabla_S\cdot n)\,v\cdot n$, as on a moving surface.

    Args:
        cloud, neighbors, method, throw: as for `laplace_beltrami`.

    Returns:
        Operator mapping `(n, *c, d)` fields to `(n, *c)`, in units of field / length.

    Accuracy: as `surface_gradient`. In float32 values are within 2e-4 of the largest on 200 points,
    gradients in the points within 1 % (`tests/test_forms.py`).
    Differentiable: forward and reverse, in points, normals and field, for fixed neighbours.
    Raises:
        ValueError: as `laplace_beltrami`.

    Example:
        >>> cloud = js.sphere(2_000, radius=2.0)
        >>> bool(jnp.abs(js.surface_divergence(cloud)(cloud.normals) - 1).max() < 0.01)
        True
    """
    return divergence_of(build(cloud, neighbors, method, Gradient(), throw))


def divergence_of(gradient: Stencil) -> Stencil:
    """The divergence, which has the weights of the gradient."""
    return gradient.of_weights(gradient.weights, in_shape=gradient.out_shape)


def directional_derivative(
    cloud: PointCloud,
    direction: Float[Array, "*n d"],
    *,
    neighbors: Neighbors | None = None,
    method: AbstractMethod = USUAL,
    throw: bool = True,
) -> Stencil:
    r"""Derivative $a \cdot \nabla_S u$ along a vector field a; its normal part does not count.

    Args:
        direction: a, `(n, d)` or `(d,)`; its length scales the derivative.
        cloud, neighbors, method, throw: as for `laplace_beltrami`.

    Returns:
        Operator mapping `(n, *c)` fields to the same shape.

    Accuracy: as `surface_gradient`. In float32 values are within 2e-4 of the largest on 200 points,
    gradients in the points within 1 % (`tests/test_forms.py`).
    Differentiable: forward and reverse, in points, normals, direction and field.
    Raises:
        ValueError: as `laplace_beltrami`; a direction of the wrong shape or not finite.

    Example:
        >>> cloud = js.sphere(300)
        >>> x, y, z = cloud.points.T
        >>> spin = js.directional_derivative(cloud, jnp.stack([-y, x, 0 * z], axis=1))
        >>> bool(jnp.abs(spin(x) + y).max() < 0.05)
        True
    """
    instance(cloud, PointCloud, "cloud")
    _field(direction, (cloud.n, cloud.dim), "direction")
    return along(build(cloud, neighbors, method, Gradient(), throw), direction)


def along(gradient: Stencil, direction: Float[Array, "*n d"]) -> Stencil:
    """The derivative along a vector field, from the gradient."""
    direction = _field(direction, (gradient.n, *gradient.out_shape), "direction")
    direction = finite(direction, "direction", gradient.active).astype(gradient.weights.dtype)
    return gradient.of_weights(_along(switched_off(gradient.active, direction), gradient.weights))


def diffusion(
    cloud: PointCloud,
    diffusivity: Float[Array, "*n"],
    *,
    neighbors: Neighbors | None = None,
    method: AbstractMethod = USUAL,
    throw: bool = True,
) -> Stencil:
    r"""Diffusion in an inhomogeneous or anisotropic medium, $\nabla_S\cdot(D\,\nabla_S u)$.

    Written without derivatives of D: for a symmetric tensor,
    $\partial_a(D_{ab}\,\partial_b u) = \tfrac12\left(D_{ab}\,\partial_a\partial_b u +
    \partial_a\partial_b(D_{ab} u) - u\,\partial_a\partial_b D_{ab}\right)$, so that
    $w_{ij} = \tfrac12 \sum_{ab} (D_{ab,i} + D_{ab,j})\, h_{ab,ij}$ for $j \ne i$ with h the
    stencils of the second derivatives. For a scalar D these are the weights of the
    Laplacian times the mean of D, which inherit their signs.

    Args:
        diffusivity: D, scalar `(n,)` or symmetric tensor `(n, d, d)`, neither negative; of a
            tensor only the tangential part counts. Taken in the precision of the cloud.
        cloud, neighbors, method, throw: as for `laplace_beltrami`.

    Returns:
        Operator mapping `(n, *c)` fields to the same shape.

    Accuracy: the order of the Laplace–Beltrami operator of the same method. In float32 values are
    within 2e-4 of the largest on 200 points, gradients in the points within 1 %
    (`tests/test_forms.py`).
    Differentiable: forward and reverse, in points, normals, diffusivity and field.
    Raises:
        ValueError: as `laplace_beltrami`; a diffusivity of the wrong shape, or one that is not
            finite, negative, not symmetric or not positive semidefinite (point and number given;
            in compiled code when it runs).

    Example:
        >>> cloud = js.sphere(500)
        >>> z = cloud.points[:, 2]
        >>> bool(jnp.abs(js.diffusion(cloud, jnp.full(500, 3.0))(z) + 6 * z).max() < 0.5)
        True
    """
    instance(cloud, PointCloud, "cloud")
    d = _checked_diffusivity(diffusivity, cloud)
    scalar = d.ndim == 1
    stencil = build(cloud, neighbors, method, Laplacian() if scalar else Hessian(), throw)
    weigh = _scalar_weights if scalar else _tensor_weights
    d = switched_off(cloud.active, d.astype(stencil.weights.dtype))
    return stencil.of_weights(weigh(d, cloud.seen.normals, stencil.indices, stencil.weights))


def _checked_diffusivity(diffusivity, cloud) -> Float[Array, "*n"]:
    n, dim = cloud.points.shape
    d = as_float(diffusivity, "diffusivity", (n,), (n, dim, dim))
    finite(d, "diffusivity", cloud.active)
    seen, active = without_derivatives(d), cloud.active
    known = is_concrete(seen, active)
    xp: Any = np if known else jnp
    seen = seen if known else jax.lax.stop_gradient(d)
    values = xp.asarray(seen)
    if active is not None:
        values = xp.where(xp.reshape(active, (n, *[1] * (d.ndim - 1))), values, 0)
    if d.ndim == 1:
        text = "diffusivity of point {i} is {v}, expected at least 0"
        return refuse(d, ~(xp.isfinite(values) & (values >= 0)), text, values)
    slack = 1e3 * np.finfo(values.dtype).eps * xp.abs(values).max(axis=(1, 2))
    skew = xp.abs(values - values.swapaxes(1, 2)).max(axis=(1, 2))
    text = "diffusivity of point {i} is not symmetric: entries differ by {v:.3g}, expected 0"
    d = refuse(d, ~(skew <= slack), text, skew)
    least = xp.linalg.eigvalsh(values)[:, 0]
    text = "diffusivity of point {i} has the eigenvalue {v:.3g}, expected at least 0"
    return refuse(d, ~(least >= -slack), text, least)


@jax.jit
def _along(direction, weights):
    return sum(a * w for a, w in zip(direction.T, jnp.moveaxis(weights, 1, 0)))


@jax.jit
def _scalar_weights(d, _, indices, weights):
    return _closed(weights * (d + take(d, indices)) / 2)


@jax.jit
def _tensor_weights(d, normals, indices, weights):
    project = jnp.eye(len(normals.T), dtype=d.dtype) - normals[:, :, None] * normals[:, None]
    # Points last, and one entry at a time: nothing of size (k, n, d, d) is made but the stencils.
    d = jnp.einsum("nab,nbc,ncd->adn", project, (d + d.mT) / 2, project)
    entries = [(a, b) for a in range(len(d)) for b in range(len(d))]
    return _closed(
        sum((d[a, b] + take(d[a, b], indices)) / 2 * weights[:, a, b] for a, b in entries)
    )


def _closed(weights):
    """Rows that sum to zero, by the weight of the centre."""
    return weights.at[0].set(-jnp.sum(weights[1:], axis=0))


def biharmonic(
    cloud: PointCloud,
    neighbors: Neighbors | None = None,
    *,
    method: AbstractMethod = USUAL,
    throw: bool = True,
) -> Composition:
    r"""Bi-Laplacian $\Delta_S^2$, the Laplace–Beltrami operator applied twice.

    Args:
        cloud, neighbors, method, throw: as for `laplace_beltrami`.

    Returns:
        Operator mapping `(n, *c)` fields to the same shape, in units of field / length⁴.

    Accuracy: on scattered points two orders below the Laplacian's, as the error of the inner
    operator is differentiated twice; hence the higher default. In float32 round-off is amplified
    by $1/h^4$: 2e-3 of the largest value on 200 points.
    Differentiable: forward and reverse, in points, normals and field.
    Raises:
        ValueError: as `laplace_beltrami`.

    Example:
        >>> cloud = js.sphere(300)
        >>> z = cloud.points[:, 2]
        >>> bool(jnp.abs(js.biharmonic(cloud)(z) - 4 * z).max() < 1)
        True
    """
    laplacian = laplace_beltrami(cloud, neighbors, method=method, throw=throw)
    return laplacian @ laplacian


def partial_derivative(
    points: Float[Array, "n d"],
    alpha: tuple[int, ...],
    *,
    neighbors: Neighbors | None = None,
    method: FlatDCPSE = FlatDCPSE(order=2),
    throw: bool = True,
) -> Stencil:
    r"""A derivative $D^\alpha$ on scattered points of the plane or of space, by flat DC-PSE.

    (Singh et al. 2023, Section 2: eqs. 4 to 8.)

    Args:
        points: `(n, d)` with d = 2 or 3.
        alpha: how often to differentiate along each axis, for example `(2, 0)`.
        neighbors: from `find_neighbors`; the nearest ones that the method asks for if None.
        method: how the weights are computed.
        throw: raise on a degenerate stencil; if False, see `Stencil.diagnostics`.

    Returns:
        Operator mapping `(n, *c)` fields to the same shape, in units of
        field / length^|alpha|.

    Accuracy: error $O(h^r)$ in the interior and at borders (`tests/test_flat.py`). In float32
    within 1e-4 on 81 points, for values of size one (`tests/test_forms.py`).
    Differentiable: forward and reverse, in points and field, for fixed neighbours.
    Raises:
        ValueError: as `laplace_beltrami`; an alpha that is no multi-index of length d ≥ 1.

    Example:
        >>> x, y = jnp.meshgrid(jnp.linspace(0, 1, 20), jnp.linspace(0, 1, 20))
        >>> points = jnp.stack([x.ravel(), y.ravel()], axis=1)
        >>> d_xy = js.partial_derivative(points, (1, 1))
        >>> bool(jnp.allclose(d_xy(points[:, 0] * points[:, 1]), 1))
        True
    """
    points = as_float(points, "points", *POINTS)
    instance(method, FlatDCPSE, "method")
    dim = points.shape[1]
    if not isinstance(alpha, tuple | list):
        raise TypeError(f"alpha is {alpha!r}, expected {dim} whole numbers")
    alpha = tuple(whole(a, "alpha") for a in alpha)
    if len(alpha) != dim or min(alpha) < 0 or sum(alpha) < 1:
        raise ValueError(f"alpha = {alpha} is no derivative in {dim} dimensions")
    target = Partial(alpha)
    if neighbors is None:
        count = min(method.neighbor_count(dim, target), len(points))
        neighbors = find_neighbors(points, count)
    # The method looks at offsets only; the normals are there for the form.
    cloud = PointCloud(points, jnp.zeros_like(points).at[:, 0].set(1))
    return build(cloud, neighbors, method, target, throw)


def _field(values, shape: tuple[int, ...], name: str):
    return jnp.broadcast_to(as_float(values, name, shape, shape[1:]), shape)
