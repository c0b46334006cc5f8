r"""Boundary conditions $a\,u + b\,\partial_\nu u = g$, and whether several agree."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Real

from .arguments import as_float, as_many, differentiable, finite, instance, shaped
from .cloud import PointCloud
from .failures import is_concrete, raise_at
from .indices import indices_of

Value = (
    float | Real[Array, "*m"] | Sequence[float] | Callable[[Float[Array, ""]], Real[Array, "*m"]]
)
Where = Bool[Array, " n"] | Int[Array, " m"] | Sequence[int]

# Conormals are of length one to within this.
_UNIT = 1e-5


class Condition(eqx.Module):
    r"""$a\,u + b\,\partial_\nu u = g$ at m points; made by `dirichlet`, `neumann` and `robin`.

    Args:
        where: indices of the points, `(m,)`.
        value: g: a number, `(m,)`, `(m, c)` for fields of c components, or a function of time
            that returns one of these.
        a: factor of the value, scalar or `(m,)`; None if the points are free.
        b: factor of the conormal derivative, scalar or `(m,)`; None for a Dirichlet condition.
        conormals: outward conormals $\nu$, `(m, d)`; None to take those of the border.

    Raises:
        TypeError: points that are no mask nor indices, numbers that are not real, a function of
            time that JAX cannot trace.
        ValueError: shapes that do not fit, numbers that are not finite and conormals that are not
            of length one (with the point), a point named twice, no point.

    Example:
        >>> condition = js.robin(np.array([3, 5]), a=1.0, b=2.0, value=0.5)
        >>> condition.m, float(condition.at(0.0))
        (2, 0.5)
    """

    where: Int[np.ndarray, " m"]
    value: Array | Callable
    a: Array | None
    b: Array | None
    conormals: Float[Array, "m d"] | None
    of: int | None = eqx.field(static=True)

    def __init__(self, where, value, *, a, b, conormals=None):
        self.where = indices_of(where, None, "where")
        raise_at(self.where < 0, "where names point {v}: indices count from 0", self.where)
        self.of = len(where) if np.asarray(where).dtype == bool else None
        m = len(self.where)
        self.value = value if callable(value) else as_float(value, "value", (), (m,), (m, "c", ...))
        self.a = None if a is None else as_float(a, "a", (), (m,))
        self.b = None if b is None else as_float(b, "b", (), (m,))
        if conormals is not None:
            conormals = as_float(conormals, "conormals", (m, 2), (m, 3))
        self.conormals = conormals

    def __check_init__(self):
        if not self.m and not self.is_free:
            raise ValueError("where names no point: a condition needs at least 1")
        self._check_function()
        for name in ("a", "b", "conormals", "value"):
            x = getattr(self, name)
            if x is not None and not callable(x):
                finite(x, name, points=self.where)
        if self.conormals is not None and is_concrete(self.conormals):
            with np.errstate(over="ignore"):
                length = np.linalg.norm(np.asarray(self.conormals), axis=1)
            text = "the conormal at point {i} has length {v:.7g}, expected 1"
            raise_at(~(np.abs(length - 1) < _UNIT), text, length, points=self.where)

    def _check_function(self):
        value = self.value
        if callable(value):
            time = jax.ShapeDtypeStruct((), jnp.result_type(float))
            try:
                found = differentiable(lambda t: jnp.asarray(value(t)), "value", time)
            except TypeError as error:
                raise TypeError(f"value must be a function of time to an array: {error}") from error
            if not jnp.issubdtype(found.dtype, jnp.floating) and found.dtype.kind not in "iub":
                raise TypeError(f"value(t) is of type {found.dtype}, expected real numbers")
            shaped(found, "value(t)", (), (self.m,), (self.m, "c", ...))

    @property
    def m(self) -> int:
        """Number of points."""
        return len(self.where)

    @property
    def is_free(self) -> bool:
        """True if the points are bound by nothing: made by `free`."""
        return self.a is None

    def at(self, t) -> Array:
        """The values g at a time."""
        return as_float(self.value(t), "value(t)") if callable(self.value) else self.value

    def __repr__(self):
        if self.is_free:
            return f"free({self.m} points)"
        what = "f(t)" if callable(self.value) else _told(self.value)
        if self.b is None:
            return f"dirichlet({self.m} points, value={what})"
        own = "" if self.conormals is None else ", own conormals"
        return f"robin({self.m} points, value={what}, a={_told(self.a)}, b={_told(self.b)}{own})"


def _told(x) -> str:
    """A number, or the range of several."""
    if not is_concrete(x):
        return f"traced{list(x.shape)}"
    x = np.asarray(x)
    low, high = float(x.min()), float(x.max())
    return f"{low:.4g}" if low == high else f"{low:.4g}..{high:.4g}"


def dirichlet(where: Where, value: Value = 0.0) -> Condition:
    """The condition u = g at some points: of a border, or any others.

    Args:
        where: mask `(n,)` or indices `(m,)`, concrete.
        value: g, in the units of the field: a number, `(m,)` in the order of the indices,
            `(m, c)` for fields of c components, or a function of time that returns such.

    Returns:
        The condition, for `eliminate`.

    Differentiable: in the value.
    Raises:
        ValueError: a value whose shape does not fit; a point named twice.

    Example:
        >>> js.dirichlet([3, 5], jnp.array([1.0, 2.0])).m
        2
    """
    return Condition(where, value, a=1.0, b=None)


def neumann(
    where: Where, value: Value = 0.0, *, conormals: Float[Array, "m d"] | None = None
) -> Condition:
    r"""The condition $\partial_\nu u = g$: the conormal flux through a border.

    Args:
        where: mask `(n,)` or indices `(m,)`, concrete.
        value: g, in units of field / length; forms as in `dirichlet`.
        conormals: outward unit vectors, tangent to the surface and normal to the border,
            `(m, d)`; those of the border if None.

    Returns:
        The condition, for `eliminate` and `with_ghosts`.

    Differentiable: in value and conormals.
    Raises:
        ValueError: a shape that does not fit; a point named twice.

    Example:
        >>> js.neumann([3], conormals=jnp.array([[1.0, 0.0, 0.0]])).m
        1
    """
    return Condition(where, value, a=0.0, b=1.0, conormals=conormals)


def robin(
    where: Where,
    value: Value = 0.0,
    *,
    a: float | Float[Array, "*a"],
    b: float | Float[Array, "*b"],
    conormals: Float[Array, "m d"] | None = None,
) -> Condition:
    r"""The condition $a\,u + b\,\partial_\nu u = g$; passive for a, b > 0.

    Args:
        where: mask `(n,)` or indices `(m,)`, concrete.
        value: g, in the units of a · field; forms as in `dirichlet`.
        a: factor of the value, scalar or `(m,)`.
        b: factor of the outward derivative, scalar or `(m,)`; its unit is that of a · length.
        conormals: as in `neumann`.

    Returns:
        The condition, for `eliminate` and `with_ghosts`.

    Differentiable: in value, a, b and conormals.
    Raises:
        ValueError: a shape that does not fit; a point named twice.

    Example:
        >>> js.robin([3], 1.0, a=2.0, b=0.5).m
        1
    """
    for name, factor in (("a", a), ("b", b)):
        as_float(factor, name)  # None means something else to a condition
    return Condition(where, value, a=a, b=b, conormals=conormals)


def free(where: Where) -> Condition:
    """No condition: the equation itself is to hold at these points of a border.

    Stencils there are one-sided. That serves where the equation says enough (outflow of a
    transport equation, a least-squares fit), and is unstable for heat and waves; hence solvers
    refuse border points about which nothing is said.

    Args:
        where: mask `(n,)` or indices `(m,)`, concrete.

    Returns:
        The condition, for `eliminate` and `with_ghosts`.

    Raises:
        ValueError: a point named twice.

    Example:
        >>> square = js.graph(lambda x, y: 0.0 * x, (7, 7))
        >>> js.eliminate(square, js.free(square.boundary)).m
        0
    """
    return Condition(where, 0.0, a=None, b=None)


# --- what a set of conditions says ---------------------------------------------------------


def checked_conditions(
    cloud: PointCloud, conditions: Condition | Sequence[Condition]
) -> tuple[list[Condition], list[Bool[np.ndarray, " m"]]]:
    """The conditions, and which of their points each one decides: a point has one owner."""
    instance(cloud, PointCloud, "cloud")
    conditions = _listed(conditions)
    on = cloud.host_active
    owner, place = np.full(cloud.n, -1), np.zeros(cloud.n, int)
    owned = []
    for number, condition in enumerate(conditions):
        where = condition.where
        if condition.of is not None:
            as_many(f"condition {number} is given by a mask", condition.of, "the cloud", cloud.n)
        text = f"condition {number} names point {{v}}, "
        raise_at(where >= cloud.n, f"{text}there are {cloud.n}", where)
        raise_at(~on[where], f"{text}which is switched off", where)
        _check_agreement(conditions, number, owner, place)
        fresh = owner[where] < 0
        owner[where[fresh]], place[where[fresh]] = number, np.flatnonzero(fresh)
        owned.append(fresh)
    free = [number for number, condition in enumerate(conditions) if condition.is_free]
    if not np.any(on & ((owner < 0) | np.isin(owner, free))):
        raise ValueError(f"all {int(on.sum())} points are bound, no free point is left")
    return conditions, owned


def _listed(conditions) -> list[Condition]:
    hint = "made by js.dirichlet, js.neumann, js.robin or js.free"
    if isinstance(conditions, Condition):
        return [conditions]
    if isinstance(conditions, str) or not isinstance(conditions, Iterable):
        instance(conditions, Condition, "conditions", hint)
    conditions = list(conditions)
    if not conditions:
        raise ValueError("conditions is empty, at least 1 condition is needed")
    for number, condition in enumerate(conditions):
        instance(condition, Condition, f"conditions[{number}]", hint)
    return conditions


def _check_agreement(conditions, number, owner, place) -> None:
    new = conditions[number]
    for other in np.unique(owner[new.where]):
        if other < 0:
            continue
        here = np.flatnonzero(owner[new.where] == other)
        there = place[new.where[here]]
        raise_at(
            _differ(conditions[other], there, new, here),
            f"point {{i}} is bound by condition {other} and by condition {number}, which do not "
            "agree{more}; name each point once",
            points=new.where[here],
        )


def _differ(one: Condition, i, two: Condition, j) -> Bool[np.ndarray, " p"]:
    """Whether two conditions differ at p points: points i of the first, j of the second."""
    everywhere, result = np.ones(len(i), bool), np.zeros(len(i), bool)
    kinds = [(c.is_free, c.b is None, c.conormals is None) for c in (one, two)]
    if kinds[0] != kinds[1]:
        return everywhere
    if one.value is not two.value and (callable(one.value) or callable(two.value)):
        return everywhere
    for name in ("a", "b", "value", "conormals"):
        x, y = getattr(one, name), getattr(two, name)
        if x is y and not (name in ("value", "conormals") and np.ndim(x)):
            continue
        if callable(x) or x is None:
            continue
        if not is_concrete(x, y):
            return everywhere
        x = np.broadcast_to(x, (one.m, *x.shape[1:]))[i]
        y = np.broadcast_to(y, (two.m, *y.shape[1:]))[j]
        if x.shape != y.shape:
            return everywhere
        far = np.abs(x - y) > 1e-5 * (np.abs(x) + np.abs(y))
        result = result | far.reshape(len(i), -1).any(axis=1)
    return result
