"""One operator after another."""

import functools

import jax.numpy as jnp
import numpy as np

import jaxsurf as js

from . import Case


@functools.cache
def ring(n=200, components=()):
    """A ring of points: second differences."""
    i = jnp.arange(n)
    indices = jnp.stack([i, (i + 1) % n, (i - 1) % n])
    return js.Stencil(indices, jnp.ones((3, *components, n)), components)


CASES = [
    Case("Sum", "operators of 200 and 100 points", lambda: ring(200) + ring(100), ("200", "100")),
    Case("Sum", "a gradient and a scalar operator", lambda: ring(200) - ring(200, (2,)), ("(2,)",)),
    Case("Sum", "a number", lambda: js.Sum(ring(200), 1.0), ("other", "1.0", "Operator")),
    Case("Sum", "an operator times another", lambda: ring(200) * ring(200), ("factor", "@")),
    Case("Sum", "a field behind", lambda: ring(200) * jnp.ones(200), ("factor", "(200,)", "()")),
    Case("Sum", "divided by a field", lambda: ring(200) / jnp.ones(200), ("(200,)", "()")),
    Case("Sum", "text added", lambda: (ring(200) @ ring(200)) + "1", ("term", "'1'", "real")),
    Case("Diagonal", "of a matrix", lambda: js.Diagonal(jnp.ones((3, 3))), ("factor", "(3, 3)")),
    Case("Diagonal", "a number alone", lambda: js.Diagonal(2.0), ("factor", "()", "n is needed")),
    Case("Diagonal", "too few", lambda: js.Diagonal(jnp.ones(4), 5), ("factor", "(4,)", "(5,)")),
    Case("Diagonal", "complex", lambda: js.Diagonal(1j * np.ones(4)), ("factor", "complex")),
    Case("Diagonal", "a long field", lambda: js.Diagonal(jnp.ones(4))(jnp.ones(5)), ("(5,)", "4")),
    Case("identity", "of 2.5 points", lambda: js.identity(2.5), ("n", "2.5")),
    Case("identity", "of many points", lambda: js.identity("10"), ("n", "10")),
    Case("identity", "of no points", lambda: js.identity(0), ("n", "0", "1")),
    Case(
        "Composition",
        "operators of 200 and 100 points",
        lambda: js.Composition(ring(200), ring(100)),
        ("inner", "200", "100"),
    ),
    Case(
        "Composition",
        "a scalar operator after a gradient",
        lambda: ring(200) @ ring(200, (2,)),
        ("inner", "(2,)", "()"),
    ),
    Case(
        "Composition",
        "a field of another length",
        lambda: (ring(200) @ ring(200))(np.ones(100)),
        ("field", "(100,)", "200"),
    ),
    Case(
        "Composition",
        "a complex field",
        lambda: (ring(200) @ ring(200))(np.ones(200) + 1j),
        ("field", "complex"),
    ),
]
