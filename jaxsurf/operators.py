r"""Differential operators on point clouds: on surfaces, and in flat space."""

from __future__ import annotations

import warnings

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from .cloud import PointCloud, is_concrete
from .neighbors import Neighbors, find_neighbors, nearest_of
from .stencils.dcpse import DCPSE, FlatDCPSE
from .stencils.method import AbstractMethod, Neighborhood
from .stencils.moments import blockwise
from .stencils.stencil import Composition, Stencil
from .stencils.targets import Gradient, Hessian, Laplacian, Partial


def laplace_beltrami(
    cloud: PointCloud,
    neighbors: Neighbors | None = None,
    *,
    method: AbstractMethod = DCPSE(order=2),
    throw: bool = True,
) -> Stencil:
    r"""Laplace–Beltrami operator of a point-cloud surface.

    $(\Delta_S u)_i \approx \sum_j w_{ij}\,u_j$ with $\sum_j w_{ij} = 0$ (Singh et al. 2023,
    eq. 11; Suchde and Kuhnert 2019, eqs. 25 to 27).

    Args:
        cloud: n points in d dimensions with unit normals.
        neighbors: from `find_neighbors`; chosen by `choose_neighbors` if None (host only).
        method: how the weights are computed.
        throw: raise on a degenerate stencil; if False, see `Stencil.diagnostics`. Under `jit`,
            `vmap` and `grad` nothing is raised: the diagnostics are the result code.

    Returns:
        Operator mapping `(n,)` or `(n, c)` fields to the same shape, in units of
        field / length². Its eigenvalues have real parts ≤ 0.

    Accuracy: error $O(h^r)$ for `DCPSE(order=r)`, $O(h^{p-1})$ for `GFDM(degree=p)`
    (`tests/test_accuracy.py`).
    Differentiable: forward and reverse, in points, normals and field, for fixed neighbours.
    Raises:
        ValueError: fewer neighbours than basis functions (both numbers given), or a stencil
            whose conditions cannot be met (point, residual and count given).

    Example:
        >>> cloud = js.sphere(2_000)
        >>> z = cloud.points[:, 2]
        >>> bool(jnp.abs(js.laplace_beltrami(cloud)(z) + 2 * z).max() < 0.05)
        True
    """
    return _build(cloud, neighbors, method, Laplacian(), throw)


def surface_gradient(
    cloud: PointCloud,
    neighbors: Neighbors | None = None,
    *,
    method: AbstractMethod = DCPSE(order=2),
    throw: bool = True,
) -> Stencil:
    r"""Gradient along the surface, $\nabla_S u$, as a vector in space.

    (Singh et al. 2023, eqs. 9 and 11; Suchde and Kuhnert 2019, eqs. 16 to 21.)

    Args:
        cloud: n points in d dimensions with unit normals.
        neighbors: from `find_neighbors`; chosen by `choose_neighbors` if None (host only).
        method: how the weights are computed.
        throw: raise on a degenerate stencil; if False, see `Stencil.diagnostics`.

    Returns:
        Operator mapping `(n, *c)` fields to `(n, *c, d)`, in units of field / length.

    Accuracy: error $O(h^r)$ for `DCPSE(order=r)`, $O(h^p)$ for `GFDM(degree=p)`.
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
    return _build(cloud, neighbors, method, Gradient(), throw)


def surface_divergence(
    cloud: PointCloud,
    neighbors: Neighbors | None = None,
    *,
    method: AbstractMethod = DCPSE(order=2),
    throw: bool = True,
) -> Stencil:
    r"""Divergence along the surface, $\nabla_S \cdot v = \sum_a (\nabla_S v_a)_a$.

    (Suchde and Kuhnert 2019, eq. 24.) A normal part of v contributes
    $(\nabla_S\cdot n)\,v\cdot n$, as on a moving surface.

    Args:
        cloud: n points in d dimensions with unit normals.
        neighbors: from `find_neighbors`; chosen by `choose_neighbors` if None (host only).
        method: how the weights are computed.
        throw: raise on a degenerate stencil; if False, see `Stencil.diagnostics`.

    Returns:
        Operator mapping `(n, *c, d)` fields to `(n, *c)`, in units of field / length.

    Accuracy: as `surface_gradient`.
    Differentiable: forward and reverse, in points, normals and field, for fixed neighbours.
    Raises:
        ValueError: as `laplace_beltrami`.

    Example:
        >>> cloud = js.sphere(2_000, radius=2.0)
        >>> bool(jnp.abs(js.surface_divergence(cloud)(cloud.normals) - 1).max() < 0.01)
        True
    """
    gradient = _build(cloud, neighbors, method, Gradient(), throw)
    return Stencil(gradient.indices, gradient.weights, (), (cloud.dim,), gradient.diagnostics)


def directional_derivative(
    cloud: PointCloud,
    direction: Float[Array, "n d"],
    *,
    neighbors: Neighbors | None = None,
    method: AbstractMethod = DCPSE(order=2),
    throw: bool = True,
) -> Stencil:
    r"""Derivative $a \cdot \nabla_S u$ along a vector field a; its normal part does not count.

    Args:
        cloud: n points in d dimensions with unit normals.
        direction: a, `(n, d)` or `(d,)`; its length scales the derivative.
        neighbors: from `find_neighbors`; chosen by `choose_neighbors` if None (host only).
        method: how the weights are computed.
        throw: raise on a degenerate stencil; if False, see `Stencil.diagnostics`.

    Returns:
        Operator mapping `(n, *c)` fields to the same shape.

    Accuracy: as `surface_gradient`.
    Differentiable: forward and reverse, in points, normals, direction and field.
    Raises:
        ValueError: as `laplace_beltrami`; a direction of the wrong shape.
    """
    gradient = _build(cloud, neighbors, method, Gradient(), throw)
    direction = _field(direction, (cloud.n, cloud.dim), "direction")
    weights = jnp.einsum("na,kan->kn", direction, gradient.weights)
    return Stencil(gradient.indices, weights, diagnostics=gradient.diagnostics)


def diffusion(
    cloud: PointCloud,
    diffusivity: Float[Array, "*n"],
    *,
    neighbors: Neighbors | None = None,
    method: AbstractMethod = DCPSE(order=2),
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
        cloud: n points in d dimensions with unit normals.
        diffusivity: D, scalar `(n,)` or symmetric tensor `(n, d, d)`; of a tensor only the
            tangential part counts.
        neighbors: from `find_neighbors`; chosen by `choose_neighbors` if None (host only).
        method: how the weights are computed.
        throw: raise on a degenerate stencil; if False, see `Stencil.diagnostics`.

    Returns:
        Operator mapping `(n, *c)` fields to the same shape.

    Accuracy: the order of the Laplace–Beltrami operator of the same method.
    Differentiable: forward and reverse, in points, normals, diffusivity and field.
    Raises:
        ValueError: as `laplace_beltrami`; a diffusivity of the wrong shape.
    """
    d = jnp.asarray(diffusivity)
    if d.shape == (cloud.n,):
        stencil = _build(cloud, neighbors, method, Laplacian(), throw)
        weights = stencil.weights * (d + d[stencil.indices]) / 2
    elif d.shape == (cloud.n, cloud.dim, cloud.dim):
        stencil = _build(cloud, neighbors, method, Hessian(), throw)
        project = jnp.eye(cloud.dim) - cloud.normals[:, :, None] * cloud.normals[:, None]
        d = jnp.einsum("nab,nbc,ncd->nad", project, (d + d.mT) / 2, project)
        mean = (d + d[stencil.indices]) / 2
        weights = jnp.einsum("knab,kabn->kn", mean, stencil.weights)
    else:
        shapes = f"({cloud.n},) or ({cloud.n}, {cloud.dim}, {cloud.dim})"
        raise ValueError(f"diffusivity has shape {d.shape}, expected {shapes}")
    weights = weights.at[0].set(-jnp.sum(weights[1:], axis=0))
    return Stencil(stencil.indices, weights, diagnostics=stencil.diagnostics)


def biharmonic(
    cloud: PointCloud,
    neighbors: Neighbors | None = None,
    *,
    method: AbstractMethod = DCPSE(order=4),
    throw: bool = True,
) -> Composition:
    r"""Bi-Laplacian $\Delta_S^2$, the Laplace–Beltrami operator applied twice.

    Args:
        cloud: n points in d dimensions with unit normals.
        neighbors: from `find_neighbors`; chosen by `choose_neighbors` if None (host only).
        method: how the weights are computed.
        throw: raise on a degenerate stencil; if False, see `Stencil.diagnostics`.

    Returns:
        Operator mapping `(n, *c)` fields to the same shape, in units of field / length⁴.

    Accuracy: on scattered points two orders below the Laplacian's, as the error of the inner
    operator is differentiated twice; hence the higher default.
    Differentiable: forward and reverse, in points, normals and field.
    Raises:
        ValueError: as `laplace_beltrami`.
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

    Accuracy: error $O(h^r)$ in the interior and at borders (`tests/test_flat.py`).
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
    points = jnp.asarray(points)
    dim = points.shape[-1]
    if len(alpha) != dim or min(alpha) < 0 or sum(alpha) < 1:
        raise ValueError(f"alpha = {alpha} is no derivative in {dim} dimensions")
    target = Partial(tuple(alpha))
    if neighbors is None:
        count = min(method.neighbor_count(dim, target), len(points))
        neighbors = find_neighbors(points, count)
    # The method looks at offsets only; the normals are there for the form.
    cloud = PointCloud(points, jnp.zeros_like(points).at[:, 0].set(1))
    return _build(cloud, neighbors, method, target, throw)


# --- building ------------------------------------------------------------------------------

# A stencil is adapted if the weight of its centre is less than this share of all the others.
_DOMINANCE = 0.2
# Growth of the neighbourhoods of such points, tried in turn.
_GROWTH = (1.5, 2.25, 3.4)


def choose_neighbors(
    cloud: PointCloud,
    *,
    method: AbstractMethod = DCPSE(order=2),
    bound: Bool[Array, " n"] | None = None,
    throw: bool = True,
) -> Neighbors:
    r"""Neighbourhoods suited to a method, larger where the points are irregular.

    Every point gets the number of neighbours that the method asks for. Where the
    Laplacian's weight of the centre is then positive or small,
    $-w_{ii} < 0.2 \sum_{j \ne i} |w_{ij}|$, or its conditions cannot be met, the neighbourhood
    grows by half, up to three times. Such points are what gives collocation matrices
    eigenvalues with positive real part (`experiments`, stability study). On a border no
    one-sided Laplacian has a dominant centre, however large: there neighbourhoods grow only
    where the conditions cannot be met.

    Args:
        cloud: n points in d dimensions with unit normals; concrete.
        method: how the weights will be computed.
        bound: True for points that need no stencil, `(n,)`, as a boundary condition gives their
            values (`Closure.bound`); their rows are switched off and never grow.
        throw: passed on to `find_neighbors`.

    Returns:
        Neighbour lists; rows that did not grow are padded.
    """
    needed = np.ones(cloud.n, bool) if bound is None else ~np.asarray(bound)
    neighbors = _adapted(cloud, method, throw, needed)[0]
    mask = neighbors.mask & jnp.asarray(needed)[:, None]
    return Neighbors(neighbors.indices, mask, neighbors.radius)


def _build(cloud, neighbors, method, target, throw) -> Stencil:
    weights = None
    if neighbors is None:
        neighbors, laplacian = _adapted(cloud, method, throw)
        if isinstance(target, Laplacian):
            weights = laplacian
    _check_sizes(cloud, neighbors, method, target, throw)
    if weights is None:
        weights = stencil_weights(cloud, neighbors, method, target)
    values, diagnostics = weights
    components = values.shape[1:-1]
    stencil = Stencil(neighbors.indices.T, values, components, (), diagnostics)
    if throw and is_concrete(values):
        _check(stencil, neighbors, method, target, cloud.dim)
    return stencil


@eqx.filter_jit
def stencil_weights(cloud, neighbors, method, target, rows=None):
    """Weights `(k, *components, r)` and diagnostics of all stencils, or of those of some rows."""
    rows = jnp.arange(cloud.n) if rows is None else rows
    radius = neighbors.radius
    around = Neighborhood(
        cloud.points[neighbors.indices] - cloud.points[rows][:, None],
        cloud.normals[neighbors.indices],
        neighbors.mask,
        None if radius is None else jnp.broadcast_to(radius, (cloud.n,))[rows],
    )
    weights, diagnostics = blockwise(
        lambda one: method.weights(one, target), method.batch_size, around
    )
    return jnp.moveaxis(weights, (-1, 0), (0, -1)), diagnostics


def _adapted(cloud, method, throw, needed=True) -> tuple[Neighbors, tuple | None]:
    """Neighbours that suit the method, and the Laplacian's weights unless some rows grew."""
    if not is_concrete(*jax.tree.leaves(cloud)):
        raise ValueError("neighbors=None needs concrete arrays; under jit pass the neighbours")
    on = np.ones(cloud.n, bool) if cloud.active is None else np.asarray(cloud.active)
    available = int(on.sum())
    k = min(method.neighbor_count(cloud.dim), available)
    neighbors = find_neighbors(cloud, k, throw=throw)
    _check_sizes(cloud, neighbors, method, Laplacian(), throw)
    weights = stencil_weights(cloud, neighbors, method, Laplacian())
    border = np.zeros(cloud.n, bool) if cloud.boundary is None else np.asarray(cloud.boundary)
    poor = np.flatnonzero(on & needed & _is_poor(weights, border))
    widths = [min(int(k * growth), available) for growth in _GROWTH]
    if not poor.size or widths[-1] == k:
        return neighbors, weights

    # Filled up with copies, so that few shapes are ever compiled.
    rows = np.resize(poor, max(64, 1 << (poor.size - 1).bit_length()))
    indices, mask = nearest_of(cloud, rows, widths[-1])
    chosen = np.full(rows.size, widths[-1])
    still = np.ones(rows.size, bool)
    for width in widths[:-1]:
        narrow = Neighbors(jnp.asarray(indices), jnp.asarray(mask & _first(width, mask)))
        again = stencil_weights(cloud, narrow, method, Laplacian(), jnp.asarray(rows))
        again = _is_poor(again, border[rows])
        chosen = np.where(still & ~again, width, chosen)
        still &= again
    widest = chosen.max()
    mask = (mask & _first(chosen[:, None], mask))[:, :widest]
    indices = np.where(mask, indices[:, :widest], rows[:, None])
    extra = ((0, 0), (0, widest - k))
    all_indices = np.pad(np.asarray(neighbors.indices), extra)
    all_indices[:, k:] = np.arange(cloud.n)[:, None]
    all_mask = np.pad(np.asarray(neighbors.mask), extra)
    all_indices[rows], all_mask[rows] = indices, mask
    return Neighbors(jnp.asarray(all_indices), jnp.asarray(all_mask)), None


def _first(count, mask: np.ndarray) -> np.ndarray:
    return np.arange(mask.shape[1]) < count


def _is_poor(stencils, border) -> np.ndarray:
    weights, residual = np.asarray(stencils[0]), np.asarray(stencils[1].residual)
    others = np.sum(np.abs(weights[1:]), axis=0)
    dominant = border | (-weights[0] >= _DOMINANCE * others)
    return ~(dominant & (residual < _tolerance(weights.dtype)))


# --- checks --------------------------------------------------------------------------------


def _tolerance(dtype) -> float:
    """Largest relative moment residual of a stencil that counts as determined."""
    return float(np.finfo(dtype).eps) ** 0.5


def _check_sizes(cloud, neighbors, method, target, throw) -> None:
    if neighbors.n != cloud.n:
        raise ValueError(f"neighbours of {neighbors.n} points, the cloud has {cloud.n}")
    need = method.basis_size(cloud.dim, target)
    if throw and neighbors.k < need:
        raise ValueError(f"k = {neighbors.k} neighbours, {method} needs at least {need}")


def _check(stencil: Stencil, neighbors, method, target, dim) -> None:
    diagnostics = stencil.diagnostics
    assert diagnostics is not None
    on = np.asarray(neighbors.mask[:, 0])
    count, residual = np.asarray(diagnostics.count), np.asarray(diagnostics.residual)
    bad = np.flatnonzero(on & ~(residual < _tolerance(residual.dtype)))
    if bad.size:
        i = bad[0]
        raise ValueError(
            f"degenerate stencil at point {i}: relative moment residual {residual[i]:.1e} with "
            f"{count[i]} points within the support {float(diagnostics.support[i]):.3g}, {method} "
            f"needs at least {method.basis_size(dim, target)} in general position "
            f"({bad.size} such points)"
        )
    tube = np.where(on, np.asarray(diagnostics.tube), 0)
    if tube.max(initial=0) > 1:
        i = int(tube.argmax())
        warnings.warn(
            f"the surface bends within one stencil: support x curvature = {tube[i]:.2f} at point "
            f"{i} ({int(np.sum(tube > 1))} points above 1). Use more points there or a smaller "
            "support",
            stacklevel=4,
        )


def _field(values, shape: tuple[int, ...], name: str):
    values = jnp.asarray(values)
    if values.shape not in (shape, shape[1:]):
        raise ValueError(f"{name} has shape {values.shape}, expected {shape}")
    return jnp.broadcast_to(values, shape)
