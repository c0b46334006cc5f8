r"""Evolution equations by the method of lines: what changes a field, split by how stiff it is."""

from __future__ import annotations

import abc
from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, PyTree

from ..arguments import as_float, instance
from ..arguments import traced_call as user
from ..boundary import Closure
from ..failures import is_concrete
from ..stencils.algebra import AbstractOperator
from .coefficients import InTime
from .implicit import IMEX
from .states import added, only_on, tell_small

Field = Float[Array, "n *c"]


class AbstractEvolution(eqx.Module):
    r"""A problem $\partial_t u = L(t)\,u + R(t, u)$ with a stiff linear part L and the rest R.

    With boundary conditions the state holds all points, but only its free entries move: the
    bound ones follow from them. With $E u + e(t)$ the field so filled in and P the restriction
    to free points, the equation is $\partial_t u = P\,(L + R)(E u + e)$.

    A problem of one's own defines `linear` and `rest` and, unless its state is a single field,
    how to fill in conditions (`closed`). It may say which solver suits it (`suggested_solver`),
    what tolerances are relative to (`controller`) and what multigrid is to invert for it
    (`factors`). Where geometry is part of the state, `at` makes of it what `linear` and `rest`
    then use.

    Example:
        >>> class Decay(js.AbstractEvolution):
        ...     closure: None
        ...     laplacian: js.AbstractOperator
        ...
        ...     def linear(self, t, u):
        ...         return self.laplacian(u)
        ...
        ...     def rest(self, t, u, args):
        ...         return -args * u
        >>> cloud = js.sphere(300)
        >>> u0 = cloud.points[:, 2]
        >>> problem = Decay(None, js.laplace_beltrami(cloud))
        >>> u = js.integrate(problem, u0, t1=0.1, args=3.0).ys[-1]
        >>> bool(jnp.abs(u - jnp.exp(-0.5) * u0).max() < 0.01)
        True
    """

    closure: eqx.AbstractVar[Closure | None]

    @property
    def diffusive(self) -> bool:
        """True if it cannot be integrated backwards in time."""
        return False

    @property
    def contractive(self) -> bool:
        """True if no solution grows in the root mean square."""
        return False

    @property
    def _grows(self) -> ArrayLike:
        r"""No solution grows faster than $e^{gt}$ in the root mean square; infinite if unknown."""
        return 0.0 if self.contractive else np.inf

    @property
    def _moves(self) -> bool:
        """True if the surface is part of the state, so that a rate is much code."""
        return False

    @property
    def active(self) -> Bool[Array | np.ndarray, " n"] | None:
        """False at points that are switched off, as its operators say; None if all are on."""
        return known_active(*vars(self).values())

    def __repr__(self):
        """The parts that there are, in a line."""
        parts = []
        for name, value in vars(self).items():
            if isinstance(value, AbstractOperator):
                parts.append(f"{name}=<{type(value).__name__} on {value.n} points>")
            elif isinstance(value, Closure):
                parts.append(f"{name}=<Closure of {value.m} points>")
            elif eqx.is_array(value):
                plain = value.ndim == 0 and is_concrete(value)
                text = f"{float(value):g}" if plain else f"<{value.dtype} {value.shape}>"
                parts.append(f"{name}={text}")
            elif callable(value):
                parts.append(
                    f"{name}=<function {getattr(value, '__name__', '')}>".replace(" >", ">")
                )
            elif value is not None:
                parts.append(f"{name}={value!r}")
        return f"{type(self).__name__}({', '.join(parts)})"

    @property
    def n(self) -> int | None:
        """How many rows every array of a state has; None if they may differ."""
        return None

    @property
    def caution(self) -> str | None:
        """What whoever integrates the problem is warned of."""
        return None

    @property
    def operators(self) -> list[AbstractOperator]:
        """What needs conditions where there is a border: all that it holds but what stabilises."""
        held = {name: x for name, x in vars(self).items() if name != "stabilization"}
        return [x for x in held.values() if isinstance(x, AbstractOperator)]

    def check(self, t) -> None:
        """Raise on coefficients that cannot be at time t: those not known when it was made."""

    def suggested_solver(self) -> tuple[dfx.AbstractSolver, str]:
        """A solver that suits the kind of problem, and why; by its kind, not by its values."""
        return IMEX(order=3), "IMEX(order=3): a linear part of unknown stiffness"

    def controller(self, rtol, atol, shortest) -> dfx.AbstractAdaptiveStepSizeController:
        """Of the lengths of steps by tolerances of their errors; none is below the shortest."""
        return dfx.PIDController(rtol, atol, dtmin=shortest, force_dtmin=False)

    def tell_small(self, u0: PyTree[Array], atol) -> None:
        """Warn of a state that is smaller than the errors that are allowed."""
        tell_small(u0, atol, "u0")

    def factors(self, g: Array, u0: PyTree[Array]) -> PyTree[Array] | None:
        r"""Multigrid inverts $1 - g L \approx \prod_i (1 - s_i \Delta)$: the $s_i$.

        Δ is the problem's `laplacian`. For each array of the state `(m,)`, or `(m, c)` for c
        species of their own; None for an array that L leaves alone. None alone if nothing is
        known.
        """
        return None

    def at(self, t, u: PyTree[Array]) -> AbstractEvolution:
        """The problem with everything frozen that `linear` and `rest` need of a state.

        Called once for a right-hand side, and by `IMEX` once for the linear part of a step: what
        is frozen are the arrays in the fields of the result, so that operators belong into a
        field and not into a property. The linear part of a state so frozen is linear.
        """
        return self

    @abc.abstractmethod
    def linear(self, t, u: PyTree[Array]) -> PyTree[Array]:
        """The stiff part L(t) u, linear in u."""

    @abc.abstractmethod
    def rest(self, t, u: PyTree[Array], args) -> PyTree[Array]:
        """Everything else, R(t, u)."""

    def closed(self, t, u: PyTree[Array]) -> PyTree[Array]:
        """The state with its bound entries filled in."""
        return u if self.closure is None else self.closure(u, t)

    def dilution(self, u: PyTree[Array], divergence: Float[Array, " n"]) -> PyTree[Array]:
        r"""What a surface that moves with velocity v adds to the rate, from $\nabla\cdot v$.

        Amounts per area, $-u\,\nabla\cdot v$, unless a problem says otherwise.
        """
        return jax.tree.map(lambda v: -per_point(divergence, v) * v, u)

    def rate(self, t, u: PyTree[Array], args) -> PyTree[Array]:
        """The whole right-hand side, for explicit and for fully implicit solvers."""
        u = self.closed(t, u)
        now = self.at(t, u)
        return now._free(added(now._linear(t, u), now._rest(t, u, args)))

    def implicit_rate(self, t, u: PyTree[Array], args) -> PyTree[Array]:
        """The part for implicit steps, linear in u: P L E u."""
        within = jax.tree.map(lambda v: homogeneous(self.closure, v), u)
        return self._free(self._linear(t, within))

    def explicit_rate(self, t, u: PyTree[Array], args) -> PyTree[Array]:
        """The part for explicit steps: P (R(E u + e) + L e)."""
        rest = self._rest(t, self.closed(t, u), args)
        if self.closure is None:
            return self._free(rest)
        none = self.closed(t, jax.tree.map(jnp.zeros_like, u))
        return self._free(added(rest, self._linear(t, none)))

    def _linear(self, t, u):
        return self._like(u, self.linear(t, u), "linear")

    def _rest(self, t, u, args):
        return self._like(u, self.rest(t, u, args), "rest")

    def _like(self, u: PyTree[Array], value: PyTree[Array], name: str) -> PyTree[Array]:
        """A part of the rate, as it has to be, of problems of users' own as well."""
        name = f"{name} of {type(self).__name__}"
        have, want = (str(jax.tree.structure(tree)) for tree in (value, u))
        if have != want:
            raise ValueError(f"{name} returns a {have}, the state is a {want}")
        return jax.tree.map(lambda v, y: same_shape(v, y, name), value, u)

    def _free(self, rate: PyTree[Array]) -> PyTree[Array]:
        rate = only_on(self.active, rate)
        if self.closure is None:
            return rate
        return jax.tree.map(self.closure.restrict, rate)


# --- pieces --------------------------------------------------------------------------------


def checked_problem(problem: Any) -> AbstractEvolution:
    hint = "like AdvectionDiffusionReaction(laplacian)"
    return instance(problem, AbstractEvolution, "problem", hint)


def known_active(*parts) -> Bool[Array | np.ndarray, " n"] | None:
    """What the first operator among them that knows says."""
    known = [part.active for part in parts if isinstance(part, AbstractOperator)]
    return next((active for active in known if active is not None), None)


def at_time(value: InTime, name: str, t):
    return user(value, name, t) if callable(value) else value


def per_point(values: ArrayLike, field: Array, keep: int = 0) -> Array:
    """Values `(n, *kept)`, `keep` axes of them, with axes inserted to go with a field."""
    values = jnp.asarray(values)
    if values.ndim == 0:
        return values
    if values.shape[0] != field.shape[0]:
        raise ValueError(
            f"a coefficient has shape {values.shape}, expected a number or one for each of "
            f"{field.shape[0]} points"
        )
    missing = (1,) * (field.ndim - 1 - keep)
    return values.reshape(values.shape[0], *missing, *values.shape[1:])


def balanced(rate: Field, mass) -> Field:
    """The rate nearest to the one given, in the norm of these weights, that keeps the mass."""
    if mass is None:
        return rate
    return rate - jnp.tensordot(mass / jnp.sum(mass), rate, axes=1)


def homogeneous(closure, u: Field) -> Field:
    return u if closure is None else closure.homogeneous(u)


def same_shape(value, u: Field, name: str) -> Array:
    value = as_float(value, f"what {name} returns")
    if value.shape != u.shape:
        raise ValueError(f"{name} returns shape {value.shape}, the field has {u.shape}")
    return value
