"""Area, volume and integrals of curvature on three surfaces: errors and their orders."""

from __future__ import annotations

from pathlib import Path

import jax.numpy as jnp
import numpy as np
import scipy.integrate
from tqdm import tqdm

import jaxsurf as js

from .pictures import convergence
from .report import Method, Row, method_name, slope

_METHODS: list[Method] = [js.GFDM(degree=2), js.GFDM(degree=4), js.DCPSE(order=4)]
_NAMES = ("area", "volume", "mean curvature", "its square", "Gauss curvature")
# The order that the operators of each promise.
_ORDER = {js.GFDM(degree=2): 2, js.GFDM(degree=4): 4, js.DCPSE(order=4): 4}


def _torus(n: int, ring: float = 1.0, tube: float = 0.4):
    pi = np.pi
    willmore = pi**2 * ring**2 / (tube * np.sqrt(ring**2 - tube**2))
    exact = [4 * pi**2 * ring * tube, 2 * pi**2 * ring * tube**2, 2 * pi**2 * ring, willmore, 0]
    return js.torus(n, ring, tube), exact


def _ellipsoid(n: int, a: float = 1.0, c: float = 0.7):
    """Of revolution: integrals over the profile (a sin t, c cos t)."""

    def total(f):
        def ring(t):
            speed = np.hypot(a * np.cos(t), c * np.sin(t))
            along = a * c / speed**3  # curvature of the profile, and that of the rings
            around = c / (a * speed)
            return 2 * np.pi * a * np.sin(t) * speed * f((along + around) / 2)

        return scipy.integrate.quad(ring, 0, np.pi, epsabs=1e-13, epsrel=1e-13)[0]

    exact = [total(f) for f in (lambda h: 1, lambda h: h, lambda h: h**2)]
    volume = 4 / 3 * np.pi * a**2 * c
    return js.ellipsoid(n, (a, a, c)), [exact[0], volume, *exact[1:], 4 * np.pi]


def _double_torus(n: int):
    """Of genus two; only the total Gauss curvature is known."""
    nan = float("nan")
    phi, bounds = js.double_torus()
    return js.level_set(phi, n=n, bounds=bounds), [nan, nan, nan, nan, -4 * np.pi]


def _integrals(cloud: js.PointCloud, method: Method) -> np.ndarray:
    surface = js.discretize(cloud, method=method)
    height = jnp.sum(cloud.points * cloud.normals, axis=1) / 3
    h = surface.mean_curvature
    fields = [jnp.ones(cloud.n), height, h, h**2, surface.gauss_curvature]
    return np.asarray(surface.integrate(jnp.stack(fields, axis=1)))


def run(quick: bool, out: Path) -> list[Row]:
    sizes = [1_000, 4_000] if quick else [2_000, 4_000, 8_000, 16_000, 32_000]
    methods = _METHODS[1:2] if quick else _METHODS
    shapes = {"ellipsoid": _ellipsoid, "torus": _torus, "double torus": _double_torus}
    rows: list[Row] = []
    progress = tqdm(total=len(shapes) * len(sizes) * len(methods), desc="integrals")
    for name, make in shapes.items():
        # Points of the double torus are spread anew for every n, and coarse ones see both holes.
        counts = sizes if name != "double torus" else [4 * n for n in sizes][: len(sizes) - 1]
        made = [make(n) for n in counts]
        for method in methods:
            found = []
            for cloud, _ in made:
                found.append(_integrals(cloud, method))
                progress.update()
            exact = np.array(made[-1][1])
            scale = np.where(exact == 0, 4 * np.pi, np.abs(exact))
            errors = np.abs(np.array(found) - exact) / scale
            _report(rows, name, method, counts, errors)
            if len(counts) > 2 and name != "double torus":
                convergence(
                    out / f"integrals-{name}-{method_name(method)}.png",
                    [n**-0.5 for n in counts],
                    dict(zip(_NAMES, errors.T.tolist())),
                    orders=[2, 4, 6],
                    title=f"Integrals, {name}, {method_name(method)}",
                    label="relative error",
                )
    progress.close()
    return rows


def _report(rows, name, method, counts, errors) -> None:
    setting = {"surface": name, "method": method_name(method)}
    for quantity, values in zip(_NAMES, errors.T):
        if not np.isfinite(values).all():
            continue
        last = setting | {"of": quantity, "n": counts[-1]}
        rows.append(Row("relative error of the integral", values[-1], last, None, "project"))
        if len(counts) > 1:
            seen = slope([n**-0.5 for n in counts], values.tolist())
            about = setting | {"of": quantity, "n": f"{counts[0]} to {counts[-1]}"}
            bound = _ORDER[method] - 0.2
            words = "order of the integral, at least"
            rows.append(Row(words, seen, about, None, "project", bound, at_least=True))
