r"""Two unit spheres move into each other (paper 002, Section 3.7.3).

Centres 2.2 apart, $v = (-0.5\,\mathrm{sign}(x), 0, 0)$. Kept apart, each is flattened against the
other; cut, they become one (there the sign is a ramp over a spacing on both sides, so that points
of the one surface do not run past each other where its velocity jumps). The paper shows pictures;
here it is counted what has crossed, and told what topology the Gauss curvature of the result has.
"""

from __future__ import annotations

from pathlib import Path

import jax.numpy as jnp
import numpy as np
from scipy.spatial import cKDTree

import jaxsurf as js
from jaxsurf.moving.contact import chambers, facing

from .report import Row

_METHOD = js.GFDM(degree=2)
_SPEED, _APART = 0.5, 2.2
# A spacing is half a smoothing length.
_SMOOTHING = 0.1


def _approaching(t, surface, fields, ramp):
    x = surface.cloud.points[:, 0]
    return jnp.stack([-_SPEED * jnp.clip(x / ramp, -1, 1), 0 * x, 0 * x], axis=1)


def spheres(n: int) -> js.PointCloud:
    """Two of n points each, the second the mirror image of the first."""
    x = np.asarray(js.sphere(n).points)
    mirrored = x * np.array([-1, 1, 1])
    half = np.array([_APART / 2, 0, 0])
    return js.PointCloud(np.concatenate([x - half, mirrored + half]), np.concatenate([x, mirrored]))


def kept_apart(cloud: js.PointCloud, distance: float, times) -> tuple[list[Row], js.Evolution]:
    contact = js.Contact(distance, kind="non-penetration")
    motion, setting = js.Motion(_approaching), {"kind": "non-penetration", "n": cloud.n}
    setting["distance"] = distance
    run = js.evolve(
        motion,
        cloud,
        t1=times[-1],
        saveat=times[:-1],
        method=_METHOD,
        contact=contact,
        rtol=1e-4,
        args=1e-9,
    )
    left = np.arange(cloud.n) < cloud.n // 2
    points = [np.asarray(one.points) for one in run.clouds]
    crossed = sum(int(np.sum(x[left, 0] > 0) + np.sum(x[~left, 0] < 0)) for x in points)
    gap = min(cKDTree(x[left]).query(x[~left])[0].min() for x in points)
    source = "paper 002, Section 3.7.3: no crossing"
    return [
        Row("points that have crossed, at any time", crossed, setting, None, source, 0),
        Row("least gap / distance, at least", gap / distance, setting, None, source, 0.9, True),
    ], run


def made_one(
    cloud: js.PointCloud, spacing: float, distance: float, times
) -> tuple[list[Row], js.Evolution]:
    """Finer near the plane where they meet, as in the paper."""

    def wanted(t, surface, fields, args):
        away = jnp.abs(surface.cloud.points[:, 0])
        return spacing * jnp.clip(0.5 + away, 0.5, 1)

    given = dict(adapt=js.Adaptation(wanted, capacity=int(1.4 * cloud.n)), method=_METHOD)
    setting = {"kind": "delete", "n": cloud.n, "distance": distance}
    run = js.evolve(
        js.Motion(_approaching),
        cloud,
        t1=times[-1],
        saveat=times[:-1],
        contact=js.Contact(distance),
        rtol=1e-4,
        args=spacing,
        **given,  # type: ignore[arg-type]
    )
    end = run.surfaces[-1]
    total = float(end.integrate(end.gauss_curvature)) / (4 * np.pi)
    parts = int(chambers(end.cloud, end.neighbors).max()) + 1
    source = "paper 002, Section 3.7.3: one surface"
    left = len(facing(end.cloud, 0.5 * distance).pairs)
    rows = [
        Row("parts at the end", parts, setting, None, source, 1),
        Row("|total curvature / 4 pi - 1|", abs(total - 1), setting, None, source, 0.15),
        Row("pairs left within half the distance", left, setting, None, source, 0),
    ]
    return rows, run


def run(quick: bool, out: Path) -> list[Row]:
    n = 600 if quick else 15_018 // 2
    spacing = np.sqrt(4 * np.pi / n)
    rows, apart = kept_apart(spheres(n), 0.2 * _SMOOTHING if not quick else 0.1, (0.3, 0.6))
    more, one = made_one(spheres(n), spacing, 2 * spacing, (0.3, 0.4))
    for name, series in (("apart", apart), ("one", one)):
        depth = [np.abs(np.asarray(c.points)[:, 0]) for c in series.clouds]
        # From aside: in front of each other they would seem to have crossed.
        path, view = out / f"e11_{name}.png", (0.0, -1.7, 0.3)
        js.plot_series(series.clouds, depth, times=series.ts, path=path, label="|x|", view=view)
    return rows + more
