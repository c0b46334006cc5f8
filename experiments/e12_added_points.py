r"""Points added on a sphere and a torus (3, 1), three placings (paper 002, Section 3.7.4).

The spacing is halved. The largest distance from the surface of what goes first into the holes (the
paper's is the mean, after all rounds): middles of circles in the plane of their corners, the same
moved along their mean normal (after eqs. 8 and 9), and on the local polynomial surface of degree 4.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

import jaxsurf as js
from jaxsurf.moving.holes import circumcenters, large_triangles

from .report import Row, slope

# Numbers of points before, those of the paper for its first three smoothing lengths.
_SIZES = {"sphere": (770, 3_520, 14_994), "torus": (7_380, 34_836, 147_112)}
_METHOD = js.GFDM(degree=4)


def _distance(surface: str, x) -> float:
    radius = np.linalg.norm(x, axis=1)
    if surface == "sphere":
        return float(np.abs(radius - 1).max())
    ring = np.hypot(x[:, 0], x[:, 1]) - 3
    return float(np.abs(np.hypot(ring, x[:, 2]) - 1).max())


def distances(surface: str, n: int) -> list[float]:
    """Of points that are placed plainly, corrected, and on the local polynomial surface."""
    cloud = js.sphere(n) if surface == "sphere" else js.torus(n, 3.0, 1.0)
    neighbors = js.find_neighbors(cloud, k=_METHOD.neighbor_count(3))
    area = 4 * np.pi if surface == "sphere" else 12 * np.pi**2
    half = np.full(cloud.n, 0.5 * np.sqrt(area / n))
    triangles, flat = large_triangles(cloud, neighbors, 0.9 * half)
    placed = [circumcenters(cloud, triangles, corrected=c) for c in (False, True)]
    found = js.discretize(cloud, neighbors, method=_METHOD).interpolate(cloud.points, flat)
    return [_distance(surface, np.asarray(x)) for x in (*placed, found)]


def run(quick: bool, out: Path) -> list[Row]:
    rows: list[Row] = []
    source = "paper 002, Section 3.7.4: half, and faster than h²"
    for surface, sizes in _SIZES.items():
        numbers = sizes[:2] if quick else sizes
        numbers = tuple(n // 4 for n in numbers) if quick and surface == "torus" else numbers
        errors = np.array([distances(surface, n) for n in numbers])
        for n, (plain, corrected, local) in zip(numbers, errors):
            setting = {"surface": surface, "n": n}
            rows.append(Row("largest distance, plain", plain, setting))
            rows.append(
                Row("largest distance, corrected", corrected, setting, None, source, plain / 2)
            )
            rows.append(Row("largest distance, polynomials", local, setting))
        setting = {"surface": surface, "n": f"{numbers[0]} to {numbers[-1]}"}
        spacing = np.array(numbers) ** -0.5
        for name, error, bound in zip(("plain", "corrected", "polynomials"), errors.T, (0, 0, 3)):
            order = slope(spacing, error)
            row = Row(f"order of {name}, at least", order, setting, None, source, bound, True)
            rows.append(row if bound else Row(f"order of {name}", order, setting))
    return rows
