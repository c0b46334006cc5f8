r"""The closed surface on which a hot spot cools fastest, among stars of one area, little bent.

Heat that starts as a Gaussian about a point spreads by $\partial_t u = \Delta_S u$; what is least
is the temperature of that point at time T. No surface of area A cools below 1 / A by its heat
kernel, $K(T, x, x) = \sum_k e^{-\lambda_k T} \phi_k(x)^2 > 1 / A$; that of the sphere is a series
of Legendre polynomials. Short times see Gauss's curvature, $4 \pi t\,K(t, x, x) = 1 + t\,G(x) / 3$:
cooling is quick at a saddle, which without a bound of the bending would become ever sharper.
(The spot is that of a kernel of the plane, of a short time: the bound is nearly one of its heat.)
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import equinox as eqx
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import optax
from jaxtyping import Array, Float
from scipy.spatial.transform import Rotation
from scipy.special import eval_legendre

import jaxsurf as js

from .report import Row

_DEGREE, _METHOD = 4, js.GFDM(degree=2)
# The Gaussian is the plane's kernel of this time; heat then flows for that one.
_AGE, _TIME, _STEPS = 0.02, 0.25, 24
_AREA = 4 * np.pi
# Integral of the squared mean curvature, in multiples of the sphere's.
_BENDING = 1.3


def exact() -> float:
    """The temperature on the unit sphere."""
    z, weight = np.polynomial.legendre.leggauss(200)
    u = np.exp((z - 1) / (2 * _AGE))
    u /= 2 * np.pi * (weight @ u)
    degrees = np.arange(60)[:, None]
    parts = (2 * degrees[:, 0] + 1) / 2 * (eval_legendre(degrees, z) @ (weight * u))
    return float(parts @ np.exp(-degrees * (degrees + 1) * _TIME)[:, 0])


def heat(surface: js.Discretization, steps: int = _STEPS) -> Float[Array, " n"]:
    """All temperatures at the end, of a spot of heat 1 about the first point."""
    x = surface.cloud.points
    spot = jnp.exp(-jnp.sum((x - x[0]) ** 2, axis=1) / (4 * _AGE))
    problem = js.AdvectionDiffusionReaction(surface.laplacian)
    return js.integrate(
        problem, spot / surface.integrate(spot), t1=_TIME, solver=js.RKC2(), dt0=_TIME / steps
    ).ys[-1]


def temperature(surface: js.Discretization):
    return heat(surface)[0]


def excess_area(surface: js.Discretization):
    return surface.areas.sum() / _AREA - 1


def excess_bending(surface: js.Discretization):
    return surface.integrate(surface.mean_curvature**2) / _AREA - _BENDING


def ball(n: int) -> js.Discretization:
    """The unit sphere, its first point at the top."""
    points = js.sphere(n).points
    turn, _ = Rotation.align_vectors([[0.0, 0.0, 1.0]], np.asarray(points[:1]))
    points = points @ turn.as_matrix().T
    return js.discretize(js.PointCloud(points, points), method=_METHOD)


def bumpy() -> Float[Array, " m"]:
    """Coefficients of the radius. A search from the sphere stays among surfaces of revolution."""
    theta = 0.05 * np.random.default_rng(0).normal(size=(_DEGREE + 1) ** 2)
    theta[:4] = [np.sqrt(4 * np.pi), 0, 0, 0]
    return jnp.asarray(theta)


def problem(n: int) -> tuple[Callable, Float[Array, " m"]]:
    star = js.star_shape(ball(n), _DEGREE)
    return lambda theta: temperature(star(theta)), bumpy()


def _picture(path: Path, start, end, history) -> None:
    figure, axes = plt.subplots(1, 3, figsize=(11.5, 3.8), layout="constrained")
    for ax, surface, title in ((axes[0], start, "start"), (axes[1], end, "end")):
        js.plot_cloud(surface.cloud, heat(surface), ax=ax, title=title, limits=(0, 0.33),
                      label="temperature", view=(1.6, -0.5, 1.0), cmap="inferno")  # fmt: skip
    axes[2].plot(history["objective"] / exact(), label="temperature over that on the sphere")
    axes[2].axhline(1 / (_AREA * exact()), color="k", linewidth=0.8, linestyle=":",
                    label="1 / area")  # fmt: skip
    axes[2].set_ylim(0, 1.1)
    axes[2].set_xlabel("step")
    axes[2].legend(fontsize=8, frameon=False)
    figure.savefig(path, dpi=130)
    plt.close(figure)


def run(quick: bool, out: Path) -> list[Row]:
    n, steps = (600, 12) if quick else (4_000, 100)
    sphere = ball(n)
    star = js.star_shape(sphere, _DEGREE)
    found = js.optimize_shape(
        temperature,
        star,
        bumpy(),
        optimizer=optax.lbfgs(),
        equalities={"area": excess_area},
        inequalities={"bending": excess_bending},
        steps=steps,
        rtol=1e-3,
    )
    print(found)

    at = eqx.filter_jit(lambda star, theta: star(theta).cloud)
    made = lambda star, theta: js.discretize(at(star, theta), method=_METHOD)
    fine = made(js.star_shape(ball(4 * n), _DEGREE), found.theta)
    again = float(heat(fine, 2 * _STEPS)[0])
    _picture(out / "hot-spot.png", made(star, bumpy()), fine, found.history)
    reference, least = exact(), float(found.objective)
    rows, about = found.history, {"n": n, "method": "GFDM(degree=2)", "T": _TIME}
    other = about | {"n": 4 * n}
    return [
        Row("temperature on the sphere, relative error", abs(float(temperature(sphere)) / reference
            - 1), about, 0.0, "series of Legendre polynomials", 2e-2 if quick else 1e-2),
        Row("temperature at the start over that on the sphere", float(rows["objective"][0])
            / reference, about),
        Row("temperature of what is found over that on the sphere", least / reference, about, None,
            "project", 0.85),
        Row("the same on other points", again / reference, other, None, "project", 0.85),
        Row("difference of these, relative", abs(again / least - 1), other, 0.0, "project",
            None if quick else 1e-2),
        Row("1 / area over the temperature on the sphere: bound of the kernel",
            1 / (_AREA * reference), about),
        Row("area over the one asked for, less 1, modulus, on other points",
            abs(float(excess_area(fine))), other, 0.0, "project", 1e-2),
        Row("bending in that of the sphere, on other points", float(excess_bending(fine))
            + _BENDING, other, _BENDING, "project", None if quick else 1.01 * _BENDING),
        Row("Gauss's curvature at the point", float(fine.gauss_curvature[0]), other),
        Row("steps", len(rows["seconds"]) - 1, about),
        Row("s to the first step, compilation included", float(rows["seconds"][1]), about),
        Row("s for a step, median", float(np.median(np.diff(rows["seconds"]))), about),
    ]  # fmt: skip
