r"""The small moment systems behind every stencil, solved for all points in blocks.

With weights $w_q$, a graded monomial basis $V_{q\gamma} = x_q^\gamma$ and a right-hand side b,
the stencil is

$$\eta_q = w_q \sum_\gamma a_\gamma x_q^\gamma, \qquad A a = b, \qquad
  A_{\beta\gamma} = \sum_q w_q\, x_q^{\beta+\gamma},$$

so that $\sum_q \eta_q x_q^\beta = b_\beta$: the moment conditions (6) of Singh et al. (2023),
and at the same time the weighted least-norm problem (18), (19) of Suchde and Kuhnert (2019).
The entries of A are the moments of w up to twice the degree, and many coincide: each is
summed once.

Here and in all that is built from it, arrays may have one more axis at the end, for the points of
a block (written `*p`): arithmetic on the entries of one point then runs over all of them.
"""

from __future__ import annotations

import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Shaped

from ..compiling import KEPT, AnyArray, namespace
from . import systems
from .monomials import (
    differentiation,
    monomial_rows,
    monomials,
    multi_indices,
    polynomial_count,
    position,
)
from .sums import sums

# In single precision weights are corrected until moments are met to this, so many times at most.
_SINGLE, _ROUNDS = 3e-5, 8


@functools.partial(jax.custom_jvp, nondiff_argnums=(3, 4))
def moment_solve(
    x: Float[Array, "dim q *p"],
    w: Float[Array, "q *p"],
    b: Float[Array, "m c *b"],
    low: int,
    high: int,
) -> tuple[Float[Array, "c q *p"], Float[Array, "*p"], Float[Array, "*p"]]:
    r"""Weights $\eta$ with prescribed moments, for c right-hand sides at once.

    Args:
        x: coordinates of the points in units of the neighbourhood, so that they are of order 1.
        w: non-negative weights; points of weight zero do not take part.
        b: moments wanted, for the multi-indices of degree `low` to `high`, graded; the same for
            all points, `(m, c)`, or those of each.
        low: lowest degree of the basis, 0 or 1.
        high: highest degree of the basis.

    Returns:
        The weights $\eta$; an estimate (from below, from the Cholesky pivots) of the condition
        number of the equilibrated matrix; and the largest moment residual relative to b.

    Differentiable: forward and reverse, in x, w and the b of each point, by the closed form; the
    two diagnostics have derivative zero. A b for all points is taken as constant.
    """
    return _solve(x, w, b, low, high)[0]


def _solve(x, w, b, low, high):
    """What `moment_solve` returns, and what its derivative needs of it."""
    v, start, gram, (solve, condition) = _system(x, w, low, high)
    small = isinstance(v, list)
    b = b.astype(w.dtype).reshape(*b.shape, *(1,) * (w.ndim + 1 - b.ndim))
    a = solve(b * jnp.ones_like(w[0]))
    wanted, a = (systems.entries(b), systems.entries(a)) if small else (b, a)
    s = systems.combine(a, v[start:])
    size = jnp.max(jnp.abs(b), axis=(0, 1))
    size = jnp.where(size > 0, size, 1)
    relative = lambda left: jnp.max(jnp.abs(left), axis=(0, 1)) / size
    if jnp.finfo(w.dtype).bits > 32:
        residual = relative(systems.symmetric(gram, a) - b)  # the moments of eta are A a
    else:
        a, s, residual = _corrected(a, s, wanted, w, v[start:], solve, relative)
    # Their sum, which the centre's weight is made of, would compute all of them again.
    eta = systems.found_once(w * s, v, w)
    return (eta, condition, residual), (v, start, solve, a, s)


def _corrected(a, s, wanted, w, basis, solve, relative):
    """Weights corrected by the moments that they have: in single precision those of A a are others.

    As often as a neighbourhood on one side takes: three times on a border, eight at a corner.
    """

    def corrected(state):
        a, s, left = state
        more = solve(left)
        s = s + systems.combine(more, basis)
        return systems.add(a, more), s, missing(s)

    missing = lambda s: systems.subtract(wanted, systems.moments(basis, w * s))
    residual = lambda left: relative(jnp.stack(left) if isinstance(left, list) else left)
    # Fewer points than moments never meet them.
    able = jnp.sum(w > 0, axis=0) >= len(basis)
    open_ = lambda state: jnp.any(able & (residual(state[2]) > _SINGLE))
    once = lambda _, state: jax.lax.cond(open_(state), corrected, lambda state: state, state)
    a, s, left = jax.lax.fori_loop(0, _ROUNDS, once, (a, s, missing(s)))
    return a, s, residual(left)


def _system(x, w, low, high):
    """All monomials, the number of those below the basis, the Gram matrix and its solver."""
    start = len(multi_indices(len(x), 0, low - 1))
    small = _is_small(x, low, high)
    v: list[Array] | Array = monomial_rows(x, high) if small else monomials(x, high)
    gram = gram_matrix(x, w, low, high)
    return v, start, gram, systems.factor(gram)


def _is_small(x, low, high) -> bool:
    """Whether straight-line code pays: it needs the points of a block behind each number."""
    return (
        x.ndim > 2
        and namespace(x) is jnp
        and systems.is_small(len(multi_indices(len(x), low, high)))
    )


@moment_solve.defjvp
def _moment_solve_jvp(low, high, primals, tangents):
    # With s = V a:  d eta = dw s + w (dV a + V da),  A da = -(V^T (dw s + w dV a) + dV^T (w s)).
    x, w, b = primals
    dx, dw, db = tangents
    (eta, condition, residual), (v, start, solve, a, s) = _solve(x, w, b, low, high)
    dx = columns(dx, v, w)
    s = systems.found_once(s, v, w)
    g = dw * s + w * moved(a, v, dx, start, high)
    rhs = add_moved_moments(systems.moments(v[start:], g), eta, v, dx, start, high)
    if b.ndim > 2:
        rhs = systems.add(rhs, [-row for row in db] if isinstance(rhs, list) else -db)
    d_eta = systems.found_once(g - w * systems.combine(solve(rhs), v[start:]), v, w)
    return (eta, condition, residual), (d_eta, jnp.zeros_like(condition), jnp.zeros_like(residual))


def polynomial_fit(
    x: Float[AnyArray, "dim q *p"],
    w: Float[AnyArray, "q *p"],
    values: Float[AnyArray, "c q *p"],
    low: int,
    high: int,
) -> tuple[Float[AnyArray, "m c *p"], Float[AnyArray, "*p"]]:
    r"""Coefficients a that minimise $\sum_q w_q (\sum_\gamma a_\gamma x_q^\gamma - z_q)^2$.

    Args:
        x, w, low, high: as for `moment_solve`, whose matrix A is that of the normal equations.
            Arrays of NumPy are left to it, in their own precision.
        values: z, of c functions.

    Returns:
        The coefficients, and the condition number as `moment_solve` estimates it.

    Differentiable: forward and reverse, in x, w and values, by the closed form.
    """
    if namespace(x) is np:
        return _fit(x, w, values, low, high)[0]
    return _polynomial_fit(x, w, values, low, high)


@functools.partial(jax.custom_jvp, nondiff_argnums=(3, 4))
def _polynomial_fit(x, w, values, low, high):
    return _fit(x, w, values, low, high)[0]


def _fit(x, w, values, low, high):
    v, start, _, (solve, condition) = _system(x, w, low, high)
    basis = v[start:]
    a = solve(systems.moments(basis, w * values), refined=False)
    # Refined by the residual: squaring the condition number costs digits, many in float32.
    left = w * (values - systems.combine(a, basis))
    more = solve(systems.moments(basis, left), refined=False)
    if isinstance(a, list):
        a, more = jnp.stack(a), jnp.stack(more)
    return (a + more, condition), (v, start, solve)


@_polynomial_fit.defjvp
def _polynomial_fit_jvp(low, high, primals, tangents):
    # With the residual e = z - V a:  A da = V^T (dw e + w (dz - dV a)) + dV^T (w e).
    x, w, values = primals
    dx, dw, dz = tangents
    (out, condition), (v, start, solve) = _fit(x, w, values, low, high)
    dx = columns(dx, v, w)
    a = systems.entries(out) if isinstance(v, list) else out
    left = values - systems.combine(a, v[start:])
    g = dw * left + w * (dz - moved(a, v, dx, start, high))
    da = solve(add_moved_moments(systems.moments(v[start:], g), w * left, v, dx, start, high))
    da = jnp.stack(da) if isinstance(v, list) else da
    return (out, condition), (da, jnp.zeros_like(condition))


def columns(dx, v, w):
    """Coordinates one by one: as slices each would have a derivative as large as all of them."""
    if not isinstance(v, list):
        return dx
    return [systems.found_once(part[0], v, w) for part in jax.lax.split(dx, (1,) * len(dx))]


def moved(a, v, dx, start, high):
    """dV a: the gradient of the polynomials with coefficients a, along dx."""
    matrices = _slopes(len(dx), start, high)
    v = v[: matrices.shape[1]]
    if isinstance(v, list):
        each = (systems.combine(systems.transform(d, a), v) for d in matrices)
        return sum(slope * dx_i for slope, dx_i in zip(each, dx))
    # One product for all coordinates: the monomials are read once.
    slopes = jnp.tensordot(matrices.astype(a.dtype), a, 1).swapaxes(0, 1)
    slopes = systems.combine(slopes.reshape(len(v), -1, *a.shape[2:]), v)
    return jnp.sum(slopes.reshape(len(dx), -1, *dx.shape[1:]) * dx[:, None], axis=0)


def add_moved_moments(rhs, eta, v, dx, start, high):
    """A right-hand side plus dV^T eta: the same matrices transposed."""
    matrices = _slopes(len(dx), start, high)
    v = v[: matrices.shape[1]]
    if isinstance(v, list):
        for d, dx_i in zip(matrices, dx):
            rhs = systems.add(rhs, systems.transform(d.T, systems.moments(v, eta * dx_i)))
        return rhs
    each = systems.moments(v, (eta * dx[:, None]).reshape(-1, *eta.shape[1:]))
    each = each.reshape(len(v), len(dx), -1, *each.shape[2:])
    return rhs + jnp.tensordot(matrices.astype(each.dtype), each, ((1, 0), (0, 1)))


def _slopes(dim: int, start: int, high: int) -> np.ndarray:
    """Coefficients of derivatives, which are a degree lower, from those of the basis."""
    return differentiation(dim, high)[:, : polynomial_count(dim, high - 1), start:]


@functools.cache
def _table(dim: int, low: int, high: int) -> np.ndarray:
    """Where the moment of multi-index beta + gamma stands."""
    basis, place = multi_indices(dim, low, high), position(dim, 2 * high)
    total = (basis[:, None] + basis).tolist()
    return np.array([[place[tuple(g)] for g in row] for row in total], np.int32)


def gram_matrix(x, w, low, high):
    """The matrix A, each moment summed once."""
    small = _is_small(x, low, high)
    found = jnp.stack(sums(monomial_rows(x, 2 * high, w), 0)) if small else all_moments(x, w, high)
    return arranged(found, len(x), low, high)


def all_moments(x, w, high):
    """Moments of w up to twice the degree, graded: monomials in all coordinates but the last, times
    powers of the last, as one small matrix product."""
    powers, xp = monomials(x[-1:], 2 * high), namespace(x)
    others = monomials(x[:-1], 2 * high) if len(x) > 1 else xp.ones_like(x)
    factors = others * w, powers
    if xp is jnp:
        # Fused with the product, monomials would be found again for each of its entries.
        factors = jax.lax.optimization_barrier(factors)
    table = xp.einsum("aq...,bq...->ab...", *factors)
    graded = multi_indices(len(x), 0, 2 * high)
    rows = position(len(x) - 1, 2 * high) if len(x) > 1 else {(): 0}
    return table[np.array([rows[tuple(g)] for g in graded[:, :-1].tolist()]), graded[:, -1]]


def arranged(moments, dim: int, low: int, high: int):
    """The matrix of a system, from all moments."""
    return moments[_table(dim, low, high)]


def in_blocks(a: Shaped[Array, "*s n"], size: int) -> Shaped[Array, "blocks *s size"]:
    """The last axis cut into blocks, and these filled up with copies of the last entry.

    Their number is rounded up, to one of few sizes: what treats them need not be compiled anew for
    another number of points. Beyond 64 blocks by a sixteenth at most.
    """
    blocks = -(-a.shape[-1] // size)
    unit = 1 << max(blocks.bit_length() - (3 if blocks <= 64 else 5), 0)
    missing = -(-blocks // unit) * unit * size - a.shape[-1]
    xp = namespace(a)
    a = xp.pad(a, [(0, 0)] * (a.ndim - 1) + [(0, missing)], mode="edge")
    return xp.moveaxis(a.reshape(*a.shape[:-1], -1, size), -2, 0)


def out_of_blocks(a: Shaped[Array, "blocks *s size"], n: int) -> Shaped[Array, "*s n"]:
    """The inverse: blocks side by side along the last axis, without what filled them up."""
    xp = namespace(a)
    a = xp.moveaxis(a, 0, -2)
    a = a.reshape(*a.shape[:-2], -1)
    if xp is jnp:
        # Apart from the copy above, which is slow where the compiler makes one of both.
        a = jax.lax.optimization_barrier(a)
    return a[..., :n]


def blockwise(f: Callable, blocks, count=None):
    """`f` on one block after another: memory stays flat.

    In reverse mode each block is computed again from its inputs and from what is `kept`, instead of
    being stored.

    Args:
        count: only so many of them, may be traced; not differentiable then. None: all.
    """
    if count is None:
        named = jax.checkpoint_policies.save_only_these_names(KEPT)
        return jax.lax.map(jax.checkpoint(f, policy=named), blocks)
    f = jax.jit(f)  # traced once
    at, put_at = jax.lax.dynamic_index_in_dim, jax.lax.dynamic_update_index_in_dim
    block = lambda i: jax.tree.map(lambda a: at(a, i, keepdims=False), blocks)
    total = len(jax.tree.leaves(blocks)[0])
    room = jax.tree.map(
        lambda a: jnp.zeros((total, *a.shape), a.dtype), jax.eval_shape(lambda: f(block(0)))
    )
    put = lambda i, room: jax.tree.map(lambda r, a: put_at(r, a, i, 0), room, f(block(i)))
    return jax.lax.fori_loop(0, count, put, room)
