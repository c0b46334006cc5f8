"""Triangle meshes on the host: what they are made of."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray as Array
from scipy import sparse
from scipy.sparse import csgraph

from jaxsurf.arguments import in_range, on_host, shaped
from jaxsurf.failures import not_finite, raise_at

# Cosine of the turn between two triangles that makes an edge a sharp one, 40 degrees, and of half.
_CREASE, _HALF_CREASE = 0.766, 0.9397


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
        object.__setattr__(self, "triangles", vertex_numbers(self.triangles))
        check_arrays(self.vertices, self.triangles)
        t = self.triangles
        twice = (t[:, 0] == t[:, 1]) | (t[:, 1] == t[:, 2]) | (t[:, 2] == t[:, 0])
        raise_at(twice, "triangle {i} names a vertex twice: {v}", t)
        table = self.edge_table
        check_manifold(table)
        raise_at(
            (table.faces[:, 1] >= 0) & ~table.consistent,
            "triangles {v[0]} and {v[1]} have opposite orientation across their common edge{more}; "
            "clean_mesh turns them round",
            table.faces,
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
    def _corner_angles(self) -> Float[Array, "m 3"]:
        """The angle at every corner; 0 in triangles without area."""
        corners = self.vertices[self.triangles]
        sides = np.roll(corners, -1, axis=1) - corners, np.roll(corners, -2, axis=1) - corners
        angle = np.arctan2(2 * self.areas[:, None], np.sum(sides[0] * sides[1], axis=2))
        return np.where(self.areas[:, None] > 0, angle, 0)

    @cached_property
    def face_normals(self) -> Float[Array, "m 3"]:
        """Unit normals of the triangles; 0 without area."""
        area = self.areas[:, None]
        return np.where(area > 0, self._area_vectors / np.where(area > 0, area, 1), 0)

    @cached_property
    def vertex_normals(self) -> Float[Array, "n 3"]:
        """Unit normals at the vertices: those of the triangles around, weighted by angle.

        Only first-order accurate on irregular meshes; NaN at a vertex of no triangle.
        """
        total = np.zeros_like(self.vertices)
        for vertices, angle in zip(self.triangles.T, self._corner_angles.T):
            np.add.at(total, vertices, angle[:, None] * self.face_normals)
        with np.errstate(invalid="ignore"):
            return total / np.linalg.norm(total, axis=1, keepdims=True)

    @cached_property
    def corner_normals(self) -> Float[Array, "m 3 3"]:
        """Unit normals at the corners of each triangle: as at vertices, of what turns little.

        Triangles around whose normals are more than 40 degrees off its own, beyond a sharp edge, do
        not count.
        """
        normal, found = self.face_normals, self.vertex_normals[self.triangles]
        # Two that are both within half of that of the normal at a vertex are within it.
        sharp = np.zeros(len(self.vertices), bool)
        sharp[self.triangles[np.einsum("md,mid->mi", normal, found) < _HALF_CREASE]] = True
        vertex = self.triangles.ravel()
        corners = np.flatnonzero(sharp[vertex])
        places = np.arange(corners.size), vertex[corners]
        at = sparse.csr_array((np.ones(corners.size), places), (corners.size, len(sharp)))
        one, other = (corners[i] for i in (at @ at.T).tocoo().coords)
        smooth = np.sum(normal[one // 3] * normal[other // 3], axis=1) > _CREASE
        one, other = one[smooth], other[smooth]
        shares = self._corner_angles.ravel()[other, None] * normal[other // 3]
        total = np.stack([np.bincount(one, column, vertex.size) for column in shares.T], axis=1)
        length = np.linalg.norm(total, axis=1, keepdims=True)
        own = total / np.where(length > 0, length, 1)
        return np.where(length > 0, own, found.reshape(-1, 3)).reshape(-1, 3, 3)

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
        return csgraph.connected_components(graph_of(inner, len(self.triangles)), directed=False)[1]

    @property
    def genus(self) -> int:
        """Handles, summed over the pieces; every border loop counts as filled with a disk."""
        pieces = int(self.components.max()) + 1
        return (2 * pieces - len(self.border_loops) - self.euler_characteristic) // 2

    def normals_at(
        self, triangle: Int[Array, " q"], bary: Float[Array, "q 3"]
    ) -> Float[Array, "q 3"]:
        """Vertex normals carried linearly into triangles, at barycentric coordinates `(q, 3)`."""
        return _carried(bary, self.vertex_normals[self.triangles[triangle]])

    def creased_normals_at(
        self, triangle: Int[Array, " q"], bary: Float[Array, "q 3"]
    ) -> Float[Array, "q 3"]:
        """The same of `corner_normals`: those of flat faces are theirs up to sharp edges."""
        return _carried(bary, self.corner_normals[triangle])

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


def _carried(bary, corners):
    normal = np.einsum("qi,qij->qj", bary, corners)
    return normal / np.linalg.norm(normal, axis=1, keepdims=True)


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


def vertex_numbers(triangles) -> Int[Array, "..."]:
    numbers = on_host(triangles, "triangles")
    if not (np.isfinite(numbers) & (numbers == np.rint(numbers))).all():
        raise ValueError("triangles must hold whole numbers of vertices")
    return numbers.astype(np.int64)


def check_arrays(vertices, triangles):
    shaped(vertices, "vertices", ("n", 3))
    shaped(triangles, "triangles", ("m", 3))
    raise_at(not_finite(vertices), "vertex {i} is not finite: {v}", vertices)
    in_range(vertices, "vertices")
    outside = ((triangles < 0) | (triangles >= len(vertices))).any(axis=1)
    text = f"triangle {{i}} names the vertices {{v}} (from 0), but there are {len(vertices)}"
    raise_at(outside, text, triangles)


def check_manifold(table: EdgeTable):
    raise_at(
        table.count > 2,
        "the edge from vertex {v[0]} to {v[1]} is shared by {count} triangles, expected at most 2"
        "{more}; largest_part=True of clean_mesh and read drops what stands on the largest part, "
        "faces=False of read takes the points alone",
        table.ends,
        count=table.count,
    )


def graph_of(links: Int[Array, "e 2"], n: int) -> sparse.coo_array:
    return sparse.coo_array((np.ones(len(links)), (links[:, 0], links[:, 1])), shape=(n, n))
