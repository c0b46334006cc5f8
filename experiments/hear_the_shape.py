"""The axes of an ellipsoid from its first 12 eigenvalues, which a spectral method computed."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import optax
from jaxtyping import Array

import jaxsurf as js

from .eigenmodes import _AXES, ellipsoid_values
from .report import Row

_COUNT = 12
_START = (0.95, 0.9, 0.85)


def stretched(x, axes):
    return axes * x


def mismatch(surface: js.Discretization, heard):
    """Mean squared relative error of the eigenvalues."""
    values = js.eigenmodes(surface.laplacian, _COUNT + 1).values[1:]
    return jnp.mean((values / heard - 1) ** 2)


def ball(n: int) -> js.MappedShape:
    return js.MappedShape(stretched, js.discretize(js.sphere(n), method=js.GFDM(degree=4)))


def problem(n: int) -> tuple[Callable, Array]:
    """The objective as a function of parameters alone, and parameters: for benchmarks."""
    shape, heard = ball(n), jnp.asarray(ellipsoid_values(12, _COUNT))
    return lambda axes: mismatch(shape(axes), heard), jnp.asarray(_START)


def _picture(path: Path, found: js.ShapeOptimization, axes: np.ndarray) -> None:
    figure, (left, right) = plt.subplots(1, 2, figsize=(8, 3.8), layout="constrained")
    mode = js.eigenmodes(found.surface.laplacian, 5).functions[:, 4]
    js.plot_cloud(found.surface.cloud, mode, ax=left, title="what was heard: mode 4")
    for i, (way, wanted) in enumerate(zip(axes.T, _AXES)):
        right.semilogy(np.abs(way / wanted - 1), "o-", markersize=3, label=f"axis {i + 1}")
    right.axhline(1e-3, color="k", linewidth=0.8, linestyle=":")
    right.set_xlabel("step")
    right.set_ylabel("relative error")
    right.legend(frameon=False)
    figure.savefig(path, dpi=130)
    plt.close(figure)


def run(quick: bool, out: Path) -> list[Row]:
    n = 800 if quick else 3_000
    heard = jnp.asarray(ellipsoid_values(12, _COUNT))
    way = [np.asarray(_START)]
    found = js.optimize_shape(
        mismatch,
        ball(n),
        jnp.asarray(_START),
        optimizer=optax.lbfgs(),
        args=(heard,),
        steps=30,
        rtol=1e-5,
        callback=lambda now: way.append(np.asarray(now.theta)),
    )
    print(found)
    _picture(out / "hear-the-shape.png", found, np.array(way))
    errors = np.abs(np.asarray(found.theta) / np.asarray(_AXES) - 1)
    about = {"n": n, "method": "GFDM(degree=4)", "eigenvalues": _COUNT}
    start = np.abs(np.asarray(_START) / np.asarray(_AXES) - 1).max()
    return [
        Row("largest relative error of an axis at the start", float(start), about),
        Row("largest relative error of an axis", float(errors.max()), about, 0.0, "project", 1e-3),
        Row("steps", len(way) - 1, about),
        Row("s to the first step, compilation included", float(found.history["seconds"][1]), about),
    ]
