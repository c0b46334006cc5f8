"""Neighbourhoods of fixed size: which points take part in the stencil of which."""

from __future__ import annotations

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from scipy.spatial import cKDTree

from .arguments import POINTS, as_float, finite, instance, is_array, real, shaped, whole
from .checks import check_count, check_orientation, check_overlap, check_spacing, two_sheets
from .cloud import PointCloud
from .compiling import on_device
from .failures import (
    check,
    is_concrete,
    needs_values,
    not_positive,
    raise_at,
    refuse,
    unchecked,
    without_derivatives,
)
from .indices import point_indices
from .sheets import distance_key, judge, nearest, nearest_on_sheet, without_islands


class Neighbors(eqx.Module):
    """Padded neighbour lists.

    Slot 0 of every row is the point itself; k counts it. A padded slot repeats the row's own
    point with mask False, so that every gather is legal.

    Args:
        indices: `(n, k)`, int32, sorted by distance within a row.
        mask: `(n, k)`, True where a slot holds a neighbour.
        radius: the search radius, scalar or `(n,)`, for lists made with a radius: operators
            then let their kernels vanish smoothly there. None for the k nearest.
        near: lists of the nearest, where `indices` leaves some of these out, as
            `choose_neighbors` does where points are uneven: cells of integrals are bounded by the
            nearest. None where it leaves out none.

    Raises:
        TypeError: indices that are not integers, a mask that is not bool.
        ValueError: shapes that do not fit; an index that is no point, a slot 0 that is not the
            point itself, a mask that leaves nothing or others but not the point itself (all in
            compiled code too, when it runs).

    Example:
        >>> neighbors = js.find_neighbors(js.sphere(300), k=12)
        >>> neighbors.indices.shape, bool(neighbors.mask.all())
        ((300, 12), True)
    """

    indices: Int[Array, "n k"]
    mask: Bool[Array, "n k"]
    radius: Float[Array, "*n"] | None = None
    near: Neighbors | None = None

    def __check_init__(self):
        if not (is_array(self.indices) and is_array(self.mask)):
            for name in ("indices", "mask"):
                value = getattr(self, name)
                if isinstance(value, list | tuple | str | int | float | None.__class__):
                    raise TypeError(f"{name} is a {type(value).__name__}, expected an array (n, k)")
            return  # a pytree of something else, as transformations make them
        indices = point_indices(self.indices, "indices", axes="(n, k)", n=0)
        if self.mask.dtype != bool:
            raise TypeError(f"mask is {self.mask.dtype}, expected bool")
        shaped(self.mask, "mask", indices.shape)
        first = (np.asarray(indices) if is_concrete(indices) else indices)[:, 0]
        text = "slot 0 of row {i} names point {v}, expected {i}"
        indices = refuse(indices, first != np.arange(self.n), text, first)
        object.__setattr__(self, "indices", indices)  # with the errors of compiled code
        used = np.asarray(self.mask) if is_concrete(self.mask) else self.mask
        text = f"mask is False in all {used.size} slots: no point has neighbours"
        mask = refuse(self.mask, ~used.any(), text)
        text = "mask of row {i} leaves out the point itself in slot 0 but takes {v} others"
        mask = refuse(mask, used.any(axis=1) & ~used[:, 0], text, used.sum(axis=1))
        object.__setattr__(self, "mask", mask)
        radius = self.radius
        if radius is not None and is_array(radius):
            shaped(radius, "radius", (), (self.n,))
            text = "radius" + " of point {i}" * radius.ndim + " is {v}, expected a positive number"
            check(radius, not_positive, text)

    def __repr__(self):
        about = f"{self.n:,} points, {self.k} slots"
        if is_concrete(self.indices, self.mask):
            count = np.asarray(self.mask).sum(axis=1)
            count = count[count > 0]
            low, high = count.min(initial=self.k), count.max(initial=0)
            about += f", {low} neighbours each" if low == high else f", {low} to {high} neighbours"
            about += f", {self.n - len(count)} rows off" if len(count) < self.n else ""
            if self.radius is not None and is_concrete(self.radius):
                reach = np.asarray(self.radius)
                about += f" within {reach.min():.3g}"
                about += f" to {reach.max():.3g}" if reach.max() > reach.min() else ""
        return f"Neighbors({about})"

    @property
    def n(self) -> int:
        return self.indices.shape[0]

    @property
    def k(self) -> int:
        return self.indices.shape[1]

    @property
    def nearest(self) -> Neighbors:
        """Lists that leave out none that is nearer than another."""
        return self if self.near is None else self.near


class Rows(eqx.Module):
    """Lists of some rows only, or of points that are not in slot 0: what weights are made from.

    No promise is checked.
    """

    indices: Int[Array, "r k"]
    mask: Bool[Array, "r k"]
    radius: Float[Array, "*r"] | None = None


def first_ring(neighbors: Neighbors, dim: int) -> Rows:
    """Lists of the points next to each, without itself: four on a curve, six on a surface."""
    ring = slice(1, 2 * dim + 1)
    return Rows(neighbors.indices[:, ring], neighbors.mask[:, ring])


def find_neighbors(
    cloud: PointCloud | Float[Array, "n d"],
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
    of a thin or folded part out of the neighbourhood. A row that reaches across a gap onto a
    sheet of the same orientation, as from one toe to the next, keeps only the points that a
    short way over the surface leads to, in steps of at most two spacings; with k, the next such
    points take the places of the others. Rows are sorted by distance, equal distances by index.

    Args:
        cloud: n points with unit normals; its arrays must be concrete. Points that are
            switched off are nobody's neighbour and have no neighbours. Or bare points
            `(n, d)` of flat space, where there are no sheets to tell apart.
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

    Accuracy: in float32 as in double precision where distances tie (`tests/test_neighbors.py`).
    Differentiable: the lists are integers; operators are differentiable for fixed lists. Under
    `grad` they are those of the values that are differentiated.
    Raises:
        TypeError: no cloud or array of points; k or capacity that are not whole numbers.
        ValueError: arrays traced by `jit` or `vmap` (use `search_neighbors`); k, radius or
            capacity out of range (both numbers given); duplicates, lone points, mixed orientation
            and sheets too close to be told apart (named by index).

    Example:
        >>> angle = 2 * jnp.pi * jnp.arange(50) / 50
        >>> circle = jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=1)
        >>> neighbors = js.find_neighbors(js.PointCloud(circle, circle), k=5)
        >>> neighbors.indices[10].tolist()
        [10, 9, 11, 8, 12]
    """
    if (k is None) == (radius is None):
        raise ValueError("give exactly one of k and radius")
    cloud = without_derivatives(cloud)
    needs_values("cloud", cloud, instead="under jit and vmap use search_neighbors")
    needs_values("radius", radius, instead="nothing is differentiated in it")
    if k is not None and capacity is not None:
        raise ValueError("capacity belongs to a search by radius; with k the rows have k slots")
    if k is not None:
        k = whole(k, "k")
    if capacity is not None:
        capacity = whole(capacity, "capacity", least=1)
    real(min_cosine, "min_cosine", least=-1, most=1)
    surface = isinstance(cloud, PointCloud)
    if not isinstance(cloud, PointCloud):
        if hasattr(cloud, "cloud"):  # a surface
            instance(cloud, PointCloud, "cloud")
        flat = shaped(as_float(cloud, "cloud"), "points", *POINTS)
        cloud = PointCloud(flat, jnp.zeros_like(flat).at[:, 0].set(1))
    on = cloud.host_active
    rows = np.flatnonzero(on)
    points = np.asarray(cloud.points)[rows]
    normals = np.asarray(cloud.normals)[rows]
    if k is not None:
        check_count(k, len(rows))
    tree = cKDTree(points.astype(float))
    check_spacing(points, tree, names=rows)
    if surface and throw:
        check_orientation(points, normals, tree, names=rows)
    if k is not None:
        slots, mask = nearest(points, normals, tree, k, min_cosine)
    else:
        given = finite(as_float(radius, "radius", (), (cloud.n,)), "radius")
        reach = np.broadcast_to(np.asarray(given, points.dtype), cloud.n)
        raise_at(on & ~(reach > 0), "radius of point {i} is {v}, expected a positive number", reach)
        slots, mask = _within(points, normals, tree, reach[rows], capacity, min_cosine, rows)
    if surface:
        above = two_sheets(points, normals, slots, np.arange(len(rows)))
        if throw:
            check_overlap(points, normals, tree, slots, above, names=rows)
        if above.any():
            slots, mask = without_islands(
                points, normals, tree, slots, mask, above, min_cosine, refill=k is not None
            )
    indices = np.tile(np.arange(cloud.n, dtype=np.int32)[:, None], slots.shape[1])
    accepted = np.zeros(indices.shape, bool)
    indices[rows] = np.where(mask, rows[slots], indices[rows])
    accepted[rows] = mask
    return Neighbors(
        on_device(indices),
        on_device(accepted),
        None if radius is None else jnp.asarray(radius, cloud.points.dtype),
    )


def nearest_of(
    cloud: PointCloud, rows: np.ndarray, k: int, *, min_cosine: float = 0.0
) -> tuple[np.ndarray, np.ndarray]:
    """The rows `rows` of `find_neighbors(cloud, k)`, without searching the others.

    Returns:
        Indices and mask, `(r, k)`; rows may come in any order and more than once.
    """
    rows = np.asarray(rows)
    on = cloud.host_active
    names = np.flatnonzero(on)
    check_count(k, len(names))
    points, normals = np.asarray(cloud.points)[names], np.asarray(cloud.normals)[names]
    wanted = np.flatnonzero(on[rows])
    place = (np.cumsum(on) - 1)[rows[wanted]]
    tree = cKDTree(points.astype(float))
    slots, accepted = nearest_on_sheet(points, normals, tree, k, min_cosine, rows=place)
    indices, mask = np.tile(rows[:, None].astype(np.int32), k), np.zeros((len(rows), k), bool)
    indices[wanted], mask[wanted] = names[slots], accepted
    return indices, mask


def _within(points, normals, tree, radius, capacity, min_cosine: float, names):
    """All acceptable points within each point's radius."""
    n = len(points)
    far = float(radius.max()) * (1 + 1e-6)  # the last bits are judged below
    pairs = tree.query_pairs(far, output_type="ndarray")
    row, found = np.concatenate([pairs, pairs[:, ::-1], np.tile(np.arange(n)[:, None], 2)]).T
    key, accepted = judge(points, normals, row, found, min_cosine)
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
    width = int(count.max(initial=1)) if capacity is None else capacity
    text = f"point {{i}} has {{v}} neighbours within the radius, capacity is {capacity}"
    raise_at(count > width, text, count, points=names)
    slots = np.tile(np.arange(n)[:, None], width)
    mask = np.arange(width) < count[:, None]
    slots[mask] = found
    return slots, mask


def switched_on(cloud: PointCloud, neighbors: Neighbors) -> Neighbors:
    """The lists less points that are switched off, whatever cloud they were found on."""
    if cloud.active is None or neighbors.n != cloud.n:
        return neighbors

    def used(lists: Neighbors) -> Neighbors:
        mask = _used(cloud.active, lists.indices, lists.mask)
        return unchecked(Neighbors, lists.indices, mask, lists.radius)

    return changed(neighbors, used)


def changed(lists: Neighbors, change: Callable[[Neighbors], Neighbors]) -> Neighbors:
    """Lists after a change, and those of the nearest that they know after the same."""
    return with_near(change(lists), None if lists.near is None else change(lists.near))


def with_near(lists: Neighbors, near: Neighbors | None) -> Neighbors:
    """Lists that know the nearest, which they may leave out."""
    return unchecked(Neighbors, lists.indices, lists.mask, lists.radius, near)


@jax.jit
def _used(active, indices, mask):
    return mask & active[indices] & active[:, None]
