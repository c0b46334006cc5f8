"""Quasi-uniform points on triangle meshes."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from numpy import ndarray as Array

from jaxsurf.arguments import instance, real, whole
from jaxsurf.cloud import PointCloud
from jaxsurf.failures import warn
from jaxsurf.shapes.closest import ClosestPoint
from jaxsurf.shapes.meshes import TriangleMesh
from jaxsurf.shapes.order import sort_cloud
from jaxsurf.shapes.sampling import quasi_uniform
from jaxsurf.shapes.smooth import fit_surface, vertices_needed
from jaxsurf.shapes.spacing import MOST, ideal_spacing, points_at


def sample_mesh(
    mesh: TriangleMesh,
    *,
    n: int | None = None,
    spacing: float | None = None,
    smooth: bool = True,
    degree: int = 4,
    seed: int = 0,
) -> PointCloud:
    r"""Quasi-uniform points on a triangle mesh, as many as asked for or that far apart.

    Borders are resampled first, along their length; then points spread over the triangles are
    thinned and relaxed between them. The flat triangles of a mesh are only second-order close
    to the surface it stands for, so the points are then moved onto local polynomial fits of
    the vertices, which also give the normals.

    Args:
        mesh: the surface, closed or with borders.
        n: number of points.
        spacing: distance h between neighbours, instead of n: $n = \text{area} / h^2$.
        smooth: fit polynomials; if False, the points stay on the triangles, with normals carried
            over from their corners, where those beyond edges that turn by more than 40 degrees do
            not count: right for surfaces with sharp edges.
        degree: of the polynomials.
        seed: of the random candidates.

    Returns:
        A cloud sorted along a space-filling curve; `boundary` flags the points on borders.

    Accuracy: distance to the smooth surface O(edge²) on the triangles, and of fourth or higher
        order with `degree=4` (`tests/test_meshes.py::test_distance_to_the_smooth_surface`).

    Raises:
        ValueError: not exactly one of n and spacing; too few points or vertices (both numbers
            given).

    Example:
        >>> corners = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0]])
        >>> mesh = js.TriangleMesh(corners, np.array([[0, 1, 2]]))
        >>> cloud = js.sample_mesh(mesh, n=200, smooth=False)
        >>> cloud.n, bool(jnp.all(cloud.normals == jnp.array([0.0, 0.0, 1.0])))
        (200, True)
    """
    instance(mesh, TriangleMesh, "mesh", "js.clean_mesh(vertices, triangles) makes one")
    whole(degree, "degree", least=1)
    whole(seed, "seed", least=0)
    instance(smooth, (bool, np.bool_), "smooth")
    n, h = _how_many(mesh.area, n, spacing)
    need = vertices_needed(degree)
    if smooth and len(mesh.vertices) < need:
        raise ValueError(
            f"the mesh has {len(mesh.vertices)} vertices, a smooth fit of degree {degree} needs"
            f" at least {need}: lower the degree or take smooth=False"
        )
    closest = ClosestPoint(mesh.vertices, mesh.triangles)

    def project(points, exact=False):
        place, triangle, bary = closest(points, exact=exact)
        return place, mesh.normals_at(triangle, bary)

    candidates, candidate_normals = _spread(mesh, 8 * n, seed)
    border = _border_points(mesh, h)
    points, _ = quasi_uniform(
        candidates,
        n,
        project,
        measure=mesh.area,
        normals=candidate_normals,
        fixed=project(border, exact=True) if len(border) else None,
        seed=seed,
    )
    points, triangle, bary = closest(points)
    at = mesh.normals_at if smooth else mesh.creased_normals_at
    normals = at(triangle, bary)
    if smooth:
        points, normals, used = fit_surface(points, normals, mesh, degree)
        low = np.flatnonzero(used < degree)
        if low.size:
            warn(
                f"the vertices near {low.size} of {n} points allow no fit of degree {degree}; the"
                f" lowest degree used is {used.min()} (0: left on the triangle)"
            )
    boundary = None if mesh.closed else jnp.arange(n) < len(border)
    cloud = PointCloud(jnp.asarray(points), jnp.asarray(normals), boundary=boundary)
    return sort_cloud(cloud)[0]


def _how_many(area: float, n: int | None, spacing: float | None) -> tuple[int, float]:
    if (n is None) == (spacing is None):
        raise ValueError(f"give one of n and spacing, not n = {n} and spacing = {spacing}")
    if n is None:
        n = points_at(real(spacing, "spacing", above=0), area)
    if whole(n, "n", most=MOST) < 10:
        raise ValueError(f"n = {n} points on a surface of area {area:.3g}, expected at least 10")
    return n, ideal_spacing(area, n)


def _spread(mesh: TriangleMesh, m: int, seed: int):
    """m points spread evenly by area over the triangles, and normals."""
    rng = np.random.default_rng(seed)
    end = np.cumsum(mesh.areas)
    where = (np.arange(m) + rng.random(m)) / m * end[-1]
    triangle = np.minimum(np.searchsorted(end, where), len(end) - 1)
    u, v = np.sqrt(rng.random(m)), rng.random(m)
    bary = np.stack([1 - u, u * (1 - v), u * v], axis=1)
    points = np.einsum("qi,qij->qj", bary, mesh.vertices[mesh.triangles[triangle]])
    return points, mesh.normals_at(triangle, bary)


def _border_points(mesh: TriangleMesh, spacing: float) -> Float[Array, "b 3"]:
    """Points about `spacing` apart along every border long enough to be seen at that spacing."""
    found, lost = [np.empty((0, 3))], 0
    for loop in mesh.border_loops:
        corner = mesh.vertices[np.append(loop, loop[0])]
        length = np.append(0, np.cumsum(np.linalg.norm(np.diff(corner, axis=0), axis=1)))
        count = round(length[-1] / spacing)
        if count < 4:
            lost += 1
            continue
        at = np.arange(count) / count * length[-1]
        found.append(np.stack([np.interp(at, length, x) for x in corner.T], axis=1))
    if lost:
        warn(
            f"{lost} of {len(mesh.border_loops)} holes are shorter round than 4 spacings of"
            f" {spacing:.3g} and are not marked as boundary"
        )
    return np.concatenate(found)
