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

from collections.abc import Sequence
from itertools import zip_longest

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse
from jaxtyping import Array, Bool, Float, Int, Real

from .arguments import as_float, instance, is_concrete, raise_at, real, whole
from .borders.border import Border, checked_border
from .borders.order import find_border, inward
from .build import residual_tolerance, stencil_weights
from .cloud import PointCloud
from .conditions import Condition, checked_conditions
from .neighbors import Neighbors, Rows, nearest_of
from .stencils.gfdm import GFDM
from .stencils.method import AbstractMethod
from .stencils.stencil import AbstractOperator, Stencil
from .stencils.targets import Gradient

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
        >>> closure = js.close(cloud, js.dirichlet(cloud.boundary, 3.0))
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
            if is_concrete(found):
                values = np.asarray(found).ravel()
                bad = (values < 0) | (values >= self.n)
                raise_at(bad, f"{name} names point {{v}}, there are {self.n}", values)

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
        return jnp.zeros(self.n, bool).at[self.rows].set(True)

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
        return self._field(u).at[self.rows].set(0)

    def extend(self, u: Float[Array, "p *c"], t=0.0) -> Float[Array, "n *c"]:
        """A field of the first p points, for a cloud with ghosts after them, filled in."""
        u = as_float(u, "field")
        if u.ndim < 1 or len(u) > self.n:
            raise ValueError(f"field has shape {u.shape}, expected at most {self.n} points")
        return self(jnp.concatenate([u, jnp.zeros((self.n - len(u), *u.shape[1:]), u.dtype)]), t)

    @property
    def stencil(self) -> Stencil:
        """E as an operator on all points. It stores k weights per point, free ones too."""
        k = self.indices.shape[0]
        own = jnp.arange(self.n, dtype=self.indices.dtype)
        indices = jnp.broadcast_to(own, (k + 1, self.n)).at[1:, self.rows].set(self.indices)
        weights = jnp.zeros((k + 1, self.n), self.weights.dtype).at[0].set(1)
        weights = weights.at[0, self.rows].set(0).at[1:, self.rows].set(self.weights)
        return Stencil(indices, weights)

    def to_scipy(self) -> scipy.sparse.csr_matrix:
        """E as a CSR matrix, `(n, n)`."""
        rows, free = np.asarray(self.rows), ~np.asarray(self.bound)
        own = np.flatnonzero(free)
        i = np.concatenate([own, np.broadcast_to(rows, self.indices.shape).ravel()])
        j = np.concatenate([own, np.asarray(self.indices).ravel()])
        weights = np.asarray(self.weights).ravel()
        values = np.concatenate([np.ones(len(own), weights.dtype), weights])
        matrix = scipy.sparse.csr_matrix((values, (i, j)), shape=(self.n, self.n))
        matrix.eliminate_zeros()
        return matrix

    def _field(self, u):
        u = as_float(u, "field")
        if u.ndim < 1 or u.shape[0] != self.n:
            raise ValueError(f"field has shape {u.shape}, expected ({self.n}, ...)")
        return u

    def _given(self, t) -> tuple[_Given, ...]:
        # The values here and the rest in one compiled function, which a new function of time
        # leaves as it is.
        real(t, "t")
        return tuple(source.at(t) for source in self.sources)


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
    return u.at[rows].set(values.astype(u.dtype))


def close(
    cloud: PointCloud,
    conditions: Condition | Sequence[Condition],
    *,
    neighbors: Neighbors | None = None,
    method: AbstractMethod = GFDM(degree=2),
    border: Border | None = None,
    throw: bool = True,
) -> Closure:
    r"""Eliminate boundary conditions with one-sided stencils.

    The derivative along the conormal is $\nu\cdot\nabla_S u$ by the stencils of `method` over
    the point itself and its nearest free points, so that bound values never depend on each
    other. Dirichlet conditions need no stencil, and hold on any set of points.

    Args:
        cloud: n points with unit normals. Points under no condition are free; on the border of
            the surface they have to be named by `free`, or solvers refuse the operator.
        conditions: one or several; together they may name a point twice only if they agree.
        neighbors: lists for all n points, of which the free ones are used; if None, the
            nearest free points are searched for (host only).
        method: how the derivatives are computed; of the operator's order or one above. GFDM
            serves DC-PSE operators too.
        border: from `find_border`, for conormals on traced points; found where needed if None.
        throw: check stencils and pivots (on concrete arrays).

    Returns:
        The map from free values to fields that meet the conditions.

    Accuracy: bound values O(h^{p+1}) for GFDM(degree=p) and DCPSE(order=p). Largest relative
        error of a screened Poisson problem with flux conditions on a spherical cap of 1,600
        points: 1.6e-3 GFDM(2), 1.5e-5 GFDM(4), 6e-4 DCPSE(2) closed by GFDM(3), 1.3e-5 DCPSE(4)
        closed by GFDM(4), with the orders of the operators (`tests/test_boundary.py`).
    Differentiable: forward and reverse, in points, normals, values, a, b and conormals, for
    fixed neighbours.
    Raises:
        TypeError: what is no cloud, condition, neighbours, method or border.
        ValueError: contradictory conditions; no conormal, or one that is not tangent to the
            surface or leads into it; a mask or neighbours of another number of points; fewer free
            neighbours than the method needs; a + b w_i near zero, with w_i the weight of the point
            itself in its conormal derivative (a Robin condition of the wrong sign); each with
            the point.

    Example:
        >>> cloud = js.sphere(500)
        >>> equator = jnp.abs(cloud.points[:, 2]) < 0.05
        >>> closure = js.close(cloud, js.dirichlet(equator, 2.0))
        >>> bool((closure(jnp.zeros(500)) == jnp.where(equator, 2.0, 0.0)).all())
        True
    """
    conditions, owner = checked_conditions(cloud, conditions)
    instance(method, AbstractMethod, "method", "as js.GFDM(degree=2)")
    check_parts(cloud, neighbors, border)
    free, declared = cloud.host_active.copy(), np.zeros(cloud.n, bool)
    for condition in conditions:
        declared[condition.where] = True
        free[condition.where] &= condition.is_free
    dtype = cloud.points.dtype

    parts, sources, start = [], [], 0
    for condition, own in zip(conditions, owner):
        rows, m = condition.where[own], int(own.sum())
        if condition.a is None or not m:  # free
            continue
        a = jnp.broadcast_to(condition.a, condition.m)[own].astype(dtype)
        if condition.b is None:
            pivot, slots, weights = a, jnp.zeros((0, m), jnp.int32), jnp.zeros((0, m), dtype)
        else:
            b = jnp.broadcast_to(condition.b, condition.m)[own].astype(dtype)
            nu = _conormals(cloud, condition, rows, own, border)
            near = _free_neighbors(cloud, rows, free, neighbors, method)
            gradient, diagnostics = stencil_weights(cloud, near, method, Gradient(), rows)
            w = jnp.einsum("md,kdm->km", nu, gradient)
            pivot, slots, weights = a + b * w[0], near.indices.T[1:], -b * w[1:]
            if throw and is_concrete(w, a, b):
                size = np.abs(a) + np.abs(b) * np.abs(w).sum(axis=0)
                _check_stencils(rows, near, diagnostics.residual, method, cloud.dim)
                check_pivots(
                    np.asarray(pivot), np.asarray(size), rows, "value at point {i}: a + b w_i"
                )
        parts.append((rows, slots, weights / pivot))
        place = jnp.arange(start, start + m)
        sources.append(Source(place, 1 / pivot, jnp.asarray(np.flatnonzero(own)), condition))
        start += m
    rows, indices, weights = stacked(parts, int(np.argmax(free)), dtype)
    return Closure(cloud.n, rows, indices, weights, tuple(sources), jnp.asarray(declared))


def check_parts(cloud, neighbors, border) -> None:
    """Refuse neighbours and borders that are none, or of another cloud."""
    if neighbors is not None:
        instance(neighbors, Neighbors, "neighbors", "made by js.find_neighbors")
        if neighbors.n != cloud.n:
            raise ValueError(f"neighbours of {neighbors.n} points, the cloud has {cloud.n}")
    if border is not None:
        checked_border(border, cloud)


def check_border(operator: AbstractOperator, conditions: Closure | None) -> None:
    """Refuse an operator on a surface with a border about which nothing is said.

    Without a condition its stencils there are one-sided, and what it is used for is not well
    posed: modes grow without bound. Looks at concrete arrays only.

    Raises:
        ValueError: names a border point under no condition, how many there are, and the two ways
            out: a condition, or `free`.
    """
    border = operator.border
    known = None if conditions is None else (conditions.declared, conditions.rows)
    if border is None or not is_concrete(*jax.tree.leaves((border, known))):
        return
    left = np.array(border)
    if conditions is not None:
        if conditions.n != operator.n:
            raise ValueError(f"conditions for {conditions.n} points, the operator has {operator.n}")
        declared = conditions.bound if conditions.declared is None else conditions.declared
        left &= ~np.asarray(declared)
    if left.any():
        raise ValueError(
            f"point {np.argmax(left)} lies on the border and is under no condition "
            f"({int(left.sum())} such points), so that modes may grow there without bound. Close "
            "the border, conditions=js.close(cloud, [js.neumann(...), ...]), or say that it is "
            "free: js.close(cloud, js.free(cloud.boundary))"
        )


def stacked(parts, free: int, dtype):
    """One table of rows, indices and weights; padding refers to a free point."""
    nothing = (np.zeros(0, np.int32), jnp.zeros((0, 0), jnp.int32), jnp.zeros((0, 0), dtype))
    parts = parts or [nothing]
    k = max(len(slots) for _, slots, _ in parts)
    padding = lambda x: ((0, k - len(x)), (0, 0))
    rows = np.concatenate([rows for rows, _, _ in parts])
    indices = [jnp.pad(jnp.asarray(s), padding(s), constant_values=free) for _, s, _ in parts]
    weights = [jnp.pad(w, padding(w)) for _, _, w in parts]
    return jnp.asarray(rows), jnp.concatenate(indices, axis=1), jnp.concatenate(weights, axis=1)


# --- one-sided stencils --------------------------------------------------------------------


def _conormals(cloud, condition, rows, own, border) -> Float[Array, "m d"]:
    """Those of the condition; else those of the border."""
    if condition.conormals is not None:
        _check_conormals(cloud, condition)
        return condition.conormals[own].astype(cloud.points.dtype)
    if border is None and cloud.boundary is not None:
        border = find_border(cloud)
    place = np.full(cloud.n, -1)
    if border is not None:
        place[np.asarray(border.points)] = np.arange(len(border.points))
    lacking = place[rows] < 0
    if lacking.any():
        raise ValueError(
            f"no conormal at point {rows[np.argmax(lacking)]}: it is not on the border of the "
            f"cloud ({int(lacking.sum())} such points); mark it in `boundary` or give conormals"
        )
    assert border is not None
    return border.conormals(cloud)[place[rows]]


# The sine of the angle that a conormal may be off the tangent plane: 3 degrees.
_OFF = 0.05


def _check_conormals(cloud, condition) -> None:
    """Given conormals have to be tangent to the surface, and to lead out of it at its border."""
    conormals, where = condition.conormals, condition.where
    if conormals.shape[1] != cloud.dim:
        raise ValueError(f"conormals have shape {conormals.shape}, expected (..., {cloud.dim})")
    if not is_concrete(conormals, cloud.points, cloud.normals, cloud.boundary):
        return
    nu, normals = np.asarray(conormals), np.asarray(cloud.normals)[where]
    normal = np.abs(np.einsum("md,md->m", nu, normals))
    bad = np.flatnonzero(normal > _OFF)
    if bad.size:
        raise ValueError(
            f"the conormal at point {where[bad[0]]} is not tangent to the surface: its normal part "
            f"is {normal[bad[0]]:.3g}, expected at most {_OFF} ({bad.size} such points)"
        )
    if cloud.boundary is None:
        return
    at_border = np.flatnonzero(np.asarray(cloud.boundary)[where])
    inside = inward(np.asarray(cloud.points), np.flatnonzero(cloud.host_active), where[at_border])
    along = np.einsum("md,md->m", nu[at_border], inside)
    bad = np.flatnonzero(along > 0.3 * np.linalg.norm(inside, axis=1))
    if bad.size:
        raise ValueError(
            f"the conormal at point {where[at_border[bad[0]]]} leads into the surface, expected "
            f"outward ({bad.size} such points)"
        )


def _free_neighbors(cloud, rows, free, neighbors, method) -> Rows:
    """Every row's own point, then free ones by distance; padding repeats a free one."""
    need = method.basis_size(cloud.dim, Gradient())
    radius = None
    if neighbors is None:
        if not is_concrete(cloud.points, cloud.normals):
            raise ValueError("neighbors=None needs concrete arrays; under jit pass the neighbours")
        indices, mask = _nearest_free(cloud, rows, free, method.neighbor_count(cloud.dim))
    else:
        if not is_concrete(neighbors.indices, neighbors.mask):
            raise ValueError("neighbours must be concrete: which points are free decides shapes")
        indices, mask = (np.asarray(x)[rows] for x in (neighbors.indices, neighbors.mask))
        indices, mask = _compacted(indices, mask & (free[indices] | (indices == rows[:, None])))
        if neighbors.radius is not None:
            radius = jnp.broadcast_to(neighbors.radius, cloud.n)
    count = mask.sum(axis=1)
    if count.min() < need:
        i = int(np.argmin(count))
        raise ValueError(
            f"point {rows[i]} has {count[i] - 1} free neighbours, {method} needs at least "
            f"{need - 1} besides the point itself ({int(np.sum(count < need))} such points)"
        )
    indices = np.where(mask, indices, indices[:, 1:2])
    return Rows(jnp.asarray(indices), jnp.asarray(mask), radius)


def _nearest_free(cloud, rows, free, k):
    """The k nearest of own point and free points, from as many candidates as it takes."""
    available = int(cloud.host_active.sum())
    count = min(2 * k, available)
    while True:
        indices, mask = nearest_of(cloud, rows, count)
        mask = mask & (free[indices] | (indices == rows[:, None]))
        if count == available or mask.sum(axis=1).min() >= k or count >= 8 * k:
            return _compacted(indices, mask, k)
        count = min(2 * count, available)


def _compacted(indices, mask, k=None):
    """The slots in use first, in their order; of these the first k."""
    order = np.argsort(~mask, axis=1, kind="stable")
    width = int(mask.sum(axis=1).max()) if k is None else min(k, int(mask.sum(axis=1).max()))
    order = order[:, :width]
    return np.take_along_axis(indices, order, axis=1), np.take_along_axis(mask, order, axis=1)


def _check_stencils(rows, near, residual, method, dim) -> None:
    residual = np.asarray(residual)
    bad = np.flatnonzero(~(residual < residual_tolerance(residual.dtype)))
    if bad.size:
        i = bad[0]
        raise ValueError(
            f"degenerate one-sided stencil at point {rows[i]}: relative moment residual "
            f"{residual[i]:.1e} with {int(near.mask[i].sum()) - 1} free neighbours, {method} needs "
            f"{method.basis_size(dim, Gradient()) - 1} in general position ({bad.size} such points)"
        )


def check_pivots(pivot, terms, points, what: str) -> None:
    """Refuse what a condition determines by a difference of nearly equal terms.

    Args:
        pivot: the factor of the unknown value, `(m,)`.
        terms: sum of the absolute terms that the factor consists of, `(m,)`.
        points: for the message, `(m,)`.
        what: the unknown with `{i}` for its point, and the factor's formula.
    """
    bad = np.flatnonzero(~(np.abs(pivot) > _PIVOT * terms))
    if bad.size:
        i = bad[0]
        raise ValueError(
            f"the condition does not determine the {what.format(i=points[i])} = {pivot[i]:.1e}, "
            f"its terms add up to {terms[i]:.1e} in modulus ({bad.size} such points)"
        )
