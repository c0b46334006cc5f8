r"""What moves a surface: velocities, their sums and multiples."""

from __future__ import annotations

import abc
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, PyTree

from ..arguments import as_float, real, switched_off, traced_call
from ..discretization import Discretization
from ..failures import is_concrete, raise_at
from ..functions import numbers_as_arrays

# Of the longest vector of a sliding, what its parts along normals may be: normals are not exact.
_OFF = 0.1


class AbstractMotion(eqx.Module):
    r"""A velocity of the points of a surface, normal and tangential.

    A motion of one's own defines `velocity`. Where that holds `derivatives` of the positions,
    explicit steps of the length that accuracy asks for are unstable; `pull` says what implicit
    steps are to treat implicitly. Motions are added, and multiplied by numbers.

    Example:
        >>> class Inflation(js.AbstractMotion):
        ...     def velocity(self, t, surface, fields, args):
        ...         return surface.cloud.normals
        >>> isinstance(Inflation(), js.AbstractMotion)
        True
    """

    @property
    def derivatives(self) -> int:
        """The highest order of derivatives of the positions that velocity holds."""
        return 0

    def pull(self, surface: Discretization) -> Callable[[Array], Array] | None:
        """The stiff part of the velocity, linear in positions; None if there is none or not known.

        An operator or an equinox module, whose arrays are kept for a step.
        """
        return None

    @abc.abstractmethod
    def velocity(self, t, surface: Discretization, fields: PyTree[Array], args) -> Array:
        """The velocity of the surface and what is on it, `(n, d)`, in length / time."""

    @property
    def slides(self) -> bool:
        """Whether points move along the surface beside that, as `sliding` says."""
        return False

    def sliding(self, t, surface: Discretization, fields: PyTree[Array], args) -> Array:
        """How they do, `(n, d)`, tangential, while fields stay where they are."""
        raise NotImplementedError

    def check(self, t, surface: Discretization, fields: PyTree[Array], args) -> None:
        """Raise what is seen to be wrong from numbers at the start of a run; by default that
        `sliding` is off the surface."""
        if not self.slides:
            return
        slide = vectors(self, "sliding", t, surface, fields, args)
        slide = switched_off(surface.cloud.active, slide)
        off = jnp.abs(jnp.sum(slide * surface.cloud.normals, axis=1))
        text = (
            f"sliding of {type(self).__name__} leaves the surface at point {{i}}: {{v:.3g}} of it "
            "is along the normal, expected a vector along the surface; what moves that is velocity"
        )
        raise_at(np.asarray(off > _OFF * jnp.max(jnp.linalg.norm(slide, axis=1))), text, off)

    def __add__(self, other: AbstractMotion) -> AbstractMotion:
        return MotionSum(self._parts + other._parts) if _is_motion(other) else NotImplemented

    def __mul__(self, factor: ArrayLike) -> AbstractMotion:
        if _is_motion(factor):
            return NotImplemented
        # Backwards, what smooths is ill-posed.
        number = real(factor, "factor", above=0) if self.derivatives else real(factor, "factor")
        return MotionSum([(number * share, motion) for share, motion in self._parts])

    __rmul__ = __mul__

    @property
    def _parts(self) -> list[tuple[ArrayLike, AbstractMotion]]:
        return [(1.0, self)]


class Motion(AbstractMotion):
    r"""A velocity given as a function of time, surface and fields.

    Args:
        velocity: `(t, surface, fields, args) -> (n, d)`, of operations of JAX. The surface is a
            `Discretization` where it is at time t: `surface.cloud.points`, `.cloud.normals`,
            `.mean_curvature`, ...; what is not asked for is not computed.

    Example:
        >>> motion = js.Motion(lambda t, surface, fields, args: 0.5 * surface.cloud.normals)
        >>> end = js.evolve(motion, js.sphere(300), t1=1.0).clouds[-1]
        >>> bool(jnp.abs(jnp.linalg.norm(end.points, axis=1) - 1.5).max() < 1e-6)
        True
    """

    function: Callable

    def __init__(self, velocity: Callable):
        if not callable(velocity):
            raise TypeError(
                f"velocity is a {type(velocity).__name__}, expected a function "
                "(t, surface, fields, args)"
            )
        self.function = velocity

    def velocity(self, t, surface, fields, args):
        return traced_call(self.function, "velocity", t, surface, fields, args)


class MotionSum(AbstractMotion):
    """Motions, each by a factor, one after another: what sums and multiples of motions are."""

    parts: list[tuple[ArrayLike, AbstractMotion]] = eqx.field(converter=numbers_as_arrays)

    @property
    def _parts(self):
        return self.parts

    @property
    def derivatives(self):
        return max(motion.derivatives for _, motion in self.parts)

    def pull(self, surface):
        pulls = [(factor, motion.pull(surface)) for factor, motion in self.parts]
        known = [(factor, pull) for factor, pull in pulls if pull is not None]
        return _Pulls(known) if known else None

    def velocity(self, t, surface, fields, args):
        given = (t, surface, fields, args)
        each = [factor * vectors(motion, "velocity", *given) for factor, motion in self.parts]
        return sum(each[1:], each[0])

    @property
    def slides(self):
        return any(motion.slides for _, motion in self.parts)

    def sliding(self, t, surface, fields, args):
        parts = [(factor, motion) for factor, motion in self.parts if motion.slides]
        given = (t, surface, fields, args)
        each = [factor * vectors(motion, "sliding", *given) for factor, motion in parts]
        return sum(each[1:], each[0])

    def check(self, t, surface, fields, args):
        for _, motion in self.parts:
            motion.check(t, surface, fields, args)

    def __repr__(self):
        number = lambda x: f"{float(x):g}" if is_concrete(x) else "traced"
        return " + ".join(f"{number(factor)} * {motion!r}" for factor, motion in self.parts)


def vectors(motion: AbstractMotion, what: str, t, surface: Discretization, fields, args) -> Array:
    """The "velocity" or "sliding" of a motion: a vector for each point, of the type of points."""
    points = surface.cloud.points
    found = getattr(motion, what)(t, surface, fields, args)
    return as_float(found, f"{what} of {type(motion).__name__}", points.shape).astype(points.dtype)


class _Pulls(eqx.Module):
    parts: list[tuple[ArrayLike, Callable]]

    def __call__(self, x):
        each = [factor * pull(x) for factor, pull in self.parts]
        return sum(each[1:], each[0])


def _is_motion(value: Any) -> bool:
    return isinstance(value, AbstractMotion)


def checked_motion(motion: Any) -> AbstractMotion:
    if not _is_motion(motion):
        raise TypeError(
            f"motion is a {type(motion).__name__}, expected js.Motion(velocity) or "
            "js.MeanCurvatureFlow(), say"
        )
    return motion
