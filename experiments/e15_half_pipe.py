r"""Diffusion on a half pipe that it inflates while a twist deforms it (paper 002, Section 4.2.2).

$v = \tfrac12\phi\,n + (-y z, 0, x y)$ (eq. 35) on half of the torus (0.75, 0.25), ring in the x-y
plane, x >= 0, with no flux through the two circles where it ends. $\phi$ is what is diffused, by
eq. 28 with $\alpha = 0.2$, so that its integral, the mass, is kept: that is what is measured. Two
patches start at $\phi = 1$; the paper does not say where, here they lie on the outside, half way to
either end, with edges that fall off over a spacing. The paper shows pictures.
"""

from __future__ import annotations

from pathlib import Path

import jax.numpy as jnp
import numpy as np

import jaxsurf as js

from .report import Row, method_name

_RING, _PIPE = 0.75, 0.25
_AREA = 2 * np.pi**2 * _RING * _PIPE
_PATCH = 0.3
_VIEW = (1.2, -0.6, 0.6)


def half_pipe(n: int) -> js.PointCloud:
    """Half of a torus, with its two borders marked, from a fine mesh of it."""
    along, around = np.linspace(-np.pi / 2, np.pi / 2, 151), np.arange(97) * 2 * np.pi / 97
    a, b = (angle.ravel() for angle in np.meshgrid(along, around, indexing="ij"))
    radius = _RING + _PIPE * np.cos(b)
    vertices = np.stack([radius * np.cos(a), radius * np.sin(a), _PIPE * np.sin(b)], axis=1)
    number = np.arange(len(a)).reshape(len(along), len(around))
    here, there = number[:-1].ravel(), number[1:].ravel()
    aside, across = (np.roll(part, -1, axis=1).ravel() for part in (number[:-1], number[1:]))
    corners = (here, there, across), (here, across, aside)
    triangles = np.concatenate([np.stack(three, axis=1) for three in corners])
    return js.sample_mesh(js.TriangleMesh(vertices, triangles), n=n)


def patches(points, spacing: float):
    """1 within two balls about points of the outer equator, 0 elsewhere."""
    place = (_RING + _PIPE) * np.sqrt(0.5)
    centers = np.array([[place, place, 0.0], [place, -place, 0.0]])
    away = jnp.linalg.norm(points[:, None] - centers, axis=2).min(axis=1)
    return 0.5 * (1 - jnp.tanh((away - _PATCH) / spacing))


def _inflating(t, surface, phi, args):
    x, y, z = surface.cloud.points.T
    twist = jnp.stack([-y * z, 0 * y, x * y], axis=1)
    return 0.5 * phi[:, None] * surface.cloud.normals + twist


def _heat(surface: js.Discretization) -> js.AdvectionDiffusionReaction:
    return js.AdvectionDiffusionReaction(
        surface.laplacian, diffusivity=0.2, closure=js.without_flux(surface)
    )


def diffused(n: int, method: js.GFDM, times) -> js.Evolution:
    cloud, spacing = half_pipe(n), float(np.sqrt(_AREA / n))
    return js.evolve(
        js.Motion(_inflating),
        cloud,
        t1=times[-1],
        saveat=times[:-1],
        fields=patches(cloud.points, spacing),
        problem=_heat,
        method=method,
        # Its area doubles.
        adapt=js.Adaptation(spacing, capacity=2 * n),
        rtol=1e-4,
        atol=1e-5,
    )


def run(quick: bool, out: Path) -> list[Row]:
    n, times = (1_200, [0.0, 0.1, 0.2]) if quick else (11_802, list(np.linspace(0, 2, 6)))
    method, rows = js.GFDM(degree=2), []
    solution = diffused(n, method, times)
    history = solution.history
    each = zip(*(history[key] for key in ("t", "n", "area", "mass")))
    for t, count, area, mass in list(each)[1:]:
        setting = {"method": method_name(method), "n": n, "t": round(float(t), 3)}
        drift = abs(float(mass / history["mass"][0]) - 1)
        rows.append(Row("drift of the mass", drift, setting, None, "kept within 1 %", 1e-2))
        rows.append(Row("number of points", int(count), setting))
        rows.append(Row("area", float(area), setting))
    js.plot_series(
        solution.clouds, solution.fields, times=solution.ts, path=out / "e15.png", label="φ",
        limits=(0.0, 0.4), view=_VIEW,
    )  # fmt: skip
    return rows
