r"""Multi-indices and monomials $x^\gamma = x_1^{\gamma_1} \cdots x_d^{\gamma_d}$.

Every basis here is *graded*: all multi-indices of length d, by increasing degree $|\gamma|$.
Multi-indices are plain NumPy arrays, known at compile time; only the coordinates are traced.
"""

from __future__ import annotations

import functools
import itertools
import math
import operator
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..compiling import AnyArray, namespace

# Powers that are no loop, whose derivative would be loops too.
_WRITTEN_OUT = 6


@functools.cache
def multi_indices(dim: int, low: int, high: int) -> np.ndarray:
    """All multi-indices with `low <= degree <= high`, graded, shape `(m, dim)`."""
    graded = [
        gamma
        for degree in range(low, high + 1)
        for gamma in itertools.product(range(degree, -1, -1), repeat=dim)
        if sum(gamma) == degree
    ]
    return np.array(graded, int).reshape(-1, dim)


def polynomial_count(dim: int, high: int) -> int:
    """Number of monomials of degree 0 to `high`."""
    return math.comb(dim + high, high)


@functools.cache
def position(dim: int, high: int) -> dict[tuple[int, ...], int]:
    """Where each multi-index stands in `multi_indices(dim, 0, high)`."""
    return {tuple(gamma): i for i, gamma in enumerate(multi_indices(dim, 0, high).tolist())}


@functools.cache
def _parents(dim: int, high: int) -> tuple[tuple[int, int], ...]:
    """For each multi-index but the first: a lower one, and the coordinate that leads to it."""
    place, parents = position(dim, high), []
    for gamma in list(place)[1:]:
        axis = next(a for a in range(dim) if gamma[a])
        lower = (*gamma[:axis], gamma[axis] - 1, *gamma[axis + 1 :])
        parents.append((place[lower], axis))
    return tuple(parents)


def monomials(x: Float[AnyArray, "dim *q"], high: int) -> Float[AnyArray, "m *q"]:
    """All monomials of degree 0 to `high`: products of powers, taken from a table of these."""
    table = _powers(x, high)
    chosen = zip(multi_indices(len(x), 0, high).T, range(len(x)))
    return functools.reduce(operator.mul, [table[power, axis] for power, axis in chosen])


def _powers(x: Float[AnyArray, "dim *q"], high: int) -> Float[AnyArray, "m dim *q"]:
    xp = namespace(x)
    if xp is jnp and high > _WRITTEN_OUT:
        return jax.lax.scan(lambda p, _: (p * x, p), jnp.ones_like(x), length=high + 1)[1]
    return xp.stack(list(itertools.accumulate([xp.ones_like(x)] + high * [x], operator.mul)))


def monomial_rows(
    x: Float[Array, "dim *q"] | Sequence[Float[Array, "*q"]],
    high: int,
    first: Float[Array, "*q"] | None = None,
) -> list[Float[Array, "*q"]]:
    """The same one by one, all times a common factor `first` if given."""
    coordinates = list(x)
    rows = [jnp.ones_like(x[0]) if first is None else first]
    for lower, axis in _parents(len(x), high):
        rows.append(jax.lax.mul(rows[lower], coordinates[axis]))
    return rows


def monomials_on_lines(
    foot: Sequence[Float[Array, "*q"]], along: Sequence[Float[Array, "*q"]], high: int
) -> list[list[Float[Array, "*q"]]]:
    """The same at points foot + z along, each as coefficients of powers of z."""
    rows = [[jnp.ones_like(foot[0])]]
    for lower, axis in _parents(len(foot), high):
        row, x, d = rows[lower], foot[axis], along[axis]
        between = (x * b + d * a for a, b in itertools.pairwise(row))
        rows.append([x * row[0], *between, d * row[-1]])
    return rows


@functools.cache
def differentiation(dim: int, high: int) -> np.ndarray:
    r"""Matrices $D_a$, `(dim, m, m)`: coefficients of $\partial_a$ of a polynomial from its own."""
    place = position(dim, high)
    matrices = np.zeros((dim, len(place), len(place)))
    for gamma, column in place.items():
        for axis in range(dim):
            if gamma[axis]:
                lower = (*gamma[:axis], gamma[axis] - 1, *gamma[axis + 1 :])
                matrices[axis, place[lower], column] = gamma[axis]
    return matrices


def derivative_at_origin(dim: int, high: int, alpha: tuple[int, ...]) -> np.ndarray:
    r"""$D^\alpha x^\gamma$ at 0 for every monomial: $\alpha!$ where $\gamma = \alpha$, else 0."""
    place = position(dim, high)
    values = np.zeros(len(place))
    values[place[alpha]] = math.prod(math.factorial(a) for a in alpha)
    return values
