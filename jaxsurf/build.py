r"""From a cloud to stencils: neighbourhoods chosen, weights in blocks, what is wrong with them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import nullcontext
from typing import Any

import jax
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from .adapt import dominance, is_better, report, represented, share_wanted, sizes_to_try
from .adapt import residual_tolerance as residual_tolerance
from .arguments import as_many, instance, whole
from .blocks import blocks_of, of_each, rows_of
from .cloud import PointCloud
from .compiling import Pieces, at_once, host_jit, is_quick, namespace, on_device
from .cores import calls_library, divided, side_by_side
from .failures import (
    is_concrete,
    needs_values,
    raise_at,
    refuse,
    unchecked,
    warn,
    without_derivatives,
)
from .fits.moments import blockwise
from .indices import mask as checked_mask
from .machine import TRIED, block
from .neighbors import Neighbors, Rows, changed, find_neighbors, nearest_of, switched_on
from .stencils.method import AbstractMethod, Diagnostics, Neighborhood, weights_by
from .stencils.stencil import Stencil
from .stencils.targets import Laplacian
from .stencils.usual import USUAL

_LAPLACIAN = Laplacian()


def choose_neighbors(
    cloud: PointCloud,
    *,
    method: AbstractMethod = USUAL,
    bound: Bool[Array, " n"] | None = None,
    throw: bool = True,
) -> Neighbors:
    r"""Neighbourhoods suited to a method, of another size where the points are irregular.

    Every point gets the number k of neighbours that the method asks for. Where the
    Laplacian's weight of the centre is then positive or small,
    $-w_{ii} < 0.2 \sum_{j \ne i} |w_{ij}|$ (with RBF-FD only where it is positive), or its
    conditions cannot be met, larger neighbourhoods are tried, by a tenth to 3.4 times, of which
    k points that are spread evenly over them are taken; then smaller ones, which see less of a
    fold. The first that serves is taken; if none does, that with
    the most dominant centre, on a border the usual one: a one-sided Laplacian has no dominant
    centre, however large. Such points are what gives collocation matrices eigenvalues with
    positive real part (`experiments`, stability study).

    Args:
        cloud: n points in d dimensions with unit normals; concrete.
        method: how the weights will be computed.
        bound: True for points that need no stencil, `(n,)`, as a boundary condition gives their
            values (`Closure.bound`); their rows are switched off and never adapted.
        throw: passed on to `find_neighbors`.

    Returns:
        Neighbour lists with k slots; shorter rows are padded. Where no size serves a point
        inside the surface, a warning says how many and names the worst.

    Raises:
        TypeError: no cloud or method, a `bound` that is no mask.
        ValueError: as `find_neighbors`.

    Example:
        >>> js.choose_neighbors(js.sphere(500), method=js.GFDM(degree=2)).k
        36
    """
    instance(cloud, PointCloud, "cloud")
    instance(method, AbstractMethod, "method")
    if bound is None:
        needed = np.ones(cloud.n, bool)
    else:
        needed = ~np.asarray(checked_mask(bound, cloud.n, "bound"))
    neighbors = weighed_neighbors(cloud, method, throw, needed)[0]

    def held(lists: Neighbors) -> Neighbors:
        mask = np.asarray(lists.mask) & needed[:, None]
        return Neighbors(lists.indices, on_device(mask), lists.radius)

    return changed(neighbors, held)


def choose_fewer_neighbors(cloud: PointCloud, method: AbstractMethod) -> Neighbors:
    """As `choose_neighbors`, but also fewer than usual on borders if their centre then dominates.

    For surfaces at rest; the Laplacian there is more accurate and has fewer negative weights.
    """
    return weighed_neighbors(cloud, method, fewest=0)[0]


def build(cloud, neighbors, method, target, throw) -> Stencil:
    """The operator of a target, with neighbours chosen if there are none."""
    return build_all(cloud, neighbors, method, target, throw)[0]


def build_all(cloud, neighbors, method, target, throw, weights=None) -> list[Stencil]:
    """As `build`; of a `Joint` each of its operators. What `stencil_weights` gives may be known."""
    instance(cloud, PointCloud, "cloud")
    instance(method, AbstractMethod, "method", "GFDM(degree=4) or DCPSE(order=2), say")
    if neighbors is not None:
        neighbors = switched_on(cloud, checked_lists(neighbors))
    else:
        neighbors, laplacian = weighed_neighbors(cloud, method, throw)
        if isinstance(target, Laplacian) and is_concrete(cloud):
            weights = laplacian
    _check_sizes(cloud, neighbors, method, target, throw)
    if weights is None:
        weights = stencil_weights(cloud, neighbors, method, target)
    stencils = _stencils(cloud, neighbors, *weights)
    if throw and is_concrete(stencils[0].weights):
        _check(stencils[0], neighbors, method, target, cloud.dim)
    return stencils


def checked_lists(neighbors) -> Neighbors:
    """Refuse what are no lists, as a method that is not given by name."""
    named = isinstance(neighbors, AbstractMethod)
    hint = "a method is given by name, method=..." if named else "see find_neighbors"
    return instance(neighbors, Neighbors, "neighbors", hint)


def _stencils(cloud, neighbors, values, diagnostics) -> list[Stencil]:
    border = cloud.boundary
    if border is not None and cloud.active is not None:
        border = border & cloud.active
    known = (diagnostics, border, cloud.active)
    # Lists that are known stay known in compiled code: transposes can gather there.
    with at_once() if is_concrete(neighbors.indices) else nullcontext():
        slots = _slots_first(neighbors.indices)
    values = values if isinstance(values, tuple) else (values,)
    return [unchecked(Stencil, slots, part, part.shape[1:-1], (), *known) for part in values]


def build_with(cloud, neighbors, method, target, find: Callable) -> tuple[list[Stencil], Any]:
    """As `build_all`, and what is found of each neighbourhood with it, in blocks; traced clouds.

    In one program, where the compiler finds that both need the same moments, and sums them once;
    and nothing that both see of a neighbourhood is stored.
    """
    neighbors = switched_on(cloud, neighbors)
    _check_sizes(cloud, neighbors, method, target, True)
    rows = np.arange(cloud.n, dtype=np.int32)
    size = block(method.batch_size)
    weights, found = of_each(_weights_and_more, cloud, neighbors, rows, size, method, target, find)
    return _stencils(cloud, neighbors, *rows_of(*weights, cloud.n)), found


def _weights_and_more(around: Neighborhood, method, target, find):
    return weights_by(method, around, target), find(around)


def _weights(around: Neighborhood, method, target):
    return weights_by(method, around, target)


def stencil_weights(
    cloud, neighbors, method, target, rows=None
) -> tuple[Float[Array, "k *c r"] | tuple[Float[Array, "k *_ r"], ...], Diagnostics]:
    """Weights `(k, *components, r)` and diagnostics of all stencils, or of those of some rows.

    Of a `Joint` the weights of each of its operators.

    Three programs. The one in the middle takes long to compile and knows nothing of the number of
    points but a rounded number of blocks, so that clouds of other sizes share it.
    """
    rows = np.arange(cloud.n, dtype=np.int32) if rows is None else rows
    size = block(whole(method.batch_size, f"batch_size of {method}", least=1))

    def found(neighbors, rows):
        blocks = blocks_of(cloud, neighbors, rows, size)
        return rows_of(*_weights_of_blocks(blocks, method, target), len(rows))

    if not is_concrete(cloud, neighbors, rows):
        each = of_each(_weights, cloud, neighbors, rows, size, method, target)
        return rows_of(*each, len(rows))
    places = divided(len(rows), size, neighbors.mask.shape[1] * (2 * cloud.dim + 1))
    if len(places) == 1:
        return found(neighbors, rows)
    lists = np.asarray(neighbors.indices), np.asarray(neighbors.mask)
    rows = np.asarray(rows)
    parts = [(Rows(lists[0][at], lists[1][at], neighbors.radius), rows[at]) for at in places]
    kind = cloud.dim, lists[1].shape[1], cloud.points.dtype, is_quick()
    if _runs_alone(method, target, kind, lambda: blocks_of(cloud, *parts[0], size)):
        return found(neighbors, rows)
    return _joined(side_by_side(lambda part: found(*part), parts), len(rows))


# What was looked at by `_runs_alone`.
_KINDS: dict[tuple, bool] = {}


def _runs_alone(method, target, kind: tuple, make_blocks) -> bool:
    """Whether weights come from a program that calls a library; methods without a hash may.

    Args:
        kind: all else that this may hang on.
    """
    kind = method, target, *kind
    try:
        known = kind in _KINDS
    except TypeError:
        return True
    if not known:
        _KINDS[kind] = calls_library(_weights_of_blocks.jaxpr(make_blocks(), method, target))
    return _KINDS[kind]


@host_jit
def _joined(parts, count: int):
    """Parts side by side."""
    xp = namespace(parts[0][0])
    return jax.tree.map(lambda *a: xp.concatenate(a, axis=-1)[..., :count], *parts)


@host_jit
def _slots_first(indices):
    return indices.T


@Pieces
def _weights_of_blocks(blocks, count, method, target):
    weights = lambda block: weights_by(method, Neighborhood.of(*block), target)
    return blockwise(weights, blocks, count)


# --- neighbourhoods ------------------------------------------------------------------------


def weighed_neighbors(cloud, method, throw=True, needed=True, fewest=None, target=_LAPLACIAN):
    """Neighbours that suit the method, and weights and diagnostics with them.

    Args:
        needed, fewest: rows that may be adapted, and see `resized`.
        target: of the weights: the Laplacian, or a `Joint` with it in front.
    """
    cloud = without_derivatives(cloud)
    needs_values("cloud", cloud, instead="under jit and vmap pass the neighbours")
    with at_once():  # also within something that is traced
        return _chosen(cloud, method, throw, needed, fewest, target)


def _chosen(cloud, method, throw, needed, fewest, target):
    on = cloud.host_active
    available = int(on.sum())
    count = whole(method.neighbor_count(cloud.dim), f"neighbor_count of {method}", least=1)
    k = min(count, available)
    neighbors = find_neighbors(cloud, k, throw=throw)
    _check_sizes(cloud, neighbors, method, target, throw)
    found = stencil_weights(cloud, neighbors, method, target)
    share, poor = poorly_served(cloud, found[1], method, needed)
    sizes = sizes_to_try(method, cloud.dim, k, available)
    new, chosen, best = resized(cloud, neighbors, found, method, share, poor, sizes, fewest, target)
    report(cloud, neighbors, poor, best, chosen, method)
    return new


def poorly_served(cloud, diagnostics, method, needed=True):
    """Shares of the centres, see `dominance`, and the rows where a method asks for more."""
    share = np.asarray(dominance(jax.tree.map(np.asarray, diagnostics)))
    return share, np.flatnonzero(cloud.host_active & needed & (share < method.least_dominance))


def resized(
    cloud: PointCloud,
    neighbors: Neighbors,
    found: tuple[Any, Diagnostics] | None,
    method: AbstractMethod,
    share: Float[np.ndarray, " n"],
    poor: Int[np.ndarray, " r"],
    sizes: Sequence[int],
    fewest: int | None = None,
    target: Any = _LAPLACIAN,
) -> tuple[tuple[Neighbors, Any], Int[np.ndarray, " r"], Float[np.ndarray, " r"]]:
    """Lists of which some rows are of other sizes, as far as these serve better; on the host.

    Args:
        found: what `stencil_weights` gives of the target; None if nobody asks for it.
        share: see `dominance`.
        poor: the rows.
        sizes: to try in turn, see `sizes_to_try`.
        fewest: points on a border; as many as there are if None.
        target: the Laplacian, or a `Joint` with it in front.

    Returns:
        The lists, and what was found, with what was found of those rows; sizes and shares of them.
    """
    k, best, chosen = neighbors.k, share[poor], np.full(poor.size, neighbors.k)
    if not poor.size or not sizes:
        return (neighbors, found), chosen, best
    fewest = k if fewest is None else fewest
    border = np.zeros(cloud.n, bool) if cloud.boundary is None else np.asarray(cloud.boundary)
    points, (near, good) = np.asarray(cloud.points), nearest_of(cloud, poor, max(sizes))
    # Rows last, as weights and diagnostics have them.
    olds = np.asarray(neighbors.indices).T, np.asarray(neighbors.mask).T, *jax.tree.leaves(found)
    kept = [np.array(a)[..., poor] for a in olds]
    for size in sizes:
        left = np.flatnonzero(best < method.least_dominance)
        if not left.size:
            break
        rows = poor[left]
        some = represented(points, near[left], good[left], size, k)
        trial = _in_chunks(cloud, *some, method, target, rows)
        now = np.asarray(dominance(trial[1]))
        wanted = share_wanted(border[rows], share[rows], size, fewest, method)
        better = is_better(now, best[left], wanted, method)
        taken = left[better]
        best[taken], chosen[taken] = now[better], size
        for old, new in zip(kept, (some[0].T, some[1].T, *jax.tree.leaves(trial))):
            old[..., taken] = new[..., better]

    def put(old, new):
        full = np.array(old)
        full[..., poor] = new
        return full

    indices, mask, *leaves = map(put, olds, kept)
    spread = neighbors if (chosen > k).any() else None
    new = Neighbors(on_device(indices.T), on_device(mask.T), near=spread)
    known = jax.tree.unflatten(jax.tree.structure(found), map(on_device, leaves))
    return (new, known), chosen, best


def _in_chunks(cloud, indices, mask, method, target, rows):
    """Weights and diagnostics of some rows, on the host."""
    parts = []
    # Filled up with copies, so that few shapes are ever compiled.
    for part in np.resize(np.arange(len(rows)), (-(-len(rows) // TRIED), TRIED)):
        some = Rows(indices[part], mask[part])
        parts.append(stencil_weights(cloud, some, method, target, rows[part]))
    joined = lambda *a: np.concatenate([np.asarray(b) for b in a], axis=-1)[..., : len(rows)]
    return jax.tree.map(joined, *parts)


# --- checks --------------------------------------------------------------------------------


def _check_sizes(cloud, neighbors, method, target, throw) -> None:
    as_many("neighbours", neighbors.n, "the cloud", cloud.n)
    need = whole(method.basis_size(cloud.dim, target), f"basis_size of {method}", least=1)
    if throw and neighbors.k < need:
        raise ValueError(f"k = {neighbors.k} neighbours, {method} needs at least {need}")


def _check(stencil: Stencil, neighbors, method, target, dim) -> None:
    diagnostics = stencil.diagnostics
    assert diagnostics is not None
    on = np.asarray(neighbors.mask)[:, 0]
    residual = np.asarray(diagnostics.residual)
    most, need = residual_tolerance(residual.dtype), method.basis_size(dim, target)
    raise_at(
        on & ~(residual < most),
        f"degenerate stencil at point {{i}}: relative moment residual {{v:.1e}}, above {most:.0e}, "
        f"with {{count}} points within the support {{support:.3g}}; {method} needs at least {need} "
        "in general position: more of them, or a lower degree or order",
        residual,
        count=diagnostics.count,
        support=diagnostics.support,
    )
    tube = np.where(on, np.asarray(diagnostics.tube), 0)
    if tube.max(initial=0) > 1:
        i = int(tube.argmax())
        warn(
            f"the surface bends within one stencil: support x curvature = {tube[i]:.2f} at point "
            f"{i} ({int(np.sum(tube > 1))} points above 1). Use more points there or a smaller "
            "support; js.discretize(cloud, method=...).expected_error tells what it makes of the "
            "Laplacian"
        )


def determined(weights, residual, degree: int):
    """The weights of local polynomials, refused where the neighbours do not determine these."""
    text = (
        f"the neighbours of point {{i}} do not determine a polynomial of degree {degree}: relative "
        f"moment residual {{v:.1e}}, above {residual_tolerance(residual.dtype):.0e}; more of them "
        "may, or a lower degree"
    )
    return refuse(weights, _undetermined(residual), text, residual)


@host_jit
def _undetermined(residual):
    return ~(residual < residual_tolerance(residual.dtype))
