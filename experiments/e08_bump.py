r"""Diffusion over a bump, compared with fine finite elements (paper 001, Section 4.5, Figs. 5, 6).

Two sets of points. The paper's: a regular grid with h = 1/32 = 0.03125 outside the bump and a
golden-angle spiral of equal areas on it, 18,439 in all; as many as the paper has, which leaves
1,995 for the bump. And graded ones, 10,368 to 18,683 of them: a spiral around the bump, fine as far
as the initial field reaches, coarser towards the border.

The paper's own parameters are held to the paper's distances like all others; where they fall short
a row says so.

Peaks are largest values over time at the probes. The width of the paper's kernel is not
given: here h. What the paper reports are distances to surface FEM; ours are to the
reference of `bump_reference`, whose own error is a row of its own.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import diffrax as dfx
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from jaxtyping import Array
from tqdm import tqdm

import jaxsurf as js

from . import bump_reference as bump
from .cutoff import smooth_support
from .report import Row, method_name

_SPACING = 1 / 32
_POINTS = 18_439
_END = 1.0
# Times at which the probes are looked at; the peaks lie between 0.05 and 0.1.
_TIMES = np.concatenate([np.linspace(0, 0.2, 101), np.linspace(0.2, _END, 41)[1:]])
_SOURCE = "paper 001, Section 4.5"
_BEST = js.GFDM(degree=4)
_PUBLISHED = {("x0", 0): 7e-4, ("x1", 0): 7e-4, ("x0", 1): 2.6e-3, ("x1", 1): 1.2e-2}


def bump_cloud(alpha: float, n: int = _POINTS, spacing: float = _SPACING) -> js.PointCloud:
    """A regular grid around the bump, a spiral on it that begins at the top."""
    side = round(2 * bump.HALF / spacing) + 1
    line = np.linspace(-bump.HALF, bump.HALF, side)
    grid = np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2)
    grid = grid[np.linalg.norm(grid - bump.CENTRE, axis=1) > bump.RADIUS * (1 - 1e-9)]
    count = n - len(grid)
    d = np.linspace(0, 1, 4001)
    strip = d * _stretch(alpha, d)
    area = np.concatenate([[0], np.cumsum((strip[1:] + strip[:-1]) / 2)])
    spiral, _ = _spiral(bump.RADIUS * np.interp(np.arange(count) / count, area / area[-1], d))
    return _lifted(alpha, np.concatenate([spiral, grid]))


def graded_cloud(alpha: float, fine: float, growth: float = 0.055) -> js.PointCloud:
    """A golden-angle spiral around the bump whose spacing grows outwards, and the border.

    Args:
        alpha: height of the bump.
        fine: spacing on the surface within a radius of 0.78.
        growth: of the spacing, per length beyond that radius.
    """

    def spacing(radius):
        return fine + growth * np.maximum(radius - 0.78, 0)

    radius = np.linspace(0, 3.8, 40_001)
    strip = 2 * np.pi * radius * _stretch(alpha, radius / bump.RADIUS)
    # On a hexagonal lattice of this spacing there would be 2/√3 points in a unit of area.
    density = 1.04 * strip / spacing(radius) ** 2
    count = np.concatenate([[0], np.cumsum((density[1:] + density[:-1]) / 2 * np.diff(radius))])
    xy, radius = _spiral(np.interp(np.arange(int(count[-1])), count, radius))
    inside = np.abs(xy).max(axis=1) < bump.HALF - 0.6 * spacing(radius)

    def side(start, step):
        """From one corner to before the next."""
        places = [0.0]
        while places[-1] < 2 * bump.HALF:
            here = start + places[-1] * step
            places.append(places[-1] + spacing(np.linalg.norm(here - bump.CENTRE)))
        places = 2 * bump.HALF * np.array(places[:-1]) / places[-1]
        return start + places[:, None] * step

    corners = bump.HALF * np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    steps = np.array([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]])
    border = [side(corner, step) for corner, step in zip(corners, steps)]
    return _lifted(alpha, np.concatenate([xy[inside], *border]))


def _spiral(radius):
    angle = np.pi * (3 - np.sqrt(5)) * np.arange(len(radius))
    around = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return bump.CENTRE + radius[:, None] * around, radius


def _stretch(alpha: float, d):
    """Length on the surface per length in the plane, going outwards from the top."""
    slope = jax.vmap(jax.grad(lambda d: alpha * bump.zeta(d * d) / bump.RADIUS))(jnp.asarray(d))
    return np.sqrt(1 + np.asarray(slope) ** 2)


def _lifted(alpha: float, xy) -> js.PointCloud:
    z, slopes = jax.vmap(jax.value_and_grad(lambda p: bump.height(alpha, p[0], p[1])))(xy)
    normals = np.concatenate([-np.asarray(slopes), np.ones((len(xy), 1))], axis=1)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    border = np.abs(xy).max(axis=1) > bump.HALF - 1e-9
    points = np.concatenate([xy, np.asarray(z)[:, None]], axis=1)
    return js.sort_cloud(js.PointCloud(points, normals, boundary=border))[0]


def probe_weights(cloud: js.PointCloud, count: int = 40) -> tuple[Array, Array]:
    """Values at both probes from the nearest points: local polynomials of degree 4."""
    xy = np.asarray(cloud.points)[:, :2]
    indices, weights = [], []
    for place in bump.PROBES.values():
        offset = xy - place
        near = np.argsort(np.linalg.norm(offset, axis=1))[:count]
        offset = offset[near]
        if np.linalg.norm(offset[0]) < 1e-12:
            value = np.eye(count)[0]
        else:
            scale = np.linalg.norm(offset, axis=1).max()
            x, y = offset.T / scale
            basis = np.stack([x**i * y**j for i in range(5) for j in range(5 - i)], axis=1)
            decay = np.exp(-4 * (x**2 + y**2))
            value = (
                decay * np.linalg.lstsq((basis * decay[:, None]).T, np.eye(15)[0], rcond=None)[0]
            )
        indices.append(near)
        weights.append(value)
    return jnp.asarray(np.array(indices)), jnp.asarray(np.array(weights))


@dataclass(frozen=True)
class Discretisation:
    """Operator, conditions and how they were made."""

    name: str
    cloud: js.PointCloud
    laplacian: js.Stencil
    closure: js.Closure

    @property
    def n(self) -> int:
        return self.cloud.n


def papers(alpha: float, cloud: js.PointCloud) -> Discretisation:
    """The paper's parameters: order 2, 3 layers h apart, cut off at 2.9 h, images."""
    support = smooth_support(2.9 * _SPACING)
    method = js.DCPSE(order=2, layers=3, layer_spacing=_SPACING, width=_SPACING / support)
    return ghosts("paper's parameters", cloud, method, support)


def ghosts(name, cloud, method, support) -> Discretisation:
    conditions = js.neumann(cloud.boundary)
    wide, closure = js.with_ghosts(cloud, conditions, depth=support)
    neighbors = js.find_neighbors(wide, radius=support)
    laplacian = js.laplace_beltrami(wide, neighbors, method=method, throw=False)
    return Discretisation(name, cloud, laplacian, closure)


def one_sided(name: str, cloud: js.PointCloud) -> Discretisation:
    """Our most accurate stencils; at the border one-sided ones of the same kind."""
    closure = js.eliminate(cloud, js.neumann(cloud.boundary), method=_BEST)
    neighbors = js.choose_neighbors(cloud, method=_BEST, bound=closure.bound)
    laplacian = js.laplace_beltrami(cloud, neighbors, method=_BEST)
    return Discretisation(f"{name}, {method_name(_BEST)}", cloud, laplacian, closure)


class _Counted(js.AdvectionDiffusionReaction):
    """Counts the evaluations of its right-hand side."""

    def rate(self, t, u, args):
        jax.debug.callback(args)
        return super().rate(t, u, args)


@dataclass(frozen=True)
class Outcome:
    """The field at the probes, and what it took.

    Args:
        history: values over time.
        evaluations: of the right-hand side, those of refused steps included.
        seconds: of a second run, None if there was none.
    """

    history: bump.History
    evaluations: int
    seconds: float | None


def diffuse(way: Discretisation, *, timed: bool = True, **how) -> Outcome:
    """Diffusion up to t = 1; `how` is passed on to `js.integrate`."""
    indices, weights = probe_weights(way.cloud)
    ghosts = jnp.zeros(way.laplacian.n - way.n)
    u0 = jnp.concatenate([bump.initial(way.cloud.points), ghosts])
    probes = dfx.SaveAt(ts=_TIMES, fn=lambda t, u, args: jnp.sum(weights * u[indices], axis=1))
    calls = 0

    def call():
        nonlocal calls
        calls += 1

    def solve(problem, args=None):
        found = js.integrate(problem, u0, t1=_END, saveat=probes, args=args, **how)
        return jax.block_until_ready(found)

    counted = _Counted(way.laplacian, closure=way.closure)
    found = solve(counted, call)
    jax.effects_barrier()
    seconds = None
    if timed:
        plain = js.AdvectionDiffusionReaction(way.laplacian, closure=way.closure)
        solve(plain)
        start = time.perf_counter()
        solve(plain)
        seconds = time.perf_counter() - start
    values = dict(zip(bump.PROBES, np.asarray(found.ys).T))
    return Outcome(bump.History(np.asarray(found.ts), values, way.n), calls, seconds)


@dataclass(frozen=True)
class Way:
    """How to solve it, and what is asked for.

    Args:
        make: the discretisation for a height.
        tolerance: of the steps in time.
        share: of the published distance that ours may have.
        evaluations: largest number.
    """

    make: Callable[[float], Discretisation]
    tolerance: float
    share: float
    evaluations: int | None = None


_WAYS = [
    Way(lambda alpha: papers(alpha, bump_cloud(alpha)), 1e-5, 1.0),
    Way(lambda alpha: one_sided("paper's points", bump_cloud(alpha)), 1e-5, 1.0),
    Way(lambda alpha: one_sided("graded points", graded_cloud(alpha, 0.02)), 3e-4, 1.0, 1_200),
    Way(lambda alpha: one_sided("graded points", graded_cloud(alpha, 0.015)), 1e-5, 0.2),
]
# Half as many points as the coarsest of these, which the published distances have room for.
_QUICK = Way(lambda alpha: one_sided("graded points", graded_cloud(alpha, 0.03)), 3e-4, 1.0, 1_200)


def run(quick: bool, out: Path) -> list[Row]:
    heights = [1] if quick else [0, 1, 2]
    fine = (0.03, 0.02) if quick else (0.01, 0.0067)
    rows: list[Row] = []
    drawn: list[tuple[int, bump.History, bump.History]] = []
    for alpha in tqdm(heights, desc="E8"):
        coarse, reference = (bump.solve(alpha, spacing=spacing) for spacing in fine)
        for probe in bump.PROBES:
            change = abs(reference.peak(probe) - coarse.peak(probe))
            setting = {"height": alpha, "probe": probe, "unknowns": int(reference.unknowns)}
            quantity = f"change of the reference's peak, spacing {fine[0]} to {fine[1]}"
            rows.append(Row(quantity, change, setting))
        for way in [_QUICK] if quick else _WAYS:
            made = way.make(alpha)
            ours = diffuse(made, timed=not quick, rtol=way.tolerance, atol=way.tolerance)
            setting = {"height": alpha, "n": made.n, "way": made.name, "tolerance": way.tolerance}
            rows += _outcome(ours, reference, setting, way)
        drawn.append((alpha, ours.history, reference))
    if not quick:  # as in the paper: 10,000 steps of six evaluations
        made = papers(1, bump_cloud(1))
        setting = {"height": 1, "n": made.n, "way": f"{made.name}, Dormand-Prince"}
        theirs = diffuse(made, solver=dfx.Dopri5(), dt0=1e-4)
        rows += _outcome(theirs, drawn[1][2], setting, Way(papers, 0, 1.0))
    _draw(out / "E8.png", drawn)
    return rows


def _outcome(ours: Outcome, reference: bump.History, setting, way: Way) -> list[Row]:
    rows = []
    for probe in bump.PROBES:
        published = _PUBLISHED.get((probe, setting["height"]))
        bound = None if published is None else way.share * published
        distance = abs(ours.history.peak(probe) - reference.peak(probe))
        place = {**setting, "probe": probe}
        rows.append(Row("distance of the peak", distance, place, published, _SOURCE, bound))
    quantity = "evaluations of the right-hand side"
    rows.append(Row(quantity, ours.evaluations, setting, 60_000, _SOURCE, way.evaluations))
    if ours.seconds is not None:
        rows.append(Row("wall time, s", ours.seconds, setting))
    return rows


def _draw(path: Path, drawn) -> None:
    """Values at the probes over time, as in the paper's Figure 6."""
    figure, axes = plt.subplots(1, 2, figsize=(9, 3.6), layout="constrained")
    for ax, probe in zip(axes, bump.PROBES):
        for number, (alpha, ours, reference) in enumerate(drawn):
            color = f"C{number}"
            ax.plot(ours.times, ours.values[probe], color=color, label=f"height {alpha}")
            some = np.linspace(0, 1, 26) ** 1.5
            ax.plot(some, reference.at(probe, some), "o", color=color, fillstyle="none", ms=4)
        ax.set_xlabel("time")
        ax.set_title(f"at {probe}", fontsize="medium")
    axes[0].set_ylabel("value at the probe")
    axes[1].legend(frameon=False, title="lines: points, circles: finite elements", fontsize=8)
    figure.savefig(path, dpi=150)
    plt.close(figure)
