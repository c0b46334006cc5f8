"""Triangle meshes from raw arrays, with stated repairs."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray as Array
from scipy import sparse
from scipy.sparse import csgraph

from jaxsurf.arguments import on_host
from jaxsurf.failures import warn
from jaxsurf.shapes.meshes import (
    EdgeTable,
    TriangleMesh,
    check_arrays,
    check_manifold,
    graph_of,
    vertex_numbers,
)


def clean_mesh(
    vertices: Float[Array, "n 3"],
    triangles: Int[Array, "m 3"],
    *,
    name: str = "mesh",
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
    vertices, triangles = on_host(vertices, "vertices"), vertex_numbers(triangles)
    try:
        check_arrays(vertices, triangles)
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
        check_manifold(EdgeTable.of(triangles, len(used)))
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
            warn(f"{name}: " + text.format(count))
    return mesh, kept


def _largest_part(vertices, triangles) -> Bool[Array, " m"]:
    """Which triangles stay, so that no edge has more than two."""
    table = EdgeTable.of(triangles, len(vertices))
    if table.count.max() <= 2:
        return np.ones(len(triangles), bool)
    inner = table.faces[table.count == 2]
    label = csgraph.connected_components(graph_of(inner, len(triangles)), directed=False)[1]
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
    sheets = csgraph.connected_components(graph_of(links, 2 * m), directed=False)[1]
    as_given, flipped = sheets[:m], sheets[m:]
    bad = np.flatnonzero(as_given == flipped)
    if bad.size:
        raise ValueError(
            "the surface has only one side (a Möbius band or worse): no orientation of the"
            f" {bad.size} triangles joined to triangle {bad[0]} is consistent"
        )
    votes = np.bincount(as_given, minlength=sheets.max() + 1)
    tie = (votes[as_given] == votes[flipped]) & (as_given > flipped)
    return (votes[as_given] < votes[flipped]) | tie
