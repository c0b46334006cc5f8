r"""Numerical damping for advection and waves, of the size of what the points do not resolve."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from ..arguments import as_float, finite, instance, real, switched_off, whole
from ..cloud import PointCloud
from ..neighbors import Neighbors, find_neighbors, switched_on
from ..operators import diffusion
from ..spectrum import spectral_estimate
from ..stencils.algebra import AbstractOperator
from ..stencils.gathers import take
from ..stencils.method import AbstractMethod
from ..stencils.stencil import Stencil
from ..stencils.usual import USUAL
from .coefficients import check_operator


def hyperviscosity(
    laplacian: Stencil,
    speed: ArrayLike,
    *,
    power: int = 2,
    strength: float = 0.5,
    spectral_radius: ArrayLike | None = None,
) -> AbstractOperator:
    r"""Damping $-\nu\,(-\Delta_S)^p$ that acts on the shortest waves and spares the others.

    $\nu = \alpha\,c\,\rho^{1/2 - p}$ with ρ the Laplacian's spectral radius: the shortest wave is
    damped at α times the rate $c\sqrt\rho$ at which it is carried along, a wave of wavenumber
    k at $\alpha\,c\,k\,(k/\sqrt\rho)^{2p - 1}$. Central stencils on scattered points give
    advection eigenvalues with positive real part; this moves them back to the left.

    Args:
        laplacian: the Laplace–Beltrami operator.
        speed: c, the largest speed of the flow or of the waves.
        power: p; the error made is $O(h^{2p - 1})$.
        strength: α.
        spectral_radius: ρ, which may be traced; estimated if None (the operator must then be
            concrete).

    Returns:
        The damping, to be added to the right-hand side: `stabilization=` of the problems.

    Accuracy: in float32 within 2e-3 of the largest value (`tests/test_time_forms.py`).
    Raises:
        TypeError: not an operator, not numbers.
        ValueError: a power below one, a strength or radius that is not positive, a negative speed.

    Example:
        >>> laplacian = js.laplace_beltrami(js.sphere(300))
        >>> damping = js.hyperviscosity(laplacian, 1.0)
        >>> rough = jnp.asarray(np.random.default_rng(0).normal(size=300))
        >>> bool(jnp.vdot(rough, damping(rough)) < 0)
        True
    """
    check_operator(laplacian, "laplacian", needed=True)
    instance(laplacian, Stencil, "laplacian", "from js.laplace_beltrami")
    power = whole(power, "power", least=1)
    real(strength, "strength", above=0)
    real(speed, "speed", least=0)
    if spectral_radius is not None:
        real(spectral_radius, "spectral_radius", above=0)
    else:
        spectral_radius = spectral_estimate(laplacian).radius
    factor = strength * jnp.asarray(speed) * spectral_radius ** (0.5 - power)
    damping: AbstractOperator = -((-1) ** power) * factor * laplacian
    for _ in range(power - 1):
        damping = damping @ laplacian
    return damping


def upwind_viscosity(
    cloud: PointCloud,
    velocity: Float[Array, "n d"],
    *,
    neighbors: Neighbors | None = None,
    method: AbstractMethod = USUAL,
    strength: float = 1.0,
) -> Stencil:
    r"""The viscosity of upwind differences, of first order.

    $\nabla\cdot\left(\tfrac{\alpha h |v|}{2}\,\nabla u\right)$ with h the distance to the nearest
    neighbour: on a line of points, central differences plus this with α = 1 are upwind
    differences. It acts in all directions, because damping along the stream alone leaves
    growing modes on scattered points.

    Args:
        cloud: n points in d dimensions with unit normals.
        velocity: v, `(n, d)`.
        neighbors: as `diffusion`; without them they are searched for on the host.
        method: how the weights are computed.
        strength: α.

    Returns:
        The damping, to be added to the right-hand side: `stabilization=` of the problems.

    Accuracy: first order; `hyperviscosity` costs accuracy of higher order only. In float32 within
    2e-4 of the largest value (`tests/test_time_forms.py`).
    Differentiable: as `diffusion`, where the velocity does not vanish.
    Raises:
        ValueError: as `diffusion`; a velocity of the wrong shape.

    Example:
        >>> cloud = js.sphere(300)
        >>> x, y, z = cloud.points.T
        >>> damping = js.upwind_viscosity(cloud, jnp.stack([-y, x, 0 * z], axis=1))
        >>> bool(jnp.vdot(x, damping(x)) < 0)
        True
    """
    instance(cloud, PointCloud, "cloud")
    instance(method, AbstractMethod, "method", "like js.GFDM(degree=4)")
    velocity = as_float(velocity, "velocity", cloud.points.shape)
    velocity = switched_off(cloud.active, finite(velocity, "velocity", cloud.active))
    real(strength, "strength", least=0)
    spacing = cloud.seen.spacing
    if spacing is None:
        near = find_neighbors(cloud, 2, throw=False) if neighbors is None else neighbors
        spacing = _nearest(cloud.seen.points, switched_on(cloud, near))
    viscosity = _viscosity(spacing, velocity, strength)
    return diffusion(cloud, viscosity, neighbors=neighbors, method=method)


@jax.jit
def _viscosity(spacing, velocity, strength) -> Float[Array, " n"]:
    return 0.5 * strength * spacing * jnp.linalg.norm(velocity, axis=1)


@jax.jit
def _nearest(points, neighbors: Neighbors) -> Float[Array, " n"]:
    """Distance to the nearest other point of each list."""
    offsets = take(points, neighbors.indices) - points[:, None]
    squares = jnp.sum(offsets**2, axis=-1)
    other = neighbors.mask & (neighbors.indices != jnp.arange(len(points))[:, None])
    # The largest where there is no other, so that nothing is divided by zero on the way back.
    squares = jnp.where(other, squares, jax.lax.stop_gradient(jnp.max(squares)))
    # By its place: a derivative of the least asks which of numbers computed anew are equal to it.
    least = jnp.argmin(squares, axis=1)[:, None]
    return jnp.sqrt(jnp.take_along_axis(squares, least, axis=1)[:, 0])
