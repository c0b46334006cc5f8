r"""A dumbbell by mean curvature flow pinches off, its ends vanish (paper 002, Section 4.2.3).

Two unit spheres, centres 4 apart, joined by a cylinder of radius 0.2, rounded where they meet. The
handle goes first, as $\rho^2 = 0.04 - t$, then each end as $r^2 = 1 - 2t$, nearly: times of both
are told. A sphere alone is held against its radius.
"""

from __future__ import annotations

from pathlib import Path

import jax.numpy as jnp
import numpy as np

import jaxsurf as js

from .report import Row

_HALF, _HANDLE, _ROUND = 2.0, 0.2, 0.05
_BOUNDS = ((-1.2, -1.2, -3.2), (1.2, 1.2, 3.2))


def _dumbbell(x):
    """Smooth union of distances: a softer minimum of those to both ends and to the handle."""
    ends = [jnp.linalg.norm(x - jnp.array([0.0, 0.0, s * _HALF])) - 1 for s in (1, -1)]
    handle = jnp.sqrt(x[0] ** 2 + x[1] ** 2 + 1e-12) - _HANDLE
    handle = jnp.maximum(handle, jnp.abs(x[2]) - _HALF)
    parts = jnp.stack([*ends, handle])
    nearest = jnp.min(parts)
    return nearest - _ROUND * jnp.log(jnp.sum(jnp.exp(-(parts - nearest) / _ROUND)))


def flow(least: float, t1: float, times) -> js.Evolution:
    """Spacing 0.35 / curvature, within bounds; sheets touch at four of the least."""

    def spacing(t, surface, fields, args):
        mean, gauss = surface.mean_curvature, surface.gauss_curvature
        largest = jnp.abs(mean) + jnp.sqrt(jnp.maximum(mean**2 - gauss, 0))
        return jnp.clip(0.35 / largest, least, 3 * least)

    cloud = js.level_set(_dumbbell, spacing=2 * least, bounds=_BOUNDS)
    adapt = js.Adaptation(spacing, every=0.01, capacity=3 * cloud.n)
    contact = js.Contact(4 * least)
    given = dict(method=js.GFDM(degree=2), adapt=adapt, contact=contact, rtol=1e-4, atol=1e-6)
    return js.evolve(js.MeanCurvatureFlow(), cloud, t1=t1, saveat=times, **given)  # type: ignore


def shrunk(n: int, t1: float) -> float:
    """Largest relative error of the radius of a sphere."""
    method = js.GFDM(degree=4)
    run = js.evolve(js.MeanCurvatureFlow(), js.sphere(n), t1=t1, method=method, rtol=1e-7)
    exact = np.sqrt(1 - 2 * t1)
    return float(np.abs(np.linalg.norm(run.clouds[-1].points, axis=1) / exact - 1).max())


def run(quick: bool, out: Path) -> list[Row]:
    source = "paper 002, Section 4.2.3"
    n, t1 = (2_000, 0.2) if quick else (8_000, 0.455)
    setting = {"n": n, "t": t1}
    quantity = "relative error of the radius of a sphere"
    rows = [Row(quantity, shrunk(n, t1), setting, None, "r² = 1 - 2t", 1e-4)]
    times = [0.0, 0.05] if quick else [0.0, 0.05, 0.06, 0.2, 0.4]
    for least in (0.06,) if quick else (0.05, 0.035, 0.025):
        solution = flow(least, 0.06 if quick else 0.6, times)
        events, setting = solution.events, {"least spacing": least}
        pinched = events["t"][events["pinched"] > 0]
        rows.append(Row("necks pinched, at least", len(pinched), setting, None, source, 1, True))
        rows.append(Row("time of the first pinch", pinched.min(initial=np.inf), setting, 0.05))
        if not quick:
            gone = events["t"][events["vanished"] > 0]
            rows.append(Row("time of the end", gone.max(initial=0), setting))
            rows.append(Row("both ends have vanished: times saved", len(solution.ts), setting))
    js.plot_series(solution.clouds, times=solution.ts, path=out / "e16.png")
    return rows
