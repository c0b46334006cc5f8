r"""Separation of two phases on a torus: mass, energy, and the first growth of a mode.

$\partial_t u = \Delta_S(u^3 - u - \epsilon^2 \Delta_S u)$ (Cahn and Hilliard 1958) keeps the mass
and never raises the energy
$\int \tfrac14 (u^2 - 1)^2 + \tfrac12 \epsilon^2 |\nabla_S u|^2 \, dA$. Around u = m a mode
$-\Delta_S f = \lambda f$ grows at the rate $-\lambda (3 m^2 - 1 + \epsilon^2 \lambda)$. On a torus
with radii R and r the modes are $f(\theta) \cos(k \phi)$ with

$$-\frac{1}{r^2 g} (g f')' + \frac{k^2}{g^2} f = \lambda f, \qquad g = R + r \cos\theta,$$

which Fourier collocation solves to round-off: theory without a mesh.
"""

from __future__ import annotations

import time
from pathlib import Path

import diffrax as dfx
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import jaxsurf as js

from .report import Row, method_name

_R, _r = 1.0, 0.45
_MEAN = 0.1
_METHOD = js.DCPSE(order=2)


def mode(k: int, j: int, points, count: int = 48) -> tuple[float, np.ndarray]:
    """The j-th eigenvalue with k waves around the axis, and its mode at the points."""
    theta = 2 * np.pi * np.arange(count) / count
    waves = np.fft.fftfreq(count, 1 / count)
    waves[count // 2] = 0  # the derivative of the highest cosine vanishes on the grid
    derivative = np.fft.ifft(1j * waves[:, None] * np.fft.fft(np.eye(count), axis=0), axis=0).real
    g = _R + _r * np.cos(theta)
    operator = np.diag(k**2 / g**2) - derivative @ (g[:, None] * derivative) / (_r**2 * g[:, None])
    values, vectors = np.linalg.eig(operator)
    chosen = np.argsort(values.real)[j]
    x, y, z = np.asarray(points).T
    at = np.arctan2(z, np.hypot(x, y) - _R)
    coefficients = np.fft.fft(vectors[:, chosen].real) / count
    profile = (np.exp(1j * np.outer(at, waves)) @ coefficients).real
    profile /= np.abs(profile).max()
    return float(values[chosen].real), profile * np.cos(k * np.arctan2(y, x))


def run(quick: bool, out: Path) -> list[Row]:
    n, width, end = (1_500, 0.15, 1.0) if quick else (6_000, 0.08, 4.0)
    cloud = js.torus(n, _R, _r)
    laplacian = js.laplace_beltrami(cloud, method=_METHOD)
    # Rings of points as far apart as the points of a ring: all stand for the same area.
    weights = jnp.full(n, 4 * np.pi**2 * _R * _r / n)
    problem = js.CahnHilliard(laplacian, width=width, mass=weights)
    setting = {"surface": "torus", "n": n, "method": method_name(_METHOD), "width": width}
    rows = _growth(problem, cloud, setting)
    return rows + _separation(problem, cloud, end, setting, out)


def _growth(problem, cloud, setting) -> list[Row]:
    """A mode that grows, from a size at which its square is of no account."""
    end, tiny = 0.05, 1e-5
    eigenvalue, shape = mode(4, 2, cloud.points)
    rate = -eigenvalue * (3 * _MEAN**2 - 1 + float(problem.width) ** 2 * eigenvalue)
    start = jnp.asarray(_MEAN + tiny * shape)
    u = js.integrate(problem, start, t1=end, dt0=end / 50, solver=js.IMEX(order=3)).ys[-1]
    seen = float(np.log(shape @ (np.asarray(u) - _MEAN) / (tiny * (shape @ shape))) / end)
    return [
        Row("growth rate of a mode", seen, setting | {"eigenvalue": round(eigenvalue, 3)}, rate,
            "linear theory"),
        Row("its relative error", abs(seen / rate - 1), setting, None, "linear theory", 1e-2),
    ]  # fmt: skip


def _separation(problem, cloud, end, setting, out) -> list[Row]:
    noise = np.random.default_rng(0).normal(size=cloud.n)
    start = jnp.asarray(_MEAN + 0.1 * noise)
    times = np.concatenate([[0.0], np.geomspace(0.01, end, 60)])
    clock = time.perf_counter()
    solution = js.integrate(
        problem, start, t1=end, rtol=1e-3, atol=1e-4, saveat=dfx.SaveAt(ts=times)
    )
    states = np.asarray(solution.ys)
    seconds = time.perf_counter() - clock
    area = np.asarray(problem.mass)
    bent = [np.asarray(problem.laplacian(u)) for u in solution.ys]
    energy = np.array(
        [
            area @ ((u**2 - 1) ** 2 / 4 - 0.5 * problem.width**2 * u * laplacian)
            for u, laplacian in zip(states, bent)
        ]
    )
    mass = states @ area
    _draw(cloud, times, states, energy, out)
    return [
        Row("change of the mass over the area", float(np.abs(mass - mass[0]).max() / area.sum()),
            setting, 0.0, "round-off", 1e-13),
        Row("largest rise of the energy between two times, over the first",
            float(np.diff(energy).max() / energy[0]), setting, None, "gradient flow", 0.0),
        Row("energy at the end over the first", float(energy[-1] / energy[0]), setting),
        Row("largest |u| at the end", float(np.abs(states[-1]).max()), setting),
        Row("steps", float(solution.stats["num_steps"]), setting),
        Row("seconds to integrate, compilation included", seconds, setting | {"end": end}),
    ]  # fmt: skip


def _draw(cloud, times, states, energy, out) -> None:
    figure, axes = plt.subplots(1, 4, figsize=(17, 3.6), layout="constrained")
    lost = 1 - energy / energy[1]  # that of the noise goes at once
    for ax, i in zip(axes, (np.argmax(lost > 0.01), np.argmax(lost > 0.25), -1)):
        js.plot_cloud(cloud, states[i], ax=ax, title=f"u, t = {times[i]:.2g}", limits=(-1.0, 1.0),
                      cmap="coolwarm", view=(0.6, -1.2, 1.3))  # fmt: skip
    axes[3].semilogx(times[1:], energy[1:])
    axes[3].set_xlabel("t")
    axes[3].set_title("energy", fontsize="medium")
    figure.savefig(out / "cahn_hilliard.png", dpi=150)
    plt.close(figure)
