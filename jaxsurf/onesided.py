"""Boundary conditions closed by one-sided stencils."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import nullcontext

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .arguments import as_many, instance, shaped
from .borders.border import Border, checked_border
from .borders.order import find_border, inward
from .boundary import Closure, Source, check_pivots, marks
from .build import residual_tolerance, stencil_weights
from .cloud import PointCloud
from .compiling import at_once, host_jit, namespace, on_device, sized_jit
from .conditions import Condition, checked_conditions
from .discretization import Discretization
from .failures import is_concrete, needs_values, raise_at, refuse
from .fits.kernels import gaussian
from .neighbors import Neighbors, Rows, nearest_of
from .stencils.method import AbstractMethod, power_mean, ramp
from .stencils.targets import Gradient
from .stencils.usual import USUAL


def eliminate(
    cloud: PointCloud | Discretization,
    conditions: Condition | Sequence[Condition],
    *,
    neighbors: Neighbors | None = None,
    method: AbstractMethod | None = None,
    border: Border | None = None,
    throw: bool = True,
) -> Closure:
    r"""Eliminate boundary conditions with one-sided stencils.

    The derivative along the conormal is $\nu\cdot\nabla_S u$ by the stencils of `method` over
    the point itself and its nearest free points, so that bound values never depend on each
    other. Dirichlet conditions need no stencil, and hold on any set of points.

    Args:
        cloud: n points with unit normals, or a surface from `discretize`, which then has
            neighbours and border: so also where points are traced, within `evolve`. Points under
            no condition are free; on the border of the surface they have to be named by `free`,
            or solvers refuse the operator.
        conditions: one or several; together they may name a point twice only if they agree.
        neighbors: lists for all n points, of which the free ones are used; if None, the
            nearest free points are searched for (host only).
        method: how the derivatives are computed; of the operator's order or one above. GFDM
            serves DC-PSE operators too. If None that of a surface, or `GFDM(degree=4)`.
        border: from `find_border`, for conormals on traced points; found where needed if None.
        throw: check stencils and pivots (on concrete arrays).

    Returns:
        The map from free values to fields that meet the conditions.

    Accuracy: bound values O(h^{p+1}) for GFDM(degree=p) and DCPSE(order=p). Largest relative
        error of a screened Poisson problem with flux conditions on a spherical cap of 1,600
        points: 1.6e-3 GFDM(2), 1.5e-5 GFDM(4), 6e-4 DCPSE(2) closed by GFDM(3), 1.3e-5 DCPSE(4)
        closed by GFDM(4), with the orders of the operators (`tests/test_boundary.py`). In float32
        filled values are within 2e-5, by degree 4 within 1e-4, gradients in the points within 1 %
        (`tests/test_boundary.py`, `tests/test_forms.py`).
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
        >>> closure = js.eliminate(cloud, js.dirichlet(equator, 2.0))
        >>> bool((closure(jnp.zeros(500)) == jnp.where(equator, 2.0, 0.0)).all())
        True
    """
    of_surface = isinstance(cloud, Discretization) and neighbors is None
    if isinstance(cloud, Discretization):
        neighbors = cloud.neighbors if neighbors is None else neighbors
        border = cloud.border if border is None else border
        method = cloud.method if method is None else method
        cloud = cloud.cloud
    conditions, owner = checked_conditions(cloud, conditions)
    method = USUAL if method is None else method
    instance(method, AbstractMethod, "method", "as js.GFDM(degree=4)")
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
        pick = np.flatnonzero(own)
        a = _picked(condition.a, condition.m, pick, dtype)
        if condition.b is None:
            pivot, slots, weights = a, np.zeros((0, m), np.int32), np.zeros((0, m), dtype)
        else:
            b = _picked(condition.b, condition.m, pick, dtype)
            nu = _conormals(cloud, condition, rows, own, border)
            near = _free_neighbors(cloud, rows, free, neighbors, method)
            others = free if of_surface else None
            near, w, residual = _outward_derivative(cloud, near, rows, nu, method, others)
            if throw:
                w = _checked(w, rows, near, residual, method, cloud.dim)
            pivot, weights = _resolved(a, b, w)
            slots = np.asarray(near.indices).T[1:]
            if throw and is_concrete(w, a, b):
                size = np.abs(a) + np.abs(b) * np.abs(w).sum(axis=0)
                check_pivots(pivot, size, rows, "value at point {i}: a + b w_i")
        parts.append((rows, slots, weights))
        place = on_device(np.arange(start, start + m))
        sources.append(Source(place, _inverse(pivot), on_device(pick), condition))
        start += m
    rows, indices, weights = stacked(parts, int(np.argmax(free)), dtype)
    return Closure(cloud.n, rows, indices, weights, tuple(sources), on_device(declared))


def without_flux(surface: Discretization) -> Closure | None:
    r"""The condition $\partial_\nu u = 0$ on the whole border of a surface, for problems on it.

    As `eliminate(cloud, neumann(cloud.boundary))`, but by the neighbours that the surface has, and
    also where points are traced: within `evolve`, on a border that moves and gains points.

    Args:
        surface: from `discretize`.

    Returns:
        The closure; None of a surface without border.

    Accuracy: as `eliminate`, in float32 too (`tests/test_boundary.py`).
    Differentiable: forward and reverse, in points and normals, for fixed neighbours.
    Raises:
        TypeError: no surface.
        ValueError: neighbours off the border that do not determine a value on it (named by index;
            others are searched for first, but in compiled code, where it is an error of the run
            time).

    Example:
        >>> bowl = lambda s: (jnp.sin(s), -jnp.cos(s))
        >>> surface = js.discretize(js.surface_of_revolution(bowl, 400))
        >>> closure = js.without_flux(surface)
        >>> heat = js.AdvectionDiffusionReaction(surface.laplacian, closure=closure)
        >>> u = js.integrate(heat, surface.cloud.points[:, 0], t1=20.0).ys[-1]
        >>> bool(jnp.ptp(u) < 1e-3)
        True
    """
    instance(surface, Discretization, "surface", "js.discretize(cloud) makes one")
    cloud, neighbors, method, border = (
        surface.cloud, surface.neighbors, surface.method, surface.border
    )  # fmt: skip
    if border is None:
        return None
    rows = border.points
    # Lists that are known stay so where points are traced, as `solve` has to know them.
    known = is_concrete(neighbors, rows)
    with at_once() if known else nullcontext():
        own, slots, bound = _without_bound(neighbors, rows)
    free = cloud.host_active & ~np.asarray(bound) if is_concrete(cloud, bound) else None
    nu = border.conormals(cloud)
    near, w, residual = _outward_derivative(cloud, own, rows, nu, method, free)
    if near is not own:
        slots = near.indices.T[1:]
    w = _checked(w, rows, near, residual, method, cloud.dim)
    if is_concrete(w):
        names, found = np.asarray(rows), np.asarray(w)
        size = np.abs(found).sum(axis=0)
        check_pivots(found[0], size, names, "value at point {i}: the weight w_i of its derivative")
    return Closure(cloud.n, rows, slots, _shares(w), (), bound)


@host_jit
def _without_bound(neighbors: Neighbors, rows):
    """Lists of some rows without the others of these, slots of other points, the rows as a mask."""
    slots = neighbors.indices[rows]
    bound = marks(neighbors.n, rows)
    near = Rows(slots, neighbors.mask[rows] & (~bound[slots] | (slots == rows[:, None])), None)
    return near, slots.T[1:], bound


_shares = host_jit(lambda w: -w[1:] / w[0])


@host_jit
def _picked(coefficient, m: int, pick, dtype):
    """That of some of the points of a condition, which has one for each of them or for all."""
    return namespace(pick).broadcast_to(coefficient, m)[pick].astype(dtype)


@host_jit
def _resolved(a, b, w):
    """What the value is multiplied by in a u + b w·u, and then the other values in its place."""
    pivot = a + b * w[0]
    return pivot, -b * w[1:] / pivot


_inverse = host_jit(lambda pivot: 1 / pivot)


# Weights of one sign begin to take over where the curvature times the reach of a stencil is this,
# and have where it is more by so much.
_BENT, _BEYOND = 1.0, 0.25
# Or where what other values are multiplied by is in sum so many times what that at the border is,
# in units of what it is on a straight border: 1.5 at degree 2, 4 to 4.6 at 4, 12 at 6. (At corners
# up to six times that.)
_GAIN, _MOST_GAIN = 10.0, 16.0
# Length of their kernel in units of the reach.
_NEAR = 0.3


def _outward_derivative(cloud, near: Rows, rows, conormals, method: AbstractMethod, free=None):
    r"""Lists, weights of $\nu\cdot\nabla_S$ at some points, `(k, m)`, and their moment residuals.

    Where these lists do not determine it, as on a border where they lie on few lines, those of the
    nearest of the points that are `free`, `(n,)`, if that is given and nothing is traced.

    Where the surface bends within the stencil, or too little stands behind the value at the border,
    $\sum_j \eta_j (u_i - u_j)$ with positive $\eta$ over points further in, exact on linear
    functions of $\nu\cdot x$ only. What polynomials
    extrapolate to a rough border can be a hundred times the values it comes from, and grows.
    """
    gradient, diagnostics = stencil_weights(cloud, near, method, Gradient(), rows)
    residual = diagnostics.residual
    if free is not None and is_concrete(residual):
        if not (np.asarray(residual) < residual_tolerance(residual.dtype)).all():
            near = _free_neighbors(cloud, np.asarray(rows), free, None, method)
            return _outward_derivative(cloud, near, rows, conormals, method)
    degree = method.polynomial_degree
    return near, _outward(gradient, cloud.seen, near, rows, conormals, degree), residual


@sized_jit
def _outward(gradient, seen, near: Rows, rows, conormals, degree: int) -> Float[Array, "k m"]:
    """Those of a gradient along conormals, or of one sign."""
    weights = jnp.einsum("md,kdm->km", conormals, gradient)
    used = near.mask.T
    offsets = seen.points[near.indices] - seen.points[rows][:, None]
    turn = jnp.sum(offsets * (seen.normals[near.indices] - seen.normals[rows][:, None]), axis=2).T
    squared = jnp.sum(offsets**2, axis=2).T
    on = used & (squared > 0)
    # Of points that fill a disc, half of its squared radius is the mean.
    mean = jnp.sum(jnp.where(on, squared, 0), axis=0) / jnp.sum(used, axis=0)
    reach = jnp.sqrt(jnp.where(mean > 0, 2 * mean, 1))
    bend = jnp.where(on, jnp.abs(turn) / jnp.where(on, squared, 1), 0) * reach
    bent = ramp((power_mean(bend, on.astype(bend.dtype)) - _BENT) / _BEYOND)
    others, own = jnp.sum(jnp.abs(weights[1:]), axis=0), jnp.abs(weights[0])
    usual = 1.5 * 8 ** ((degree - 2) / 4)
    gain = others / jnp.where(own > 0, usual * own, 1)
    loud = jnp.where(own > 0, ramp((gain - _GAIN) / (_MOST_GAIN - _GAIN)), 1)
    part = bent + loud - bent * loud

    inwards = jnp.maximum(-jnp.einsum("mkd,md->km", offsets, conormals), 0)
    kernel = gaussian(squared, _NEAR * reach, reach, on)
    second = jnp.sum(kernel * inwards**2, axis=0)
    one_sign = -kernel * inwards / jnp.where(second > 0, second, 1)
    one_sign = one_sign.at[0].set(-jnp.sum(one_sign[1:], axis=0))
    blend = weights + part * (one_sign - weights)
    return jnp.where((part > 0) & (second > 0), blend, weights)


def check_parts(cloud, neighbors, border) -> None:
    """Refuse neighbours and borders that are none, or of another cloud."""
    if neighbors is not None:
        instance(neighbors, Neighbors, "neighbors", "made by js.find_neighbors")
        as_many("neighbours", neighbors.n, "the cloud", cloud.n)
    if border is not None:
        checked_border(border, cloud)


def stacked(parts, free: int, dtype):
    """One table of rows, indices and weights; padding refers to a free point.

    Who refers to whom is concrete in traced code too, where `solve` has to know it.
    """
    nothing = (np.zeros(0, np.int32), np.zeros((0, 0), np.int32), np.zeros((0, 0), dtype))
    parts = parts or [nothing]
    k = max(len(slots) for _, slots, _ in parts)
    padding = lambda x: ((0, k - len(x)), (0, 0))
    rows = np.concatenate([rows for rows, _, _ in parts])
    indices = [np.pad(s, padding(s), constant_values=free) for _, s, _ in parts]
    table = np.concatenate(indices, axis=1)
    return on_device(rows), on_device(table), _side_by_side([w for *_, w in parts], k)


@host_jit
def _side_by_side(weights: list, k: int):
    numbers = namespace(weights[0])
    filled = [numbers.pad(w, ((0, k - len(w)), (0, 0))) for w in weights]
    return numbers.concatenate(filled, axis=1)


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
    raise_at(
        place[rows] < 0,
        "no conormal at point {i}{more}: it is not on the border of the cloud; mark it in "
        "`boundary` or give conormals",
        points=rows,
    )
    assert border is not None
    return border.conormals(cloud)[place[rows]]


# The sine of the angle that a conormal may be off the tangent plane: 3 degrees.
_OFF = 0.05


def _check_conormals(cloud, condition) -> None:
    """Given conormals have to be tangent to the surface, and to lead out of it at its border."""
    conormals = shaped(condition.conormals, "conormals", (..., cloud.dim))
    where = condition.where
    if not is_concrete(conormals, cloud.points, cloud.normals, cloud.boundary):
        return
    nu, normals = np.asarray(conormals), np.asarray(cloud.normals)[where]
    normal = np.abs(np.einsum("md,md->m", nu, normals))
    text = "the conormal at point {i} is not tangent to the surface: its normal part is {v:.3g}, "
    raise_at(normal > _OFF, f"{text}expected at most {_OFF}", normal, points=where)
    if cloud.boundary is None:
        return
    at_border = np.flatnonzero(np.asarray(cloud.boundary)[where])
    inside = inward(np.asarray(cloud.points), np.flatnonzero(cloud.host_active), where[at_border])
    along = np.einsum("md,md->m", nu[at_border], inside)
    bad = along > 0.3 * np.linalg.norm(inside, axis=1)
    text = "the conormal at point {i} leads into the surface, expected outward"
    raise_at(bad, text, points=where[at_border])


def _free_neighbors(cloud, rows, free, neighbors, method) -> Rows:
    """Every row's own point, then free ones by distance; padding repeats a free one."""
    need = method.basis_size(cloud.dim, Gradient())
    radius = None
    if neighbors is None:
        needs_values("cloud", cloud, instead="under jit pass the neighbours")
        indices, mask = _nearest_free(cloud, rows, free, method.neighbor_count(cloud.dim))
    else:
        lists = neighbors.indices, neighbors.mask
        needs_values("neighbors", lists, instead="which points are free decides shapes")
        indices, mask = (np.asarray(x)[rows] for x in lists)
        indices, mask = _compacted(indices, mask & (free[indices] | (indices == rows[:, None])))
        if neighbors.radius is not None:
            radius = jnp.broadcast_to(neighbors.radius, cloud.n)
    count = mask.sum(axis=1)
    text = f"point {{i}} has {{v}} free neighbours, {method} needs at least {need - 1} besides "
    raise_at(count < need, f"{text}the point itself", count - 1, points=rows)
    indices = np.where(mask, indices, indices[:, 1:2])
    return Rows(on_device(indices), on_device(mask), radius)


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


def _checked(w, rows, near, residual, method, dim) -> Float[Array, "k m"]:
    """Weights that meet their conditions; what is traced ends in an error when it runs."""
    most, need = residual_tolerance(residual.dtype), method.basis_size(dim, Gradient()) - 1
    residual, mask = (np.asarray(a) if is_concrete(a) else a for a in (residual, near.mask))
    return refuse(
        w,
        ~(residual < most),
        "degenerate one-sided stencil at point {i}: relative moment residual {v:.1e}, above "
        f"{most:.0e}, with {{count}} free neighbours; {method} needs {need} in general position: "
        "more of them, or a lower degree or order",
        residual,
        points=rows,
        count=mask.sum(axis=1) - 1,
    )
