"""Laplace–Beltrami operator on the unit circle (paper 001, Section 4.1, Figure 2c)."""

from __future__ import annotations

from pathlib import Path

import jax.numpy as jnp
import numpy as np
from tqdm import tqdm

import jaxsurf as js

from .pictures import convergence
from .report import Row, slope


def paper_laplacian(n: int) -> tuple[js.PointCloud, js.Stencil]:
    """Equispaced points, and the Laplacian with the paper's parameters."""
    layer_spacing = 3 / (n - 1)
    cloud = js.circle(n)
    # 4.1 of these spacings are 1.96 times the distance between points: two neighbours.
    # Three points carry the second derivative of an even stencil, although not every
    # polynomial of the basis, hence throw=False.
    neighbors = js.find_neighbors(cloud, radius=4.1 * layer_spacing)
    method = js.DCPSE(order=2, layers=4, layer_spacing=layer_spacing)
    return cloud, js.laplace_beltrami(cloud, neighbors, method=method, throw=False)


def run(quick: bool, out: Path) -> list[Row]:
    sizes = [100, 400] if quick else [50, 100, 200, 400, 800, 1600]
    spacings, largest, mean = [], [], []
    for n in tqdm(sizes, desc="E1"):
        cloud, laplacian = paper_laplacian(n)
        f = jnp.sum(cloud.points, axis=1)
        error = np.abs(np.asarray(laplacian(f) + f))
        spacings.append(2 * np.pi / n)
        largest.append(float(error.max()))
        mean.append(float(np.sqrt(np.mean(error**2))))
    errors = {"maximum": largest, "root mean square": mean}
    convergence(out / "E1.png", spacings, errors, orders=[2], title="Circle, DC-PSE of order 2")
    source = "paper 001, Fig. 2c"
    rows = [
        Row(
            f"order of the {name} error, at least",
            slope(spacings, values),
            {"n": f"{sizes[0]} to {sizes[-1]}"},
            2.0,
            source,
            1.8,
            at_least=True,
        )
        for name, values in errors.items()
    ]
    for n, worst, typical in zip(sizes, largest, mean):
        rows.append(Row("maximum error", worst, {"n": n}, None, source))
        rows.append(Row("root mean square error", typical, {"n": n}, None, source))
    return rows
