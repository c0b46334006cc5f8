r"""What moves a surface: a given velocity, or its own curvature."""

from __future__ import annotations

import abc
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from ..arguments import instance
from ..discretization import Discretization
from ..stencils.algebra import AbstractOperator


class AbstractMotion(eqx.Module):
    r"""A velocity of the points of a surface, normal and tangential.

    A motion of one's own defines `velocity`. Where that holds derivatives of the positions,
    explicit steps of the length that accuracy asks for are unstable: such a motion is `stiff`, and
    may say by `pull` what implicit steps are to treat implicitly.

    Example:
        >>> class Inflation(js.AbstractMotion):
        ...     def velocity(self, t, surface, fields, args):
        ...         return surface.cloud.normals
        >>> isinstance(Inflation(), js.AbstractMotion)
        True
    """

    @property
    def stiff(self) -> bool:
        """True if velocity holds derivatives of the positions."""
        return False

    def pull(self, surface: Discretization) -> AbstractOperator | None:
        """The stiff part of the velocity, as an operator on positions; None if there is none."""
        return None

    @abc.abstractmethod
    def velocity(self, t, surface: Discretization, fields: PyTree[Array], args) -> Array:
        """The velocity of the points `(n, d)`, in length / time."""


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
        return self.function(t, surface, fields, args)


class MeanCurvatureFlow(AbstractMotion):
    r"""Mean curvature flow $v = -H\,n$, with $H = \tfrac12\nabla\cdot n$, $v = \tfrac12\Delta x$.

    A unit sphere shrinks as $r' = -1/r$. A curve moves by half its curvature.

    Args:
        keep_volume: add the mean of H along the normal, so that the enclosed volume is kept; closed
            surfaces only.

    Source: Suchde and Kuhnert 2019, eqs. 36 to 38.

    Example:
        >>> flow = js.MeanCurvatureFlow()
        >>> end = js.evolve(flow, js.sphere(300), t1=0.1, method=js.GFDM(degree=4)).clouds[-1]
        >>> bool(jnp.abs(jnp.linalg.norm(end.points, axis=1) - 0.8**0.5).max() < 1e-3)
        True
    """

    keep_volume: bool = eqx.field(static=True)

    def __init__(self, keep_volume: bool = False):
        self.keep_volume = bool(instance(keep_volume, (bool, np.bool_), "keep_volume"))

    @property
    def stiff(self):
        return True

    def pull(self, surface):
        return surface.laplacian / 2

    def velocity(self, t, surface, fields, args):
        cloud = surface.cloud
        toward: Float[Array, "n d"] = surface.laplacian(cloud.points) / 2
        if not self.keep_volume:
            return toward
        outward = -jnp.sum(toward * cloud.normals, axis=1)
        return toward + surface.mean(outward) * cloud.normals


def checked_motion(motion: Any) -> AbstractMotion:
    if not isinstance(motion, AbstractMotion):
        raise TypeError(
            f"motion is a {type(motion).__name__}, expected js.Motion(velocity) or "
            "js.MeanCurvatureFlow(), say"
        )
    return motion
