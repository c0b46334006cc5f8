r"""A quarter of the unit sphere turns about its centre (paper 002, Section 3.7.1).

$v = (-y, x - z, y)$ is a rotation at the rate $\sqrt2$: after one turn every point is where it was.
The mean distance from the unit sphere is the paper's measure, of steps of given length: Euler's
move is its first-order one, that of Adams and Bashforth its second-order one, here with a start of
second order as well.
"""

from __future__ import annotations

import math
from pathlib import Path

import diffrax as dfx
import jax.numpy as jnp
import numpy as np

import jaxsurf as js

from .report import Row

_TURN = 2 * math.pi / math.sqrt(2)
_STEP = 0.05


def _turning(t, surface, fields, args):
    x, y, z = surface.cloud.points.T
    return jnp.stack([-y, x - z, y], axis=1)


def quarter(n: int) -> js.PointCloud:
    """About n points."""
    whole = js.sphere(4 * n)
    kept = np.asarray((whole.points[:, 0] > 0) & (whole.points[:, 2] > 0))
    return js.PointCloud(whole.points[kept], whole.normals[kept])


def run(quick: bool, out: Path) -> list[Row]:
    cloud = quarter(500 if quick else 3_792)
    surface = js.discretize(cloud, js.find_neighbors(cloud, 20), method=js.GFDM(degree=2))
    steps = math.ceil(_TURN / _STEP)
    source = "paper 002, Section 3.7.1"
    moves = (
        (dfx.Euler(), 1, 1.37e-1, 1.4e-1),
        (js.AdamsBashforth2(), 2, 5.57e-4, 5.6e-4),
        (dfx.Tsit5(), 5, None, 1e-5),
    )
    rows: list[Row] = []
    for solver, order, reference, bound in moves:
        name = type(solver).__name__
        setting = {"move": name, "order": order, "n": cloud.n, "steps": steps}
        solution = js.evolve(
            js.Motion(_turning), surface, t1=_TURN, solver=solver, dt0=_TURN / steps
        )
        found = np.asarray(solution.clouds[-1].points)
        distance = float(np.abs(np.linalg.norm(found, axis=1) - 1).mean())
        rows.append(
            Row("mean distance from the sphere", distance, setting, reference, source, bound)
        )
        back = float(np.linalg.norm(found - np.asarray(cloud.points), axis=1).max())
        rows.append(Row("largest distance from the start", back, setting))
    return rows
