r"""One call from a model and noisy data to the likeliest unknowns, and how sure they are."""

from __future__ import annotations

import time
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, PyTree

from ..arguments import as_float, floating, further, instance, real, whole
from ..design.lagrangian import started, strong
from ..design.outcome import OptimizationError
from ..failures import needs_values
from .asked import in_sight, priors, refuse, told_units, with_noise
from .posterior import Posterior, posterior_of
from .priors import AbstractPrior
from .problem import (
    Problem,
    Seen,
    along,
    conjugate,
    descent,
    newton,
    seen,
    size_of,
    slope,
)

# A step is shortened so often,
_SHORTENED = 12
# until J falls by this share of what its slope promises; differences of J below the second number,
# which is nothing to a likelihood, are not looked at, as solves leave that much.
_ARMIJO, _NOTHING = 1e-4, 1e-6
# What solves in the model leave may end it where so many deviations are left: no error.
_ROUGH = 0.1
# A step that goes past the least of J along it, which is there at this share of it or before, is
# tried again as long as that: else data that the model misses, whose part in the second derivative
# Gauss and Newton leave out, take steps to and fro. For the same reason steps are conjugate.
_PAST = 0.75
# The next step is first tried as long as this one should have been, but not shorter than this.
_SHARE = 0.1
# No step may be longer in any part of the white noise: what is likely before the data lies within.
_LONGEST = 3.0
# Data that are missed by so much, in deviations squared, are not where to stay without a step.
_MISSED = 4.0
# The first step of Gauss and Newton is solved for to this share, later ones better.
_FORCING = 0.5
_COLUMNS = ("energy", "misfit", "gradient", "decrement", "linear_steps", "shortened", "seconds")


class Inversion(eqx.Module):
    r"""The likeliest unknowns, and the way there: made by `solve_inverse`.

    Args:
        theta: the unknowns, as at the start.
        predictions: of the data.
        energy: $J$, minus the logarithm of the posterior density up to a constant.
        misfit: $|(F(\theta) - d) / \sigma|^2$ over the number of data: about 1 where the model
            and the noise are right, above where data are missed, below where noise is fitted.
        history: by names `(steps + 1,)`: `energy`, `misfit`, norm of the `gradient`, `decrement`,
            `linear_steps`, how often a step was `shortened`, `seconds`.
        converged: whether the tolerance was reached.
        stopped: why it ended.

    Example:
        >>> times = jnp.linspace(0.1, 2, 40)
        >>> decay = lambda rate: jnp.exp(-rate * times)
        >>> found = js.solve_inverse(decay, jnp.array(1.0), decay(1.5), noise=0.01)
        >>> found.converged, bool(abs(found.theta - 1.5) < 1e-3)
        (True, True)
    """

    theta: PyTree[Array]
    predictions: PyTree[Array]
    energy: Float[Array, ""]
    misfit: Float[Array, ""]
    history: dict[str, np.ndarray]
    converged: bool
    stopped: str
    problem: Problem
    xi: PyTree[Array]

    def posterior(self) -> Posterior:
        """How sure the unknowns are.

        It takes a linearised model for each of the data or unknowns, whichever are fewer, and
        memory for the product of both numbers.

        Raises:
            ValueError: unknowns without a prior that the data do not tell apart there.
        """
        scaled = bool(self.history["linear_steps"].any())
        return posterior_of(self.problem, self.xi, self.theta, scaled)

    def __repr__(self):
        rows = self.history
        return (
            f"Inversion(misfit {float(self.misfit):.3g} a datum, energy {float(self.energy):.6g} "
            f"from {rows['energy'][0]:.6g}, {len(rows['energy']) - 1} steps; {self.stopped})"
        )


def solve_inverse(
    forward: Callable[..., PyTree[Array]],
    theta: PyTree[Float[Array, "..."]],
    data: PyTree[Float[Array, "..."]],
    *,
    noise: PyTree[Float[Array, "..."] | float],
    prior: PyTree[AbstractPrior | None] = None,
    args: tuple = (),
    optimizer: optax.GradientTransformation | None = None,
    steps: int = 100,
    linear_steps: int = 200,
    tol: float | None = None,
    throw: bool = True,
) -> Inversion:
    r"""Unknowns of a model from noisy data: a coefficient, a source, an initial state, a rate.

    Minimises $J = \tfrac12 |(F(\theta) - d) / \sigma|^2 + \tfrac12 |\xi|^2$ over white noise
    $\xi$, with $\theta = \bar\theta + A \xi$ as the prior has it: minus the logarithm of the
    posterior density. By default by the method of Gauss and Newton, its steps by conjugate
    gradients with products of the linearised model and its adjoint, solved for the better the
    nearer the minimum is (Eisenstat and Walker 1996), shortened to three deviations of the prior
    and to where a parabola along them says that J is least. The number of linear steps does not
    grow with the number of unknowns, as the prior preconditions them.

    Args:
        forward: $F$, of the unknowns and `args`; returns what is measured, in any pytree. Of
            `js.solve`, `js.integrate`, `surface.interpolate(u, sensors)` and what JAX has. For
            unknowns that are positive take the exponential in it.
        theta: where to start, any pytree of floating-point arrays.
        data: $d$, as the model returns them.
        noise: $\sigma$, standard deviations: a number, or like the data, or one for each array.
        prior: as theta, of `js.GaussianPrior`, `js.MaternPrior`, or None for what the data have to
            determine alone.
        args: further arguments of the model; other values compile nothing.
        optimizer: of optax, for steps of first order in $\xi$ instead: `optax.lbfgs()`, say. It
            needs no forward mode, and more steps.
        steps: at most.
        linear_steps: of conjugate gradients a step, at most.
        tol: it has converged where the step of Gauss and Newton (of first order: the gradient) is
            this many standard deviations of the posterior long. If None 1e-3, in single precision
            0.05. Of first order, unknowns without a prior have no deviations to begin with: those
            are estimated from the gradient and the misfit at the first theta.
        throw: raise where it cannot go on; if False, see `stopped`.

    Returns:
        `Inversion`: `theta`, `predictions`, `misfit`, `history`; its `posterior()` has standard
        deviations and samples. Steps that are used up are no error.

    Accuracy: of the model and its derivatives, to `tol` deviations; of a rate in float32 to a
        twentieth of one (`tests/test_inverse.py`).
    Raises:
        TypeError: a model, priors, an optimiser that are none; unknowns that are no floating-point
            arrays; a model that has no derivative in forward mode, unless steps of first order
            are asked for (`js.integrate` has both modes if it is not given an `adjoint`).
        ValueError: data, noise or priors of other shapes than the model's; noise that is not
            positive; data or predictions that are not finite (named by number); unknowns without
            a prior on which the data do not depend at the first theta, or that they do not tell
            apart there: the system of Gauss and Newton is singular (steps of first order have
            none); traced arrays.
        OptimizationError: no step lowers J; its `solution` has the best unknowns so far.

    Example:
        >>> surface = js.discretize(js.sphere(400), method=js.GFDM(degree=2))
        >>> x = surface.cloud.points
        >>> def temperature(source):
        ...     return js.solve(1 - surface.laplacian, source, mean_zero=False).value[::10]
        >>> data = temperature(x[:, 2])
        >>> prior = js.MaternPrior(surface, deviation=1.0, length=2.0)
        >>> found = js.solve_inverse(
        ...     temperature, jnp.zeros(400), data, noise=0.01, prior=prior)
        >>> found.converged, bool(jnp.abs(found.theta - x[:, 2]).max() < 0.4)
        (True, True)
    """
    if not callable(forward):
        raise TypeError(f"forward is a {type(forward).__name__}, expected a function")
    if optimizer is not None:
        instance(optimizer, optax.GradientTransformation, "optimizer", "optax.lbfgs(), say")
    steps = whole(steps, "steps", least=1)
    linear_steps = whole(linear_steps, "linear_steps", least=1)
    needs_values("theta, data, noise, prior and args", theta, data, noise, prior, args)
    theta, args = strong(floating(theta, "theta")), further(args)
    prior = priors(prior, theta)
    for name, given in (("data", data), ("noise", noise)):
        if not jax.tree.leaves(given):
            raise TypeError(f"{name} is {given!r}, expected numbers")
    data = jax.tree.map(lambda d: as_float(d, "data"), data)
    problem = Problem(forward, args, data, noise, prior, jax.tree.map(jnp.ones_like, theta))
    problem = with_noise(problem, theta)
    dtype = jnp.result_type(*jax.tree.leaves(theta))
    tol = (1e-3 if jnp.finfo(dtype).bits > 32 else 0.05) if tol is None else tol
    tol = real(tol, "tol", above=0)
    found, failed = _run(problem, theta, optimizer, steps, linear_steps, float(tol))
    if failed and throw:
        raise OptimizationError(found.stopped, found)
    return found


def _run(problem, theta, optimizer, steps, linear_steps, tol) -> tuple[Inversion, bool]:
    """What is found, and whether it failed."""
    clock = time.perf_counter()
    rows: dict[str, list] = {name: [] for name in _COLUMNS}
    look = seen if optimizer is None else slope
    xi = strong(problem.whitened(theta))
    now = look(problem, xi)
    refuse(problem, theta, now)
    if optimizer is None:
        problem, xi = in_sight(problem, theta)
    if optimizer is not None:
        state, units = started(optimizer, xi), told_units(problem, now)
    first, forcing, stopped, failed = 0.0, _FORCING, "", False

    def note(size, decrement, linear=0, shortened=0):
        m = now.residual.size
        known = (now.energy, jnp.sum(now.residual**2) / m, size, decrement, linear, shortened)
        for name, x in zip(_COLUMNS, (*known, time.perf_counter() - clock)):
            rows[name].append(float(x))

    linear, shortened, before, share = 0, 0, None, 1.0
    while not stopped:
        missed = float(jnp.mean(now.residual**2)) > _MISSED
        if optimizer is None:
            step, gradient, falls, linear, unseen = newton(
                problem, xi, now, np.asarray(forcing), np.asarray(linear_steps)
            )
            size, decrement = size_of(gradient), jnp.sqrt(jnp.maximum(-falls, 0) + unseen)
            after = gradient, falls
            if before is not None:
                step, falls = conjugate(step, *after, before)
            before = *after, step
        else:
            step, state = descent(optimizer, problem, xi, now, state)
            size, falls = size_of(jax.tree.map(jnp.multiply, units, now.gradient)), None
            # A first theta that is the likeliest has no gradient by which to measure others.
            at_rest = not (rows["energy"] or missed)
            decrement = size_of(now.gradient) if at_rest else size
        first = first or float(size)
        forcing = min(_FORCING, max(float(size) / max(first, 1e-300), 1e-12) ** 0.5)
        note(size, decrement, linear, shortened)
        if float(size) == 0 and len(rows["energy"]) == 1 and missed:
            stopped = "the derivative of J vanishes at the first theta, where data are missed"
            failed = True
        elif float(decrement) <= tol:
            stopped = "converged"
        elif not np.isfinite(float(decrement)):
            stopped, failed = "the derivative of the model is not finite", True
        elif len(rows["energy"]) > steps:
            stopped = f"all {steps} steps used"
        if stopped:
            continue
        longest = max(float(jnp.max(jnp.abs(x))) for x in jax.tree.leaves(problem.known(step)))
        scale = min(share, _LONGEST / max(longest, _LONGEST))
        found, shortened, least = _lower(look, problem, xi, now, step, falls, scale)
        share = min(max(least, _SHARE), 1.0) if least is not None else share
        if found is None:
            stopped = f"steps were shortened {_SHORTENED} times, and none lowers J"
            failed = float(decrement) > _ROUGH
        else:
            xi, now = found
    return _found(problem, xi, now, rows, stopped), failed


def _lower(look, problem: Problem, xi, now: Seen, step, falls, scale: float):
    """Where along a step J is lower, if it is, after how many tries; where it is least, if known.

    Args:
        falls: the slope of J along the step; None of steps that are taken as they are.
        scale: how much of the step is tried first.
    """
    taken = None
    for shortened in range(_SHORTENED + 1):
        there = along(xi, step, scale)
        then = look(problem, there)
        if taken is not None:
            return min(taken, (there, then), key=lambda one: float(one[1].energy)), shortened, scale
        finite = bool(np.isfinite(then.energy))
        if finite and falls is None:
            return (there, then), shortened, None
        if not finite:
            scale = scale / 2
            continue
        # The parabola with the slope here that has J there.
        slope, rise = scale * float(falls), float(then.energy - now.energy)
        known = rise - slope > _NOTHING
        least = -scale * slope / (2 * max(rise - slope, _NOTHING))
        if rise > _ARMIJO * slope + _NOTHING:
            scale = min(max(least, 0.1 * scale), 0.5 * scale)
        elif known and least < _PAST * scale:
            taken, scale = (there, then), least
        else:
            return (there, then), shortened, least if known else None
    return taken, _SHORTENED, None


def _found(problem: Problem, xi, now: Seen, rows, stopped: str) -> Inversion:
    off = ravel_pytree(problem.data)[1](now.residual)
    predictions = jax.tree.map(lambda d, s, r: d + s * r, problem.data, problem.noise, off)
    history = {name: np.array(values) for name, values in rows.items()}
    return Inversion(
        now.theta, predictions, now.energy, jnp.mean(now.residual**2), history,
        stopped == "converged", stopped, problem, xi,
    )  # fmt: skip
