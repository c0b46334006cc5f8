"""Symmetric negative semi-definite Laplacians: three ways compared, and the one kept on scans.

The ways, all with the masses of `surface.cell_areas` and the neighbours of GFDM of degree 2:

- averaged: $(ML + L^T M)/2$ of GFDM's Laplacian, its diagonal by row sums;
- weak: $-G^T M G$ with GFDM's gradient, less the residuals of its local fit to the neighbours;
- least change: `surface.symmetric_laplacian`, positive weights nearest to a kernel.
"""

from __future__ import annotations

import time
from pathlib import Path

import diffrax as dfx
import jax.numpy as jnp
import numpy as np
import scipy.linalg
import scipy.sparse as sp
from scipy.sparse.linalg import spsolve

import jaxsurf as js

from . import data, surfaces
from .report import Row, relative_l2, slope

_METHOD = js.GFDM(degree=2)


def _averaged(surface: js.Discretization):
    half = sp.diags(np.asarray(surface.cell_areas)) @ surface.laplacian.to_scipy()
    form = (half + half.T) / 2
    return form - sp.diags(np.ravel(form.sum(axis=1)))


def _weak(surface: js.Discretization):
    """Semi-definite by construction too: squares of gradients, and of what a linear fit leaves."""
    masses = np.asarray(surface.cell_areas)
    gradient = surface.gradient.to_scipy()
    form = -gradient.T @ sp.diags(np.repeat(masses, 3)) @ gradient
    lists, mask = np.asarray(surface.neighbors.indices)[:, 1:7], surface.neighbors.mask[:, 1:7]
    rows = np.arange(lists.size)
    own, other = np.repeat(np.arange(surface.n), 6), lists.ravel()
    ones = np.ravel(np.asarray(mask, float))
    shape = (lists.size, surface.n)
    jump = sp.csr_matrix((ones, (rows, other)), shape) - sp.csr_matrix((ones, (rows, own)), shape)
    offset = np.asarray(surface.cloud.points)[other] - np.asarray(surface.cloud.points)[own]
    columns = 3 * own[:, None] + np.arange(3)
    along = (np.ravel(offset * ones[:, None]), (np.repeat(rows, 3), columns.ravel()))
    left = jump - sp.csr_matrix(along, (lists.size, 3 * surface.n)) @ gradient
    return form - left.T @ left / 6


def _least_change(surface: js.Discretization):
    return sp.diags(np.asarray(surface.cell_areas)) @ surface.symmetric_laplacian.to_scipy()


_WAYS = {"averaged": _averaged, "weak": _weak, "least change": _least_change}


def _compared(sizes: list[int]) -> list[Row]:
    rows, of = [], surfaces.ellipsoid()
    for name, way in _WAYS.items():
        solved, applied, spacings = [], [], []
        for n in sizes:
            surface = js.discretize(of.cloud("jittered", n), method=_METHOD)
            u, exact = map(np.asarray, of.exact(surface.cloud))
            form, masses = way(surface), np.asarray(surface.cell_areas)
            operator = (sp.diags(1 / masses) @ form).tocsc()
            found = spsolve((sp.eye_array(n) - operator).tocsc(), u - exact)
            solved.append(relative_l2(found, u))
            applied.append(relative_l2(operator @ u, exact))
            spacings.append(of.spacing(n))
            setting = {"way": name, "n": n}
            rows.append(Row("error of (1 - L) u = f, rms", solved[-1], setting))
            rows.append(Row("error of L u, rms", applied[-1], setting))
        kept = name == "least change"
        setting = {"way": name, "n": f"{sizes[0]} to {sizes[-1]}"}
        rows.append(Row("order of solutions, at least" if kept else "order of solutions",
                        slope(spacings, solved), setting, None, "project",
                        1.7 if kept else None, kept))  # fmt: skip
        rows.append(Row("order of L u", slope(spacings, applied), setting))
        for kind in ("jittered", "random"):
            surface = js.discretize(of.cloud(kind, sizes[0]), method=_METHOD)
            form, masses = way(surface).toarray(), np.asarray(surface.cell_areas)
            values = scipy.linalg.eigvalsh(form / np.sqrt(masses)[:, None] / np.sqrt(masses))
            rows.append(Row("largest eigenvalue over spectral radius", values[-1] / -values[0],
                            {"way": name, "points": kind}, None, "project",
                            1e-13 if kept else None))  # fmt: skip
    return rows


def _cost(n: int) -> list[Row]:
    """Of a second build, when programs are compiled, in builds of GFDM's Laplacian."""
    cloud = surfaces.ellipsoid().cloud("jittered", n)
    neighbors = js.choose_neighbors(cloud, method=_METHOD)
    times: dict[str, float] = {}
    for _ in range(2):
        surface = js.discretize(cloud, neighbors, method=_METHOD)
        for name in ("laplacian", "cell_areas", "symmetric_laplacian"):
            start = time.perf_counter()
            operator = getattr(surface, name)
            getattr(operator, "weights", operator).block_until_ready()
            times[name] = time.perf_counter() - start
    return [
        Row(
            f"build of {name}, in builds of the Laplacian",
            times[name] / times["laplacian"],
            {"n": n},
        )
        for name in ("cell_areas", "symmetric_laplacian")
    ]


def _on_scan(name: str, cloud: js.PointCloud, t1: float) -> list[Row]:
    """Waves from a bell about the first point, and heat from random values."""
    surface = js.discretize(cloud, method=_METHOD)
    operator, masses = surface.symmetric_laplacian, surface.cell_areas
    x, size = cloud.points, jnp.sqrt(jnp.sum(masses) / (4 * jnp.pi))
    bell = jnp.exp(-jnp.sum((x - x[0]) ** 2, axis=1) / (0.3 * size) ** 2)
    scaled = size**2 * operator  # as if it had the area of the unit sphere

    def energy(u, v):
        return masses @ (v**2 - u * scaled(u)) / 2

    setting = {"points": name, "n": cloud.n, "t": t1}
    save = {"t1": t1, "saveat": dfx.SaveAt(ts=jnp.linspace(0, t1, 11))}
    waves = js.integrate(js.WaveEquation(scaled), (bell, 0 * bell), rtol=1e-6, **save)
    energies = np.array([energy(u, v) for u, v in zip(*waves.ys)])
    noise = jnp.asarray(np.random.default_rng(0).normal(size=cloud.n))
    heat = js.integrate(js.AdvectionDiffusionReaction(scaled), noise, **save).ys
    norms, mass = np.asarray(heat**2 @ masses), np.asarray(heat @ masses)
    residual = operator.diagnostics.residual
    return [
        Row("drift of the energy of waves", float(np.abs(energies / energies[0] - 1).max()),
            setting, None, "project", 0.01),
        # In the end nothing is left but constants and what the steps' tolerance allows.
        Row("largest growth of the norm of heat, less 1", float((norms[1:] / norms[:-1] - 1).max()),
            setting, None, "project", 1e-9),
        Row("change of the mass of heat", float(np.ptp(mass) / (masses @ jnp.abs(noise))),
            setting, None, "project", 1e-12),
        Row("moments missed, median", float(jnp.median(residual)), setting),
        Row("moments missed, largest", float(residual.max()), setting),
    ]  # fmt: skip


def run(quick: bool, out: Path) -> list[Row]:
    rows = _compared([300, 1_200] if quick else [500, 1_000, 2_000, 4_000])
    rows += _cost(1_200 if quick else 20_000)
    if not quick:
        cloud = surfaces.ellipsoid().cloud("jittered", 400)
        rows += _on_scan("ellipsoid, jittered", cloud, 20.0)
    scans: list = [("bunny", data.bunny, 1_200 if quick else 2_960)]
    if not quick:
        scans += [("bunny", data.bunny, 10_000), ("Armadillo", data.armadillo, 10_000)]
        scans += [("bunny", data.bunny, 20_000), ("Armadillo", data.armadillo, 20_000)]
    for name, scan, n in scans:
        try:
            rows += _on_scan(name, scan(n), 2.0 if quick else 20.0)
        except FileNotFoundError as error:
            print(f"without the {name}: {error}")
    return rows
