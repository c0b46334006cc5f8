"""Linear operators on fields, and what can be made of them: sums, products, transposes."""

from __future__ import annotations

import abc
import functools
import math
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import scipy.sparse
from jaxtyping import Array, ArrayLike, Bool, Float

from ..arguments import as_float, instance, per_point, switched_off, whole
from .lineax import Action
from .masks import both, either


class AbstractOperator(eqx.Module):
    """A linear map from fields `(n, *batch, *in_shape)` to fields `(n, *batch, *out_shape)`.

    Operators add, subtract and multiply: `L + M`, `2 * L`, `-L + 1`, `f * L` (row i times `f[i]`),
    `L + f` (plus `f[i]` times the value at point i), `L @ M`, `L @ u` and `L.T`.

    Example:
        >>> laplacian = js.laplace_beltrami(js.sphere(300))
        >>> screened = -laplacian + 1
        >>> u = jnp.arange(300.0)
        >>> bool(jnp.allclose(screened @ u, u - laplacian(u)))
        True
        >>> twice = laplacian @ laplacian
        >>> [isinstance(operator, js.AbstractOperator) for operator in (laplacian, twice)]
        [True, True]
    """

    # NumPy's arrays leave products with operators to these.
    __array_ufunc__ = None

    def __init_subclass__(cls, **kwargs):
        """Operators of users' own are held to the shapes that they promise."""
        super().__init_subclass__(**kwargs)
        if "__call__" in vars(cls):
            cls.__call__ = _as_promised(cls.__call__)  # type: ignore[method-assign]

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

    def transpose(self) -> AbstractOperator:
        """The transposed operator, with the components taken and given exchanged."""
        return Transposed(self)

    @property
    def T(self) -> AbstractOperator:
        """The transposed operator."""
        return self.transpose()

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

    @property
    def diagonal(self) -> Float[Array, "*c n"]:
        """The weight of every point in its own row, `(*out_shape, *in_shape, n)`.

        Raises:
            ValueError: an operator of which it is not known.
        """
        raise ValueError(
            f"the diagonal of a {type(self).__name__} is not at hand; an operator of one's own "
            "has it as its property diagonal"
        )

    def to_scipy(self) -> scipy.sparse.csr_matrix:
        """CSR matrix acting on flattened fields (the components of a point stand together).

        Raises:
            ValueError: an operator of which only products are known.
        """
        raise ValueError(
            f"the matrix of a {type(self).__name__} is not at hand: an operator of one's own "
            "returns it from its method to_scipy"
        )

    def to_lineax(self, dtype=None) -> lx.AbstractLinearOperator:
        """The operator on one field, for the linear solvers of lineax."""
        return Action(self, jnp.dtype(jnp.result_type(float) if dtype is None else dtype))

    def __matmul__(self, other):
        return Composition(self, other) if isinstance(other, AbstractOperator) else self(other)

    def __add__(self, other) -> AbstractOperator:
        if not isinstance(other, AbstractOperator):
            term = per_point(other, self.n, "term")
            other = Diagonal(term, self.n, self.in_shape, active=self.active)
        return Sum(self, other)

    def __radd__(self, other) -> AbstractOperator:
        return self + other

    def __neg__(self) -> AbstractOperator:
        return -1.0 * self

    def __sub__(self, other) -> AbstractOperator:
        return self + -(other if isinstance(other, AbstractOperator) else as_float(other, "term"))

    def __rsub__(self, other) -> AbstractOperator:
        return -self + other

    def __rmul__(self, factor) -> AbstractOperator:
        factor = per_point(factor, self.n, "factor")
        return Composition(Diagonal(factor, self.n, self.out_shape, active=self.active), self)

    def __mul__(self, factor) -> AbstractOperator:
        if isinstance(factor, AbstractOperator):
            raise TypeError("factor is an operator: write one @ other for one after the other")
        factor = per_point(factor, self.n, "factor")
        if factor.ndim:
            raise ValueError(
                f"factor has shape {factor.shape}, expected (): write factor * operator for a "
                "number per row, or operator @ js.Diagonal(factor) for fields multiplied before"
            )
        return self.__rmul__(factor)

    def __truediv__(self, number) -> AbstractOperator:
        return self * (1 / as_float(number, "number"))

    def checked(self, u: Float[Array, "n *c"]) -> Float[Array, "n *c"]:
        """A field that the operator takes, as an array; else an error."""
        return as_float(u, "field", (self.n, ..., *self.in_shape))

    @property
    def _maps(self) -> str:
        """What goes in and comes out, for `repr`."""
        kinds = ("scalar", "vector", "tensor")
        taken, given = (kinds[min(len(s), 2)] for s in (self.in_shape, self.out_shape))
        return f"{self.n:,} points, {taken} to {given} fields"

    def __repr__(self):
        parts = [repr(part) for part in vars(self).values() if isinstance(part, AbstractOperator)]
        of = f", of {' and '.join(parts)}" if parts else ""
        return f"{type(self).__name__}({self._maps}{of})"


def _as_promised(call: Callable) -> Callable:
    @functools.wraps(call)
    def checked(self, u):
        result = call(self, u)
        batch = np.shape(u)[1 : np.ndim(u) - len(self.in_shape)]
        want = (self.n, *batch, *self.out_shape)
        if not isinstance(result, jax.Array | np.ndarray) or result.shape != want:
            have = f"shape {result.shape}" if hasattr(result, "shape") else repr(result)
            raise ValueError(f"{type(self).__name__} gives {have}, expected shape {want}")
        return result

    return checked


class Diagonal(AbstractOperator):
    """Multiplication by a number or by a scalar field: all components of a point by one number.

    Args:
        factor: a number, or one per point `(n,)`.
        n: number of points; that of the factors if None.
        shape: components per point of the fields, `()` for scalar ones.
        active: False at points that are switched off, `(n,)`; None if all are on.

    Raises:
        TypeError: no real numbers.
        ValueError: a factor of another shape; a number without n.

    Example:
        >>> factor = jnp.arange(3.0)
        >>> (js.Diagonal(factor) @ jnp.ones(3)).tolist()
        [0.0, 1.0, 2.0]
        >>> (2.0 - js.Diagonal(factor)).to_scipy().diagonal().tolist()
        [2.0, 1.0, 0.0]
    """

    factor: Float[Array, "*n"]
    n: int = eqx.field(static=True, default=0)
    in_shape: tuple[int, ...] = eqx.field(static=True, default=())
    active: Bool[Array, " n"] | None = None

    def __init__(
        self,
        factor: ArrayLike,
        n: int | None = None,
        shape: tuple[int, ...] = (),
        *,
        active: Bool[Array, " n"] | None = None,
    ):
        factor = as_float(factor, "factor")
        if n is None and factor.ndim != 1:
            raise ValueError(f"factor has shape {factor.shape}, expected (n,), or n is needed")
        self.n = whole(len(factor) if n is None else n, "n", least=1)
        self.in_shape = shape
        self.factor, self.active = per_point(factor, self.n, "factor"), active
        if self.factor.ndim:
            self.factor = switched_off(active, self.factor)

    out_shape = property(lambda self: self.in_shape)

    @property
    def diagonal(self):
        return super().diagonal if self.in_shape else jnp.broadcast_to(self.factor, self.n)

    def __call__(self, u):
        u = switched_off(self.active, self.checked(u))
        if not self.factor.ndim:  # numbers leave the precision of a field
            return self.factor.astype(u.dtype) * u
        return self.factor.reshape(-1, *[1] * (u.ndim - 1)) * u

    def transpose(self):
        return self

    def to_scipy(self):
        on = True if self.active is None else np.asarray(self.active)
        factor = np.broadcast_to(np.where(on, self.factor, 0), self.n)
        return scipy.sparse.diags(np.repeat(factor, math.prod(self.in_shape))).tocsr()


def identity(n: int, shape: tuple[int, ...] = ()) -> Diagonal:
    """The operator that leaves fields as they are.

    Args:
        n: number of points.
        shape: components per point of the fields.

    Example:
        >>> u = jnp.arange(4.0)
        >>> bool(jnp.all((3 * js.identity(4)) @ u == 3 * u))
        True
    """
    return Diagonal(1.0, n, shape)


class Composition(AbstractOperator):
    """One operator after another: `(outer @ inner)(u) = outer(inner(u))`.

    Example:
        >>> laplacian = js.laplace_beltrami(js.sphere(300))
        >>> u = jnp.arange(300.0)
        >>> bool(jnp.all((laplacian @ laplacian)(u) == laplacian(laplacian(u))))
        True
    """

    outer: AbstractOperator
    inner: AbstractOperator

    def __check_init__(self):
        instance(self.outer, AbstractOperator, "outer")
        instance(self.inner, AbstractOperator, "inner")
        have = (self.inner.n, self.inner.out_shape)
        want = (self.outer.n, self.outer.in_shape)
        if have != want:
            raise ValueError(f"inner operator gives (n, components) {have}, outer takes {want}")

    n = property(lambda self: self.inner.n)
    in_shape = property(lambda self: self.inner.in_shape)
    out_shape = property(lambda self: self.outer.out_shape)
    border = property(lambda self: either(self.inner.border, self.outer.border))
    active = property(lambda self: both(self.inner.active, self.outer.active))

    @property
    def diagonal(self):
        if isinstance(self.outer, Diagonal):
            return self.outer.factor * self.inner.diagonal
        return super().diagonal

    def __call__(self, u):
        return self.outer(self.inner(u))

    def transpose(self):
        return Composition(self.inner.T, self.outer.T)

    def to_scipy(self):
        return (self.outer.to_scipy() @ self.inner.to_scipy()).tocsr()


class Sum(AbstractOperator):
    """Two operators added: `(one + other)(u) = one(u) + other(u)`.

    Example:
        >>> laplacian = js.laplace_beltrami(js.sphere(300))
        >>> hyper = laplacian - 0.1 * laplacian @ laplacian
        >>> type(hyper).__name__, hyper.n
        ('Sum', 300)
    """

    one: AbstractOperator
    other: AbstractOperator

    def __check_init__(self):
        instance(self.one, AbstractOperator, "one")
        instance(self.other, AbstractOperator, "other")
        maps = [(o.n, o.in_shape, o.out_shape) for o in (self.one, self.other)]
        if maps[0] != maps[1]:
            raise ValueError(f"operators of (n, taken, given) {maps[0]}, {maps[1]} do not add up")

    n = property(lambda self: self.one.n)
    in_shape = property(lambda self: self.one.in_shape)
    out_shape = property(lambda self: self.one.out_shape)
    border = property(lambda self: either(self.one.border, self.other.border))
    active = property(lambda self: both(self.one.active, self.other.active))
    diagonal = property(lambda self: self.one.diagonal + self.other.diagonal)

    def __call__(self, u):
        return self.one(u) + self.other(u)

    def transpose(self):
        return Sum(self.one.T, self.other.T)

    def to_scipy(self):
        return (self.one.to_scipy() + self.other.to_scipy()).tocsr()


class Transposed(AbstractOperator):
    """The transpose of an operator of which products are known.

    Args:
        operator: what is transposed.
        rows: the transpose as a function, where there is one that reads instead of scattering.
    """

    operator: AbstractOperator
    rows: Callable | None = None

    n = property(lambda self: self.operator.n)
    in_shape = property(lambda self: self.operator.out_shape)
    out_shape = property(lambda self: self.operator.in_shape)
    border = property(lambda self: self.operator.border)
    active = property(lambda self: self.operator.active)

    @property
    def diagonal(self):
        scalar = not (self.in_shape or self.out_shape)
        return self.operator.diagonal if scalar else super().diagonal

    def __call__(self, v):
        v = self.checked(v)
        if self.rows is not None:
            return self.rows(v)
        batch = v.shape[: v.ndim - len(self.in_shape)]
        u = jax.ShapeDtypeStruct((*batch, *self.out_shape), v.dtype)
        out = jax.eval_shape(self.operator, u)
        return jax.linear_transpose(self.operator, u)(v.astype(out.dtype))[0]

    def transpose(self):
        return self.operator

    def to_scipy(self):
        return self.operator.to_scipy().T.tocsr()


def check_scalar(operator: AbstractOperator) -> None:
    """Refuse what is no operator, and operators with components."""
    hint = "surface.laplacian is one, js.laplace_beltrami(cloud) makes one"
    instance(operator, AbstractOperator, "operator", hint)
    if operator.in_shape or operator.out_shape:
        shapes = f"{operator.in_shape} to {operator.out_shape}"
        raise ValueError(f"an operator on scalar fields is needed, not from {shapes} components")
