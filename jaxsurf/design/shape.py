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

from ..arguments import as_float, differentiable, finite, instance, pair, switched_off
from ..cloud import PointCloud
from ..compiling import sized_jit
from ..discretization import Discretization
from ..failures import check, marking, not_positive, raise_at
from ..frames import frames_of
from ..functions import Traced, canonical
from ..motion import crossed
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
        onto: takes points `(n, d)` next to the reference to it; returns points and unit normals on
            the side where those of the reference are. With it `renewed` spreads points evenly over
            the surface again, by moving those of the reference (of a base that is a shape it does
            not). Then no number of an objective may belong to a point, as a load given by an
            array, or a point by its index, would.

    Differentiable: forward and reverse in theta, for fixed neighbours.
    Raises:
        TypeError: f or onto that is no function, a base that is neither discretisation nor shape.
        ValueError: at a theta for which f returns no point, or folds or flattens the surface; an
            onto for a shape, or for a surface with border or mask.

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
    onto: Callable[[Float[Array, "n d"]], tuple[Array, Array]] | None = None

    def __check_init__(self):
        check_function(self.f, "f")
        instance(self.base, (Discretization, AbstractShape), "base", "js.discretize makes one")
        if self.onto is None:
            return
        check_function(self.onto, "onto")
        if isinstance(self.base, AbstractShape):
            raise ValueError("onto is for a surface that is mapped: base is a shape")
        for name in ("boundary", "active"):
            if getattr(self.base.cloud, name) is not None:
                raise ValueError(f"onto is for surfaces without {name}: this one has some")

    def __call__(self, theta: PyTree) -> Discretization:
        if isinstance(self.base, AbstractShape):
            own, theta = pair(theta, "theta", "parameters of the shape and of the map")
            surface = self.base(own)
        else:
            surface = self.base
        points, normals = starts(surface.cloud)
        images, normals, area = _mapped(self._program(theta, points), points, normals)
        text = "f flattens the surface at point {i}: it stretches areas there by {v}"
        on = surface.cloud.active
        check(switched_off(on, area, 1), not_positive, text)
        return surface.moved(images, switched_off(on, normals, surface.cloud.normals))

    def _program(self, theta: PyTree, points: Float[Array, "n d"]) -> Traced:
        """The map of one point."""
        point = jax.ShapeDtypeStruct(points.shape[1:], points.dtype)
        apply = lambda x: self.f(x, theta)
        found = differentiable(apply, "f", point)
        if getattr(found, "shape", None) != point.shape:
            what = getattr(found, "shape", type(found).__name__)
            raise ValueError(f"f returns {what} for one point, expected {point.shape}")
        return canonical(apply, jnp.zeros(point.shape, point.dtype))

    def renewed(self, theta: PyTree, search: NeighborSearch) -> AbstractShape:
        """As of any shape; with `onto` points are also spread evenly again."""
        reference, base = self.onto, self.base
        if reference is None or isinstance(base, AbstractShape):
            return super().renewed(theta, search)
        surface, place = unchecked_surface(self, theta), geometry(base)
        _check_onto(reference(place[0]), *place)
        program, dtype = self._program(theta, place[0]), place[0].dtype

        def onto(x):
            """Where the map comes nearest to x, by Newton's method on the reference."""
            nonlocal place
            there, x = place, jnp.asarray(x, dtype)
            for _ in range(_PULLS):
                points, normals = reference(_pulled(program, *there, x))
                there = jnp.asarray(points, dtype), jnp.asarray(normals, dtype)
            images, normals, _ = _mapped(program, *there)
            good = jnp.all(jnp.isfinite(images) & jnp.isfinite(normals), axis=1)[:, None]
            place = jnp.where(good, there[0], place[0]), jnp.where(good, there[1], place[1])
            return images, normals

        found = surface.moved(*spread_evenly(surface, onto), search=search)
        cloud = eqx.tree_at(lambda c: (c.points, c.normals), base.cloud, place)
        lists = (base.neighbors, base.method, base.border)
        anew = with_lists(Discretization(cloud, *lists), found)
        return eqx.tree_at(lambda s: s.base, self, anew)


def _check_onto(found, points, normals) -> None:
    """Refuse what is no projection to the side that a reference has."""
    if not (isinstance(found, (tuple, list)) and len(found) == 2):
        raise TypeError(f"onto returns a {type(found).__name__}, expected points and normals")
    images = as_float(found[0], "onto: points", points.shape)
    turned = as_float(found[1], "onto: normals", points.shape)
    finite(images, "onto: points")
    length = jnp.linalg.norm(turned, axis=1)
    raise_at(abs(length - 1) > 1e-3, "onto: normal {i} has length {v:.3g}, expected 1", length)
    cosine = jnp.sum(turned * normals, axis=1)
    text = "onto: normal {i} has the cosine {v:.3g} with that of the reference, expected above 0"
    raise_at(~(cosine > 0), text, cosine)


# Newton steps back to the reference: points move by a fifth of the spacing at a time.
_PULLS = 3


@eqx.filter_jit
def _mapped(f: Traced, points, normals):
    """Images of points, unit normals there, and how f stretches areas."""
    images, moved = _moved(f, points, frames_of(normals)[:, :-1])
    normals = crossed(moved)
    area = jnp.sqrt(jnp.sum(normals**2, axis=1))
    return images, normals / area[:, None], area


@eqx.filter_jit
def _pulled(f: Traced, points, normals, wanted):
    """Points whose images are nearer to those wanted, by a step along the tangents."""
    tangents = frames_of(normals)[:, :-1]
    images, moved = _moved(f, points, tangents)
    metric = jnp.einsum("nad,nbd->nab", moved, moved)
    along = jnp.einsum("nad,nd->na", moved, wanted - images)
    step = jnp.linalg.solve(metric, along[..., None])[..., 0]
    return points + jnp.einsum("na,nad->nd", step, tangents)


def _moved(f, points, tangents):
    """Images of points and of tangents there."""

    def single(x, tangents):
        images, moved = jax.vmap(lambda t: jax.jvp(f, (x,), (t,)))(tangents)
        return images[0], moved

    return jax.vmap(single)(points, tangents)


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
