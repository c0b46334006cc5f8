r"""Boundary conditions $a\,u + b\,\partial_\nu u = g$, and whether several agree."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from .arguments import is_concrete
from .cloud import PointCloud

Value = float | Float[Array, "*m"] | Callable[[Float[Array, ""]], Float[Array, "*m"]]
Where = Bool[Array, " n"] | Int[Array, " m"] | Sequence[int]


class Condition(eqx.Module):
    r"""$a\,u + b\,\partial_\nu u = g$ at m points; made by `dirichlet`, `neumann` and `robin`.

    Args:
        where: indices of the points, `(m,)`.
        value: g: a number, `(m,)`, `(m, c)` for fields of c components, or a function of time
            that returns one of these.
        a: factor of the value, scalar or `(m,)`; None if the points are free.
        b: factor of the conormal derivative, scalar or `(m,)`; None for a Dirichlet condition.
        conormals: outward conormals $\nu$, `(m, d)`; None to take those of the border.
    """

    where: Int[np.ndarray, " m"]
    value: Array | Callable
    a: Array | None
    b: Array | None
    conormals: Float[Array, "m d"] | None

    def __init__(self, where, value, *, a, b, conormals=None):
        self.where = _indices(where)
        self.value = value if callable(value) else jnp.asarray(value)
        self.a = None if a is None else jnp.asarray(a)
        self.b = None if b is None else jnp.asarray(b)
        self.conormals = None if conormals is None else jnp.asarray(conormals)

    def __check_init__(self):
        m = len(self.where)
        for name in ("a", "b", "value"):
            x = getattr(self, name)
            if x is None or callable(x) or x.shape[:1] in ((), (m,)):
                continue
            raise ValueError(f"{name} has shape {x.shape}, the condition has {m} points")
        if self.conormals is not None and self.conormals.shape[:1] != (m,):
            shape = self.conormals.shape
            raise ValueError(f"conormals have shape {shape}, the condition has {m} points")

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
        return jnp.asarray(self.value(t)) if callable(self.value) else self.value


def dirichlet(where: Where, value: Value = 0.0) -> Condition:
    """The condition u = g at some points: of a border, or any others.

    Args:
        where: mask `(n,)` or indices `(m,)`, concrete.
        value: g, in the units of the field: a number, `(m,)` in the order of the indices,
            `(m, c)` for fields of c components, or a function of time that returns such.

    Returns:
        The condition, for `close`.

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
        The condition, for `close` and `with_ghosts`.

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
    a: float | Float[Array, " m"],
    b: float | Float[Array, " m"],
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
        The condition, for `close` and `with_ghosts`.

    Differentiable: in value, a, b and conormals.
    Raises:
        ValueError: a shape that does not fit; a point named twice.

    Example:
        >>> js.robin([3], 1.0, a=2.0, b=0.5).m
        1
    """
    return Condition(where, value, a=a, b=b, conormals=conormals)


def free(where: Where) -> Condition:
    """No condition: the equation itself is to hold at these points of a border.

    Stencils there are one-sided. That serves where the equation says enough (outflow of a
    transport equation, a least-squares fit), and is unstable for heat and waves; hence solvers
    refuse border points about which nothing is said.

    Args:
        where: mask `(n,)` or indices `(m,)`, concrete.

    Returns:
        The condition, for `close` and `with_ghosts`.

    Raises:
        ValueError: a point named twice.

    Example:
        >>> square = js.graph(lambda x, y: 0.0 * x, (7, 7))
        >>> js.close(square, js.free(square.boundary)).m
        0
    """
    return Condition(where, 0.0, a=None, b=None)


# --- what a set of conditions says ---------------------------------------------------------


def checked_conditions(
    cloud: PointCloud, conditions: Condition | Sequence[Condition]
) -> tuple[list[Condition], list[Bool[np.ndarray, " m"]]]:
    """The conditions, and which of their points each one decides: a point has one owner."""
    conditions = [conditions] if isinstance(conditions, Condition) else list(conditions)
    if not conditions:
        raise ValueError("no conditions given")
    on = cloud.host_active
    owner, place = np.full(cloud.n, -1), np.zeros(cloud.n, int)
    owned = []
    for number, condition in enumerate(conditions):
        where = condition.where
        outside = where[(where < 0) | (where >= cloud.n)]
        if outside.size:
            raise ValueError(f"condition {number} names point {outside[0]}, there are {cloud.n}")
        off = where[~on[where]]
        if off.size:
            raise ValueError(f"condition {number} names point {off[0]}, which is switched off")
        _check_agreement(conditions, number, owner, place)
        fresh = owner[where] < 0
        owner[where[fresh]], place[where[fresh]] = number, np.flatnonzero(fresh)
        owned.append(fresh)
    free = [number for number, condition in enumerate(conditions) if condition.is_free]
    if not np.any(on & ((owner < 0) | np.isin(owner, free))):
        raise ValueError(f"all {int(on.sum())} points are bound, no free point is left")
    return conditions, owned


def _check_agreement(conditions, number, owner, place) -> None:
    new = conditions[number]
    for other in np.unique(owner[new.where]):
        if other < 0:
            continue
        here = np.flatnonzero(owner[new.where] == other)
        there = place[new.where[here]]
        differ = _differ(conditions[other], there, new, here)
        if differ.any():
            i = new.where[here[np.argmax(differ)]]
            raise ValueError(
                f"point {i} is bound by condition {other} and by condition {number}, which do "
                f"not agree ({int(differ.sum())} such points); name each point once"
            )


def _differ(one: Condition, i, two: Condition, j) -> Bool[np.ndarray, " p"]:
    """Whether two conditions differ at p points: points i of the first, j of the second."""
    everywhere, nowhere = np.ones(len(i), bool), np.zeros(len(i), bool)
    if one.is_free != two.is_free or (one.b is None) != (two.b is None):
        return everywhere
    if (one.conormals is None) != (two.conormals is None):
        return everywhere
    if callable(one.value) or callable(two.value):
        if one.value is not two.value:
            return everywhere
    result = nowhere
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


def _indices(where) -> Int[np.ndarray, " m"]:
    if not is_concrete(where):
        raise ValueError("where must be concrete: which points are bound decides shapes")
    where = np.asarray(where)
    if where.dtype == bool and where.ndim == 1:
        return np.flatnonzero(where).astype(np.int32)
    if where.ndim != 1 or not (where.size == 0 or np.issubdtype(where.dtype, np.integer)):
        raise ValueError(f"where is {where.dtype}{where.shape}, expected a mask or indices, 1-D")
    unique, count = np.unique(where, return_counts=True)
    if count.max(initial=1) > 1:
        raise ValueError(f"point {unique[np.argmax(count)]} is named {count.max()} times")
    return where.astype(np.int32)
