r"""Moments of points on straight lines, such as copies of a neighbour along its normal.

With the last coordinate z as the parameter a line is $x = x_0 + u z$, $y = y_0 + v z$, and what the
weighted points on it make of a monomial follows from two others,

$$F[x^{a+1} y^b z^c] = x_0 F[x^a y^b z^c] + u F[x^a y^b z^{c+1}],$$

starting from the sums $F[z^c]$: the points themselves are needed for these only. All of it, and the
sums over the lines, is one program of straight-line code, which stores nothing in between.
"""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ..compiling import first, is_quick, kept, stored
from . import systems
from .moments import add_moved_moments, all_moments, arranged, columns, moved
from .monomials import monomial_rows, monomials, multi_indices, polynomial_count, position
from .sums import sums


def are_steep(x: Float[Array, "dim l k *p"], w: Float[Array, "l k *p"]) -> Bool[Array, ""]:
    """Whether the last coordinate changes most along all lines that have a weight."""
    last = len(x) - 1
    return jnp.all((_steepest(x) == last) | ~jnp.any(w > 0, axis=0))


def _steepest(x):
    """The coordinate that changes most along each line: slopes above 1 have powers that cancel."""
    return jnp.argmax(jnp.abs(x[:, -1] - x[:, 0]), axis=0)


def functionals(
    x: Float[Array, "dim l k *p"], w: Float[Array, "l k *p"], high: int, steep: bool = True
) -> list[Float[Array, "k *p"]]:
    """What the points of each of k lines make of the monomials up to a degree, graded.

    Args:
        steep: whether the last coordinate is that which changes most along each of the lines.
    """
    basis = position(len(x), high)
    if steep:
        found = _on_steep(list(x), w, high)
        return [found[g] for g in basis]
    # Coordinates in another order for each line, and the monomials accordingly.
    steepest, turns = _steepest(x), range(1, len(x) + 1)
    each, twice = jnp.broadcast_to(steepest, w.shape), [*x, *x]
    turned = [jax.lax.select_n(each, *(twice[a + i] for i in turns)) for a in range(len(x))]
    found = _on_steep(turned, w, high)
    return [jax.lax.select_n(steepest, *(found[g[i:] + g[:i]] for i in turns)) for g in basis]


def _on_steep(x, w, high) -> dict[tuple[int, ...], Array]:
    """The same by multi-index, with the last of the coordinates x as the parameter of all lines."""
    along = [x_i[-1] - x_i[0] for x_i in x]
    # Lines without a weight may have any slope, or none.
    longest = functools.reduce(jnp.maximum, map(abs, along))
    rise = jnp.where(2 * abs(along[-1]) > longest, along[-1], 1)
    slopes = [along_i / rise for along_i in along[:-1]]
    feet = [x_i[0] - slope * x[-1][0] for x_i, slope in zip(x, slopes)]
    heights = list(x[-1])
    add, times = jax.lax.add, jax.lax.mul
    terms, found = list(w), {}
    for c in range(high + 1):
        found[(0,) * (len(x) - 1) + (c,)] = functools.reduce(add, terms)
        terms = list(map(times, terms, heights))
    # Each after those that its recurrence reads.
    for g in sorted(position(len(x), high), key=lambda g: sum(g[:-1])):
        if g not in found:
            axis = next(a for a in range(len(x)) if g[a])
            lower = (*g[:axis], g[axis] - 1, *g[axis + 1 :])
            shifted = (*lower[:-1], lower[-1] + 1)
            found[g] = add(times(feet[axis], found[lower]), times(slopes[axis], found[shifted]))
    return found


@functools.partial(jax.jit, static_argnums=(2, 3))
def moments(x, w, high, steep):
    """What all lines together make of the monomials up to a degree, graded; see `functionals`."""
    return jnp.stack(sums(functionals(x, w, high, steep), 0))


@functools.partial(jax.jit, static_argnums=(3, 4, 5))
def _weights(a, x, w, low, high, steep):
    """Sums over each line of w times the polynomials with coefficients a."""
    found = functionals(x, w, high, steep)[len(multi_indices(len(x), 0, low - 1)) :]
    each = lambda a: jax.lax.broadcast(a, w.shape[1:2])
    one = lambda a: functools.reduce(jax.lax.add, map(jax.lax.mul, map(each, a), found))
    return jnp.stack([one(list(jnp.unstack(a_c))) for a_c in jnp.unstack(a, axis=1)])


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
            are treated somewhat faster than others.
        w, b, low, high: as for `moment_solve`, with one b for all.

    Returns:
        What `moment_solve` returns, with one weight for each line.

    Differentiable: forward and reverse, in x and w, by the closed form; the two diagnostics have
    derivative zero.
    """
    return _solve(x, w, b, low, high)[0]


def _solve(x, w, b, low, high):
    if is_quick():
        every = _flat(x), w.reshape(-1, *w.shape[2:])
        found, weights = all_moments(*every, high), lambda a: _weights_by_points(a, x, w, low, high)
    else:
        steep = are_steep(x, w)
        found = _either(steep, lambda of: moments(x, w, 2 * high, of))
        weights = lambda a: _either(steep, lambda of: _weights(a, x, w, low, high, of))
    gram = arranged(kept(found), len(x), low, high)
    solve, condition = systems.factor(gram)
    b = b.astype(w.dtype).reshape(*b.shape, *(1,) * (w.ndim - 2))
    a = kept(solve(jnp.broadcast_to(b, (*b.shape[:2], *w.shape[2:]))))
    eta = kept(weights(a))
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
        v = stored(monomials(x, high), first(w) < 0)
    dx = columns(dx, v, w)
    s = systems.found_once(systems.combine(a, v[start:]), v, w)
    g = dw * s + w * moved(a, v, dx, start, high)
    rhs = add_moved_moments(systems.moments(v[start:], g), w * s, v, dx, start, high)
    d_eta = g - w * systems.combine(solve(rhs), v[start:])
    d_eta = jnp.sum(d_eta.reshape(-1, *shape), axis=1)
    return out, (d_eta, jnp.zeros_like(out[1]), jnp.zeros_like(out[2]))


def _weights_by_points(a, x, w, low, high):
    s = systems.combine(a, monomials(_flat(x), high)[len(multi_indices(len(x), 0, low - 1)) :])
    return jnp.sum(w * s.reshape(-1, *w.shape), axis=1)


def _flat(x):
    return x.reshape(len(x), -1, *x.shape[3:])


def _either(condition, function):
    """A function of True or of False: what is traced has a program for each."""
    return jax.lax.cond(condition, lambda: function(True), lambda: function(False))
