"""Triangle meshes on the host: what they are made of, how they are cleaned and resampled."""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass
from functools import cached_property

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray as Array
from scipy import sparse
from scipy.sparse import csgraph

from jaxsurf.arguments import in_range, instance, on_host, raise_at, real, whole
from jaxsurf.cloud import PointCloud
from jaxsurf.shapes.closest import ClosestPoint, fit_surface
from jaxsurf.shapes.order import sort_cloud
from jaxsurf.shapes.sampling import quasi_uniform
from jaxsurf.shapes.spacing import MOST, ideal_spacing, points_at


@dataclass(frozen=True, eq=False)
class TriangleMesh:
    """An oriented triangle mesh, closed or with borders, in NumPy arrays on the host.

    Args:
        vertices: positions, `(n, 3)`.
        triangles: three vertex numbers each, counted from 0 and counter-clockwise seen from
            the side that the normals point to, `(m, 3)`.

    Raises:
        ValueError: wrong shapes, non-finite vertices (index named), vertex numbers out of
            range, triangles that name a vertex twice, edges shared by more than two triangles,
            neighbouring triangles of opposite orientation. `clean_mesh` repairs what can be.

    Example:
        >>> tetrahedron = js.TriangleMesh(
        ...     np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]),
        ...     np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]]),
        ... )
        >>> tetrahedron.closed, tetrahedron.genus, round(tetrahedron.volume, 4)
        (True, 0, 0.1667)
    """

    vertices: Float[Array, "n 3"]
    triangles: Int[Array, "m 3"]

    def __post_init__(self):
        object.__setattr__(self, "vertices", on_host(self.vertices, "vertices"))
        object.__setattr__(self, "triangles", _vertex_numbers(self.triangles))
        _check_arrays(self.vertices, self.triangles)
        t = self.triangles
        twice = (t[:, 0] == t[:, 1]) | (t[:, 1] == t[:, 2]) | (t[:, 2] == t[:, 0])
        raise_at(twice, "triangle {i} names a vertex twice: {v}", t)
        _check_manifold(self.edge_table)
        turned = np.flatnonzero((self.edge_table.faces[:, 1] >= 0) & ~self.edge_table.consistent)
        if turned.size:
            a, b = self.edge_table.faces[turned[0]]
            raise ValueError(
                f"triangles {a} and {b} have opposite orientation across their common edge"
                f" ({turned.size} such edges); clean_mesh turns them round"
            )

    def __repr__(self) -> str:
        kind = "closed" if self.closed else f"{len(self.border_loops)} borders"
        return (
            f"TriangleMesh({len(self.vertices)} vertices, {len(self.triangles)} triangles, {kind},"
            f" genus {self.genus}, edges of {self.edge_length:.3g})"
        )

    @cached_property
    def edge_table(self) -> EdgeTable:
        """Every edge once, with the triangles on its two sides."""
        return EdgeTable.of(self.triangles, len(self.vertices))

    @cached_property
    def _area_vectors(self) -> Float[Array, "m 3"]:
        a, b, c = np.moveaxis(self.vertices[self.triangles], 1, 0)
        return 0.5 * np.cross(b - a, c - a)

    @cached_property
    def areas(self) -> Float[Array, " m"]:
        """Area of every triangle."""
        return np.linalg.norm(self._area_vectors, axis=1)

    @property
    def area(self) -> float:
        """Area of the whole surface."""
        return float(self.areas.sum())

    @property
    def volume(self) -> float:
        """Volume enclosed by a closed mesh; negative where the normals point inwards."""
        if not self.closed:
            raise ValueError(f"no volume: the mesh has {len(self.border_edges)} border edges")
        corner = self.vertices[self.triangles[:, 0]] - self.vertices.mean(axis=0)
        return float(np.sum(corner * self._area_vectors) / 3)

    @cached_property
    def vertex_normals(self) -> Float[Array, "n 3"]:
        """Unit normals at the vertices: those of the triangles around, weighted by angle.

        Only first-order accurate on irregular meshes; NaN at a vertex of no triangle.
        """
        corners = self.vertices[self.triangles]
        with np.errstate(invalid="ignore", divide="ignore"):
            unit = self._area_vectors / self.areas[:, None]
            total = np.zeros_like(self.vertices)
            for i in range(3):
                a = corners[:, (i + 1) % 3] - corners[:, i]
                b = corners[:, (i + 2) % 3] - corners[:, i]
                angle = np.arctan2(2 * self.areas, np.sum(a * b, axis=1))
                share = np.where(self.areas[:, None] > 0, angle[:, None] * unit, 0)
                np.add.at(total, self.triangles[:, i], share)
            return total / np.linalg.norm(total, axis=1, keepdims=True)

    @cached_property
    def border_edges(self) -> Int[Array, "b 2"]:
        """Edges with a triangle on one side only, as pairs of vertices."""
        table = self.edge_table
        return table.ends[table.faces[:, 1] < 0]

    @cached_property
    def border_vertices(self) -> Bool[Array, " n"]:
        """True for the vertices of border edges."""
        flag = np.zeros(len(self.vertices), bool)
        flag[self.border_edges] = True
        return flag

    @property
    def closed(self) -> bool:
        """True if no edge is a border."""
        return len(self.border_edges) == 0

    @property
    def euler_characteristic(self) -> int:
        """Vertices − edges + triangles, counting only vertices that a triangle uses."""
        return len(np.unique(self.triangles)) - len(self.edge_table.ends) + len(self.triangles)

    @cached_property
    def components(self) -> Int[Array, " m"]:
        """Number of the connected piece that each triangle belongs to, from 0."""
        inner = self.edge_table.faces[self.edge_table.faces[:, 1] >= 0]
        return csgraph.connected_components(_graph(inner, len(self.triangles)), directed=False)[1]

    @property
    def genus(self) -> int:
        """Handles, summed over the pieces; every border loop counts as filled with a disk."""
        pieces = int(self.components.max()) + 1
        return (2 * pieces - len(self.border_loops) - self.euler_characteristic) // 2

    def normals_at(
        self, triangle: Int[Array, " q"], bary: Float[Array, "q 3"]
    ) -> Float[Array, "q 3"]:
        """Vertex normals carried linearly into triangles, at barycentric coordinates `(q, 3)`."""
        corner = self.vertex_normals[self.triangles[triangle]]
        normal = np.einsum("qi,qij->qj", bary, corner)
        return normal / np.linalg.norm(normal, axis=1, keepdims=True)

    @cached_property
    def border_loops(self) -> list[Int[Array, " l"]]:
        """The borders as closed rows of vertices, in the direction of the triangles."""
        start, stop = self.triangles.ravel(), np.roll(self.triangles, -1, axis=1).ravel()
        n = len(self.vertices)
        single = ~np.isin(start * n + stop, stop * n + start)
        onward: dict[int, list[int]] = {}
        for a, b in zip(start[single].tolist(), stop[single].tolist()):
            onward.setdefault(a, []).append(b)
        loops = []
        for first in list(onward):
            while onward[first]:
                loop = [first]
                while onward[loop[-1]]:
                    loop.append(onward[loop[-1]].pop())
                loops.append(np.array(loop[:-1]))
        return loops

    @property
    def edge_length(self) -> float:
        """Mean length of the edges."""
        a, b = self.vertices[self.edge_table.ends].swapaxes(0, 1)
        return float(np.linalg.norm(a - b, axis=1).mean())


@dataclass(frozen=True, eq=False)
class EdgeTable:
    """The edges of a triangle list.

    Args:
        ends: the two vertices, `(e, 2)`, the lower number first.
        faces: the triangles on both sides, `(e, 2)`; −1 where there is none.
        count: number of triangles that share the edge, `(e,)`.
        consistent: True where the two triangles run through the edge in opposite directions,
            as they do when both are seen from the same side.
    """

    ends: Int[Array, "e 2"]
    faces: Int[Array, "e 2"]
    count: Int[Array, " e"]
    consistent: Bool[Array, " e"]

    @staticmethod
    def of(triangles: Int[Array, "m 3"], n: int) -> EdgeTable:
        start, stop = triangles.ravel(), np.roll(triangles, -1, axis=1).ravel()
        face = np.repeat(np.arange(len(triangles)), 3)
        key = np.minimum(start, stop) * n + np.maximum(start, stop)
        order = np.argsort(key, kind="stable")
        unique, first, count = np.unique(key[order], return_index=True, return_counts=True)
        one, two = order[first], order[np.minimum(first + 1, len(order) - 1)]
        paired = count >= 2
        faces = np.stack([face[one], np.where(paired, face[two], -1)], axis=1)
        ends = np.stack([unique // n, unique % n], axis=1)
        return EdgeTable(ends, faces, count, paired & (start[one] != start[two]))


def clean_mesh(
    vertices: Float[Array, "n 3"],
    triangles: Int[Array, "m 3"],
    *,
    name: str = "mesh",
    stacklevel: int = 2,
    largest_part: bool = False,
) -> tuple[TriangleMesh, Int[Array, " kept"]]:
    """Mesh from raw arrays, every repair stated in a warning.

    Vertices at exactly equal positions become one, triangles that then name a vertex twice
    are dropped, so are vertices that no triangle uses, and triangles that are turned the
    wrong way round are turned back (as few as possible in each connected piece).

    Args:
        vertices: positions, `(n, 3)`.
        triangles: vertex numbers from 0, `(m, 3)`.
        name: what to call the mesh in warnings and errors.
        stacklevel: of the warnings, as in `warnings.warn`.
        largest_part: where edges have more than two triangles, as where a fin stands on a
            surface, cut the triangles apart there and keep the pieces, from the one with the
            largest area on, that leave no edge with more than two; the others are dropped.

    Returns:
        The mesh, and for each of its vertices the row of `vertices` that it was.

    Raises:
        ValueError: as `TriangleMesh`; no triangle left; not orientable (a Möbius band).
        TypeError: arrays of other kinds.

    Example:
        >>> corners = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
        >>> triangles = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]])
        >>> mesh, kept = js.clean_mesh(corners, triangles)
        >>> mesh.closed, kept.tolist()
        (True, [0, 1, 2, 3])
    """
    vertices, triangles = on_host(vertices, "vertices"), _vertex_numbers(triangles)
    try:
        _check_arrays(vertices, triangles)
        first, inverse = merge_equal(vertices)
        merged = len(vertices) - len(first)
        triangles = inverse[triangles]
        a, b, c = triangles.T
        collapsed = (a == b) | (b == c) | (c == a)
        triangles = triangles[~collapsed]
        if not len(triangles):
            raise ValueError("no triangles")
        chosen = np.ones(len(triangles), bool)
        if largest_part:
            chosen = _largest_part(vertices, triangles)
            triangles = triangles[chosen]
        used, triangles = np.unique(triangles, return_inverse=True)
        triangles = triangles.reshape(-1, 3)
        unused = np.setdiff1d(np.arange(len(first)), used)
        kept = first[used]
        _check_manifold(EdgeTable.of(triangles, len(used)))
        flip = _faces_to_flip(triangles, len(used))
        triangles[flip] = triangles[flip][:, ::-1]
        mesh = TriangleMesh(vertices[kept], triangles)
    except ValueError as error:
        raise ValueError(f"{name}: {error}") from None
    for count, text in (
        (merged, "{} vertices at exactly the position of another merged with it"),
        (collapsed.sum(), "{} triangles without area (a vertex named twice) dropped"),
        (unused.size, f"{{}} vertices belong to no triangle, dropped (first: {first[unused[:1]]})"),
        (flip.sum(), "{} triangles turned round to agree with their neighbours"),
        ((~chosen).sum(), "{} triangles dropped, so that no edge has more than two"),
    ):
        if count:
            warnings.warn(f"{name}: " + text.format(count), stacklevel=stacklevel)
    return mesh, kept


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
        smooth: fit polynomials; if False, the points stay on the triangles with normals
            carried over from the vertices: right for surfaces with sharp edges.
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
    need = math.comb(degree + 2, 2) + 2
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
    points, normals = project(points, exact=True)
    if smooth:
        points, normals, used = fit_surface(
            points,
            normals,
            vertices=mesh.vertices,
            vertex_normals=mesh.vertex_normals,
            degree=degree,
        )
        low = np.flatnonzero(used < degree)
        if low.size:
            warnings.warn(
                f"the vertices near {low.size} of {n} points allow no fit of degree {degree}; the"
                f" lowest degree used is {used.min()} (0: left on the triangle)",
                stacklevel=2,
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
        warnings.warn(
            f"{lost} of {len(mesh.border_loops)} holes are shorter round than 4 spacings of"
            f" {spacing:.3g} and are not marked as boundary",
            stacklevel=3,
        )
    return np.concatenate(found)


def _vertex_numbers(triangles) -> Int[Array, "..."]:
    numbers = on_host(triangles, "triangles")
    if not (np.isfinite(numbers) & (numbers == np.rint(numbers))).all():
        raise ValueError("triangles must hold whole numbers of vertices")
    return numbers.astype(np.int64)


def _check_arrays(vertices, triangles):
    if vertices.ndim != 2 or vertices.shape[1] != 3:
        raise ValueError(f"vertices must have shape (n, 3), not {vertices.shape}")
    if triangles.ndim != 2 or triangles.shape[1] != 3:
        raise ValueError(f"triangles must have shape (m, 3), not {triangles.shape}")
    raise_at(~np.isfinite(vertices).all(axis=1), "vertex {i} is not finite: {v}", vertices)
    in_range(vertices, "vertices")
    outside = ((triangles < 0) | (triangles >= len(vertices))).any(axis=1)
    text = f"triangle {{i}} names the vertices {{v}} (from 0), but there are {len(vertices)}"
    raise_at(outside, text, triangles)


def _check_manifold(table: EdgeTable):
    many = np.flatnonzero(table.count > 2)
    if many.size:
        i, j = table.ends[many[0]]
        raise ValueError(
            f"{many.size} edges are shared by more than two triangles (first: vertices {i} and"
            f" {j}, {table.count[many[0]]} triangles); largest_part=True of clean_mesh and read"
            " drops what stands on the largest part, faces=False of read takes the points alone"
        )


def _largest_part(vertices, triangles) -> Bool[Array, " m"]:
    """Which triangles stay, so that no edge has more than two."""
    table = EdgeTable.of(triangles, len(vertices))
    if table.count.max() <= 2:
        return np.ones(len(triangles), bool)
    inner = table.faces[table.count == 2]
    label = csgraph.connected_components(_graph(inner, len(triangles)), directed=False)[1]
    a, b, c = np.moveaxis(vertices[triangles], 1, 0)
    area = np.bincount(label, np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2)
    # Which piece has how many triangles at which of the edges that too many share.
    ends = np.sort(np.stack([triangles, np.roll(triangles, -1, axis=1)], axis=-1), axis=-1)
    key = ends[..., 0] * len(vertices) + ends[..., 1]
    wide = table.ends[table.count > 2] @ [len(vertices), 1]
    at, edge = np.nonzero(np.isin(key, wide))
    held = sparse.coo_array(
        (np.ones(len(at)), (label[at], np.searchsorted(wide, key[at, edge]))),
        shape=(len(area), len(wide)),
    ).tocsr()
    load, kept = np.zeros(len(wide)), np.zeros(len(area), bool)
    # Areas that are equal up to round-off in the order of the file.
    for piece in np.argsort(-(area / area.max()).round(9), kind="stable"):
        more = held[[piece]].toarray()[0]
        if (load + more <= 2).all():
            load, kept[piece] = load + more, True
    return kept[label]


def merge_equal(points: Float[Array, "n d"]) -> tuple[Int[Array, " u"], Int[Array, " n"]]:
    """First row of every distinct point, in order of appearance, and each row's place there."""
    order = np.lexsort(points.T)  # stable, so equal rows stay in order of appearance
    new = np.ones(len(points), bool)
    new[1:] = (points[order[1:]] != points[order[:-1]]).any(axis=1)
    first = np.empty(len(points), np.int64)
    first[order] = order[new][np.cumsum(new) - 1]
    kept = np.unique(first)
    return kept, np.searchsorted(kept, first)


def _faces_to_flip(triangles: Int[Array, "m 3"], n: int) -> Bool[Array, " m"]:
    # Two sheets, one for each orientation of every triangle: an edge links equal sheets where
    # its triangles agree and opposite sheets where they do not. A piece is orientable exactly
    # if its two sheets stay apart.
    m, table = len(triangles), EdgeTable.of(triangles, n)
    inner = table.faces[:, 1] >= 0
    (a, b), agree = table.faces[inner].T, table.consistent[inner]
    links = np.concatenate(
        [
            np.stack([a, np.where(agree, b, b + m)], axis=1),
            np.stack([a + m, np.where(agree, b + m, b)], axis=1),
        ]
    )
    sheets = csgraph.connected_components(_graph(links, 2 * m), directed=False)[1]
    as_given, turned = sheets[:m], sheets[m:]
    bad = np.flatnonzero(as_given == turned)
    if bad.size:
        raise ValueError(
            "the surface has only one side (a Möbius band or worse): no orientation of the"
            f" {bad.size} triangles joined to triangle {bad[0]} is consistent"
        )
    votes = np.bincount(as_given, minlength=sheets.max() + 1)
    tie = (votes[as_given] == votes[turned]) & (as_given > turned)
    return (votes[as_given] < votes[turned]) | tie


def _graph(links: Int[Array, "e 2"], n: int) -> sparse.coo_array:
    return sparse.coo_array((np.ones(len(links)), (links[:, 0], links[:, 1])), shape=(n, n))
