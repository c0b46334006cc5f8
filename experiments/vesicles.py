r"""Red blood cells: surfaces of least bending energy at given area and reduced volume.

The area is that of the unit sphere, the volume v times its. Energies $\int H^2 dS / 4\pi$, 1 for
the sphere, and profiles are compared with those of axisymmetric solutions of the shape equation
(Seifert, Berndl, Lipowsky 1991, spontaneous curvature 0): biconcave disks that shrink from an
oblate spheroid to v = 0.65, prolate capsules to v = 0.9. What is searched here is not axisymmetric.
"""

from __future__ import annotations

from pathlib import Path

import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import optax

import jaxsurf as js

from .report import Row
from .shape_equation import Profile, branch, equal_energy

_DEGREE = 4
_COUNT = (_DEGREE + 1) ** 2
# Bending grows with the fourth power of the degree: all coefficients are about as stiff then.
_SOFT = 1 / (1 + np.repeat([m * (m + 1) for m in range(_DEGREE + 1)],
                           [2 * m + 1 for m in range(_DEGREE + 1)]))  # fmt: skip
# At volumes that are far from the one asked for, the two kinds are one: at the sphere. Constraints
# are stiff from the first step on, so that a search stays with its kind.
_PENALTY = 200.0
# Least is the energy of prolate shapes for v > 0.652, of biconcave ones for 0.592 < v < 0.651
# (Seifert et al.): in between the two are equal.
_EQUAL = 0.6515
# Reduced volumes, the spheroid from which the search starts, and the one for the shape equation.
_SHAPES = {"prolate": (0.9, 2.0, 1.3), "biconcave": (0.65, 0.4, 0.75)}


def bending(surface: js.Discretization, v):
    return surface.integrate(surface.mean_curvature**2) / (4 * jnp.pi)


def excess_area(surface: js.Discretization, v):
    return surface.areas.sum() / (4 * jnp.pi) - 1


def excess_volume(surface: js.Discretization, v):
    return js.volume(surface) / (4 * jnp.pi / 3) - v


def vesicles(n: int, axis: float) -> tuple[js.MappedShape, np.ndarray]:
    """Spheroids whose distances from axis and equator are multiplied by smooth functions."""
    axes = jnp.array([1.0, 1.0, axis])

    def move(x, theta):
        direction = x / axes
        y = js.spherical_harmonics(direction / jnp.linalg.norm(direction), _DEGREE)
        wide, high = 1 + theta.reshape(2, _COUNT) @ (_SOFT * y)
        return x * jnp.array([wide, wide, high])

    surface = js.discretize(js.ellipsoid(n, (1, 1, axis)), method=js.GFDM(degree=4))
    theta = 0.1 * np.random.default_rng(0).normal(size=(2, _COUNT))
    theta[:, 0] = np.sqrt(4 * np.pi) * (np.sqrt(4 * np.pi / float(surface.areas.sum())) - 1)
    return js.MappedShape(move, surface), theta.ravel()


def half_profile(surface: js.Discretization) -> tuple[np.ndarray, np.ndarray]:
    """Distances of points from the axis and from the equator, wherever these have turned."""
    centroid, second = js.moments(surface)
    size, along = np.linalg.eigh(np.asarray(second))
    odd = 0 if size[1] - size[0] > size[2] - size[1] else 2
    x = np.asarray(surface.cloud.points - centroid)
    z = x @ along[:, odd]
    return np.linalg.norm(x - np.outer(z, along[:, odd]), axis=1), np.abs(z)


def _away(surface: js.Discretization, exact: Profile) -> float:
    """Largest distance of a point from the profile."""
    r, z = half_profile(surface)
    gaps = np.hypot(r[:, None] - exact.r[::2], z[:, None] - exact.z[::2])
    return float(np.max(np.min(gaps, axis=1)))


def problem(n: int):
    """Bending energy of a spheroid with bumps, of its parameters alone; and where."""
    shape, theta = vesicles(n, _SHAPES["prolate"][1])
    return lambda theta: bending(shape(theta), None), jnp.asarray(theta)


def _picture(path: Path, found: dict, exact: dict[str, Profile], branches: dict) -> None:
    figure, axes = plt.subplots(1, len(found) + 2, figsize=(4 * len(found) + 8, 3.8),
                                layout="constrained")  # fmt: skip
    *left, middle, right = axes
    for ax, color, (name, one) in zip(left, ("C0", "C3"), found.items()):
        surface = one.surface
        js.plot_cloud(surface.cloud, surface.mean_curvature, ax=ax, label="mean curvature",
                      title=f"{name}, reduced volume {_SHAPES[name][0]}")  # fmt: skip
        r, z = half_profile(surface)
        middle.plot(r, z, ".", color=color, markersize=3, label=f"{name}: points found")
        middle.plot(exact[name].r, exact[name].z, "k-", linewidth=1)
        right.plot(_SHAPES[name][0], float(one.objective), "o", color=color)
    for color, (name, line) in zip(("C0", "C3"), branches.items()):
        volumes, energies = [p.v for p in line], [p.energy for p in line]
        right.plot(volumes, energies, color=color, linewidth=1, label=name)
    middle.plot([], [], "k-", linewidth=1, label="shape equation")
    middle.set_xlabel("distance from the axis")
    middle.set_ylabel("from the equator")
    middle.set_aspect("equal")
    right.axvline(_EQUAL, color="k", linewidth=0.8, linestyle=":", label="published crossing")
    right.set_xlabel("reduced volume")
    right.set_ylabel("bending energy, 1 for the sphere")
    for ax in (middle, right):
        ax.legend(fontsize=8, frameon=False)
    figure.savefig(path, dpi=130)
    plt.close(figure)


def run(quick: bool, out: Path) -> list[Row]:
    n, steps = (500, 40) if quick else (1_500, 200)
    names = ["prolate"] if quick else list(_SHAPES)
    starts = [spheroid for *_, spheroid in _SHAPES.values()]
    branches = {name: branch(0.6, start) for name, start in zip(_SHAPES, starts)}
    exact, found = {}, {}
    crossing = equal_energy(0.64, 0.66, *starts)
    rows = [
        Row("reduced volume at which both kinds have the same energy, from the published one",
            abs(crossing - _EQUAL), {}, _EQUAL, "Seifert et al. 1991", 1e-3),
    ]  # fmt: skip
    for name in names:
        v, axis, spheroid = _SHAPES[name]
        exact[name] = branch(v, spheroid)[-1]
        shape, theta = vesicles(n, axis)
        found[name] = one = js.optimize_shape(
            bending,
            shape,
            jnp.asarray(theta),
            optimizer=optax.lbfgs(),
            equalities={"area": excess_area, "volume": excess_volume},
            args=(jnp.asarray(v),),
            steps=steps,
            rtol=1e-3,
            penalty=_PENALTY,
        )
        print(name, one)
        about = {"n": n, "method": "GFDM(degree=4)", "shape": name, "reduced volume": v}
        energy, pressure = exact[name].energy, exact[name].pressure
        seconds = one.history["seconds"]
        rows += [
            Row("bending energy, 1 for the sphere", float(one.objective), about, energy,
                "shape equation"),
            Row("bending energy, relative error", abs(float(one.objective) / energy - 1), about,
                0.0, "shape equation", 1e-2),
            Row("derivative of the energy in the volume", -float(one.multipliers["volume"]), about,
                -pressure / 6, "shape equation"),
            Row("largest distance of a point from the profile", _away(one.surface, exact[name]),
                about, 0.0, "shape equation"),
            Row("area and volume, largest violation", float(one.history["violation"][-1]), about,
                0.0, "project", 1e-3),
            Row("steps", len(seconds) - 1, about),
            Row("s to the first step, compilation included", float(seconds[1]), about),
            Row("s for a step after that, median", float(np.median(np.diff(seconds)[1:])), about),
        ]  # fmt: skip
    _picture(out / "vesicles.png", found, exact, branches)
    return rows
