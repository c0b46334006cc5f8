r"""Points that spread evenly along a surface, which stays where it is."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from ..arguments import as_float, real, switched_off, traced_call
from ..discretization import Discretization
from ..failures import refuse
from ..stencils.gathers import take
from .motions import AbstractMotion

# Points count for the density up to this multiple of the rms distance of a list: two to three
# spacings, within the list on curves and surfaces.
_REACH = 0.9


class Redistribution(AbstractMotion):
    r"""Points slide along a closed surface until they are evenly spaced.

    Their density $\rho$ diffuses, $\partial_t \rho = D \Delta \rho$, by the tangential velocity $w
    = -D\,\nabla\rho / \rho$. It is not matter that slides: surface, fields and what they conserve
    stay where they are, $\dot u = f(u) + w\cdot\nabla_S u$. Added to a flow, which moves points
    along normals, it keeps them from crowding, and neighbourhoods from wearing out:

        js.MeanCurvatureFlow() + js.Redistribution(0.5)

    It neither adds nor removes points; `js.Adaptation` does, and goes with it.

    Args:
        diffusivity: D, in length² / time; of L² / T for density that varies over a length L to
            even out in a time T. Explicit steps are limited to a multiple of h² / D, as those of
            heat: the default solver has many stages.
        spacing: what distances are to be in proportion to, `(t, surface, fields, args) -> (n,)`, of
            operations of JAX; None: even everywhere.

    Accuracy: points stay on the surface to the tolerance of the steps and the error of the normals;
        fields follow with the order of the gradient. In float32 points are within 1e-4
        (`tests/test_redistribution.py`).
    Differentiable: forward and reverse, as `evolve`.
    Raises:
        TypeError: a diffusivity that is no number, a spacing that is no function.
        ValueError: a diffusivity that is not positive; when it is used, a surface with a border, a
            spacing of another shape, or not positive (named by index where a run starts).
    Source: shifts of particles after Xu, Stansby and Laurence 2009, J. Comput. Phys. 228, 6703, and
        Lind, Xu, Stansby and Rogers 2012, J. Comput. Phys. 231, 1499, here along a surface.

    Example:
        >>> crowded = js.ellipsoid(300, (1.0, 1.0, 0.4)).points * jnp.array([1, 1, 2.5])
        >>> surface = js.discretize(js.PointCloud(crowded, crowded), method=js.GFDM(degree=2))
        >>> end = js.evolve(js.Redistribution(0.2), surface, t1=1.0).surfaces[-1]
        >>> apart = lambda surface: jnp.std(surface.cell_areas) / jnp.mean(surface.cell_areas)
        >>> bool(apart(end) < apart(surface) / 2)
        True
    """

    diffusivity: Float[Array, ""]
    spacing: Callable | None

    def __init__(self, diffusivity: ArrayLike, spacing: Callable | None = None):
        self.diffusivity = jnp.asarray(real(diffusivity, "diffusivity", above=0))
        if not (spacing is None or callable(spacing)):
            raise TypeError(
                f"spacing is a {type(spacing).__name__}, expected a function "
                "(t, surface, fields, args)"
            )
        self.spacing = spacing

    @property
    def derivatives(self):
        return 2

    @property
    def slides(self):
        return True

    def velocity(self, t, surface, fields, args):
        return jnp.zeros_like(surface.cloud.points)

    def sliding(self, t, surface, fields, args):
        size = self._wanted(t, surface, fields, args) ** (surface.cloud.dim - 1)
        return self.diffusivity * _away(surface, size)

    def check(self, t, surface, fields, args):
        self._wanted(t, surface, fields, args)

    def _wanted(self, t, surface, fields, args) -> Float[Array, " n"]:
        one = jnp.ones(surface.n, surface.cloud.points.dtype)
        if self.spacing is None:
            return one
        h = traced_call(self.spacing, "spacing", t, surface, fields, args)
        h = switched_off(surface.cloud.active, one * as_float(h, "spacing", (surface.n,), ()), 1.0)
        bad = ~(jnp.isfinite(h) & (h > 0))
        return refuse(h, bad, "the spacing wanted at point {i} is {v}, expected above 0", h)


@jax.jit
def _away(surface: Discretization, size: Float[Array, " n"]) -> Float[Array, "n d"]:
    r"""$-\nabla\rho / \rho$ along the surface, with $\rho(x) = \sum_j s_j W(|x - x_j| / R)$.

    Of Wendland's kernel $W(q) = (1 - q)^4 (4q + 1)$, $W' = -20 q (1 - q)^3$: its transform is
    positive, so that on a lattice displacements of every wave length die out. Points that are even
    but no lattice first rearrange: some of their displacements grow, slowly, until they are one.
    """
    x, lists, normals = surface.cloud.points, surface.neighbors, surface.cloud.normals
    apart = x[:, None] - take(x, lists.indices)
    distance2 = jnp.sum(apart**2, axis=2)
    count = jnp.maximum(jnp.sum(lists.mask, axis=1), 1)
    reach2 = _REACH**2 * jnp.sum(jnp.where(lists.mask, distance2, 0), axis=1) / count
    reach2 = jnp.where(reach2 > 0, reach2, 1)[:, None]
    # At the point itself a root has no derivative.
    other = distance2 > 0
    q = jnp.where(other, jnp.sqrt(jnp.where(other, distance2 / reach2, 1)), 0)
    size = jnp.where(lists.mask & (q < 1), take(size, lists.indices), 0)
    left = 1 - q
    density = jnp.sum(size * left**4 * (4 * q + 1), axis=1)
    push = jnp.einsum("nk,nkx->nx", size * left**3, apart)
    push = 20 * push / (reach2 * jnp.where(density > 0, density, 1)[:, None])
    return push - jnp.sum(push * normals, axis=1, keepdims=True) * normals
