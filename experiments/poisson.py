"""Manufactured Poisson problems on closed surfaces: errors, orders, Krylov steps."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from tqdm import tqdm

import jaxsurf as js

from . import data, surfaces
from .pictures import convergence
from .report import Method, Row, method_name, relative_l2, slope

_METHODS: dict[Method, int] = {
    js.DCPSE(order=2): 2,
    js.DCPSE(order=4): 4,
    js.GFDM(degree=3): 2,
    js.GFDM(degree=5): 4,
    js.RBFFD(degree=5): 4,
}


def _shapes():
    """Name, maker of n points, level set function and size."""
    ellipsoid, torus = surfaces.ellipsoid(), surfaces.torus()
    phi, bounds = js.double_torus()
    genus_two = lambda n: js.level_set(phi, n=n, bounds=bounds)
    return [
        ("ellipsoid", ellipsoid.regular, ellipsoid.phi, ellipsoid.size),
        ("torus", torus.regular, torus.phi, torus.size),
        ("genus 2", genus_two, phi, 2.5),
    ]


def run(quick: bool, out: Path) -> list[Row]:
    sizes = [2_000, 4_000] if quick else [4_000, 8_000, 16_000, 32_000]
    methods: list[Method] = [js.DCPSE(order=4)] if quick else [*_METHODS]
    rows: list[Row] = []
    shapes = _shapes()[:2] if quick else _shapes()
    progress = tqdm(total=len(shapes) * len(sizes) * len(methods), desc="poisson")
    for name, make, phi, size in shapes:
        errors: dict[Method, list[float]] = {method: [] for method in methods}
        for n in sizes:
            cloud = make(n)
            u, f = surfaces.exact(phi, size, cloud)
            for method, values in errors.items():
                laplacian = js.laplace_beltrami(cloud, method=method)
                found = js.solve(laplacian, f, rtol=1e-10)
                values.append(relative_l2(found.value, u - u.mean()))
                setting = {"surface": name, "method": method_name(method), "n": n}
                steps = float(found.stats["num_steps"])
                rows.append(Row("relative l2 error", values[-1], setting, None, "project"))
                rows.append(Row("Krylov steps", steps, setting, None, "project"))
                progress.update()
        spacings = [n**-0.5 for n in sizes]
        for method, values in errors.items():
            order = _METHODS[method]
            setting = {
                "surface": name,
                "method": method_name(method),
                "n": f"{sizes[0]} to {sizes[-1]}",
            }
            quantity = "order of the relative l2 error, at least"
            seen = slope(spacings, values)
            rows.append(Row(quantity, seen, setting, None, "project", order - 0.2, at_least=True))
        convergence(
            out / f"poisson-{name.replace(' ', '-')}.png",
            spacings,
            {method_name(method): values for method, values in errors.items()},
            orders=[2, 4],
            title=f"Poisson, {name}",
            label="relative l2 error",
        )
    progress.close()
    return rows + _scans(quick)


def _scans(quick: bool) -> list[Row]:
    """Poisson on the scans: that it converges, and in how many steps."""
    rows = []
    n = 3_000 if quick else None
    makers = (data.bunny,) if quick else (data.bunny, data.armadillo)
    orders = (2,) if quick else (2, 4)
    jobs = [(make, js.DCPSE(order=order)) for make in makers for order in orders]
    for make, method in tqdm(jobs, desc="scans"):
        cloud = make(n)
        x = np.asarray(cloud.points)
        x = (x - x.mean(axis=0)) / x.std()
        f = np.sin(2 * x[:, 0]) + x[:, 1] * x[:, 2]
        laplacian = js.laplace_beltrami(cloud, method=method, throw=False)
        # No flux through the holes of the bunny; the Armadillo is closed.
        closure = (
            None if cloud.boundary is None else js.eliminate(cloud, js.neumann(cloud.boundary))
        )
        found = js.solve(laplacian, f, closure=closure, throw=False)
        setting = {"surface": make.__name__, "method": method_name(method), "n": cloud.n}
        residual = float(found.stats["relative_residual"])
        rows.append(Row("relative residual", residual, setting, None, "project", 1.5e-8))
        steps = float(found.stats["num_steps"])
        rows.append(Row("Krylov steps", steps, setting, None, "project"))
    return rows
