"""Neighbours found anew, and adapted, also in compiled code: `choose_neighbors` for motion.

Known points of a CPU are searched on the host. In compiled code all shapes are fixed beforehand
(`NeighborSearch`). Most rows are searched at once, within the distance that most need; those that
need more, hold points of another sheet or have no dominant centre are taken out, some at a time,
for as long as there are any.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Int

from .adapt import dominance, is_better, represented, share_wanted, sizes_to_try
from .arguments import instance, real
from .build import poorly_served, resized, stencil_weights
from .built import Built, built
from .cells import all_on
from .checks import RINGS
from .cloud import PointCloud
from .compiling import in_batches, on_device, sized_jit
from .failures import is_concrete, is_eager, unchecked, without_derivatives
from .islands import Rings, without_islands
from .machine import AGAIN, COUNTED, CPU, SHEETS, TRIED, block, machine
from .nearest import Grid, Nearest, nearest_in
from .neighbors import Neighbors, Rows, find_neighbors, with_near
from .quadrature import Cut
from .stencils.method import AbstractMethod
from .stencils.targets import Laplacian

# Rows that are looked at again are taken out so many at a time, their sheets so many.
# Points whose neighbours reach farther than others' by so many standard deviations wait for that.
_DEVIATIONS = 3.0
# What numbers of candidates are rounded up to.
_ROUND = 64
# A list that reaches so many times as far as others' has lost a point.
_LOST = 4.0
# How much farther a wider search looks than even points would need.
_SLACK = 1.1
# What a code says of a point's list.
UNREACHED, CROWDED = 4, 5


class Tier(NamedTuple):
    """A search for some rows: how many neighbours, cells to look into, room for candidates."""

    k: int
    reach: int
    candidates: int


class NeighborSearch(eqx.Module):
    """Room to find neighbours of a moving surface in, and to adapt them, in compiled code.

    Made by `Discretization.search`, taken by `Discretization.moved`. Its numbers are part of the
    compiled program: surfaces that share them share it.

    Args:
        method: how weights are computed; it asks for so many neighbours.
        k: the usual number of neighbours.
        sizes: of other neighbourhoods, tried in turn where the Laplacian has no dominant centre.
        slots: of the lists.
        tiers: the searches for all rows, for those with points out of reach or on another sheet,
            and for those that are adapted; none if points will be known, and on a CPU.

    Example:
        >>> surface = js.discretize(js.sphere(500), method=js.GFDM(degree=2))
        >>> search = surface.search()
        >>> isinstance(search, js.NeighborSearch), search.k
        (True, 36)
        >>> surface.moved(2 * surface.cloud.points, search=search).neighbors.k == search.slots
        True
    """

    method: AbstractMethod
    k: int = eqx.field(static=True)
    sizes: tuple[int, ...] = eqx.field(static=True)
    slots: int = eqx.field(static=True)
    tiers: tuple[Tier, ...] = eqx.field(static=True)

    def __check_init__(self):
        instance(self.method, AbstractMethod, "method", "GFDM(degree=2), say")
        if self.slots < self.k:
            raise ValueError(f"slots = {self.slots}, for k = {self.k} neighbours at least {self.k}")
        if len(self.tiers) not in (0, 3):
            raise ValueError(f"tiers: {len(self.tiers)} searches, 3 are needed")

    @classmethod
    def allocated(
        cls,
        cloud: PointCloud,
        neighbors: Neighbors,
        method: AbstractMethod,
        margin: float,
        known: bool = False,
    ) -> NeighborSearch:
        """With room for what these points need, times a margin; for known ones none on a CPU."""
        real(margin, "margin", least=1)
        d, available = cloud.dim, int(cloud.host_active.sum())
        k = min(method.neighbor_count(d), available)
        sizes = tuple(sizes_to_try(method, d, k, available))
        if known and machine() is CPU:
            return cls(method, k, sizes, max(k, neighbors.k), ())
        usual = min(max(k, 2 * RINGS), available)
        grid = _grid(cloud, _reach(cloud, neighbors, k, usual))

        def tier(wanted: int, least: int) -> Tier:
            wanted = min(wanted, available)
            reach = max(least, math.ceil(_SLACK * (wanted / usual) ** (1 / (d - 1))))
            room = min(cloud.n, math.ceil(margin * int(np.max(_candidates(grid, reach)))))
            # Few sizes: surfaces of as many points share a program.
            return Tier(wanted, reach, -(-room // _ROUND) * _ROUND)

        most = 2 * max(k, *sizes) if sizes else usual
        first = Tier(usual, 1, tier(0, 1).candidates)
        return cls(
            method,
            k,
            sizes,
            max(k, neighbors.k),
            (first, tier(max(2 * k, usual), 2), tier(most, 2)),
        )


@sized_jit
def _candidates(grid, reach: int):
    rows = jnp.arange(len(grid.order), dtype=jnp.int32)
    return in_batches(lambda i: grid.candidates(i[None], reach)[1][0], rows, block(COUNTED))


def renewed(
    search: NeighborSearch,
    cloud: PointCloud,
    before: Neighbors,
    cut: Cut | None = None,
    throw: bool = False,
) -> tuple[Neighbors, Int[Array, " n"], Built]:
    """Lists of a moved cloud, a code for each, and operators that are built with them.

    These are differentiated; all the rest is constant. Known points of a CPU are searched by a k-d
    tree: nothing is compiled for that, and it needs no room.

    Args:
        before: lists of the same points before they moved. They say how far to look; a row without
            room for a new list keeps that one.
        cut: as of `built`.
        throw: raise what is an error of the host, as points that coincide.
    """
    known = without_derivatives((cloud, before, search.method))
    if machine() is CPU and cut is None and is_concrete(known) and is_eager():
        try:
            return _on_host(search, cloud, before)
        except ValueError:
            # What is not finite has a code, below.
            if not search.tiers or (throw and np.isfinite(known[0].seen.points).all()):
                raise
    if not search.tiers:
        raise ValueError("search has no room for points that are not known: see surface.search()")
    fixed = jax.tree.map(jax.lax.stop_gradient, cloud)
    usual, code, found_by = usual_lists(search, fixed, before)
    built_with = lambda lists: built(cloud, lists, search.method, cut, throw=False)
    operators = built_with(usual)
    # Where the lists before had none, those of all points are even, or nearly.
    near = None if before.near is None else usual
    if not search.sizes:
        return with_near(usual, near), code, operators
    diagnostics = jax.tree.map(jax.lax.stop_gradient, operators.laplacian.diagnostics)
    adapted, code, changed = _adapted(search, found_by, fixed, before, usual, code, diagnostics)
    changed = without_derivatives(changed)
    if not is_concrete(changed):
        again = lambda: (adapted, built_with(adapted))
        adapted, operators = jax.lax.cond(changed, again, lambda: (usual, operators))
    elif changed:
        operators = built_with(adapted)
    return with_near(adapted, near), code, operators


def _on_host(search, cloud, before):
    fixed, method = without_derivatives(cloud), search.method
    lists = find_neighbors(fixed, search.k, throw=False)
    usual = _with_slots(lists, search.slots)
    built_with = lambda lists: built(cloud, lists, method, throw=False)
    operators, code = built_with(usual), on_device(np.zeros(cloud.n, int))
    near = None if before.near is None else usual
    diagnostics = without_derivatives(operators.laplacian.diagnostics)
    share, poor = poorly_served(fixed, diagnostics, method)
    (adapted, _), size, _ = resized(fixed, lists, None, method, share, poor, search.sizes)
    if (size == search.k).all():
        return with_near(usual, near), code, operators
    adapted = _with_slots(adapted, search.slots)
    return with_near(adapted, near), code, built_with(adapted)


def _with_slots(lists: Neighbors, slots: int) -> Neighbors:
    """Lists with as many slots or more; concrete."""
    indices = np.tile(np.arange(lists.n, dtype=np.int32)[:, None], slots)
    mask = np.zeros(indices.shape, bool)
    indices[:, : lists.k], mask[:, : lists.k] = lists.indices, lists.mask
    return unchecked(Neighbors, on_device(indices), on_device(mask))


@sized_jit
def usual_lists(search: NeighborSearch, cloud: PointCloud, before: Neighbors):
    """Lists of the usual size, a code for each, and what others are found with."""
    grid = _grid(cloud, _reach(cloud, before, search.k, search.tiers[0].k))
    found, code = _usual(search, grid)
    on = all_on(cloud.points, cloud.active)
    code = jnp.where(on & ~grid.on, UNREACHED, code)  # not finite
    rings = Rings.of(grid, found)
    lists = _Lists(found.indices[: search.k], found.mask[: search.k], code)
    lists = _apart(search, grid, rings, found, lists)
    return _padded(lists, before, search.slots), lists.code, (grid, rings)


class _Lists(eqx.Module):
    """Lists of some rows, slots first, and what is wrong with them."""

    indices: Int[Array, "k r"]
    mask: Bool[Array, "k r"]
    code: Int[Array, " r"]


@sized_jit
def _reach(cloud, before, k: int, usual: int):
    """Within which most points find `usual` neighbours, from where their last k are now."""
    x = cloud.points

    def farthest(most, slot):
        index, used = slot
        return jnp.maximum(most, jnp.where(used, jnp.sum((x[index] - x) ** 2, axis=1), 0)), None

    mask = before.mask[:, :k]
    squared = jax.lax.scan(farthest, jnp.zeros(len(x), x.dtype), (before.indices[:, :k].T, mask.T))
    count = jnp.sum(mask, axis=1)
    # Where there are fewer, as many more as a larger disc holds.
    far = jnp.sqrt(squared[0]) * (usual / jnp.maximum(count, 1)) ** (1 / (cloud.dim - 1))
    far = far.astype(x.dtype)
    on = (count > 1) & (far > 0) & jnp.isfinite(far)
    # A point lost far away is in the lists of many.
    low = jnp.mean(jnp.where(on, far, 1) ** -2.0, where=on) ** -0.5
    on = on & (far < _LOST * low)
    mean = jnp.mean(far, where=on)
    most = jnp.minimum(
        jnp.max(far, where=on, initial=0), mean + _DEVIATIONS * jnp.std(far, where=on)
    )
    return (1 + 1e-6) * most


@sized_jit
def _grid(cloud, reach):
    on = all_on(cloud.points, cloud.active)
    return Grid.of(cloud.points, cloud.normals, on, reach)


def _usual(search, grid) -> tuple[Nearest, Int[Array, " n"]]:
    """The nearest of all points, and a code where they were not found."""
    (k, reach, room), wider, _ = search.tiers
    n = len(grid.order)
    rows = jnp.arange(n, dtype=jnp.int32)
    found = nearest_in(grid, rows, k, reach=reach, count=room)
    code = jnp.where(found.crowded & grid.on, CROWDED, 0).astype(int)

    def look(rows, state):
        again = nearest_in(grid, rows, k, reach=wider.reach, count=wider.candidates, few=True)
        lost = ~again.mask[search.k - 1] & ~again.all
        return again, jnp.where(again.crowded, CROWDED, jnp.where(lost, UNREACHED, 0))

    short = grid.on & (code == 0) & ~found.mask[-1]
    return _for_rows(short, look, (found, code), AGAIN)


def _apart(search, grid, rings, found, lists) -> _Lists:
    """Other sheets taken out."""
    held = grid.on & (lists.code == 0) & jnp.any(found.above[: search.k], axis=0)
    look = lambda rows, _: _lists(grid, rings, rows, search.k, search.tiers[1])
    return _for_rows(held, look, lists, AGAIN)


@sized_jit
def _adapted(search, found_by, cloud, before, usual, code, diagnostics):
    """Lists of other sizes where the usual one does not serve, codes, and whether any changed."""
    grid, rings = found_by
    lists = _Lists(usual.indices.T[: search.k], usual.mask.T[: search.k], code)
    share = dominance(diagnostics)
    border = jnp.zeros(cloud.n, bool) if cloud.boundary is None else cloud.boundary
    most = max(search.sizes)

    def look(rows, _):
        wide = _lists(grid, rings, rows, most, search.tiers[2])

        def of_size(size):
            return represented(cloud.points, wide.indices.T, wide.mask.T, size, search.k)

        def trial(best_so_far, size):
            best, chosen = best_so_far
            some = Rows(*of_size(size))
            now = dominance(stencil_weights(cloud, some, search.method, Laplacian(), rows)[1])
            wanted = share_wanted(border[rows], share[rows], size, search.k, search.method)
            better = is_better(now, best, wanted, search.method)
            return (jnp.where(better, now, best), jnp.where(better, size, chosen)), None

        start = (share[rows], jnp.full(len(rows), search.k))
        chosen = jax.lax.scan(trial, start, jnp.array(search.sizes))[0][1]
        chosen = jnp.where(wide.code == 0, chosen, search.k)
        changed = (chosen != search.k) & (wide.code == 0)
        new = of_size(chosen[:, None])
        old = lists.indices[:, rows], lists.mask[:, rows]
        indices, mask = (jnp.where(changed, a.T, b) for a, b in zip(new, old))
        return _Lists(indices, mask, wide.code), changed

    poor = grid.on & (lists.code == 0) & (share < search.method.least_dominance)
    lists, changed = _for_rows(poor, look, (lists, jnp.zeros(cloud.n, bool)), TRIED)
    # Rows that find no wider list keep the one from before.
    changed = jnp.any(changed | (lists.code != code))
    return _padded(lists, before, search.slots), lists.code, changed


def _for_rows(which, look: Callable, state, size: int):
    """Some rows of the arrays of a state, which end with the axis of rows, put in by `look`."""
    n = len(which)
    chunk = min(block(size), n)
    # A chunk may begin at the last of them.
    rows = jnp.nonzero(which, size=n + chunk, fill_value=n)[0].astype(jnp.int32)
    count = jnp.sum(which)

    def step(carry):
        start, state = carry
        some = jax.lax.dynamic_slice_in_dim(rows, start, chunk)
        new = look(jnp.minimum(some, n - 1), state)
        put = lambda old, new: old.at[..., some].set(new.astype(old.dtype), mode="drop")
        return start + chunk, jax.tree.map(put, state, new)

    start = jnp.zeros((), count.dtype)
    return jax.lax.while_loop(lambda carry: carry[0] < count, step, (start, state))[1]


def _padded(lists: _Lists, before: Neighbors, slots: int) -> Neighbors:
    """Lists with as many slots; where something is wrong, what there was before."""
    own = jnp.arange(before.n, dtype=jnp.int32)
    fitted = lambda indices, mask: (_wide(indices, slots, own).T, _wide(mask, slots, False).T)
    good = (lists.code == 0)[:, None]
    new, old = fitted(lists.indices, lists.mask), fitted(before.indices.T, before.mask.T)
    return unchecked(Neighbors, *(jnp.where(good, a, b) for a, b in zip(new, old)))


def _wide(a, slots: int, value):
    """As many slots: more are filled with a value."""
    more = slots - len(a)
    if more <= 0:
        return a[:slots]
    return jnp.concatenate([a, jnp.broadcast_to(value, (more, a.shape[1])).astype(a.dtype)])


def _lists(grid: Grid, rings: Rings, rows, k: int, tier: Tier) -> _Lists:
    """The rows of `find_neighbors(cloud, k)`."""
    wide = nearest_in(grid, rows, tier.k, reach=tier.reach, count=tier.candidates, few=True)
    candidates, good = wide.indices[: 2 * k], wide.mask[: 2 * k]
    usual = (candidates[:k], good[:k])
    held = jnp.any(wide.above[:k], axis=0)

    def apart():
        d = len(grid.cells)
        x, normals = jnp.stack(grid.given[:d], axis=1), jnp.stack(grid.given[d:], axis=1)
        find = lambda row: without_islands(x, normals, rings, k, *row)
        found = in_batches(find, (rows, candidates.T, good.T), block(SHEETS))
        return tuple(jnp.where(held, a.T, b) for a, b in zip(found, usual))

    indices, mask = jax.lax.cond(jnp.any(held), apart, lambda: usual)
    # Where points of another sheet were taken out, others may stand beyond the candidates.
    lost = ~mask[-1] & ~jnp.where(held, good[-1], False) & ~wide.all
    code = jnp.where(wide.crowded, CROWDED, jnp.where(lost, UNREACHED, 0))
    return _Lists(indices, mask, code)
