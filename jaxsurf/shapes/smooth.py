"""The smooth surface that the vertices of a mesh lie on, by local polynomial fits."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray as Array
from scipy import sparse
from scipy.spatial import cKDTree

from jaxsurf.fits.monomials import polynomial_count
from jaxsurf.fits.plane import TangentPlane
from jaxsurf.frames import frames_of
from jaxsurf.shapes.meshes import TriangleMesh

# Cosine of the largest angle between a fitted normal and that of the mesh: 35 degrees.
_MOST_TURN = 0.82
# Of the normal equations of a fit: the vertices determine it where their condition is below.
_WORST = 1e4
# Vertices looked at in turn, in units of the usual number: around a pole many are on a few rings.
_WIDER = (1, 4, 12)
# Longest edges are made at most so many times as short beside the shortest.
_LONGEST = 16.0


def fit_surface(
    points: Float[Array, "q 3"], normals: Float[Array, "q 3"], mesh: TriangleMesh, degree: int
) -> tuple[Float[Array, "q 3"], Float[Array, "q 3"], Int[Array, " q"]]:
    """Move points along their normals onto local polynomial fits of the vertices.

    Around each point the nearest vertices on the same sheet (normals within 75 degrees) are
    fitted by a height polynomial over the tangent plane, with weights that decay from the
    point; its value at the point is the new position, its slope the new normal. Twice, the
    second time over the improved plane. Near is what few edges lead to: where a mesh is long in one
    direction, as many vertices count in the other. Where they do not determine a polynomial of
    this degree, or it turns the normal by more than 35 degrees, more of them are taken, then a
    lower degree, down to two: a plane is no better than the triangles.

    Args:
        points: places near the surface, `(q, 3)`.
        normals: unit normals there, `(q, 3)`.
        mesh: its vertices are points of the surface.
        degree: degree of the polynomials.

    Returns:
        New points, new normals, and the degree used at each point (0: left where it was).
    """
    points, normals = points.copy(), normals.copy()
    tree = cKDTree(mesh.vertices)
    stretch = _stretch(mesh)[tree.query(points)[1]]
    used = np.zeros(len(points), np.int64)
    order = np.argsort(_length(stretch), kind="stable")
    tries = [(degree, wider) for wider in _WIDER] + [(p, 1) for p in range(degree - 1, 1, -1)]
    for todo in np.array_split(order, 1 + len(points) // 2048):
        for p, wider in tries:
            if not todo.size:
                break
            x, m, good = points[todo], normals[todo], np.ones(len(todo), bool)
            for _ in range(2):
                x, m, solved = _fit_once(x, m, stretch[todo], tree, mesh, p, wider)
                good &= solved
            # Extrapolated over noisy borders, high degrees turn the normal at will; no mesh
            # that resolves its surface has normals this far from those of its triangles.
            good &= np.sum(m * normals[todo], axis=1) > _MOST_TURN
            points[todo[good]], normals[todo[good]], used[todo[good]] = x[good], m[good], p
            todo = todo[~good]
    return points, normals, used


def vertices_needed(degree: int) -> int:
    """The fewest that a fit of this degree is made of."""
    return polynomial_count(2, degree) + 2


def _fit_once(points, normals, stretch, tree, mesh, degree, wider):
    need = vertices_needed(degree)
    k = min(wider * 2 * need, tree.n)
    slots, squared = _nearest(points, stretch, tree, mesh, k)
    radius, normals = np.sqrt(squared.max(axis=0)), normals.T
    offsets = np.stack([v[slots] - x for v, x in zip(mesh.vertices.T, points.T)], axis=1)
    same = sum(v[slots] * n for v, n in zip(mesh.vertex_normals.T, normals)) > 0.25
    weights = np.where(same, np.exp(-5 * squared / radius**2), 0)
    plane = TangentPlane.at(normals, offsets, weights, radius, radius)
    stretch = np.einsum("iap,pab,jbp->ijp", plane.tangents, stretch, plane.tangents)
    plane = replace(plane, points=np.einsum("ijp,jkp->ikp", stretch, plane.points))
    c, condition = plane.surface(0, degree)
    # A fit that lifts a point by more than the distance between vertices is no fit.
    enough = (same.sum(axis=0) >= need) & (condition < _WORST)
    enough &= np.abs(c[0]) < 1 / math.sqrt(k)
    c = np.where(enough, c, 0)
    slopes = np.einsum("ijp,jp->ip", stretch, c[1:3])
    return points + (c[0] * radius * normals).T, plane.tilted(normals, slopes).T, enough


def _nearest(points, stretch, tree, mesh, k):
    """The k vertices nearest to each point by stretched distance, and its square, `(k, q)`."""
    # Of a disk r times as long as wide: its circle holds r times as many.
    within = min(math.ceil(k * _length(stretch).max()), tree.n)
    slots = tree.query(points, k=range(1, within + 1))[1]
    offsets = mesh.vertices[slots] - points[:, None]
    squared = np.sum((offsets @ stretch) ** 2, axis=2)
    order = np.argpartition(squared, k - 1, axis=1)[:, :k]
    slots, squared = (np.take_along_axis(a, order, axis=1) for a in (slots, squared))
    return slots.T, squared.T


def _stretch(mesh: TriangleMesh) -> Float[Array, "n 3 3"]:
    """Symmetric matrices that make edges equally long in all directions, and keep areas."""
    ends, n = mesh.edge_table.ends, len(mesh.vertices)
    edges = mesh.vertices[ends[:, 1]] - mesh.vertices[ends[:, 0]]
    places = np.repeat(np.arange(len(ends)), 2)
    at = sparse.csr_array((np.ones(2 * len(ends)), (ends.ravel(), places)), (n, len(ends)))
    spread = at @ (edges[:, :, None] * edges[:, None]).reshape(-1, 9)
    spread = (at @ (at.T @ spread)).reshape(-1, 3, 3)  # of the vertices around too
    frames = np.asarray(frames_of(mesh.vertex_normals))
    tangents, normal = frames[:, :2], frames[:, 2]
    c = np.einsum("nia,nab,njb->nij", tangents, spread, tangents)
    c = c + c.trace(axis1=1, axis2=2)[:, None, None] / _LONGEST**2 * np.eye(2)
    # Of two by two: c^(1/2) is (c + s) / (tr c + 2 s)^(1/2), with s^2 = det c.
    trace = c.trace(axis1=1, axis2=2)
    with np.errstate(invalid="ignore", divide="ignore"):  # at vertices of no triangle
        s = np.sqrt(np.linalg.det(c))
        inverse = (trace + s)[:, None, None] * np.eye(2) - c
        root = inverse / np.sqrt((trace + 2 * s) * s)[:, None, None]
    stretch = np.einsum("nia,nij,njb->nab", tangents, root, tangents)
    stretch = stretch + normal[:, :, None] * normal[:, None]
    return np.where(np.isfinite(stretch), stretch, np.eye(3))


def _length(stretch):
    """How many times as long as wide what they make a circle is."""
    return np.sum(stretch**2, axis=(1, 2)) - 1
