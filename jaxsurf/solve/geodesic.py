r"""Distances along a surface by the heat method."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable

import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import scipy.sparse
from jaxtyping import Array, Bool, Float, Int

from ..arguments import instance, real, within_round_off
from ..build import choose_fewer_neighbors
from ..cloud import PointCloud
from ..compiling import at_once, sized_jit
from ..discretization import Discretization
from ..failures import is_concrete, needs_values, refuse, unchecked
from ..neighbors import Neighbors, find_neighbors, switched_on
from ..stencils.gfdm import GFDM
from ..stencils.method import AbstractMethod
from ..stencils.stencil import Stencil
from .krylov import BiCGStab, solve_system
from .paths import around, path_lengths, source_indices, tell_short
from .precondition import jacobi, multigrid

# From this distance of their mean, in units of their root mean square, neighbours are one-sided.
_ONE_SIDED = 0.45
# A chord leans out of a tangent plane by 60 degrees at most.
_LEANING = 4.0
# Stencils spread heat over as much as a time of this times h² would: it falls the more slowly.
# Found on circles, spheres, squares and random points, where v with it neither grows nor falls by
# more than 0.05 of the powers.
_SPREAD = 0.15
_COLD = (
    "heat from the sources has not converged by Jacobi's iteration, which needs a method of second "
    "order, with weights of one sign"
)


def geodesic_distance(
    cloud: PointCloud,
    sources: Bool[Array, " n"] | Int[Array, " m"],
    *,
    neighbors: Neighbors | None = None,
    method: AbstractMethod = GFDM(degree=2),
    smoothing: float = 0.5,
    rtol: float | None = None,
) -> Float[Array, " n"]:
    r"""Distance of every point from the nearest source, along the surface, by the heat method.

    (Crane, Weischedel and Wardetzky 2013.) Heat that leaves the sources for a time
    $t = (s h)^2$, $u - t \Delta_S u = \delta$, flows away from them: $X = -\nabla_S u / |\nabla_S
    u|$ is the gradient of the distance. Four things differ from the usual form:

    - u falls like $e^{-d / \sqrt t}$, over hundreds of powers of ten. With p the length of the
      shortest path along neighbours, $v = e^{p / \sqrt t} u$ is solved for instead, by
      Jacobi's iteration, whose terms do not cancel: every v gets its digits.
    - The gradient is integrated as differences,
      $\sum_j (d_j - d_i) = \sum_j b_{ij} (x_j - x_i)\cdot(X_i + X_j) / 2$ over the neighbours j
      of i, which where two fronts meet and X jumps needs no divergence of it. The factors b make
      up for chords that are shorter than arcs and lean out of the tangent planes.
    - Next to the sources the distance is prescribed: that along the circular arc that fits both
      points and their normals. So a corner in the distance is not differentiated.
    - Where weights of the Laplacian have both signs, as along borders, it is a random walk's, which
      keeps heat positive, and the direction is the mean of those near by.

    Args:
        cloud: n points with unit normals; borders need no conditions.
        sources: a mask, or indices; concrete.
        neighbors: lists, concrete; if None as many as `method` asks for, other numbers
            along borders (host only).
        method: of the Laplacian and the gradient; of second order, as heat has to stay positive.
        smoothing: s, in units of the spacing h. More of it rounds the distance off where fronts
            meet, and bends it by O(s h); less is less well resolved.
        rtol: of both linear solves; by the precision of the points if None.

    Returns:
        Distances, `(n,)`, zero at the sources, and at points that are switched off.

    Accuracy: relative l2 error 2e-3 from one source on the sphere at n = 10,000, and no less with
    more points: heat for a time of the size of h² is not resolved, whatever h. Where fronts meet
    first order: 7e-3 from five sources (`tests/test_geodesic.py`,
    `python -m experiments run geodesics`). On surfaces with a border and on random points 1e-2 to
    4e-2 with 2,000 points (tested there too). First order on
    curves, 1e-2 with 200 even or graded points; on 300 random points of a circle, whose gaps are up
    to six spacings, 5e-2 to 0.4. Not yet shown for methods above second order.
    In float32 within 1e-4 of that, in l2 (`test_single_precision` there).
    Differentiable: forward and reverse, in points and normals, for fixed neighbours. Where two ways
        are the shortest there is a crease, and no derivative: at such points (opposite the source
        on a circle, say) what is given hangs on round-off.
    Raises:
        ValueError: no source; a source that is no point; a point that no path leads to.
        RuntimeError: a linear solve failed.
        ImportError: pyamg is not installed (extra `multigrid`).

    Example:
        >>> cloud = js.sphere(2_000)
        >>> distance = js.geodesic_distance(cloud, jnp.array([0]))
        >>> exact = jnp.arccos(cloud.points @ cloud.points[0])
        >>> bool(jnp.linalg.norm(distance - exact) < 0.02 * jnp.linalg.norm(exact))
        True
    """
    instance(cloud, PointCloud, "cloud", "js.PointCloud(points, normals) makes one")
    instance(method, AbstractMethod, "method", "like js.GFDM(degree=2)")
    if neighbors is not None:
        instance(neighbors, Neighbors, "neighbors", "js.find_neighbors(cloud, k) makes them")
        if neighbors.n != cloud.n:
            raise ValueError(f"neighbours of {neighbors.n} points, the cloud has {cloud.n}")
    real(smoothing, "smoothing", above=0)
    sources = source_indices(sources, cloud)  # type: ignore[assignment]
    if neighbors is None:
        neighbors = _neighbors(cloud, method)
    else:
        needs_values("neighbors", neighbors.indices, neighbors.mask)
    if cloud.active is not None:
        cloud, neighbors = cloud.seen, _own_in_padding(switched_on(cloud, neighbors))
    if rtol is not None:
        within_round_off(rtol, cloud.points.dtype)
    else:
        rtol = float(jnp.finfo(cloud.points.dtype).eps) ** 0.6

    indices, mask = np.asarray(neighbors.indices), np.asarray(neighbors.mask)
    off = ~cloud.host_active
    path = path_lengths(jax.lax.stop_gradient(cloud.points), neighbors, indices, mask, sources, off)
    near, owners = around(indices, sources)
    with at_once():  # of the lists alone, also where points are traced
        share = _shares(indices, mask).astype(cloud.points.dtype)
        fixed = np.isin(np.arange(cloud.n), near)
        traced = not is_concrete(cloud.points, cloud.normals)
        inverse = _preconditioner(indices, share, fixed, traced)
        known = jax.device_put((share, fixed, near, owners, sources.astype(np.int32), off))
    surface = Discretization(cloud, neighbors, method)
    plain = (surface.laplacian.weights, surface.gradient.weights)
    scale = np.asarray(smoothing, cloud.points.dtype)
    place = cloud.points, cloud.normals
    where = place, neighbors, plain, path
    distance, cold, unsolved = _distances(*where, known, inverse, scale, rtol)
    if cloud.active is not None:  # whatever comes back from there in reverse
        distance = jnp.where(cloud.active, distance, jax.lax.stop_gradient(distance))
    distance = refuse(distance, cold, _COLD, error=RuntimeError)
    text = f"distances have not been found to a relative tolerance of {rtol:.1g} (`rtol`)"
    distance = refuse(distance, unsolved, text, error=RuntimeError)
    if is_concrete(distance):
        tell_short(cloud, sources, np.asarray(distance))
    return distance


@sized_jit
def _distances(place, neighbors, plain, path, known, inverse, smoothing, rtol):
    """All that is done on the device, in one program, and which solve failed; rtol is static."""
    points, normals = place
    share, fixed, near, owners, sources, off = known
    indices = neighbors.indices.T
    h = _spacing(points, neighbors)
    root = smoothing * h
    laplacian, gradient = plain
    mixed = jnp.any(laplacian[1:] < -1e-3 * jnp.abs(laplacian[0]), axis=0)
    laplacian = jnp.where(mixed, _random_walk(points, indices, share), laplacian)
    # The operators on v: similar to those on u, whatever the path.
    growth = jnp.exp((path - path[indices]) / jnp.sqrt(root**2 + _SPREAD * h**2))
    heat = unchecked(Stencil, indices, (-(root**2) * laplacian * growth).at[0].add(1))
    # Switched-off points have equations of their own, v = 1 and then d = 0.
    start = off.astype(path.dtype).at[sources].set(1)
    # Heat takes about two steps for every spacing between the source and the farthest point.
    limit = 1000 + (20 * jnp.max(path) / root).astype(int)
    v, cold = _warm(heat, start, jax.lax.stop_gradient(limit), rtol)
    flow = unchecked(Stencil, indices, -gradient * growth[:, None], (points.shape[1],))(v)

    distance, away = _arcs(points, normals, near, owners)
    # Only directions count; those next to the sources are known.
    direction = _unit(flow / v[:, None])
    others = share * ~mixed[indices]
    replaced = mixed & (jnp.sum(others, axis=0) > 0)
    from_others = _unit(unchecked(Stencil, indices, others)(direction))
    direction = jnp.where(replaced[:, None], from_others, direction).at[near].set(away)
    value = jnp.zeros_like(path).at[near].set(distance)
    differences = indices, share, fixed
    distance, unsolved = _integrate(place, differences, direction, value, inverse, rtol)
    return distance, cold, unsolved


def _random_walk(points, indices, share):
    """A Laplacian without negative weights: steps to neighbours, as often as their size asks."""
    square = jnp.sum(share * jnp.sum((points[indices] - points) ** 2, axis=2), axis=0)
    square = jnp.where(square > 0, square, 1)
    return (2 * (points.shape[1] - 1) / square) * share.at[0].set(-1)


def _warm(heat: Stencil, start, limit, rtol: float):
    """The solution of the rescaled heat equation, positive everywhere, with its derivative.

    And whether it has not been found.

    Once the values are known, the operator is rescaled by them too: the solution is then one
    everywhere, and derivatives, which have both signs, are of like size at all points.
    """
    known, given = jax.lax.stop_gradient((heat, start))
    values, unfinished = _relaxed(known, given, known.diagonal, jnp.abs, limit, rtol)
    weights = heat.weights * (values[heat.indices] / values)
    # Zero; what is left of it is the derivative of the equation at its solution.
    residual = start / values - unchecked(Stencil, heat.indices, weights)(jnp.ones_like(values))
    residual = residual - jax.lax.stop_gradient(residual)
    return values * (1 + _zero(weights, residual, heat.indices, limit, rtol)), unfinished


@functools.partial(jax.custom_jvp, nondiff_argnums=(4,))
def _zero(weights, residual, indices, limit, rtol: float):
    """The solution of a system whose right-hand side is zero: only its derivative is solved for."""
    del weights, indices, limit, rtol
    return jnp.zeros_like(residual)


@_zero.defjvp
def _zero_jvp(rtol, primals, tangents):
    weights, residual, indices, limit = primals
    d_weights, d_residual, *_ = tangents
    operator = unchecked(Stencil, indices, weights)
    diagonal = jax.lax.stop_gradient(operator.diagonal)
    nothing = _zero(weights, residual, indices, limit, rtol)

    def solve(matvec, b):
        largest = lambda x: jnp.max(jnp.abs(x))
        x, unfinished = _relaxed(matvec, b, diagonal, largest, limit, rtol)
        return refuse(x, unfinished, _COLD)

    d_residual = d_residual - unchecked(Stencil, indices, d_weights)(nothing)
    return nothing, jax.lax.custom_linear_solve(operator, d_residual, solve, solve)


def _relaxed(operator: Callable, rhs, diagonal, size: Callable, limit, rtol: float):
    """Solve by Jacobi's iteration until no entry changes by more than the share rtol of a size.

    Also whether it has not come to that in so many steps.
    """

    def step(carry):
        x, _, count = carry
        change = (rhs - operator(x)) / diagonal
        return x + change, jnp.any(jnp.abs(change) > rtol * size(x)), count + 1

    start = rhs / diagonal, jnp.array(True), jnp.array(0)
    goes_on = lambda carry: carry[1] & (carry[2] < limit)
    x, unfinished, _ = jax.lax.while_loop(goes_on, step, start)
    return x, unfinished | ~jnp.all(jnp.isfinite(x))


def _shares(indices, mask) -> Float[np.ndarray, "k n"]:
    """Weights of the differences, whose sum is one.

    Where the directions are a gradient any will do, but rows that lean to one side are a random
    walk with a drift, which takes exponentially long to come back to a source that it leads away
    from; and where spacing grows, be it by one per cent across a square, nearest neighbours do
    lean. So a pair has one weight from either end, by the ranks of both in each other's lists
    (up to the sum of its row). These depend on nothing but the lists, hence neither does the
    preconditioner. (With equal weights no connection would count as strong in multigrid.)
    """
    others = mask.copy()
    others[:, 0] = False
    rank = np.cumsum(others, axis=1) / (1 + np.sum(others, axis=1, keepdims=True))
    near = np.where(others, (1 - rank) ** 3, 0)
    n, k = indices.shape
    rows = np.repeat(np.arange(n), k)
    matrix = scipy.sparse.csr_matrix((near.ravel(), (rows, indices.ravel())), shape=(n, n))
    # What the list of the other has of this point; nothing, where it has not.
    back = np.asarray(matrix[indices.ravel(), rows]).reshape(n, k)
    share = np.where(others, near + back, 0).T
    total = np.sum(share, axis=0)
    return share / np.where(total > 0, total, 1)


def _differences(indices, share, fixed, table=None) -> Stencil:
    """Value less the mean of the others, between free points; the identity where it is known."""
    own = np.arange(len(share))[:, None] == 0
    return unchecked(Stencil, indices, own - share * ~(fixed | fixed[indices]), table=table)


def _preconditioner(indices, share, fixed, differentiated: bool):
    """Of the differences, and the table of their transpose where it is needed."""
    operator = _differences(np.ascontiguousarray(indices.T), share, fixed)
    # Hierarchies need unknowns.
    inverse = jacobi(operator) if fixed.all() else multigrid(operator)
    return jax.device_put(inverse), operator.prepared.table if differentiated else None


def _integrate(place, differences, direction, value, inverse, rtol):
    """The field whose differences fit the directions and which has given values near sources.

    And whether it has not been found.
    """
    (x, normals), (indices, share, fixed) = place, differences

    def add_slot(total, slot):
        j, w = slot
        chord = x[j] - x
        step = _along(chord, direction, normals) + _along(chord, direction[j], normals[j])
        return total - w * (_bent(chord, normals[j] - normals) * step / 2 - value[j]), None

    rhs, _ = jax.lax.scan(add_slot, jnp.zeros_like(value), (indices, share))
    preconditioner, table = inverse
    operator = _differences(indices, share, fixed, table)
    found = solve_system(operator, jnp.where(fixed, 0, rhs), BiCGStab(rtol), preconditioner)
    return found.value + value, found.result != lx.RESULTS.successful


def _along(chord, direction, normals):
    """A chord's part along directions, as if it was turned into the tangent plane of one end.

    Where normals are rough it leans out of that by as much, and would be too short.
    """
    square = jnp.sum(chord**2, axis=1)
    square = jnp.where(square > 0, square, 1)
    flat = square - jnp.sum(chord * normals, axis=1) ** 2
    longer = jnp.sqrt(square / jnp.maximum(flat, square / _LEANING))
    return longer * jnp.sum(chord * direction, axis=1)


def _bent(chord, turn):
    r"""Length of an arc over its chord.

    A circle through two points turns by $2\theta$, $\sin\theta = a = (n_j - n_i)\cdot e / 2$ with e
    along the chord: $\theta / \sin\theta = 1 + a^2 / 6 + 3 a^4 / 40 + \dots$
    """
    square = jnp.sum(chord**2, axis=1)
    a2 = jnp.sum(turn * chord, axis=1) ** 2 / (4 * jnp.where(square == 0, 1, square))
    return 1 + a2 * (1 / 6 + a2 * (3 / 40))


def _neighbors(cloud, method) -> Neighbors:
    """The usual ones, as a Laplacian that does not suit heat is replaced; others at borders.

    There distances are twice as wrong without them. A border is seen by neighbours that lie to one
    side: those of a straight one have their mean 0.6 of their mean square away.
    """
    count = min(method.neighbor_count(cloud.dim), int(cloud.host_active.sum()))
    neighbors = find_neighbors(cloud, count)
    x, mask = np.asarray(cloud.points), np.asarray(neighbors.mask)[:, :, None]
    offsets = np.where(mask, x[np.asarray(neighbors.indices)] - x[:, None], 0)
    total, square = offsets.sum(axis=1), (offsets**2).sum(axis=(1, 2))
    one_sided = (total**2).sum(axis=1) > _ONE_SIDED**2 * mask.sum(axis=(1, 2)) * square
    if cloud.boundary is not None:  # folds are one-sided too
        marked = np.asarray(cloud.boundary)[np.asarray(neighbors.indices)]
        one_sided &= (marked & mask[:, :, 0]).any(axis=1)
    if not one_sided.any():
        return neighbors
    chosen, rows = choose_fewer_neighbors(cloud, method), one_sided[:, None]
    indices = jnp.where(rows, chosen.indices, neighbors.indices)
    return Neighbors(indices, jnp.where(rows, chosen.mask, neighbors.mask))


def _own_in_padding(neighbors: Neighbors) -> Neighbors:
    indices, mask = np.asarray(neighbors.indices), np.asarray(neighbors.mask)
    indices = np.where(mask, indices, np.arange(len(indices), dtype=indices.dtype)[:, None])
    return Neighbors(jnp.asarray(indices), neighbors.mask, neighbors.radius)


def _spacing(points, neighbors) -> Float[Array, ""]:
    """The spacing h at which k neighbours fill a disk of area k h², or a piece k h of a curve."""
    on = neighbors.mask[:, 0]
    count = jnp.maximum(jnp.sum(neighbors.mask, axis=1), 1)
    offset = points[neighbors.indices] - points[:, None]
    square = jnp.sum(jnp.where(neighbors.mask, jnp.sum(offset**2, axis=2), 0), axis=1) / count
    curve = points.shape[1] == 2
    squares = 12 * square / count**2 if curve else 2 * math.pi * square / count
    return jnp.sqrt(jnp.sum(squares) / jnp.sum(on))


def _arcs(x, n, near, owners):
    r"""Distance of points from the nearest of their sources, and the direction away from it.

    A circle through both with their normals turns by $2 \arcsin a$ on the way, with
    $a = (n - n_s)\cdot e / 2$ and e the unit vector along the chord.
    """
    squares = jnp.sum((x[near][:, None] - x[owners]) ** 2, axis=2)
    source = owners[np.arange(len(near)), jnp.argmin(squares, axis=1)]
    chord = x[near] - x[source]
    at_source = source == near
    length = jnp.sqrt(jnp.where(at_source, 1, jnp.sum(chord**2, axis=1)))
    e = chord / length[:, None]
    a = jnp.sum((n[near] - n[source]) * e, axis=1) / 2
    flat = jnp.abs(a) < 1e-4
    safe = jnp.where(flat, 1, a)
    distance = length * jnp.where(flat, 1 + a**2 / 6, jnp.arcsin(safe) / safe)
    tangent = e - n[near] * jnp.sum(n[near] * e, axis=1, keepdims=True)
    return jnp.where(at_source, 0, distance), _unit(jnp.where(at_source[:, None], 0, tangent))


def _unit(vectors):
    """Unit vectors; zero stays zero, as where equal fronts meet."""
    square = jnp.sum(vectors**2, axis=1, keepdims=True)
    zero = square == 0
    return jnp.where(zero, 0, vectors / jnp.sqrt(jnp.where(zero, 1, square)))
