r"""What is minimised: an objective and constraints on surfaces, as one function of parameters."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Bool, Float, Int, PyTree

from ..arguments import as_float, traced_call
from ..compiling import sized_jit
from ..discretization import Discretization
from ..failures import marking, needs_values
from ..functions import Traced, canonical
from ..motion import judged, unreached
from .crossing import crosses, pierces
from .shape import AbstractShape, surface_of

# Lists are found anew once points outside may come as near as this share of the farthest in them.
_WORN = 0.75
# Beside the codes of `Discretization.code`.
CROSSED = 6


class Multipliers(NamedTuple):
    r"""Forces of the constraints: $\lambda$, $\nu \ge 0$, and the penalty $\mu$."""

    equalities: dict[str, Array]
    inequalities: dict[str, Array]
    penalty: Array


def weightless(multipliers: Multipliers) -> Multipliers:
    """Those with which nothing counts but the objective, for the same program."""
    nothing, mu = jax.tree.map(jnp.zeros_like, multipliers), multipliers.penalty
    return nothing._replace(penalty=jnp.full_like(mu, jnp.finfo(mu.dtype).tiny))


def with_penalty(multipliers: Multipliers, factor: float) -> Multipliers:
    """With so many times the penalty; no program is compiled for the product."""
    mu = multipliers.penalty
    return multipliers._replace(penalty=jnp.asarray(factor * np.asarray(mu), mu.dtype))


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


class Violation(eqx.Module):
    r"""What constraints are off by, $\tfrac12 \sum h^2 + \tfrac12 \sum \max(0, g)^2$."""

    equalities: dict[str, Callable]
    inequalities: dict[str, Callable]

    def __call__(self, surface, *args):
        off = [h(surface, *args) for h in self.equalities.values()]
        off += [jnp.maximum(0, g(surface, *args)) for g in self.inequalities.values()]
        return sum(jnp.sum(x**2) for x in off) / 2


def first_penalty(values: Values) -> Array:
    """Ten objectives, or 10: less where constraints are so far off that they cost twenty with less.

    As ALGENCAN begins. One that drowns the objective takes the straightest way to the constraints,
    which may lead through folds; with much less, to give one up may cost less than to keep it.
    """
    off = [*values.equalities.values()]
    off += [jnp.maximum(0, g) for g in values.inequalities.values()]
    amount = sum(jnp.sum(x**2) for x in off)
    return 10 * jnp.maximum(1, jnp.abs(values.objective)) / jnp.maximum(1, amount / 4)


class Asked(NamedTuple):
    """What the user minimises: functions of a surface and of `args`, and of parameters."""

    objective: Callable
    equalities: dict[str, Callable]
    inequalities: dict[str, Callable]
    project: Callable | None

    def measured(self, surface: Discretization, args: tuple) -> tuple[Array, dict, dict]:
        """Objective, equalities and inequalities."""
        value = lambda f, name: _number(traced_call(f, name, surface, *args), name)
        each = lambda some: {name: value(f, f"constraint {name!r}") for name, f in some.items()}
        return value(self.objective, "objective"), each(self.equalities), each(self.inequalities)


def _number(found: Any, name: str) -> Array:
    """What a function of the user's returns, which has to have a slope."""
    if bool in [getattr(x, "dtype", type(x)) for x in jax.tree.leaves(found)]:
        raise TypeError(f"{name} is true or false, expected a number: a - b in place of a > b, say")
    if isinstance(found, tuple | list):
        kind = type(found).__name__
        raise TypeError(f"{name} is a {kind}, expected one array of numbers: jnp.stack makes one")
    if jnp.issubdtype(getattr(found, "dtype", float), jnp.integer):
        raise TypeError(
            f"{name} is of type {found.dtype}, which has no slope: expected real numbers"
        )
    return as_float(found, name)


class _Aside:
    """What a problem was made of: what its programs do not tell, they are not told apart by."""

    def __init__(self, asked: Asked, others: PyTree, theta: PyTree):
        self.asked, self.others, self.theta = asked, others, theta

    def __eq__(self, other):
        return isinstance(other, _Aside)

    def __hash__(self):
        return 0


class Problem(eqx.Module):
    r"""Minimise $f(S(\theta))$ under $h(S(\theta)) = 0$ and $g(S(\theta)) \le 0$.

    The augmented Lagrangian is $f + \sum (\lambda h + \tfrac\mu2 h^2) + \sum \tfrac1{2\mu}
    (\max(0, \nu + \mu g)^2 - \nu^2)$: NaN where the surface is not one.

    Functions are the programs that they are, so that the same code with other numbers in it, or
    another shape of the same size, compiles nothing.

    Args:
        arrays: of the shape, where neighbours are renewed; else they are in the program.
        seen: what is wrong with the surface, whether its lists are worn, and what is measured.
        project: to parameters that are allowed.
        args: of the user's functions.
    """

    arrays: list[Array]
    seen: Traced
    project: Traced | None
    args: tuple
    _made_of: _Aside = eqx.field(static=True)

    @classmethod
    def of(cls, asked: Asked, shape: AbstractShape, theta, args: tuple, renew: bool) -> Problem:
        """For shapes of these arrays, or for this one."""
        arrays, others = eqx.partition(shape, eqx.is_array if renew else False)
        arrays, structure = jax.tree.flatten(arrays)

        def seen(arrays, theta, args):
            shape = eqx.combine(jax.tree.unflatten(structure, arrays), others)
            surface = surface_of(shape, theta)
            return *_judged(surface), asked.measured(surface, args)

        with marking():
            project = None if asked.project is None else canonical(asked.project, theta)
            made_of = _Aside(asked, others, theta)
            return cls(arrays, canonical(seen, arrays, theta, args), project, args, made_of)

    def at(self, shape: AbstractShape) -> Problem:
        """The same with other arrays of the shape; with other programs where it is another kind."""
        if not self.arrays:
            return self
        arrays, others = eqx.partition(shape, eqx.is_array)
        flat = jax.tree.leaves(arrays)
        sizes = lambda some: [(a.shape, a.dtype) for a in some]
        made_of = self._made_of
        if sizes(flat) != sizes(self.arrays) or not eqx.tree_equal(others, made_of.others):
            return Problem.of(made_of.asked, shape, made_of.theta, self.args, True)
        return eqx.tree_at(lambda problem: problem.arrays, self, flat)

    def lagrangian(self, theta: PyTree, multipliers: Multipliers) -> tuple[Array, Any]:
        code, worn, (f, h, g) = self.seen(self.arrays, theta, self.args)
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
        found = _evaluated(problem, theta, multipliers, updates, jnp.asarray(scale))
    needs_values("what functions, shape and optimizer close over", found)
    return found


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

    def seen(there):
        # A search in single precision may go on in double.
        of_type = lambda new, old: new.astype(old.dtype)
        with jax.disable_jit(False):
            values = look(jax.tree.map(of_type, there, theta))
        return values.lagrangian, jax.tree.map(of_type, values.gradient, there)

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


def kinds(problem: Problem, theta: PyTree) -> tuple:
    """Shapes and types of objective, equalities and inequalities."""
    return eqx.filter_eval_shape(problem.seen, problem.arrays, theta, problem.args)[2]
