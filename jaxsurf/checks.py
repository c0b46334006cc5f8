"""What is wrong with a cloud: duplicates, mixed orientation, sheets too close to each other."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

# Normals more than about 140 degrees apart are opposite: bends that sharp are not resolved.
_OPPOSITE = -0.75
# Points used to measure the local spacing: about two rings around a point.
RINGS = 13
# A duplicate is a pair closer than this fraction of the spacing.
_DUPLICATE = 1e-10
# Opposite sheets closer than this fraction of the spacing cannot be told from a flipped point.
_GAP = 0.1
# Two points farther apart than this many spacings are not linked by the surface between them,
# and no narrower gap between sheets of the same orientation is one.
LINK = 2.0
# A way along the surface longer than this times the chord leads around a gap; around a right
# angle it is at most 1.41.
DETOUR = 1.5


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
    count = min(len(points), RINGS)
    found = query(tree, points, count)
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
    around = distance <= 1.5 * spacing[:, None]
    # A sheet close by is lifted by more than my own sheet bends, unless that is rough.
    bend = np.max(np.where(same & around, height, 0), axis=1)
    lift = np.minimum(0.3 * distance, (_GAP * sheet + 1.5 * bend)[:, None])
    flat = opposite & around & (height <= lift)
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
    points: np.ndarray,
    normals: np.ndarray,
    tree: cKDTree,
    slots: np.ndarray,
    above: np.ndarray,
    *,
    names: np.ndarray,
) -> None:
    """Raise if two sheets of the same orientation lie one above the other without a real gap.

    Their normals agree, so that the bound on the normals cannot keep them apart, and what is
    not much wider than the spacing cannot be told from the distance between neighbours.
    """
    rows = np.flatnonzero(above.any(axis=1))
    if not rows.size:
        return
    distance = np.linalg.norm(points[slots[rows]] - points[rows][:, None], axis=2)
    # The second neighbour: at a corner of an open sheet the next ones are farther away.
    spacing = tree.query(points[rows], [min(len(points), 3)])[0][:, 0]
    tight = np.argwhere(above[rows] & (distance < LINK * spacing[:, None]))
    if tight.size:
        r, c = tight[0]
        raise ValueError(
            f"points {names[rows[r]]} and {names[slots[rows[r], c]]} lie on two sheets of the "
            f"same orientation, {distance[r, c]:.3g} apart: their normals cannot tell them apart; "
            f"use more points there (spacing {spacing[r]:.3g}, a gap of at least "
            f"{LINK * spacing[r]:.3g} is needed)"
        )


def two_sheets(points, normals, slots, rows) -> np.ndarray:
    """True for slots above or below their row's point on a sheet parallel to it."""
    here, mine = points[rows], normals[rows]
    above = np.zeros(slots.shape, bool)
    for column, slot in zip(above.T, slots.T, strict=True):  # (n, k, d) arrays would be large
        d, theirs = points[slot] - here, normals[slot]
        rise = np.minimum(*(np.abs(np.einsum("nd,nd->n", d, m)) for m in (mine, theirs)))
        cosine = np.einsum("nd,nd->n", mine, theirs)
        column[:] = stands_above(np.einsum("nd,nd->n", d, d), cosine, rise)
    return above


def stands_above(squared, cosine, rise):
    """Whether points at some distance lie above or below one, on a sheet parallel to its own.

    Args:
        squared: of the distance.
        cosine: between the normals.
        rise: the lesser of the heights over the two tangent planes.
    """
    return (cosine > 0.9) & (rise * rise > 0.81 * squared) & (squared > 0)


def ring_size(dim: int) -> int:
    """A point and its closest neighbours: two of a curve, four of a surface."""
    return 2 * dim - 1


def query(tree: cKDTree, points: np.ndarray, count: int) -> np.ndarray:
    """Indices of the `count` nearest points, `(n, count)`."""
    return tree.query(points, np.arange(1, count + 1), workers=-1)[1]


def _spacing_from_count(reach: np.ndarray, count, dim: int) -> np.ndarray:
    """Spacing h of a sheet that has `count` points within `reach`."""
    volume = 2 * reach if dim == 2 else np.pi * reach**2
    return (volume / count) ** (1 / (dim - 1))
