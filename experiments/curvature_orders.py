r"""Orders of mean curvature flow, in positions, normals and curvature.

In time on fixed points, against a run with short steps; in space on a spheroid, against the profile
that moves by the same law to 1e-10.
"""

from __future__ import annotations

from pathlib import Path

import jax.numpy as jnp
import numpy as np

import jaxsurf as js

from .axisymmetric import angles, flow, nearest_on
from .report import Row, method_name

_AXES = (1.0, 1.0, 1.4)
_END = 0.1
_WHAT = ("positions", "normals", "H")


def slopes(errors: list[np.ndarray], finer: list[float]) -> np.ndarray:
    """Between the last two, of each column."""
    return np.log(errors[-2] / errors[-1]) / np.log(finer[-1] / finer[-2])


def size(x) -> float:
    return float(np.sqrt(np.mean(np.sum(np.reshape(x, (len(x), -1)) ** 2, axis=1))))


def in_time(order: int, n: int, steps: list[int]) -> list[Row]:
    surface = js.discretize(js.ellipsoid(n, (1.2, 1.0, 0.9)), method=js.GFDM(degree=4))

    def end(count: int) -> tuple:
        # The tolerance of the linear systems is far below the errors of the steps.
        solver = js.IMEX(order=order, tolerance=1e-13)
        given = dict(t1=_END, solver=solver, dt0=_END / count)
        last = js.evolve(js.MeanCurvatureFlow(), surface, **given).surfaces[-1]  # type: ignore[arg-type]
        return last.cloud.points, last.cloud.normals, last.mean_curvature

    exact = end(4 * steps[-1])
    errors = [np.array([size(a - b) for a, b in zip(end(count), exact)]) for count in steps]
    found = slopes(errors, [float(count) for count in steps])
    setting = {"IMEX": order, "n": n, "steps": steps[-1]}
    source, least = "short steps", order - 0.4
    rows = [Row(f"error of {w}", e, setting, None, source) for w, e in zip(_WHAT, errors[-1])]
    return rows + [
        Row(f"order in time of {w}, at least", s, setting, None, source, least, at_least=True)
        for w, s in zip(_WHAT, found)
    ]


def in_space(method: js.GFDM | js.DCPSE, order: int, sizes: list[int]) -> list[Row]:
    count = 96
    u = angles(count, 0.5)
    r, z = _AXES[0] * np.sin(u), _AXES[2] * np.cos(u)
    profile = flow(r, z, until=_END, narrow=0.0, at=count // 4).at(_END)
    errors = []
    for n in sizes:
        given = dict(method=method, t1=_END, rtol=1e-7, atol=1e-9)
        run = js.evolve(js.MeanCurvatureFlow(), js.ellipsoid(n, _AXES), **given)  # type: ignore[arg-type]
        surface = run.surfaces[-1]
        x = np.asarray(surface.cloud.points)
        place, normals, curvature = nearest_on(profile, x)
        wrong = (x - place, surface.cloud.normals - normals, surface.mean_curvature - curvature)
        errors.append(np.array([size(jnp.asarray(w)) for w in wrong]))
    found = slopes(errors, [n**0.5 for n in sizes])
    setting = {"method": method_name(method), "n": sizes[-1], "t": _END}
    rows = [Row(f"error of {w}", e, setting, None, "profile") for w, e in zip(_WHAT, errors[-1])]
    return rows + [
        Row(
            f"order in space of {w}, at least",
            s,
            setting,
            None,
            "profile",
            order - 0.4,
            at_least=True,
        )
        for w, s in zip(_WHAT, found)
    ]


def run(quick: bool, out: Path) -> list[Row]:
    n, numbers = (200, [4, 8]) if quick else (300, [8, 16])
    rows = in_time(2, n, numbers) + in_time(4, n, [8, 16])
    rows += in_space(js.GFDM(degree=4), 4, [700, 1_400] if quick else [1_000, 2_000, 4_000])
    if not quick:
        rows += in_space(js.GFDM(degree=2), 2, [1_000, 2_000, 4_000])
        rows += in_space(js.DCPSE(order=4), 4, [1_000, 2_000, 4_000])
    return rows
