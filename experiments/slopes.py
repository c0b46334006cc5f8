"""Observed orders of the Laplacian on three surfaces and three kinds of points."""

from __future__ import annotations

from pathlib import Path

from tqdm import tqdm

import jaxsurf as js

from . import surfaces
from .pictures import convergence
from .report import Method, Row, method_name, relative_l2, slope

_KINDS = ("regular", "jittered", "Poisson disk")
# The quick version takes every surface once. On Poisson-disk points neighbourhoods are adapted,
# which compiles three programs more for every method and number of points.
_QUICK = {"sphere": "regular", "ellipsoid": "jittered", "torus": "regular"}
# The order of convergence that each method promises.
_METHODS: dict[Method, int] = {js.DCPSE(order=r): r for r in (2, 3, 4)} | {
    make(degree=r + 1): r for make in (js.GFDM, js.RBFFD) for r in (2, 3, 4)
}


def run(quick: bool, out: Path) -> list[Row]:
    sizes = [2_000, 4_000] if quick else [2_000, 4_000, 8_000, 16_000, 32_000]
    methods: list[Method] = (
        [js.DCPSE(order=2), js.DCPSE(order=4), js.GFDM(degree=4)] if quick else [*_METHODS]
    )
    shapes = [surfaces.sphere(), surfaces.ellipsoid(), surfaces.torus()]
    rows: list[Row] = []
    kinds = {s.name: (_QUICK[s.name],) if quick else _KINDS for s in shapes}
    jobs = sum(map(len, kinds.values())) * len(sizes) * len(methods)
    progress = tqdm(total=jobs, desc="slopes")
    for surface in shapes:
        for kind in kinds[surface.name]:
            errors: dict[Method, list[float]] = {method: [] for method in methods}
            for n in sizes:
                cloud = surface.cloud(kind, n)
                u, exact = surface.exact(cloud)
                for method, values in errors.items():
                    laplacian = js.laplace_beltrami(cloud, method=method)
                    values.append(relative_l2(laplacian(u), exact))
                    progress.update()
            spacings = [surface.spacing(n) for n in sizes]
            for method, values in errors.items():
                order = _METHODS[method]
                setting = {
                    "method": method_name(method),
                    "surface": surface.name,
                    "points": kind,
                    "n": f"{sizes[0]} to {sizes[-1]}",
                }
                quantity = "order of the relative l2 error, at least"
                bound = order - 0.2
                seen = slope(spacings, values)
                rows.append(Row(quantity, seen, setting, None, "project", bound, at_least=True))
                last = setting | {"n": sizes[-1]}
                rows.append(Row("relative l2 error", values[-1], last, None, "project"))
            convergence(
                out / f"slopes-{surface.name}-{kind.replace(' ', '-')}.png",
                spacings,
                {method_name(method): values for method, values in errors.items()},
                orders=[2, 3, 4],
                title=f"Laplacian, {surface.name}, {kind} points",
                label="relative l2 error",
            )
    progress.close()
    return rows
