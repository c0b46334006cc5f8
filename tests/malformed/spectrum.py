"""Spectra of operators."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse

import jaxsurf as js

from . import Case


@functools.cache
def operator(n=200):
    """A ring of points: second differences."""
    i = jnp.arange(n)
    indices = jnp.stack([i, (i + 1) % n, (i - 1) % n])
    return js.Stencil(indices, jnp.stack([jnp.full(n, w) for w in (-2.0, 1.0, 1.0)]))


def estimate(given, **settings):
    return lambda: js.spectral_estimate(given() if callable(given) else given, **settings)


def spoiled(value, i=7):
    ring = operator()
    return js.Stencil(ring.indices, ring.weights.at[1, i].set(value))


def traced():
    ring = operator()
    make = lambda w: js.spectral_estimate(js.Stencil(ring.indices, w)).radius
    return jax.jit(make)(ring.weights)


def vector_valued():
    return js.Stencil(operator().indices, jnp.ones((3, 2, 200)), (2,))


CASES = [
    Case("spectral_estimate", label, call, words)
    for label, call, words in (
        ("a NumPy matrix", estimate(np.eye(200)), ("operator", "(200, 200)", "Operator")),
        ("a SciPy matrix", estimate(scipy.sparse.eye(200).tocsr()), ("operator", "Operator")),
        ("a string", estimate("laplacian"), ("operator", "'laplacian'", "Operator")),
        ("a list", estimate([1.0, 2.0]), ("operator", "list", "Operator")),
        ("nothing", estimate(None), ("operator", "None", "Operator")),
        ("a function", lambda: js.spectral_estimate(lambda u: u), ("operator", "Operator")),
        ("components", estimate(vector_valued), ("operator", "(2,)")),
        ("a weight of NaN", estimate(lambda: spoiled(jnp.nan)), ("finite", "7")),
        ("a weight of infinity", estimate(lambda: spoiled(jnp.inf)), ("finite", "7")),
        ("under jit", traced, ("operator", "traced", "jit")),
        ("steps=2.5", estimate(operator, steps=2.5), ("steps", "2.5", "whole number")),
        ("steps=0", estimate(operator, steps=0), ("steps", "0", "8")),
        ("steps of text", estimate(operator, steps="40"), ("steps", "'40'", "whole number")),
        ("negative steps", estimate(operator, steps=-40), ("steps", "-40", "8")),
        ("degree=0", estimate(operator, degree=0), ("degree", "0", "1")),
        ("degree=True", estimate(operator, degree=True), ("degree", "True", "whole number")),
        ("degree=None", estimate(operator, degree=None), ("degree", "None", "whole number")),
    )
] + [
    Case("spectral_estimate", label, call, right=right)
    for label, call, right in (
        (
            "more steps than points",
            estimate(operator, steps=500),
            lambda s: abs(s.radius - 4) < 1e-9,
        ),
        (
            "weights of 1e200",
            estimate(lambda: 1e200 * operator()),
            lambda s: abs(s.radius / 4e200 - 1) < 0.02,
        ),
        (
            "weights of 1e-200",
            estimate(lambda: 1e-200 * operator()),
            lambda s: abs(s.radius / 4e-200 - 1) < 0.02,
        ),
        ("all weights zero", estimate(lambda: 0.0 * operator()), lambda s: s == (0, 0, 0)),
        ("one point", estimate(lambda: operator(1)), lambda s: s == (0, 0, 0)),
    )
]
