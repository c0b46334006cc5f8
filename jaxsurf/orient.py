"""First guess of the normals of a bare point cloud, and which way they point (on the host)."""

from __future__ import annotations

import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import breadth_first_order, connected_components, minimum_spanning_tree
from scipy.spatial import cKDTree

from .checks import check_orientation
from .failures import raise_at

# Neighbours used for the first guess: one ring and a half, so that thin parts stay apart.
_NEAR = {2: 5, 3: 13}
# Sheets with fewer points than this are scraps of another.
_SCRAP = 50
# Edges steeper than this against the surface lead to another sheet.
_STEEP = 0.7


def plane_normals(points: np.ndarray, tree: cKDTree, *, k: int | None = None) -> np.ndarray:
    r"""Unit normals of unknown sign: the n that minimises $\sum_j W_{ij}\cos^2\theta_{ij}$.

    $\theta_{ij}$ is the angle between n and $x_j-x_i$, W Gaussian (Suchde and Kuhnert 2019,
    eq. 4): the weighted principal axes of the unit directions to the neighbours.
    """
    n, dim = points.shape
    count = min(n, _NEAR[dim] if k is None else k)
    if count < dim:
        raise ValueError(f"too few points: {n}, normals in {dim} dimensions need {dim}")
    distance, found = tree.query(points, count, workers=-1)
    d = (points[found[:, 1:]] - points[:, None]) / distance[:, 1:, None]
    w = np.exp(-2 * (distance[:, 1:] / distance[:, -1:]) ** 2)
    value, axes = np.linalg.eigh(np.einsum("nk,nki,nkj->nij", w, d, d))
    # In space two axes must carry the neighbours, or they all lie on a line.
    line = (value[:, -2] < 1e-8 * value[:, -1]) & (dim == 3)
    text = f"the {count} nearest points around point {{i}} lie on a line{{more}}: they determine "
    raise_at(line, f"{text}no normal")
    return axes[:, :, 0]


def orient_normals(points: np.ndarray, normals: np.ndarray, tree: cKDTree) -> np.ndarray:
    r"""The normals with signs chosen so that they agree over each surface, outward if closed.

    Signs spread along a minimum spanning tree of the neighbour graph (Hoppe et al. 1992). Two
    neighbours on a circular arc have normals that are mirror images in the plane halfway
    between them; an edge costs as much as it departs from that. It also holds between the
    two sides of a thin part, which then get opposite normals, as they must.
    """
    n, dim = points.shape
    count = min(n, _NEAR[dim])
    found = tree.query(points, count, workers=-1)[1][:, 1:]
    i, j = np.repeat(np.arange(n), count - 1), found.ravel()
    agreement, steep = _compare(points, normals, i, j)
    cost = 1 - np.abs(agreement) + steep**2
    tree_edges = minimum_spanning_tree(_symmetric(i, j, cost + 1e-9, n)).tocoo()
    i, j = tree_edges.row, tree_edges.col
    agreement, steep = _compare(points, normals, i, j)
    sign = _spread(n, i, j, np.where(agreement < 0, -1, 1))
    normals = normals * sign[:, None]
    area = tree.query(points, [count], workers=-1)[0][:, 0] ** (dim - 1)
    sheet = _sheets(area[:, None] * normals, i, j, steep)
    return normals * _outward(points, normals, area, sheet)[:, None]


def check_one_sided(points: np.ndarray, normals: np.ndarray, tree: cKDTree) -> None:
    check_orientation(
        points,
        normals,
        tree,
        names=np.arange(len(points)),
        message="neighbouring points {i} and {j} got opposite normals (cosine {c:.2f}): the "
        "surface has one side only, like a Moebius strip, or too few points where it bends",
    )


def _compare(points, normals, i, j):
    """Cosine between n_j and the mirror image of n_i, and how steep the edge is."""
    e = points[j] - points[i]
    e /= np.linalg.norm(e, axis=1, keepdims=True)
    up_i = np.einsum("nd,nd->n", normals[i], e)
    up_j = np.einsum("nd,nd->n", normals[j], e)
    agreement = np.einsum("nd,nd->n", normals[i], normals[j]) - 2 * up_i * up_j
    return agreement, np.maximum(np.abs(up_i), np.abs(up_j))


def _symmetric(i, j, value, n: int) -> csr_matrix:
    graph = csr_matrix((value, (i, j)), shape=(n, n))
    return graph.maximum(graph.T)


def _spread(n: int, i, j, flip) -> np.ndarray:
    """Sign of every node of a forest, from the signs of its edges."""
    forest = _symmetric(i, j, np.ones(len(i)), n)
    _, piece = connected_components(forest, directed=False)
    roots = np.unique(piece, return_index=True)[1]
    # One more node joins the trees, so that one sweep visits all.
    joined = _symmetric(
        np.r_[i, roots], np.r_[j, np.full(len(roots), n)], np.ones(len(i) + len(roots)), n + 1
    )
    _, parent = breadth_first_order(joined, n, directed=False)
    parent[n] = n
    sign_of_edge = _symmetric(i, j, flip + 2.0, n + 1)  # 1 or 3: zeros are not stored
    node = np.arange(n + 1)
    sign = np.asarray(sign_of_edge[node, parent]).ravel()
    sign = np.where(sign == 1, -1, 1)
    # Product of the signs along the way to the root, doubling the stride.
    while np.any(parent != n):
        sign, parent = sign * sign[parent], parent[parent]
    return sign[:n]


def _sheets(area_vectors, i, j, steep) -> np.ndarray:
    """Label of the surface that each point belongs to, from the tree edges (i, j).

    Steep edges lead to another sheet. A closed one is a surface of its own; open ones, as
    the two sides of a plate without a rim, keep the signs that they have to each other.
    """
    n = len(area_vectors)
    flat = steep < _STEEP
    _, label = connected_components(_symmetric(i[flat], j[flat], np.ones(flat.sum()), n), False)
    i, j = i[~flat], j[~flat]
    size = np.bincount(label)
    # A scrap, as at a sharp tip, follows the sheet it hangs on.
    while True:
        a, b = label[i], label[j]
        scrap = np.flatnonzero((a != b) & (np.minimum(size[a], size[b]) < _SCRAP))
        if not scrap.size:
            break
        small, large = sorted((a[scrap[0]], b[scrap[0]]), key=lambda piece: size[piece])
        label[label == small] = large
        size[large] += size[small]
        size[small] = 0
    # The area vectors of a closed surface add up to nothing.
    total = np.stack([np.bincount(label, c, len(size)) for c in area_vectors.T], axis=1)
    area = np.bincount(label, np.linalg.norm(area_vectors, axis=1), len(size))
    is_open = np.linalg.norm(total, axis=1) > 0.1 * area
    both = is_open[label[i]] & is_open[label[j]]
    links = _symmetric(label[i[both]], label[j[both]], np.ones(both.sum()), len(size))
    return connected_components(links, directed=False)[1][label]


def _outward(points, normals, area, label) -> np.ndarray:
    """Sign per point that makes the enclosed volume of each surface positive."""
    size = np.maximum(np.bincount(label), 1)
    centre = np.stack([np.bincount(label, c) / size for c in points.T], axis=1)
    flux = area * np.einsum("nd,nd->n", points - centre[label], normals)
    total, scale = np.bincount(label, flux), np.bincount(label, np.abs(flux))
    reach = np.bincount(label, area * np.linalg.norm(points - centre[label], axis=1))
    # An open sheet that is flat, or bends as much to one side as to the other, encloses nothing:
    # the first component of its mean normal that counts is positive, and where there is none
    # (a helicoid) that of the normal at one end. No sign is left to the last bit.
    mean = np.stack([np.bincount(label, c) / size for c in normals.T], axis=1)
    high = points @ np.array([1.0, 0.61, 0.37])[: points.shape[1]]
    end = np.lexsort((high, label))[np.cumsum(np.bincount(label))[label] - 1]
    last = np.zeros_like(mean)
    last[label] = normals[end]
    mean = np.where(np.abs(mean).max(axis=1, keepdims=True) > 1e-3, mean, last)
    leading = mean[np.arange(len(mean)), np.argmax(np.abs(mean).round(6), axis=1)]
    undecided = (scale <= 1e-6 * reach) | (np.abs(total) <= 1e-3 * scale)
    return np.where(np.where(undecided, leading, total) < 0, -1, 1)[label]
