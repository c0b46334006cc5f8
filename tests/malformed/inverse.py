"""Unknowns from noisy data."""

# One case a line reads as a table.
# ruff: noqa: E501

import functools

import jax
import jax.numpy as jnp
import numpy as np
import optax

import jaxsurf as js

from . import Case
from .design import surface

THREE = jnp.array([1.0, 2.0, 3.0])
ONE = jnp.array(1.0)


def line(theta):
    return theta * THREE


def inverted(forward=line, theta=ONE, data=THREE, noise=0.1, **options):
    return lambda: js.solve_inverse(forward, theta, data, noise=noise, **options)


def random(deviation=1.0, length=1.0, **options):
    return lambda: js.MaternPrior(surface(), deviation, length, **options)


@functools.cache
def field():
    return js.MaternPrior(surface(), 1.0, 1.0)


class Half(js.AbstractPrior):
    """A prior that lacks a method."""

    def color(self, xi):
        return xi

    def whiten(self, theta):
        return theta


CALLS = [
    ("solve_inverse", "a number for the model", inverted(1.0), ("forward is a float", "function")),
    ("solve_inverse", "whole unknowns", inverted(theta=1), ("theta has a leaf of type int", "floating")),
    ("solve_inverse", "data of another shape", inverted(data=THREE[:2]), ("data have shape (2,)", "(3,)")),
    ("solve_inverse", "data of another structure", inverted(data=(THREE,)), ("data have the structure", "forward returns")),
    ("solve_inverse", "a datum that is no number", inverted(data=THREE.at[1].set(np.nan)), ("datum 1 is nan",)),
    ("solve_inverse", "noise of zero", inverted(noise=0.0), ("noise of datum 0 is 0", "positive")),
    ("solve_inverse", "noise of another shape", inverted(noise=THREE[:2]), ("noise has shape (2,)", "(3,)")),
    ("solve_inverse", "noise of another structure", inverted(noise=(0.1, 0.1)), ("noise has the structure", "a number")),
    ("solve_inverse", "a number for a prior", inverted(prior=1.0), ("prior is 1.0", "Prior", "GaussianPrior")),
    ("solve_inverse", "a prior of another structure", inverted(prior=[js.GaussianPrior(1.0)]), ("prior has the structure", "theta")),
    ("solve_inverse", "a prior of another field", inverted(prior=field()), ("prior of unknowns of shape ()", "(80, ")),
    ("solve_inverse", "a prediction that is no number", inverted(lambda a: line(a).at[2].set(jnp.log(-a))), ("prediction of datum 2", "not finite")),
    ("solve_inverse", "more unknowns than data", inverted(lambda a: a[:3], jnp.ones(4)), ("3 data for 4 unknowns", "singular", "prior")),
    ("solve_inverse", "an unknown without effect", inverted(lambda a: line(a[0]), jnp.ones(2)), ("unknown 1", "singular", "prior")),
    ("solve_inverse", "a slope without end", inverted(lambda a: jnp.sqrt(a) * jnp.ones(3), jnp.array(0.0)), ("derivative of the data in unknown 0", "inf", "first theta")),
    ("solve_inverse", "unknowns in one product", inverted(lambda a: line(a[0] * a[1]), jnp.ones(2)), ("apart", "singular", "prior")),
    ("solve_inverse", "an optimiser's name", inverted(optimizer="adam"), ("optimizer is 'adam'", "optax.lbfgs()")),
    ("solve_inverse", "no steps", inverted(steps=0), ("steps = 0", "at least 1")),
    ("solve_inverse", "no linear steps", inverted(linear_steps=0), ("linear_steps = 0", "at least 1")),
    ("solve_inverse", "a tolerance of zero", inverted(tol=0.0), ("tol = 0", "above 0")),
    ("solve_inverse", "traced", lambda: jax.jit(lambda a: inverted(theta=a)().theta)(ONE), ("theta", "traced")),
    ("solve_inverse", "a model of what is differentiated", lambda: jax.grad(lambda a: inverted(lambda t: a * line(t))().theta)(1.0), ("forward and optimizer close over", "traced")),
    ("solve_inverse", "a model of what is mapped", lambda: jax.vmap(lambda a: inverted(lambda t: a * line(t))().theta)(THREE), ("forward and optimizer close over", "traced")),
    ("solve_inverse", "a rate that is differentiated", lambda: jax.grad(lambda a: inverted(data=2 * THREE, optimizer=optax.sgd(a))().theta)(1e-5), ("forward and optimizer close over", "traced")),
    ("GaussianPrior", "a deviation of zero", lambda: js.GaussianPrior(jnp.array([1.0, 0.0])), ("deviation 0 of unknown 1", "positive")),
    ("GaussianPrior", "text", lambda: js.GaussianPrior("wide"), ("deviation", "'wide'")),
    ("GaussianPrior", "a mean that is no number", lambda: js.GaussianPrior(1.0, jnp.array([0.0, np.nan])), ("mean nan of unknown 1",)),
    ("MaternPrior", "a cloud", lambda: js.MaternPrior(surface().cloud, 1.0, 1.0), ("surface", "Discretization")),
    ("MaternPrior", "a deviation below zero", random(-1.0), ("deviation = -1", "above 0")),
    ("MaternPrior", "a length of zero", random(length=0.0), ("length = 0", "above 0")),
    ("MaternPrior", "a mean of others", random(mean=THREE), ("mean has shape (3,)", "(80,)")),
    ("MaternPrior", "a traced length", lambda: jax.jit(lambda x: random(length=x)().tau)(1.0), ("length", "traced")),
    ("AbstractPrior", "made itself", lambda: js.AbstractPrior(), ("AbstractPrior", "abstract")),
    ("AbstractPrior", "a method that lacks", lambda: Half(), ("Half", "variance")),
    ("AbstractPrior", "a class for a prior", inverted(prior=js.GaussianPrior), ("prior", "Prior")),
    ("solve_inverse", "no noise", inverted(noise=None), ("noise is None", "numbers")),
    ("solve_inverse", "no data", inverted(data=None), ("data is None", "numbers")),
    ("solve_inverse", "a model that returns nothing", inverted(lambda a: None), ("forward returns None", "arrays")),
    ("solve_inverse", "a complex model", inverted(lambda a: 1j * line(a)), ("forward returns complex128", "floating-point")),
    ("solve_inverse", "a model in NumPy", inverted(lambda a: np.asarray(a) * np.ones(3)), ("forward", "jax.numpy")),
    ("solve_inverse", "a number for further arguments", inverted(lambda a, k: k * line(a), args=2.0), ("args is 2.0", "tuple")),
    ("GaussianPrior", "a mean of other unknowns", lambda: js.GaussianPrior(THREE, jnp.ones(2)), ("mean has shape (2,)", "(3,)")),
    ("GaussianPrior", "noise of other unknowns", lambda: js.GaussianPrior(THREE).color(jnp.ones(2)), ("xi has shape (2,)", "(3,)")),
    ("GaussianPrior", "complex unknowns", lambda: js.GaussianPrior(1.0).whiten(1j), ("theta", "complex")),
    ("MaternPrior", "noise of other points", lambda: field().color(THREE), ("xi has shape (3,)", "(80, ...)")),
    ("Posterior", "half a sample", lambda: inverted()().posterior().samples(jax.random.key(0), 2.5), ("count is 2.5", "whole number")),
    ("Posterior", "no samples", lambda: inverted()().posterior().samples(jax.random.key(0), 0), ("count = 0", "at least 1")),
    ("Posterior", "a quantity of two arrays", lambda: inverted()().posterior().deviation_of(lambda a: (a, a)), ("quantity returns tuple", "array")),
    ("Posterior", "a whole quantity", lambda: inverted()().posterior().deviation_of(lambda a: jnp.arange(3)), ("quantity returns int64", "floating-point")),
]  # fmt: skip

CASES = [Case(*call) for call in CALLS]
