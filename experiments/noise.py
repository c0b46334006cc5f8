r"""Noise of 1 to 10 % of the spacing: errors of normals, curvature, Laplacians and solutions.

On a torus, where all is known, and on the bunny, where the reference is what the same method makes
of the same points without noise. Points are moved in all directions; normals are estimated from
the moved points, by fits of the degree of the method to as many points as it has neighbours. The
field is $e^{(x + 2y + 1.5z)/s}$ in space; its values stay those at the points without noise. The
solution is that of $u - \ell^2 \Delta_S u = f$, $\ell$ a tenth of the size: a step of heat. Beside
it (extra `peers`) what robust_laplacian (Sharp and Crane 2020) makes of the same points.
"""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import NamedTuple

import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import scipy.sparse as sp
from jaxtyping import Array, Float
from scipy.sparse.linalg import spsolve
from tqdm import tqdm

import jaxsurf as js

try:
    import robust_laplacian
except ImportError:
    robust_laplacian = None

from . import data, surfaces
from .report import Row, method_name, relative_l2

_SHARES = (0.0, 0.01, 0.02, 0.05, 0.1)
_QUANTITIES = ("normals, rad", "mean curvature", "Laplacian of a field", "solution")


class Reader(NamedTuple):
    """A method, and of how many neighbours in units of the usual number."""

    method: js.GFDM
    wider: int

    @property
    def name(self) -> str:
        return method_name(self.method) + (f", {self.wider} k" if self.wider > 1 else "")


class Case(NamedTuple):
    """Points without noise, their spacing, a field, a right-hand side; and what is known."""

    name: str
    cloud: js.PointCloud
    spacing: float
    field: Float[Array, " n"]
    rhs: Float[Array, " n"]
    exact: dict[str, Array] | None

    @property
    def scale(self) -> float:
        """Squared length that the solution is smoothed over."""
        return _scale(self.cloud)


def _scale(cloud: js.PointCloud) -> float:
    return float(jnp.ptp(cloud.points, axis=0).max() / 10) ** 2


def torus(n: int) -> Case:
    of = surfaces.torus()
    cloud = of.cloud("Poisson disk", n)
    mean = js.level_set_curvature(of.phi, cloud.points)[0]
    field, laplacian = of.exact(cloud)
    exact = dict(zip(_QUANTITIES, (cloud.normals, mean, laplacian, field)))
    return Case("torus", cloud, of.spacing(n), field, field - _scale(cloud) * laplacian, exact)


def bunny(n: int) -> Case:
    """Its texture is finer than the points: what each method makes of these is the reference."""
    cloud = data.bunny(n)
    field = jnp.exp(cloud.points @ jnp.array([1.0, 2.0, 1.5]) / jnp.ptp(cloud.points))
    spacing = float((js.discretize(cloud).cell_areas.sum() / n) ** 0.5)
    return Case("bunny", cloud, spacing, field, field, None)


def moved(case: Case, share: float) -> Float[Array, "n 3"]:
    """Its points with this share of noise."""
    shift = np.random.default_rng(0).normal(size=case.cloud.points.shape)
    return case.cloud.points + share * case.spacing * jnp.asarray(shift)


def results(case: Case, reader: Reader, share: float) -> dict[str, Array]:
    """Everything on points with this share of noise."""
    method, k = reader.method, reader.wider * reader.method.neighbor_count(3)
    clean, points = case.cloud, moved(case, share)
    normals = js.estimate_normals(points, degree=method.degree, k=k)
    normals = normals * jnp.sign(jnp.sum(normals * clean.normals, axis=1, keepdims=True))
    cloud = js.PointCloud(points, normals, boundary=clean.boundary)
    neighbors = js.find_neighbors(cloud, k, throw=False)
    if reader.wider == 1:
        neighbors = js.choose_neighbors(cloud, method=method, throw=False)
    surface = js.discretize(cloud, neighbors, method=method)
    closure = None
    if cloud.boundary is not None:
        closure = js.eliminate(cloud, js.dirichlet(cloud.boundary, case.field[cloud.boundary]))
    solution = js.solve(1 - case.scale * surface.laplacian, case.rhs, closure=closure).value
    found = (normals, surface.mean_curvature, surface.laplacian(case.field), solution)
    return dict(zip(_QUANTITIES, found))


class Peer:
    """robust_laplacian: linear elements on triangles of every neighbourhood."""

    name = "robust_laplacian"


def results_of_peer(case: Case, share: float) -> dict[str, Array]:
    """The same; normals, which it does not make, are those without noise."""
    points, field = np.asarray(moved(case, share)), np.asarray(case.field)
    stiffness, mass = robust_laplacian.point_cloud_laplacian(points)
    per_area = sp.diags_array(1 / mass.diagonal()) @ stiffness
    normals = case.cloud.normals
    curvature = jnp.sum(jnp.asarray(per_area @ points) * normals, axis=1) / 2
    system = sp.csr_array(mass + case.scale * stiffness)
    border = case.cloud.boundary
    free = np.ones(len(points), bool) if border is None else ~np.asarray(border)
    rhs = mass @ np.asarray(case.rhs) - system[:, ~free] @ field[~free]
    solution = field.copy()
    solution[free] = spsolve(sp.csc_array(system[free][:, free]), rhs[free])
    found = (normals, curvature, jnp.asarray(-per_area @ field), jnp.asarray(solution))
    return dict(zip(_QUANTITIES, found))


def _made(case: Case, reader: Reader | Peer, share: float) -> dict[str, Array] | None:
    """The results, or None where the noise leaves a point too few neighbours on its side."""
    if isinstance(reader, Peer):
        return results_of_peer(case, share)
    try:
        return results(case, reader, share)
    except ValueError as error:
        print(f"{case.name}, {reader.name}, noise {share}: {error}")
        return None


def errors(case: Case, found: dict[str, Array] | None, exact: dict[str, Array]) -> dict[str, float]:
    """Relative l2 errors inside, of the normals the root mean square of the angle.

    No numbers of results that there are none of.
    """
    if found is None:
        return dict.fromkeys(_QUANTITIES, np.nan)
    border = case.cloud.boundary
    inner = slice(None) if border is None else ~np.asarray(border)
    off = {name: relative_l2(found[name][inner], exact[name][inner]) for name in _QUANTITIES}
    cosine = jnp.sum(found["normals, rad"] * exact["normals, rad"], axis=1)
    angle = jnp.arccos(jnp.clip(cosine, -1, 1))
    return off | {"normals, rad": float(jnp.sqrt(jnp.mean(angle**2)))}


_READERS = [Reader(js.GFDM(degree=p), wider) for p in (2, 4) for wider in (1, 2, 4)]
_QUICK = [_READERS[3], _READERS[1]]
# With noise of a tenth of the spacing: solutions of the default, curvature of twice the neighbours.
_BOUNDS = {(_READERS[3], "solution"): 0.02, (_READERS[1], "mean curvature"): 0.05}
# Ten times the noise may add more than ten times the error by this factor.
_STEEPER = 2.0


def _added(values: list[float]) -> float:
    """What noise of 10 % adds to an error, over ten times what 1 % adds, all as squares add."""
    clean, one, *_, ten = np.square(values)
    return float(np.sqrt(max(ten - clean, 0) / max(one - clean, 1e-4 * ten)) / 10)


def run(quick: bool, out: Path) -> list[Row]:
    cases = [torus(2_000)]
    if not quick:
        try:
            cases.append(bunny(10_000))
        except FileNotFoundError as error:
            print(f"without the bunny: {error}")
    rows: list[Row] = []
    seen: dict[tuple[str, str], dict[str, list[float]]] = {}
    for case in cases:
        # Wide lists of a degree that noise needs to be low for: once is enough.
        readers: list[Reader | Peer] = [*(_QUICK if quick else _READERS)]
        if case.name != "torus":
            readers = readers[:-1]
        if robust_laplacian is not None:
            readers.append(Peer())
        for reader in tqdm(readers, desc=f"noise, {case.name}"):
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", UserWarning)  # it bends within one stencil
                made = [_made(case, reader, share) for share in _SHARES]
                exact = case.exact or made[0]
                assert exact is not None
                found = [errors(case, one, exact) for one in made]
            curves = {name: [one[name] for one in found] for name in found[0]}
            seen[case.name, reader.name] = curves
            setting = {"surface": case.name, "n": case.cloud.n, "method": reader.name}
            known = case.name == "torus"
            for name, values in curves.items():
                for share, value in zip(_SHARES, values):
                    last = known and share == _SHARES[-1]
                    bound = _BOUNDS.get((reader, name)) if last else None
                    rows.append(
                        Row(name, value, setting | {"noise": share}, None, "project", bound)
                    )
                usual = isinstance(reader, Reader) and reader.wider == 1
                bound = _STEEPER if known and usual else None
                name = f"{name}: growth over proportional"
                rows.append(Row(name, _added(values), setting, None, "project", bound))
    _picture(out / "noise.png", seen)
    return rows


def _picture(path: Path, seen: dict) -> None:
    surfaces_, names = (list(dict.fromkeys(column)) for column in zip(*seen))
    figure, axes = plt.subplots(len(surfaces_), 4, figsize=(14, 3.4 * len(surfaces_)),
                                layout="constrained", squeeze=False)  # fmt: skip
    for line, surface in zip(axes, surfaces_):
        for ax, quantity in zip(line, _QUANTITIES):
            for name in names:
                if (surface, name) in seen:
                    ax.plot(_SHARES, seen[surface, name][quantity], ".-", label=name)
            ax.set(yscale="log", title=f"{surface}: {quantity}", xlabel="noise over spacing")
            ax.set_xscale("symlog", linthresh=0.01)
    axes[0, 0].legend(fontsize=7)
    figure.savefig(path, dpi=120)
    plt.close(figure)
