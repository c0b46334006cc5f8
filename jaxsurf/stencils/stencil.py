"""Stencils: sparse operators with the same number of neighbours at every point."""

from __future__ import annotations

import math
import os
import struct
import zipfile
import zlib
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse
from jaxtyping import Array, Bool, Float, Int

from ..arguments import instance, is_array, per_point, shaped, switched_off
from ..compiling import host_jit, namespace
from ..failures import check, is_concrete, unchecked
from ..indices import mask, point_indices
from .algebra import AbstractOperator, Transposed
from .gathers import product
from .masks import both, either
from .method import Diagnostics
from .padded import Incoming, Table, table_of


class Stencil(AbstractOperator):
    r"""A sparse operator with the same number k of neighbours at every point.

    $(L u)_i = \sum_{s} w_{si}\, u_{j(s, i)}$. The neighbour slots run along the first axis, so
    that one pass adds one slot for all points, reading contiguous columns.

    Args:
        indices: neighbour of point i in slot s, `(k, n)`.
        weights: `(k, *out_shape, *in_shape, n)`; zero in padded slots.
        out_shape: `()` for scalar results, `(d,)` for a gradient.
        in_shape: `()` for scalar fields, `(d,)` for a divergence.
        diagnostics: how well each stencil is determined; None if unknown.
        border: True at border points of the surface, `(n,)`; None if it has none.
        active: False at points that are switched off, `(n,)`: what fields have there is not looked
            at, results are zero; None if all are on.
        table: where the entries of the transpose stand, see `prepared`.

    A field of another precision than the weights is taken as JAX does: the result has the wider
    of both. Integers count as floating-point numbers; complex fields are refused, and are two real
    ones in a batch.

    Differentiable: forward and reverse, in the weights and in the field.
    Raises:
        TypeError: indices that are not integers, weights that are not real floating-point numbers.
        ValueError: shapes that do not fit; an index that is no point (in compiled code too, when it
            runs).

    Example:
        >>> laplacian = js.laplace_beltrami(js.sphere(300))
        >>> laplacian(jnp.ones((300, 2))).shape, laplacian.to_scipy().shape
        ((300, 2), (300, 300))
    """

    indices: Int[Array, "k n"]
    weights: Float[Array, "k *c n"]
    out_shape: tuple[int, ...] = eqx.field(static=True, default=())
    in_shape: tuple[int, ...] = eqx.field(static=True, default=())
    diagnostics: Diagnostics | None = None
    border: Bool[Array, " n"] | None = None
    active: Bool[Array, " n"] | None = None
    table: Table | None = None

    def __check_init__(self):
        if not is_array(self.indices):
            return  # a pytree of something else, as transformations make them
        indices = point_indices(self.indices, "indices", axes="(k, n)", n=-1)
        object.__setattr__(self, "indices", indices)  # with the errors of compiled code
        weights = self.weights
        if is_array(weights):
            if not jnp.issubdtype(weights.dtype, jnp.floating):
                raise TypeError(f"weights are {weights.dtype}, expected floating-point numbers")
            shaped(weights, "weights", (self.k, *self.out_shape, *self.in_shape, self.n))
            if self.diagnostics is None:
                # Those with diagnostics were looked at when they were built, or were not to be.
                bad = lambda w: ~np.isfinite(w).reshape(-1, self.n).all(axis=0)
                check(weights, bad, "weights of point {i} are not finite")
        for name in ("border", "active"):
            if is_array(getattr(self, name)):
                mask(getattr(self, name), self.n, name)

    def __repr__(self):
        filled = "" if self.diagnostics is None else f" ({_counts(self.diagnostics.count)} used)"
        dtype = getattr(self.weights, "dtype", type(self.weights).__name__)
        return f"Stencil({self._maps}, {self.k} slots{filled}, {dtype})"

    @property
    def n(self) -> int:
        return self.indices.shape[1]

    @property
    def k(self) -> int:
        """Number of slots, the centre included."""
        return self.indices.shape[0]

    def __call__(self, u):
        contracted = len(self.in_shape)
        return product(self.weights, self.indices, self.checked(u), contracted, None, self.active)

    def transpose(self) -> Transposed:
        """The transposed operator, which gathers too where the table of its entries is at hand.

        The table is made on the host, from concrete indices, once for all stencils on them; in
        compiled code to which indices are an argument pass an operator that is `prepared`.
        """
        table = table_of(self.indices) if is_concrete(self.indices) else self.table
        return Transposed(self, None if table is None else Incoming.of(self, table))

    @property
    def prepared(self) -> Stencil:
        """The operator with what transposes need of concrete indices."""
        if self.table is not None or not is_concrete(self.indices):
            return self
        table = table_of(self.indices)
        return eqx.tree_at(lambda s: s.table, self, table, is_leaf=lambda x: x is None)

    def to_scipy(self):
        p, q, n = math.prod(self.out_shape), math.prod(self.in_shape), self.n
        weights = np.asarray(self.weights)
        if self.active is not None:
            on = np.asarray(self.active)
            used = np.expand_dims(
                on & on[np.asarray(self.indices)], tuple(range(1, weights.ndim - 1))
            )
            weights = np.where(used, weights, 0)
        weights = weights.reshape(self.k, p, q, n).transpose(3, 1, 0, 2)
        columns = np.asarray(self.indices).T[:, None, :, None] * q + np.arange(q)
        columns = np.broadcast_to(columns, weights.shape)
        # Rows stay in the order of the slots: to sort them takes longer than all the rest.
        pointers = np.arange(n * p + 1) * (self.k * q)
        data = (weights.flatten(), columns.flatten(), pointers)  # copies, to be changed in place
        matrix = scipy.sparse.csr_matrix(data, shape=(n * p, n * q))
        matrix.eliminate_zeros()
        return matrix

    @property
    def diagonal(self) -> Float[Array, "*c n"]:
        return _diagonal(self.weights, self.indices)

    def __rmul__(self, factor) -> Stencil:
        return self._with(_scaled(self.weights, self._own(factor, "factor")))

    def __add__(self, other) -> AbstractOperator:
        # What the same slots can hold is one stencil again.
        if isinstance(other, Stencil) and self._has_slots_of(other):
            marks = either(self.border, other.border), both(self.active, other.active)
            weights, shapes = self.weights + other.weights, (self.out_shape, self.in_shape)
            fields = (self.indices, weights, *shapes, None, *marks, self.table)
            return unchecked(Stencil, *fields)
        if isinstance(other, AbstractOperator) or self.in_shape or not self._starts_with_centers:
            return super().__add__(other)
        return self._with(_raised(self.weights, self._own(other, "term")))

    def _own(self, value, name: str):
        """A number or one number per point, in the precision of the weights."""
        value = per_point(value, self.n, name).astype(self.weights.dtype)
        return switched_off(self.active, value) if value.ndim else value

    def of_weights(self, weights, out_shape=(), in_shape=()) -> Stencil:
        """Another operator on the same slots, whose weights were computed from these."""
        known = (self.diagnostics, self.border, self.active)
        return unchecked(Stencil, self.indices, weights, out_shape, in_shape, *known)

    def _with(self, weights) -> Stencil:
        return eqx.tree_at(lambda s: s.weights, self, weights)

    def _has_slots_of(self, other: Stencil) -> bool:
        if (self.in_shape, self.out_shape) != (other.in_shape, other.out_shape):
            return False
        one, two = self.indices, other.indices
        return one is two or (is_concrete(one, two) and np.array_equal(one, two))

    @property
    def _starts_with_centers(self) -> bool:
        """Whether the first slot of every row is that of its own point, as far as can be seen."""
        if self.out_shape or not is_concrete(self.indices):
            return False
        return np.array_equal(np.asarray(self.indices)[0], np.arange(self.n))

    def save(self, path: str | Path) -> None:
        """Write indices and weights to a NumPy archive (`.npz`, no pickle)."""
        instance(path, (str, os.PathLike), "path")
        data = {
            "indices": np.asarray(self.indices),
            "weights": np.asarray(self.weights),
            "out_shape": np.array(self.out_shape, int),
            "in_shape": np.array(self.in_shape, int),
        }
        if self.diagnostics is not None:
            known = vars(self.diagnostics).items()
            data |= {name: np.asarray(value) for name, value in known if value is not None}
        marks = {"border": self.border, "active": self.active}
        data |= {name: np.asarray(mark) for name, mark in marks.items() if mark is not None}
        with open(path, "wb") as file:
            np.savez(file, **data)  # type: ignore[arg-type]

    @classmethod
    def load(cls, path: str | Path) -> Stencil:
        """Read what `save` wrote.

        Raises:
            TypeError: a path that is none.
            ValueError: the file is not such an archive.
        """
        instance(path, (str, os.PathLike), "path")
        try:
            with np.load(path, allow_pickle=False) as archive:
                data = {name: archive[name] for name in archive.files}
            out_shape, in_shape = (
                tuple(data.pop(name).tolist()) for name in ("out_shape", "in_shape")
            )
            indices, weights = jnp.asarray(data.pop("indices")), jnp.asarray(data.pop("weights"))
            border, active = (
                jnp.asarray(data.pop(name)) if name in data else None
                for name in ("border", "active")
            )
            extra = {name: jnp.asarray(value) for name, value in data.items()}
            diagnostics = Diagnostics(**extra) if extra else None
            return cls(indices, weights, out_shape, in_shape, diagnostics, border, active)
        except FileNotFoundError:
            raise
        except _DAMAGE as error:
            raise ValueError(f"{path} does not hold a stencil: {error}") from error


# What reading a file that was cut off or changed can end in.
_DAMAGE = (
    OSError, EOFError, KeyError, IndexError, ValueError, TypeError, AttributeError, SyntaxError,
    OverflowError, MemoryError, NotImplementedError, RuntimeError, struct.error, zlib.error,
    zipfile.BadZipFile,
)  # fmt: skip


def _counts(count) -> str:
    """Least and largest of counts per point, in words."""
    if not is_concrete(count) or not np.size(count):
        return "some"
    count = np.asarray(count)
    low, high = count[count > 0].min(initial=count.max()), count.max()
    return f"{low}" if low == high else f"{low} to {high}"


@host_jit
def _scaled(weights, factor):
    return weights * factor


@host_jit
def _raised(weights, term):
    """With a term added to the slots of the centres."""
    return namespace(weights).concatenate([weights[:1] + term, weights[1:]])


@host_jit
def _diagonal(weights, indices):
    xp = namespace(weights)
    own = indices == xp.arange(indices.shape[1], dtype=indices.dtype)
    own = own.reshape(len(own), *[1] * (weights.ndim - 2), -1)
    return xp.sum(xp.where(own, weights, 0), axis=0)


def prepared(operator: AbstractOperator) -> AbstractOperator:
    """The operator, all its stencils with what transposes need of concrete indices."""
    is_stencil = lambda o: isinstance(o, Stencil)
    return jax.tree.map(lambda o: o.prepared if is_stencil(o) else o, operator, is_leaf=is_stencil)
