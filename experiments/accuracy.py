"""Laplacian of exp(x + 2y + 1.5z) on the unit sphere, beside what other codes reach.

With the default neighbourhoods, and for the methods of the table of timings
(`python -m experiments.benchmarks`) with the numbers of neighbours that are timed there.
"""

from __future__ import annotations

from pathlib import Path

from tqdm import tqdm

import jaxsurf as js
from jaxsurf.normals import estimate_normals

from . import surfaces
from .benchmarks.cases import METHODS as TIMED
from .report import Method, Row, method_name, relative_l2

# What others reach at n = 1e5, on Fibonacci points and on jittered ones, with how many neighbours.
# Compadre of degree 2 is more accurate than ours on Fibonacci points, less so on jittered ones.
_PEERS = {
    js.GFDM(degree=2): ("Compadre degree 2, k = 13", {"regular": 7.5e-5, "jittered": 1.2e-3}),
    js.GFDM(degree=4): ("Compadre degree 4, k = 37", {"regular": 4.5e-8, "jittered": 2.1e-7}),
    js.DCPSE(order=2): ("OpenFPM order 2, k = 26", {"regular": 2.9e-4, "jittered": 2.9e-4}),
    js.DCPSE(order=4): ("OpenFPM order 4, k = 47", {"regular": 6.4e-7, "jittered": 6.1e-7}),
}
_METHODS: list[Method] = [
    *(js.DCPSE(order=r) for r in (2, 3, 4)),
    *(js.GFDM(degree=p) for p in (2, 3, 4, 5)),
    *(js.RBFFD(degree=p) for p in (2, 4)),
]


def polynomial_degree(method: Method) -> int:
    """Degree of the polynomials that the Laplacian of a method is exact on."""
    return method.order + 1 if isinstance(method, js.DCPSE) else method.degree


def run(quick: bool, out: Path) -> list[Row]:
    n = 4_000 if quick else 100_000
    surface = surfaces.sphere()
    kinds = ("regular", "jittered")
    jobs: list[tuple[str, str, Method, int | None]]
    if quick:  # what is compiled for other experiments too
        few = (js.DCPSE(order=2), js.DCPSE(order=4))
        jobs = [(kind, "exact", method, None) for kind in kinds for method in few]
    else:
        jobs = [(kind, "exact", method, k) for kind in kinds for method, k in TIMED.values()]
        jobs += [
            (kind, normals, method, None)
            for kind in kinds
            for normals in ("exact", "estimated")
            for method in _METHODS
        ]
    rows, clouds = [], {}
    for kind, normals, method, k in tqdm(jobs, desc="accuracy"):
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
        if k is None:
            neighbors, k = None, f"{method.neighbor_count(3)} (default)"
        else:
            neighbors = js.find_neighbors(cloud, k=k)
        laplacian = js.laplace_beltrami(cloud, neighbors, method=method, throw=False)
        error = relative_l2(laplacian(u), exact)
        setting = {"method": method_name(method), "k": k, "points": kind, "normals": normals,
                   "n": n}  # fmt: skip
        peer, figures = _PEERS.get(method, ("", {}))
        reference = figures.get(kind)
        # The figures are for n = 1e5: at fewer points larger by h^order. Estimated normals may
        # cost a factor of two. Where a peer is better the row says so.
        bound = None
        if reference is not None:
            bound = reference * (100_000 / n) ** ((polynomial_degree(method) - 1) / 2)
            bound = bound if normals == "exact" else 2 * bound
        rows.append(Row("relative l2 error", error, setting, reference, peer, bound))
    return rows
