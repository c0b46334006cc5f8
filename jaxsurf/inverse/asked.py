"""What an inverse problem asks of what it is given, and whether data tell its unknowns apart."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import PyTree

from ..arguments import as_float, instance, traced_call
from ..design.lagrangian import strong
from ..failures import raise_at
from .priors import AbstractPrior
from .problem import Problem, Seen, each, free_columns, is_prior, pairs

# Unknowns are not told apart where data change by less than this many roots of the last digit.
_SINGULAR = 10.0


def _structure(tree: PyTree) -> Any:
    return jax.tree.structure(tree, is_leaf=is_prior)


def priors(prior, theta) -> PyTree:
    """One prior or None for each array of the unknowns."""
    for given in jax.tree.leaves(prior, is_leaf=is_prior):
        if not is_prior(given):
            instance(given, AbstractPrior, "prior", "js.GaussianPrior(deviation=1.0), say")
    if prior is None:
        return jax.tree.map(lambda _: None, theta)
    have, want = _structure(prior), _structure(theta)
    if have != want:
        raise ValueError(
            f"prior has the structure {have}, theta {want}: one prior or None for each array"
        )
    for given, x in pairs(prior, theta):
        if given is None:
            continue
        try:
            shape = jax.eval_shape(given.whiten, x).shape
        except (ValueError, TypeError) as error:
            raise ValueError(f"prior of unknowns of shape {x.shape}: {error}") from error
        if shape != x.shape:
            raise ValueError(f"prior of unknowns of shape {x.shape}: it is of shape {shape}")
    return prior


def with_noise(problem: Problem, theta) -> Problem:
    """With standard deviations for all data, which the model has to predict."""
    predicted = eqx.filter_eval_shape(traced_call, problem.forward, "forward", theta, *problem.args)
    if not jax.tree.leaves(predicted):
        raise TypeError(f"forward returns {predicted!r}, expected arrays like the data")
    have, want = _structure(problem.data), _structure(predicted)
    if have != want:
        raise ValueError(f"data have the structure {have}, forward returns {want}")
    for d, f in zip(jax.tree.leaves(problem.data), jax.tree.leaves(predicted)):
        if not jnp.issubdtype(getattr(f, "dtype", object), jnp.floating):
            kind = getattr(f, "dtype", type(f).__name__)
            raise TypeError(f"forward returns {kind}, expected floating-point numbers")
        if d.shape != f.shape:
            raise ValueError(f"data have shape {d.shape}, forward returns {f.shape}")
        raise_at(~np.isfinite(d).ravel(), "datum {i} is {v}, expected a number", np.ravel(d))
    like = lambda s: jax.tree.map(lambda _: s, problem.data)
    noise = problem.noise
    if _structure(noise) != have:
        if _structure(noise) != _structure(0):
            raise ValueError(
                f"noise has the structure {_structure(noise)}, expected a number or {have}"
            )
        noise = like(noise)

    def spread(s, d):
        s = as_float(s, "noise")
        if s.shape not in ((), d.shape):
            raise ValueError(f"noise has shape {s.shape}, expected one number or {d.shape}")
        bad = ~(np.isfinite(s) & (np.asarray(s) > 0)).ravel()
        raise_at(bad, "noise of datum {i} is {v:g}, expected a positive number", np.ravel(s))
        return jnp.broadcast_to(s, d.shape).astype(d.dtype)

    noise = jax.tree.map(spread, noise, problem.data)
    return eqx.tree_at(lambda p: p.noise, problem, noise)


def in_sight(problem: Problem, theta) -> tuple[Problem, PyTree]:
    """Unknowns without a prior in units that data can see, and the white noise at theta.

    Raises:
        ValueError: data do not tell them apart.
    """
    free = [x for prior, x in pairs(problem.prior, theta) if prior is None]
    if not free:
        return problem, strong(problem.whitened(theta))
    columns = free_columns(problem, theta)
    sizes = told_apart(np.asarray(columns), "the first theta")
    flat, unravel = ravel_pytree(free)
    units = iter(unravel(jnp.asarray(1 / sizes, flat.dtype)))
    unit = each(lambda prior, x: next(units) if prior is None else x, problem.prior, problem.unit)
    problem = eqx.tree_at(lambda p: p.unit, problem, unit)
    return problem, strong(problem.whitened(theta))


def told_units(problem: Problem, now: Seen) -> PyTree:
    """What the gradient in each unknown is measured in, at the first theta.

    With a prior it is without a unit. Without one, the deviation that data would tell if they
    changed with the unknowns as the gradient says: by no less, for the residual that there is.
    """
    size = jnp.sqrt(jnp.sum(now.residual**2))

    def unit(prior, slope):
        along = jnp.sqrt(jnp.sum(slope**2))
        told = size / jnp.where(along > 0, along, 1)
        return jnp.where((along > 0) & (prior is None), told, 1).astype(slope.dtype)

    return each(unit, problem.prior, now.gradient)


def told_apart(columns: np.ndarray, where: str, *, scaled: bool = False) -> np.ndarray:
    """How much data change with each unknown without a prior.

    Args:
        columns: of the Jacobian, those of these unknowns, `(m, z)`.
        scaled: the units of these unknowns are what data could see at the start.

    Raises:
        ValueError: data do not tell them apart, or the derivative of the model is not finite.
    """
    text = (
        f" at {where}: the system of Gauss and Newton is singular; give them a prior, "
        "js.GaussianPrior(1.0), say"
    )
    m, z = columns.shape
    if m < z:
        raise ValueError(f"{m} data for {z} unknowns without a prior{text}")
    sizes = np.linalg.norm(columns, axis=0)
    unknown = "unknown {i} of those without a prior"
    bad = f"the derivative of the data in {unknown} is {{v}} at {where}"
    raise_at(~np.isfinite(sizes), bad, sizes)
    enough = _SINGULAR * np.finfo(columns.dtype).eps ** 0.5
    nothing = sizes <= (enough if scaled else 0)
    raise_at(nothing, f"no datum depends on {unknown}{text}")
    least = np.linalg.svd(columns / sizes, compute_uv=False).min(initial=1.0)
    if not least > enough:
        raise ValueError(
            f"data do not tell {z} unknowns without a prior apart: of changes of size one, in "
            f"units that data can see, one changes them by {least:.1g} only{text}"
        )
    return sizes


def refuse(problem: Problem, theta, now: Seen) -> None:
    """Say what is not good at the start."""
    if np.isfinite(now.energy):
        return
    problem.forward(theta, *problem.args)  # may say why
    text = "the prediction of datum {i} is not finite at the first theta"
    raise_at(~np.isfinite(now.residual), text)
    raise ValueError("J is not finite at the first theta")
