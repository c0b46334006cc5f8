r"""Linear algebra of the small systems: products with a basis, and symmetric solves.

Two forms of the same operations. In *small* ones a vector over the basis is a list of arrays, and
sums over the neighbours are straight-line code on its entries, which a compiler makes loops over
the points of a block. In large ones a vector is one array. Matrices are factored in loops over
columns, all points at a time; on accelerators, and where programs are to be compiled quickly,
larger ones by library calls, matrix by matrix. NumPy does it for its arrays, compiled by nobody.

Shapes: q points of a neighbourhood, c right-hand sides, m monomials, `*p` points of a block.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from ..compiling import is_quick, namespace, stored
from ..machine import CPU, machine
from .sums import spread, sums, total

# Columns of a factor between two passes over the matrix, at most.
_TOGETHER = 12
# Monomials of a sum.
_SUMMED = 32


def is_small(unknowns: int) -> bool:
    """Whether a system of so many takes the form that runs faster, and is compiled more slowly."""
    return unknowns <= machine().unknowns and not is_quick()


def is_written_out(monomials: int) -> bool:
    """Whether products with so many monomials take that form, in systems of any size."""
    return monomials <= machine().monomials and not is_quick()


def entries(a) -> list[jax.Array]:
    """A vector over the basis as a list."""
    return list(jnp.unstack(a))


def combine(a, v):
    """Polynomials at the points, `(c, q, *p)`: the monomials v with coefficients a."""
    if isinstance(v, list):
        return _total(_times(a_i, v_i) for a_i, v_i in zip(spread(a, 1, len(v[0])), v))
    if _in_passes(v):
        return _total((a[some, :, None] * v[some, None]).sum(axis=0) for some in _parts(v))
    return namespace(v).einsum("mc...,mq...->cq...", a, v)


def moments(v, eta):
    """Moments of the weights eta `(c, q, *p)`."""
    if isinstance(v, list):
        return sums([_times(eta, v_i) for v_i in v], 1)
    if _in_passes(v):
        return jnp.concatenate([(v[some, None] * eta).sum(axis=2) for some in _parts(v)])
    return namespace(v).einsum("mq...,cq...->mc...", v, eta)


def _in_passes(v) -> bool:
    """Whether sums over the basis run over the points of a block: a library would want those first,
    and copies all monomials for that."""
    return v.ndim > 2 and namespace(v) is jnp and machine() is CPU and not is_quick()


def _parts(v) -> list[slice]:
    """So few monomials that the compiler adds them up in one pass, which stores no products."""
    return [slice(first, first + _SUMMED) for first in range(0, len(v), _SUMMED)]


def symmetric(gram, a):
    """The symmetric matrix of a system times a vector over the basis."""
    a = jnp.stack(a) if isinstance(a, list) else a
    return (gram[:, :, None] * a[:, None]).sum(axis=0)


def transform(matrix: np.ndarray, a):
    """A constant matrix times a vector over the basis."""
    if isinstance(a, list):
        zero = jnp.zeros_like(a[0])
        times = lambda f, a_i: a_i if f == 1 else jax.lax.mul(a_i, jax.lax.full_like(a_i, f))
        rows = matrix.tolist()
        return [_total((times(f, a_i) for f, a_i in zip(row, a) if f), zero) for row in rows]
    return jnp.tensordot(matrix.astype(a.dtype), a, 1)


def add(a, b):
    """Sum of two vectors over the basis."""
    return [x + y for x, y in zip(a, b)] if isinstance(a, list) else a + b


def subtract(a, b):
    """Difference of two vectors over the basis."""
    return [x - y for x, y in zip(a, b)] if isinstance(a, list) else a - b


def found_once(x, v, w):
    """The same array, found once: else a compiler finds it again for each monomial of v, say.

    No weight w is negative.
    """
    return stored(x, w[0, 0] < 0) if isinstance(v, list) else x


def factor(gram):
    r"""A solver for the equilibrated symmetric matrix, and its condition estimate.

    The factorisation gets a shift $\sigma$ of the size of round-off, so that it exists also where a
    moment is dependent on the others (a flat surface with few normal copies, say); one step of
    refinement, $(A + \sigma) x_1 = b + \sigma x_0$, takes its effect away again.
    """
    rsqrt = jax.lax.rsqrt if namespace(gram) is jnp else lambda x: 1 / np.sqrt(x)
    diagonal = _diagonal(gram)
    scale = rsqrt(namespace(gram).where(diagonal > 0, diagonal, 1))
    a = gram * scale * scale[:, None]
    shift = 4 * len(a) * jnp.finfo(a.dtype).eps
    solve_scaled, pivot = (_by_columns if _in_columns(a) else _by_lapack)(a, shift)

    def solve(b, refined=True):
        rows = isinstance(b, list)
        b = (jnp.stack(b) if rows else b) * scale[:, None]
        x = solve_scaled(b, refined) * scale[:, None]
        return entries(x) if rows else x

    xp = namespace(pivot)
    return solve, (xp.max(pivot, axis=0) / xp.min(pivot, axis=0)) ** 2


def _in_columns(a) -> bool:
    """Whether a loop over columns is faster than a library: for the points of a block, not one."""
    loops = a.ndim > 2 and namespace(a) is jnp and not is_quick()
    return loops and len(a) <= machine().columns


def _by_columns(a, shift):
    """Cholesky's factor and its inverse column by column, for all points at once."""
    columns = _cholesky(a, shift)

    def times(x):
        rows = jnp.sum(columns[:, :, None] * x, axis=1)
        return jnp.sum(columns[:, :, None] * rows[:, None], axis=0) - shift * x

    def solution(_, b):
        again = lambda _, x: _substituted(columns, b + shift * x)
        return _while(2, again, jnp.zeros_like(b))

    def solve(b, refined):
        if not refined:
            return _substituted(columns, b)
        return jax.lax.custom_linear_solve(times, b, solution, symmetric=True)

    return solve, _diagonal(columns)


def _cholesky(a, shift):
    """Columns of Cholesky's factor, `(m, m, *p)`, each in its row.

    One after another within a few, in a loop, whose body is short: written out, 14 unknowns take
    ten seconds to compile. Then one pass over what is left of the matrix takes them out of it.
    """
    m, columns = len(a), jnp.zeros_like(a)
    together = math.ceil(m / math.ceil(m / _TOGETHER))
    for start in range(0, m, together):
        few = _eliminated(a[:together], shift)
        count = len(few)
        columns = jax.lax.dynamic_update_slice(columns, few, (start, start, *(0,) * (a.ndim - 2)))
        if start + count < m:
            below, left = few[:, count:], a[count:, count:]
            left = functools.reduce(lambda a, c: a - c[:, None] * c, below, left)
            a = jax.lax.optimization_barrier(left)
    return columns


def _while(count: int, body: Callable, start):
    """`fori_loop` that counts once, by numbers without a sign, which need no code for negative
    ones. Each operation on a number is a program for the compiler. Not for reverse mode, which
    solves of linear systems do not need."""
    step = lambda state: (state[0] + np.uint32(1), body(*state))
    return jax.lax.while_loop(lambda state: state[0] < count, step, (np.uint32(0), start))[1]


def _scan(count: int, body: Callable, start):
    """The same for any derivative."""
    step = lambda state, i: (body(i, state), None)
    return jax.lax.scan(step, start, np.arange(count, dtype=np.uint32))[0]


def _with_loops(f: Callable) -> Callable:
    """From f(loop, *arrays) a function of the arrays: by `while`, in derivatives by `scan`."""
    call = jax.custom_jvp(functools.partial(f, _while))
    call.defjvp(lambda primals, tangents: jax.jvp(functools.partial(f, _scan), primals, tangents))
    return functools.wraps(f)(call)


@_with_loops
def _eliminated(loop, rows, shift):
    """The first columns of a factor, of as many rows of a symmetric matrix."""
    places = _places(rows[0])

    def eliminate(j, columns):
        # Those that are not there yet have no part. (Masks are factors: constants, zeros say, the
        # compiler takes out of a loop and stores, by a program of their own.)
        before = (places[: len(rows)] < j) * _at(columns, j, 1)
        column = _at(rows, j) - jnp.sum(columns * before[:, None], axis=0)
        column = column + shift * (places == j)
        column = column * ((places >= j) * jax.lax.rsqrt(_at(column, j)))
        return _put(columns, column, j)

    return loop(len(rows), eliminate, rows)


@_with_loops
def _substituted(loop, columns, b):
    """The solution, of which an entry takes the place of that of b once it is found."""
    m, pivot, places = len(b), _diagonal(columns), _places(b[:, 0])

    def forward(i, y):
        row = (places < i) * _at(columns, i, 1)
        left = _at(b, i) - total(row[:, None] * y)
        return _put(y, left / _at(pivot, i), i)

    def backward(j, x):
        i = np.uint32(m - 1) - j
        column = (places > i) * _at(columns, i)
        left = _at(y, i) - total(column[:, None] * x)
        return _put(x, left / _at(pivot, i), i)

    y = loop(m, forward, b)
    return loop(m, backward, y)


def _places(a):
    """Numbers of the entries of the first axis."""
    return np.arange(len(a), dtype=np.uint32).reshape(-1, *(1,) * (a.ndim - 1))


def _at(a, i, axis: int = 0):
    return jax.lax.dynamic_index_in_dim(a, i, axis, keepdims=False)


def _put(a, row, i):
    return jax.lax.dynamic_update_index_in_dim(a, row, i, 0)


def _by_lapack(a, shift):
    xp = namespace(a)
    a = xp.moveaxis(a, (0, 1), (-2, -1))  # LAPACK wants the matrix last
    chol = xp.linalg.cholesky(a + shift * xp.eye(a.shape[-1], dtype=a.dtype))
    if xp is np:
        inverse = np.linalg.inv(chol)  # NumPy has no triangular solves of many matrices
        substitute = lambda b: inverse.swapaxes(-2, -1) @ (inverse @ b)
    else:
        substitute = lambda b: jax.scipy.linalg.cho_solve((chol, True), b)

    def solve(b, refined):
        b = xp.moveaxis(b, (0, 1), (-2, -1))
        x = substitute(b)
        if refined:
            x = substitute(b + shift * x)
        return xp.moveaxis(x, (-2, -1), (0, 1))

    return solve, xp.moveaxis(xp.diagonal(chol, axis1=-2, axis2=-1), -1, 0)


def _diagonal(a):
    m = len(a)
    return a.reshape(m * m, *a.shape[2:])[:: m + 1]


def _times(a, v):
    """Of each of several functions. (Straight-line code is long, and JAX traces its own operations
    sooner than those that are written as in NumPy.)"""
    return jax.lax.mul(a, jax.lax.broadcast(v, a.shape[:1]))


def _total(terms, start=None):
    """Sum without a zero to begin with."""
    terms = list(terms)
    return functools.reduce(jax.lax.add, terms) if terms else start
