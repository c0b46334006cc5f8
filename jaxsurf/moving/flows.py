r"""Flows that make energies of a surface less: area, and the integral of H²."""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from ..arguments import flag, real
from ..discretization import Discretization
from ..stencils.algebra import AbstractOperator
from ..stencils.gathers import take
from .motions import AbstractMotion


class MeanCurvatureFlow(AbstractMotion):
    r"""Mean curvature flow $v = -H\,n$, with $H = \tfrac12\nabla\cdot n$, $v = \tfrac12\Delta x$.

    A unit sphere shrinks as $r' = -1/r$. A curve moves by half its curvature.

    Args:
        keep_volume: add the mean of H along the normal, so that the enclosed volume is kept; closed
            surfaces only.
        smoothing: length h of a Gaussian $e^{-|x - y|^2 / h^2}$ by which H is averaged over each
            list of neighbours. None: not at all, as stability does not ask for it. It slows the
            flow of what is as small as h: by $1 - e^{-\lambda h^2 / 4}$ of eigenvalue $\lambda$.

    Raises:
        TypeError: what is no bool or number.
        ValueError: a smoothing that is not positive.
    Source: Suchde and Kuhnert 2019, eqs. 36 to 38, smoothing as in eqs. 40 and 41.

    Example:
        >>> flow = js.MeanCurvatureFlow()
        >>> end = js.evolve(flow, js.sphere(300), t1=0.1, method=js.GFDM(degree=4)).clouds[-1]
        >>> bool(jnp.abs(jnp.linalg.norm(end.points, axis=1) - 0.8**0.5).max() < 1e-3)
        True
    """

    keep_volume: bool = eqx.field(static=True)
    smoothing: Float[Array, ""] | None

    def __init__(self, keep_volume: bool = False, smoothing: ArrayLike | None = None):
        self.keep_volume = flag(keep_volume, "keep_volume")
        length = None if smoothing is None else real(smoothing, "smoothing", above=0)
        self.smoothing = None if length is None else jnp.asarray(length)

    @property
    def derivatives(self):
        return 2

    def pull(self, surface):
        return surface.laplacian / 2

    def velocity(self, t, surface, fields, args):
        cloud = surface.cloud
        toward: Float[Array, "n d"] = surface.laplacian(cloud.points) / 2
        if self.smoothing is None and not self.keep_volume:
            return toward
        curvature = -jnp.sum(toward * cloud.normals, axis=1)
        mean = surface.mean(curvature) if self.keep_volume else 0.0
        if self.smoothing is None:
            return toward + mean * cloud.normals
        return (mean - _smoothed(surface, curvature, self.smoothing))[:, None] * cloud.normals


def _smoothed(
    surface: Discretization, values: Float[Array, " n"], h: Float[Array, ""]
) -> Float[Array, " n"]:
    """Means over lists of neighbours, weighted by a Gaussian."""
    x, lists = surface.cloud.points, surface.neighbors
    distance2 = jnp.sum((take(x, lists.indices) - x[:, None]) ** 2, axis=2)
    weights = jnp.where(lists.mask, jnp.exp(-distance2 / h**2), 0)
    total = jnp.sum(weights, axis=1)
    product = jnp.sum(weights * take(values, lists.indices), axis=1)
    return product / jnp.where(total > 0, total, 1)


class _AlongNormals(eqx.Module):
    r"""$x \mapsto \Delta H\,n$ with $H = -\tfrac12 n\cdot\Delta x$, linear for this Δ and n."""

    laplacian: AbstractOperator
    normals: Float[Array, "n d"]

    def __call__(self, x: Float[Array, "n d"]) -> Float[Array, "n d"]:
        curvature = -jnp.sum(self.laplacian(x) * self.normals, axis=1) / 2
        return self.laplacian(curvature)[:, None] * self.normals


class SurfaceDiffusionFlow(AbstractMotion):
    r"""Surface diffusion $v = \Delta H\,n$, $H = \tfrac12\nabla\cdot n$: less area, same volume.

    Of a unit sphere, a bump of degree l decays at the rate $\lambda(\lambda - 2)/2$, $\lambda =
    l(l + 1)$. Semi-implicit by default: $\Delta(n\cdot\Delta x)\,n$ of the geometry at the start
    of a step is treated implicitly. Points move along normals and crowd where the surface draws
    together, which costs steps: long runs want `Adaptation`.

    Accuracy: velocities of order r with a `GFDM` of degree r = 4, 1 % on a torus (2, 1) of 1,600
    points. In float32, where a fourth derivative loses the digits that $h^4$ takes, radii of curves
    of 40 points are within 1e-3 (`tests/test_flows.py`).

    Source: Mullins 1957, J. Appl. Phys. 28, 333.

    Example:
        >>> cloud = js.ellipsoid(400, (1.2, 1.0, 1.0))
        >>> flow = js.SurfaceDiffusionFlow()
        >>> run = js.evolve(flow, cloud, t1=0.02, saveat=[0.0], method=js.GFDM(degree=4))
        >>> bool(jnp.diff(run.history["area"])[0] < 0)
        True
    """

    @property
    def derivatives(self):
        return 4

    def pull(self, surface):
        return _AlongNormals(surface.laplacian, surface.cloud.normals)

    def velocity(self, t, surface, fields, args):
        return self.pull(surface)(surface.cloud.points)


class WillmoreFlow(AbstractMotion):
    r"""Willmore flow, down the gradient of $\int H^2$, with $H = \tfrac12\nabla\cdot n$.

    $v = (\Delta H + H\,(|S|^2 - 2 H^2))\,n$ with the shape tensor $S = \nabla n$; of surfaces
    $|S|^2 - 2 H^2 = (\kappa_1 - \kappa_2)^2/2$. Spheres stand still, and tori whose radii have the
    ratio $\sqrt 2$; the radius of a circle grows as $r^4 = r_0^4 + t$. Semi-implicit by default, as
    `SurfaceDiffusionFlow`, and as accurate.

    Source: Willmore 1965; Kuwert and Schaetzle 2001, Comm. Anal. Geom. 10, 307.

    Example:
        >>> flow = js.WillmoreFlow()
        >>> end = js.evolve(flow, js.circle(60), t1=1.0, method=js.GFDM(degree=4)).clouds[-1]
        >>> bool(jnp.abs(jnp.linalg.norm(end.points, axis=1) - 2**0.25).max() < 1e-4)
        True
    """

    @property
    def derivatives(self):
        return 4

    def pull(self, surface):
        return _AlongNormals(surface.laplacian, surface.cloud.normals)

    def velocity(self, t, surface, fields, args):
        cloud = surface.cloud
        return self.pull(surface)(cloud.points) + _uneven(surface)[:, None] * cloud.normals


def _uneven(surface: Discretization) -> Float[Array, " n"]:
    r"""$H\,(|S|^2 - 2H^2)$."""
    tensor = surface.shape_tensor
    mean = jnp.trace(tensor, axis1=1, axis2=2) / 2
    return mean * (jnp.sum(tensor**2, axis=(1, 2)) - 2 * mean**2)
