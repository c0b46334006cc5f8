"""Poisson's equation on the unit sphere (paper 001, Section 4.2, Figure 3d).

Values are prescribed on the great circle x = 0, at the points within half a spacing of it (no
point of a Fibonacci lattice lies on it), with the solution at each. Operators and their lengths
are those of E2.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from tqdm import tqdm

import jaxsurf as js

from .e02_sphere_laplacian import harmonic, paper_laplacian
from .pictures import convergence
from .report import Row, slope


def solution_error(n: int, order: int, *, proportional: bool = False) -> tuple[np.ndarray, int]:
    """Error at every point, and the number of Krylov steps."""
    cloud, laplacian = paper_laplacian(n, order, proportional=proportional)
    exact = harmonic(cloud.points[:, 2])
    half = math.sqrt(4 * math.pi / n) / 2
    band = np.flatnonzero(np.abs(cloud.points[:, 0]) < half)
    conditions = js.eliminate(cloud, js.dirichlet(band, exact[band]))
    found = js.solve(laplacian, -20 * exact, closure=conditions, rtol=1e-10)
    return np.asarray(found.value - exact), int(found.stats["num_steps"])


def run(quick: bool, out: Path) -> list[Row]:
    sizes = [2_000, 4_000] if quick else [2_000, 4_000, 8_000, 16_000, 32_000, 64_000]
    orders = (2,) if quick else (2, 4)
    source = "paper 001, Fig. 3d"
    rows: list[Row] = []
    errors = {}
    progress = tqdm(total=len(orders) * len(sizes), desc="E5")
    spacings = [math.sqrt(4 * math.pi / n) for n in sizes]
    for order in orders:
        largest, typical = [], []
        for n in sizes:
            error, steps = solution_error(n, order)
            largest.append(float(np.abs(error).max()))
            typical.append(float(np.sqrt(np.mean(error**2))))
            setting = {"order": order, "n": n}
            rows.append(Row("Krylov steps", float(steps), setting, None, source))
            progress.update()
        for name, values in {"maximum": largest, "root mean square": typical}.items():
            errors[f"order {order}, {name}"] = values
            over = {"order": order, "n": f"{sizes[0]} to {sizes[-1]}"}
            quantity = f"order of the {name} error, at least"
            seen = slope(spacings, values)
            bound = order - 0.2
            rows.append(Row(quantity, seen, over, float(order), source, bound, at_least=True))
            for n, value in zip(sizes, values):
                rows.append(Row(f"{name} error", value, {"order": order, "n": n}, None, source))
    progress.close()
    title = r"Sphere, $\Delta_S u = -20\,Y_{40}$, surface DC-PSE"
    convergence(out / "E5.png", spacings, errors, orders=orders, title=title)
    return rows
