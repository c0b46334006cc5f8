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
    """Largest relative error of the radius of a sphere, integrated so that it is that of space."""
    given = dict(method=js.GFDM(degree=4), rtol=1e-8, atol=1e-10)
    run = js.evolve(js.MeanCurvatureFlow(), js.sphere(n), t1=t1, **given)  # type: ignore[arg-type]
    exact = np.sqrt(1 - 2 * t1)
    return float(np.abs(np.linalg.norm(run.clouds[-1].points, axis=1) / exact - 1).max())


def uneven(solution: js.Evolution) -> float:
    """Spread of distances from the middle of the upper end at the last time, over their mean."""
    x = np.asarray(solution.clouds[-1].points)
    upper = x[x[:, 2] > 0]
    radii = np.linalg.norm(upper - (upper.max(axis=0) + upper.min(axis=0)) / 2, axis=1)
    return float(np.ptp(radii) / np.mean(radii))


def run(quick: bool, out: Path) -> list[Row]:
    source = "paper 002, Section 4.2.3"
    n, t1 = (1_000, 0.05) if quick else (8_000, 0.455)
    setting = {"n": n, "t": t1}
    quantity = "relative error of the radius of a sphere"
    rows = [Row(quantity, shrunk(n, t1), setting, None, "r² = 1 - 2t", 1e-4)]
    times = [0.0, 0.02] if quick else [0.0, 0.03, 0.045, 0.2, 0.4]
    spacings = (0.06,) if quick else (0.05, 0.035, 0.025)
    when = []
    for least in spacings:
        solution = flow(least, 0.06 if quick else 0.6, times)
        events, setting = solution.events, {"least spacing": least}
        pinched, gone = (events["t"][events[what] > 0] for what in ("pinched", "vanished"))
        when.append((pinched.min(initial=np.inf), gone.max(initial=0)))
        rows.append(Row("necks pinched, at least", len(pinched), setting, None, source, 1, True))
        rows.append(Row("time of the first pinch", when[-1][0], setting, 0.05, source))
        if not quick:
            rows.append(Row("time at which nothing is left", when[-1][1], setting))
            seen = setting | {"t": times[-1]}
            rows.append(
                Row("unevenness of the upper end", uneven(solution), seen, None, source, 0.05)
            )
    if not quick:
        for name, (before, after) in zip(("pinch", "end"), np.abs(np.diff(when, axis=0)).T):
            setting = {"least spacing": " to ".join(map(str, spacings[1:]))}
            quantity = f"change of the time of the {name}"
            rows.append(Row(quantity, after, setting, None, "the change before", before))
    js.plot_series(solution.clouds, times=solution.ts, path=out / "e16.png")
    return rows
