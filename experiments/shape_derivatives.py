r"""Derivatives of functionals in the shape, held against spectral references.

Ellipsoids and tori, in their axes and radii and along their normals by random polynomials; reverse
mode through points, normals, stencils, areas, solves, eigenmodes and integrations in time. A
derivative along one direction may vanish nearly, as that of the Willmore energy of the ellipsoid
does along the first polynomial, and so may its error at some number of points; so errors are norms
over all axes, radii or polynomials, relative to that of the derivatives.
"""

from __future__ import annotations

import functools
import warnings
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import jaxsurf as js

from . import galerkin
from .report import Method, Row, method_name, slope

_RADIUS, _TIME = 0.5, 0.1
_BOUND, _DEFAULT = 1e-5, 1e-4
# Of the reference, and of one to compare it with.
_DEGREE, _COARSE = 12, 8
# Random polynomials.
_BUMPS = 6
# Methods, and neighbours of each point where these are fewer than the method asks for, to be stable
# on uneven points too. The nearer they are the smaller is the error; with 26 all centres here have
# half the weights and more, with 24 a tenth, which solvers in time feel.
_METHODS: list[tuple[Method, int | None]] = [
    (js.GFDM(degree=4), None),
    (js.GFDM(degree=4), 26),
    (js.DCPSE(order=4), None),
    (js.GFDM(degree=6), None),
]


def bumps(x):
    """Random polynomials, the same on every machine."""
    rng = np.random.default_rng(0)
    a, b, c = (rng.normal(size=(_BUMPS, *shape)) for shape in ((3,), (3, 3), (3,)))
    return a @ x + b @ x @ x + (c @ x) ** 3


FIELDS = {
    "load": lambda x: x[0] + x[1] * x[2],
    "start": lambda x: 1 + x[0] + 0.5 * x[1] * x[2] - x[2] ** 2,
    "weight": lambda x: 1 + 2 * x[0] - x[2] + x[1] * x[1],
}


def ellipsoid(x, theta):
    """Of these axes, then along its normals."""
    axes, sizes = theta
    n = x / axes
    return axes * x + sizes @ bumps(x) * n / jnp.linalg.norm(n)


def torus(x, theta):
    """Of these radii, then along its normals."""
    radii, sizes = theta
    y = galerkin.torus_map(x, radii)
    core = galerkin.torus_map(x, radii * jnp.array([1.0, 0.0]))
    return y + sizes @ bumps(x) * (y - core) / radii[1]


# Map, parameters, group of eigenvalues.
CASES = {
    "ellipsoid": (ellipsoid, (jnp.array([1.0, 0.8, 0.7]), jnp.zeros(_BUMPS)), (1, 3)),
    "torus": (torus, (jnp.array([1.0, _RADIUS]), jnp.zeros(_BUMPS)), (1, 2)),
}


def directions(name: str) -> dict[str, list[tuple]]:
    """In each axis or radius, and along normals by each polynomial."""
    _, (size, still), _ = CASES[name]
    what = "axes" if name == "ellipsoid" else "radii"
    return {
        what: [(each, still) for each in jnp.eye(len(size))],
        "normals": [(0 * size, each) for each in jnp.eye(_BUMPS)],
    }


@functools.cache
def reference(name: str, degree: int) -> dict[tuple[str, str], tuple[float, np.ndarray]]:
    """Value and derivatives, by functional and kind of direction."""
    F, theta, group = CASES[name]
    base = galerkin.sphere(degree) if name == "ellipsoid" else galerkin.torus(1, _RADIUS, degree)
    found = {}
    for what, dots in directions(name).items():
        each = galerkin.functionals(base, F, theta, dots, FIELDS, *group, _TIME)
        for key, (value, _) in each[0].items():
            found[key, what] = value, np.array([one[key][1] for one in each])
    return found


def functionals(name: str, n: int, method: Method, k: int | None, **tolerances) -> dict:
    """The same of a discretisation, as functions of parameters."""
    F, _, (first, last) = CASES[name]
    cloud = js.sphere(n) if name == "ellipsoid" else js.torus(n, 1.0, _RADIUS)
    lists = js.find_neighbors(cloud, k) if k else None
    shape = js.MappedShape(F, js.discretize(cloud, lists, method=method))
    load, start, weight = (jax.vmap(f)(cloud.points) for f in FIELDS.values())

    def heat(surface):
        problem = js.AdvectionDiffusionReaction(surface.laplacian)
        u = js.integrate(problem, start, t1=_TIME, **tolerances).ys[-1]
        return surface.inner(weight, u)

    of_surface = {
        "area": lambda s: s.areas.sum(),
        "volume": js.volume,
        "int H^2": js.willmore_energy,
        "eigenvalue group": lambda s: jnp.mean(js.eigenvalues(s, last + 1)[first : last + 1]),
        "compliance": lambda s: js.compliance(s, load, screening=1.0),
        "heat content": heat,
    }
    return {key: lambda theta, f=f: f(shape(theta)) for key, f in of_surface.items()}


def errors(
    name: str, n: int, method: Method, k: int | None = None, keys=None, **tolerances
) -> dict:
    """Relative errors of values and derivatives, by functional and kind of direction."""
    exact, (_, theta, *_) = reference(name, _DEGREE), CASES[name]
    found = {}
    for key, f in functionals(name, n, method, k, **tolerances).items():
        if keys is not None and key not in keys:
            continue
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            value, gradient = jax.value_and_grad(f)(theta)
        for what, dots in directions(name).items():
            slopes = np.array([sum(map(jnp.vdot, gradient, dot)) for dot in dots])
            found[key, what] = _apart((float(value), slopes), exact[key, what])
    return found


def _apart(found: tuple, wanted: tuple) -> tuple[float, float]:
    """Relative differences of values and, over all directions, of derivatives."""
    (value, slopes), (exact, right) = found, wanted
    return abs(value / exact - 1), float(np.linalg.norm(slopes - right) / np.linalg.norm(right))


def run(quick: bool, out: Path) -> list[Row]:
    sizes = (300, 600) if quick else (2_500, 10_000)
    names = ["ellipsoid"] if quick else list(CASES)
    keys = {"area", "volume", "compliance"} if quick else None
    rows, drawn = [], {}
    for name in names:
        fine, coarse = reference(name, _DEGREE), reference(name, _COARSE)
        change = max(max(_apart(coarse[at], fine[at])) for at in fine)
        rows.append(Row(f"change of the reference, degree {_COARSE} to {_DEGREE}, relative",
                        float(change), {"surface": name}, None, "project", 1e-7))  # fmt: skip
        for method, k in _METHODS[: 1 if quick else None]:
            label = method_name(method) + (f", k = {k}" if k else "")
            about = {"surface": name, "method": label}
            found = [errors(name, n, method, k, keys, rtol=1e-7, atol=1e-10) for n in sizes]
            for key, what in found[0]:
                pair = [each[key, what][1] for each in found]
                order = slope([n**-0.5 for n in sizes], pair)
                here = about | {"in": what, "n": sizes[-1]}
                rows += [
                    Row(f"derivative of {key}, relative error", pair[-1], here, 0.0, "Galerkin",
                        None if quick else _BOUND),
                    Row("error of the derivative, its order, at least", order,
                        about | {"in": what, "of": key}, 4.0, "project", 2.0, at_least=True),
                ]  # fmt: skip
                drawn[name, label, key, what] = pair
            if not quick:
                # With the tolerances that nobody chose.
                default = errors(name, sizes[-1], method, k, {"heat content"})
                rows += [
                    Row("derivative of heat content, relative error, default tolerances",
                        error, about | {"in": what, "n": sizes[-1]}, 0.0, "Galerkin", _DEFAULT)
                    for (_, what), (_, error) in default.items()
                ]  # fmt: skip
    if not quick:
        _picture(out / "shape-derivatives.png", sizes, drawn)
    return rows


def _picture(path: Path, sizes, drawn) -> None:
    """A panel for each surface and method."""
    panels = list(dict.fromkeys(at[:2] for at in drawn))
    columns = len(panels) // 2
    figure, axes = plt.subplots(2, columns, figsize=(4 * columns, 8), sharey=True,
                                layout="constrained")  # fmt: skip
    for ax, panel in zip(axes.ravel(), panels):
        for (*at, key, what), pair in drawn.items():
            if tuple(at) == panel:
                kind = "s--" if what == "normals" else "o-"
                color = f"C{list(dict.fromkeys(k for *_, k, _ in drawn)).index(key)}"
                label = f"{key}, {'normals' if what == 'normals' else 'axes or radii'}"
                ax.loglog(sizes, pair, kind, color=color, label=label, markersize=4)
        ax.axhline(_BOUND, color="k", linewidth=0.8, linestyle=":")
        ax.set_title(", ".join(panel), fontsize="medium")
        ax.set_xlabel("points")
    lines = axes[0, 0].get_legend_handles_labels()
    figure.legend(*lines, loc="outside lower center", frameon=False, ncols=6)
    axes[0, 0].set_ylabel("relative error of the derivative")
    figure.savefig(path, dpi=130)
    plt.close(figure)
