"""Surfaces of revolution and graphs of functions, with exact normals, on quasi-uniform points."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxsurf.arguments import differentiable, in_range, on_host, whole
from jaxsurf.cloud import PointCloud
from jaxsurf.compiling import block_by_block
from jaxsurf.failures import raise_at
from jaxsurf.functions import Traced, canonical
from jaxsurf.shapes.order import sort_points
from jaxsurf.shapes.spacing import MOST

# Successive angles at this distance never line up, whatever their number.
GOLDEN_ANGLE = np.pi * (3 - np.sqrt(5))
# Parameter values at which arc lengths and areas are tabulated.
_TABLE = 4_097


def surface_of_revolution(
    profile: Callable[[Float[Array, ""]], tuple[Float[Array, ""], Float[Array, ""]]],
    n: int,
    *,
    interval: tuple[float, float] = (0.0, 1.0),
) -> PointCloud:
    r"""n quasi-uniform points on the surface swept by a profile curve about the z axis.

    Rings h apart along the profile, with numbers of points in proportion to their lengths. An
    end of the profile on the axis is a pole; if the profile returns to its start, the surface
    closes like a torus; any other end is a border, and its ring is marked in `boundary`.

    Args:
        profile: s -> (radius, z), differentiable by JAX, with radius > 0 inside the interval
            and nowhere stationary.
        n: number of points, at least 12.
        interval: range of s.

    Returns:
        Sorted cloud. Normals by differentiation: outward on a closed surface; on one with
        borders they point to the right of the direction of travel in the (radius, z) plane,
        which is away from the axis where z grows.

    Accuracy: smallest distance above 0.75 h where the profile is long against h.
    Raises:
        ValueError: n too small for the rings, or a profile that meets the axis inside.

    Example:
        >>> vase = js.surface_of_revolution(lambda s: (1 + 0.3 * jnp.sin(3 * s), s), 2_000)
        >>> outward = (vase.normals * vase.points)[:, :2].sum(axis=1) > 0
        >>> vase.n, bool(vase.boundary.any()), bool(outward.all())
        (2000, True, True)
    """
    check_count(n, 12)
    start, stop = _interval(interval)
    dtype = jnp.result_type(float)
    found = differentiable(profile, "profile", jax.ShapeDtypeStruct((), dtype))
    if not (isinstance(found, tuple | list) and [np.shape(a) for a in found] == [(), ()]):
        raise TypeError("profile must return two numbers, radius and z, for one number")
    program = canonical(profile, jnp.zeros((), dtype))
    along = block_by_block(partial(_curve, program), dtype)

    table = np.linspace(start, stop, _TABLE)
    curve, tangent = (np.asarray(a, float) for a in along(table))
    in_range(curve, "profile")
    radius, speed = curve[:, 0], np.linalg.norm(tangent, axis=1)
    tiny = 1e3 * float(jnp.finfo(jnp.result_type(float)).eps) * np.abs(curve).max()
    inside = slice(1, -1)
    raise_at(~(speed[inside] > 0), "profile is stationary or not finite at s = {v}", table[inside])
    raise_at(radius[inside] <= tiny, "profile meets the axis inside, at s = {v}", table[inside])
    pole = np.abs(radius[[0, -1]]) <= tiny
    periodic = not pole.any() and np.linalg.norm(curve[0] - curve[-1]) <= tiny
    border = ~pole & (not periodic)
    raise_at(radius[[0, -1]] < -tiny, "profile ends at radius {v}", radius[[0, -1]])

    length = cumulative(speed, table)
    area = cumulative(2 * np.pi * radius * speed, table)[-1]
    # Points on a border stand for half a cell: n = area / h² + (length of borders) / 2h.
    rim = np.pi * radius[[0, -1]] @ border
    spacing = (rim + np.sqrt(rim**2 + 4 * n * area)) / (2 * n)
    # Rings on the borders, half a gap away from ends that are none.
    halves = border.sum() / 2
    rings = max(round(length[-1] / spacing + halves), 2)
    place = np.arange(rings) + (0.0 if border[0] else 0.5)
    s = np.interp(place / (rings - halves) * length[-1], length, table)
    ring, slope = (np.asarray(a, float) for a in along(s))
    counts = _shares(ring[:, 0], n)

    row = np.repeat(np.arange(rings), counts)
    within = np.arange(n) - np.repeat(np.cumsum(counts) - counts, counts)
    angle = 2 * np.pi * within / counts[row] + GOLDEN_ANGLE * row
    out = np.stack([slope[:, 1], -slope[:, 0]], axis=1)
    out /= np.linalg.norm(out, axis=1, keepdims=True)
    closed = not border.any()
    if closed and cumulative(radius**2 * tangent[:, 1], table)[-1] < 0:
        out = -out
    boundary = (border[0] & (row == 0)) | (border[1] & (row == rings - 1))
    return sorted_cloud(
        swept(ring[row], angle), swept(out[row], angle), None if closed else boundary
    )


def graph(
    f: Callable[[Float[Array, ""], Float[Array, ""]], Float[Array, ""]],
    n: int | tuple[int, int],
    *,
    bounds: tuple[tuple[float, float], tuple[float, float]] = ((-1.0, -1.0), (1.0, 1.0)),
) -> PointCloud:
    r"""The surface z = f(x, y) over a rectangle, with upward normals.

    Args:
        f: height, differentiable by JAX.
        n: (nx, ny) for a regular grid that includes the border; or the exact total, in equal
            rows that differ by at most one point (a regular grid where n permits).
        bounds: lower and upper corner of the rectangle.

    Returns:
        Sorted cloud, the border marked in `boundary`. Points are evenly spaced over the
        rectangle, so they are further apart where f is steep.

    Raises:
        ValueError: fewer than 3 points a row, or an empty rectangle.

    Example:
        >>> bump = js.graph(lambda x, y: jnp.exp(-(x**2) - y**2), (30, 20))
        >>> bump.n, int(bump.boundary.sum()), bool((bump.normals[:, 2] > 0).all())
        (600, 96, True)
    """
    (x0, y0), (x1, y1) = in_range(on_host(bounds, "bounds", (2, 2)), "bounds")
    if not (x1 > x0 and y1 > y0):
        raise ValueError(f"upper corner {bounds[1]} must exceed lower corner {bounds[0]}")
    dtype = jnp.result_type(float)
    number = jax.ShapeDtypeStruct((), dtype)
    found = differentiable(f, "f", number, number)
    if getattr(found, "shape", None) != ():
        raise TypeError("f must return one number, the height, for two numbers")
    if isinstance(n, tuple | list):
        if len(n) != 2:
            raise ValueError(f"n = {n} has {len(n)} numbers, expected 2: (nx, ny)")
        counts = np.full(whole(n[1], "n", least=0), whole(n[0], "n", least=0))
    else:
        check_count(n, 9)
        wide, high = x1 - x0, y1 - y0
        # (wide / h + 1)(high / h + 1) = n
        gaps = (-(wide + high) + np.sqrt((wide - high) ** 2 + 4 * n * wide * high)) / 2
        rows = max(round(gaps / wide) + 1, 3)
        counts = np.diff(np.arange(rows + 1) * n // rows)
    fewest = counts.min(initial=MOST) if len(counts) else 0
    if len(counts) < 3 or fewest < 3:
        raise ValueError(f"{fewest} points in each of {len(counts)} rows, needs at least 3 in 3")
    row = np.repeat(np.arange(len(counts)), counts)
    within = np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)
    x = x0 + (x1 - x0) * within / (counts[row] - 1)
    y = y0 + (y1 - y0) * row / (len(counts) - 1)
    program = canonical(f, jnp.zeros((), dtype), jnp.zeros((), dtype))
    heights = block_by_block(partial(_height, program), dtype)(np.stack([x, y], axis=1))
    z, x_slope, y_slope = (np.asarray(a, float) for a in heights)
    bad = ~(np.isfinite(z) & np.isfinite(x_slope) & np.isfinite(y_slope))
    raise_at(bad, "f or its slope is not finite at (x, y) = {v}", np.stack([x, y], axis=1))
    normals = np.stack([-x_slope, -y_slope, np.ones(len(x))], axis=1)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    boundary = (row == 0) | (row == row[-1]) | (within == 0) | (within == counts[row] - 1)
    return sorted_cloud(np.stack([x, y, np.asarray(z)], axis=1), normals, boundary)


@eqx.filter_jit
def _curve(profile: Traced, s):
    """Points of a profile and its slopes."""

    def single(t):
        return jax.jvp(lambda v: jnp.stack(profile(v)), (t,), (jnp.ones_like(t),))

    return jax.vmap(single)(s)


@eqx.filter_jit
def _height(f: Traced, points):
    """Height of a graph and its slopes."""
    z, (x_slope, y_slope) = jax.vmap(jax.value_and_grad(f, argnums=(0, 1)))(*points.T)
    return z, x_slope, y_slope


def _interval(interval) -> tuple[float, float]:
    ends = on_host(interval, "interval")
    if ends.shape != (2,) or not np.isfinite(ends).all():
        raise ValueError(f"interval is {interval}, expected two finite numbers")
    if not ends[1] > ends[0]:
        raise ValueError(f"interval {interval} is empty")
    return float(ends[0]), float(ends[1])


def swept(profile: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """Points or vectors given by (radius, z) and an angle about the z axis."""
    radius, z = profile.T
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), z], axis=1)


def cumulative(values: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Running integral along the first axis by the trapezoidal rule."""
    gaps = np.diff(at).reshape((-1,) + (1,) * (values.ndim - 1))
    pieces = gaps * (values[1:] + values[:-1]) / 2
    return np.concatenate([np.zeros_like(values[:1]), np.cumsum(pieces, axis=0)])


def _shares(lengths: np.ndarray, n: int) -> np.ndarray:
    """n points shared among rings in proportion to their lengths, at least three to each."""
    if n < 3 * len(lengths):
        raise ValueError(f"n = {n} points, needs at least {3 * len(lengths)}: three on each ring")
    # Halves that are equal up to round-off are rounded the same way.
    shares = np.round(n * (lengths / lengths.sum()), 9)
    counts = np.maximum(np.rint(shares).astype(int), 3)
    # What rounding left over goes to the rings on which one point matters least.
    while (left := n - counts.sum()) != 0:
        most = np.argsort(-counts, kind="stable")[: abs(left)]
        counts[most] += np.sign(left)
    return counts


def sorted_cloud(
    points: np.ndarray, normals: np.ndarray, boundary: np.ndarray | None = None
) -> PointCloud:
    order = sort_points(points)
    return PointCloud(
        jnp.asarray(points[order]),
        jnp.asarray(normals[order]),
        boundary=None if boundary is None else jnp.asarray(boundary[order]),
    )


def check_count(n: int, least: int) -> None:
    if whole(n, "n", most=MOST) < least:
        raise ValueError(f"n = {n} points, needs at least {least}")
