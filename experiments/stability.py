"""Spectra of the default Laplacians: an eigenvalue to the right makes every diffusion blow up."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import scipy.linalg
from tqdm import tqdm

import jaxsurf as js

from . import data, surfaces
from .report import Method, Row, method_name

_METHODS: list[Method] = [
    js.DCPSE(order=2),
    js.DCPSE(order=4),
    js.GFDM(degree=2),
    js.GFDM(degree=4),
    js.RBFFD(degree=2),
    js.RBFFD(degree=4),
]


_QUICK: list[Method] = [js.DCPSE(order=2), js.GFDM(degree=4), js.RBFFD(degree=4)]


def clouds(n: int) -> Iterator[tuple[str, js.PointCloud]]:
    """Everything from lattices to points that no one would choose."""
    sphere, ellipsoid, torus = surfaces.sphere(), surfaces.ellipsoid(), surfaces.torus()
    for kind in ("regular", "jittered", "Poisson disk", "random"):
        yield f"sphere, {kind}", sphere.cloud(kind, n)
    for surface in (ellipsoid, torus):
        for kind in ("regular", "Poisson disk"):
            yield f"{surface.name}, {kind}", surface.cloud(kind, n)


def run(quick: bool, out: Path) -> list[Row]:
    cases = list(clouds(600 if quick else 2_000))
    if quick:
        cases = cases[2::2]
    methods = _QUICK if quick else _METHODS
    if not quick:
        try:
            cases.append(("bunny, resampled", data.bunny(2_960)))
        except FileNotFoundError as error:
            print(f"without the bunny: {error}")
    rows: list[Row] = []
    spectra: dict[tuple[str, Method], np.ndarray] = {}
    for (name, cloud), method in tqdm([(c, m) for c in cases for m in methods], desc="stability"):
        laplacian = js.laplace_beltrami(cloud, method=method)
        values = scipy.linalg.eigvals(laplacian.to_scipy().toarray())
        spectra[name, method] = values
        radius, right = float(np.abs(values).max()), float(values.real.max())
        setting = {"points": name, "method": method_name(method), "n": cloud.n}
        source = "project"
        rows.append(Row("largest real part over spectral radius", right / radius, setting, None,
                        source, 1e-8))  # fmt: skip
        rows.append(Row("spectral radius times h^2", radius * _spacing2(cloud), setting))
    _picture(out / "stability.png", spectra, cases, methods)
    return rows


def _spacing2(cloud: js.PointCloud) -> float:
    """h² such that a disc that holds k points has area k h², by the median over the points."""
    k = 20
    neighbors = js.find_neighbors(cloud, k=k, throw=False)
    offsets = cloud.points[neighbors.indices] - cloud.points[:, None]
    reach2 = jnp.max(jnp.where(neighbors.mask, jnp.sum(offsets**2, axis=2), 0), axis=1)
    return float(jnp.median(np.pi * reach2 / (k - 0.5)))


def _picture(path: Path, spectra, cases, methods) -> None:
    figure, axes = plt.subplots(
        len(cases),
        len(methods),
        figsize=(2.75 * len(methods), 1.7 * len(cases)),
        layout="constrained",
    )
    for line, (name, _) in zip(axes, cases):
        for ax, method in zip(line, methods):
            values = spectra[name, method]
            ax.axvline(0, color="0.6", linewidth=0.8)
            ax.plot(values.real, values.imag, ".", markersize=2)
            ax.tick_params(labelsize=6)
            ax.locator_params(axis="x", nbins=4)
            ax.set_title(f"{name}, {method_name(method)}", fontsize=7)
    figure.supxlabel("real part", fontsize=9)
    figure.supylabel("imaginary part", fontsize=9)
    figure.savefig(path, dpi=120)
    plt.close(figure)
