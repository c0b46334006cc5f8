"""Level sets with parameters, whose parts may meet, part, vanish and be born."""

from __future__ import annotations

from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PyTree

from ..cloud import PointCloud
from ..discretization import Discretization
from ..failures import unchecked
from ..neighbors import Neighbors, find_neighbors
from ..renew import NeighborSearch
from ..shapes.implicit import Bounds, level_set_normals, project_to_level_set
from ..shapes.level_sets import RESOLUTION, spread, watched
from ..shapes.topology import Sides, checked_bounds
from .shape import (
    AbstractShape,
    check_function,
    check_surface,
    geometry,
    spread_evenly,
    starts,
    unchecked_surface,
    with_lists,
)

# A sheet gets points if they fill so many stencils; with fewer than wanted by this factor it is
# sampled anew.
_STENCILS, _FEWER = 2, 4


class LevelSetShape(AbstractShape):
    r"""The level sets $\{x : \phi(x, \theta) = 0\}$, of neural networks too.

    Points are those of the reference moved along $\nabla\phi$ onto the level set; their
    derivatives in $\theta$ follow by the implicit function theorem. Normals are exact.

    With `bounds` their topology may change in `js.optimize_shape`. After each step the signs of
    phi on a grid over the box tell which sheets the level set has. Where one was born, vanished,
    met another or parted, a hole opened or closed, or one has less than a quarter of the points
    that its area asks for, the level set is sampled anew, with as many points in all. What would
    get fewer points than two stencils hold is not seen, nor what is thinner than a cell, a 48th of
    the box. Derivatives are those of the sheets that have points: none tells that another would be
    born, and functions of the surface jump where it is.

    Args:
        phi: function of one point `(d,)` and of parameters, any pytree (an `eqx.nn.MLP`, say,
            under `eqx.filter_grad` and `eqx.filter_jit`). Smooth near the level set: where
            sheets meet in a kink, as by `jnp.minimum` of two, points have no normals.
        surface: of a level set nearby, as of `js.level_set(lambda x: phi(x, theta0), ...)`.
        bounds: lower and upper corner of a box that the level set stays in, as of `js.level_set`;
            None where its topology does not change.

    Differentiable: forward and reverse in theta, for fixed neighbours.
    Raises:
        TypeError: phi that is no function, a surface that is no discretisation.
        ValueError: at a theta for which points do not reach the level set, named by point; under
            `jit`, `vmap` and `grad` they are NaN, with code 1. Bounds of another dimension or that
            are none, or for a surface with a border, a mask or a spacing of its own. In
            `js.optimize_shape` also a level set within one cell.

    Example:
        >>> phi = lambda x, axes: jnp.sum((x / axes) ** 2) - 1
        >>> axes = jnp.array([1.0, 0.8, 0.7])
        >>> surface = js.discretize(js.ellipsoid(300, axes), method=js.GFDM(degree=2))
        >>> shape = js.LevelSetShape(phi, surface)
        >>> height = lambda axes: shape(axes).cloud.points[:, 2].max()
        >>> bool(jax.grad(height)(axes)[2] > 0.9)
        True
    """

    phi: Callable[[Float[Array, " d"], PyTree], Float[Array, ""]]
    surface: Discretization
    bounds: Float[Array, "2 d"] | None
    # How many sheets had points when they were chosen, and how many tunnels; 0 if not yet known.
    topology: Int[Array, "2"] | None

    def __init__(
        self,
        phi: Callable[[Float[Array, " d"], PyTree], Float[Array, ""]],
        surface: Discretization,
        bounds: Bounds | None = None,
    ):
        check_function(phi, "phi")
        check_surface(surface)
        self.phi, self.surface, self.bounds, self.topology = phi, surface, None, None
        if bounds is not None:
            cloud = surface.cloud
            for name in ("boundary", "active", "spacing"):
                if getattr(cloud, name) is not None:
                    raise ValueError(f"bounds are for surfaces without {name}: this one has some")
            box = checked_bounds(bounds)
            if box.shape[1] != cloud.dim:
                raise ValueError(f"bounds of shape {box.shape} for a surface in {cloud.dim} axes")
            self.bounds, self.topology = jnp.asarray(box), jnp.zeros(2, jnp.int32)

    def __call__(self, theta: PyTree) -> Discretization:
        phi = lambda x: self.phi(x, theta)
        points = project_to_level_set(phi, starts(self.surface.cloud)[0])
        return self.surface.moved(points, level_set_normals(phi, points))

    def renewed(self, theta: PyTree, search: NeighborSearch) -> LevelSetShape:
        """As of any shape; without border or mask, points are also spread evenly again."""
        surface = unchecked_surface(self, theta)
        cloud = surface.cloud
        if cloud.active is None and cloud.boundary is None:
            phi = lambda x: self.phi(x, theta)

            def onto(x):
                x = project_to_level_set(phi, jnp.asarray(x, cloud.points.dtype), throw=False)
                return x, level_set_normals(phi, x)

            points, normals = spread_evenly(surface, onto)
        else:
            points, normals = geometry(surface)
        found = surface.moved(points, normals, search=search)
        return eqx.tree_at(lambda s: s.surface, self, with_lists(found, found))

    def rebuilt(self, theta: PyTree, search: NeighborSearch | None = None) -> LevelSetShape:
        """Another sample, within the bounds, where the points are not one of the level set."""
        if self.bounds is None:
            return self
        phi, cloud = lambda x: self.phi(x, theta), self.surface.cloud
        values, look = watched(phi, cloud.dim)
        sides = Sides.of(values, np.asarray(self.bounds, float), RESOLUTION)
        sheets = sides.sheets()
        wanted, k = cloud.n * sheets.share, self.surface.method.neighbor_count(cloud.dim)
        seen = wanted >= min(_STENCILS * k, wanted.max())
        points = np.asarray(unchecked_surface(self, theta).cloud.points)
        known = lambda counts: jnp.asarray([np.count_nonzero(counts), sheets.tunnels], jnp.int32)
        if np.isfinite(points).all():
            counts, before = sheets.counts(points), np.asarray(self.topology)
            covered = (counts >= seen * wanted / _FEWER).all()
            if covered:
                _check_extent(points, sides.size)
                if not before.any():
                    return eqx.tree_at(lambda s: s.topology, self, known(counts))
                if np.array_equal(before, known(counts)):
                    return self
        chosen = spread(phi, look, sides, cloud.n, on=lambda x: seen[sheets.at(x)])
        _check_extent(np.asarray(chosen.points), sides.size)
        topology = known(sheets.counts(np.asarray(chosen.points)))
        surface = _listed(self.surface, chosen, k, search)
        return eqx.tree_at(lambda s: (s.surface, s.topology), self, (surface, topology))


def _check_extent(points: np.ndarray, cell: np.ndarray) -> None:
    """What is within one cell would be seen or not, as there is a node of the grid in it or not."""
    extent = np.ptp(points, axis=0)
    if (extent < cell).all():
        raise ValueError(
            f"the level set vanishes: it extends over {extent.max():.2g}, less than a cell of the "
            f"grid within the bounds, {cell.max():.2g}"
        )


def _listed(
    surface: Discretization, cloud: PointCloud, k: int, search: NeighborSearch | None
) -> Discretization:
    """A surface of other points, with neighbours of their own in as many slots."""
    points, normals = (a.astype(surface.cloud.points.dtype) for a in (cloud.points, cloud.normals))
    cloud = PointCloud(points, normals)
    near = find_neighbors(cloud, k, throw=False)
    indices = np.repeat(np.arange(near.n, dtype=np.int32)[:, None], surface.neighbors.k, axis=1)
    mask = np.zeros(indices.shape, bool)
    indices[:, : near.k], mask[:, : near.k] = near.indices, near.mask
    lists = unchecked(Neighbors, jnp.asarray(indices), jnp.asarray(mask))
    new = Discretization(cloud, lists, surface.method, surface.border)
    try:
        found = new.moved(points, normals, search=search or new.search())
    except ValueError:
        if search is None:
            raise
        return _listed(surface, cloud, k, None)
    return with_lists(found, found)
