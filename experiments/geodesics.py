r"""Distances by the heat method: exact ones on the sphere, bands on the bunny.

`js.geodesic_distance` (after Crane, Weischedel and Wardetzky 2013) against great circles: from one
source, from several, whose fronts meet, and from a cap of sources. The reference is what
potpourri3d makes of the same 10,000 points from one source. On the bunny there is no exact
distance; shortest paths over edges to many neighbours come close.
"""

from __future__ import annotations

import time
from pathlib import Path

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.colors import ListedColormap
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import cKDTree
from tqdm import tqdm

import jaxsurf as js

from . import data
from .report import Row, relative_l2, slope

_PEER = 1.4e-2
_BOUND = 1e-2
_N = 10_000


def great_circles(points, sources) -> np.ndarray:
    """Angle to the nearest source, from chords, which lose no digits where they are short."""
    chords = np.linalg.norm(points[:, None] - points[sources], axis=2)
    return 2 * np.arcsin(np.clip(chords / 2, 0, 1)).min(axis=1)


def run(quick: bool, out: Path) -> list[Row]:
    figure, axes = plt.subplots(1, 3, figsize=(14, 4.4), layout="constrained")
    rows = _sphere(quick, axes[0])
    rows += _bunny(3_000 if quick else None, axes[1:])
    figure.savefig(out / "geodesics.png", dpi=150)
    plt.close(figure)
    return rows


def _sphere(quick: bool, ax) -> list[Row]:
    jobs: list[tuple[int, str, np.ndarray]] = []
    sizes = [3_000] if quick else [2_500, _N, 40_000]
    judged = sizes[0] if quick else _N
    for n in sizes:
        scattered = np.random.default_rng(0).choice(n, 5, replace=False)
        jobs += [(n, "1 source", np.array([n // 8])), (n, "5 sources", scattered)]
    if not quick:
        height = np.asarray(js.sphere(_N).points) @ [0.36, 0.48, 0.8]
        jobs.append((_N, "a cap", np.flatnonzero(height > np.cos(0.5))))
    rows: list[Row] = []
    errors: dict[str, list[float]] = {}
    for n, name, sources in tqdm(jobs, desc="geodesics, sphere"):
        cloud = js.sphere(n)
        clock = time.perf_counter()
        distance = np.asarray(js.geodesic_distance(cloud, sources))
        seconds = time.perf_counter() - clock
        exact = great_circles(np.asarray(cloud.points), sources)
        error = relative_l2(distance, exact)
        errors.setdefault(name, []).append(error)
        setting = {"surface": "sphere", "n": n, "from": name}
        peer = _PEER if (n, name) == (_N, "1 source") else None
        rows += [
            Row("relative l2 error", error, setting, peer, "potpourri3d" if peer else "project",
                # From several sources the error is of the order of h.
                _BOUND * (_N / n) ** 0.5 if n == judged else None),
            Row("largest error", float(np.abs(distance - exact).max()), setting),
            Row("seconds, compilation included", seconds, setting),
        ]  # fmt: skip
        if (n, name) == (judged, "5 sources"):
            _draw(ax, cloud, distance, "sphere, 5 sources", view=(1.0, -1.7, 0.9))
    if not quick:
        setting = {"surface": "sphere", "n": f"{sizes[0]} to {sizes[-1]}", "from": "5 sources"}
        # The distance is rounded off over a width h where fronts meet. From one source they meet
        # in a point only, and what is left is small but does not fall: heat for a time of the
        # size of h^2 is not resolved, whatever h.
        observed = slope(np.array(sizes) ** -0.5, errors["5 sources"])
        rows.append(Row("order of the relative l2 error, at least", observed, setting, None,
                        "width of the fronts", 0.8, True))  # fmt: skip
    return rows


def _bunny(n: int | None, axes) -> list[Row]:
    r"""From the nose, against shortest paths over many neighbours; $|\nabla_S d| = 1$."""
    cloud = data.bunny(n)
    source = int(np.argmin(np.asarray(cloud.points)[:, 0]))
    clock = time.perf_counter()
    distance = js.geodesic_distance(cloud, np.array([source]))
    seconds = time.perf_counter() - clock
    slopes = np.linalg.norm(js.surface_gradient(cloud, throw=False)(distance), axis=1)
    distance, paths = np.asarray(distance), shortest_paths(cloud, source)
    for ax, view in zip(axes, [(-0.4, 0.3, 1.0), (-0.5, 0.4, -1.0)]):
        _draw(ax, cloud, distance, f"bunny, {cloud.n:,} points", view=view, up=(0.0, 1.0, 0.0))
    setting = {"surface": "bunny", "n": cloud.n}
    # The fur bends by some tenths of a radian from neighbour to neighbour, the square of which
    # is what arcs between neighbours are wrong by.
    return [
        Row("relative l2 difference from shortest paths", relative_l2(distance, paths), setting,
            None, "project", 5e-2),
        Row("median of | |grad d| - 1 |", float(np.median(np.abs(slopes - 1))), setting, 0.0,
            "eikonal equation", 5e-2),
        Row("seconds, compilation included", seconds, setting),
    ]  # fmt: skip


def shortest_paths(cloud: js.PointCloud, source: int, k: int = 60) -> np.ndarray:
    """Dijkstra's algorithm over arcs to neighbours whose normals do not point apart.

    On the sphere with 10,000 points paths over 60 neighbours are too long by 1e-3.
    """
    x, normals = np.asarray(cloud.points), np.asarray(cloud.normals)
    chord, j = (a[:, 1:] for a in cKDTree(x).query(x, k=k + 1))
    i = np.broadcast_to(np.arange(cloud.n)[:, None], j.shape)
    same_side = np.sum(normals[i] * normals[j], axis=2) > 0.5
    sine = np.sum((normals[j] - normals[i]) * (x[j] - x[i]), axis=2) / (2 * chord)
    arc = chord / np.sinc(np.arcsin(np.clip(sine, -0.9, 0.9)) / np.pi)
    graph = csr_array((arc[same_side], (i[same_side], j[same_side])), shape=(cloud.n, cloud.n))
    return dijkstra(graph, indices=source)


def _draw(ax, cloud, distance, title, **camera) -> None:
    name = "distance bands"
    mpl.colormaps.register(_bands(), name=name, force=True)
    js.plot_cloud(cloud, distance, ax=ax, title=title, cmap=name, label="distance", **camera)


def _bands(count: int = 24, width: int = 16) -> ListedColormap:
    """Bands of one colour each with a dark line between them: isolines without a mesh."""
    colors = np.repeat(mpl.colormaps["viridis"](np.linspace(0.05, 1, count)), width, axis=0)
    line = np.arange(count * width) % width >= width - 2
    colors[line, :3] *= 0.3
    return ListedColormap(colors)
