"""Normals at the vertices of a mesh: those in its file, and those of fits."""

from __future__ import annotations

import math

import numpy as np

from jaxsurf.failures import raise_at, warn
from jaxsurf.formats.contents import Contents
from jaxsurf.shapes.cleaning import merge_equal
from jaxsurf.shapes.meshes import TriangleMesh
from jaxsurf.shapes.smooth import fit_surface


def unit_normals(normals: np.ndarray, on: np.ndarray | bool = True) -> np.ndarray:
    length = np.linalg.norm(normals, axis=1)
    bad = on & ~(np.isfinite(length) & (length > 0))
    length = np.where(on, length, 1)
    raise_at(bad, "normal {i} is {v}, expected a direction", normals)
    return normals / length[:, None]


def own_normals(contents: Contents, kept) -> np.ndarray:
    """Those in the file at the vertices of the mesh; the mean of those that were merged."""
    assert contents.normals is not None
    first, group = merge_equal(contents.points)
    total = np.zeros((len(first), 3))
    np.add.at(total, group, contents.normals)
    return unit_normals(total[group[kept]])


def turned_to(path, mesh: TriangleMesh, normals: np.ndarray) -> TriangleMesh:
    """The mesh with the side that normals point to."""
    others = np.sum(mesh.vertex_normals * normals, axis=1) < 0
    if 2 * np.count_nonzero(others) <= len(others):
        return mesh
    warn(
        f"{path}: {np.count_nonzero(others)} of {len(others)} normals point to the other side than "
        "the order of corners tells: triangles are turned round to theirs"
    )
    return TriangleMesh(mesh.vertices, mesh.triangles[:, ::-1])


# Normals in a file are no better than those of triangles where they are as far from those of a fit
# to a share of this, if that is more than this angle.
_SHARE, _ANGLE = 0.3, 3e-4


def compare_normals(path, mesh: TriangleMesh, normals: np.ndarray, degree: int) -> None:
    """Warn of normals of first order."""
    if len(mesh.vertices) < math.comb(degree + 2, 2) + 2:
        return
    _, fitted, used = fit_surface(mesh.vertices, mesh.vertex_normals, mesh, degree)
    good = used == degree
    if not good.any():
        return
    off = [np.linalg.norm(some - fitted, axis=1)[good] for some in (normals, mesh.vertex_normals)]
    own, plain = map(np.median, off)
    if own > max(_ANGLE, _SHARE * plain):
        warn(
            f"{path}: normals in the file are {own:.2g} rad off those of fits of degree {degree} "
            f"(median; at most {off[0].max():.2g}), those of the triangles {plain:.2g}. "
            "normals=False takes those of the fits, smooth=False says that edges are sharp"
        )


def fitted_normals(path, mesh: TriangleMesh, degree: int) -> np.ndarray:
    need = math.comb(degree + 2, 2) + 2
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
