r"""The neck of a smooth dumbbell by mean curvature flow, until shortly before it pinches off.

$\rho^2 = (1 - s^2)(a + b s^2)^2$ with $s = z/l$, a surface of revolution. The radius of its neck is
held against that of a profile that moves by the same law to 1e-10; the spacing follows the largest
curvature.
"""

from __future__ import annotations

from pathlib import Path

import jax.numpy as jnp
import numpy as np

import jaxsurf as js

from .axisymmetric import angles, closing, flow, narrowest
from .report import Row, method_name

_HALF, _NECK, _BULGE = 2.0, 0.4, 1.2
_BOUNDS = ((-0.9, -0.9, -2.2), (0.9, 0.9, 2.2))
_METHOD = js.GFDM(degree=4)
# Numbers of this kind have a point of the profile at the neck, and none on the axis.
_COUNT = 4 * 64 + 2


def _dumbbell(x):
    s = x[2] / _HALF
    return x[0] ** 2 + x[1] ** 2 - (1 - s**2) * (_NECK + _BULGE * s**2) ** 2


def reference():
    """The radius of the neck over time, and when it pinches off."""
    u, neck = angles(_COUNT, 0.5), (_COUNT - 2) // 4
    r, z = np.sin(u) * (_NECK + _BULGE * np.cos(u) ** 2), _HALF * np.cos(u)
    profile = flow(r, z, until=1.0, narrow=0.06, at=neck)
    return lambda t: profile.at(t)[0][neck], closing(profile, neck)


def spacing(t, surface, fields, args):
    """A share of the least radius of curvature, or that of bulbs."""
    share, least, most = args
    mean, gauss = surface.mean_curvature, surface.gauss_curvature
    largest = jnp.abs(mean) + jnp.sqrt(jnp.maximum(mean**2 - gauss, 0))
    return jnp.clip(share / largest, least, most)


def followed(
    n: int, share: float, parts: tuple[float, ...], bound: float
) -> tuple[list[Row], js.Evolution]:
    """To parts of the time in which the neck pinches off."""
    radius, pinch = reference()
    times = pinch * np.array(parts)
    cloud = js.level_set(_dumbbell, n=n, bounds=_BOUNDS)
    most = float(np.sqrt(js.discretize(cloud).areas.sum() / n))
    run = js.evolve(
        js.MeanCurvatureFlow(),
        cloud,
        t1=times[-1],
        saveat=[0.0, *times[:-1]],
        method=_METHOD,
        adapt=js.Adaptation(spacing, capacity=int(1.3 * n)),
        args=(share, 0.0, most),
    )
    rows = []
    for part, t, surface in zip(parts, times, run.surfaces[1:]):
        setting = {"method": method_name(_METHOD), "n": surface.n, "t / pinch": part}
        rows.append(Row("radius of the neck, of the profile", radius(t), setting))
        error = abs(narrowest(surface) - radius(t))
        rows.append(Row("error of the radius", error, setting, None, "profile", bound))
    return rows, run


def run(quick: bool, out: Path) -> list[Row]:
    given = (1_500, 0.25, (0.5,), 1e-2) if quick else (10_000, 0.12, (0.5, 0.9), 1e-3)
    rows, run = followed(*given)
    curvature = [surface.mean_curvature for surface in run.surfaces]
    js.plot_series(
        run.clouds, curvature, times=run.ts, path=out / "neck.png", label="mean curvature"
    )
    return rows
