"""Mean curvature of the Stanford bunny (paper 001, Section 4.3, Figure 4d).

The paper shows a picture for 2,960 points. Numbers here: all values finite, and how far the
coarse points are from the full model, which is the error to expect at that resolution (the fur
of the model is not resolved).
"""

from __future__ import annotations

from pathlib import Path

import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from scipy.spatial import cKDTree
from tqdm import tqdm

import jaxsurf as js
from jaxsurf.plot import plot_cloud

from . import data
from .report import Row

_SOURCE = "paper 001, Fig. 4d (a picture)"


def run(quick: bool, out: Path) -> list[Row]:
    # The quick version has as many points as others, with which it shares what is compiled.
    sizes = [3_000] if quick else [None, 2_960]
    rows: list[Row] = []
    results = []
    for n in tqdm(sizes, desc="E7"):
        cloud = data.bunny(n)
        size = float(jnp.max(jnp.ptp(cloud.points, axis=0)))
        mean = size * np.asarray(js.mean_curvature(cloud, method=js.DCPSE(order=2)))
        results.append((cloud, mean))
        setting = {"n": cloud.n}
        lost = float(np.sum(~np.isfinite(mean)))
        rows.append(Row("points without a finite mean curvature", lost, setting, 0, _SOURCE, 0))
        for share in (1, 50, 99):
            quantity = f"percentile {share} of mean curvature times size"
            rows.append(Row(quantity, float(np.percentile(mean, share)), setting, None, _SOURCE))
    if not quick:
        (full, fine), (coarse, rough) = results
        near = cKDTree(np.asarray(full.points)).query(np.asarray(coarse.points), k=12)[1]
        difference = float(np.median(np.abs(rough - np.median(fine[near], axis=1))))
        quantity = "median difference from the full model, times size"
        rows.append(Row(quantity, difference, {"n": coarse.n}, None, _SOURCE))

    figure, axes = plt.subplots(
        1, len(results), figsize=(5.5 * len(results), 5), layout="constrained", squeeze=False
    )
    view, up = (0.35, 0.3, 1.0), (0.0, 1.0, 0.0)
    for ax, (cloud, mean) in zip(axes[0], results):
        title = f"{cloud.n:,} points"
        limits = (-15.0, 15.0)
        plot_cloud(cloud, jnp.asarray(mean), ax=ax, title=title, limits=limits, view=view, up=up,
                   label="mean curvature times size")  # fmt: skip
    figure.savefig(out / "E7.png", dpi=150)
    plt.close(figure)
    return rows
