"""Normals estimated from points, as accurate as the operators that use them."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float
from scipy.spatial import cKDTree

from .arguments import POINTS, as_float, as_many, in_range, instance, switched_off, whole
from .checks import check_count, check_spacing
from .cloud import PointCloud
from .compiling import in_batches, sized_jit
from .failures import check, is_concrete, needs_values, not_finite, raise_at, warn
from .fits.kernels import bell, enclosing
from .fits.monomials import polynomial_count
from .fits.plane import TangentPlane, dot
from .indices import mask
from .machine import FITTED, MOVING, block
from .neighbors import Neighbors
from .orient import check_one_sided, orient_normals, plane_normals
from .sheets import nearest, nearest_on_sheet

# Below this smallest pivot of the scaled normal equations, times the round-off, a fit is noise.
_PIVOT = 100
# A normal that still turns by more than this, in radians, has no fit to settle on.
_LOOSE = 0.01
# Points fitted per call while normals settle.


def from_points(
    points: Float[Array, "n d"],
    *,
    degree: int = 4,
    boundary: Bool[Array, " n"] | None = None,
    k: int | None = None,
) -> PointCloud:
    """Point cloud of a surface that is known by its points alone.

    Args:
        points: n points in d = 2 or 3 dimensions, concrete.
        degree, k: as for `estimate_normals`; the degree that of the operators to be used.
        boundary: True for points on a border of the surface, `(n,)`.

    Returns:
        The points, in the order given, with the normals from `estimate_normals`.

    Accuracy: as `estimate_normals`.
    Not differentiable, as `estimate_normals`. In float32 normals are within 2e-5 on 1,000 points of
    a sphere (`tests/test_frames.py`).
    Raises:
        ValueError, TypeError: as `estimate_normals`; a `boundary` that is no mask of n points.

    Example:
        >>> angle = 2 * jnp.pi * jnp.arange(100) / 100
        >>> circle = jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=1)
        >>> bool(jnp.abs(js.from_points(circle).normals - circle).max() < 1e-7)
        True
    """
    points = _checked_points(points)
    if boundary is not None:
        boundary = mask(boundary, len(points), "boundary")
    return PointCloud(points, estimate_normals(points, degree=degree, k=k), boundary=boundary)


def estimate_normals(
    points: Float[Array, "n d"],
    *,
    degree: int = 4,
    k: int | None = None,
    iterations: int = 40,
    orient: bool = True,
) -> Float[Array, "n d"]:
    r"""Unit normals of a surface that is known by its points alone.

    First planes through the neighbours, then signs that agree over the surface, then the
    polynomial fits of `refit_normals`, repeated until the normals stand still.

    Args:
        points: n points in d = 2 or 3 dimensions, concrete.
        degree: polynomial degree of the fits.
        k: number of neighbours in a fit, the point included; two (curves) or three
            (surfaces) times the number of coefficients if None.
        iterations: most repetitions of the fit at a point; it stops when nothing changes.
        orient: choose the signs; if False, each is arbitrary and neighbours on the
            other side of a thin part cannot be told apart.

    Returns:
        Unit normals, `(n, d)`, outward on closed surfaces. The sign of an open sheet is
        that of its convex side, and arbitrary if it is flat. At points where the fits do not
        settle the first guess is returned, with a warning that names their number.

    Accuracy: angle O(h^degree) (`tests/test_frames.py::test_refit_order`); in float32 what rounding
        leaves, 1e-5 at 4,000 points (`tests/test_frames.py::test_single_precision`).
    Not differentiable: use `refit_normals` with these normals and fixed neighbours.
    Raises:
        ValueError: traced or non-finite points, duplicates, too few points or neighbours for
            the degree, points on a line, surfaces with one side only (named by index, with
            the number needed).
    Source: Suchde and Kuhnert 2019, eq. 4; Hoppe et al. 1992.

    Example:
        >>> angle = 2 * jnp.pi * jnp.arange(100) / 100
        >>> ellipse = jnp.stack([2 * jnp.cos(angle), jnp.sin(angle)], axis=1)
        >>> js.estimate_normals(ellipse)[25].round(6).tolist()
        [0.0, 1.0]
    """
    points = _checked_points(points)
    whole(degree, "degree", least=1)
    whole(iterations, "iterations", least=1)
    if k is not None:
        whole(k, "k")
    instance(orient, (bool, np.bool_), "orient")
    n, dim = points.shape
    x = np.asarray(points)
    needed = polynomial_count(dim - 1, degree)
    if k is None:
        k = 3 * needed if dim == 3 else 2 * needed + 1
    _check_fit(k, degree, needed)
    check_count(k, n)
    tree = cKDTree(x.astype(float))
    check_spacing(x, tree, names=np.arange(n))
    guess = plane_normals(x.astype(float), tree)
    if orient:
        guess = orient_normals(x.astype(float), guess, tree)
        slots, found = nearest_on_sheet(x, guess, tree, k, 0.0)
    else:
        slots, found = nearest(x, guess, tree, k, -1.0)
    count, needs = found.sum(axis=1), f"degree {degree} needs at least {needed}"
    text = f"point {{i}} has {{v}} neighbours on its side of the surface, {needs}"
    raise_at(count < needed, text, count)
    normals, pivot, turn = _settle(points, guess, slots, found, degree, iterations)
    eps = float(jnp.finfo(points.dtype).eps)
    raise_at(
        ~(pivot > _PIVOT * eps),
        f"the {k} neighbours of point {{i}} do not determine a polynomial of degree {degree} "
        f"(smallest pivot {{v:.2g}}, at least {_PIVOT * eps:.2g} is needed)",
        pivot,
    )
    loose = turn > _LOOSE
    if loose.any():
        normals[loose] = guess[loose]
        worst = np.argmax(turn)
        warn(
            f"the surface is not resolved at {loose.sum()} of {n} points: after {iterations} fits "
            f"of degree {degree} their normals still turn, most at point {worst} by "
            f"{turn[worst]:.2g} rad; the normal of the plane through the nearest points is "
            "taken there"
        )
    if orient:
        check_one_sided(x, normals, tree)
    return jnp.asarray(normals)


def refit_normals(
    points: Float[Array, "n d"],
    normals: Float[Array, "n d"],
    neighbors: Neighbors,
    *,
    degree: int,
    iterations: int = 3,
    batch_size: int = FITTED,
) -> Float[Array, "n d"]:
    r"""Normals of local polynomials fitted over the tangent planes of the given normals.

    Near $x_i$ the surface is the graph $z=\sum_{0<|\alpha|\le p} c_\alpha q^\alpha$ over its
    tangent plane, fitted to the neighbours by weighted least squares; it passes through
    $x_i$, and its slope there corrects the normal: $n\propto n_i-\sum_a c_a t_a$.

    Args:
        points: n points in d = 2 or 3 dimensions.
        normals: unit normals to start from; off by less than a right angle.
        neighbors: neighbours on the same sheet, more than the polynomial has coefficients.
        degree: polynomial degree p.
        iterations: times to repeat the fit over the new planes. Each brings the result, and
            its derivative, closer to those of the normals that no longer change.
        batch_size: points treated at a time on a CPU, elsewhere in proportion; bounds the memory.

    Returns:
        Unit normals, `(n, d)`. Switched-off rows keep theirs. Under `jit`, `vmap` and `grad`
        normals are NaN where otherwise an error would be raised: at points with too few
        neighbours, and where a fit turns the normal over.

    Accuracy: angle O(h^degree) (`tests/test_frames.py::test_refit_order`); float32 as
        `estimate_normals`.
    Differentiable: forward and reverse, in points and normals, for fixed neighbours. From
        settled normals, three iterations have the derivative of the settled normals to 1e-6
        (`tests/test_frames.py::test_refit_derivative`).
    Raises:
        ValueError: wrong shapes, k or degree; on concrete arrays also too few neighbours for
            the degree, named by index with both numbers, and a normal turned over by its fit.
        TypeError: arguments of other kinds.

    Example:
        >>> angle = 2 * jnp.pi * jnp.arange(100) / 100
        >>> circle = jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=1)
        >>> neighbors = js.find_neighbors(js.PointCloud(circle, circle), k=9)
        >>> normals = js.refit_normals(circle, jnp.roll(circle, 1, 0), neighbors, degree=4)
        >>> bool(jnp.abs(normals - circle).max() < 1e-6)
        True
    """
    instance(neighbors, Neighbors, "neighbors", "js.find_neighbors(cloud, k) makes some")
    points = as_float(points, "points", *POINTS)
    normals, n = as_float(normals, "normals", points.shape), len(points)
    as_many("neighbors", neighbors.n, "the surface", n)
    whole(iterations, "iterations", least=1)
    whole(batch_size, "batch_size", least=1)
    needed = polynomial_count(points.shape[1] - 1, whole(degree, "degree", least=1))
    _check_fit(neighbors.k, degree, needed)
    known = is_concrete(points, normals, neighbors.mask)
    mask = np.asarray(neighbors.mask) if known else neighbors.mask
    on, count = mask[:, 0], mask.sum(axis=1)
    text = f"point {{i}} has {{v}} neighbours, degree {degree} needs at least {needed}"
    check(count, lambda count, on: on & (count < needed), text, on)
    radius = neighbors.radius
    if radius is not None:
        radius = jnp.broadcast_to(jnp.asarray(radius, points.dtype), n)
    some = None if is_concrete(on) and np.asarray(on).all() else on
    given, points = normals, switched_off(some, points)
    normals = switched_off(some, given, np.eye(points.shape[1])[0])
    lists = neighbors.indices, neighbors.mask, radius
    fitted, cosine = _turned(points, normals, *lists, degree, iterations, batch_size)
    text = (
        "the fit turned the normal of point {i} over (cosine {v:.2f} with the one given): "
        "the points do not resolve the surface there, use more points or a lower degree"
    )
    check(cosine, lambda cosine, on: on & ~(cosine > 0), text, on)
    if is_concrete(cosine, on):
        return switched_off(some, fitted, given)
    bad = on & ((count < needed) | ~(cosine > 0))
    return switched_off(on, jnp.where(bad[:, None], jnp.nan, fitted), given)


def _checked_points(points) -> Float[Array, "n d"]:
    needs_values("points", points, instead="under jit, vmap or grad use refit_normals")
    points = as_float(points, "points", *POINTS)
    x = np.asarray(points)
    raise_at(not_finite(x), "point {i} is not finite: {v}", x)
    in_range(x, "points")
    return points


def _check_fit(k: int, degree: int, needed: int) -> None:
    if k < needed:
        raise ValueError(f"k = {k} neighbours, degree {degree} needs at least {needed}")


def _settle(points, guess, slots, mask, degree: int, iterations: int):
    """Repeat the fits until the normals stand still: normals, pivots and last turns.

    Where the surface is coarse a fit can overshoot; there the steps are halved. Only the
    points that still move are fitted again, in chunks of one size, compiled once.
    """
    dtype = points.dtype
    n = len(points)
    normals = np.array(guess, dtype)
    slots = slots.astype(np.int32)
    pivot, turn, damping = np.ones(n, dtype), np.full(n, np.inf, dtype), np.ones(n, dtype)
    todo = np.arange(n, dtype=np.int32)
    chunk = min(n, block(MOVING))
    for _ in range(iterations):
        for start in range(0, len(todo), chunk):
            part = todo[start : start + chunk]
            i = np.resize(part, chunk)
            new, low = (
                np.asarray(a)[: len(part)]
                for a in _refit(points, normals[i], slots[i], mask[i], None, degree, 1, FITTED)
            )
            step = new - normals[part]
            size = np.linalg.norm(step, axis=1)
            slow = size > 0.5 * turn[part]
            damping[part] = np.where(slow, np.maximum(damping[part] / 2, 1 / 16), damping[part])
            moved = normals[part] + damping[part][:, None] * step
            normals[part] = moved / np.linalg.norm(moved, axis=1, keepdims=True)
            pivot[part], turn[part] = low, size
        todo = todo[turn[todo] > np.finfo(dtype).eps ** 0.7]
        if not todo.size:
            break
    return normals, pivot, turn


@sized_jit
def _refit(points, normals, slots, mask, radius, degree: int, iterations: int, batch_size: int):
    """New normals of the points in the first slots, and the smallest scaled pivot of each fit."""

    def row(normal, slots, mask, radius):
        offsets = points[slots] - points[slots[0]]
        squared = dot(offsets, offsets)
        reach = enclosing(squared, mask) if radius is None else radius**2
        weights = jnp.where(mask, bell(squared / reach), 0)
        reach = jnp.sqrt(reach)

        def step(normal, _):
            plane = TangentPlane.at(normal, offsets, weights, reach, reach)
            graph, condition = plane.surface(1, degree)
            # Without what was added to the matrix, see `systems.factor`.
            pivot = 1 / condition - 4 * len(graph) * jnp.finfo(condition.dtype).eps
            # The linear monomials come first.
            return plane.tilted(normal, graph[: len(plane.tangents)]), pivot

        fitted, pivot = jax.lax.scan(step, normal, length=iterations)
        return jnp.where(mask[0], fitted, normal), pivot[-1]

    return in_batches(lambda r: row(*r), (normals, slots, mask, radius), block(batch_size))


@sized_jit
def _turned(points, normals, slots, mask, radius, degree: int, iterations: int, batch_size: int):
    """New normals, NaN where nothing determines them, and their cosines with those before."""
    fitted, pivot = _refit(points, normals, slots, mask, radius, degree, iterations, batch_size)
    needed = polynomial_count(points.shape[1] - 1, degree)
    determined = pivot > needed * jnp.finfo(points.dtype).eps
    fitted = jnp.where(determined[:, None], fitted, jnp.nan)
    return fitted, jnp.sum(fitted * normals, axis=1)
