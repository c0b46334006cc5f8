"""Heat on a surface, for the demo: a hot spot, how long it spreads, how much there is."""

from __future__ import annotations

import math
from typing import NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .boundary import Closure
from .cloud import PointCloud
from .frames import tangent_frames
from .neighbors import Neighbors
from .stencils.stencil import Stencil
from .time.amplification import amplification_of
from .time.explicit import RKC2
from .time.integrate import integrate
from .time.stability import check_steps
from .time.transport import AdvectionDiffusionReaction


def cell_areas(cloud: PointCloud, neighbors: Neighbors, *, rays: int = 120) -> Float[Array, " n"]:
    r"""Area of each point's Voronoi cell in its tangent plane (length of it on a curve).

    A cell reaches as far as $\min_j |d_j|^2/2 d_j\cdot e$ in direction e. On a border, where
    it would be endless, cells end at the distance of the sixth neighbour.

    Accuracy: O(h²) on quasi-uniform points.
    """
    flat, used = _around(cloud, neighbors)
    squared = jnp.sum(flat**2, axis=2)
    if cloud.dim == 2:
        directions = jnp.array([[1.0], [-1.0]])
        share, power = 1.0, 1
    else:
        angle = 2 * jnp.pi * jnp.arange(rays) / rays
        directions = jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=1)
        share, power = float(jnp.pi / rays), 2
    farthest = jnp.sqrt(squared[:, min(5, flat.shape[1] - 1)])

    def add(total, direction):
        ahead = flat @ direction
        reach = jnp.where(
            used & (ahead > 0), squared / (2 * jnp.where(ahead > 0, ahead, 1)), jnp.inf
        )
        return total + jnp.minimum(jnp.min(reach, axis=1), farthest) ** power, None

    return share * jax.lax.scan(add, jnp.zeros(cloud.n, flat.dtype), directions)[0]


def carried(
    areas: Float[Array, " n"], before: PointCloud, after: PointCloud, neighbors: Neighbors
) -> Float[Array, " n"]:
    r"""Areas of points that a smooth motion of the surface has carried along.

    Stretched as $\sqrt{\det J J^T}$, with the linear map J nearest to the one that takes a point's
    tangent plane to where the neighbours are: Voronoi's cells have kinks where they gain a side.

    Differentiable: in the points after the motion.
    """
    flat, used = _around(before, neighbors)
    slots, weighted = neighbors.indices[:, 1 : 1 + flat.shape[1]], flat * used[:, :, None]
    gram = jnp.einsum("nkt,nks->nts", weighted, flat)

    def stretch(points):
        offsets = points[slots] - points[:, None]
        J = jnp.linalg.solve(gram, jnp.einsum("nkt,nkd->ntd", weighted, offsets))
        return jnp.sqrt(jnp.linalg.det(jnp.einsum("ntd,nsd->nts", J, J)))

    return areas * stretch(after.points) / stretch(before.points)


def _around(cloud: PointCloud, neighbors: Neighbors):
    """The nearest neighbours in the tangent planes, and which slots are used."""
    slots, used = neighbors.indices[:, 1:20], neighbors.mask[:, 1:20]
    offsets = cloud.points[slots] - cloud.points[:, None]
    tangents = tangent_frames(cloud.normals)[:, :-1]
    return jnp.einsum("nkd,ntd->nkt", offsets, tangents), used


class Heat(NamedTuple):
    """How long, in how many steps, when to look, and a bound of the operator's eigenvalues."""

    until: float
    steps: int
    frames: tuple[float, ...]
    radius: float

    @staticmethod
    def within(until: float, laplacian: Stencil, radius: float) -> Heat:
        """Steps short enough for a hot spot, and stable as `integrate` asks for.

        What the radius asks for RKC2's stages give; on coarse scans there may be eigenvalues beside
        the real axis too, for which steps have to be shorter.

        Args:
            until: the end.
            laplacian: what is stepped, at rest where borders are held.
            radius: an estimate of its spectral radius.

        Raises:
            ValueError: no steps are stable.
        """
        radius *= _MARGIN
        step, dt = amplification_of(RKC2(spectral_radius=radius)), until / _STEPS
        assert step is not None
        zero, u = jnp.zeros(()), jnp.zeros(laplacian.n, laplacian.weights.dtype)
        look = eqx.filter_jit(check_steps)
        found = look(step, (lambda t, u, args: laplacian(u),), zero, u, None, dt, until, False)
        steps = _STEPS
        if not found.stable:
            longest, _ = found.longest(step, dt, until)
            if not longest:
                raise ValueError(f"RKC2 is stable for no step, the spectral radius is {radius:.3g}")
            # A little shorter, as surfaces are moved a little; the frames lie between steps.
            steps = 5 * math.ceil(until / (5 * 0.9 * longest))
        return Heat(until, steps, (0.0, until / 5, until), radius)


# The spectral radius is estimated from below.
_STEPS, _MARGIN = 40, 1.2


def diffuse(
    laplacian: Stencil,
    closure: Closure | None,
    start: Float[Array, " n"],
    heat: Heat,
    areas: Float[Array, " n"] | None = None,
) -> Float[Array, "frames n"]:
    r"""Temperatures $u_t = \Delta_S u$ at the frames; borders keep theirs.

    With the areas of the points of a closed surface the sum of the heat is kept to round-off, by
    the `mass` of `AdvectionDiffusionReaction`.

    Differentiable in the operator, the start and the areas.
    """
    if closure is not None:
        held = start[closure.rows]
        closure = eqx.tree_at(lambda c: c.sources[0].condition.value, closure, held)
    return integrate(
        AdvectionDiffusionReaction(laplacian, closure=closure, mass=areas),
        start,
        t1=heat.until,
        solver=RKC2(spectral_radius=heat.radius),
        # Given steps make the end a smooth function of the surface.
        dt0=heat.until / heat.steps,
        saveat=diffrax.SaveAt(ts=jnp.asarray(heat.frames, start.dtype)),
    ).ys  # type: ignore[return-value]


def spot(cloud: PointCloud, source: int, width: float) -> Float[Array, " n"]:
    squared = jnp.sum((cloud.points - cloud.points[source]) ** 2, axis=1)
    return jnp.exp(-squared / (2 * width**2))
