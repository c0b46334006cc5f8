r"""Points and fields as one state: the surface is made anew from the points of every stage."""

from __future__ import annotations

from collections.abc import Callable

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from ..arguments import switched_off
from ..cloud import PointCloud
from ..discretization import Discretization
from ..failures import is_concrete, marking, warn
from ..functions import numbers_as_arrays
from ..motion import carried, moved_cloud
from ..normals import refit_normals
from ..stencils.stencil import Stencil
from ..time.explicit import RKC2
from ..time.higher import WaveEquation
from ..time.implicit import IMEX
from ..time.problem import AbstractEvolution
from .contact import Faced
from .motions import AbstractMotion, vectors
from .tolerances import RelativeToSurface


class Moving(AbstractEvolution):
    r"""$\dot x = v$ and $\dot u + u\,\nabla\cdot v = f(u)$ on the surface that moves.

    Args:
        surface: where it was when its neighbours were found.
        gradient: of the surface there, which tells normals from positions.
        motion: v.
        on: makes the problem of the fields from a surface; None: fields go with the points.
        faced: what points are kept apart from.
        beside: what normals were there beside those of local fits, if the motion slides.
        pull: the stiff part of v on the surface of a state, see `at`.
        problem: that of the fields there.
    """

    closure: None
    surface: Discretization
    gradient: Stencil
    motion: AbstractMotion
    on: Callable | None
    faced: Faced | None = None
    beside: Float[Array, "n d"] | None = None
    pull: Callable[[Array], Array] | None = None
    problem: AbstractEvolution | None = None

    @property
    def _moves(self) -> bool:
        return True

    @classmethod
    def of(
        cls,
        surface: Discretization,
        motion: AbstractMotion,
        on: Callable | None,
        faced: Faced | None = None,
    ) -> Moving:
        points, normals = surface.cloud.points, surface.cloud.normals
        fitted = lambda: normals - fitted_normals(surface, points, normals)
        beside = fitted() if motion.slides else None
        return cls(None, surface, surface.gradient, motion, on, faced, beside)

    def surface_at(self, points: Array) -> Discretization:
        """The surface with its points elsewhere."""
        return self.surface.moved(points, self._normals(points))

    def cloud_at(self, points: Array) -> PointCloud:
        """Its cloud, where neighbours are to be found anew: those there were need not serve."""
        return moved_cloud(self.surface.cloud, points, self._normals(points), lambda: self.gradient)

    def _normals(self, points: Array) -> Array:
        before = self.surface.cloud
        normals = carried(self.gradient, before.normals, before.points, points)[0]
        if self.beside is not None:
            # Each point its own way, by up to a spacing: that is not smooth, the surface is.
            normals = fitted_normals(self.surface, points, normals) + self.beside
            normals = normals / jnp.linalg.norm(normals, axis=1, keepdims=True)
        return switched_off(self.active, normals, before.normals)

    @property
    def active(self):
        return self.surface.cloud.active

    @property
    def operators(self):
        """Those of the fields are those of their own problem; points go where they are taken."""
        return [self.gradient] if self.motion.derivatives else []

    def suggested_solver(self):
        if self.motion.derivatives > 2 and self.motion.pull(self.surface) is not None:
            return IMEX(order=3), "IMEX(order=3): a velocity with derivatives of high order"
        if self.motion.derivatives:
            return RKC2(), "RKC2: a velocity by curvature, by explicit steps with many stages"
        if self.on is None:
            return dfx.Tsit5(), "Tsit5: a velocity without derivatives is not stiff"
        return self.on(self.surface).suggested_solver()

    def controller(self, rtol, atol, shortest):
        return RelativeToSurface(rtol, atol, dtmin=shortest, force_dtmin=False, active=self.active)

    def tell_small(self, u0, atol):
        """Nothing: positions are small by where the origin is, of fields `evolve` tells."""

    def rate(self, t, u, args):
        points, fields = parted(u)
        surface = self.surface_at(points)
        problem = None if self.on is None else self.on(surface)
        _check_made_here(problem, points)
        fields = self._filled(t, surface, fields, args, problem)
        velocity = self._velocity(t, surface, fields, args)
        changes = [jax.tree.map(jnp.zeros_like, fields)]
        if problem is not None:
            dilution = problem.dilution(fields, surface.divergence(velocity))
            changes += [problem.rate(t, fields, args), dilution]
        if self.motion.slides:
            slide = vectors(self.motion, "sliding", t, surface, fields, args)
            passed = lambda u: jnp.einsum("nx,n...x->n...", slide, surface.gradient(u))
            changes, velocity = [*changes, jax.tree.map(passed, fields)], velocity + slide
        return self._free(joined(velocity, jax.tree.map(lambda *each: sum(each), *changes)))

    def at(self, t, u):
        points, fields = parted(u)
        surface, problem = self.surface_at(points), None
        if self.on is not None:
            problem = self.on(surface)
            problem = numbers_as_arrays(problem.at(t, problem.closed(t, fields)))
        frozen = self.motion.pull(surface), problem
        parts = lambda moving: (moving.pull, moving.problem)
        return eqx.tree_at(parts, self, frozen, is_leaf=lambda x: x is None)

    def linear(self, t, u):
        points, fields = parted(u)
        pulled = jnp.zeros_like(points) if self.pull is None else self.pull(points)
        if self.problem is None:
            return joined(pulled, jax.tree.map(jnp.zeros_like, fields))
        return joined(pulled, self.problem.implicit_rate(t, fields, None))

    def rest(self, t, u, args):
        return jax.tree.map(jnp.subtract, self.rate(t, u, args), self.linear(t, u))

    def closed(self, t, u):
        points, fields = parted(u)
        at_rest = fields if self.on is None else self.on(self.surface_at(points)).closed(t, fields)
        return joined(points, at_rest)

    def fields(self, t, u: PyTree[Array], args) -> PyTree[Array]:
        """With their bound values filled in, and rates of those at the speed of the surface."""
        points, fields = parted(u)
        surface = self.surface_at(points)
        problem = None if self.on is None else self.on(surface)
        return self._filled(t, surface, fields, args, problem)

    def _velocity(self, t, surface: Discretization, fields, args) -> Float[Array, "n d"]:
        points = surface.cloud.points
        # A step that is tried may take the surface to where it has none: it is refused, and a
        # shorter one is tried.
        with marking():
            velocity = vectors(self.motion, "velocity", t, surface, fields, args)
        if self.faced is None:
            return velocity
        return self.faced.kept_apart(points, surface.cloud.normals, surface.shape_tensor, velocity)

    def _filled(self, t, surface: Discretization, fields, args, problem) -> PyTree[Array]:
        """Bound entries as conditions say; those of a wave's velocity along the paths of points.

        A condition on a border that moves changes with its place: that is part of the velocity.
        """
        if problem is None:
            return fields
        fields = problem.closed(t, fields)
        if not isinstance(problem, WaveEquation) or problem.closure is None or self.on is None:
            return fields
        value, rate = fields
        points, on = surface.cloud.points, self.on
        filled = lambda t, x, value: on(self.surface_at(x)).closed(t, (value, rate))[0]
        now = (jnp.asarray(t, points.dtype), points, value)
        speeds = (jnp.ones_like(now[0]), self._velocity(t, surface, fields, args), rate)
        return jax.jvp(filled, now, speeds)


def _check_made_here(problem: AbstractEvolution | None, points: Array) -> None:
    """Say so where operators are known before the surface is, as those of another are."""
    if problem is None or is_concrete(points):
        return
    arrays = [jax.tree.leaves(eqx.filter(each, eqx.is_array)) for each in problem.operators]
    if any(held and is_concrete(held) for held in arrays):
        warn(
            "an operator of the problem is not made from the surface that it is given, but stays "
            "that of another: lambda surface: js.AdvectionDiffusionReaction(surface.laplacian), say"
        )


def fitted_normals(surface: Discretization, points: Array, normals: Array) -> Array:
    """Normals of the operators' order of a surface through points that are elsewhere."""
    degree = surface.method.polynomial_degree
    return refit_normals(points, normals, surface.neighbors, degree=degree)


def joined(points: Array, fields: PyTree[Array]) -> tuple:
    """A state of points and fields, if there are any (diffrax takes no empty parts)."""
    return (points, fields) if jax.tree.leaves(fields) else (points,)


def parted(state: tuple) -> tuple[Array, PyTree[Array]]:
    return state if len(state) == 2 else (*state, ())
