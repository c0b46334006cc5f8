"""Neighbourhoods of fixed size: which points take part in the stencil of which."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from scipy.spatial import cKDTree

from .cloud import PointCloud, is_concrete, raise_at

# Normals more than about 140 degrees apart are opposite: bends that sharp are not resolved.
_OPPOSITE = -0.75
# Points used to measure the local spacing: about two rings around a point.
_RINGS = 13
# A duplicate is a pair closer than this fraction of the spacing.
_DUPLICATE = 1e-10
# Sheets closer than this fraction of the spacing cannot be told apart.
_GAP = 0.35


class Neighbors(eqx.Module):
    """Padded neighbour lists.

    Slot 0 of every row is the point itself; k counts it. A padded slot repeats the row's own
    point with mask False, so that every gather is legal.

    Args:
        indices: `(n, k)`, int32, sorted by distance within a row.
        mask: `(n, k)`, True where a slot holds a neighbour.
        radius: the search radius, scalar or `(n,)`, for lists made with a radius: operators
            then let their kernels vanish smoothly there. None for the k nearest.
    """

    indices: Int[Array, "n k"]
    mask: Bool[Array, "n k"]
    radius: Float[Array, "*n"] | None = None

    @property
    def n(self) -> int:
        return self.indices.shape[0]

    @property
    def k(self) -> int:
        return self.indices.shape[1]


def find_neighbors(
    cloud: PointCloud,
    k: int | None = None,
    *,
    radius: float | Float[Array, " n"] | None = None,
    capacity: int | None = None,
    min_cosine: float = 0.0,
    throw: bool = True,
) -> Neighbors:
    r"""Neighbours of every point of a surface, by a k-d tree on the host.

    Point j is a neighbour of i if it is among the k nearest, or within the radius, of the
    points with $n_i\cdot n_j \ge$ `min_cosine`. The bound on the normals keeps the other side
    of a thin or folded part out of the neighbourhood. Rows are sorted by distance, equal
    distances by index.

    Args:
        cloud: n points with unit normals; its arrays must be concrete. Points that are
            switched off are nobody's neighbour and have no neighbours.
        k: number of neighbours, the point itself included. Give this or `radius`.
        radius: neighbours are at most this far away, in the units of `points`; one number or
            one per point.
        capacity: number of slots per row for a search by radius; the largest number of
            neighbours found if None.
        min_cosine: least cosine between the normals of neighbours (-1 accepts all).
        throw: raise where normals change side within a sheet, or where the surface folds so
            tightly that a neighbourhood holds two sheets; if False, take it as it is.

    Returns:
        Neighbour lists. A row that has fewer than k acceptable points among its 8 k nearest
        is padded, with mask False.

    Differentiable: the lists are integers; operators are differentiable for fixed lists.
    Raises:
        ValueError: traced arrays (use `search_neighbors`); k, radius or capacity out of range
            (both numbers given); duplicates, lone points, mixed orientation and sheets too
            close to be told apart (named by index).

    Example:
        >>> angle = 2 * jnp.pi * jnp.arange(50) / 50
        >>> circle = jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=1)
        >>> neighbors = js.find_neighbors(js.PointCloud(circle, circle), k=5)
        >>> neighbors.indices[10].tolist()
        [10, 9, 11, 8, 12]
    """
    if (k is None) == (radius is None):
        raise ValueError("give exactly one of k and radius")
    if not is_concrete(*jax.tree.leaves((cloud, radius))):
        raise ValueError(
            "find_neighbors needs concrete arrays; under jit, vmap or grad use search_neighbors"
        )
    if k is not None and capacity is not None:
        raise ValueError("capacity belongs to a search by radius; with k the rows have k slots")
    on = np.ones(cloud.n, bool) if cloud.active is None else np.asarray(cloud.active)
    rows = np.flatnonzero(on)
    points = np.asarray(cloud.points)[rows]
    normals = np.asarray(cloud.normals)[rows]
    if k is not None:
        check_count(k, len(rows))
    tree = cKDTree(points.astype(float))
    check_spacing(points, tree, names=rows)
    if throw:
        check_orientation(points, normals, tree, names=rows)
    if k is not None:
        slots, mask = nearest(points, normals, tree, k, min_cosine)
    else:
        reach = np.broadcast_to(np.asarray(radius, points.dtype), cloud.n)
        raise_at(on & ~(reach > 0), "radius of point {i} is {v}, expected a positive number", reach)
        slots, mask = _within(points, normals, tree, reach[rows], capacity, min_cosine, rows)
    if throw:
        check_overlap(points, normals, slots, names=rows)
    indices = np.tile(np.arange(cloud.n, dtype=np.int32)[:, None], slots.shape[1])
    accepted = np.zeros(indices.shape, bool)
    indices[rows] = np.where(mask, rows[slots], indices[rows])
    accepted[rows] = mask
    return Neighbors(
        jnp.asarray(indices),
        jnp.asarray(accepted),
        None if radius is None else jnp.asarray(radius, cloud.points.dtype),
    )


# --- what both searches agree on -----------------------------------------------------------


def distance_key(squared: np.ndarray) -> np.ndarray:
    """Integer that grows with a squared distance and ignores its last bits.

    Distances that are equal up to round-off, as on lattices, get equal keys on every machine,
    so that the tie is broken by the index, not by the rounding.
    """
    if squared.dtype == np.float32:
        return (squared.view(np.int32) + (1 << 7)) >> 8
    return (squared.astype(np.float64).view(np.int64) + (1 << 21)) >> 22


def cosine_slack(dtype) -> float:
    """Round-off allowed in the cosine between two normals."""
    return 64 * float(jnp.finfo(dtype).eps)


# --- the two searches on the host ----------------------------------------------------------


def nearest_of(
    cloud: PointCloud, rows: np.ndarray, k: int, *, min_cosine: float = 0.0
) -> tuple[np.ndarray, np.ndarray]:
    """The rows `rows` of `find_neighbors(cloud, k)`, without searching the others.

    Returns:
        Indices and mask, `(r, k)`; rows may come in any order and more than once.
    """
    rows = np.asarray(rows)
    on = np.ones(cloud.n, bool) if cloud.active is None else np.asarray(cloud.active)
    names = np.flatnonzero(on)
    check_count(k, len(names))
    points, normals = np.asarray(cloud.points)[names], np.asarray(cloud.normals)[names]
    wanted = np.flatnonzero(on[rows])
    place = (np.cumsum(on) - 1)[rows[wanted]]
    tree = cKDTree(points.astype(float))
    slots, accepted = nearest(points, normals, tree, k, min_cosine, rows=place)
    indices, mask = np.tile(rows[:, None].astype(np.int32), k), np.zeros((len(rows), k), bool)
    indices[wanted], mask[wanted] = names[slots], accepted
    return indices, mask


def nearest(points, normals, tree, k: int, min_cosine: float, *, rows=None):
    """The k nearest acceptable points of each (of `rows`), from as many candidates as it takes."""
    n = len(points)
    rows = np.arange(n) if rows is None else rows
    slots = np.tile(rows[:, None], k)
    mask = np.zeros(slots.shape, bool)
    todo = np.arange(len(rows))
    count = min(n, k + 4)
    most = min(n, max(8 * k, 64))
    while todo.size:
        centre = rows[todo]
        found = _query(tree, points[centre], count)
        key, accepted = _judge(points, normals, centre[:, None], found, min_cosine)
        # Beyond the farthest candidate there may be others at the same distance.
        sure = np.sum(accepted & (key < key.max(axis=1, keepdims=True)), axis=1) >= k
        done = sure | (count == most)
        order = np.lexsort((found, np.where(accepted, key, np.iinfo(key.dtype).max)), axis=1)
        order = order[done, :k]
        mask[todo[done]] = np.take_along_axis(accepted[done], order, axis=1)
        slots[todo[done]] = np.take_along_axis(found[done], order, axis=1)
        todo = todo[~done]
        count = min(most, 2 * count)
    return np.where(mask, slots, rows[:, None]), mask


def _within(points, normals, tree, radius, capacity, min_cosine: float, names):
    """All acceptable points within each point's radius."""
    n = len(points)
    far = float(radius.max()) * (1 + 1e-6)  # the last bits are judged below
    pairs = tree.query_pairs(far, output_type="ndarray")
    row, found = np.concatenate([pairs, pairs[:, ::-1], np.tile(np.arange(n)[:, None], 2)]).T
    key, accepted = _judge(points, normals, row, found, min_cosine)
    near = key <= distance_key(radius * radius)[row]
    lone = np.flatnonzero(np.bincount(row[near], minlength=n) < 2)
    if lone.size:
        nearest = tree.query(points[lone[0]], [2])[0][0]
        raise ValueError(
            f"point {names[lone[0]]} has no neighbour within its radius {radius[lone[0]]:.3g}, "
            f"the nearest is {nearest:.3g} away ({lone.size} such points)"
        )
    keep = near & accepted
    row, found, key = row[keep], found[keep], key[keep]
    order = np.lexsort((found, key, row))
    row, found = row[order], found[order]
    count = np.bincount(row, minlength=n)
    most = int(count.max(initial=1))
    if capacity is not None and most > capacity:
        raise ValueError(
            f"point {names[np.argmax(count)]} has {most} neighbours within the radius, "
            f"capacity is {capacity}"
        )
    width = most if capacity is None else capacity
    slots = np.tile(np.arange(n)[:, None], width)
    mask = np.arange(width) < count[:, None]
    slots[mask] = found
    return slots, mask


def _judge(points, normals, row, found, min_cosine: float):
    """Distance key of each candidate, and whether its normal lets it in."""
    d = points[found] - points[row]
    key = distance_key(np.einsum("...d,...d->...", d, d))
    cosine = np.einsum("...d,...d->...", normals[found], normals[row])
    return key, cosine >= min_cosine - cosine_slack(points.dtype)


def _query(tree: cKDTree, points: np.ndarray, count: int) -> np.ndarray:
    """Indices of the `count` nearest points, `(n, count)`."""
    return tree.query(points, np.arange(1, count + 1), workers=-1)[1]


# --- what is wrong with a cloud ------------------------------------------------------------


def check_count(k: int, n: int) -> None:
    if k < 2:
        raise ValueError(f"k = {k} neighbours; the point itself counts, so at least 2 are needed")
    if n < k:
        raise ValueError(f"too few points: {n}, with k = {k} neighbours at least {k} are needed")


def check_spacing(points: np.ndarray, tree: cKDTree, *, names: np.ndarray) -> None:
    """Raise if two points coincide."""
    if len(points) < 2:
        raise ValueError(f"too few points: {len(points)}, at least 2 are needed")
    distance = tree.query(points, [2], workers=-1)[0][:, 0]
    where = np.flatnonzero(distance <= _DUPLICATE * np.median(distance))
    if where.size:
        i = where[0]
        j = next(j for j in tree.query(points[i], 2)[1] if j != i)
        raise ValueError(
            f"points {names[i]} and {names[j]} coincide (distance {distance[i]:.3g}, "
            f"spacing {np.median(distance):.3g}); {where.size} points have a duplicate"
        )


def check_orientation(
    points: np.ndarray,
    normals: np.ndarray,
    tree: cKDTree,
    *,
    names: np.ndarray,
    message: str = "mixed orientation: neighbouring points {i} and {j} of one sheet "
    "have opposite normals (cosine {c:.2f})",
) -> None:
    r"""Raise if normals change side within a sheet, or if two sheets are too close.

    A neighbour with the opposite normal lies either on another sheet, or on the same sheet and
    then one of the two normals is flipped. On another sheet it is displaced along the
    normal, or my own sheet goes on underneath it. A flipped point is displaced along the
    tangent and none of my own orientation is near it.
    """
    count = min(len(points), _RINGS)
    found = _query(tree, points, count)
    opposite = np.einsum("nd,nkd->nk", normals, normals[found]) < _OPPOSITE
    rows = np.flatnonzero(opposite.any(axis=1))
    if not rows.size:
        return
    found, opposite = found[rows], opposite[rows]
    d = points[found] - points[rows][:, None]
    distance = np.linalg.norm(d, axis=2)
    height = np.abs(np.einsum("nkd,nd->nk", d, normals[rows]))
    same = np.einsum("nd,nkd->nk", normals[rows], normals[found]) > 0.5
    spacing = _spacing_from_count(distance[:, -1], count, points.shape[1])
    # Spacing of my own sheet: by count, unless there is a border, which leaves half a ring empty.
    second = np.sort(np.where(same, distance, distance[:, -1:]), axis=1)[:, min(2, count - 1)]
    counted = _spacing_from_count(distance[:, -1], same.sum(axis=1), points.shape[1])
    sheet = np.minimum(second, counted)
    flat = opposite & (height <= 0.3 * distance) & (distance <= 1.5 * spacing[:, None])
    # Nearest point of my own orientation to each candidate, over the tangent plane.
    flat_d = d - np.einsum("nkd,nd->nk", d, normals[rows])[..., None] * normals[rows][:, None]
    apart = np.linalg.norm(flat_d[:, :, None] - flat_d[:, None], axis=3)
    mine = same.copy()
    mine[:, 0] = False
    covered = (np.where(mine[:, None, :], apart, np.inf).min(axis=2)) < 0.5 * distance
    flipped = flat & ~covered
    # One such neighbour may be noise at a sharp fold; a seam shows several at a surface point.
    flipped &= flipped.sum(axis=1, keepdims=True) >= points.shape[1] - 1
    if flipped.any():
        r, c = np.argwhere(flipped)[0]
        i, j = rows[r], found[r, c]
        raise ValueError(message.format(i=names[i], j=names[j], c=normals[i] @ normals[j]))
    beside = np.sqrt(np.maximum(distance**2 - height**2, 0))
    close = opposite & (height < _GAP * sheet[:, None]) & (beside < 0.75 * sheet[:, None])
    if close.any():
        r, c = np.argwhere(close)[0]
        raise ValueError(
            f"two sheets too close to be told apart at points {names[rows[r]]} and "
            f"{names[found[r, c]]}: gap {height[r, c]:.3g}, spacing {sheet[r]:.3g}, "
            f"a gap of at least {_GAP * sheet[r]:.3g} is needed"
        )


def check_overlap(
    points: np.ndarray, normals: np.ndarray, slots: np.ndarray, *, names: np.ndarray
) -> None:
    """Raise if a neighbourhood holds two sheets of the same orientation, one above the other.

    Their normals agree, so that the bound on the normals cannot keep them apart.
    """
    for slot in slots.T:  # one slot at a time: the (n, k, d) arrays are large
        d = points[slot] - points
        distance = np.linalg.norm(d, axis=1)
        rise = np.minimum(*(np.abs(np.einsum("nd,nd->n", d, m)) for m in (normals, normals[slot])))
        parallel = np.einsum("nd,nd->n", normals, normals[slot]) > 0.9
        above = np.flatnonzero(parallel & (rise > 0.9 * distance) & (distance > 0))
        if above.size:
            i = above[0]
            raise ValueError(
                f"points {names[i]} and {names[slot[i]]} lie on two sheets of the same "
                f"orientation, {distance[i]:.3g} apart: their normals cannot tell them apart, "
                "use a smaller neighbourhood or more points"
            )


def tube_ratio(cloud: PointCloud, neighbors: Neighbors) -> Float[Array, " n"]:
    r"""Largest normal curvature that each point sees among its neighbours.

    $\max_j |(x_j-x_i)\cdot(n_j-n_i)|\,/\,|x_j-x_i|^2$. Times the radius of the support it says
    how far the surface bends within one stencil: above 1 the lines along the normals meet
    within the support, and points copied along them land among each other.

    Args:
        cloud: n points with unit normals.
        neighbors: which points to compare with.

    Returns:
        One number per point, `(n,)`, in 1 / length; 0 for a point without neighbours.

    Differentiable: forward and reverse, in points and normals, for fixed neighbours.

    Example:
        >>> angle = 2 * jnp.pi * jnp.arange(50) / 50
        >>> circle = jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=1)
        >>> cloud = js.PointCloud(2 * circle, circle)
        >>> float(js.tube_ratio(cloud, js.find_neighbors(cloud, k=5)).max().round(6))
        0.5
    """

    # One column of neighbours at a time: nothing of size (n, k, d) is stored.
    def bend(slot, mask):
        d = cloud.points[slot] - cloud.points
        squared = jnp.sum(d * d, axis=1)
        used = mask & (squared > 0)
        turn = jnp.sum(d * (cloud.normals[slot] - cloud.normals), axis=1)
        return jnp.where(used, jnp.abs(turn) / jnp.where(used, squared, 1), 0)

    ratios = jax.lax.map(lambda column: bend(*column), (neighbors.indices.T, neighbors.mask.T))
    return jnp.max(ratios, axis=0)


def _spacing_from_count(reach: np.ndarray, count, dim: int) -> np.ndarray:
    """Spacing h of a sheet that has `count` points within `reach`."""
    volume = 2 * reach if dim == 2 else np.pi * reach**2
    return (volume / count) ** (1 / (dim - 1))
