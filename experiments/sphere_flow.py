r"""Mean curvature flow of the unit sphere, which stays one (paper 002, Section 4.1).

$r(t) = \sqrt{1 - 2t}$. Until r = 0.3, where errors have grown by a factor of 1/0.09: the velocity
is -1/r, so that $r\,\delta r$ is kept and a relative error grows as $1/r^2$.
"""

from __future__ import annotations

from pathlib import Path

import diffrax as dfx
import jax.numpy as jnp
import numpy as np

import jaxsurf as js

from .report import Row, method_name

_LAST = 0.3
_ASKED = 1e-4


def error(n: int, method: js.DCPSE | js.GFDM, last: float, **options) -> tuple[float, float, dict]:
    """Largest relative errors of the radii and of their mean at the last, and what it took."""
    surface = js.discretize(js.sphere(n), method=method)
    flow = js.MeanCurvatureFlow()
    run = js.evolve(flow, surface, t1=(1 - last**2) / 2, **options)
    radii = np.asarray(jnp.linalg.norm(run.clouds[-1].points, axis=1))
    return float(np.abs(radii / last - 1).max()), float(radii.mean() / last - 1), run.stats


def predicted(n: int, method: js.DCPSE | js.GFDM, last: float) -> float:
    """Of the radius at the end, from the mean error of the curvature at the start alone.

    A share e of the curvature that is missing leaves $r^2 = 1 - 2(1 - e)t$: e stays the same as the
    points draw together evenly.
    """
    cloud = js.sphere(n)
    bent = js.laplace_beltrami(cloud, method=method)(cloud.points)
    missing = 1 + float(jnp.mean(jnp.sum(bent * cloud.points, axis=1))) / 2
    return missing * (1 - last**2) / (2 * last**2)


def run(quick: bool, out: Path) -> list[Row]:
    fine, other = js.DCPSE(order=4), js.GFDM(degree=4)
    cases: list[tuple[int, js.DCPSE | js.GFDM]] = [(350 if quick else 1_000, fine)]
    if not quick:
        cases += [(2_000, fine), (2_000, other), (4_000, fine)]
    rows: list[Row] = []
    last = 0.75 if quick else _LAST
    for n, method in cases:
        largest, mean, stats = error(n, method, last, solver=dfx.Tsit5(), rtol=1e-7, atol=1e-9)
        of_space = predicted(n, method, last)
        setting = {"method": method_name(method), "n": n, "r": last}
        bound = _ASKED if n == 4_000 else None
        source = "r(t) = sqrt(1 - 2t)"
        rows += [
            Row("largest relative error of a radius", largest, setting, None, source, bound),
            Row("relative error of the mean radius", mean, setting, None, source),
            Row("the same, as the curvature at the start foretells", of_space, setting),
            Row("what these two differ by", abs(mean - of_space), setting, None,
                source, _ASKED),
            Row("steps", float(stats["steps"]), setting),
            Row("renewals of neighbours", float(stats["renewals"]), setting),
        ]  # fmt: skip
    return rows
