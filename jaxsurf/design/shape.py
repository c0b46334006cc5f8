"""Shapes with parameters: θ ↦ a discretisation, differentiable, with the arrays of a reference."""

from __future__ import annotations

import abc
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from ..arguments import as_float, finite, instance, switched_off, traced_call
from ..cloud import PointCloud
from ..compiling import sized_jit
from ..discretization import Discretization
from ..failures import marking
from ..normals import refit_normals
from ..renew import NeighborSearch
from ..shapes.sampling import relax
from ..shapes.spacing import ideal_spacing


class AbstractShape(eqx.Module):
    r"""A family of surfaces: `shape(theta)` is the discretisation that belongs to $\theta$.

    Its points are those of a reference moved along, its neighbours those of the reference: all
    arrays keep their shapes, and nothing jumps (but integrals, by some 1e-9 of them, where the cell
    of a point gets another side). A shape of one's own moves a surface likewise.

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
        found = surface.moved(*geometry(surface), search=search)
        return _followed(self, lambda x: with_lists(x, found))

    def rebuilt(self, theta: PyTree, search: NeighborSearch | None = None) -> AbstractShape:
        r"""The same family, on other points where those there are do not cover its surface at
        $\theta$; else this very shape; not traced.

        `js.optimize_shape` asks after every step. All arrays keep their shapes, so that nothing
        is compiled again. Most shapes always have the same parts, and need not write this; what
        holds another shape has to ask it, as `js.MappedShape` does.

        Args:
            theta: where.
            search: as for `renewed`; if None, or without room enough, one made for the points.

        Raises:
            ValueError: there is no surface at theta, or none that can be sampled.
        """
        return self


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
        check_surface(surface)
        start = jnp.zeros_like(surface.cloud.points[:, 0]) if start is None else start
        self.surface = surface
        self.start = finite(as_float(start, "start", (surface.n,)), "start", surface.cloud.active)

    def __call__(self, theta: Float[Array, " n"]) -> Discretization:
        theta = as_float(theta, "displacements", (self.surface.n,))
        points, normals = starts(self.surface.cloud)
        far = switched_off(self.surface.cloud.active, theta - self.start)
        return self.surface.moved(points + far[:, None] * normals)

    def renewed(self, theta: Float[Array, " n"], search: NeighborSearch) -> NormalShape:
        """As of any shape; the surface at theta is the reference, its normals fitted again."""
        surface = unchecked_surface(self, theta)
        points, normals, degree = *geometry(surface), surface.method.polynomial_degree
        normals = refit_normals(points, normals, surface.neighbors, degree=degree)
        found = surface.moved(points, normals, search=search)
        return NormalShape(with_lists(found, found), theta)


def check_function(f: Any, name: str) -> None:
    if not callable(f):
        raise TypeError(f"{name} is a {type(f).__name__}, expected a function of x and theta")


def check_surface(surface: Any) -> None:
    instance(surface, Discretization, "surface", "js.discretize(cloud) makes one")


def surface_of(shape: AbstractShape, theta: PyTree) -> Discretization:
    """The surface of a shape, which may be a user's own, if it is one."""
    found = traced_call(shape, type(shape).__name__, theta)
    name = f"the surface of {type(shape).__name__}"
    return instance(found, Discretization, name, "surface.moved(points) makes one")


def checked_shape(found: Any, shape: AbstractShape, by: str) -> AbstractShape:
    """What a method of a shape made of it, if it is a shape."""
    return instance(found, AbstractShape, f"what {type(shape).__name__}.{by} returns")


def unchecked_surface(shape: AbstractShape, theta: PyTree) -> Discretization:
    """The surface, its lists in whatever state."""
    with marking():
        return _unchecked(shape, theta)


@sized_jit
def _unchecked(shape, theta):
    return surface_of(shape, theta)


def renewed_with_room(shape: AbstractShape, theta: PyTree, search: NeighborSearch) -> AbstractShape:
    """Renewed with a search, or where it has no room with one made for the points."""
    return checked_shape(with_room(type(shape).renewed, shape, theta, search), shape, "renewed")


def with_room(renew: Callable, shape, theta, search) -> AbstractShape:
    try:
        return renew(shape, theta, search)
    except ValueError:
        return renew(shape, theta, unchecked_surface(shape, theta).search(margin=2.0))


def with_wear(shape: AbstractShape) -> AbstractShape:
    """The same shape, whose surfaces know where their neighbours were found."""
    known = lambda x: x.cloud.points if x.found_at is None else x.found_at
    lists = lambda x: (x.neighbors, x.method, x.border, known(x))
    return _followed(shape, lambda x: Discretization(x.cloud, *lists(x)))


def _followed(shape: AbstractShape, change: Callable) -> AbstractShape:
    """A shape with every surface in it changed."""
    is_one = lambda x: isinstance(x, Discretization)
    return jax.tree.map(lambda x: change(x) if is_one(x) else x, shape, is_leaf=is_one)


def geometry(surface: Discretization) -> tuple[Array, Array]:
    return surface.cloud.points, surface.cloud.normals


def starts(cloud: PointCloud) -> tuple[Array, Array]:
    """Points and normals that a family moves: switched-off rows go where one that is on goes.

    Anywhere else a function of the user's may have no derivative, and 0 times that is NaN.
    """
    on = cloud.active
    if on is None:
        return cloud.points, cloud.normals
    first = jnp.argmax(on)
    along = lambda x: switched_off(on, x, x[first])
    return along(cloud.points), along(cloud.normals)


def spread_evenly(surface: Discretization, onto: Callable) -> tuple[Array, Array]:
    """Points and normals of a surface pushed apart, and put back `onto` it."""
    cloud = surface.cloud
    spacing = ideal_spacing(float(jnp.sum(surface.areas)), cloud.n, dim=cloud.dim)
    points, normals = relax(np.asarray(cloud.points), onto, spacing=spacing, steps=_SPREAD)
    return jnp.asarray(points, cloud.points.dtype), jnp.asarray(normals, cloud.points.dtype)


# Steps that spread points which the last have left nearly even.
_SPREAD = 10


def with_lists(surface: Discretization, found: Discretization) -> Discretization:
    """A surface with the lists of another of the same points."""
    lists = (found.neighbors, surface.method, surface.border, found.cloud.points)
    return Discretization(surface.cloud, *lists)
