"""Surfaces as users bring them: in parts, with holes, with edges of three triangles, bare points.

Meshes are vertices and triangles as a file has them. All are smooth, so that nothing but what is
wrong with them is wrong.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray as Array
from scipy.spatial import ConvexHull

import jaxsurf as js

Mesh = tuple[Float[Array, "n 3"], Int[Array, "m 3"]]


def star(n: int) -> Mesh:
    """A round body with bumps, of n vertices."""
    x = np.asarray(js.sphere(n).points)
    triangles = ConvexHull(x).simplices
    a, b, c = x[triangles].swapaxes(0, 1)
    inward = np.einsum("md,md->m", np.cross(b - a, c - a), a) < 0
    triangles[inward] = triangles[inward, ::-1]
    bump = np.sin(3 * x[:, 0]) * np.cos(2 * x[:, 1] - 1) + np.sin(4 * x[:, 2])
    return x * (1 + 0.12 * bump)[:, None], triangles


def ring(n: int, R: float = 2.2, r: float = 0.7, *, wall: bool = False) -> Mesh:
    """A torus with waves along it, of about n vertices in a grid.

    With a wall across its tube, on a circle whose edges then have three triangles.
    """
    around = round((n * r / R) ** 0.5)
    along = round(n / around)
    u, v = np.meshgrid(np.arange(along) / along, np.arange(around) / around, indexing="ij")
    u, v = 2 * np.pi * u.ravel(), 2 * np.pi * v.ravel()
    tube = r * (1 + 0.12 * np.sin(5 * u))
    reach = R + tube * np.cos(v)
    vertices = np.stack([reach * np.cos(u), reach * np.sin(u), tube * np.sin(v)], axis=1)
    a = np.arange(along * around).reshape(along, around)
    b = np.roll(a, -1, axis=0)
    c, d = np.roll(b, -1, axis=1), np.roll(a, -1, axis=1)
    corners = [(a, b, c), (a, c, d)]
    if wall:
        corners.append((a[0], d[0], np.full(around, len(vertices))))
        vertices = np.append(vertices, vertices[a[0]].mean(axis=0, keepdims=True), axis=0)
    return vertices, np.concatenate([np.stack([m.ravel() for m in t], axis=1) for t in corners])


def together(*meshes: Mesh) -> Mesh:
    """Several meshes in one file."""
    first = np.cumsum([0, *(len(vertices) for vertices, _ in meshes)])
    return (
        np.concatenate([vertices for vertices, _ in meshes]),
        np.concatenate([triangles + start for (_, triangles), start in zip(meshes, first)]),
    )


def moved(mesh: Mesh, by: tuple[float, float, float], scale: float = 1.0) -> Mesh:
    return scale * mesh[0] + np.array(by), mesh[1]


def holed(mesh: Mesh, radii: list[float], *, seed: int = 0) -> Mesh:
    """Without the triangles in balls of these radii about some vertices."""
    vertices, triangles = mesh
    middle = vertices[triangles].mean(axis=1)
    kept = np.ones(len(triangles), bool)
    centres = np.random.default_rng(seed).choice(len(vertices), len(radii), replace=False)
    for centre, radius in zip(vertices[centres], radii):
        kept &= np.linalg.norm(middle - centre, axis=1) > radius
    return vertices, triangles[kept]


def finned(mesh: Mesh, width: float = 0.3) -> Mesh:
    """With a fin on a path of edges from top to bottom, which then have three triangles."""
    vertices, triangles = mesh
    height = vertices[:, 2]
    around: dict[int, set[int]] = {}
    for corner in triangles.tolist():
        for vertex in corner:
            around.setdefault(vertex, set()).update(corner)
    path = [int(np.argmax(height))]
    while height[low := min(around[path[-1]], key=height.__getitem__)] < height[path[-1]]:
        path.append(low)
    feet = np.array(path)
    a, b = feet[:-1], feet[1:]
    d = len(vertices) + np.arange(len(a))
    c = d + 1
    fin = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
    raised = vertices[feet]
    raised = raised * (1 + width / np.linalg.norm(raised, axis=1, keepdims=True))
    return np.concatenate([vertices, raised]), np.concatenate([triangles, fin])


def write(path: Path, mesh: Mesh) -> Path:
    """An OBJ file."""
    vertices, triangles = mesh
    with path.open("w", encoding="utf-8") as file:
        np.savetxt(file, vertices, fmt="v %.15g %.15g %.15g")
        np.savetxt(file, triangles + 1, fmt="f %d %d %d")
    return path


def noisy(points: Float[Array, "n 3"], share: float, area: float, *, seed: int = 0):
    """With Gaussian noise of this share of the spacing in each direction."""
    noise = np.random.default_rng(seed).normal(size=points.shape)
    return points + share * (area / len(points)) ** 0.5 * noise
