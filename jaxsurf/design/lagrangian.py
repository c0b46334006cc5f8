r"""What is minimised: an objective and constraints on surfaces, as one function of parameters."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Float, Int, PyTree

from ..arguments import as_float, traced_call
from ..compiling import sized_jit
from ..discretization import Discretization
from ..failures import marking
from ..functions import Traced, canonical
from ..motion import judged, unreached
from .crossing import crosses, pierces
from .shape import AbstractShape

# Lists are found anew once points outside may come as near as this share of the farthest in them.
_WORN = 0.75
# Beside the codes of `Discretization.code`.
CROSSED = 6


class Multipliers(NamedTuple):
    r"""Forces of the constraints: $\lambda$, $\nu \ge 0$, and the penalty $\mu$."""

    equalities: dict[str, Array]
    inequalities: dict[str, Array]
    penalty: Array


class Values(NamedTuple):
    """What is seen of a surface.

    Args:
        objective, equalities, inequalities: as the user's functions have them.
        violation: the largest of a constraint, in its units.
        lagrangian: what is minimised.
        gradient: of that, in the parameters.
        size: the norm of the gradient; under a projection, of the step along it that this leaves.
        code: what is wrong: 0 nothing, 1 points that are not finite, 2 a fold, 3 a Lagrangian
            or gradient that is not, 4 lists of neighbours that no longer reach, 6 a surface that
            passes through itself.
        worn: whether lists of neighbours should be found anew.
        forced: the multipliers that the constraints were met with.
    """

    objective: Float[Array, ""]
    equalities: dict[str, Array]
    inequalities: dict[str, Array]
    violation: Float[Array, ""]
    lagrangian: Float[Array, ""]
    gradient: PyTree[Array]
    size: Float[Array, ""]
    code: Int[Array, ""]
    worn: Bool[Array, ""]
    forced: Multipliers


class Problem(eqx.Module):
    r"""Minimise $f(S(\theta))$ under $h(S(\theta)) = 0$ and $g(S(\theta)) \le 0$.

    The augmented Lagrangian is $f + \sum (\lambda h + \tfrac\mu2 h^2) + \sum \tfrac1{2\mu}
    (\max(0, \nu + \mu g)^2 - \nu^2)$: NaN where the surface is not one.
    """

    shape: AbstractShape | Callable
    objective: Callable
    equalities: dict[str, Callable]
    inequalities: dict[str, Callable]
    args: tuple
    project: Callable | None

    def measured(self, surface: Discretization) -> tuple[Array, dict, dict]:
        """Objective, equalities and inequalities."""
        value = lambda f, name: as_float(traced_call(f, name, surface, *self.args), name)
        each = lambda some: {name: value(f, f"constraint {name!r}") for name, f in some.items()}
        return value(self.objective, "objective"), each(self.equalities), each(self.inequalities)

    def lagrangian(self, theta: PyTree, multipliers: Multipliers) -> tuple[Array, Any]:
        surface = self.shape(theta)
        code, worn = _judged(surface)
        f, h, g = self.measured(surface)
        lambdas, nus, mu = multipliers
        value, violation, forces = f, jnp.zeros_like(f), Multipliers({}, {}, mu)
        for name, x in h.items():
            forces.equalities[name] = lambdas[name] + mu * x
            value = value + jnp.sum(lambdas[name] * x + mu / 2 * x**2)
            violation = jnp.maximum(violation, jnp.max(jnp.abs(x)))
        for name, x in g.items():
            forces.inequalities[name] = force = jnp.maximum(0, nus[name] + mu * x)
            value = value + jnp.sum(force**2 - nus[name] ** 2) / (2 * mu)
            # A force where there is no contact is as wrong.
            off = jnp.maximum(x, -nus[name] / mu)
            violation = jnp.maximum(violation, jnp.max(jnp.abs(off)))
        value = jnp.where(code > 0, jnp.nan, value)
        return value, (f, h, g, violation, code, worn, forces)

    def projected(self, theta: PyTree) -> PyTree:
        """The nearest parameters that are allowed."""
        return theta if self.project is None else self.project(theta)


def _judged(surface: Discretization) -> tuple[Array, Array]:
    """What is wrong with a surface, and whether its lists are worn."""
    fixed = jax.lax.stop_gradient(surface)
    cloud, neighbors, found_at = fixed.cloud, fixed.neighbors, fixed.found_at
    code = jnp.max(judged(cloud, neighbors, jnp.zeros(cloud.n, cloud.points.dtype)))
    crossed = crosses if fixed.border is None else pierces
    code = jnp.where((code == 0) & crossed(cloud, neighbors), CROSSED, code)
    if found_at is None:
        return code, jnp.zeros((), bool)
    far = lambda *share: jnp.any(unreached(found_at, cloud.points, neighbors, *share))
    return jnp.where((code == 0) & far(), 4, code), far(_WORN)


def evaluated(problem, theta, multipliers, updates=None, scale=1.0) -> tuple[PyTree, Values]:
    """Parameters after a share of some updates, and what is seen there."""
    updates = jax.tree.map(jnp.zeros_like, theta) if updates is None else updates
    with marking():
        return _evaluated(problem, theta, multipliers, updates, jnp.asarray(scale))


@sized_jit
def _evaluated(problem: Problem, theta, multipliers, updates, scale):
    updates = jax.tree.map(lambda u: scale.astype(u.dtype) * u, updates)
    theta = problem.projected(optax.apply_updates(theta, updates))
    differentiated = jax.value_and_grad(problem.lagrangian, has_aux=True)
    (value, (f, h, g, violation, code, worn, forces)), gradient = differentiated(theta, multipliers)
    size = optax.tree.norm(gradient)
    if problem.project is not None:
        # What a step along the gradient would change.
        there = problem.projected(jax.tree.map(jnp.subtract, theta, gradient))
        size = optax.tree.norm(jax.tree.map(jnp.subtract, theta, there))
    ill = ~(jnp.isfinite(value) & jnp.isfinite(size) & jnp.isfinite(violation))
    code = jnp.where((code == 0) & ill, 3, code)
    seen = Values(f, h, g, violation, value, gradient, size, code, worn, forces)
    return strong((theta, seen))


def direction(
    optimizer, look: Callable[[PyTree], Values], theta, values: Values, state
) -> tuple[PyTree, Any]:
    """Updates of the parameters and the state of the optimiser, which may search along a line.

    Args:
        look: what is seen at other parameters.
    """
    try:
        return _direction(optimizer, theta, values, state)
    except _Searches:
        pass

    @jax.custom_vjp
    def lagrangian(theta):
        return seen(theta)[0]

    def seen(theta):
        with jax.disable_jit(False):
            values = look(theta)
        return values.lagrangian, values.gradient

    slopes = lambda gradient, scale: (jax.tree.map(lambda g: scale * g, gradient),)
    lagrangian.defvjp(seen, slopes)
    # A search calls the program that is there; in a program of its own that would be compiled anew.
    with jax.disable_jit():
        return strong(_updated(optimizer, theta, values, state, lagrangian))


class _Searches(Exception):
    """An optimiser asks for the function."""


@sized_jit
def _direction(optimizer, theta, values, state):
    def lagrangian(theta):
        raise _Searches

    return strong(_updated(optimizer, theta, values, state, lagrangian))


def _updated(optimizer, theta, values, state, lagrangian):
    optimizer = optax.with_extra_args_support(optimizer)
    along = dict(value=values.lagrangian, grad=values.gradient, value_fn=lagrangian)
    return optimizer.update(values.gradient, state, theta, **along)


@sized_jit
def started(optimizer, theta):
    """The state of an optimiser before its first step."""
    return strong(optimizer.init(theta))


def strong(tree: PyTree) -> PyTree:
    """The same arrays, none of them weakly typed: what comes out can go in again."""
    return jax.tree.map(lambda x: jnp.asarray(x, jnp.asarray(x).dtype), tree)


def computed(problem: Problem, theta: PyTree) -> list[Traced]:
    """What the user's functions compute, as programs, which tell them apart."""
    measured = lambda theta: problem.measured(problem.shape(theta))
    with marking():
        return [canonical(f, theta) for f in (measured, problem.projected)]


def kinds(problem: Problem, theta: PyTree) -> tuple:
    """Shapes and types of objective, equalities and inequalities."""
    with marking():
        return eqx.filter_eval_shape(_kinds, problem, theta)


@sized_jit
def _kinds(problem, theta):
    return problem.measured(problem.shape(theta))
