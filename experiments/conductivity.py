r"""A conductivity on the bunny from 200 noisy thermometers.

Six heaters are on one after the other; each time all thermometers are read at the steady state of
$\lambda u - \nabla_S \cdot (\kappa\,\nabla_S u) = f$. The readings come from linear finite elements
on all triangles of the scan, so that what is inverted is not what made the data; the unknown is
$\log\kappa$ at the points of a coarser cloud, whose operator is symmetric and lets no flux through
the holes. The ears, thinner than a coarse cloud resolves, carry no heater and no thermometer.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import meshio
import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg as sla
from jaxtyping import Array, Float

import jaxsurf as js

from . import data
from .report import Row

# Lengths in tenths of a metre: the bunny is 1.5 high.
_UNIT = 10.0
_LOSS, _WIDTH, _HEATERS, _SENSORS = 0.5, 0.15, 6, 200
# Standard deviations: of the noise, in shares of the readings' own; of the prior.
_NOISE, _SPREAD, _LENGTH = 0.03, 0.6, 0.5
# Height above which there are the ears alone.
_EARS = 1.5


def true(x: Float[Array, "n 3"]) -> Float[Array, " n"]:
    """Logarithm of the conductivity: between a quarter and four times one."""
    x = jnp.asarray(x)
    return 0.9 * jnp.sin(5 * x[:, 0] + 1) * jnp.cos(4 * x[:, 1]) + 0.5 * jnp.sin(6 * x[:, 2])


def heat(x: Float[Array, "n 3"], heaters) -> Float[Array, "n k"]:
    """What the heaters give at points, each."""
    apart = jnp.sum((jnp.asarray(x)[:, None] - jnp.asarray(heaters)) ** 2, axis=2)
    return jnp.exp(-apart / (2 * _WIDTH**2))


def spread_out(points, count: int) -> np.ndarray:
    """Indices of points far from each other, each next one farthest from those before."""
    chosen = [0]
    nearest = np.linalg.norm(points - points[0], axis=1)
    while len(chosen) < count:
        chosen.append(int(np.argmax(nearest)))
        nearest = np.minimum(nearest, np.linalg.norm(points - points[chosen[-1]], axis=1))
    return np.array(chosen)


def elements(points, triangles, kappa=1.0) -> tuple[sp.csc_matrix, sp.csc_matrix]:
    """Stiffness and mass of linear finite elements, with a conductivity for each triangle."""
    corners = points[triangles]
    edges = corners[:, [2, 0, 1]] - corners[:, [1, 2, 0]]  # opposite to each corner
    areas = np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1) / 2
    rows, columns = np.repeat(triangles, 3, axis=1), np.tile(triangles, 3)
    stiff = np.einsum("t,tid,tjd->tij", kappa / (4 * areas), edges, edges)
    mass = areas[:, None, None] / 12 * (1 + np.eye(3))
    assembled = lambda entries: sp.csc_matrix(
        (entries.ravel(), (rows.ravel(), columns.ravel())), shape=2 * (len(points),)
    )
    return assembled(stiff), assembled(mass)


def readings(points, triangles, heaters, sensors) -> np.ndarray:
    """Temperatures `(sensors, heaters)` at vertices, by linear finite elements."""
    kappa = np.exp(np.asarray(true(points[triangles].mean(axis=1))))
    stiff, mass = elements(points, triangles, kappa)
    solve = sla.factorized(_LOSS * mass + stiff)
    right = mass @ np.asarray(heat(points, heaters))
    return np.stack([solve(f)[sensors] for f in right.T], axis=1)


def _picture(path: Path, surface, found, deviation) -> None:
    figure, axes = plt.subplots(1, 4, figsize=(14, 3.9), layout="constrained")
    x = surface.cloud.points
    error = found - true(x)
    views = (
        (true(x), "truth", "log κ", (-1.4, 1.4)),
        (found, "found", "log κ", (-1.4, 1.4)),
        (jnp.abs(error), "error, modulus", "of log κ", (0, 0.6)),
        (deviation, "posterior deviation", "of log κ", (0, 0.6)),
    )
    for ax, (field, title, label, limits) in zip(axes, views):
        js.plot_cloud(surface.cloud, field, ax=ax, title=title, label=label, limits=limits)
    figure.savefig(path, dpi=130)
    plt.close(figure)


def scan() -> tuple[np.ndarray, np.ndarray]:
    """Vertices of the bunny that triangles use, and the triangles."""
    mesh = meshio.read(data.BUNNY)
    used, triangles = np.unique(mesh.cells_dict["triangle"], return_inverse=True)
    return _UNIT * mesh.points[used].astype(float), triangles.reshape(-1, 3)


def conduction(surface: js.Discretization, kappa):
    r"""$\nabla_S \cdot (\kappa \nabla_S u)$, symmetric: on each pair the mean of both ends."""
    laplacian = surface.symmetric_laplacian
    weights = laplacian.weights * (kappa + kappa[laplacian.indices]) / 2
    return laplacian.of_weights(weights.at[0].set(-weights[1:].sum(axis=0)))


class Experiment(NamedTuple):
    """What is measured, with which noise, and what would be measured at a field."""

    surface: js.Discretization
    model: Callable
    clean: np.ndarray
    noisy: Array
    sigma: float


def experiment(n: int, heated: int) -> Experiment:
    """On n points, with so many heaters."""
    points, triangles = scan()
    body = np.flatnonzero(points[:, 1] < _EARS)
    places = body[spread_out(points[body], _SENSORS)]
    sensors, heaters = points[places], points[places[1 : heated + 1]]
    clean = readings(points, triangles, heaters, places)
    sigma = _NOISE * clean.std()
    noisy = jnp.asarray(clean + sigma * np.random.default_rng(0).normal(size=clean.shape))

    cloud = data.bunny(n)
    cloud = js.PointCloud(_UNIT * cloud.points, cloud.normals, boundary=cloud.boundary)
    surface = js.discretize(cloud, method=js.GFDM(degree=2))
    given = heat(cloud.points, heaters)

    def model(log_conductivity):
        operator = conduction(surface, jnp.exp(log_conductivity))
        u = js.solve(_LOSS - operator, given, mean_zero=False).value
        return surface.interpolate(u, sensors)

    return Experiment(surface, model, clean, noisy, sigma)


def problem(n: int) -> tuple[Callable, Array]:
    """The misfit as a function of the field alone, and a field: for benchmarks."""
    surface, model, _, noisy, sigma = experiment(n, _HEATERS)
    misfit = lambda field: jnp.mean(((model(field) - noisy) / sigma) ** 2)
    return misfit, 0.5 * true(surface.cloud.points)


def run(quick: bool, out: Path) -> list[Row]:
    n, heated, tol = (1_000, 2, 1e-2) if quick else (4_000, _HEATERS, None)
    surface, model, clean, noisy, sigma = experiment(n, heated)
    x = surface.cloud.points
    off = (model(true(x)) - clean) / sigma
    prior = js.MaternPrior(surface, deviation=_SPREAD, length=_LENGTH)
    found = js.solve_inverse(model, jnp.zeros(n), noisy, noise=sigma, prior=prior, tol=tol)
    print(found)
    start = time.perf_counter()
    posterior = found.posterior()
    deviation = jax.block_until_ready(posterior.deviation)
    seconds = time.perf_counter() - start
    _picture(out / "conductivity.png", surface, found.theta, deviation)
    weights = surface.cell_areas / surface.cell_areas.sum()
    share = lambda u, where: float(
        jnp.sqrt(jnp.sum(weights * where * u**2) / jnp.sum(weights * where * true(x) ** 2))
    )
    error = found.theta - true(x)
    measured = x[:, 1] < _EARS
    inside = float(weights @ (jnp.abs(error) < 2 * deviation))
    # Data that the unknowns take up are fitted, noise included.
    left = 1 - float(jnp.sum(posterior.factor**2)) / noisy.size
    rows = found.history
    about = {"n": n, "operator": "symmetric", "sensors": _SENSORS, "heaters": heated}
    return [
        Row("error of the model at the true field, in deviations of the noise, rms",
            float(jnp.sqrt(jnp.mean(off**2))), about),
        Row("error of log κ without the ears, root mean square over that of log κ",
            share(error, measured), about, 0.0, "project", None if quick else 0.35),
        Row("the same with the ears", share(error, True), about),
        Row("misfit over the share of the data that the field leaves, less 1, modulus",
            abs(float(found.misfit) / left - 1), about, 0.0, "project", None if quick else 0.3),
        Row("share of the surface where the error is at most two deviations, at least", inside,
            about, 0.95, "project", 0.8, True),
        Row("data that the field takes up", noisy.size * (1 - left), about),
        Row("steps of Gauss and Newton", len(rows["energy"]) - 1, about),
        Row("linear steps in all", float(rows["linear_steps"].sum()), about),
        Row("s for the likeliest field, compilation included", float(rows["seconds"][-1]), about),
        Row("s for its deviations, compilation included", seconds, about),
    ]  # fmt: skip
