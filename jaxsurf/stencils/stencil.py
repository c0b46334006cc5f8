"""Linear operators on fields: stencils and their compositions."""

from __future__ import annotations

import abc
import functools
import math
import struct
import zipfile
import zlib
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import scipy.sparse
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array, Bool, Float, Int

from ..arguments import (
    as_float,
    instance,
    is_array,
    is_concrete,
    mask,
    point_indices,
    raise_at,
    switched_off,
)
from ..compiling import is_quick
from .method import Diagnostics


class AbstractOperator(eqx.Module):
    """A linear map from fields `(n, *batch, *in_shape)` to fields `(n, *batch, *out_shape)`.

    Example:
        >>> laplacian = js.laplace_beltrami(js.sphere(300))
        >>> twice = laplacian @ laplacian
        >>> [isinstance(operator, js.AbstractOperator) for operator in (laplacian, twice)]
        [True, True]
    """

    @property
    @abc.abstractmethod
    def n(self) -> int:
        """Number of points."""

    @property
    @abc.abstractmethod
    def in_shape(self) -> tuple[int, ...]:
        """Components per point that the operator takes: `()` for scalar fields."""

    @property
    @abc.abstractmethod
    def out_shape(self) -> tuple[int, ...]:
        """Components per point that the operator gives."""

    @abc.abstractmethod
    def __call__(self, u: Float[Array, "n *c"]) -> Float[Array, "n *c"]:
        """Apply to a field or to a batch of fields."""

    @abc.abstractmethod
    def transpose(self) -> AbstractOperator:
        """The transposed operator, with the components taken and given exchanged."""

    @property
    def border(self) -> Bool[Array, " n"] | None:
        """True at border points of the surface, which conditions should say something about.

        None on closed surfaces, and where it is not known.
        """
        return None

    @property
    def active(self) -> Bool[Array, " n"] | None:
        """False at points that are switched off, whose values are zero before and after.

        None if all are on.
        """
        return None

    @abc.abstractmethod
    def to_scipy(self) -> scipy.sparse.csr_matrix:
        """CSR matrix acting on flattened fields (the components of a point stand together)."""

    def __matmul__(self, other: AbstractOperator) -> Composition:
        return Composition(self, other)

    def checked(self, u: Float[Array, "n *c"]) -> Float[Array, "n *c"]:
        """A field that the operator takes, as an array; else an error."""
        u = as_float(u, "field")
        split = u.ndim - len(self.in_shape)
        if split < 1 or u.shape[0] != self.n or u.shape[split:] != self.in_shape:
            batch = "".join(f", {c}" for c in self.in_shape)
            raise ValueError(
                f"field has shape {u.shape}, expected ({self.n}{batch or ','}) or a batch "
                f"({self.n}, c{batch})"
            )
        return u

    @property
    def _maps(self) -> str:
        """What goes in and comes out, for `repr`."""
        kinds = [
            {0: "scalar", 1: "vector"}.get(len(s), "tensor")
            for s in (self.in_shape, self.out_shape)
        ]
        return f"{self.n:,} points, {kinds[0]} to {kinds[1]} fields"

    def to_lineax(self, dtype=None) -> lx.FunctionLinearOperator:
        """The operator on one field, for the linear solvers of lineax."""
        dtype = jnp.result_type(float) if dtype is None else dtype
        field = jax.ShapeDtypeStruct((self.n, *self.in_shape), dtype)
        return lx.FunctionLinearOperator(self, field)


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

    A field of another precision than the weights is taken as JAX does: the result has the wider
    of both. Integers count as floating-point numbers; complex fields are refused, and are two real
    ones in a batch.

    Differentiable: forward and reverse, in the weights and in the field.
    Raises:
        TypeError: indices that are not integers, weights that are not real floating-point numbers.
        ValueError: shapes that do not fit; on concrete arrays an index that is no point.

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

    def __check_init__(self):
        if not is_array(self.indices):
            return  # a pytree of something else, as transformations make them
        point_indices(self.indices, "indices", axes="(k, n)", n=-1)
        weights = self.weights
        if is_array(weights):
            if not jnp.issubdtype(weights.dtype, jnp.floating):
                raise TypeError(f"weights are {weights.dtype}, expected floating-point numbers")
            shape = (self.k, *self.out_shape, *self.in_shape, self.n)
            if weights.shape != shape:
                raise ValueError(f"weights have shape {weights.shape}, expected {shape}")
            if self.diagnostics is None and is_concrete(weights):
                # Those with diagnostics were looked at when they were built, or were not to be.
                bad = ~np.isfinite(np.asarray(weights)).reshape(-1, self.n).all(axis=0)
                raise_at(bad, "weights of point {i} are not finite", np.asarray(bad))
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
        args = (self.weights, self.indices, self.checked(u), self.active)
        return _apply(*args, len(self.in_shape))

    def transpose(self) -> Stencil:
        """The transposed stencil, again with one gather per slot.

        The indices must be concrete (they decide the number of slots, the largest number of
        stencils that any point is part of); the weights may be traced.
        """
        if not is_concrete(self.indices):
            raise ValueError("transpose needs concrete indices: they decide the number of slots")
        slots, order = _incoming(np.asarray(self.indices))
        source = np.broadcast_to(np.arange(self.n), self.indices.shape).ravel()[order]
        place, row = slots
        # Rounded up, so that operators of one size on one geometry and another share programs.
        k = -(-(int(place.max()) + 1) // 8) * 8
        indices = np.broadcast_to(np.arange(self.n, dtype=np.int32), (k, self.n)).copy()
        indices[place, row] = source
        moved = _moved(self.weights, order, place, row, k, len(self.in_shape))
        shapes = (self.in_shape, self.out_shape)
        return Stencil(jnp.asarray(indices), moved, *shapes, None, self.border, self.active)

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
        """The weight of every point in its own row, `(*out_shape, *in_shape, n)`."""
        return _diagonal(self.weights, self.indices)

    def scaled(self, factor: Float[Array, " n"] | float) -> Stencil:
        """The operator with row i multiplied by `factor[i]`."""
        factor = _per_point(factor, self, "factor")
        return eqx.tree_at(lambda s: s.weights, self, self.weights * factor)

    def shifted(self, term: Float[Array, " n"] | float) -> Stencil:
        """The operator plus `term[i]` times the value at point i: the identity times a number.

        The term goes to the first slot that holds the point itself. If a row has none, as rows of
        a transpose may, one more slot is added; which needs concrete indices.
        """
        check_scalar(self)
        term = _per_point(term, self, "term")
        indices, weights = self.indices, self.weights
        if is_concrete(indices):
            own = np.asarray(indices) == np.arange(self.n)
            slot = own.argmax(axis=0)
            lacking = ~own.any(axis=0)
            if lacking.any():
                centre = np.arange(self.n, dtype=indices.dtype)
                indices = jnp.concatenate([indices, centre[None]])
                weights = jnp.pad(weights, ((0, 1), (0, 0)))
                slot = np.where(lacking, self.k, slot)
        else:
            own = indices == jnp.arange(self.n, dtype=indices.dtype)
            slot = jnp.argmax(own, axis=0)
            weights = eqx.error_if(
                weights,
                ~own.any(),
                "a row has no slot for its own point: make the shifted operator outside jit",
            )
        weights = weights.at[slot, np.arange(self.n)].add(term)
        return eqx.tree_at(lambda s: (s.indices, s.weights), self, (indices, weights))

    def save(self, path: str | Path) -> None:
        """Write indices and weights to a NumPy archive (`.npz`, no pickle)."""
        data = {
            "indices": np.asarray(self.indices),
            "weights": np.asarray(self.weights),
            "out_shape": np.array(self.out_shape, int),
            "in_shape": np.array(self.in_shape, int),
        }
        if self.diagnostics is not None:
            data |= {name: np.asarray(value) for name, value in vars(self.diagnostics).items()}
        if self.border is not None:
            data["border"] = np.asarray(self.border)
        if self.active is not None:
            data["active"] = np.asarray(self.active)
        with open(path, "wb") as file:
            np.savez(file, **data)  # type: ignore[arg-type]

    @classmethod
    def load(cls, path: str | Path) -> Stencil:
        """Read what `save` wrote.

        Raises:
            ValueError: the file is not such an archive.
        """
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


class Composition(AbstractOperator):
    """One operator after another: `(outer @ inner)(u) = outer(inner(u))`.

    Example:
        >>> cloud = js.sphere(300)
        >>> laplacian = js.laplace_beltrami(cloud)
        >>> z = cloud.points[:, 2]
        >>> bool(jnp.all((laplacian @ laplacian)(z) == laplacian(laplacian(z))))
        True
    """

    outer: AbstractOperator
    inner: AbstractOperator

    def __check_init__(self):
        for name in ("outer", "inner"):
            instance(getattr(self, name), AbstractOperator, name)
        have = (self.inner.n, self.inner.out_shape)
        want = (self.outer.n, self.outer.in_shape)
        if have != want:
            raise ValueError(f"inner operator gives (n, components) {have}, outer takes {want}")

    @property
    def n(self):
        return self.inner.n

    @property
    def in_shape(self):
        return self.inner.in_shape

    @property
    def out_shape(self):
        return self.outer.out_shape

    @property
    def border(self):
        marked = [b for b in (self.inner.border, self.outer.border) if b is not None]
        either = (np if is_concrete(*marked) else jnp).logical_or
        return functools.reduce(either, marked) if marked else None

    @property
    def active(self):
        if self.inner.active is self.outer.active:
            return self.inner.active
        known = [a for a in (self.inner.active, self.outer.active) if a is not None]
        both = (np if is_concrete(*known) else jnp).logical_and
        return functools.reduce(both, known) if known else None

    def __repr__(self):
        return f"Composition({self._maps}, of {self.outer!r} after {self.inner!r})"

    def __call__(self, u):
        return self.outer(self.inner(u))

    def transpose(self):
        return Composition(self.inner.transpose(), self.outer.transpose())

    def to_scipy(self):
        return self.outer.to_scipy() @ self.inner.to_scipy()


def check_scalar(operator: AbstractOperator) -> None:
    """Refuse operators with components."""
    if operator.in_shape or operator.out_shape:
        shapes = f"{operator.in_shape} to {operator.out_shape}"
        raise ValueError(f"an operator on scalar fields is needed, not from {shapes} components")


def _per_point(value, operator: Stencil, name: str):
    """A number or one number per point, in the precision of the operator."""
    n, dtype = operator.n, operator.weights.dtype
    value = as_float(value, name)
    if value.shape not in ((), (n,)):
        raise ValueError(f"{name} has shape {value.shape}, expected () or ({n},)")
    value = value.astype(dtype)
    return switched_off(operator.active, value) if value.ndim else value


def _counts(count) -> str:
    """Least and largest of counts per point, in words."""
    if not is_concrete(count) or not np.size(count):
        return "some"
    count = np.asarray(count)
    low, high = count[count > 0].min(initial=count.max()), count.max()
    return f"{low}" if low == high else f"{low} to {high}"


# Slots added up in one pass over the memory of the result.
_GROUP = 10


# Compiled once for each shape, not at every call outside jit.
@functools.partial(jax.jit, static_argnums=4)
def _apply(weights, indices, u, active, contracted: int):
    u = switched_off(active, u)
    n, components = len(u), u.shape[u.ndim - contracted :]
    batch = u.shape[1 : u.ndim - contracted]
    # A single column is gathered alone; of several, whole rows.
    values = u if u.ndim == 1 else u.reshape(n, -1, *components)
    total = _sum_slots(weights, indices, values, contracted)
    out_shape = weights.shape[1 : weights.ndim - 1 - contracted]
    total = jnp.moveaxis(total.reshape(*out_shape, n, -1), -2, 0)
    return switched_off(active, jnp.moveaxis(total, -1, 1).reshape(n, *batch, *out_shape))


@jax.jit
def _diagonal(weights, indices):
    own = indices == jnp.arange(indices.shape[1], dtype=indices.dtype)
    own = own.reshape(len(own), *[1] * (weights.ndim - 2), -1)
    return jnp.sum(jnp.where(own, weights, 0), axis=0)


@functools.partial(jax.jit, static_argnums=(4, 5))
def _moved(weights, order, place, row, k: int, contracted: int):
    """The weights in the order of the transpose, with the components taken and given exchanged."""
    components, n = weights.shape[1:-1], weights.shape[-1]
    flat = jnp.moveaxis(weights, -1, 1).reshape(len(weights) * n, *components)
    moved = jnp.zeros((k, n, *components), weights.dtype).at[place, row].set(flat[order])
    moved = jnp.moveaxis(moved, 1, -1)
    return jnp.swapaxes(moved, 1, 2) if 0 < contracted < len(components) else moved


@functools.partial(jax.custom_jvp, nondiff_argnums=(3,))
def _sum_slots(weights, indices, values, contracted: int):
    """All slots' terms, `(*out_shape, n, *batch)`; the last `contracted` axes are summed over."""

    def add(slot, total):
        w, j = (jax.lax.dynamic_index_in_dim(a, slot, keepdims=False) for a in (weights, indices))
        return total + _term(w, j, values, contracted)

    def add_group(i, total):
        for q in range(_GROUP):
            total = add(i * _GROUP + q, total)
        return total

    if is_quick():
        return _scan_slots(weights, indices, values, contracted)
    groups, rest = divmod(len(indices), _GROUP)
    total = jax.lax.fori_loop(0, groups, add_group, _zero(weights, values, contracted))
    for slot in range(len(indices) - rest, len(indices)):
        total = add(slot, total)
    return total


@functools.partial(_sum_slots.defjvp, symbolic_zeros=True)
def _sum_slots_jvp(contracted, primals, tangents):
    # Bilinear. The tangents are sums one slot at a time, because JAX transposes a scan over slots
    # into one that writes each slot's part once.
    weights, indices, values = primals
    d_weights, _, d_values = tangents
    out = _sum_slots(weights, indices, values, contracted)
    pairs = [(d_weights, values), (weights, d_values)]
    parts = [
        _scan_slots(w, indices, u, contracted)
        for w, u in pairs
        if not any(isinstance(a, SymbolicZero) for a in (w, u))
    ]
    return out, sum(parts, jnp.zeros_like(out))


def _scan_slots(weights, indices, values, contracted: int):
    def add_slot(total, slot):
        w, j = slot
        return total + _term(w, j, values, contracted), None

    zero = _zero(weights, values, contracted)
    return jax.lax.scan(add_slot, zero, (weights, indices))[0]


def _term(w, j, values, contracted: int):
    """One slot's part: weights `(*out_shape, *in_shape, n)` times the neighbours' values."""
    neighbor = values.at[j].get(mode="promise_in_bounds")
    if contracted:
        return sum(w[..., i, :, None] * neighbor[..., i] for i in range(values.shape[-1]))
    return w * neighbor if values.ndim == 1 else w[..., None] * neighbor


def _zero(weights, values, contracted: int):
    out_shape = weights.shape[1 : weights.ndim - 1 - contracted]
    shape = (*out_shape, *values.shape[: values.ndim - contracted])
    return jnp.zeros(shape, jnp.result_type(weights, values))


def _incoming(indices: np.ndarray):
    """For every entry, sorted by the point it reads: its slot and row in the transpose."""
    target = indices.ravel()
    order = np.argsort(target, kind="stable")
    row = target[order]
    counts = np.bincount(row, minlength=indices.shape[1])
    start = np.cumsum(counts) - counts
    place = np.arange(row.size) - start[row]
    return (place, row), order
