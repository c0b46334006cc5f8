r"""Lowest eigenvalues of the Laplace–Beltrami operator on sphere, ellipsoid and torus.

References: on the unit sphere $l(l + 1)$, $2l + 1$ times. On the ellipsoid a Galerkin method
with spherical harmonics of the parameter sphere; on the torus one with trigonometric polynomials
in the small angle for every wave number around the axis. Both converge exponentially.
"""

from __future__ import annotations

from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import scipy.linalg
import scipy.special
from jaxtyping import Float
from tqdm import tqdm

import jaxsurf as js
from jaxsurf.plot import plot_cloud

from .report import Method, Row, method_name

_COUNT = 24
_AXES = (1.0, 0.8, 0.75)
_RADII = (3.0, 1.0)


def sphere_values(count: int = _COUNT) -> Float[np.ndarray, " count"]:
    """The lowest non-zero ones of the unit sphere."""
    degrees = np.arange(1, count + 1)
    return np.repeat(degrees * (degrees + 1.0), 2 * degrees + 1)[:count]


def ellipsoid_values(degree: int, count: int = _COUNT) -> Float[np.ndarray, " count"]:
    """The lowest non-zero ones by spherical harmonics up to a degree."""
    nodes, shares = np.polynomial.legendre.leggauss(2 * degree)
    azimuth = np.pi * np.arange(4 * degree) / (2 * degree)
    theta, phi = (a.ravel() for a in np.meshgrid(np.arccos(nodes), azimuth, indexing="ij"))
    share = np.repeat(shares, len(azimuth)) * np.pi / (2 * degree) / np.sin(theta)
    a, b, c = _AXES
    sin, cos = np.sin, np.cos
    along = np.stack([a * cos(theta) * cos(phi), b * cos(theta) * sin(phi), -c * sin(theta)])
    around = np.stack([-a * sin(theta) * sin(phi), b * sin(theta) * cos(phi), 0 * phi])
    e, f, g = (np.sum(x * y, axis=0) for x, y in
               ((along, along), (along, around), (around, around)))  # fmt: skip
    area = np.sqrt(e * g - f**2)

    pairs = [(n, m) for n in range(degree + 1) for m in range(-n, n + 1)]
    found = [scipy.special.sph_harm_y(n, m, theta, phi, diff_n=1) for n, m in pairs]
    y = np.stack([value for value, _ in found])
    y_theta, y_phi = (np.stack([slope[..., i] for _, slope in found]) for i in (0, 1))
    weigh = lambda p, w, q: (p.conj() * (share * w)) @ q.T
    mixed = weigh(y_theta, -f / area, y_phi)
    stiffness = (
        weigh(y_theta, g / area, y_theta) + weigh(y_phi, e / area, y_phi) + mixed + mixed.conj().T
    )
    values = scipy.linalg.eigh(stiffness, weigh(y, area, y), eigvals_only=True)
    return values[1 : count + 1]


def torus_values(degree: int, count: int = _COUNT) -> Float[np.ndarray, " count"]:
    r"""The lowest non-zero ones by trigonometric polynomials up to a degree.

    With $w = R + r\cos\theta$ a mode $e^{i m \phi} f(\theta)$ has
    $-(w f')' / r^2 + m^2 f / w = \lambda\,w f$.
    """
    outer, inner = _RADII
    theta = 2 * np.pi * np.arange(8 * degree) / (8 * degree)
    w = outer + inner * np.cos(theta)
    k = np.arange(-degree, degree + 1)
    basis = np.exp(1j * k[:, None] * theta)
    weigh = lambda p, v, q: (p.conj() * v) @ q.T / len(theta)
    slopes = 1j * k[:, None] * basis
    found = []
    for m in range(count + 1):
        stiffness = weigh(slopes, w / inner**2, slopes) + m**2 * weigh(basis, 1 / w, basis)
        values = scipy.linalg.eigh(stiffness, weigh(basis, w, basis), eigvals_only=True)
        found += [*values, *(values if m else [])]
    return np.sort(found)[1 : count + 1]


def run(quick: bool, out: Path) -> list[Row]:
    n = 5_000 if quick else 10_000
    shapes = [
        ("sphere", js.sphere(n), sphere_values(), 0.0, 1e-4),
        ("ellipsoid", js.ellipsoid(n, _AXES), *_converged(ellipsoid_values, 12, 16), 1e-3),
        ("torus", js.torus(n, *_RADII), *_converged(torus_values, 12, 16), 1e-3),
    ]
    methods: list[Method] = [js.DCPSE(order=4), js.GFDM(degree=4)]
    rows: list[Row] = []
    drawn = []
    progress = tqdm(total=len(shapes) * len(methods), desc="eigenmodes")
    for name, cloud, exact, change, bound in shapes:
        if name != "sphere":
            quantity = "change of the reference, degree 12 to 16, relative"
            rows.append(Row(quantity, change, {"surface": name}, None, "project", bound / 100))
        for method in methods:
            modes = js.eigenmodes(js.laplace_beltrami(cloud, method=method), _COUNT + 1)
            error = float(np.abs(np.asarray(modes.values)[1:] / exact - 1).max())
            setting = {"surface": name, "method": method_name(method), "n": cloud.n}
            quantity = f"largest relative error of {_COUNT} non-zero eigenvalues"
            rows.append(Row(quantity, error, setting, None, "project", bound))
            quantity = "largest imaginary part over its eigenvalue"
            size = float(np.max(np.asarray(modes.imaginary)[1:] / exact))
            rows.append(Row(quantity, size, setting, 0.0, "project"))
            progress.update()
        drawn.append((name, cloud, modes))
    progress.close()
    _draw(out / "eigenmodes.png", drawn)
    return rows


def _converged(values, coarse: int, fine: int) -> tuple[np.ndarray, float]:
    better = values(fine)
    return better, float(np.abs(values(coarse) / better - 1).max())


def _draw(path: Path, drawn) -> None:
    """Three modes of every surface."""
    figure, axes = plt.subplots(len(drawn), 3, figsize=(9, 3 * len(drawn)), layout="constrained")
    for row, (name, cloud, modes) in zip(axes, drawn):
        for ax, i in zip(row, (2, 7, 23)):
            mode = modes.functions[:, i]
            limit = float(np.abs(mode).max())
            title = f"{name}: {float(modes.values[i]):.4f}"
            plot_cloud(cloud, mode, ax=ax, title=title, limits=(-limit, limit))
    figure.savefig(path, dpi=130)
    plt.close(figure)
