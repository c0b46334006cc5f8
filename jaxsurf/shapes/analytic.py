"""Curves and surfaces in closed form, with exact outward normals, on quasi-uniform points."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxsurf.arguments import in_range, on_host, real, whole
from jaxsurf.cloud import PointCloud
from jaxsurf.failures import needs_values, not_positive, raise_at
from jaxsurf.shapes.parametric import (
    GOLDEN_ANGLE,
    check_count,
    cumulative,
    sorted_cloud,
    surface_of_revolution,
    swept,
)
from jaxsurf.shapes.sampling import Project, relax
from jaxsurf.shapes.spacing import ideal_spacing

Axes = tuple[float, float, float] | Float[Array, " 3"]


def circle(n: int, *, radius: float = 1.0) -> PointCloud:
    """n equispaced points on a circle in the plane, in the order of their angle.

    Args:
        n: number of points, at least 3; the first is (radius, 0).
        radius: in units of length.

    Example:
        >>> js.circle(4).points.round(12).tolist()
        [[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [-0.0, -1.0]]
    """
    check_count(n, 3)
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
    check_count(n, 4)
    _check_positive("radius", radius)
    normals = _fibonacci(n)
    return sorted_cloud(radius * normals, normals)


def ellipsoid(n: int, axes: Axes, *, steps: int = 30) -> PointCloud:
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
    check_count(n, 4)
    semi = _checked_axes(axes)
    whole(steps, "steps", least=0)
    sphere_points, area = _equal_area_ellipsoid(n, semi)
    points, normals = relax(
        sphere_points * semi,
        ellipsoid_projection(axes),
        spacing=ideal_spacing(area, n),
        steps=steps,
    )
    return sorted_cloud(points, normals)


def torus(n: int, R: float, r: float) -> PointCloud:
    r"""n quasi-uniform points on the torus $(R - \sqrt{x^2+y^2})^2 + z^2 = r^2$.

    Rings h apart around the axis, with numbers of points in proportion to their lengths.

    Args:
        n: number of points, at least 12.
        R: radius of the centre line, in units of length.
        r: radius of the tube, less than R.

    Accuracy: smallest distance above 0.85 h, holes below 0.75 h
        (`tests/test_shapes.py::test_analytic_points_are_even`). In float32 within 1e-5 of the
        surface for radii 3 and 1 (`tests/test_shapes.py`).
    Raises:
        ValueError: n below 12, radii that are not positive, or r not less than R.

    Example:
        >>> js.torus(1_000, 3.0, 1.0).n
        1000
    """
    check_count(n, 12)
    _check_positive("r", r)
    _check_positive("R", R)
    if not r < R:
        raise ValueError(f"tube radius r = {r} must be less than R = {R}")
    # Arrays, not constants of the program: other radii run what is compiled.
    centre, tube = jnp.asarray(float(R)), jnp.asarray(float(r))
    return surface_of_revolution(
        lambda s: (centre + tube * jnp.cos(s), tube * jnp.sin(s)), n, interval=(0.0, 2 * np.pi)
    )


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


def ellipsoid_projection(axes: Axes) -> Project:
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
    angle = GOLDEN_ANGLE * np.arange(n)
    return swept(np.stack([np.sqrt(1 - z * z), z], axis=1), angle)


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
    below = cumulative(cumulative(density.T, angle)[-1], z)
    area = float(below[-1])

    height = np.interp((np.arange(n) + 0.5) / n * area, below, z)
    turns = (np.arange(n) * (3 - np.sqrt(5)) / 2) % 1
    share = cumulative(density.T, angle)
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
    points = swept(np.stack([np.sqrt(1 - height**2), height], axis=1), phi)
    return points[:, np.argsort(turn)], area


def _check_positive(name: str, value: Any) -> None:
    real(value, name, above=0)
    needs_values(name, value, instead="points are chosen outside jit and grad")
    in_range(value, name)


def _checked_axes(axes: Axes) -> np.ndarray:
    semi = on_host(axes, "axes", (3,))
    raise_at(not_positive(semi), "axis {i} is {v}, expected a positive number", semi)
    in_range(semi, "axes")
    return semi
