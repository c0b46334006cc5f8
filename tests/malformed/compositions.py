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
