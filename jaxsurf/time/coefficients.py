r"""What problems in time ask of their coefficients, operators and functions."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from jaxtyping import Array, ArrayLike, Float

from ..arguments import as_float, finite, instance, real, switched_off
from ..boundary import Closure
from ..failures import is_concrete, raise_at
from ..functions import numbers_as_arrays
from ..stencils.algebra import AbstractOperator

InTime = ArrayLike | Callable[[Any], Any]


def number(value: Any, name: str, least: float = -np.inf) -> Array:
    """A coefficient that is one number, as an array: a new one compiles nothing.

    Raises:
        TypeError: not a real number.
        ValueError: not finite, or less than `least`.
    """
    return numbers_as_arrays(_plain(real(value, name, least=least)))


def coefficient(value: Any, name: str, least: float = -np.inf, on: Any = None) -> Array | Callable:
    """A number, an array in space, or a function of time, which stays as it is.

    Args:
        on: points that are switched on; None for all.

    Raises:
        TypeError: not of real numbers.
        ValueError: names the first entry that is not finite, or less than `least`.
    """
    if callable(value):
        return value
    if value is None or np.ndim(value) == 0:
        return number(value, name, least)
    values = finite(as_float(value, name), name, on)
    if on is not None and values.shape[:1] == on.shape:
        values = switched_off(on, values, max(least, 0))
    if is_concrete(values):
        seen = np.asarray(values)
        low = np.any(np.less(seen, least).reshape(len(seen), -1), axis=1)
        raise_at(
            np.asarray(low), f"{name} at point {{i}} is {{v}}, expected at least {least:g}", seen
        )
    return values


def _plain(value: Any) -> Any:
    """Whole numbers as others: 1 and 0.5 are to be one kind."""
    return float(value) if isinstance(value, int) else value


def function(value: Any, name: str) -> Callable | None:
    """A function, or None.

    Raises:
        TypeError: what cannot be called.
    """
    if value is not None and not callable(value):
        raise TypeError(f"{name} is a {type(value).__name__}, expected a function or None")
    return value


def check_operator(
    operator: Any, name: str, n: int | None = None, *, out: tuple | None = (), needed: bool = False
) -> int | None:
    """The number of points of an operator on scalar fields, or n without one.

    Args:
        operator: None where there may be none.
        n: number of points that the others have.
        out: components that it gives; None for any.
        needed: there must be one.

    Raises:
        TypeError: not an operator.
        ValueError: other components or points.
    """
    if operator is None and not needed:
        return n
    hint = "from js.laplace_beltrami, js.surface_gradient, js.diffusion, ..."
    instance(operator, AbstractOperator, name, hint)
    if operator.in_shape or (out is not None and operator.out_shape != out):
        have = f"{operator.in_shape} to {operator.out_shape}"
        raise ValueError(f"{name} maps fields of components {have}, expected () to {out}")
    if n is not None and operator.n != n:
        raise ValueError(f"{name} has {operator.n} points, the other operators have {n}")
    return operator.n


def check_closure(closure: Any, n: int | None) -> None:
    """Raise on what is not a closure for n points."""
    if closure is None:
        return
    hint = "eliminate(cloud, conditions) or with_ghosts makes one from conditions"
    instance(closure, Closure, "closure", hint)
    if n is not None and closure.n != n:
        raise ValueError(f"closure is of {closure.n} points, the operators have {n}")


def check_mass(
    mass: Any, closure: Closure | None, n: int | None, on: Any = None
) -> Float[Array, " n"] | None:
    """The weights of the mass, as an array."""
    if mass is None:
        return None
    if closure is not None:
        raise ValueError("`mass` is for closed systems: with boundary conditions it may change")
    mass = switched_off(on, finite(as_float(mass, "mass"), "mass", on))
    if mass.ndim != 1 or (n is not None and mass.shape != (n,)):
        raise ValueError(f"mass has shape {mass.shape}, expected ({'n' if n is None else n},)")
    # NumPy's sum: JAX's is traced within `jit`, also that of an array that is known.
    if is_concrete(mass) and not (total := np.sum(np.asarray(mass))) > 0:
        raise ValueError(f"the weights of the mass add up to {float(total)}, not to > 0")
    return mass
