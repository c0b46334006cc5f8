r"""Boundary conditions, eliminated: bound values as an affine function of the free ones.

Points are *free* (the equation holds there) or *bound* (their value follows from a condition).
A condition $a\,u + b\,\partial_\nu u = g$ at a bound point, its conormal derivative
replaced by a one-sided stencil $\sum_j w_j u_j$ over the point itself and free neighbours, gives

$$u_i = \frac{g_i - b \sum_{j \ne i} w_j u_j}{a + b\,w_i}, \qquad\text{together}\quad u = E v + e.$$

No bound value depends on another, so that E is explicit. A steady problem $A u = f$ becomes
$P A E v = P (f - A e)$ on the free points (P picks them), a problem in time
$\dot v = P\,F(t, E v + e(t))$.
"""

from __future__ import annotations

from itertools import zip_longest

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse
from jaxtyping import Array, Bool, Float, Int, Real

from .arguments import as_float, as_many, count_on, real, switched_off, whole
from .compiling import host_jit, namespace
from .conditions import Condition
from .failures import check, is_concrete, raise_at
from .stencils.algebra import AbstractOperator

# The factor of an unknown value has to be more than this share of its terms.
_PIVOT = 1e-3


class Source(eqx.Module):
    """Prescribed values of one condition, as they are added to the bound values.

    Args:
        slots: which bound points, `(e,)`.
        factor: what the value is multiplied by, `(e,)`.
        pick: which of the condition's values, `(e,)`.
        condition: where the values come from.
    """

    slots: Int[Array, " e"]
    factor: Float[Array, " e"]
    pick: Int[Array, " e"]
    condition: Condition

    def at(self, t) -> _Given:
        """At a time, in the form that `_filled` takes."""
        return self.slots, self.factor, self.pick, self.condition.at(t)


_Given = tuple[Array, Array, Array, Array]


@host_jit
def marks(n: int, rows) -> Bool[Array | np.ndarray, " n"]:
    """True at these of n rows."""
    if namespace(rows) is np:
        marked = np.zeros(n, bool)
        marked[rows] = True
        return marked
    return jnp.zeros(n, bool).at[rows].set(True)


class Closure(eqx.Module):
    r"""Fills in the bound values of a field: $u = E v + e(t)$.

    Only the rows of bound points are stored; rows of E at free points are those of the
    identity, and bound rows refer to free points only, hence $E^2 = E$.

    Args:
        n: number of points.
        rows: the bound points, `(m,)`.
        indices: free points that each bound value depends on, `(k, m)`.
        weights: with which weight, `(k, m)`; zero in padded slots.
        sources: prescribed values.
        declared: True at points that some condition names, those of `free` included, `(n,)`;
            None: the bound points.

    Example:
        >>> cloud = js.graph(lambda x, y: 0 * x, (8, 8))
        >>> closure = js.eliminate(cloud, js.dirichlet(cloud.boundary, 3.0))
        >>> u = closure(jnp.zeros(64))
        >>> bool(jnp.all(u[cloud.boundary] == 3)), float(u[~cloud.boundary].max())
        (True, 0.0)
    """

    n: int = eqx.field(static=True)
    rows: Int[Array, " m"]
    indices: Int[Array, "k m"]
    weights: Float[Array, "k m"]
    sources: tuple[Source, ...]
    declared: Bool[Array, " n"] | None

    def __init__(self, n, rows, indices, weights, sources=(), declared=None):
        self.n = whole(n, "n", least=1)
        self.rows, self.indices, self.weights = rows, indices, weights
        self.sources, self.declared = sources, declared
        k, m = np.shape(self.indices)[:1], np.shape(self.rows)
        wanted = {"rows": m[:1], "indices": (*k, *m), "weights": (*k, *m), "declared": (self.n,)}
        for name, shape in wanted.items():
            found = getattr(self, name)
            if found is not None and (np.shape(found) != shape or len(m) != 1):
                raise ValueError(f"{name} has shape {np.shape(found)}, expected {shape}")
        for name in ("rows", "indices"):
            found = getattr(self, name)
            outside = lambda x: (x < 0) | (x >= self.n)
            check(found, outside, f"{name} names point {{v}}, there are {self.n}")
        if is_concrete(self.rows):
            often = np.bincount(np.asarray(self.rows), minlength=1)
            raise_at(often > 1, "rows names point {i} {v} times, expected once", often)

    def __repr__(self):
        said = ", ".join(repr(source.condition) for source in self.sources) or "no condition"
        if self.declared is not None and is_concrete(self.declared, self.rows):
            free = int(np.sum(np.asarray(self.declared) & ~np.asarray(self.bound)))
            said += f", free({free} points)" * (free > 0)
        return f"Closure({self.m} of {self.n} points bound: {said})"

    @property
    def m(self) -> int:
        """Number of bound points."""
        return self.rows.shape[0]

    @property
    def bound(self) -> Bool[Array, " n"]:
        """True at bound points."""
        return marks(self.n, self.rows)

    def __call__(self, u: Real[Array, "n *c"], t=0.0) -> Float[Array, "n *c"]:
        """The field with its bound values replaced by those that follow at time t.

        Args:
            u: the field; its bound values are not looked at.
            t: time, for conditions whose values are functions of it.

        Raises:
            TypeError: no array of real numbers.
            ValueError: another number of points; values with components for a field without.
        """
        u, given = self._field(u), self._given(t)
        components = _components(given)
        if len(components) > u.ndim - 1:
            raise ValueError(f"values have components {components}, the field has none")
        if any(c not in (1, own) for c, own in zip(components, u.shape[1:])):
            raise ValueError(f"values have components {components}, the field {u.shape[1:]}")
        return _filled(u, self.rows, self.indices, self.weights, given)

    def homogeneous(self, u: Float[Array, "n *c"]) -> Float[Array, "n *c"]:
        """The linear part E u, which ignores the bound values of u."""
        return _filled(self._field(u), self.rows, self.indices, self.weights, ())

    def offset(self, t=0.0) -> Float[Array, "n *c"]:
        """The affine part e at time t; zero at free points."""
        given = self._given(t)
        shape, dtype = (self.n, *_components(given)), self.weights.dtype
        return _filled(jnp.zeros(shape, dtype), self.rows, self.indices, self.weights, given)

    def restrict(self, u: Float[Array, "n *c"]) -> Float[Array, "n *c"]:
        """The field with its bound values set to zero."""
        return self._field(u).at[self.rows].set(0, unique_indices=True)

    def extend(self, u: Float[Array, "p *c"], t=0.0) -> Float[Array, "n *c"]:
        """A field of the first p points, for a cloud with ghosts after them, filled in."""
        u = as_float(u, "field")
        if u.ndim < 1 or len(u) > self.n:
            raise ValueError(f"field has shape {u.shape}, expected at most {self.n} points")
        return self(jnp.concatenate([u, jnp.zeros((self.n - len(u), *u.shape[1:]), u.dtype)]), t)

    def reduce(self, operator: AbstractOperator) -> AbstractOperator:
        """P A E: what an operator A on all points does to the free ones."""
        return self.restriction @ operator @ self.extension

    @property
    def extension(self) -> Extension:
        """E as an operator."""
        return Extension(self)

    @property
    def restriction(self) -> Restriction:
        """P as an operator."""
        return Restriction(self.n, self)

    def to_scipy(self) -> scipy.sparse.csr_matrix:
        """E as a CSR matrix, `(n, n)`."""
        own = np.flatnonzero(self.restriction.on_host)
        i = np.concatenate([own, np.broadcast_to(self.rows, self.indices.shape).ravel()])
        j = np.concatenate([own, np.asarray(self.indices).ravel()])
        weights = np.asarray(self.weights).ravel()
        values = np.concatenate([np.ones(len(own), weights.dtype), weights])
        matrix = scipy.sparse.csr_matrix((values, (i, j)), shape=(self.n, self.n))
        matrix.eliminate_zeros()
        return matrix

    def _field(self, u):
        return as_float(u, "field", (self.n, ...))

    def _given(self, t) -> tuple[_Given, ...]:
        # The values here and the rest in one compiled function, which a new function of time
        # leaves as it is.
        real(t, "t")
        return tuple(source.at(t) for source in self.sources)


class Extension(AbstractOperator):
    """E: bound values from the free ones, without what is prescribed."""

    closure: Closure
    in_shape = ()
    out_shape = ()

    n = property(lambda self: self.closure.n)

    def __call__(self, u):
        return self.closure.homogeneous(u)

    def to_scipy(self):
        return self.closure.to_scipy()


class Restriction(AbstractOperator):
    """P: the values of free points as they are, zero for others. Symmetric.

    Args:
        n: number of points.
        closure: whose bound points are not free; None if there are none.
        on: nor are those where this is False; None if all are on.
    """

    n: int = eqx.field(static=True, default=0)
    closure: Closure | None = None
    on: Bool[Array, " n"] | None = None
    in_shape = ()
    out_shape = ()

    @property
    def all_free(self) -> bool:
        """True if nothing is bound or switched off, so that P is the identity."""
        return self.closure is None and self.on is None

    @property
    def on_host(self) -> Bool[np.ndarray, " n"]:
        """Which points are free, as a NumPy array."""
        free = np.ones(self.n, bool) if self.on is None else np.array(self.on)
        if self.closure is not None:
            free[np.asarray(self.closure.rows)] = False
        return free

    @property
    def count(self):
        """Number of free points."""
        return count_on(self.on, self.n) - (0 if self.closure is None else self.closure.m)

    def __call__(self, u):
        u = switched_off(self.on, u)
        return u if self.closure is None else self.closure.restrict(u)

    def transpose(self):
        return self

    def to_scipy(self):
        dtype = float if self.closure is None else self.closure.weights.dtype
        return scipy.sparse.diags(self.on_host.astype(dtype)).tocsr()


def _components(given) -> tuple[int, ...]:
    """Components per point of prescribed values."""
    sizes = zip_longest(*(g.shape[1:] for *_, g in given), fillvalue=1)
    return tuple(max(size) for size in sizes)


@jax.jit
def _filled(u, rows, indices, weights, given):
    """u with the values at `rows` replaced: a linear part and what is prescribed."""
    shape = u.shape[1:]
    linear = weights.reshape(*weights.shape, *[1] * len(shape))
    values = jnp.sum(linear * u[indices], axis=0)
    for slots, factor, pick, g in given:
        g = (g[pick] if g.ndim else g[None]).astype(factor.dtype)
        g = g.reshape(*g.shape, *[1] * (len(shape) + 1 - g.ndim))
        part = factor.reshape(-1, *[1] * len(shape)) * g
        values = values.at[slots].add(jnp.broadcast_to(part, (len(slots), *shape)))
    return u.at[rows].set(values.astype(u.dtype), unique_indices=True)


def check_border(operator: AbstractOperator, closure: Closure | None) -> None:
    """Refuse an operator on a surface with a border about which nothing is said.

    Without a condition its stencils there are one-sided, and what it is used for is not well
    posed: modes grow without bound. Looks at concrete arrays only.

    Raises:
        ValueError: names a border point under no condition, how many there are, and the two ways
            out: a condition, or `free`.
    """
    border = operator.border
    known = None if closure is None else (closure.declared, closure.rows)
    if border is None or not is_concrete(border, known):
        return
    left = np.array(border)
    if closure is not None:
        as_many("closure", closure.n, "the operator", operator.n)
        declared = closure.bound if closure.declared is None else closure.declared
        left &= ~np.asarray(declared)
    raise_at(
        left,
        "point {i}{more} lies on the border and is under no condition, so that modes may grow "
        "there without bound. Close the border, closure=js.eliminate(cloud, [js.neumann(...), "
        "...]), or say that it is free: js.eliminate(cloud, js.free(cloud.boundary))",
    )


def check_pivots(pivot, terms, points, what: str) -> None:
    """Refuse what a condition determines by a difference of nearly equal terms.

    Args:
        pivot: the factor of the unknown value, `(m,)`.
        terms: sum of the absolute terms that the factor consists of, `(m,)`.
        points: for the message, `(m,)`.
        what: the unknown with `{i}` for its point, and the factor's formula.
    """
    pivot, terms = np.asarray(pivot), np.asarray(terms)
    text = f"the condition does not determine the {what} = {{v:.1e}}, its terms add up to "
    text += "{terms:.1e} in modulus"
    raise_at(~(np.abs(pivot) > _PIVOT * terms), text, pivot, points=points, terms=terms)
