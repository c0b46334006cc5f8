r"""Linear algebra of the small systems: products with a basis, and symmetric solves.

Two forms of the same operations. In *small* ones a vector over the basis is a list of arrays, and
everything is straight-line code on its entries: a compiler turns that into loops over the points
of a block, without ever storing a matrix. In large ones it is one array, and library calls do
the work matrix by matrix.

Shapes: q points of a neighbourhood, c right-hand sides, m monomials, `*p` points of a block.
"""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np

# Up to this number of unknowns a system is small.
SMALL = 15


def combine(a, v):
    """Polynomials at the points, `(c, q, *p)`: the monomials v with coefficients a."""
    if isinstance(v, list):
        return _total(a_i[:, None] * v_i for a_i, v_i in zip(a, v))
    return jnp.einsum("mc...,mq...->cq...", a, v)


def moments(v, eta):
    """Moments of the weights eta `(c, q, *p)`."""
    if isinstance(v, list):
        return [jnp.sum(eta * v_i, axis=1) for v_i in v]
    return jnp.einsum("mq...,cq...->mc...", v, eta)


def symmetric(gram, a):
    """The symmetric matrix of a system times a vector over the basis."""
    if isinstance(gram, list):
        return [_total(g * a_j for g, a_j in zip(row, a)) for row in gram]
    return jnp.einsum("mn...,nc...->mc...", gram, a)


def transform(matrix: np.ndarray, a):
    """A constant matrix times a vector over the basis."""
    if isinstance(a, list):
        zero = jnp.zeros_like(a[0])
        return [_total((f * a_i for f, a_i in zip(row, a) if f), zero) for row in matrix.tolist()]
    return jnp.tensordot(matrix.astype(a.dtype), a, 1)


def add(a, b):
    """Sum of two vectors over the basis."""
    return [x + y for x, y in zip(a, b)] if isinstance(a, list) else a + b


def factor(gram):
    """A solver for the equilibrated symmetric matrix, and its condition estimate.

    The factorisation gets a shift of the size of round-off, so that it exists also where a
    moment is dependent on the others (a flat surface with few normal copies, say); one step of
    refinement on the unshifted matrix takes the effect of the shift away again.
    """
    m = len(gram)
    diagonal = [gram[i][i] for i in range(m)]
    scale = [jax.lax.rsqrt(jnp.where(d > 0, d, 1)) for d in diagonal]
    shift = 4 * m * jnp.finfo(diagonal[0].dtype).eps
    return (_small if isinstance(gram, list) else _large)(gram, scale, shift)


def _small(gram, scale, shift):
    m = len(gram)
    a = [[gram[i][j] * scale[i] * scale[j] for j in range(m)] for i in range(m)]
    lower: list[list] = []
    pivot: list = []
    for i in range(m):
        row: list = []
        for j in range(i):
            row.append(_minus_dot(a[i][j], row, lower[j]) / pivot[j])
        lower.append(row)
        pivot.append(jnp.sqrt(_minus_dot(a[i][i] + shift, row, row)))

    def substitute(b):
        y: list = []
        for i in range(m):
            y.append(_minus_dot(b[i], lower[i], y) / pivot[i])
        x: list = []
        for i in reversed(range(m)):
            column = [lower[j][i] for j in reversed(range(i + 1, m))]
            x.append(_minus_dot(y[i], column, x) / pivot[i])
        return x[::-1]

    def solve(b):
        b = [b_i * s for b_i, s in zip(b, scale)]

        def refine(_, x):
            return add(x, substitute([_minus_dot(b_i, row, x) for b_i, row in zip(b, a)]))

        # A loop, because what goes in and comes out of one is stored; what is not, a compiler
        # computes again at every use.
        zero = [
            jnp.zeros(jnp.broadcast_shapes(b_i.shape, s.shape), s.dtype) for b_i, s in zip(b, scale)
        ]
        x = jax.lax.fori_loop(0, 2, refine, zero)
        return [x_i * s for x_i, s in zip(x, scale)]

    largest, smallest = (functools.reduce(f, pivot) for f in (jnp.maximum, jnp.minimum))
    return solve, (largest / smallest) ** 2


def _large(gram, scale, shift):
    scale = jnp.stack(scale)
    # LAPACK wants the matrix last.
    points_first = lambda a: jnp.moveaxis(a, (0, 1), (-2, -1))
    points_last = lambda a: jnp.moveaxis(a, (-2, -1), (0, 1))
    a = points_first(gram * scale * scale[:, None])
    chol = jnp.linalg.cholesky(a + shift * jnp.eye(len(gram), dtype=a.dtype))
    pivots = jnp.diagonal(chol, axis1=-2, axis2=-1)
    condition = (jnp.max(pivots, axis=-1) / jnp.min(pivots, axis=-1)) ** 2

    def solve(b):
        b = points_first(b * scale[:, None])
        first = jax.scipy.linalg.cho_solve((chol, True), b)
        second = jax.scipy.linalg.cho_solve((chol, True), b - a @ first)
        return points_last(first + second) * scale[:, None]

    return solve, condition


def _total(terms, start=None):
    """Sum without a zero to begin with."""
    terms = list(terms)
    return functools.reduce(jnp.add, terms) if terms else start


def _minus_dot(start, a: list, b: list):
    return functools.reduce(lambda s, pair: s - pair[0] * pair[1], zip(a, b), start)
