r"""Sheets of a surface that come near each other: which points face which, and what is done."""

from __future__ import annotations

from typing import Any, Literal, NamedTuple, get_args

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from ..arguments import instance, real
from ..cloud import PointCloud
from ..compiling import on_device
from ..discretization import Discretization
from ..failures import warn
from ..neighbors import Neighbors, Rows, changed, first_ring

Kind = Literal["delete", "non-penetration", "merge"]
KINDS = get_args(Kind)
# Points face each other if the cosine of their normals is below, if the way from one to the other
# leaves both sheets steeply: its cosine with their normals is above; and if a circle through both
# with these normals is no wider than this, in the distance asked for.
_OPPOSED, _STEEP, _WIDE = -0.05, 0.6, 1.18
# Sheets are watched from so many contact distances on.
_WATCHED = 2.0
# Between two looks a point may always go as far as this, in contact distances: looks at sheets
# that approach do not follow each other ever faster.
_LEAST = 0.05
# Points of the other sheet that a point is kept apart from.
_FACED = 16


class Contact(eqx.Module):
    r"""What happens where two sheets of a surface come near each other.

    Sheets are of two surfaces or of one, and meet from outside, or through the inside of a part
    that has become thin. Those are found by their normals, which oppose each other; so do those
    of a corner of less than a right angle, and of points that a front has left behind in a corner:
    "delete" rounds it off before it folds. Only sheets
    of two surfaces that are kept apart, or stick, may have normals that point the same way.

    Args:
        distance: at which sheets touch, in length. For "delete" three to five spacings: a neck is
            that thick when it pinches off (or 1.2 times so: sheets may face each other at a slant),
            and must still carry stencils. For the others two or more, of what spacings are where
            sheets meet: below one they may cross between points, with a warning.
        kind: "delete" cuts out what touches and closes what is left: a neck pinches off, two drops
            become one, what is thinner everywhere vanishes, and so does a part with fewer points
            than a stencil asks for. The new parts are the zero set of a smooth function that passes
            through the points around with their normals; fields there are means of those around,
            and with `Adaptation(conserve=True)` what was held by the parts that go is spread over
            all that is left. It needs `adapt`, and a closed surface there.
            "non-penetration" takes away the velocity with which sheets approach, half from each,
            more and more from twice the distance on: they may slide and part. "merge" takes away
            all of their relative velocity so: they stick, and move as one sheet of two sides.

    Accuracy: looks follow each other so that sheets come nearer by at most a fifth of the distance
        unseen; by which sheets are apart falls with the square of the spacing; new parts pass
        through the points around (`tests/test_contact.py`); in float32 they are within 1e-5.
    Raises:
        TypeError: a distance that is no number.
        ValueError: a distance that is not positive, another kind.
    Source: after Suchde and Kuhnert 2019, Section 3.6. There points are deleted and the rims left
        to the filling of holes; points that have penetrated are moved back. Here none penetrates:
        sheets are looked at before they can have crossed, at a distance by a quadratic fit (10).

    Example:
        >>> x, half = js.sphere(200).points, jnp.array([1.5, 0, 0])
        >>> both = js.PointCloud(jnp.concatenate([x - half, x + half]), jnp.concatenate([x, x]))
        >>> ahead = jnp.repeat(jnp.array([[1.0, 0, 0], [-1.0, 0, 0]]), 200, axis=0)
        >>> meet = js.Motion(lambda t, surface, fields, args: ahead)
        >>> end = js.evolve(meet, both, t1=0.2, contact=js.Contact(0.5, kind="non-penetration"))
        >>> way = jnp.abs(end.clouds[-1].points - both.points)[:, 0]
        >>> bool(way.min() < 0.17), bool(abs(way.max() - 0.2) < 1e-6)
        (True, True)
    """

    distance: Float[Array, ""]
    kind: Kind = eqx.field(static=True)

    def __init__(self, distance, kind: Kind = "delete"):
        self.distance = jnp.asarray(real(distance, "distance", above=0))
        if kind not in KINDS:
            raise ValueError(f"kind = {kind!r}, expected one of {', '.join(map(repr, KINDS))}")
        self.kind = kind

    @property
    def deletes(self) -> bool:
        return self.kind == "delete"


def checked_contact(contact: Any) -> Contact:
    return instance(contact, Contact, "contact", "js.Contact(distance)")


class Facing(NamedTuple):
    """Points that face each other.

    Args:
        pairs: their rows, each pair once.
        gap: how far they are apart.
        inside: the way from one to the other goes through the inside.
    """

    pairs: Int[np.ndarray, "m 2"]
    gap: Float[np.ndarray, " m"]
    inside: Bool[np.ndarray, " m"]


def facing(cloud: PointCloud, reach: float) -> Facing:
    """All pairs of points that face each other, as far apart as this at most."""
    rows = np.flatnonzero(cloud.host_active)
    x, n = (np.asarray(a, float)[rows] for a in (cloud.points, cloud.normals))
    # Next to each other, with normals that oppose each other: near in a space of both.
    size = reach / np.sqrt(2 + 2 * _OPPOSED)
    trees = [cKDTree(np.concatenate([x, sign * size * n], axis=1)) for sign in (1, -1)]
    found = trees[0].sparse_distance_matrix(trees[1], np.sqrt(2) * reach, output_type="ndarray")
    i, j = found["i"][once := found["i"] < found["j"]], found["j"][once]
    way = x[j] - x[i]
    gap = np.linalg.norm(way, axis=1)
    ups = [np.einsum("md,md->m", way, s * n[k]) / gap for k, s in ((i, 1), (j, -1))]
    cosine = np.einsum("md,md->m", n[i], n[j])
    steep = np.minimum(*np.abs(ups)) > _STEEP
    near = gap <= reach * np.minimum(1, _WIDE * np.sqrt((1 - cosine) / 2))
    good = near & steep & (cosine < _OPPOSED) & (ups[0] * ups[1] > 0)
    return Facing(rows[np.stack([i, j], axis=1)[good]], gap[good], ups[0][good] < 0)


def turned_over(cloud: PointCloud, neighbors: Neighbors) -> Facing:
    """Pairs of points next to each other in a corner that folds.

    Their normals oppose each other; or the way from one to the other is along both normals, where
    one has been left behind.
    """
    x, n = np.asarray(cloud.points, float), np.asarray(cloud.normals, float)
    lists, used = np.asarray(neighbors.indices), np.asarray(neighbors.mask)
    ring = first_ring(neighbors, cloud.dim)
    near, on = np.asarray(ring.indices), np.asarray(ring.mask)
    way = x[near] - x[:, None]
    heights = [np.einsum("nkd,nd->nk", way, n), np.einsum("nkd,nkd->nk", way, n[near])]
    steep = np.minimum(*np.abs(heights)) > _STEEP * np.linalg.norm(way, axis=2)
    opposed = np.einsum("nkd,nd->nk", n[near], n) < _OPPOSED
    row, slot = np.nonzero(on & (opposed | steep & (heights[0] * heights[1] > 0)))
    pairs = np.unique(np.sort(np.stack([row, near[row, slot]], axis=1), axis=1), axis=0)
    row, other = pairs.T
    # Through the inside where the points around are below.
    around, share = lists[row], used[row]
    mean = np.einsum("mk,mkd->md", share, n[around])
    rise = np.einsum("mk,mkd,md->m", share, x[around] - x[row, None], mean)
    return Facing(pairs, np.linalg.norm(x[other] - x[row], axis=1), rise < 0)


def chambers(cloud: PointCloud, neighbors: Neighbors | Rows) -> Int[np.ndarray, " n"]:
    """Which connected part of the surface each point is on, from 0; -1 where it is off.

    Connected by lists: parts of fewer points than a list holds are connected to others by what is
    farther, but not by their `first_ring`.
    """
    row, slot = np.nonzero(np.asarray(neighbors.mask))
    found = np.asarray(neighbors.indices)[row, slot]
    graph = coo_array((np.ones(len(row), np.int8), (row, found)), shape=(cloud.n, cloud.n))
    label, on = connected_components(graph, directed=False)[1], cloud.host_active
    parts = np.full(cloud.n, -1)
    parts[on] = np.unique(label[on], return_inverse=True)[1]
    return parts


def _parts(
    before: Int[np.ndarray, " n"], cloud: PointCloud, neighbors: Neighbors, distance: float
) -> Int[np.ndarray, " n"]:
    """The chamber that each point is on: what was apart stays so, and new points are on that of the
    nearest with such a normal."""
    on = cloud.host_active
    known, new = np.flatnonzero(on & (before >= 0)), np.flatnonzero(on & (before < 0))
    if not known.size:
        return chambers(cloud, neighbors)
    place = np.concatenate([cloud.points, distance * np.asarray(cloud.normals)], axis=1)
    parts = np.where(on, before, -1)
    parts[new] = before[known[cKDTree(place[known]).query(place[new])[1]]]
    return parts


def parts_after(parts: Int[np.ndarray, " n"], before, after) -> Int[np.ndarray, " m"]:
    """The parts of rows that hold the same points as before; -1 for others, as for more rows."""
    same = np.all(np.asarray(before) == np.asarray(after)[: len(before)], axis=1)
    return np.pad(np.where(same, parts, -1), (0, len(after) - len(before)), constant_values=-1)


def without_other_parts(
    surface: Discretization, contact: Contact | None, parts: Int[np.ndarray, " n"]
) -> Discretization:
    """With lists that hold no points of other parts that it is kept apart from, though these are
    near: at rims, or where a sheet is stretched until its points are no nearer to each other."""
    if contact is None or contact.deletes:
        return surface

    def mixed(lists: Neighbors):
        one, other = parts[:, None], parts[np.asarray(lists.indices)]
        return np.asarray(lists.mask) & (one != other) & (one >= 0) & (other >= 0)

    def held(lists: Neighbors) -> Neighbors:
        return Neighbors(lists.indices, lists.mask & ~on_device(mixed(lists)), lists.radius)

    if not mixed(surface.neighbors).any():
        return surface
    lists = changed(surface.neighbors, held)
    return Discretization(surface.cloud, lists, surface.method, surface.border)


class Faced(eqx.Module):
    """What points are kept apart from.

    Args:
        indices, mask: points on other sheets near each point.
        side: 1 if it is outside of those, as their normals tell, else -1.
        width: of the weights of those points.
        distance: at which sheets touch.
        stick: nor do they slide or part.
    """

    indices: Int[Array, "n f"]
    mask: Bool[Array, "n f"]
    side: Float[Array, " n"]
    width: Float[Array, " n"]
    distance: Float[Array, ""]
    stick: bool = eqx.field(static=True)

    def gap(self, points, normals, bends) -> tuple[Array, Array, Array]:
        r"""Signed distance of each point from the other sheet, the way out of that, and weights.

        From a sheet with shape tensor $S_j$ at its point $x_j$ a point with $y = x - x_j$, at the
        height $h = y\cdot n_j$, is as far as $h + \tfrac12 y\cdot(S_j - h S_j^2)\,y$, to second
        order: the local quadratic fit (10), from normals. Of those near it the mean is taken with
        Gaussian weights, which is smooth.

        Args:
            bends: S, `(n, d, d)`.
        """
        away = points[:, None] - points[self.indices]
        width = (self.width**2)[:, None]
        squared = jnp.sum(away**2, axis=2)
        nearest = jnp.min(jnp.where(self.mask, squared, jnp.inf), axis=1, keepdims=True)
        share = jnp.exp(-(squared - jnp.where(jnp.isfinite(nearest), nearest, 0)) / width)
        share = jnp.where(self.mask, share, 0)
        total = jnp.sum(share, axis=1, keepdims=True)
        share = (share / jnp.where(total > 0, total, 1))[..., None]
        side = self.side[:, None, None]
        there, tensor = normals[self.indices], bends[self.indices]
        bent = jnp.einsum("nfab,nfb->nfa", tensor, away)
        height = jnp.sum(away * there, axis=2, keepdims=True)
        bent = bent - height * jnp.einsum("nfab,nfb->nfa", tensor, bent)
        gap = jnp.sum(share * side * away * (there + bent / 2), axis=(1, 2))
        # Far from a sheet, in its radii, the fit tells nothing; it is no nearer than its points
        # are, less what may be between them.
        between = jnp.max(jnp.where(self.mask, self.width[self.indices], 0), axis=1)
        beyond = jnp.where(jnp.any(self.mask, axis=1), nearest[:, 0] - between**2, 0)
        least = jnp.sqrt(jnp.where(beyond > 0, beyond, 1))
        gap = jnp.where(beyond > 0, jnp.maximum(gap, least), gap)
        out = jnp.sum(share * side * (there + bent), axis=1)
        out = out / jnp.sqrt(jnp.maximum(jnp.sum(out**2, axis=1, keepdims=True), 0.01))
        return gap, out, share

    def kept_apart(self, points, normals, bends, velocity) -> Float[Array, "n d"]:
        """The velocity less half of that with which sheets approach, or all that is relative."""
        gap, out, share = self.gap(points, normals, bends)
        relative = velocity - jnp.sum(share * velocity[self.indices], axis=1)
        approach = jnp.minimum(jnp.sum(relative * out, axis=1), 0)
        wrong = relative if self.stick else approach[:, None] * out
        near = jnp.clip(2 - gap / self.distance, 0, 1)
        near = jnp.where(jnp.any(self.mask, axis=1), near**2 * (3 - 2 * near), 0)
        return velocity - (near / 2)[:, None] * wrong


def watched(
    contact: Contact, cloud: PointCloud, neighbors: Neighbors, before: Int[np.ndarray, " n"]
) -> tuple[Float[np.ndarray, " n"], Faced | None, Int[np.ndarray, " n"]]:
    """How far points may go until sheets are looked at again, what they are kept apart from, and
    the part that each is on.

    Args:
        before: the part, at the look before; -1 for points that are new.
    """
    if not contact.deletes:
        part = _parts(before, cloud, neighbors, float(contact.distance))
        return *_others(contact, cloud, neighbors, part), part
    d = float(contact.distance)
    pairs, gap, _ = facing(cloud, _WATCHED * d)
    nearest = np.full(cloud.n, _WATCHED * d)
    np.minimum.at(nearest, pairs.ravel(), np.repeat(gap, 2))
    return np.maximum((nearest - d) / 2, _LEAST * d), None, before


def _others(contact: Contact, cloud: PointCloud, neighbors: Neighbors, part):
    """The nearest points of other chambers, and of the own that face a point."""
    x, n = np.asarray(cloud.points, float), np.asarray(cloud.normals, float)
    h = _spacings(cloud, neighbors)
    # Both of two sheets may come nearer by what a point may go, and slide as far.
    reach = _WATCHED * float(contact.distance) + 4 * float(h.max())
    found = [facing(cloud, reach).pairs]
    for label in range(part.max()):
        one, rest = np.flatnonzero(part == label), np.flatnonzero(part > label)
        trees = [cKDTree(x[rows]) for rows in (one, rest)]
        near = trees[0].sparse_distance_matrix(trees[1], reach, output_type="ndarray")
        found.append(np.stack([one[near["i"]], rest[near["j"]]], axis=1))
    pairs = np.concatenate(found)
    pairs = np.unique(np.concatenate([pairs, pairs[:, ::-1]]), axis=0)
    length = np.linalg.norm(x[pairs[:, 1]] - x[pairs[:, 0]], axis=1)
    pairs = pairs[np.lexsort((length, pairs[:, 0]))]
    slot = np.arange(len(pairs)) - np.searchsorted(pairs[:, 0], pairs[:, 0])
    pairs, slot = pairs[slot < _FACED], slot[slot < _FACED]
    indices = np.tile(np.arange(cloud.n, dtype=np.int32)[:, None], _FACED)
    mask = np.zeros(indices.shape, bool)
    indices[pairs[:, 0], slot], mask[pairs[:, 0], slot] = pairs[:, 1], True
    other = indices[:, 0]
    limit, away = float(contact.distance), np.linalg.norm(x - x[other], axis=1)
    near = mask[:, 0] & (away < _WATCHED * limit + h) & (h > limit)
    for label in np.unique(part[near]):
        _tell_short(limit, x[part == label], x[near & (part == label)])
    outside = np.where(np.sum((x - x[other]) * n[other], axis=1) < 0, -1.0, 1.0)
    numbers = (outside, h, contact.distance)
    side, width, distance = (jnp.asarray(a, cloud.points.dtype) for a in numbers)
    lists = (jnp.asarray(indices), jnp.asarray(mask))
    return h, Faced(*lists, side, width, distance, contact.kind == "merge")


def _tell_short(limit: float, sheet, points) -> None:
    """Warn of a distance below the spacing of a sheet at some of its points."""
    if np.any(cKDTree(sheet).query(points, 2)[0][:, 1] > limit):
        warn(
            f"distance = {limit:.3g} is shorter than points are apart on sheets that come near "
            "each other: they may cross between points; two spacings or more do"
        )


def _spacings(cloud: PointCloud, neighbors: Neighbors) -> Float[np.ndarray, " n"]:
    """Mean distance to the points next to each; zero where it is off."""
    x, ring = np.asarray(cloud.points, float), first_ring(neighbors, cloud.dim)
    on = np.asarray(ring.mask)
    away = np.linalg.norm(x[np.asarray(ring.indices)] - x[:, None], axis=2)
    return np.sum(np.where(on, away, 0), axis=1) / np.maximum(on.sum(axis=1), 1)
