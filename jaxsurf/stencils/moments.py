r"""The small moment systems behind every stencil, solved for all points in blocks.

With weights $w_q$, a graded monomial basis $V_{q\gamma} = x_q^\gamma$ and a right-hand side b,
the stencil is

$$\eta_q = w_q \sum_\gamma a_\gamma x_q^\gamma, \qquad A a = b, \qquad
  A_{\beta\gamma} = \sum_q w_q\, x_q^{\beta+\gamma},$$

so that $\sum_q \eta_q x_q^\beta = b_\beta$: the moment conditions (6) of Singh et al. (2023),
and at the same time the weighted least-norm problem (18), (19) of Suchde and Kuhnert (2019).
The entries of A are the moments of w up to twice the degree, and many coincide: each is
summed once.
"""

from __future__ import annotations

import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .monomials import differentiation, monomials, multi_indices, position


@functools.partial(jax.custom_jvp, nondiff_argnums=(3, 4))
def moment_solve(
    x: Float[Array, "dim q"],
    w: Float[Array, " q"],
    b: Float[Array, "m c"],
    low: int,
    high: int,
) -> tuple[Float[Array, "c q"], Float[Array, ""], Float[Array, ""]]:
    r"""Weights $\eta$ with prescribed moments, for c right-hand sides at once.

    Args:
        x: coordinates of the points in units of the neighbourhood, so that they are of order 1.
        w: non-negative weights; points of weight zero do not take part.
        b: moments wanted, for the multi-indices of degree `low` to `high`, graded.
        low: lowest degree of the basis, 0 or 1.
        high: highest degree of the basis.

    Returns:
        The weights $\eta$; an estimate (from below, from the Cholesky pivots) of the condition
        number of the equilibrated matrix; and the largest moment residual relative to b.

    Differentiable: forward and reverse, in x and w, by the closed form; the two diagnostics
    have derivative zero. b is taken as constant.
    """
    return _solve(x, w, b, low, high)[0]


def _solve(x, w, b, low, high):
    v = monomials(x, high)
    start = _first(x.shape[0], low)
    gram = _gram(x, w, low, high)
    solve, condition = _factor(gram)
    a = jnp.zeros((v.shape[0], b.shape[1]), v.dtype).at[start:].set(solve(b.astype(v.dtype)))
    s = a.T @ v
    eta = w * s
    residual = jnp.max(jnp.abs(v[start:] @ eta.T - b)) / jnp.max(jnp.abs(b))
    return (eta, condition, residual), (v, solve, a, s)


@moment_solve.defjvp
def _moment_solve_jvp(low, high, primals, tangents):
    # With s = V a:  d eta = dw s + w (dV a + V da),  A da = -(V^T (dw s + w dV a) + dV^T (w s)).
    x, w, b = primals
    dx, dw, _ = tangents
    (eta, condition, residual), (v, solve, a, s) = _solve(x, w, b, low, high)
    start = _first(x.shape[0], low)
    d = differentiation(x.shape[0], high).astype(v.dtype)
    # dV a is the gradient of the polynomial s along dx; dV^T g the same matrices transposed.
    ds = sum((((d[i] @ a).T @ v) * dx[i] for i in range(x.shape[0])), jnp.zeros_like(s))
    g = dw * s + w * ds
    rhs = v @ g.T + sum(d[i].T @ (v @ (eta * dx[i]).T) for i in range(x.shape[0]))
    da = jnp.zeros_like(a).at[start:].set(-solve(rhs[start:]))
    d_eta = g + w * (da.T @ v)
    return (eta, condition, residual), (d_eta, jnp.zeros_like(condition), jnp.zeros_like(residual))


def _first(dim: int, low: int) -> int:
    return len(multi_indices(dim, 0, low - 1))


@functools.cache
def _gather_table(dim: int, low: int, high: int) -> tuple[np.ndarray, np.ndarray]:
    """Where the moment of multi-index beta + gamma stands: first coordinates, last coordinate."""
    basis = multi_indices(dim, low, high)
    total = basis[:, None] + basis[None]
    place = position(dim - 1, 2 * high) if dim > 1 else {(): 0}
    rows = np.array([[place[tuple(g[:-1])] for g in row] for row in total.tolist()])
    return rows, total[..., -1]


def _gram(x, w, low, high):
    # Moments as one small matrix product: monomials in all coordinates but the last, times
    # powers of the last.
    powers = monomials(x[-1:], 2 * high)
    others = monomials(x[:-1], 2 * high) if x.shape[0] > 1 else jnp.ones_like(x)
    moments = (others * w) @ powers.T
    return moments[_gather_table(x.shape[0], low, high)]


def _factor(gram):
    """A solver for the equilibrated matrix, and its condition estimate.

    The factorisation gets a shift of the size of round-off, so that it exists also where a
    moment is dependent on the others (a flat surface with few normal copies, say); one step of
    refinement on the unshifted matrix takes the effect of the shift away again.
    """
    diagonal = jnp.diagonal(gram)
    scale = jax.lax.rsqrt(jnp.where(diagonal > 0, diagonal, 1))
    a = gram * scale * scale[:, None]
    shift = 4 * a.shape[0] * jnp.finfo(a.dtype).eps
    chol = jnp.linalg.cholesky(a + shift * jnp.eye(a.shape[0], dtype=a.dtype))
    pivots = jnp.diagonal(chol)
    condition = (jnp.max(pivots) / jnp.min(pivots)) ** 2

    def solve(b):
        b = b * scale[:, None]
        first = jax.scipy.linalg.cho_solve((chol, True), b)
        second = jax.scipy.linalg.cho_solve((chol, True), b - a @ first)
        return (first + second) * scale[:, None]

    return solve, condition


def blockwise(f: Callable, batch_size: int, *arguments):
    """`vmap(f)` over the leading axis of all arrays, a block at a time: memory stays flat.

    The last block is filled up with copies of the last row, so that one compiled block serves
    all. In reverse mode each block is computed again from its inputs instead of being stored.
    """
    n = jax.tree.leaves(arguments)[0].shape[0]
    size = min(batch_size, n)
    blocks = -(-n // size)

    def split(a):
        if blocks * size != n:
            a = a[jnp.minimum(jnp.arange(blocks * size), n - 1)]
        return a.reshape(blocks, size, *a.shape[1:])

    block = jax.checkpoint(jax.vmap(f))
    out = jax.lax.map(lambda rows: block(*rows), jax.tree.map(split, arguments))
    return jax.tree.map(lambda a: a.reshape(blocks * size, *a.shape[2:])[:n], out)
