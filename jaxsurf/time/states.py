"""States in time as vectors: sums, norms, types."""

from __future__ import annotations

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PyTree

from ..arguments import count_on, switched_off
from ..compiling import AnyArray, host_jit, namespace
from ..failures import is_concrete, warn


@host_jit
def length(y: PyTree[AnyArray]) -> Float[AnyArray, ""]:
    """Euclidean norm of all entries."""
    leaves = jax.tree.leaves(y) or [np.zeros(0)]
    return namespace(leaves[0]).sqrt(sum((leaf * leaf).sum() for leaf in leaves))


@host_jit
def root_mean_square(y: PyTree[AnyArray]) -> Float[AnyArray, ""]:
    """Of all entries."""
    return length(y) / max(sum(leaf.size for leaf in jax.tree.leaves(y)), 1) ** 0.5


def added(*trees: PyTree[Array]) -> PyTree[Array]:
    """The sum of states, or of rates."""
    return jax.tree.map(lambda first, *others: sum(others, first), *trees)


def zeros_like_result(f: Callable, *args) -> PyTree[Array]:
    """In place of what a function returns, such as a rate that is still to be found."""
    return jax.tree.map(lambda k: jnp.zeros(k.shape, k.dtype), jax.eval_shape(f, *args))


def only_on(active: Bool[Array | np.ndarray, " n"] | None, tree: PyTree) -> PyTree:
    """A state or a rate with zeros in the rows of points that are switched off."""
    if active is None:
        return tree
    fields = lambda x: jnp.ndim(x) > 0 and jnp.shape(x)[0] == len(active)
    return jax.tree.map(lambda x: switched_off(active, x) if fields(x) else x, tree)


def tell_small(u0, atol, name: str) -> None:
    """Warn of a state that is smaller than the errors that are allowed."""
    if not is_concrete(u0, atol):
        return
    sizes = (float(np.max(np.abs(x), initial=0)) for x in map(np.asarray, jax.tree.leaves(u0)))
    most = max(sizes, default=0.0)
    if 0 < most <= atol:
        warn(
            f"{name} is at most {most:.2g} in size and errors of atol = {float(atol):.2g} are "
            "allowed: the solution may be lost in them; pass a smaller atol"
        )


class Norm(eqx.Module):
    """Root mean square over the points that are on."""

    active: Bool[Array, " n"]

    def __call__(self, y: PyTree[Array]) -> Float[Array, ""]:
        share = count_on(self.active, 0) / len(self.active)
        return root_mean_square(only_on(self.active, y)) / jnp.sqrt(share).astype(dtype_of(y))


def small(y: PyTree[Array]) -> Float[Array, ""]:
    """The length of a step for differences at a state, in the scale of the state."""
    size = length(y)
    return jnp.sqrt(jnp.finfo(dtype_of(y)).eps) * jnp.where(size > 0, size, 1)


def dtype_of(y: PyTree[Array]):
    """The common type of all entries."""
    return jnp.result_type(*jax.tree.leaves(y))
