r"""Diffusion over a bump, compared with fine finite elements (paper 001, Section 4.5, Figs. 5, 6).

The points: a regular grid with h = 1/32 = 0.03125 outside the bump and a golden-angle spiral of
equal areas on it, 18,439 in all; as many as the paper has, which leaves 1,995 for the bump.
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

TITLE = "Diffusion over a bump against fine surface finite elements (paper 001, Figs. 5, 6)"

_SPACING = 1 / 32
_POINTS = 18_439
_END = 1.0
# Times at which the probes are looked at; the peaks lie between 0.05 and 0.1.
_TIMES = np.concatenate([np.linspace(0, 0.2, 101), np.linspace(0.2, _END, 41)[1:]])
_SOURCE = "paper 001, Section 4.5"
# Tolerance in time: its share of the error is below that of the space.
_RTOL = 1e-5
# Our best at this number of points.
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
    slope = np.asarray(jax.vmap(jax.grad(lambda s: alpha * bump.zeta(s * s) / bump.RADIUS))(d))
    strip = d * np.sqrt(1 + slope**2)
    area = np.concatenate([[0], np.cumsum((strip[1:] + strip[:-1]) / 2)])
    k = np.arange(count)
    radius = bump.RADIUS * np.interp(k / count, area / area[-1], d)
    angle = np.pi * (3 - np.sqrt(5)) * k
    spiral = bump.CENTRE + radius[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    xy = np.concatenate([spiral, grid])
    z, slopes = jax.vmap(jax.value_and_grad(lambda p: bump.height(alpha, p[0], p[1])))(xy)
    normals = np.concatenate([-np.asarray(slopes), np.ones((n, 1))], axis=1)
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


def one_sided(cloud: js.PointCloud, method) -> Discretisation:
    """Neighbourhoods as the method chooses them; borders with stencils of its own order."""
    closure = js.close(cloud, js.neumann(cloud.boundary), method=method)
    neighbors = js.choose_neighbors(cloud, method=method, bound=closure.bound)
    laplacian = js.laplace_beltrami(cloud, neighbors, method=method)
    return Discretisation(method_name(method), cloud, laplacian, closure)


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
        seconds: of a second run.
    """

    history: bump.History
    evaluations: int
    seconds: float


def diffuse(way: Discretisation, **how) -> Outcome:
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

    counted = _Counted(way.laplacian, conditions=way.closure)
    found = solve(counted, call)
    jax.effects_barrier()
    plain = js.AdvectionDiffusionReaction(way.laplacian, conditions=way.closure)
    solve(plain)
    start = time.perf_counter()
    solve(plain)
    seconds = time.perf_counter() - start
    values = dict(zip(bump.PROBES, np.asarray(found.ys).T))
    return Outcome(bump.History(np.asarray(found.ts), values, way.n), calls, seconds)


def run(quick: bool, out: Path) -> list[Row]:
    heights = [1] if quick else [0, 1, 2]
    fine = (0.02, 0.014) if quick else (0.01, 0.0067)
    rows: list[Row] = []
    drawn: list[tuple[int, bump.History, bump.History]] = []
    for alpha in tqdm(heights, desc="E8"):
        coarse, reference = (bump.solve(alpha, spacing=spacing) for spacing in fine)
        cloud = bump_cloud(alpha)
        ways: list[tuple[Callable[[], Discretisation], float]] = [
            (lambda: papers(alpha, cloud), 1.0),  # noqa: B023
            (lambda: one_sided(cloud, _BEST), 5.0),  # noqa: B023
        ]
        for probe in bump.PROBES:
            change = abs(reference.peak(probe) - coarse.peak(probe))
            setting = {"height": alpha, "probe": probe, "unknowns": reference.unknowns}
            quantity = f"change of the reference's peak, spacing {fine[0]} to {fine[1]}"
            rows.append(Row(quantity, change, setting))
        for make, closer in ways:
            way = make()
            ours = diffuse(way, rtol=_RTOL, atol=_RTOL)
            for probe in bump.PROBES:
                setting = {"height": alpha, "probe": probe, "way": way.name}
                published = _PUBLISHED.get((probe, alpha))
                bound = None if published is None else published / closer
                distance = abs(ours.history.peak(probe) - reference.peak(probe))
                rows.append(
                    Row("distance of the peak", distance, setting, published, _SOURCE, bound)
                )
            setting = {"height": alpha, "way": way.name}
            quantity = "evaluations of the right-hand side"
            rows.append(Row(quantity, ours.evaluations, setting, 60_000, _SOURCE, 1_200))
            rows.append(Row("wall time, s", ours.seconds, setting))
        drawn.append((alpha, ours.history, reference))
        if alpha == 1 and not quick:
            setting = {"height": alpha, "way": f"{way.name}, Dormand-Prince, steps of 1e-4"}
            theirs = diffuse(way, solver=dfx.Dopri5(), dt0=1e-4)
            rows.append(Row("evaluations of the right-hand side", theirs.evaluations, setting))
            rows.append(Row("wall time, s", theirs.seconds, setting))
            for probe in bump.PROBES:
                distance = abs(theirs.history.peak(probe) - reference.peak(probe))
                rows.append(Row("distance of the peak", distance, {"probe": probe, **setting}))
    _draw(out / "E8.png", drawn)
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
