"""Shapes as unknowns, and derivatives held against differences."""

# One case a line reads as a table.
# ruff: noqa: E501

import jax
import jax.numpy as jnp
import numpy as np

import jaxsurf as js

from . import Case

X = jnp.array([1.0, 2.0, 3.0])


def taylor(f=lambda x: jnp.sum(jnp.sin(x)), x=X, direction=X, **options):
    return lambda: js.taylor_remainders(f, x, direction, **options)


CALLS = [
    ("taylor_remainders", "f a number", taylor(f=1.0), ("f is a float", "function")),
    ("taylor_remainders", "f with several values", taylor(f=jnp.sin), ("f returns", "(3,)", "one real number")),
    ("taylor_remainders", "f a complex value", taylor(f=lambda x: jnp.sum(1j * x)), ("f returns", "complex128", "one real number")),
    ("taylor_remainders", "a value that is not finite", taylor(f=lambda x: jnp.sum(x) / 0), ("f(x) is not finite", "inf")),
    ("taylor_remainders", "not finite beside x", taylor(f=lambda x: jnp.sqrt(1 - x[0])), ("derivative of f", "not finite")),
    ("taylor_remainders", "whole numbers", taylor(x=jnp.arange(3)), ("x has a leaf of type int64", "floating")),
    ("taylor_remainders", "text", taylor(x="abc"), ("x has a leaf", "str")),
    ("taylor_remainders", "nothing", taylor(x=()), ("x has no arrays",)),
    ("taylor_remainders", "a direction of another shape", taylor(direction=X[:2]), ("direction has shapes (2,)", "(3,)")),
    ("taylor_remainders", "a direction of another structure", taylor(direction=(X,)), ("direction has shapes ((3,),)", "(3,)")),
    ("taylor_remainders", "a direction that is not finite", taylor(direction=X * np.nan), ("direction is not finite",)),
    ("taylor_remainders", "a step of zero", taylor(steps=[0.1, 0.0]), ("step 1 is 0.0", "positive")),
    ("taylor_remainders", "one step", taylor(steps=[0.1]), ("1 different steps", "at least 2")),
    ("taylor_remainders", "traced", lambda: jax.jit(lambda x: taylor(x=x)().slope)(X), ("x and direction", "traced")),
]  # fmt: skip

CASES = [Case(*case) for case in CALLS]
