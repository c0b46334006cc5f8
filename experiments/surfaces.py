"""Surfaces of the studies: points of several kinds, and exact Laplacians of a test field."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
import scipy.special
from jaxtyping import Array, Float

import jaxsurf as js
from jaxsurf.shapes import analytic
from jaxsurf.shapes.sampling import Project, jitter
from jaxsurf.shapes.spacing import ideal_spacing
from jaxsurf.shapes.thinning import thin


@dataclass(frozen=True)
class Surface:
    """A closed surface about which everything is known.

    Args:
        name: for tables.
        regular: n points in the order of the maker.
        project: closest points and their normals.
        phi: level set function, growing outwards.
        area: exact.
        size: largest distance from the origin.
        parametric: maps points of the unit square to points and area elements.
    """

    name: str
    regular: Callable[[int], js.PointCloud]
    project: Project
    phi: Callable[[Float[Array, " 3"]], Float[Array, ""]]
    area: float
    size: float
    parametric: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]

    def spacing(self, n: int) -> float:
        return ideal_spacing(self.area, n)

    def uniform(self, m: int, *, seed: int = 0) -> np.ndarray:
        """m independent points, uniform by area (rejection)."""
        rng = np.random.default_rng((seed, 7))
        found: list[np.ndarray] = []
        while sum(map(len, found)) < m:
            points, element = self.parametric(rng.random((4 * m, 2)))
            found.append(points[rng.random(len(points)) * element.max() < element])
        return np.concatenate(found)[:m]

    def cloud(self, kind: str, n: int, *, seed: int = 0) -> js.PointCloud:
        """n points: "regular", "jittered", "Poisson disk" or "random"."""
        if kind == "regular":
            return self.regular(n)
        if kind == "jittered":
            moved = jitter(self.regular(n), self.project, spacing=self.spacing(n), seed=seed)
            return js.sort_cloud(moved)[0]
        if kind == "Poisson disk":
            candidates = self.uniform(8 * n, seed=seed)
            points = candidates[thin(candidates, n, seed=seed)]
        elif kind == "random":
            points = self.uniform(n, seed=seed)
        else:
            raise ValueError(f"no kind of points is called {kind!r}")
        points, normals = self.project(points)
        return js.sort_cloud(js.PointCloud(jnp.asarray(points), jnp.asarray(normals)))[0]

    def exact(self, cloud: js.PointCloud) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
        """The test field on the surface and its Laplacian."""
        return exact(self.phi, self.size, cloud)


def exact(phi, size: float, cloud: js.PointCloud) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
    r"""exp((x + 2 y + 1.5 z) / size), without a symmetry that could flatter a method.

    $\Delta_S u = \Delta u - 2 H\,\partial_n u - n^T (\nabla\nabla u)\,n$ on {phi = 0}.
    """

    def field(x):
        return jnp.exp(jnp.dot(jnp.array([1.0, 2.0, 1.5]), x) / size)

    x = cloud.points
    n = js.level_set_normals(phi, x)
    mean = js.level_set_curvature(phi, x)[0]
    gradient = jax.vmap(jax.grad(field))(x)
    hessian = jax.vmap(jax.hessian(field))(x)
    laplacian = (
        jnp.trace(hessian, axis1=1, axis2=2)
        - 2 * mean * jnp.sum(gradient * n, axis=1)
        - jnp.einsum("na,nab,nb->n", n, hessian, n)
    )
    return jax.vmap(field)(x), laplacian


def _sphere_from_square(square: np.ndarray) -> np.ndarray:
    z, angle = 2 * square[:, 0] - 1, 2 * np.pi * square[:, 1]
    rho = np.sqrt(1 - z * z)
    return np.stack([rho * np.cos(angle), rho * np.sin(angle), z], axis=1)


def sphere() -> Surface:
    def parametric(square):
        return _sphere_from_square(square), np.ones(len(square))

    return Surface(
        "sphere",
        js.sphere,
        analytic.sphere_projection(),
        lambda x: jnp.sum(x * x) - 1,
        4 * np.pi,
        1.0,
        parametric,
    )


def ellipsoid(axes: tuple[float, float, float] = (1.0, 0.8, 0.75)) -> Surface:
    semi = np.array(axes)

    def parametric(square):
        on_sphere = _sphere_from_square(square)
        return on_sphere * semi, np.linalg.norm(on_sphere / semi, axis=1)

    a, b, c = semi**2
    return Surface(
        "ellipsoid",
        lambda n: js.ellipsoid(n, axes),
        analytic.ellipsoid_projection(axes),
        lambda x: jnp.sum((x / jnp.asarray(semi)) ** 2) - 1,
        float(4 * np.pi * scipy.special.elliprg(a * b, a * c, b * c)),
        max(axes),
        parametric,
    )


def torus(R: float = 3.0, r: float = 1.0) -> Surface:
    def parametric(square):
        angle, around = 2 * np.pi * square.T
        reach = R + r * np.cos(around)
        points = np.stack([reach * np.cos(angle), reach * np.sin(angle), r * np.sin(around)], 1)
        return points, reach

    return Surface(
        "torus",
        lambda n: js.torus(n, R, r),
        analytic.torus_projection(R, r),
        lambda x: (jnp.sqrt(x[0] ** 2 + x[1] ** 2) - R) ** 2 + x[2] ** 2 - r**2,
        4 * np.pi**2 * R * r,
        R + r,
        parametric,
    )
