"""How far apart points are: the spacing that belongs to their number, and what is measured."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree

from jaxsurf.compiling import AnyArray

# Points are numbered in 32 bits.
MOST = 2**31 - 1


class Quality(NamedTuple):
    """How even a sampling is, in units of h (see `measure_quality`)."""

    spacing: float
    smallest: float
    mean: float
    hole: float | None


def ideal_spacing(measure: float, n: int, *, dim: int = 3) -> float:
    """h = (measure / n)^(1 / (d - 1)): the spacing of n points on a surface of that area.

    Example:
        >>> round(ideal_spacing(4 * np.pi, 10_000), 4)
        0.0354
    """
    return float((measure / n) ** (1 / (dim - 1)))


def points_at(spacing: float, measure: float, *, dim: int = 3) -> int:
    """How many points h apart a surface of that area holds.

    Raises:
        ValueError: more than can be numbered.

    Example:
        >>> points_at(0.1, 4 * np.pi)
        1257
    """
    with np.errstate(over="ignore", divide="ignore"):
        n = float(np.divide(measure, float(spacing) ** (dim - 1)))
    if not n <= MOST:
        raise ValueError(f"spacing = {spacing} gives n = {n:.3g} points, at most {MOST} fit")
    return round(n)


def measure_quality(
    points: Float[AnyArray, "n d"],
    *,
    measure: float,
    normals: Float[AnyArray, "n d"] | None = None,
    probes: Float[AnyArray, "q d"] | None = None,
) -> Quality:
    """Smallest and mean distance to the nearest neighbour, and the largest hole, over h.

    A hexagonal pattern has 1.07, 1.07 and 0.62.

    Args:
        points: `(n, d)`.
        measure: area of the surface (length of a curve).
        normals: `(n, d)`; if given, neighbours that face the opposite way do not count.
        probes: many points on the surface; the hole is the largest distance from a probe to its
            nearest point. None leaves it out.

    Example:
        >>> q = measure_quality(js.sphere(1_000).points, measure=4 * np.pi)
        >>> q.smallest > 0.85
        True
    """
    points = np.asarray(points, float)
    spacing = ideal_spacing(measure, len(points), dim=points.shape[1])
    tree = cKDTree(points)
    distance, near = tree.query(points, k=min(len(points), 2 if normals is None else 9))
    if normals is not None:
        normals = np.asarray(normals, float)
        distance = np.where(same_sheet(normals[:, None], normals[near]), distance, np.inf)
    nearest = distance[:, 1:].min(axis=1) / spacing
    hole = None if probes is None else float(tree.query(np.asarray(probes))[0].max() / spacing)
    return Quality(spacing, float(nearest.min()), float(nearest.mean()), hole)


def same_sheet(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.sum(a * b, axis=-1) > 0
