"""Shapes with parameters: θ ↦ a discretisation, differentiable, with the arrays of a reference."""

from __future__ import annotations

import abc
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from ..arguments import as_float, differentiable, finite, instance, pair, switched_off
from ..compiling import sized_jit
from ..discretization import Discretization
from ..failures import check, marking, not_positive
from ..frames import frames_of
from ..functions import Traced, canonical
from ..motion import crossed
from ..normals import refit_normals
from ..renew import NeighborSearch


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
        is compiled again. Most shapes always have the same parts, and need not write this.

        Args:
            theta: where.
            search: as for `renewed`; if None, or without room enough, one made for the points.

        Raises:
            ValueError: there is no surface at theta, or none that can be sampled.
        """
        return self


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
        check_function(self.f, "f")
        instance(self.base, (Discretization, AbstractShape), "base", "js.discretize makes one")

    def __call__(self, theta: PyTree) -> Discretization:
        if isinstance(self.base, AbstractShape):
            own, theta = pair(theta, "theta", "parameters of the shape and of the map")
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
        check_surface(surface)
        start = jnp.zeros_like(surface.cloud.points[:, 0]) if start is None else start
        self.surface = surface
        self.start = finite(as_float(start, "start", (surface.n,)), "start", surface.cloud.active)

    def __call__(self, theta: Float[Array, " n"]) -> Discretization:
        theta = as_float(theta, "displacements", (self.surface.n,))
        cloud = self.surface.cloud
        return self.surface.moved(cloud.points + (theta - self.start)[:, None] * cloud.normals)

    def renewed(self, theta: Float[Array, " n"], search: NeighborSearch) -> NormalShape:
        """As of any shape; the surface at theta is the reference, its normals fitted again."""
        surface = unchecked_surface(self, theta)
        points, normals, degree = *geometry(surface), surface.method.polynomial_degree
        normals = refit_normals(points, normals, surface.neighbors, degree=degree)
        found = surface.moved(points, normals, search=search)
        return NormalShape(with_lists(found, found), theta)


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
    turn, shift = pair(theta, "theta", "a rotation and a shift")
    turn = as_float(turn, "rotation", () if len(x) == 2 else (3,))
    shift = as_float(shift, "shift", x.shape)
    if len(x) == 2:
        matrix = jnp.array([[0.0, -1.0], [1.0, 0.0]], turn.dtype) * turn
    else:
        matrix = jnp.cross(turn, jnp.eye(3, dtype=turn.dtype)).T
    return jax.scipy.linalg.expm(matrix) @ x + shift


def check_function(f: Any, name: str) -> None:
    if not callable(f):
        raise TypeError(f"{name} is a {type(f).__name__}, expected a function of x and theta")


def check_surface(surface: Any) -> None:
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


def geometry(surface: Discretization) -> tuple[Array, Array]:
    return surface.cloud.points, surface.cloud.normals


def with_lists(surface: Discretization, found: Discretization) -> Discretization:
    """A surface with the lists of another of the same points."""
    lists = (found.neighbors, surface.method, surface.border, found.cloud.points)
    return Discretization(surface.cloud, *lists)
