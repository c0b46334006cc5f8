"""Border points in order along the border, with the surface on the left."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.spatial import cKDTree

from ..arguments import instance
from ..cloud import PointCloud
from ..compiling import on_device
from ..failures import is_concrete, needs_values, warn, without_derivatives
from ..shapes.meshes import TriangleMesh
from ..sheets import distance_key
from .border import Border, checked_border

# Points in a row that the border is interpolated through.
_ROW = 5
# A corner turns by more than this, in radians, and this many times as much as the points beside
# it; whatever turns by more than the last is one.
_TURN, _TIMES, _SHARP = 0.3, 2.5, 1.0
# Along a border, the second neighbour is off by at least this cosine from the first, and not
# farther than so many spacings. Not those of a lattice: there the last bit would decide.
_ASIDE, _FAR = 0.49, 4.03
# And where there is none, by this: corners of 16 degrees and more.
_TIP = 0.96
# Points around one of a border lie on its inside, or on either side of a corner; so many spacings
# outside they do not.
_LEANING = 0.35
# An end is beside another part so many spacings away.
_BESIDE = 2.0
# Closed chains of so few points beside another are holes, or tips that are cut off.
_SMALL = 6


def border_conormals(cloud: PointCloud, border: Border | None = None) -> Float[Array, "m d"]:
    r"""Outward conormals at the points marked in `cloud.boundary`.

    $\nu = \tau \times n$, with $\tau$ the direction of the border. At a corner, the mean
    direction of both sides.

    Args:
        cloud: points and normals; `boundary` must be set.
        border: from `find_border`, for traced points; found if None.

    Returns:
        Unit vectors `(m, d)`, in the order of the indices of the m marked points.

    Accuracy: angle O(h⁴) on smooth borders (`tests/test_boundary.py`). In float32 within 1e-5
    (`tests/test_boundary.py`).
    Differentiable: forward and reverse, in points and normals, for a given border.
    Raises:
        ValueError: as `find_border`.

    Example:
        >>> bowl = lambda s: (jnp.sin(s), -jnp.cos(s))
        >>> cap = js.surface_of_revolution(bowl, 800)
        >>> border = cap.points[cap.boundary]
        >>> exact = jnp.cross(jnp.cross(jnp.array([0.0, 0.0, 1.0]), border), border)
        >>> exact = -exact / jnp.linalg.norm(exact, axis=1, keepdims=True)
        >>> bool(jnp.abs(js.border_conormals(cap) - exact).max() < 1e-3)
        True
    """
    instance(cloud, PointCloud, "cloud")
    border = find_border(cloud) if border is None else checked_border(border, cloud)
    return border.conormals(cloud)[jnp.argsort(border.points)]


def find_border(cloud: PointCloud, mesh: TriangleMesh | None = None) -> Border:
    """The points marked in `cloud.boundary`, put in order along the border.

    Every border point is linked to its nearest one, and to the nearest one on the other side of
    it; those that others pass over, as the tip of a sharp corner, are put between two where the
    way over them is least longer. Or the border edges of a mesh say how.

    Args:
        cloud: n points with `boundary`; concrete.
        mesh: a mesh whose vertices are the points of the cloud, in the same order.

    Returns:
        The border, with the surface on its left.

    Raises:
        TypeError: no cloud, no mesh.
        ValueError: traced arrays; no point marked; a marked point without a neighbour along the
            border (named by index); a mesh with another number of vertices, or without border.

    Warns where what is found cannot be: its outside is where the surface is, or it ends beside
    another part of it.

    Example:
        >>> border = js.find_border(js.graph(lambda x, y: 0 * x, (6, 6)))
        >>> len(border.points), int(border.corners.sum())
        (20, 4)
    """
    instance(cloud, PointCloud, "cloud")
    cloud = without_derivatives(cloud)
    needs_values("cloud", cloud, instead="find the border outside jit and vmap, and pass it on")
    if mesh is not None:
        instance(mesh, TriangleMesh, "mesh")
        if len(mesh.vertices) != cloud.n:
            raise ValueError(f"the mesh has {len(mesh.vertices)} vertices, the cloud {cloud.n}")
        if mesh.closed:
            raise ValueError("the mesh has no border edges")
        paths = [(loop, True) for loop in mesh.border_loops]
        return _with_rows(cloud, paths)
    on = cloud.host_active
    marked = np.zeros(cloud.n, bool) if cloud.boundary is None else np.asarray(cloud.boundary) & on
    if not marked.any():
        raise ValueError("no point is marked in cloud.boundary; see detect_boundary")
    points = np.asarray(cloud.points, float)
    inside = inward(points, np.flatnonzero(on), np.flatnonzero(marked))
    if cloud.dim == 2:
        return _ends(points, np.flatnonzero(on), np.flatnonzero(marked))
    names = np.flatnonzero(marked)
    paths, wrong = [], np.zeros(len(names), bool)
    links = _links(points[names], names)
    beside, spacing = _beside(points[names])
    chains = _paths(_rejoined(points[names], links, inside, beside))
    for path, closed in chains:
        left = _leftness(cloud, names[path], inside[path], closed)
        if np.sum(left) < 0:
            path, left = path[::-1], -left[::-1]
        wrong[path] = left < -_LEANING * spacing
        paths.append((names[path], closed))
    wrong[_cut_off(chains, beside)] = True
    if wrong.any():
        warn(
            f"the border is not resolved: at {wrong.sum()} of its points, the first "
            f"{names[np.argmax(wrong)]}, what is found as its outside is where the surface is, or "
            "it ends beside another part. Use more points there; a mesh tells the order, "
            "js.find_border(cloud, mesh)"
        )
    return _with_rows(cloud, paths)


def marked_border(cloud: PointCloud) -> Border | None:
    """The border of a cloud that has one; None where no point is marked."""
    if cloud.boundary is None:
        return None
    known = is_concrete(cloud.boundary, cloud.active)
    if known and not (np.asarray(cloud.boundary) & cloud.host_active).any():
        return None
    needs_values(
        "a cloud with a border",
        without_derivatives(cloud),
        instead="make its surface outside jit and vmap, pass it, and take surface.moved(points)",
    )
    return find_border(cloud)


def inward(points, on, border):
    """Mean offset from each border point to the points around it."""
    count = min(4 * points.shape[1], len(on))
    near = cKDTree(points[on]).query(points[border], count)[1]
    return (points[on][near] - points[border][:, None]).mean(axis=1)


def _links(points, names) -> list[list[int]]:
    """For every border point the one or two that come next to it."""
    count = min(len(points), 12)
    if count < 2:
        raise ValueError(f"border point {names[0]} is alone; a border has at least 2 points")
    distance, near = cKDTree(points).query(points, count)
    # What is equally far comes by its number, whatever the last bit says.
    order = np.lexsort((near, distance_key(distance**2)), axis=1)
    distance, near = (np.take_along_axis(x, order, axis=1) for x in (distance, near))
    d = (points[near] - points[:, None])[:, 1:]
    near, distance = near[:, 1:], distance[:, 1:]
    first = d[:, 0] / distance[:, :1]
    cosine = np.einsum("nkd,nd->nk", d, first) / distance
    close_by = distance < _FAR * np.median(distance[:, 0])
    other = (cosine < _ASIDE) & close_by
    # At the tip of a sharp corner nothing is on the other side.
    other = np.where(other.any(axis=1)[:, None], other, (cosine < _TIP) & close_by)
    # Of those that are equally far, the one straight on.
    far = np.where(other, distance_key(distance**2), np.iinfo(np.int64).max)
    ahead = np.lexsort((near, np.round(cosine, 6), far), axis=1)[:, 0]
    second = np.where(other.any(axis=1), near[np.arange(len(near)), ahead], -1)
    wanted = {(i, int(j)) for i, j in enumerate(near[:, 0])}
    wanted |= {(i, int(j)) for i, j in enumerate(second) if j >= 0}
    pairs = _not_past_tips({(min(p), max(p)) for p in wanted}, len(names))
    squared = np.array([np.sum((points[i] - points[j]) ** 2) for i, j in pairs])
    length = dict(zip(pairs, distance_key(squared).tolist()))
    links: list[list[int]] = [[] for _ in names]
    # Links that both ends ask for come first, then short ones.
    mutual = {p for p in pairs if p in wanted and p[::-1] in wanted}
    for i, j in sorted(pairs, key=lambda p: (p not in mutual, length[p], p)):
        if len(links[i]) < 2 and len(links[j]) < 2:
            links[i].append(j)
            links[j].append(i)
    for i in [i for i, linked in enumerate(links) if not linked]:
        if not _insert([(i, i)], near[i][close_by[i]], points, links):
            raise ValueError(
                f"border point {names[i]} has no neighbour along the border: mark all points "
                "there, and no inner ones (of uneven points js.detect_boundary may name some)"
            )
    return links


def _not_past_tips(pairs: set[tuple[int, int]], m: int) -> set[tuple[int, int]]:
    """Without links past the tip of a sharp corner, whose two neighbours are near each other."""
    partners: list[set[int]] = [set() for _ in range(m)]
    for i, j in pairs:
        partners[i].add(j)
        partners[j].add(i)
    past = {
        (min(beside), max(beside))
        for beside in partners
        if len(beside) == 2 and all(len(partners[j]) > 2 for j in beside)
    }
    return pairs - past


def _insert(ends, near, points, links, *, breaks=False) -> bool:
    """Take the way over a chain, as a tip, where that is least longer.

    Between two points that are linked, of which one is among those that are near.

    Args:
        ends: of the chain, `(i, j)`, of which there is a choice.
        breaks: the link between them.
    """
    ways = sorted(
        (a, b, i, j)
        for a, b in {pair for c in near.tolist() for d in links[c] for pair in ((c, d), (d, c))}
        for i, j in ends
    )
    if not ways:
        return False
    a, b, i, j = np.transpose(ways)
    length = lambda p, q: np.linalg.norm(points[p] - points[q], axis=-1)
    # Twice the link more, which is positive.
    longer = length(a, i) + length(j, b) - length(a, b) - length(i, j) + 2 * length(i, j).max()
    a, b, i, j = ways[np.argmin(distance_key(np.maximum(longer, 0)))]
    if breaks:
        links[i].remove(j)
        links[j].remove(i)
    links[a][links[a].index(b)], links[b][links[b].index(a)] = i, j
    links[i].append(a)
    links[j].append(b)
    return True


def _rejoined(points, links, inside, beside) -> list[list[int]]:
    """With tips that are cut off, where both sides of a corner are nearer than points of each."""
    while any(_put_back(points, links, inside, beside, *chain) for chain in _paths(links)):
        pass  # one chain less
    return links


def _put_back(points, links, inside, beside, path, closed: bool) -> bool:
    """Put a chain into another beside it, if it is a tip."""
    off = lambda some: np.setdiff1d(np.concatenate([beside[i] for i in some]), path)
    near = off(path)
    if closed:
        tip = near.size > 0 and len(path) <= _SMALL and not _is_hole(points, inside, path)
        following = np.roll(path, -1)
        ends = [*zip(path.tolist(), following.tolist()), *zip(following.tolist(), path.tolist())]
    else:
        tip = off(path[:1]).size > 0 and off(path[-1:]).size > 0
        ends = [(int(path[0]), int(path[-1]))]
    return tip and _insert(ends, near, points, links, breaks=closed)


def _is_hole(points, inside, path) -> bool:
    """Whether the surface is around a closed chain; around a tip it is on one side."""
    away = points[path] - points[path].mean(axis=0)
    size = np.linalg.norm(inside[path], axis=1) * np.linalg.norm(away, axis=1)
    return bool(np.sum(inside[path] * away) > 0.5 * np.sum(size))


def _beside(points) -> tuple[list[np.ndarray], float]:
    """The points beside each, itself included, and the spacing."""
    tree = cKDTree(points)
    spacing = float(np.median(tree.query(points, 2)[0][:, 1]))
    near = tree.query_ball_point(points, _BESIDE * spacing)
    return [np.array(some, int) for some in near], spacing


def _paths(links: list[list[int]]) -> list[tuple[np.ndarray, bool]]:
    """The chains of linked points, and whether each closes."""
    seen = np.zeros(len(links), bool)
    paths = []
    ends = [i for i, near in enumerate(links) if len(near) == 1]
    for start in [*ends, *range(len(links))]:
        if seen[start]:
            continue
        path, here = [start], start
        seen[start] = True
        while True:
            onward = [j for j in links[here] if not seen[j]]
            if not onward:
                break
            here = onward[0]
            seen[here] = True
            path.append(here)
        paths.append((np.array(path), len(path) > 2 and start in links[here]))
    return paths


def _cut_off(chains, beside) -> list[int]:
    """Ends of open chains that are beside another chain."""
    ends = [(path, int(path[k])) for path, closed in chains if not closed for k in (0, -1)]
    return [end for path, end in ends if np.setdiff1d(beside[end], path).size]


def _leftness(cloud, path, inside, closed) -> np.ndarray:
    """How far the surface lies on the left of each point of a path, as normals see it."""
    points, normals = np.asarray(cloud.points, float)[path], np.asarray(cloud.normals)[path]
    on_either_side = np.roll(points, -1, axis=0) - np.roll(points, 1, axis=0)
    ahead = on_either_side if closed else np.gradient(points, axis=0)
    left = np.cross(normals, ahead)
    size = np.linalg.norm(left, axis=1)
    return np.sum(left * inside, axis=1) / np.where(size > 0, size, 1)


def _with_rows(cloud, paths) -> Border:
    """The rows of border points around each: within a piece between two corners."""
    names: list[int] = []
    rows: list[list] = [[], []]
    masks: list[list] = [[], []]
    for path, closed in paths:
        m = len(path)
        corner = _corners(cloud, path, closed)
        for here in range(m):
            names.append(path[here])
            for side in (0, 1):
                reach = [_reach(corner, here, step, closed, most=_ROW - 1) for step in (-1, 1)]
                if corner[here] and all(reach):
                    reach[1 - side] = 0
                low, high = _window(*reach)
                window = path[(here + np.arange(-low, high + 1)) % m]
                padding = _ROW - len(window)
                rows[side].append(np.pad(window, (0, padding), mode="edge"))
                masks[side].append(np.arange(_ROW) < len(window))
    unique, count = np.unique(names, return_counts=True)
    if count.max() > 1:
        raise ValueError(f"point {unique[np.argmax(count)]} lies on {count.max()} borders")
    return Border(
        on_device(np.array(names, np.int32)),
        on_device(np.array(rows, np.int32)),
        on_device(np.array(masks)),
    )


def _reach(corner, here, step, closed, most) -> int:
    """How many points of the same piece follow in a direction."""
    m, count = len(corner), 0
    most = min(most, (m - 1) // 2) if closed else most
    while count < most:
        place = here + step * (count + 1)
        if not closed and not 0 <= place < m:
            break
        count += 1
        if corner[place % m]:
            break
    return count


def _window(before: int, after: int) -> tuple[int, int]:
    """How many points on either side: evenly, unless one side has too few."""
    half = (_ROW - 1) // 2
    low, high = min(before, half), min(after, half)
    low = min(before, _ROW - 1 - high)
    high = min(after, _ROW - 1 - low)
    return low, high


def _corners(cloud, path, closed) -> np.ndarray:
    """Points where the border turns sharply, the ends of an open path included."""
    points = np.asarray(cloud.points, float)[path]
    if len(path) < 3:
        return np.ones(len(path), bool)
    ahead = np.roll(points, -1, axis=0) - points
    ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
    turn = np.arccos(np.clip(np.sum(ahead * np.roll(ahead, 1, axis=0), axis=1), -1, 1))
    beside = np.maximum(np.roll(turn, 1), np.roll(turn, -1))
    corner = (turn > _SHARP) | ((turn > _TURN) & (turn > _TIMES * beside))
    if not closed:
        corner[[0, -1]] = True
    return corner


def _ends(points, on, border) -> Border:
    """Rows at the ends of a plane curve: each end and its nearest point."""
    near = on[cKDTree(points[on]).query(points[border], 2)[1][:, 1]]
    rows = np.stack([border, near], axis=1).astype(np.int32)
    rows = np.broadcast_to(rows, (2, *rows.shape))
    return Border(on_device(border), on_device(rows), on_device(np.ones(rows.shape, bool)))
