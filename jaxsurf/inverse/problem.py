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
import lineax as lx
import optax
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, PyTree

from ..compiling import sized_jit
from ..failures import marking, needs_values
from ..machine import PUSHED
from ..time.run import forwards
from .priors import AbstractPrior


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

    def residual(self, xi: PyTree) -> Float[Array, " m"]:
        """Data that are missed, in standard deviations."""
        predicted = self.forward(self.theta(xi), *self.args)
        off = lambda f, d, s: (f - d) / s
        return ravel_pytree(jax.tree.map(off, predicted, self.data, self.noise))[0]

    def energy(self, xi: PyTree) -> tuple[Float[Array, ""], Float[Array, " m"]]:
        """J, and the residual."""
        residual = self.residual(xi)
        return (jnp.sum(residual**2) + inner(self.known(xi), xi)) / 2, residual


class Seen(NamedTuple):
    """J at a place, the residual, and the gradient where that was asked for."""

    energy: Float[Array, ""]
    residual: Float[Array, " m"]
    gradient: PyTree = None


def inner(a: PyTree, b: PyTree) -> Float[Array, ""]:
    products = jax.tree.map(lambda a, b: jnp.sum(a * b), a, b)
    return jax.tree.reduce(jnp.add, products)


def size_of(a: PyTree) -> Float[Array, ""]:
    return jnp.sqrt(inner(a, a))


def along(xi: PyTree, step: PyTree, scale: Any) -> PyTree:
    return jax.tree.map(lambda x, s: x + scale * s, xi, step)


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


def newton(problem: Problem, xi: PyTree, tolerance: Any, max_steps: Any):
    """The step of Gauss and Newton, the gradient, the slope along the step, steps of the solver."""
    with _failing_softly():
        return _newton(problem, xi, tolerance, max_steps)


def jacobian(problem: Problem, xi: PyTree, rows: bool) -> Float[Array, "m p"]:
    """Of the residual, row by row in reverse or column by column in forward mode."""
    with _failing_softly():
        return _jacobian(problem, xi, rows)


@sized_jit
def _seen(problem, xi):
    return Seen(*problem.energy(xi))


@sized_jit
def _slope(problem, xi):
    (energy, residual), gradient = jax.value_and_grad(problem.energy, has_aux=True)(xi)
    return Seen(energy, residual, gradient)


def _pushed(f: Callable, x: PyTree) -> Callable:
    """Products with its Jacobian."""
    with forwards():
        return jax.linearize(f, x)[1]


@sized_jit
def _newton(problem, xi, tolerance, max_steps):
    push = _pushed(problem.residual, xi)
    residual, pulled = jax.vjp(problem.residual, xi)
    pull = lambda r: pulled(r)[0]
    plus = lambda a, b: jax.tree.map(jnp.add, a, b)
    gradient = plus(pull(residual), problem.known(xi))
    hessian = lx.FunctionLinearOperator(
        lambda s: plus(pull(push(s)), problem.known(s)),
        jax.eval_shape(lambda: xi),
        lx.positive_semidefinite_tag,
    )
    size = size_of(gradient)
    # lineax compares component by component, in which a right-hand side may pass through zero.
    small = jnp.where(size > 0, size, 1) * tolerance
    # Residuals from the recurrence: another product to renew them is as much again to compile, and
    # steps are solved for to a few digits.
    solver = lx.CG(0.0, small, norm=size_of, stabilise_every=None, max_steps=max_steps)
    down = jax.tree.map(jnp.negative, gradient)
    found = lx.linear_solve(hessian, down, solver, throw=False)
    return found.value, gradient, inner(found.value, gradient), found.stats["num_steps"]


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


def free_columns(problem: Problem, xi: PyTree) -> Float[Array, "m z"]:
    """Of the Jacobian, those of unknowns without a prior."""
    with _failing_softly():
        return _free_columns(problem, xi)


@sized_jit
def _free_columns(problem, xi):
    free = [x for prior, x in pairs(problem.prior, xi) if prior is None]
    flat, unravel = ravel_pytree(free)

    def residual(flat):
        ours = iter(unravel(flat))
        return problem.residual(
            each(lambda prior, x: next(ours) if prior is None else x, problem.prior, xi)
        )

    push = _pushed(residual, flat)
    return jax.lax.map(push, jnp.eye(flat.size, dtype=flat.dtype), batch_size=PUSHED).T


@sized_jit
def _jacobian(problem, xi, rows):
    flat, unravel = ravel_pytree(xi)
    of_flat = lambda flat: problem.residual(unravel(flat))
    if not rows:
        push = _pushed(of_flat, flat)
        return jax.lax.map(push, jnp.eye(flat.size, dtype=flat.dtype), batch_size=PUSHED).T
    residual, pulled = jax.vjp(of_flat, flat)
    pull = lambda r: pulled(r)[0]
    return jax.lax.map(pull, jnp.eye(residual.size, dtype=residual.dtype), batch_size=PUSHED)
