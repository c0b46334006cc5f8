"""A surface or another shape under a map with parameters."""

from __future__ import annotations

import math
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from ..arguments import as_float, differentiable, finite, instance, pair, switched_off
from ..discretization import Discretization
from ..failures import check, not_positive, raise_at
from ..frames import frames_of
from ..functions import Traced, canonical
from ..motion import crossed, unjudged
from ..renew import NeighborSearch
from .shape import (
    AbstractShape,
    check_function,
    geometry,
    renewed_with_room,
    spread_evenly,
    starts,
    surface_of,
    unchecked_surface,
    with_lists,
    with_room,
)


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
            the surface again, by moving those of the reference (a base that is a shape spreads its
            own). Then no number of an objective may belong to a point, as a load given by an
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
            own, theta = _parts(theta)
            with unjudged():
                surface = surface_of(self.base, own)
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
        """As of any shape; a base that is one is renewed itself; `onto` spreads points evenly."""
        reference, base = self.onto, self.base
        if isinstance(base, AbstractShape):
            anew = self._over(renewed_with_room(base, _parts(theta)[0], search))
            return AbstractShape.renewed(anew, theta, search)
        if reference is None:
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
        return self._over(with_lists(Discretization(cloud, *lists), found))

    def rebuilt(self, theta: PyTree, search: NeighborSearch | None = None) -> AbstractShape:
        """On other points where a base that is a shape is, with neighbours that images have."""
        if not isinstance(self.base, AbstractShape):
            return self
        base = self.base.rebuilt(_parts(theta)[0], search)
        if base is self.base:
            return self
        anew = self._over(base)
        before, now = (unchecked_surface(shape, theta) for shape in (self, anew))
        if np.array_equal(before.cloud.points, now.cloud.points):
            return anew
        return with_room(AbstractShape.renewed, anew, theta, search or now.search())

    def _over(self, base: Discretization | AbstractShape) -> MappedShape:
        """The map of another base."""
        return eqx.tree_at(lambda shape: shape.base, self, base)


def _parts(theta: PyTree) -> tuple:
    return pair(theta, "theta", "parameters of the shape and of the map")


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


# Terms of the series of a rotation, which are less than the last digit for angles below 1.
_TERMS = 9
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
        cos, sin = jnp.cos(turn), jnp.sin(turn)
        return jnp.stack([cos * x[0] - sin * x[1], sin * x[0] + cos * x[1]]) + shift
    once = jnp.cross(turn, x)
    first, second = _rodrigues(jnp.sum(turn**2))
    return x + first * once + second * jnp.cross(turn, once) + shift


def _rodrigues(s):
    r"""$\sin a / a$ and $(1 - \cos a) / a^2$ of the square of an angle: smooth at 0 too."""
    near = s < 1
    small, a = jnp.where(near, s, 0), jnp.sqrt(jnp.where(near, 1, s))

    def series(start: int):
        terms = [(-1) ** k / math.factorial(2 * k + start) for k in range(_TERMS)]
        return jnp.polyval(jnp.array(terms[::-1], s.dtype), small)

    first = jnp.where(near, series(1), jnp.sin(a) / a)
    return first, jnp.where(near, series(2), (1 - jnp.cos(a)) / a**2)
