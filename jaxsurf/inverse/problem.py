r"""What is minimised: how unlikely unknowns are, by data and priors, as a function of white noise.

$J(\xi) = \tfrac12 |r(\xi)|^2 + \tfrac12 |D \xi|^2$ with $r = (F(\theta(\xi)) - d) / \sigma$; D is
one where there is a prior, else zero.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, PyTree

from ..compiling import in_batches, sized_jit
from ..failures import marking, needs_values
from ..machine import PUSHED
from ..solve.krylov import scale_of
from ..time.run import forwards
from .priors import AbstractPrior

# Data see a direction where it bends J by more than so many roundings of one.
_UNSEEN = 100


def is_prior(x: Any) -> bool:
    return x is None or isinstance(x, AbstractPrior)


def each(f: Callable, prior: PyTree, *trees: PyTree) -> PyTree:
    """A function of the prior and what belongs to it of trees that look like the unknowns."""
    return jax.tree.map(f, prior, *trees, is_leaf=is_prior)


def pairs(prior: PyTree, tree: PyTree) -> list[tuple]:
    """Each prior or None with what belongs to it."""
    return list(zip(jax.tree.leaves(prior, is_leaf=is_prior), jax.tree.leaves(tree)))


class Problem(eqx.Module):
    """A model with its data, and how likely unknowns are before these are known.

    Args:
        forward: the model, of unknowns and args.
        args: its further arguments.
        data, noise: as it returns them, with their standard deviations.
        prior: as the unknowns, with a prior or None for each.
        unit: as the unknowns: what one is of those that have no prior.
    """

    forward: Callable
    args: tuple
    data: PyTree
    noise: PyTree
    prior: PyTree
    unit: PyTree

    def theta(self, xi: PyTree) -> PyTree:
        """The unknowns of white noise."""
        color = lambda prior, xi, unit: unit * xi if prior is None else prior.color(xi)
        return each(color, self.prior, xi, self.unit)

    def whitened(self, theta: PyTree) -> PyTree:
        white = lambda prior, x, unit: x / unit if prior is None else prior.whiten(x)
        return each(white, self.prior, theta, self.unit)

    def known(self, xi: PyTree) -> PyTree:
        """What of the noise has a prior, zero elsewhere."""
        return each(lambda prior, x: 0 * x if prior is None else x, self.prior, xi)

    def residual(self, theta: PyTree) -> Float[Array, " m"]:
        """Data that are missed, in standard deviations."""
        predicted = self.forward(theta, *self.args)
        off = lambda f, d, s: (f - d) / s
        return ravel_pytree(jax.tree.map(off, predicted, self.data, self.noise))[0]

    def energy(self, xi: PyTree) -> tuple[Float[Array, ""], tuple[Float[Array, " m"], PyTree]]:
        """J; and the residual and the unknowns."""
        theta = self.theta(xi)
        residual = self.residual(theta)
        return (jnp.sum(residual**2) + inner(self.known(xi), xi)) / 2, (residual, theta)


class Seen(NamedTuple):
    """J at a place, the residual, the unknowns, and the gradient where that was asked for."""

    energy: Float[Array, ""]
    residual: Float[Array, " m"]
    theta: PyTree
    gradient: PyTree = None


def inner(a: PyTree, b: PyTree) -> Float[Array, ""]:
    products = jax.tree.map(lambda a, b: jnp.sum(a * b), a, b)
    return jax.tree.reduce(jnp.add, products)


def size_of(a: PyTree) -> Float[Array, ""]:
    return jnp.sqrt(inner(a, a))


def along(xi: PyTree, step: PyTree, scale: Any) -> PyTree:
    return jax.tree.map(lambda x, s: (x + scale * s).astype(x.dtype), xi, step)


@contextlib.contextmanager
def _failing_softly():
    """What fails in a model gives no numbers; what has no derivative says the way to one."""
    try:
        with marking():
            yield
    except TypeError as error:
        if "forward-mode" not in str(error):
            raise
        raise TypeError(
            "forward has no derivative in forward mode, which steps of Gauss and Newton take: "
            "leave out an adjoint that has none, or ask for optimizer=optax.lbfgs()"
        ) from error


def seen(problem: Problem, xi: PyTree) -> Seen:
    """Energies; those of models that fail are no numbers."""
    with _failing_softly():
        return _known(_seen(problem, xi))


def slope(problem: Problem, xi: PyTree) -> Seen:
    """Energies with the gradient."""
    with _failing_softly():
        return _known(_slope(problem, xi))


def _known(found: Any) -> Any:
    needs_values("what forward and optimizer close over", found)
    return found


def newton(problem: Problem, xi: PyTree, now: Seen, tolerance: Any, max_steps: Any):
    """The step of Gauss and Newton, the gradient, the slope along the step, steps of the solver.

    And the square of what is left of the gradient along directions that data do not see.
    """
    with _failing_softly():
        return _newton(problem, xi, now, tolerance, max_steps)


def jacobian(problem: Problem, xi: PyTree, theta: PyTree, rows: bool) -> Float[Array, "m p"]:
    """Of the residual, row by row in reverse or column by column in forward mode."""
    with _failing_softly():
        return _jacobian(problem, xi, theta, rows)


@sized_jit
def _seen(problem, xi):
    energy, (residual, theta) = problem.energy(xi)
    return Seen(energy, residual, theta)


@sized_jit
def _slope(problem, xi):
    seen, gradient = jax.value_and_grad(problem.energy, has_aux=True)(xi)
    energy, (residual, theta) = seen
    return Seen(energy, residual, theta, gradient)


# Unknowns are given beside their noise: what would find them again is compiled nowhere.


def _pushed(problem: Problem, xi: PyTree, theta: PyTree) -> Callable:
    """Products with the Jacobian of the residual, in the noise."""
    colored = jax.linearize(problem.theta, xi)[1]
    with forwards():
        missed = jax.linearize(problem.residual, theta)[1]
    return lambda s: missed(colored(s))


def _pulled(problem: Problem, xi: PyTree, theta: PyTree) -> Callable:
    """Those with its transpose."""
    colored = jax.vjp(problem.theta, xi)[1]
    missed = jax.vjp(problem.residual, theta)[1]
    return lambda r: colored(*missed(r))[0]


@sized_jit
def _newton(problem, xi, now: Seen, tolerance, max_steps):
    """By conjugate gradients, to residuals and last moves of this share of the gradient.

    The gradient is found in their loop, the first time round: the linearised model and its adjoint,
    which are nearly all of the program, are compiled once. (Those of lineax have them three times.)
    It is solved for at size one: products of large numbers are infinite in single precision. A
    direction that data do not see ends the loop.
    """
    push, pull = (f(problem, xi, now.theta) for f in (_pushed, _pulled))
    none = jax.tree.map(jnp.zeros_like, xi)

    def more(carry):
        count, gradient, step, left, p, squared, _ = carry
        first = count == 0
        pick = lambda a, b: jax.tree.map(lambda a, b: jnp.where(first, a, b), a, b)
        w = along(pull(pick(now.residual, push(p))), problem.known(pick(xi, p)), 1)
        bent, size = inner(p, w), inner(p, p)
        sound = first | (bent > _UNSEEN * jnp.finfo(bent.dtype).eps * size)
        length = jnp.where(sound, squared / bent, 0)
        step = pick(step, along(step, p, length))
        left = pick(along(none, w, -1 / _largest(w)), along(left, w, -length))
        remains = jnp.where(sound, inner(left, left), 0)
        p = pick(left, along(left, p, remains / squared))
        moved = jnp.where(first, jnp.inf, length**2 * size)
        return count + 1, pick(w, gradient), step, left, p, remains, moved

    def unfinished(carry):
        count, gradient, *_, squared, moved = carry
        small = tolerance * size_of(along(none, gradient, 1 / _largest(gradient)))
        large = jnp.maximum(squared, moved) > small**2
        return (count == 0) | (large & (squared > 0) & (count <= max_steps))

    start = (jnp.asarray(0), *[none] * 4, *[inner(none, none)] * 2)
    count, gradient, step, left, _, squared, _ = jax.lax.while_loop(unfinished, more, start)
    step, left = (along(none, a, _largest(gradient)) for a in (step, left))
    unseen = jnp.where(squared == 0, inner(left, left), 0)
    return step, gradient, inner(step, gradient), count - 1, unseen


def _largest(a: PyTree) -> Float[Array, ""]:
    return scale_of(ravel_pytree(a)[0])


@sized_jit
def conjugate(step, gradient, falls, before: tuple):
    """A step made conjugate to that before (Polak and Ribière), where both agree, and its slope.

    Args:
        falls: the slope along the step.
        before: the gradient there, the slope along the step of Gauss and Newton there, and the
            direction that was taken.
    """
    there, fell, direction = before
    share = jnp.maximum((falls - inner(step, there)) / fell, 0)
    both = along(step, direction, share)
    slope = inner(both, gradient)
    good = slope < falls / 2
    return jax.tree.map(lambda a, b: jnp.where(good, a, b), (both, slope), (step, falls))


def descent(optimizer, problem, xi, now: Seen, state):
    """Updates by an optimiser of optax, and its state."""
    return _known(_descent(optimizer, problem, xi, now, state))


@sized_jit
def _descent(optimizer, problem, xi, now: Seen, state):
    optimizer = optax.with_extra_args_support(optimizer)
    energy = lambda xi: problem.energy(xi)[0]
    about = dict(value=now.energy, grad=now.gradient, value_fn=energy)
    return optimizer.update(now.gradient, state, xi, **about)


def free_columns(problem: Problem, theta: PyTree) -> Float[Array, "m z"]:
    """Of the Jacobian, those of unknowns without a prior."""
    with _failing_softly():
        return _free_columns(problem, theta)


@sized_jit
def _free_columns(problem, theta):
    free = [x for prior, x in pairs(problem.prior, theta) if prior is None]
    flat, unravel = ravel_pytree(free)

    def residual(flat):
        ours = iter(unravel(flat))
        return problem.residual(
            each(lambda prior, x: next(ours) if prior is None else x, problem.prior, theta)
        )

    with forwards():
        push = jax.linearize(residual, flat)[1]
    return in_batches(push, jnp.eye(flat.size, dtype=flat.dtype), PUSHED).T


@sized_jit
def _jacobian(problem, xi, theta, rows):
    if not rows:
        flat, unravel = ravel_pytree(xi)
        push = _pushed(problem, xi, theta)
        columns = lambda e: push(unravel(e))
        return in_batches(columns, jnp.eye(flat.size, dtype=flat.dtype), PUSHED).T
    missed = jax.eval_shape(problem.residual, theta)
    pull = _pulled(problem, xi, theta)
    return in_batches(
        lambda e: ravel_pytree(pull(e))[0], jnp.eye(missed.size, dtype=missed.dtype), PUSHED
    )
