r"""Functionals of surfaces $F(S_0)$ and their derivatives in F, to spectral accuracy.

The reference surface $S_0$, a sphere or torus, has a quadrature that is exact for polynomials of
high degree and a basis with exponential convergence; metric, stiffness and mass of the image follow
from the derivative of F. Nothing here knows stencils, neighbours or point clouds.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg
from jaxtyping import Array, Float

import jaxsurf as js


class Reference(NamedTuple):
    """A surface with a quadrature and a basis.

    Args:
        points, weights: of the quadrature.
        normal: unit normal as a function of a point.
        basis: values of all basis functions at a point.
    """

    points: Float[Array, "q 3"]
    weights: Float[Array, " q"]
    normal: Callable
    basis: Callable


def sphere(degree: int) -> Reference:
    """The unit sphere with spherical harmonics."""
    z, share = np.polynomial.legendre.leggauss(2 * degree)
    phi = np.pi * (np.arange(4 * degree) + 0.5) / (2 * degree)
    ring = np.sqrt(1 - z**2)[:, None]
    x = np.stack([ring * np.cos(phi), ring * np.sin(phi), z[:, None] + 0 * phi], axis=-1)
    weights = np.repeat(share, len(phi)) * np.pi / (2 * degree)
    return Reference(
        jnp.asarray(x.reshape(-1, 3)), jnp.asarray(weights), lambda x: x / jnp.linalg.norm(x),
        lambda x: js.spherical_harmonics(x / jnp.linalg.norm(x), degree),
    )  # fmt: skip


def torus(R: float, r: float, degree: int) -> Reference:
    """A torus with trigonometric polynomials in both angles."""
    u = 2 * np.pi * np.arange(4 * degree) / (4 * degree)
    v = u[:, None]
    ring = R + r * np.cos(v)
    x = np.stack([ring * np.cos(u), ring * np.sin(u), r * np.sin(v) + 0 * u], axis=-1)
    weights = (r * ring * (2 * np.pi / len(u)) ** 2 + 0 * u).ravel()

    def normal(x):
        return (x - R * _ring(x)) / jnp.linalg.norm(x - R * _ring(x))

    def basis(x):
        rho = jnp.linalg.norm(x[:2])
        angles = jnp.stack([jnp.arctan2(x[1], x[0]), jnp.arctan2(x[2], rho - R)])
        k = jnp.arange(1, degree + 1)[:, None] * angles
        each = jnp.concatenate([jnp.ones((1, 2)), jnp.cos(k), jnp.sin(k)])
        return jnp.outer(each[:, 0], each[:, 1]).ravel()

    return Reference(jnp.asarray(x.reshape(-1, 3)), jnp.asarray(weights), normal, basis)


def _ring(x):
    """The unit vector from the axis."""
    return jnp.array([x[0], x[1], 0.0]) / jnp.linalg.norm(x[:2])


def torus_map(x, radii, R: float = 1.0):
    """The torus of these radii, from any around the same circle."""
    tube = x - R * _ring(x)
    return radii[0] * _ring(x) + radii[1] * tube / jnp.linalg.norm(tube)


class Matrices(NamedTuple):
    """What functionals of the image need, at the nodes and in the basis."""

    points: Array
    normals: Array
    areas: Array
    mean_curvature: Array
    stiffness: Array
    mass: Array


def matrices(reference: Reference, F: Callable, theta) -> Matrices:
    """Of the image of the reference under `F(x, theta)`."""
    image = lambda x: F(x, theta)

    def along(x):
        """Orthonormal tangents, smooth but on the axis, where no node is."""
        around = jnp.array([-x[1], x[0], 0.0]) / jnp.linalg.norm(x[:2])
        return jnp.stack([around, jnp.cross(reference.normal(x), around)])

    def slopes(f, x):
        return jax.vmap(lambda t: jax.jvp(f, (x,), (t,))[1])(along(x))

    def normal(x):
        n = jnp.cross(*slopes(image, x))
        return n / jnp.linalg.norm(n)

    def of_node(x):
        moved = slopes(image, x)
        metric = moved @ moved.T
        inverse = jnp.linalg.inv(metric)
        bend = slopes(normal, x) @ moved.T
        h = jnp.trace(inverse @ bend) / 2
        return image(x), normal(x), jnp.sqrt(jnp.linalg.det(metric)), h, inverse

    points, normals, stretch, h, inverse = jax.vmap(of_node)(reference.points)
    areas = reference.weights * stretch
    values = jax.vmap(reference.basis)(reference.points)
    gradients = jax.vmap(lambda x: slopes(reference.basis, x))(reference.points)
    flux = areas[:, None, None] * jnp.einsum("qab,qbi->qai", inverse, gradients)
    stiffness = jnp.einsum("qai,qaj->ij", gradients, flux)
    mass = values.T @ (areas[:, None] * values)
    return Matrices(points, normals, areas, h, stiffness, mass)


def functionals(
    reference: Reference, F: Callable, theta, directions: list, fields: dict, first: int,
    last: int, time: float,
) -> list[dict[str, tuple[float, float]]]:  # fmt: skip
    """Values and derivatives along each of the directions.

    Args:
        fields: "load", "start" and "weight" as functions of points of the reference.
        first, last: the group of eigenvalues whose mean is taken, the zero counted as 0.
        time: of the heat content.
    """
    along = jax.jit(
        lambda theta, dot: jax.jvp(lambda t: matrices(reference, F, t), (theta,), (dot,))
    )
    nodes = {name: np.asarray(jax.vmap(f)(reference.points)) for name, f in fields.items()}
    basis = np.asarray(jax.vmap(reference.basis)(reference.points))
    return [
        _along(*jax.tree.map(np.asarray, along(theta, dot)), nodes, basis, slice(first, last + 1),
               time)
        for dot in directions
    ]  # fmt: skip


def _along(m: Matrices, dm: Matrices, nodes: dict, basis, group: slice, time: float) -> dict:
    r"""Values and derivatives from matrices and theirs.

    The heat content is $w^T e^{-tA} s$ with $A = M^{-1} K$; the derivative of the exponential has
    divided differences of $e^{-t\lambda}$ between the modes of A (Daleckii and Krein).
    """
    rates, modes = scipy.linalg.eigh(m.stiffness, m.mass)
    # The derivative of A between modes.
    mixed = modes.T @ dm.stiffness @ modes - (modes.T @ dm.mass @ modes) * rates

    height = np.sum(m.points * m.normals, axis=1)
    rise = np.sum(dm.points * m.normals + m.points * dm.normals, axis=1)
    h, dh = m.mean_curvature, dm.mean_curvature
    load, dload, weight, dweight = (
        basis.T @ (areas * nodes[name])
        for name in ("load", "weight")
        for areas in (m.areas, dm.areas)
    )
    solved = np.linalg.solve(m.stiffness + m.mass, load)
    stiffer = solved @ (dm.stiffness + dm.mass) @ solved
    # Exactly, since the basis holds the field.
    start = modes.T @ m.mass @ np.linalg.lstsq(basis, nodes["start"])[0]
    fall = np.exp(-time * rates)
    apart = rates[:, None] - rates
    near = np.abs(apart) < 1e-6 * rates[-1]
    between = np.where(
        near, -time * fall[:, None], (fall[:, None] - fall) / np.where(near, 1, apart)
    )
    seen = weight @ modes
    return {
        "area": (m.areas.sum(), dm.areas.sum()),
        "volume": (m.areas @ height / 3, (dm.areas @ height + m.areas @ rise) / 3),
        "int H^2": (m.areas @ h**2, dm.areas @ h**2 + 2 * m.areas @ (h * dh)),
        "eigenvalue group": (rates[group].mean(), np.diag(mixed)[group].mean()),
        "compliance": (load @ solved, 2 * dload @ solved - stiffer),
        "heat content": (
            seen @ (fall * start),
            dweight @ modes @ (fall * start) + seen @ (between * mixed) @ start,
        ),
    }  # fmt: skip
