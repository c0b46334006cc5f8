"""Normals at the vertices of a mesh: those in its file, and those of fits."""

from __future__ import annotations

import numpy as np

from jaxsurf.failures import raise_at, warn
from jaxsurf.formats.contents import Contents
from jaxsurf.shapes.cleaning import merge_equal
from jaxsurf.shapes.meshes import TriangleMesh
from jaxsurf.shapes.smooth import fit_surface, vertices_needed


def unit_normals(normals: np.ndarray, on: np.ndarray | bool = True) -> np.ndarray:
    length = np.linalg.norm(normals, axis=1)
    bad = on & ~(np.isfinite(length) & (length > 0))
    length = np.where(on, length, 1)
    text = "normal {i} is {v}, expected a direction (normals=False takes none from the file)"
    raise_at(bad, text, normals)
    return normals / length[:, None]


def own_normals(contents: Contents, kept) -> np.ndarray:
    """Those in the file at the vertices of the mesh, of any length; of merged ones the sum."""
    assert contents.normals is not None
    first, group = merge_equal(contents.points)
    total = np.zeros((len(first), 3))
    np.add.at(total, group, contents.normals)
    return total[group[kept]]


def turned_to(path, mesh: TriangleMesh, normals: np.ndarray) -> TriangleMesh:
    """The mesh with each piece turned to the side that most of the normals on it point to."""
    own = np.nan_to_num(normals)[mesh.triangles].sum(axis=1)
    votes = np.bincount(mesh.components, np.sign(np.sum(own * mesh.face_normals, axis=1)))
    turned = (votes < 0)[mesh.components]
    if not turned.any():
        return mesh
    warn(
        f"{path}: on {turned.sum()} of {len(turned)} triangles normals point to the other side "
        "than the order of corners tells: these are turned round to them"
    )
    triangles = np.where(turned[:, None], mesh.triangles[:, ::-1], mesh.triangles)
    return TriangleMesh(mesh.vertices, triangles)


# Normals in a file are no better than those of triangles where they are as far from those of a fit
# to a share of this, if that is more than this angle; told from so many of them.
_SHARE, _ANGLE, _SAMPLE = 0.3, 3e-4, 2_000


def compare_normals(path, mesh: TriangleMesh, normals: np.ndarray, degree: int) -> None:
    """Warn of normals of first order."""
    n = len(mesh.vertices)
    if n < vertices_needed(degree + 2):
        return
    rows = np.linspace(0, n - 1, min(n, _SAMPLE)).astype(int)
    place = mesh.vertices[rows], mesh.vertex_normals[rows], mesh
    _, fitted, used = fit_surface(*place, degree)
    good = used == degree
    if not good.any():
        return
    others = normals[rows], mesh.vertex_normals[rows], fit_surface(*place, degree + 2)[1]
    off = (np.median(np.linalg.norm(other - fitted, axis=1)[good]) for other in others)
    own, plain, unsure = off
    if own > max(_ANGLE, _SHARE * plain, unsure):
        warn(
            f"{path}: normals in the file are {own:.2g} rad off those of fits of degree {degree} "
            f"(median), those of the triangles {plain:.2g}. normals=False takes those of the fits, "
            "smooth=False says that edges are sharp"
        )


def fitted_normals(path, mesh: TriangleMesh, degree: int) -> np.ndarray:
    need = vertices_needed(degree)
    if len(mesh.vertices) < need:
        raise ValueError(
            f"{len(mesh.vertices)} vertices, normals of degree {degree} need at least"
            f" {need}: lower the degree or take smooth=False"
        )
    _, normals, used = fit_surface(mesh.vertices, mesh.vertex_normals, mesh, degree)
    low = np.count_nonzero(used < degree)
    if low:
        warn(
            f"{path}: the neighbours of {low} of {len(used)} vertices allow no fit of degree"
            f" {degree}; the lowest degree used for a normal is {used.min()}"
        )
    return normals
