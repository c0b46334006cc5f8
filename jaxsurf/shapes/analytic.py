"""Curves and surfaces in closed form, with exact outward normals, on quasi-uniform points."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxsurf.arguments import differentiable, in_range, is_concrete, on_host, raise_at, real, whole
from jaxsurf.cloud import PointCloud
from jaxsurf.compiling import block_by_block
from jaxsurf.functions import Traced, canonical
from jaxsurf.shapes.order import sort_points
from jaxsurf.shapes.sampling import Project, relax
from jaxsurf.shapes.spacing import MOST, ideal_spacing

# Successive angles at this distance never line up, whatever their number.
_GOLDEN_ANGLE = np.pi * (3 - np.sqrt(5))
# Parameter values at which arc lengths and areas are tabulated.
_TABLE = 4_097


def circle(n: int, *, radius: float = 1.0) -> PointCloud:
    """n equispaced points on a circle in the plane, in the order of their angle.

    Args:
        n: number of points, at least 3; the first is (radius, 0).
        radius: in units of length.

    Example:
        >>> js.circle(4).points.round(12).tolist()
        [[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [-0.0, -1.0]]
    """
    _check_count(n, 3)
    _check_positive("radius", radius)
    angle = 2 * np.pi * np.arange(n) / n
    normals = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return PointCloud(jnp.asarray(radius * normals), jnp.asarray(normals))


def sphere(n: int, *, radius: float = 1.0) -> PointCloud:
    r"""n points of the Fibonacci lattice on a sphere.

    $z_i = 1 - (2i+1)/n$ at angles that advance by the golden angle, then sorted along a
    space-filling curve.

    Args:
        n: number of points, at least 4.
        radius: in units of length.

    Accuracy: smallest distance 0.87 h, h = sqrt(area / n).
    Raises:
        ValueError: n below 4, or a radius that is not positive.

    Example:
        >>> cloud = js.sphere(1_000)
        >>> bool(jnp.allclose(jnp.linalg.norm(cloud.points, axis=1), 1))
        True
    """
    _check_count(n, 4)
    _check_positive("radius", radius)
    normals = _fibonacci(n)
    return _sorted_cloud(radius * normals, normals)


def ellipsoid(n: int, axes: tuple[float, float, float], *, steps: int = 30) -> PointCloud:
    r"""n quasi-uniform points on the ellipsoid $x^2/a^2 + y^2/b^2 + z^2/c^2 = 1$.

    The Fibonacci lattice is carried over by a map that preserves area, then relaxed with
    projection to the closest point.

    Args:
        n: number of points, at least 4.
        axes: semi-axes (a, b, c) in units of length.
        steps: of relaxation; 0 keeps the lattice.

    Accuracy: smallest distance above 0.75 h for ratios of axes up to 4
        (`tests/test_shapes.py::test_analytic_points_are_even`); 0.92 h at axes (1, 0.8, 0.75).
    Raises:
        ValueError: n below 4, or axes that are not three positive numbers.

    Example:
        >>> cloud = js.ellipsoid(500, (1.0, 0.8, 0.75))
        >>> level = jnp.sum((cloud.points / jnp.array([1.0, 0.8, 0.75])) ** 2, axis=1)
        >>> bool(jnp.allclose(level, 1))
        True
    """
    _check_count(n, 4)
    semi = _checked_axes(axes)
    whole(steps, "steps", least=0)
    sphere_points, area = _equal_area_ellipsoid(n, semi)
    points, normals = relax(
        sphere_points * semi,
        ellipsoid_projection(axes),
        spacing=ideal_spacing(area, n),
        steps=steps,
    )
    return _sorted_cloud(points, normals)


def torus(n: int, R: float, r: float) -> PointCloud:
    r"""n quasi-uniform points on the torus $(R - \sqrt{x^2+y^2})^2 + z^2 = r^2$.

    Rings h apart around the axis, with numbers of points in proportion to their lengths.

    Args:
        n: number of points, at least 12.
        R: radius of the centre line, in units of length.
        r: radius of the tube, less than R.

    Accuracy: smallest distance above 0.85 h, holes below 0.75 h
        (`tests/test_shapes.py::test_analytic_points_are_even`).
    Raises:
        ValueError: n below 12, radii that are not positive, or r not less than R.

    Example:
        >>> js.torus(1_000, 3.0, 1.0).n
        1000
    """
    _check_count(n, 12)
    _check_positive("r", r)
    _check_positive("R", R)
    if not r < R:
        raise ValueError(f"tube radius r = {r} must be less than R = {R}")
    # Arrays, not constants of the program: other radii run what is compiled.
    centre, tube = jnp.asarray(float(R)), jnp.asarray(float(r))
    return surface_of_revolution(
        lambda s: (centre + tube * jnp.cos(s), tube * jnp.sin(s)), n, interval=(0.0, 2 * np.pi)
    )


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
    _check_count(n, 12)
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

    length = _cumulative(speed, table)
    area = _cumulative(2 * np.pi * radius * speed, table)[-1]
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
    angle = 2 * np.pi * within / counts[row] + _GOLDEN_ANGLE * row
    out = np.stack([slope[:, 1], -slope[:, 0]], axis=1)
    out /= np.linalg.norm(out, axis=1, keepdims=True)
    closed = not border.any()
    if closed and _cumulative(radius**2 * tangent[:, 1], table)[-1] < 0:
        out = -out
    boundary = (border[0] & (row == 0)) | (border[1] & (row == rings - 1))
    return _sorted_cloud(
        _swept(ring[row], angle), _swept(out[row], angle), None if closed else boundary
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
    box = in_range(on_host(bounds, "bounds"), "bounds")
    if box.shape != (2, 2):
        raise ValueError(f"bounds must be two corners in the plane, shape (2, 2), not {box.shape}")
    (x0, y0), (x1, y1) = box
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
        _check_count(n, 9)
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
    return _sorted_cloud(np.stack([x, y, np.asarray(z)], axis=1), normals, boundary)


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


def sphere_projection(radius: float = 1.0) -> Project:
    """Closest point on a circle or sphere about the origin, for `jitter` and `relax`.

    Example:
        >>> sphere_projection(2.0)(np.array([[0.0, 0.0, 3.0]]))[0].tolist()
        [[0.0, 0.0, 2.0]]
    """

    def project(points):
        normals = points / np.linalg.norm(points, axis=1, keepdims=True)
        return radius * normals, normals

    return project


def ellipsoid_projection(axes: tuple[float, float, float]) -> Project:
    r"""Closest point on an ellipsoid, for `jitter` and `relax`.

    $x_i = a_i^2 y_i/(t + a_i^2)$ with t the largest root of
    $\sum_i (a_i y_i/(t + a_i^2))^2 = 1$; Newton's method from a lower bound of t climbs to it.

    Example:
        >>> ellipsoid_projection((1.0, 2.0, 3.0))(np.array([[0.0, 0.0, 4.0]]))[0].tolist()
        [[0.0, 0.0, 3.0]]
    """
    semi = _checked_axes(axes)
    square = semi**2

    def project(points):
        scaled = semi * np.abs(points)
        t = (scaled - square).max(axis=1, keepdims=True)
        for _ in range(60):
            term = (scaled / (t + square)) ** 2
            excess = term.sum(axis=1, keepdims=True) - 1
            step = excess / (2 * (term / (t + square)).sum(axis=1, keepdims=True))
            t = t + step
            if np.abs(step).max() <= 1e-15 * square.max():
                break
        onto = points * square / (t + square)
        normals = onto / square
        return onto, normals / np.linalg.norm(normals, axis=1, keepdims=True)

    return project


def torus_projection(R: float, r: float) -> Project:
    """Closest point on a torus about the z axis, for `jitter` and `relax`.

    Example:
        >>> torus_projection(3.0, 1.0)(np.array([[5.0, 0.0, 0.0]]))[0].tolist()
        [[4.0, 0.0, 0.0]]
    """

    def project(points):
        points = np.asarray(points)
        flat = points * np.array([1.0, 1.0, 0.0])
        centre = R * flat / np.linalg.norm(flat, axis=1, keepdims=True)
        normals = points - centre
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        return centre + r * normals, normals

    return project


def _fibonacci(n: int) -> np.ndarray:
    z = 1 - (2 * np.arange(n) + 1) / n
    angle = _GOLDEN_ANGLE * np.arange(n)
    return _swept(np.stack([np.sqrt(1 - z * z), z], axis=1), angle)


def _swept(profile: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """Points or vectors given by (radius, z) and an angle about the z axis."""
    radius, z = profile.T
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), z], axis=1)


def _equal_area_ellipsoid(n: int, semi: np.ndarray) -> tuple[np.ndarray, float]:
    """Points on the unit sphere that stretching by `semi` makes uniform on the ellipsoid; area.

    The ellipsoid's area is J dz dφ, J = abc |(x/a, y/b, z/c)| at the point (x, y, z) of the
    sphere. The lattice's first coordinate is spread by the area below z, its second by the share
    of the ring at z.
    """
    # About the axis across which the ellipsoid is roundest, to shear the lattice least.
    # (Ratios that are equal up to round-off are a tie.)
    ratios = [abs(np.log(np.divide(*np.delete(semi, axis)))).round(9) for axis in range(3)]
    turn = (int(np.argmin(ratios)) + 1 + np.arange(3)) % 3
    a, b, c = semi[turn]
    z = np.linspace(-1, 1, 1_025)
    angle = np.linspace(0, 2 * np.pi, 721)
    across = (np.cos(angle) / a) ** 2 + (np.sin(angle) / b) ** 2
    density = a * b * c * np.sqrt((1 - z[:, None] ** 2) * across + (z[:, None] / c) ** 2)
    below = _cumulative(_cumulative(density.T, angle)[-1], z)
    area = float(below[-1])

    height = np.interp((np.arange(n) + 0.5) / n * area, below, z)
    turns = (np.arange(n) * (3 - np.sqrt(5)) / 2) % 1
    share = _cumulative(density.T, angle)
    share /= share[-1]
    # Inverse of each ring's share, as a table over (height, share of a turn).
    even = np.linspace(0, 1, 721)
    inverse = np.stack([np.interp(even, column, angle) for column in share.T])
    row = np.clip(((height + 1) / 2 * (len(z) - 1)).astype(int), 0, len(z) - 2)
    column = np.clip((turns * (len(even) - 1)).astype(int), 0, len(even) - 2)
    u = (height - z[row]) / (z[row + 1] - z[row])
    v = turns * (len(even) - 1) - column
    phi = (1 - u) * ((1 - v) * inverse[row, column] + v * inverse[row, column + 1]) + u * (
        (1 - v) * inverse[row + 1, column] + v * inverse[row + 1, column + 1]
    )
    turned = _swept(np.stack([np.sqrt(1 - height**2), height], axis=1), phi)
    return turned[:, np.argsort(turn)], area


def _cumulative(values: np.ndarray, at: np.ndarray) -> np.ndarray:
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


def _sorted_cloud(
    points: np.ndarray, normals: np.ndarray, boundary: np.ndarray | None = None
) -> PointCloud:
    order = sort_points(points)
    return PointCloud(
        jnp.asarray(points[order]),
        jnp.asarray(normals[order]),
        boundary=None if boundary is None else jnp.asarray(boundary[order]),
    )


def _check_count(n: int, least: int) -> None:
    if whole(n, "n", most=MOST) < least:
        raise ValueError(f"n = {n} points, needs at least {least}")


def _check_positive(name: str, value: Any) -> None:
    real(value, name, above=0)
    if not is_concrete(value):
        raise TypeError(f"{name} must be concrete: points are chosen outside jit and grad")
    in_range(value, name)


def _checked_axes(axes: tuple[float, float, float]) -> np.ndarray:
    semi = on_host(axes, "axes")
    if semi.shape != (3,):
        raise ValueError(f"axes must be three numbers, not shape {semi.shape}")
    raise_at(~(np.isfinite(semi) & (semi > 0)), "axis {i} is {v}, expected a positive number", semi)
    in_range(semi, "axes")
    return semi
