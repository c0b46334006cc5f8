r"""Which neighbourhood serves a point: one decision, on the host and in compiled code.

Lists keep the usual number of neighbours: a larger neighbourhood is represented by points that are
spread evenly over it. So no row is wider than others.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from .compiling import namespace
from .failures import warn
from .stencils.method import AbstractMethod, Diagnostics
from .stencils.targets import Laplacian

# How many of the nearest points make up the neighbourhoods of such points, in units of the usual
# number: tried in turn. Small steps, since farther points than needed cost accuracy.
_SIZES = (1.1, 1.2, 1.35, 1.5, 1.85, 2.25, 2.8, 3.4, 0.67, 0.45)
# Where a method asks for the sign of the centre's weight only, small steps would just reach it.
_SIZES_BY_SIGN = (1.5, 2.25, 3.4, 0.67, 0.45)
# A direction along which no regular arrangement of points is symmetric.
_OBLIQUE = (0.6180, 0.3247, 0.7549)

# Of NumPy or of JAX.
_Numbers = Float[Array, " r"] | Float[np.ndarray, " r"]


def sizes_to_try(method: AbstractMethod, dim: int, k: int, available: int) -> list[int]:
    """Of how many of the nearest, beside the usual k; none where no larger ones can be had."""
    need = method.basis_size(dim, Laplacian())
    steps = _SIZES if method.least_dominance > 0 else _SIZES_BY_SIGN
    sizes = [min(int(k * size), available) for size in steps if k * size > 1.5 * need]
    return sizes if max(sizes, default=0) > k else []


def dominance(diagnostics: Diagnostics) -> _Numbers:
    """Share of the centre in the Laplacian's weights; -inf where they are of no use."""
    share, residual = diagnostics.dominance, diagnostics.residual
    assert share is not None  # of a Laplacian
    return namespace(share).where(residual < residual_tolerance(residual.dtype), share, -np.inf)


def share_wanted(border, share, size, fewest: int, method: AbstractMethod) -> _Numbers:
    """What a neighbourhood of this size must reach at each point, if it is to be better at all.

    On a border the usual size stays unless another serves, of the fewest points that are allowed
    there or more: a one-sided Laplacian has no dominant centre, however large. Fewer than usual may
    only just determine a polynomial, and no longer do so when they have moved.
    """
    xp = namespace(share)
    least = xp.where(xp.asarray(size < fewest), np.inf, method.least_dominance)
    return xp.where(border & (share > -np.inf), least, -np.inf)


def is_better(
    share, best, wanted, method: AbstractMethod
) -> Bool[Array, " r"] | Bool[np.ndarray, " r"]:
    """Whether a size with this share is taken in place of the best one so far.

    The first size that serves is taken; if none does, that with the largest share.
    """
    return (best < method.least_dominance) & (share > best) & (share >= wanted)


def represented(points, indices, mask, size, k: int) -> tuple[Any, Any]:
    """Lists of k slots for the nearest `size` points: all of these, or k spread evenly over them.

    Args:
        points: `(n, d)`, of NumPy or of JAX as the lists are.
        indices, mask: lists of many points, `(r, K)`, nearest first.
        size: how many of them count, one number or `(r, 1)`; may be traced.

    Returns:
        Indices and mask `(r, k)`, nearest first.
    """
    xp = namespace(mask)
    mask = mask & (xp.arange(mask.shape[1]) < size)
    chosen, wide = mask, xp.asarray(size) > k
    if xp is jnp or wide.any():
        offsets = points[indices] - points[indices[:, :1]]
        chosen = xp.where(wide, _spread(xp, offsets, mask, k), mask)
    slots = xp.argsort(~chosen, axis=1, stable=True)[:, :k]
    held = xp.take_along_axis(chosen, slots, axis=1)
    found = xp.take_along_axis(indices, slots, axis=1)
    return xp.where(held, found, indices[:, :1]), held


def _spread(xp, offsets, mask, k: int):
    """True for k of the points, each in turn the one farthest from those before; the first first.

    Of points as far as each other, to round-off, that farther along some direction.
    """
    size = xp.max(xp.where(mask[..., None], xp.abs(offsets), 0), axis=(1, 2), keepdims=True)
    x = offsets / xp.where(size > 0, size, 1)
    along = x @ xp.asarray(_OBLIQUE[: x.shape[-1]], x.dtype)
    favour = 1 + float(jnp.finfo(x.dtype).eps) ** 0.5 * along

    def farther(_, state):
        chosen, gap = state
        far = xp.argmax(xp.where(mask, gap * favour, -1), axis=1)[:, None]
        to = x - xp.take_along_axis(x, far[..., None], axis=1)
        gap = xp.minimum(gap, xp.sum(to * to, axis=-1))
        return chosen | ((xp.arange(mask.shape[1]) == far) & mask), gap

    first = mask & (xp.arange(mask.shape[1]) == 0)
    state = first, xp.sum(x * x, axis=-1)
    if xp is jnp:
        return jax.lax.fori_loop(1, k, farther, state)[0]
    for i in range(1, k):
        state = farther(i, state)
    return state[0]


def residual_tolerance(dtype) -> float:
    """Largest relative moment residual of a stencil that counts as determined."""
    return float(jnp.finfo(dtype).eps) ** 0.5


def report(cloud, neighbors, poor, best, chosen, method) -> None:
    """Warn of points inside the surface where no size serves."""
    failed = best < method.least_dominance
    if cloud.boundary is not None:
        failed &= ~np.asarray(cloud.boundary)[poor]
    if failed.any():
        worst = np.flatnonzero(failed)[np.argmin(best[failed])]
        bare = _on_one_side(cloud, neighbors, poor[failed]) if cloud.boundary is None else 0
        bare = bare if bare > _RIM * cloud.n ** (1 - 1 / (cloud.dim - 1)) else 0
        advice = "; if the surface has a border, mark it (boundary=js.detect_boundary(cloud))"
        aside = f". {bare} of them have neighbours on one side only{advice}" if bare else ""
        warn(
            f"for {failed.sum()} points no size of neighbourhood serves {method}: the worst is "
            f"point {poor[worst]}, where the centre has a share of {best[worst]:.2g} of the "
            f"weights among the {chosen[worst]} nearest, {method.least_dominance} is needed; the "
            f"operator may have growing modes (js.spectral_estimate){aside}"
        )


# On half of a disk the mean of the points is 0.6 of their distances from its centre off it. Fewer
# such points than this, in units of those across a surface, are folds.
_ASIDE, _RIM = 0.45, 0.5


def _on_one_side(cloud, neighbors, rows) -> int:
    """How many of these points look as if they were on a border."""
    points, mask = np.asarray(cloud.points), np.asarray(neighbors.mask)[rows][:, :, None]
    offsets = mask * (points[np.asarray(neighbors.indices)[rows]] - points[rows][:, None])
    mean = np.linalg.norm(offsets.sum(axis=1), axis=1) / mask.sum(axis=(1, 2))
    squared = np.sum(offsets**2, axis=(1, 2)) / mask.sum(axis=(1, 2))
    return int(np.sum(mean > _ASIDE * np.sqrt(squared)))
