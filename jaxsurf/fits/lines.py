r"""Moments of points on straight lines, such as copies of a neighbour along its normal.

With the last coordinate z as the parameter a line is $x = x_0 + u z$, $y = y_0 + v z$, and what the
weighted points on it make of a monomial follows from two others,

$$F[x^{a+1} y^b z^c] = x_0 F[x^a y^b z^c] + u F[x^a y^b z^{c+1}],$$

starting from the sums $F[z^c]$: the points themselves are needed for these only. Monomials stand
in groups of the same b, ordered by a, then c. The shift of c is then a shift of the rows, at the
price of a few at the ends of the runs that mean nothing and are read by none that do.
"""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ..compiling import is_quick, kept, stored
from . import systems
from .moments import add_moved_moments, all_moments, arranged, columns, moved
from .monomials import monomial_rows, monomials, multi_indices, polynomial_count

# Least cosine between a line and the last axis. Flatter ones have slopes whose powers cancel.
_STEEP = 0.7


def are_steep(x: Float[Array, "dim l k *p"], w: Float[Array, "l k *p"]) -> Bool[Array, ""]:
    """Whether all lines with a weight are steep enough to be followed by their last coordinate."""
    return jnp.all(_is_steep(x[:, -1] - x[:, 0]) | ~jnp.any(w > 0, axis=0))


def _is_steep(along):
    return along[-1] ** 2 >= _STEEP**2 * jnp.sum(along**2, axis=0)


def functionals(
    x: Float[Array, "dim l k *p"], w: Float[Array, "l k *p"], high: int
) -> list[Float[Array, "rows k *p"]]:
    """What the points of each of k lines make of the monomials up to a degree, in groups."""
    along = x[:, -1] - x[:, 0]
    rise = jnp.where(_is_steep(along), along[-1], 1)
    slopes = along[:-1] / rise
    feet = x[:-1, 0] - slopes * x[-1, 0]
    slopes, feet = jax.lax.optimization_barrier((slopes, feet))

    def power(term, _):
        return term * x[-1], jnp.sum(term, axis=0)

    run = jax.lax.scan(power, w, length=high + 1)[1]
    runs = [run]
    for _ in range(high):
        runs.append(_next(runs[-1], len(runs[-1]) - 1, feet[0], slopes[0]))
    groups = [jax.lax.optimization_barrier(jnp.concatenate(runs))]
    for b in range(1, high + 1 if len(x) > 2 else 1):
        groups.append(_next(groups[-1], len(groups[0]) - b * (b + 1) // 2, feet[1], slopes[1]))
    return groups


def _next(rows, count: int, foot, slope):
    # The barrier, as the compiler finds cheap values again at every use.
    return jax.lax.optimization_barrier(foot * rows[:count] + slope * rows[1 : count + 1])


@functools.cache
def _places(dim: int, high: int) -> dict[tuple[int, ...], int]:
    """Where the monomials stand in all groups, one after another."""
    count = (high + 1) * (high + 2) // 2
    starts = np.cumsum([0] + [count - b * (b + 1) // 2 for b in range(high + 1)]).tolist()
    run = [a * (high + 1) - a * (a - 1) // 2 for a in range(high + 1)]
    return {
        tuple(g): starts[g[1] if dim > 2 else 0] + run[g[0]] + g[-1]
        for g in multi_indices(dim, 0, high).tolist()
    }


def _moments(x, w, high):
    """The moments of all lines together, up to twice the degree, graded."""
    sums = jnp.concatenate([jnp.sum(group, axis=1) for group in functionals(x, w, 2 * high)])
    places = _places(len(x), 2 * high)
    return sums[np.array([places[tuple(g)] for g in multi_indices(len(x), 0, 2 * high).tolist()])]


def _weights(a, x, w, low, high):
    """Sums over each line of w times the polynomials with coefficients a."""
    basis = multi_indices(len(x), low, high).tolist()
    groups = functionals(x, w, high)
    order = np.full(sum(map(len, groups)), len(basis), np.int32)
    order[[_places(len(x), high)[tuple(g)] for g in basis]] = np.arange(len(basis))
    a = jnp.concatenate([a, jnp.zeros_like(a[:1])])[order]
    ends = np.cumsum([len(group) for group in groups])[:-1]
    parts = zip(jnp.split(a, ends), groups)
    return sum(jnp.sum(part[:, :, None] * group[:, None], axis=0) for part, group in parts)


@functools.partial(jax.custom_jvp, nondiff_argnums=(3, 4))
def line_solve(
    x: Float[Array, "dim l k *p"],
    w: Float[Array, "l k *p"],
    b: Float[Array, "m c"],
    low: int,
    high: int,
) -> tuple[Float[Array, "c k *p"], Float[Array, "*p"], Float[Array, "*p"]]:
    r"""`moment_solve` for l points on each of k straight lines; their weights are summed.

    Args:
        x: coordinates of the points in units of the neighbourhood; lines about along the last axis
            make it fast, others are served too.
        w, b, low, high: as for `moment_solve`, with one b for all.

    Returns:
        What `moment_solve` returns, with one weight for each line.

    Differentiable: forward and reverse, in x and w, by the closed form; the two diagnostics have
    derivative zero.
    """
    return _solve(x, w, b, low, high)[0]


def _solve(x, w, b, low, high):
    every = _flat(x), w.reshape(-1, *w.shape[2:])

    def pointwise(a):
        s = systems.combine(a, monomials(every[0], high)[len(multi_indices(len(x), 0, low - 1)) :])
        return jnp.sum(w * s.reshape(-1, *w.shape), axis=1)

    steep = not is_quick() and are_steep(x, w)
    found = _either(steep, lambda: _moments(x, w, high), lambda: all_moments(*every, high))
    gram = arranged(kept(found), len(x), low, high)
    solve, condition = systems.factor(gram)
    b = b.astype(w.dtype).reshape(*b.shape, *(1,) * (w.ndim - 2))
    a = kept(solve(jnp.broadcast_to(b, (*b.shape[:2], *w.shape[2:]))))
    eta = _either(steep, lambda: _weights(a, x, w, low, high), lambda: pointwise(a))
    error = jnp.max(jnp.abs(systems.symmetric(gram, a) - b), axis=(0, 1))
    size = jnp.max(jnp.abs(b), axis=(0, 1))
    return (eta, condition, error / jnp.where(size > 0, size, 1)), (solve, a)


@line_solve.defjvp
def _line_solve_jvp(low, high, primals, tangents):
    # As in `moment_solve`, point by point.
    x, w, b = primals
    dx, dw, _ = tangents
    out, (solve, a) = _solve(x, w, b, low, high)
    shape = w.shape
    x, dx, w, dw = _flat(x), _flat(dx), w.reshape(-1, *shape[2:]), dw.reshape(-1, *shape[2:])
    start = len(multi_indices(len(x), 0, low - 1))
    v: list[Array] | Array
    if x.ndim > 2 and systems.is_written_out(polynomial_count(len(x), high)):
        v, a = monomial_rows(x, high), systems.entries(a)
    else:
        v = stored(monomials(x, high), w[(0,) * w.ndim] < 0)
    dx = columns(dx, v, w)
    s = systems.found_once(systems.combine(a, v[start:]), v, w)
    g = dw * s + w * moved(a, v, dx, start, high)
    rhs = add_moved_moments(systems.moments(v[start:], g), w * s, v, dx, start, high)
    d_eta = g - w * systems.combine(solve(rhs), v[start:])
    d_eta = jnp.sum(d_eta.reshape(-1, *shape), axis=1)
    return out, (d_eta, jnp.zeros_like(out[1]), jnp.zeros_like(out[2]))


def _flat(x):
    return x.reshape(len(x), -1, *x.shape[3:])


def _either(condition, one, other):
    return other() if condition is False else jax.lax.cond(condition, one, other)
