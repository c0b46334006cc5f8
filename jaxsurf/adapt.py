"""Which size of neighbourhood serves a point: one decision, on the host and in compiled code."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from .compiling import namespace
from .stencils.method import AbstractMethod
from .stencils.targets import Laplacian

# Sizes of the neighbourhoods of such points, in units of the usual one: tried in turn.
_SIZES = (1.5, 2.25, 3.4, 0.67, 0.45)

# Of NumPy or of JAX.
_Numbers = Float[Array, " r"] | Float[np.ndarray, " r"]


def sizes_to_try(method: AbstractMethod, dim: int, k: int, available: int) -> list[int]:
    """Numbers of neighbours beside the usual k; none where no larger ones can be had."""
    need = method.basis_size(dim, Laplacian())
    sizes = [min(int(k * size), available) for size in _SIZES if k * size > 1.5 * need]
    return sizes if max(sizes, default=0) > k else []


def dominance(weights, residual) -> _Numbers:
    """Share of the centre among the absolute weights of the others; of no use where -inf.

    Args:
        weights: of the Laplacian, `(k, r)`, that of the centre first.
        residual: of the moments of each stencil.
    """
    xp = namespace(weights)
    others = xp.sum(xp.abs(weights[1:]), axis=0)
    share = xp.where(others > 0, -weights[0] / xp.where(others > 0, others, 1), -np.inf)
    return xp.where(residual < residual_tolerance(weights.dtype), share, -np.inf)


def share_wanted(border, share, method: AbstractMethod) -> _Numbers:
    """What another size must reach at each point, if it is to be better at all.

    On a border the usual size stays unless another serves: a one-sided Laplacian has no dominant
    centre, however large.
    """
    return namespace(share).where(border & (share > -np.inf), method.least_dominance, -np.inf)


def is_better(
    share, best, wanted, method: AbstractMethod
) -> Bool[Array, " r"] | Bool[np.ndarray, " r"]:
    """Whether a size with this share is taken in place of the best one so far.

    The first size that serves is taken; if none does, that with the largest share.
    """
    return (best < method.least_dominance) & (share > best) & (share >= wanted)


def first_slots(count: Any, mask) -> Bool[Array, "*r k"] | Bool[np.ndarray, "*r k"]:
    """The first slots of lists, as many as are counted for each row or for all."""
    return namespace(mask).arange(mask.shape[1]) < count


def residual_tolerance(dtype) -> float:
    """Largest relative moment residual of a stencil that counts as determined."""
    return float(jnp.finfo(dtype).eps) ** 0.5
