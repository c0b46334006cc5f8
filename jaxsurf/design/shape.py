"""Shapes with parameters: θ ↦ a discretisation, differentiable, with the arrays of a reference."""

from __future__ import annotations

import abc
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PyTree

from ..arguments import as_float, differentiable, instance, switched_off
from ..cloud import PointCloud
from ..compiling import sized_jit
from ..discretization import Discretization
from ..failures import check, marking, not_positive, unchecked
from ..frames import frames_of
from ..functions import Traced, canonical
from ..motion import crossed
from ..neighbors import Neighbors, find_neighbors
from ..normals import refit_normals
from ..renew import NeighborSearch
from ..shapes.implicit import Bounds, level_set_normals, project_to_level_set
from ..shapes.level_sets import RESOLUTION, spread, watched
from ..shapes.sampling import relax
from ..shapes.spacing import ideal_spacing
from ..shapes.topology import Sides, checked_bounds

# Steps of repulsion by which points are spread again over a level set.
_SPREAD = 10
# A sheet gets points if they fill so many stencils; with fewer than wanted by this factor it is
# sampled anew.
_STENCILS, _FEWER = 2, 4


class AbstractShape(eqx.Module):
    r"""A family of surfaces: `shape(theta)` is the discretisation that belongs to $\theta$.

    Its points are those of a reference moved along, its neighbours those of the reference: all
    arrays keep their shapes, and nothing jumps. A shape of one's own moves a surface likewise.

    Example:
        >>> class Scaled(js.AbstractShape):
        ...     surface: js.Discretization
        ...
        ...     def __call__(self, theta):
        ...         cloud = self.surface.cloud
        ...         return self.surface.moved(theta * cloud.points, cloud.normals)
        >>> shape = Scaled(js.discretize(js.sphere(500), method=js.GFDM(degree=4)))
        >>> area = lambda theta: shape(theta).areas.sum()
        >>> bool(abs(jax.grad(area)(2.0) - 16 * jnp.pi) < 1e-3)
        True
    """

    @abc.abstractmethod
    def __call__(self, theta: PyTree) -> Discretization:
        r"""The discretisation at $\theta$, under `jit`, `vmap` and `grad`; see `surface.moved`.

        Raises:
            ValueError: as `surface.moved`; under `jit`, `vmap` and `grad` see its `code`.
        """

    def renewed(self, theta: PyTree, search: NeighborSearch) -> AbstractShape:
        r"""The same family, its neighbours those that points have at $\theta$; not traced.

        For shapes that go far, as in `js.optimize_shape`. All arrays keep their shapes, so that
        nothing is compiled again. A shape of one's own need not write this: the surfaces in it
        are given the lists.

        Args:
            theta: where.
            search: from `surface.search()`, with as many slots as the lists.

        Raises:
            ValueError: as `surface.moved`.
        """
        surface = unchecked_surface(self, theta)
        found = surface.moved(*_geometry(surface), search=search)
        return _followed(self, lambda x: _with_lists(x, found))

    def rebuilt(self, theta: PyTree, search: NeighborSearch | None = None) -> AbstractShape:
        r"""The same family, on other points where those there are do not cover its surface at
        $\theta$; else this very shape; not traced.

        `js.optimize_shape` asks after every step. All arrays keep their shapes, so that nothing
        is compiled again. Most shapes always have the same parts, and need not write this.

        Args:
            theta: where.
            search: as for `renewed`; if None, or without room enough, one made for the points.

        Raises:
            ValueError: there is no surface at theta, or none that can be sampled.
        """
        return self


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
            under `eqx.filter_grad` and `eqx.filter_jit`).
        surface: of a level set nearby, as of `js.level_set(lambda x: phi(x, theta0), ...)`.
        bounds: lower and upper corner of a box that the level set stays in, as of `js.level_set`;
            None where its topology does not change.

    Differentiable: forward and reverse in theta, for fixed neighbours.
    Raises:
        TypeError: phi that is no function, a surface that is no discretisation.
        ValueError: at a theta for which points do not reach the level set, named by point; under
            `jit`, `vmap` and `grad` they are NaN, with code 1. Bounds of another dimension or that
            are none, or for a surface with a border, a mask or a spacing of its own.

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
        _function(phi, "phi")
        _surface(surface)
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
        cloud = self.surface.cloud
        # A switched-off point goes where another goes, and stays where it is.
        start = cloud.points
        if cloud.active is not None:
            start = switched_off(cloud.active, start, start[jnp.argmax(cloud.active)])
        points = project_to_level_set(phi, start)
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

            spacing = ideal_spacing(float(jnp.sum(surface.areas)), cloud.n, dim=cloud.dim)
            even = relax(np.asarray(cloud.points), onto, spacing=spacing, steps=_SPREAD)
            points, normals = (jnp.asarray(a, cloud.points.dtype) for a in even)
        else:
            points, normals = _geometry(surface)
        found = surface.moved(points, normals, search=search)
        return eqx.tree_at(lambda s: s.surface, self, _with_lists(found, found))

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
            if covered and not before.any():
                return eqx.tree_at(lambda s: s.topology, self, known(counts))
            if covered and np.array_equal(before, known(counts)):
                return self
        chosen = spread(phi, look, sides, cloud.n, on=lambda x: seen[sheets.at(x)])
        topology = known(sheets.counts(np.asarray(chosen.points)))
        surface = _listed(self.surface, chosen, k, search)
        return eqx.tree_at(lambda s: (s.surface, s.topology), self, (surface, topology))


class MappedShape(AbstractShape):
    r"""A reference surface, or another shape, under a map with parameters.

    Points are $f(x, \theta)$, normals $\propto F t_1 \times F t_2$ with F the derivative of f and
    t the tangents before, exactly. So are parametric surfaces (x a surface that parametrises
    them), rigid (`js.rigid_motion`) and affine maps (`lambda x, theta: theta[0] @ x + theta[1]`),
    and stars (`js.star_shape`). Of a shape, the parameters are its own and those of the map:
    `MappedShape(f, shape)((theta, theta_f))`. Maps that reflect turn normals inwards.

    Args:
        f: takes one point `(d,)` and parameters, any pytree; returns a point.
        base: what it is applied to.

    Differentiable: forward and reverse in theta, for fixed neighbours.
    Raises:
        TypeError: f that is no function, a base that is neither discretisation nor shape.
        ValueError: at a theta for which f returns no point, or folds or flattens the surface.

    Example:
        >>> surface = js.discretize(js.sphere(500), method=js.GFDM(degree=4))
        >>> stretched = js.MappedShape(lambda x, axes: axes * x, surface)
        >>> volume = lambda axes: js.volume(stretched(axes))
        >>> slopes = jax.grad(volume)(jnp.array([1.0, 2.0, 1.0]))
        >>> bool(jnp.allclose(slopes, 4 * jnp.pi / 3 * jnp.array([2, 1, 2]), rtol=1e-3))
        True
    """

    f: Callable[[Float[Array, " d"], PyTree], Float[Array, " d"]]
    base: Discretization | AbstractShape

    def __check_init__(self):
        _function(self.f, "f")
        instance(self.base, (Discretization, AbstractShape), "base", "js.discretize makes one")

    def __call__(self, theta: PyTree) -> Discretization:
        if isinstance(self.base, AbstractShape):
            own, theta = theta
            surface = self.base(own)
        else:
            surface = self.base
        points, normals = surface.cloud.seen.points, surface.cloud.seen.normals
        point = jax.ShapeDtypeStruct(points.shape[1:], points.dtype)
        apply = lambda x: self.f(x, theta)
        found = differentiable(apply, "f", point)
        if getattr(found, "shape", None) != point.shape:
            what = getattr(found, "shape", type(found).__name__)
            raise ValueError(f"f returns {what} for one point, expected {point.shape}")
        program = canonical(apply, jnp.zeros(point.shape, point.dtype))
        images, normals, area = _mapped(program, points, frames_of(normals)[:, :-1])
        text = "f flattens the surface at point {i}: it stretches areas there by {v}"
        on = surface.cloud.active
        check(switched_off(on, area, 1), not_positive, text)
        return surface.moved(images, switched_off(on, normals, surface.cloud.normals))


@eqx.filter_jit
def _mapped(f: Traced, points, tangents):
    """Images of points, unit normals there, and how f stretches areas."""

    def single(x, tangents):
        images, moved = jax.vmap(lambda t: jax.jvp(f, (x,), (t,)))(tangents)
        return images[0], moved

    images, moved = jax.vmap(single)(points, tangents)
    normals = crossed(moved)
    area = jnp.sqrt(jnp.sum(normals**2, axis=1))
    return images, normals / area[:, None], area


class NormalShape(AbstractShape):
    r"""Free form: the points of a reference moved along its normals, $x + (\theta - \theta_0) n$.

    Args:
        surface: the reference. Parameters are one displacement for each point, `(n,)`, in units
            of length, which should be smooth over a few points; normals are carried along.
        start: the displacements $\theta_0$ that belong to the reference; zero if None.

    Accuracy: normals as `surface.gradient`, $O(h^p)$.
    Differentiable: forward and reverse in theta, for fixed neighbours.
    Raises:
        TypeError: a surface that is no discretisation, displacements that are no real numbers.
        ValueError: displacements of another shape, or that fold the surface.

    Example:
        >>> shape = js.NormalShape(js.discretize(js.sphere(500), method=js.GFDM(degree=4)))
        >>> bool(abs(js.volume(shape(jnp.ones(500))) - 32 * jnp.pi / 3) < 1e-2)
        True
    """

    surface: Discretization
    start: Float[Array, " n"]

    def __init__(self, surface: Discretization, start: Float[Array, " n"] | None = None):
        _surface(surface)
        start = jnp.zeros_like(surface.cloud.points[:, 0]) if start is None else start
        self.surface, self.start = surface, as_float(start, "start", (surface.n,))

    def __call__(self, theta: Float[Array, " n"]) -> Discretization:
        theta = as_float(theta, "displacements", (self.surface.n,))
        cloud = self.surface.cloud
        return self.surface.moved(cloud.points + (theta - self.start)[:, None] * cloud.normals)

    def renewed(self, theta: Float[Array, " n"], search: NeighborSearch) -> NormalShape:
        """As of any shape; the surface at theta is the reference, its normals fitted again."""
        surface = unchecked_surface(self, theta)
        points, normals, degree = *_geometry(surface), surface.method.polynomial_degree
        normals = refit_normals(points, normals, surface.neighbors, degree=degree)
        found = surface.moved(points, normals, search=search)
        return NormalShape(_with_lists(found, found), theta)


def rigid_motion(
    x: Float[Array, " d"], theta: tuple[Float[Array, "..."], Float[Array, " d"]]
) -> Float[Array, " d"]:
    r"""A point turned about the origin, then shifted: for `MappedShape`.

    Args:
        x: `(d,)`.
        theta: rotation, and shift `(d,)`. In space the rotation is a vector `(3,)` along the axis,
            as long as the angle; in the plane an angle `()`. Smooth everywhere, at 0 too.

    Accuracy: round-off; in float32 within 1e-5 (`tests/test_design.py::test_single_precision`).
    Differentiable: forward and reverse in theta and x, to any order.
    Raises:
        ValueError: a rotation or shift of another shape.

    Example:
        >>> quarter = jnp.array([0.0, 0.0, jnp.pi / 2]), jnp.array([0.0, 0.0, 1.0])
        >>> js.rigid_motion(jnp.array([1.0, 0.0, 0.0]), quarter).round(6).tolist()
        [0.0, 1.0, 1.0]
    """
    x = as_float(x, "x", (2,), (3,))
    turn, shift = theta
    turn = as_float(turn, "rotation", () if len(x) == 2 else (3,))
    shift = as_float(shift, "shift", x.shape)
    if len(x) == 2:
        matrix = jnp.array([[0.0, -1.0], [1.0, 0.0]], turn.dtype) * turn
    else:
        matrix = jnp.cross(turn, jnp.eye(3, dtype=turn.dtype)).T
    return jax.scipy.linalg.expm(matrix) @ x + shift


def _function(f: Any, name: str) -> None:
    if not callable(f):
        raise TypeError(f"{name} is a {type(f).__name__}, expected a function of x and theta")


def _surface(surface: Any) -> None:
    instance(surface, Discretization, "surface", "js.discretize(cloud) makes one")


def unchecked_surface(shape: AbstractShape, theta: PyTree) -> Discretization:
    """The surface, its lists in whatever state."""
    with marking():
        return _unchecked(shape, theta)


@sized_jit
def _unchecked(shape, theta):
    return shape(theta)


def with_wear(shape: AbstractShape) -> AbstractShape:
    """The same shape, whose surfaces know where their neighbours were found."""
    known = lambda x: x.cloud.points if x.found_at is None else x.found_at
    lists = lambda x: (x.neighbors, x.method, x.border, known(x))
    return _followed(shape, lambda x: Discretization(x.cloud, *lists(x)))


def _followed(shape: AbstractShape, change: Callable) -> AbstractShape:
    """A shape with every surface in it changed."""
    is_one = lambda x: isinstance(x, Discretization)
    return jax.tree.map(lambda x: change(x) if is_one(x) else x, shape, is_leaf=is_one)


def _geometry(surface: Discretization) -> tuple[Array, Array]:
    return surface.cloud.points, surface.cloud.normals


def _with_lists(surface: Discretization, found: Discretization) -> Discretization:
    """A surface with the lists of another of the same points."""
    lists = (found.neighbors, surface.method, surface.border, found.cloud.points)
    return Discretization(surface.cloud, *lists)


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
    return _with_lists(found, found)
