"""Poisson's equation on the unit circle (paper 001, Section 4.2, Figure 2d).

The solution sin 2θ belongs to the right-hand side -4 sin 2θ; the paper prints the other sign.
"""

from __future__ import annotations

from pathlib import Path

import jax.numpy as jnp
import numpy as np
from tqdm import tqdm

import jaxsurf as js

from .e01_circle_laplacian import paper_laplacian
from .pictures import convergence
from .report import Row, slope


def run(quick: bool, out: Path) -> list[Row]:
    sizes = [100, 400] if quick else [50, 100, 200, 400, 800, 1600]
    source = "paper 001, Fig. 2d"
    rows: list[Row] = []
    largest, typical = [], []
    for n in tqdm(sizes, desc="E4"):
        cloud, laplacian = paper_laplacian(n)
        theta = jnp.arctan2(cloud.points[:, 1], cloud.points[:, 0])
        start = int(jnp.argmin(jnp.linalg.norm(cloud.points - jnp.array([1.0, 0.0]), axis=1)))
        conditions = js.eliminate(cloud, js.dirichlet(np.array([start]), 0.0))
        found = js.solve(laplacian, -4 * jnp.sin(2 * theta), closure=conditions, rtol=1e-9)
        error = np.abs(np.asarray(found.value - jnp.sin(2 * theta)))
        largest.append(float(error.max()))
        typical.append(float(np.sqrt(np.mean(error**2))))
        steps = float(found.stats["num_steps"])
        rows.append(Row("Krylov steps", steps, {"n": n}, None, source))
    errors = {"maximum": largest, "root mean square": typical}
    spacings = [2 * np.pi / n for n in sizes]
    convergence(out / "E4.png", spacings, errors, orders=[2], title="Poisson on the circle")
    for name, values in errors.items():
        over = {"n": f"{sizes[0]} to {sizes[-1]}"}
        seen = slope(spacings, values)
        quantity = f"order of the {name} error, at least"
        rows.append(Row(quantity, seen, over, 2.0, source, 1.8, at_least=True))
        for n, value in zip(sizes, values):
            rows.append(Row(f"{name} error", value, {"n": n}, None, source))
    return rows
