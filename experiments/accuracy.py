"""Laplacian of exp(x + 2y + 1.5z) on the unit sphere with the default stencils."""

from __future__ import annotations

from pathlib import Path

from tqdm import tqdm

import jaxsurf as js
from jaxsurf.frames import estimate_normals

from . import surfaces
from .report import Method, Row, method_name, relative_l2

# What others reach at n = 1e5, on Fibonacci points and on jittered ones.
_PEERS = {
    js.GFDM(degree=2): ("GFDM degree 2 written by hand", {"regular": 1.7e-4, "jittered": 7.3e-4}),
    js.GFDM(degree=4): ("Compadre degree 4", {"regular": 4.5e-8, "jittered": 2.1e-7}),
    js.DCPSE(order=2): ("OpenFPM Surface DC-PSE order 2", {"regular": 2.9e-4, "jittered": 2.9e-4}),
    js.DCPSE(order=4): ("OpenFPM Surface DC-PSE order 4", {"regular": 6.4e-7, "jittered": 6.1e-7}),
}
_METHODS = [js.DCPSE(order=r) for r in (2, 3, 4)] + [js.GFDM(degree=p) for p in (2, 3, 4, 5)]


def polynomial_degree(method: Method) -> int:
    """Degree of the polynomials that the Laplacian of a method is exact on."""
    return method.order + 1 if isinstance(method, js.DCPSE) else method.degree


def run(quick: bool, out: Path) -> list[Row]:
    n = 20_000 if quick else 100_000
    surface = surfaces.sphere()
    jobs = [
        (kind, normals, method)
        for kind in ("regular", "jittered")
        for normals in ("exact", "estimated")
        for method in _METHODS
    ]
    rows, clouds = [], {}
    for kind, normals, method in tqdm(jobs, desc="accuracy"):
        if kind not in clouds:
            clouds[kind] = surface.cloud(kind, n)
        cloud = clouds[kind]
        u, exact = surface.exact(cloud)
        if normals == "estimated":
            key = (kind, polynomial_degree(method))
            if key not in clouds:
                found = estimate_normals(cloud.points, degree=key[1])
                clouds[key] = js.PointCloud(cloud.points, found)
            cloud = clouds[key]
        error = relative_l2(js.laplace_beltrami(cloud, method=method)(u), exact)
        setting = {"method": method_name(method), "points": kind, "normals": normals, "n": n}
        peer, figures = _PEERS.get(method, ("", {}))
        reference = figures.get(kind)
        bound = None
        # The figures are for n = 1e5: at fewer points the error is only told.
        if reference is not None and not quick:
            bound = reference if normals == "exact" else 2 * reference
        rows.append(Row("relative l2 error", error, setting, reference, peer, bound))
    return rows
