r"""Turing patterns of Schnakenberg's reaction: onset on the sphere, and what grows on the bunny.

$$\partial_t u = \ell^2 \Delta_S u + a - u + u^2 v, \qquad
  \partial_t v = d\,\ell^2 \Delta_S v + b - u^2 v$$

(Schnakenberg 1979) with a = 0.1, b = 0.9, d = 10, the unit of time that of the reaction. At rest
u = a + b and v = b / (a + b)^2, which is stable without diffusion. With it a mode
$-\Delta_S \phi = \lambda \phi$ grows at the rate σ(λ), the larger eigenvalue of
$J - \lambda \ell^2 \mathrm{diag}(1, d)$, positive for $0.2 < \lambda \ell^2 < 0.5$
(Murray, Mathematical Biology II, Section 2.3).

What holds beyond the onset: u stays above a, by the maximum principle; and once the pattern stands
still the mean of u is a + b, because reactions cancel and diffusion keeps the mass.
"""

from __future__ import annotations

import time
from pathlib import Path

import diffrax as dfx
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from scipy.special import eval_legendre
from tqdm import tqdm

import jaxsurf as js

from . import data
from .report import Row, method_name, slope

_A, _B, _RATIO = 0.1, 0.9, 10.0
_REST = np.array([_A + _B, _B / (_A + _B) ** 2])
_SOURCE = "linear stability"


def reaction(t, state, args):
    u, v = state.T
    turnover = u * u * v
    return jnp.stack([_A - u + turnover, _B - turnover], axis=1)


def system(laplacian: js.Stencil, length: float, mass=None) -> js.AdvectionDiffusionReaction:
    diffusivity = length**2 * jnp.array([1.0, _RATIO])
    return js.AdvectionDiffusionReaction(
        laplacian, diffusivity=diffusivity, reaction=reaction, mass=mass
    )


def growth(scaled: float) -> tuple[complex, np.ndarray]:
    r"""σ, and the shares of u and v that grow together, for $\lambda\ell^2$."""
    jacobian = np.asarray(jax.jacfwd(lambda w: reaction(0, w[None], None)[0])(jnp.asarray(_REST)))
    values, vectors = np.linalg.eig(jacobian - scaled * np.diag([1.0, _RATIO]))
    leading = np.argmax(values.real)
    return values[leading], vectors[:, leading].real


def run(quick: bool, out: Path) -> list[Row]:
    figure, axes = plt.subplots(
        1, 3, figsize=(14, 4.2), width_ratios=(1, 1.1, 1.1), layout="constrained"
    )
    rows = _onset([2_000, 4_000] if quick else [2_000, 4_000, 8_000], axes[0])
    if quick:
        for ax in axes[1:]:
            ax.remove()
    else:
        rows += _bunny(10_000, axes[1:])
    figure.savefig(out / "turing.png", dpi=150)
    plt.close(figure)
    return rows


# --- onset ---------------------------------------------------------------------------------


def _onset(sizes: list[int], ax) -> list[Row]:
    """Zonal harmonics about a tilted axis, each so small that nothing but its growth is seen."""
    length, method = 200**-0.5, js.DCPSE(order=4)
    scaled = lambda degree: degree * (degree + 1) * length**2
    degrees = np.arange(5, 12)
    theory = np.array([growth(scaled(degree))[0].real for degree in degrees])
    growing, top = theory > 0, int(np.argmax(theory))
    rows, errors = [], []
    for n in tqdm(sizes, desc="turing, sphere"):
        cloud = js.sphere(n)
        problem = system(js.laplace_beltrami(cloud, method=method), length)
        height = np.asarray(cloud.points) @ np.array([0.36, 0.48, 0.8])
        seen = np.array(
            [_rate(problem, eval_legendre(d, height), growth(scaled(d))[1]) for d in degrees]
        )
        setting = {"surface": "sphere", "n": n, "method": method_name(method)}
        errors.append(float(np.abs(seen - theory)[growing].max() / theory[top]))
        which = {"degrees": f"{degrees[growing][0]} to {degrees[growing][-1]}"}
        rows += [
            Row("growth rate of the fastest harmonic", float(seen[top]),
                setting | {"degree": int(degrees[top])}, float(theory[top]), _SOURCE),
            Row("largest error of a growth rate over the largest rate", errors[-1],
                setting | which, None, _SOURCE, 1e-2 if n == sizes[-1] else None),
        ]  # fmt: skip
    # λ is found with the order of the method, and the rate is a smooth function of it.
    order = slope(np.array(sizes) ** -0.5, errors)
    setting = {"surface": "sphere", "n": f"{sizes[0]} to {sizes[-1]}"}
    rows.append(Row("order of that error, at least", order, setting, None, "order of the method",
                    3.8, True))  # fmt: skip

    curve = np.linspace(degrees[0] - 0.3, degrees[-1] + 0.3, 200)
    ax.axhline(0, color="0.7", linewidth=0.8)
    ax.plot(curve, [growth(scaled(degree))[0].real for degree in curve], label="theory")
    ax.plot(degrees, seen, "ko", label=f"seen, {sizes[-1]:,} points", markersize=5)
    ax.set_xlabel("degree of the harmonic")
    ax.set_ylabel("growth rate")
    ax.set_title("onset on the sphere", fontsize="medium")
    ax.legend(frameon=False)
    return rows


def _rate(problem, mode, shares, end: float = 10.0, tiny: float = 1e-6) -> float:
    """Observed growth rate of a small multiple of a mode."""
    start = jnp.asarray(_REST + tiny * mode[:, None] * shares)
    # Second order in time: an error of (σ dt)² / 6 of the rate, 3e-5 for the fastest.
    end_state = js.integrate(problem, start, t1=end, dt0=0.25, solver=js.RKC2()).ys[-1]
    grown = mode @ (np.asarray(end_state) - _REST) @ shares
    return float(np.log(grown / (tiny * (mode @ mode) * (shares @ shares))) / end)


# --- pattern -------------------------------------------------------------------------------


def _bunny(n: int, axes) -> list[Row]:
    scan, method = data.bunny(n), js.DCPSE(order=2)
    # As if closed: points at the holes below get one-sided stencils and no condition.
    cloud = js.PointCloud(scan.points, scan.normals)
    neighbors = js.choose_neighbors(cloud, method=method)
    laplacian = js.laplace_beltrami(cloud, neighbors, method=method)
    size = float(jnp.max(jnp.ptp(cloud.points, axis=0)))
    length, end = 0.0125 * size, 400.0  # which is repeated every 11 lengths or so
    weights = jnp.ones(cloud.n) / cloud.n  # the points are spread evenly
    problem = system(laplacian, length, mass=weights)
    noise = np.random.default_rng(0).normal(size=(cloud.n, 2))
    start = jnp.asarray(_REST * (1 + 0.02 * noise))
    times = (40.0, end)
    clock = time.perf_counter()
    solution = js.integrate(problem, start, t1=end, rtol=1e-4, saveat=dfx.SaveAt(ts=times))
    states = np.asarray(solution.ys)
    seconds = time.perf_counter() - clock
    for ax, t, state in zip(axes, times, states):
        js.plot_cloud(cloud, state[:, 0], ax=ax, title=f"u on the bunny, t = {t:g}",
                      cmap="YlGnBu_r", view=(0.35, 0.3, 1.0), up=(0.0, 1.0, 0.0))  # fmt: skip
    u = states[-1, :, 0]
    rate = np.asarray(problem.rate(end, jnp.asarray(states[-1]), None))
    maxima = _maxima(u, neighbors)
    setting = {"surface": "bunny", "n": cloud.n, "method": method_name(method)}
    spectrum = js.spectral_estimate(laplacian)
    return [
        Row("largest real part of the Laplacian over its radius",
            spectrum.abscissa / spectrum.radius, setting, None, "stability", 1e-6),
        Row("smallest u, at least", float(states[..., 0].min()), setting, None,
            "maximum principle", _A, True),
        Row("largest u less the smallest, at least", float(np.ptp(u)), setting, None, "project",
            1.0, True),
        Row("mean of u less a + b", abs(float(u.mean()) - _REST[0]), setting, 0.0,
            "balance of masses", 1e-3),
        Row("rate of change, root mean square", float(np.sqrt(np.mean(rate**2))), setting),
        Row("local maxima of u", float(maxima), setting),
        Row("steps", float(solution.stats["num_steps"]), setting),
        Row("seconds to integrate, compilation included", seconds, setting),
    ]  # fmt: skip


def _maxima(u: np.ndarray, neighbors: js.Neighbors) -> int:
    """Points above the middle that no neighbour exceeds."""
    highest = u[np.asarray(neighbors.indices)].max(axis=1)
    return int(np.sum((u >= highest) & (u > (u.min() + u.max()) / 2)))
