r"""A torus (3, 1) by averaged mean curvature flow closes its hole (paper 002, Section 4.2.3).

$v = (\kappa - \bar\kappa)\,n$ keeps the volume, and the tube moves inwards until the hole is gone;
what is left tends to a sphere. Until then the inner radius is held against that of a profile that
moves by the same law (the paper's run, coarse and smoothed, closed between 6.8 and 7.05).
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

import jaxsurf as js

from .axisymmetric import angles, flow, narrowest
from .report import Row

_TORUS = (3.0, 1.0)


def reference(radii: tuple[float, float]):
    """The profile until the hole is narrow, and when it closes by r² being straight at the end."""
    u, count = angles(128), 128
    r, z = radii[0] + radii[1] * np.cos(u), radii[1] * np.sin(u)
    profile = flow(r, z, until=20.0, narrow=0.2, at=count // 2, keep_volume=True)
    inner = lambda t: profile.at(t)[0][count // 2]
    before = profile.end - 1e-3
    slope = (inner(profile.end) ** 2 - inner(before) ** 2) / 1e-3
    return inner, profile.end - inner(profile.end) ** 2 / slope


def followed(n: int, radii, share: float) -> list[Row]:
    """Without contact, to a share of the time in which the hole closes."""
    inner, closing = reference(radii)
    times = share * closing * np.array([0.5, 1.0])
    motion, method = js.MeanCurvatureFlow(keep_volume=True), js.GFDM(degree=4)
    spacing = 2 * np.pi * np.sqrt(radii[0] * radii[1] / n)
    run = js.evolve(
        motion,
        js.torus(n, *radii),
        t1=times[-1],
        saveat=times[:-1],
        method=method,
        adapt=js.Adaptation(spacing, capacity=int(1.2 * n)),
    )
    found = [narrowest(surface) for surface in run.surfaces]
    error = max(abs(r - inner(t)) for r, t in zip(found, times))
    setting = {"torus": radii, "n": n, "t": round(times[-1], 3)}
    drift = float(np.ptp(run.history["volume"])) / float(run.history["volume"][0])
    bound = 1e-3 if n >= 10_000 else 2e-2
    source = "profile"
    return [
        Row("error of the inner radius", error, setting, None, source, bound),
        Row("drift of the volume", drift, setting, None, "0.1 %", 1e-3),
        Row("time of closing, of the profile", closing, setting),
    ]


def closed(spacing: float, radii, t1: float, saveat) -> tuple[list[Row], js.Evolution]:
    """With contact: the hole closes, and a ball is left."""
    n = round(4 * np.pi**2 * radii[0] * radii[1] / spacing**2)
    adapt = js.Adaptation(spacing, capacity=int(1.3 * n))
    given = dict(method=js.GFDM(degree=2), rtol=1e-4, atol=1e-6, adapt=adapt)
    run = js.evolve(
        js.MeanCurvatureFlow(keep_volume=True),
        js.torus(n, *radii),
        t1=t1,
        saveat=saveat,
        contact=js.Contact(5 * spacing),
        **given,  # type: ignore[arg-type]
    )
    events, end = run.history["events"], run.surfaces[-1]
    when = events["t"][events["joined"] > 0]
    total = float(end.integrate(end.gauss_curvature)) / (4 * np.pi)
    volume, area = float(run.history["volume"][-1]), float(run.history["area"][-1])
    setting = {"torus": radii, "n": n, "spacing": spacing, "t": t1}
    return [
        Row("time at which the hole is closed", when.min(initial=np.inf), setting),
        Row("|total curvature / 4 pi - 1|", abs(total - 1), setting, None, "genus 0", 0.1),
        Row("36 pi V² / A³ (1 of a sphere)", 36 * np.pi * volume**2 / area**3, setting),
    ], run


def run(quick: bool, out: Path) -> list[Row]:
    if quick:
        rows = followed(800, (2.5, 1.0), 0.25)
        more, solution = closed(0.22, (1.8, 1.0), 0.5, [0.0, 0.3])
    else:
        rows = followed(10_000, _TORUS, 0.9)
        more, solution = closed(0.15, _TORUS, 10.0, [0.0, 4.0, 4.5, 5.0, 6.0])
    js.plot_series(solution.clouds, times=solution.ts, path=out / "e17.png", view=(0.7, -1, 1))
    return rows + more
