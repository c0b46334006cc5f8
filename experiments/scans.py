r"""Scans as they come: the demo's computations on all of them, heat and time told.

The meshes handed out beside the project, and surfaces of our own with what is wrong with scans:
several parts, holes, edges of three triangles, 300,000 vertices, bare points with and without
noise. Each is written to a file and read as a user would read it. Heat spreads from a hot spot over
a hundredth of the squared size, without flux through borders: by the Laplacian of the default
method and by the symmetric one.
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import diffrax as dfx
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from jaxtyping import Array, Float
from tqdm import tqdm

import jaxsurf as js
from jaxsurf.heat import spot

from . import data, rough, surfaces
from .report import Row

# Of the issue: what the default may lose or make of the heat, and the symmetric operator.
_LOST, _ROUND_OFF = 0.01, 1e-12
_FRAMES = 11


class Case(NamedTuple):
    """A kind of scan, a name, and how a user makes a cloud of it."""

    kind: str
    name: str
    cloud: Callable[[], js.PointCloud]


def _cases(quick: bool, folder: Path) -> Iterator[Case]:
    n, big = 1_500 if quick else 10_000, 300_000
    star, ring = rough.star(4 * n), rough.ring(4 * n)

    def read(mesh: rough.Mesh, **how) -> Callable[[], js.PointCloud]:
        return lambda: js.read(rough.write(folder / "scan.obj", mesh), **{"n": n, **how})

    drops = [rough.moved(rough.star(2 * n), (x, 0.0, 0.0), 0.6) for x in (-0.7, 0.7)]
    # Farther apart than stencils reach: where normals agree, other parts count as neighbours.
    around = rough.ring(4 * n, R=3.0)
    yield Case("parts", "star in a ring", read(rough.together(star, around)))
    yield Case("holes", "star with four holes", read(rough.holed(star, [0.5, 0.3, 0.2, 0.1])))
    yield Case("wide edges", "star with a fin", read(rough.finned(star), largest_part=True))
    yield Case("bare points", "star, 2 % noise", lambda: _bare(rough.star(n)[0], 0.02))
    if quick:
        return
    shell = rough.moved(star, (0.0, 0.0, 0.0), 2.5)
    yield Case("parts", "two drops in a shell", read(rough.together(*drops, shell)))
    yield Case("holes", "ring with twenty holes", read(rough.holed(ring, 20 * [0.25])))
    yield Case(
        "wide edges", "ring with a wall", read(rough.ring(4 * n, wall=True), largest_part=True)
    )
    yield Case("bare points", "star, 10 % noise", lambda: _bare(rough.star(n)[0], 0.1))
    random = surfaces.torus().uniform(n)
    yield Case("bare points", "torus, random", lambda: js.from_points(jnp.asarray(random)))
    for name, scan in (("bunny", data.bunny), ("Armadillo", data.armadillo), ("Spot", data.spot)):
        yield Case("scan", f"{name}, even", lambda scan=scan: scan(n))
        yield Case("scan", f"{name}, its own points", scan)
    yield Case("large", "star", read(rough.star(big), n=None))
    yield Case("large", "ring", read(rough.ring(big), n=None))


def _bare(points: np.ndarray, share: float) -> js.PointCloud:
    """Normals of fits that average over the noise."""
    area = float(np.pi * np.ptp(points, axis=0).max() ** 2)
    return js.from_points(jnp.asarray(rough.noisy(points, share, area)), degree=2, k=40)


def _timed(seconds: dict[str, float], name: str, work: Callable):
    start = time.perf_counter()
    found = jax.block_until_ready(work())
    seconds[name] = time.perf_counter() - start
    return found


def _spread(operator, closure, start, until: float) -> Float[Array, "frames n"]:
    problem = js.AdvectionDiffusionReaction(operator, closure=closure)
    frames = dfx.SaveAt(ts=jnp.linspace(0, until, _FRAMES))
    return js.integrate(problem, start, t1=until, saveat=frames).ys


def _measured(case: Case) -> tuple[list[Row], js.PointCloud, Float[Array, " n"]]:
    seconds: dict[str, float] = {}
    cloud = _timed(seconds, "points", case.cloud)
    surface = _timed(seconds, "neighbours", lambda: js.discretize(cloud))
    operator = _timed(seconds, "operator", lambda: surface.laplacian)
    _timed(seconds, "curvature", lambda: (surface.mean_curvature, surface.gauss_curvature))
    masses = _timed(seconds, "areas", lambda: surface.cell_areas)
    symmetric = _timed(seconds, "symmetric operator", lambda: surface.symmetric_laplacian)

    closure = js.without_flux(surface)
    x = np.asarray(cloud.points)
    size = np.ptp(x, axis=0).max()
    start = spot(cloud, int(np.argmin(np.linalg.norm(x - x.mean(axis=0), axis=1))), size / 10)
    until = float(size**2 / 100)
    heat = _timed(seconds, "heat", lambda: _spread(operator, closure, start, until))
    even = _timed(seconds, "symmetric heat", lambda: _spread(symmetric, None, start, until))
    held = operator if closure is None else closure.reduce(operator)
    spectrum = _timed(seconds, "spectrum", lambda: js.spectral_estimate(held))

    setting = {"kind": case.kind, "surface": case.name, "n": cloud.n}
    rows = []
    for name, u, lost in (("default", heat, _LOST), ("symmetric", even, _ROUND_OFF)):
        content, peak = np.asarray(u @ masses), np.asarray(jnp.abs(u).max(axis=1))
        which = setting | {"operator": name}
        rows += [
            Row("heat lost or made", float(np.abs(content / content[0] - 1).max()), which, None,
                "issue 11", lost),
            Row("largest growth of the maximum over it", float((np.diff(peak) / peak[0]).max()),
                which, None, "project", 1e-6),
        ]  # fmt: skip
    right = spectrum.abscissa / spectrum.radius
    which = setting | {"operator": "default"}
    rows.append(Row("largest real part over spectral radius", right, which, None, "project", 1e-8))
    rows += [Row(f"seconds, {name}", spent, setting) for name, spent in seconds.items()]
    return rows, cloud, heat[-1]


def run(quick: bool, out: Path) -> list[Row]:
    rows, pictures = [], []
    with TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # repairs, and folds within one stencil
        for case in tqdm(_cases(quick, Path(folder)), desc="scans"):
            try:
                found, *picture = _measured(case)
            except FileNotFoundError as error:
                print(f"without {case.name}: {error}")
                continue
            rows += found
            pictures.append((case, *picture))
    _picture(out / "scans.png", pictures)
    return rows


def _picture(path: Path, pictures: list) -> None:
    """Heat at the end, seen from where it is."""
    columns = min(5, len(pictures))
    lines = -(-len(pictures) // columns)
    size = (3.4 * columns, 3.2 * lines)
    figure, axes = plt.subplots(lines, columns, figsize=size, layout="constrained", squeeze=False)
    for ax in axes.ravel():
        ax.set_axis_off()
    for ax, (case, cloud, heat) in zip(axes.ravel(), pictures):
        # Scans are stored with y up.
        up = np.array([0.0, 1.0, 0.0] if case.kind == "scan" else [0.0, 0.0, 1.0])
        view = np.asarray(cloud.normals)[np.argmax(heat)]
        view = view - (view @ up) * up
        view = view / np.linalg.norm(view) + 0.6 * up
        js.plot_cloud(
            cloud, heat, ax=ax, title=case.name, up=tuple(up), view=tuple(view), pixels=400
        )
    figure.savefig(path, dpi=120)
    plt.close(figure)
