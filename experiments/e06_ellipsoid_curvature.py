r"""Mean and Gauss curvature of an ellipsoid (paper 001, Section 4.3, Figures 4a to 4c).

As printed, $\delta_n = 3/(N_p - 1)$ with $N_p$ the number of points gives supports that hold no
neighbour. The 32,258 points tell how it is meant: $126 \cdot 256 + 2$ is the grid of 128 values
of v (poles included, counted once) by 256 of u in the parameters (23), and with $N_p = 128$ the
layers are $3/127$ apart, like the points along a meridian ($0.75\ldots1 \cdot \pi/127$). So $N_p$
counts the points from pole to pole. The grid crowds at the poles; the same number of
quasi-uniform points with the same parameters is measured too.

Equation (24) agrees with differentiation to round-off; its H belongs to outward normals as
$+\tfrac12\nabla_S\cdot n$, while the text has a minus sign. The paper does not give the kernel's
width: here it is the mean spacing h. The smooth support that stands for $r_c$ is in `cutoff`.
"""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from tqdm import tqdm

import jaxsurf as js
from jaxsurf.plot import plot_fields

from . import surfaces
from .cutoff import smooth_support
from .pictures import convergence
from .report import Row, slope

_AXES = np.array([1.0, 0.8, 0.75])


def published_curvature(u, v):
    """Equation (24)."""
    a, b, c = _AXES
    s = np.sin(v) ** 2
    across = (b * np.cos(u)) ** 2 + (a * np.sin(u)) ** 2
    below = (a * b * np.cos(v)) ** 2 + c**2 * across * s
    bracket = 3 * (a**2 + b**2) + 2 * c**2 + (a**2 + b**2 - 2 * c**2) * np.cos(2 * v)
    mean = a * b * c * (bracket - 2 * (a**2 - b**2) * np.cos(2 * u) * s) / (8 * below**1.5)
    return mean, (a * b * c) ** 2 / below**2


def parameter_grid(rows: int) -> tuple[np.ndarray, np.ndarray]:
    """u and v of the points, row by row from pole to pole; both poles once."""
    v = np.pi * np.arange(1, rows - 1) / (rows - 1)
    u = np.pi * np.arange(2 * rows) / rows
    inner = np.repeat(v, len(u))
    return np.r_[0, np.tile(u, len(v)), 0], np.r_[0, inner, np.pi]


def grid_cloud(u, v) -> js.PointCloud:
    """Points (23) with exact normals."""
    direction = np.stack([np.cos(u) * np.sin(v), np.sin(u) * np.sin(v), np.cos(v)], axis=1)
    normals = direction / _AXES
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return js.PointCloud(jnp.asarray(direction * _AXES), jnp.asarray(normals))


def curvatures(cloud: js.PointCloud, rows: int, spacing: float):
    """Mean and Gauss curvature with the paper's parameters."""
    layer_spacing = 3 / (rows - 1)
    support = smooth_support(2.9 * layer_spacing)
    neighbors = js.find_neighbors(cloud, radius=support)
    method = js.DCPSE(order=2, layers=2, layer_spacing=layer_spacing, width=spacing / support)
    return (
        np.asarray(js.mean_curvature(cloud, neighbors, method=method)),
        np.asarray(js.gauss_curvature(cloud, neighbors, method=method)),
    )


def grid_curvatures(cloud: js.PointCloud, rows: int, spacing: float):
    """The same on the grid, belt by belt: its neighbourhoods hold many more points at the poles.

    Each belt of rows is computed with a margin wider than the support on either side.
    """
    row = np.r_[0, np.repeat(np.arange(1, rows - 1), 2 * rows), rows - 1]
    half = np.unique(np.minimum([0, 4, 8, 16, 32], rows // 2))
    edges = np.unique(np.r_[half, rows - half])
    margin = 7
    mean, gauss = np.empty(cloud.n), np.empty(cloud.n)
    for low, high in itertools.pairwise(edges):
        around = np.flatnonzero((row >= low - margin) & (row < high + margin))
        belt = js.PointCloud(cloud.points[around], cloud.normals[around])
        own = (row[around] >= low) & (row[around] < high)
        values = curvatures(belt, rows, spacing)
        mean[around[own]], gauss[around[own]] = (value[own] for value in values)
    return mean, gauss


def run(quick: bool, out: Path) -> list[Row]:
    sizes = [16, 32] if quick else [32, 64, 128]
    ellipsoid = surfaces.ellipsoid(tuple(_AXES.tolist()))
    source = "paper 001, Fig. 4"
    rows: list[Row] = []
    spacings: list[float] = []
    errors: dict[tuple[str, str, str], list[float]] = {}
    progress = tqdm(total=len(sizes), desc="E6")
    for size in sizes:
        u, v = parameter_grid(size)
        grid = grid_cloud(u, v)
        h = ellipsoid.spacing(grid.n)
        spacings.append(h)
        even = ellipsoid.regular(grid.n)
        exact_even = tuple(map(np.asarray, js.level_set_curvature(ellipsoid.phi, even.points)))
        exact_grid = published_curvature(u, v)
        cases = {
            "quasi-uniform": (even, exact_even, curvatures(even, size, h)),
        }
        if not quick:  # every belt of the grid is compiled by itself
            cases = {"(u, v) grid": (grid, exact_grid, grid_curvatures(grid, size, h))} | cases
        progress.update()
        for kind, (_, exact, found) in cases.items():
            for name, value, right in zip(("mean", "Gauss"), found, exact):
                error = np.abs(value - right)
                errors.setdefault((kind, name, "maximum"), []).append(error.max())
                rms = np.sqrt(np.mean(error**2))
                errors.setdefault((kind, name, "root mean square"), []).append(rms)
    progress.close()
    counts = f"{(sizes[0] - 2) * 2 * sizes[0] + 2} to {grid.n}"
    for (kind, name, norm), values in errors.items():
        quantity = f"order of the {norm} error of the {name} curvature, at least"
        setting: dict[str, Any] = {"points": kind, "n": counts}
        row = Row(quantity, slope(spacings, values), setting, 2.0, source, 1.8, at_least=True)
        rows.append(row)
    for kind, (_, exact, found) in cases.items():
        for name, value, right in zip(("mean", "Gauss"), found, exact):
            relative = np.abs(value / right - 1)
            setting = {"points": kind, "n": grid.n}
            # The Gauss curvature is a product: the relative errors of two curvatures add up.
            # The published range is that of 32,258 points, 128 from pole to pole: h^2 for fewer.
            bound = {"mean": 1e-3, "Gauss": 2e-3}[name] * (127 / (sizes[-1] - 1)) ** 2
            quantity = f"largest relative error of the {name} curvature"
            rows.append(Row(quantity, float(relative.max()), setting, 1e-3, source, bound))
            quantity = f"median relative error of the {name} curvature"
            rows.append(Row(quantity, float(np.median(relative)), setting, None, source))
            quantity = f"smallest relative error of the {name} curvature"
            rows.append(Row(quantity, float(relative.min()), setting, 1e-7, source))
    checked = np.max([np.abs(a - b).max() for a, b in zip(
        exact_grid, map(np.asarray, js.level_set_curvature(ellipsoid.phi, grid.points))
    )])  # fmt: skip
    quantity = "largest difference between eq. (24) and curvature by differentiation"
    rows.append(Row(quantity, float(checked), {"n": grid.n}, 0.0, "paper 001, eq. (24)", 1e-12))

    named = {f"{name} curvature, {norm}": values for (kind, name, norm), values in errors.items()
             if kind == "quasi-uniform"}  # fmt: skip
    title = "Ellipsoid, quasi-uniform points, DC-PSE of order 2"
    convergence(out / "E6.png", spacings, named, orders=[2], title=title)
    cloud, exact, found = cases["quasi-uniform"]
    fields = {"mean curvature": found[0], "Gauss curvature": found[1]}
    for name, value, right in zip(("mean", "Gauss"), found, exact):
        fields[f"log10 of relative error, {name}"] = np.log10(np.abs(value / right - 1) + 1e-16)
    as_jax = {name: jnp.asarray(value) for name, value in fields.items()}
    plt.close(plot_fields(cloud, as_jax, path=out / "E6-fields.png", columns=2))
    return rows
