r"""Which method suits one who does not choose: error, stability, time and heat on ten surfaces.

Smooth, coarse, noisy and random points, where $\Delta_S u$ is known exactly, and scans, where it is
not. The coarse surface of genus five is $\sum_i x_i^4 - 5 x_i^2 = -11.8$. Noise is a twentieth of
the spacing, in all directions, with normals estimated from the noisy points. Borders of scans are
held at rest, as every problem on them does by its conditions, and heat that flows out there is part
of the heat lost. Bounds are kept by the method that is proposed to all.
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from jaxtyping import Array, Float
from matplotlib.colors import LogNorm
from tqdm import tqdm

import jaxsurf as js
from jaxsurf.heat import Heat, diffuse, spot
from jaxsurf.heat import cell_areas as voronoi
from jaxsurf.normals import estimate_normals

from . import data, surfaces
from .report import Method, Row, method_name, relative_l2

PROPOSED: Method = js.GFDM(degree=4)
_METHODS: list[Method] = [
    *(js.DCPSE(order=r) for r in (2, 3, 4)),
    *(js.GFDM(degree=p) for p in (2, 3, 4, 5)),
    *(js.RBFFD(degree=p) for p in (2, 4)),
]
_QUICK: list[Method] = [js.DCPSE(order=2), js.GFDM(degree=2), js.GFDM(degree=4)]


class Case(NamedTuple):
    """Points, and where they are known a field on them with its Laplacian.

    `error`: what the proposed method may be off; `heat`: what it may lose of a hot spot.
    """

    name: str
    cloud: js.PointCloud
    field: tuple[Float[Array, " n"], Float[Array, " n"]] | None = None
    error: float | None = None
    heat: float | None = None


def genus_five(x):
    return jnp.sum(x**4 - 5 * x**2) + 11.8


def _coarse(n: int) -> Case:
    cloud = js.level_set(genus_five, n=n, bounds=((-3.0,) * 3, (3.0,) * 3))
    field = surfaces.exact(genus_five, 2.5, cloud)
    return Case("genus 5, coarse", cloud, field, 0.02 * (2_500 / n) ** 1.5, 0.01)


def _noisy(n: int) -> Case:
    surface = surfaces.torus()
    cloud = surface.cloud("Poisson disk", n)
    noise = np.random.default_rng(0).normal(size=cloud.points.shape)
    moved = cloud.points + 0.05 * surface.spacing(n) * jnp.asarray(noise)
    normals = estimate_normals(moved, degree=4)
    return Case("torus, noisy", js.PointCloud(moved, normals), surface.exact(cloud))


def _cases(quick: bool) -> Iterator[Case]:
    n = 600 if quick else 4_000
    sphere = surfaces.sphere()
    random = sphere.cloud("random", n)
    yield _coarse(2_500)
    yield Case("sphere, random", random, sphere.exact(random), 1e-3 * (4_000 / n) ** 1.5)
    if quick:
        return
    for surface in (sphere, surfaces.ellipsoid(), surfaces.torus()):
        cloud = surface.cloud("Poisson disk", n)
        yield Case(surface.name, cloud, surface.exact(cloud), 1e-3, 0.01)
    torus = surfaces.torus()
    cloud = torus.cloud("jittered", 400)
    yield Case("torus, coarse", cloud, torus.exact(cloud))
    yield _noisy(n)
    try:
        for m in (2_960, 10_000):
            yield Case(f"bunny, {m:,}", data.bunny(m), heat=0.01)
        yield Case("Armadillo, 10,000", data.armadillo(10_000), heat=0.01)
    except FileNotFoundError as error:
        print(f"without the scans: {error}")


def _seconds(run: Callable, times: int) -> float:
    """Of the fastest of several runs."""
    found = []
    for _ in range(times):
        start = time.perf_counter()
        jax.block_until_ready(run())
        found.append(time.perf_counter() - start)
    return min(found)


def _heat_lost(cloud: js.PointCloud, laplacian: js.Stencil, held, radius: float) -> float:
    """Share of a hot spot that is lost or made until it has spread over a tenth of the size."""
    areas = voronoi(cloud, js.find_neighbors(cloud, k=20, throw=False))
    points = np.asarray(cloud.points)
    size = np.ptp(points, axis=0).max()
    middle = int(np.argmin(np.linalg.norm(points - points.mean(axis=0), axis=1)))
    start = spot(cloud, middle, size / 8)  # what the coarse surfaces resolve
    closure, border = None, cloud.boundary
    if border is not None and border.any():
        closure = js.eliminate(cloud, js.dirichlet(border, jnp.zeros(int(border.sum()))))
    heat = Heat.within(float(size**2 / 100), held, radius)
    try:
        temperature = diffuse(laplacian, closure, start, heat)
    except js.IntegrationError:  # it grows
        return np.inf
    first, *_, last = np.asarray(temperature @ areas)
    return abs(float(last / first) - 1)


def _measured(case: Case, method: Method) -> dict[str, float]:
    build = lambda: js.laplace_beltrami(case.cloud, method=method)
    laplacian = build()
    border = laplacian.border
    held = laplacian if border is None else (1.0 - border) * laplacian
    spectrum = js.spectral_estimate(held)
    found = {}
    if case.field is not None:
        u, exact = case.field
        seen = laplacian(u)
        found["relative l2 error"] = relative_l2(seen, exact)
        found["largest error over largest value"] = float(
            jnp.abs(seen - exact).max() / jnp.abs(exact).max()
        )
    found["largest real part over spectral radius"] = spectrum.abscissa / spectrum.radius
    if found["largest real part over spectral radius"] < 1e-8:
        found["heat lost"] = _heat_lost(case.cloud, laplacian, held, spectrum.radius)
    one = jnp.ones(case.cloud.n)
    found["ms to build"] = 1e3 * _seconds(lambda: build().weights, 2)
    found["ms to apply"] = 1e3 * _seconds(lambda: laplacian(one), 5)
    assert laplacian.diagnostics is not None
    bent = np.asarray(laplacian.diagnostics.tube) > 1
    found["share of the points where the surface bends within one stencil"] = float(bent.mean())
    return found


def run(quick: bool, out: Path) -> list[Row]:
    methods = _QUICK if quick else _METHODS
    rows: list[Row] = []
    seen: dict[tuple[str, str], dict[str, float]] = {}
    for case in _cases(quick):
        bounds = {
            "relative l2 error": case.error,
            "heat lost": case.heat,
            "largest real part over spectral radius": 1e-8,
        }
        for method in tqdm(methods, desc=case.name):
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", UserWarning)  # it bends within one stencil
                found = _measured(case, method)
            name = method_name(method)
            seen[case.name, name] = found
            setting = {"surface": case.name, "method": name, "n": case.cloud.n}
            for quantity, value in found.items():
                bound = bounds.get(quantity) if method == PROPOSED else None
                rows.append(Row(quantity, value, setting, None, "project", bound))
    _picture(out / "choice.png", seen)
    return rows


def _picture(path: Path, seen: dict[tuple[str, str], dict[str, float]]) -> None:
    """Three tables by colour: methods in columns, surfaces in rows."""
    cases, methods = (list(dict.fromkeys(names)) for names in zip(*seen))
    panels = {
        "relative l2 error": (1e-4, 1.0),
        "largest real part over spectral radius": (1e-9, 1.0),
        "ms to build": (10.0, 1e4),
    }
    figure, axes = plt.subplots(
        1, 3, figsize=(3 + 1.5 * len(methods), 1.5 + 0.36 * len(cases)), layout="constrained"
    )
    for ax, (quantity, (low, high)) in zip(axes, panels.items()):
        values = np.array([[seen[c, m].get(quantity, np.nan) for m in methods] for c in cases])
        ax.imshow(np.clip(values, low, high), cmap="RdYlGn_r", norm=LogNorm(low, high),
                  aspect="auto")  # fmt: skip
        for (i, j), value in np.ndenumerate(values):
            text = "" if np.isnan(value) else "stable" if value < 1e-8 else f"{value:.2g}"
            ax.text(j, i, text, ha="center", va="center", fontsize=6)
        ax.set_xticks(range(len(methods)), methods, rotation=60, ha="right", fontsize=7)
        ax.set_yticks(range(len(cases)), cases if ax is axes[0] else [""] * len(cases), fontsize=7)
        ax.set_title(quantity, fontsize=8)
    figure.savefig(path, dpi=150)
    plt.close(figure)
