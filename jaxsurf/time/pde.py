r"""Evolution equations by the method of lines: what changes a field, split by how stiff it is."""

from __future__ import annotations

import abc
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, PyTree

from ..arguments import as_float, finite, instance, is_concrete, switched_off
from ..boundary import Closure
from ..operators import divergence_of
from ..stencils.algebra import AbstractOperator
from ..stencils.gathers import take
from ..stencils.stencil import Stencil
from .coefficients import (
    InTime,
    check_closure,
    check_mass,
    check_operator,
    coefficient,
    function,
    number,
    user,
)
from .states import only_on

Field = Float[Array, "n *c"]


class AbstractEvolution(eqx.Module):
    r"""A problem $\partial_t u = L(t)\,u + R(t, u)$ with a stiff linear part L and the rest R.

    With boundary conditions the state holds all points, but only its free entries move: the
    bound ones follow from them. With $E u + e(t)$ the field so filled in and P the restriction
    to free points, the equation is $\partial_t u = P\,(L + R)(E u + e)$.

    A problem of one's own defines `linear` and `rest` and, unless its state is a single field,
    how to fill in conditions (`closed`).

    Example:
        >>> class Decay(js.AbstractEvolution):
        ...     conditions: None
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

    conditions: eqx.AbstractVar[Closure | None]

    @property
    def diffusive(self) -> bool:
        """True if it cannot be integrated backwards in time."""
        return False

    @property
    def contractive(self) -> bool:
        """True if no solution grows in the root mean square."""
        return False

    @property
    def active(self) -> Bool[Array | np.ndarray, " n"] | None:
        """False at points that are switched off, as its operators say; None if all are on."""
        return _known_active(*vars(self).values())

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

    @abc.abstractmethod
    def linear(self, t, u: PyTree[Field]) -> PyTree[Field]:
        """The stiff part L(t) u, linear in u."""

    @abc.abstractmethod
    def rest(self, t, u: PyTree[Field], args) -> PyTree[Field]:
        """Everything else, R(t, u)."""

    def closed(self, t, u: PyTree[Field]) -> PyTree[Field]:
        """The state with its bound entries filled in."""
        return u if self.conditions is None else self.conditions(u, t)

    def rate(self, t, u: PyTree[Field], args) -> PyTree[Field]:
        """The whole right-hand side, for explicit and for fully implicit solvers."""
        u = self.closed(t, u)
        return self._free(_add(self.linear(t, u), self.rest(t, u, args)))

    def implicit_rate(self, t, u: PyTree[Field], args) -> PyTree[Field]:
        """The part for implicit steps, linear in u: P L E u."""
        within = jax.tree.map(lambda v: _homogeneous(self.conditions, v), u)
        return self._free(self.linear(t, within))

    def explicit_rate(self, t, u: PyTree[Field], args) -> PyTree[Field]:
        """The part for explicit steps: P (R(E u + e) + L e)."""
        rest = self.rest(t, self.closed(t, u), args)
        if self.conditions is None:
            return self._free(rest)
        none = self.closed(t, jax.tree.map(jnp.zeros_like, u))
        return self._free(_add(rest, self.linear(t, none)))

    def _free(self, rate: PyTree[Field]) -> PyTree[Field]:
        rate = only_on(self.active, rate)
        if self.conditions is None:
            return rate
        return jax.tree.map(self.conditions.restrict, rate)


class AdvectionDiffusionReaction(AbstractEvolution):
    r"""Advection, diffusion and reaction of one or several species on a fixed surface.

    $\partial_t u + \nabla\cdot(v\,u) = \nabla\cdot(D\,\nabla u) + f(t, u)$ (Suchde and Kuhnert
    2019, eq. 28, for a surface at rest), for fields u of shape `(n,)` or, with c species,
    `(n, c)`.

    Args:
        laplacian: the Laplace–Beltrami operator, or $\nabla\cdot(A\,\nabla\,\cdot)$ from
            `diffusion` for anisotropic media; None without diffusion.
        diffusivity: D in units of length² / time: a number, `(c,)` one per species, `(n,)` or
            `(n, 1)`, `(n, c)` in space, or a function of time that returns one of these. In
            space it stands inside the divergence.
        gradient: the surface gradient, needed with a velocity.
        velocity: tangential, `(n, d)`, or a function of time that returns one.
        reaction: `(t, u, args) -> f`, of the shape of u; None for none.
        conservative: the form above; if False $v\cdot\nabla u$ in place of $\nabla\cdot(v\,u)$.
        stabilization: an operator added to the right-hand side, that damps what advection
            cannot resolve: `hyperviscosity` or `upwinding`.
        conditions: from `close` or `with_ghosts`; None for closed surfaces.
        mass: weights m, `(n,)`. If given, transport is corrected by the smallest change that
            keeps $\sum_i m_i u_i$: a shift of the rate by its mean. Conserves to round-off.

    Accuracy: that of the operators; the correction of the mass is of the size of their error.
    Differentiable: in every array, forward and reverse.
    Raises:
        ValueError: a velocity without a gradient, neither laplacian nor velocity, a diffusivity
            whose shape fits neither points nor species, `mass` with boundary conditions.

    Example:
        >>> cloud = js.sphere(500)
        >>> u0 = cloud.points[:, 2]
        >>> problem = js.AdvectionDiffusionReaction(js.laplace_beltrami(cloud), diffusivity=0.5)
        >>> u = js.integrate(problem, u0, t1=1.0).ys[-1]
        >>> bool(jnp.abs(u - jnp.exp(-1.0) * u0).max() < 0.01)
        True
    """

    laplacian: AbstractOperator | None
    diffusivity: InTime
    advection: AbstractOperator | None
    gradient: Stencil | None
    velocity: Callable | None
    reaction: Callable | None
    conservative: bool = eqx.field(static=True)
    stabilization: AbstractOperator | None
    conditions: Closure | None
    mass: Float[Array, " n"] | None

    def __init__(
        self,
        laplacian: AbstractOperator | None = None,
        *,
        diffusivity: InTime = 1.0,
        gradient: Stencil | None = None,
        velocity: InTime | None = None,
        reaction: Callable | None = None,
        conservative: bool = True,
        stabilization: AbstractOperator | None = None,
        conditions: Closure | None = None,
        mass: Float[Array, " n"] | None = None,
    ):
        if laplacian is None and velocity is None:
            raise ValueError("neither a laplacian nor a velocity: nothing moves the field")
        n = check_operator(laplacian, "laplacian")
        n = check_operator(gradient, "gradient", n, out=None)
        check_operator(stabilization, "stabilization", n)
        check_closure(conditions, n)
        on = _known_active(laplacian, gradient, stabilization)
        self.laplacian = laplacian
        self.diffusivity = coefficient(diffusivity, "diffusivity", 0, on)
        self.reaction, self.stabilization = function(reaction, "reaction"), stabilization
        self.conservative, self.conditions = bool(conservative), conditions
        self.mass = check_mass(mass, conditions, n, on)
        self.advection, self.gradient, self.velocity = None, None, None
        if velocity is not None:
            if gradient is None:
                raise ValueError("a velocity needs the surface gradient, pass `gradient`")
            instance(gradient, Stencil, "gradient", "from js.surface_gradient")
            if callable(velocity):
                self.gradient, self.velocity = gradient, velocity
            else:  # one stencil of scalars does the work of d
                self.advection = _along(gradient, velocity, conservative)

    @property
    def moving(self) -> bool:
        """True with a velocity."""
        return self.advection is not None or self.velocity is not None

    @property
    def diffusive(self):
        return self.laplacian is not None

    @property
    def contractive(self):
        compressed = self.moving and self.conservative
        return self.reaction is None and self.conditions is None and not compressed

    def linear(self, t, u):
        if self.laplacian is None:
            return jnp.zeros_like(u)
        return _balanced(
            _diffused(self.laplacian, _at(self.diffusivity, "diffusivity", t), u), self.mass
        )

    def rest(self, t, u, args):
        rate = jnp.zeros_like(u)
        if self.advection is not None:
            rate = rate - self.advection(u)
        if self.velocity is not None and self.gradient is not None:
            v = user(self.velocity, "velocity", t)
            rate = rate - _advected(self.gradient, v, u, self.conservative)
        if self.stabilization is not None:
            rate = rate + self.stabilization(u)
        rate = _balanced(rate, self.mass if self.conservative else None)
        if self.reaction is not None:
            rate = rate + _same_shape(user(self.reaction, "reaction", t, u, args), u, "reaction")
        return rate


class BiharmonicDiffusion(AbstractEvolution):
    r"""Diffusion of fourth order, $\partial_t u = -\kappa\,\Delta_S^2 u + f(t, u)$.

    Args:
        laplacian: the Laplace–Beltrami operator; it is applied twice.
        stiffness: κ in units of length⁴ / time, a number.
        reaction: `(t, u, args) -> f`; None for none.
        conditions: from `close` or `with_ghosts`, for u and, with zero data, for its
            Laplacian; None for closed surfaces.
        mass: weights m, `(n,)`: $\sum_i m_i u_i$ is then conserved to round-off.

    Accuracy: on scattered points two orders below the Laplacian's.
    Differentiable: in every array, forward and reverse.
    Raises:
        ValueError: `mass` with boundary conditions.

    Example:
        >>> cloud = js.sphere(300)
        >>> u0 = cloud.points[:, 2]
        >>> problem = js.BiharmonicDiffusion(js.laplace_beltrami(cloud), stiffness=0.1)
        >>> rate = problem.rate(0.0, u0, None)  # of u = z, with eigenvalue -2
        >>> bool(jnp.abs(rate + 0.4 * u0).max() < 0.1)
        True
    """

    laplacian: AbstractOperator
    stiffness: ArrayLike
    reaction: Callable | None
    conditions: Closure | None
    mass: Float[Array, " n"] | None

    def __init__(
        self,
        laplacian: AbstractOperator,
        *,
        stiffness: ArrayLike = 1.0,
        reaction: Callable | None = None,
        conditions: Closure | None = None,
        mass: Float[Array, " n"] | None = None,
    ):
        n = check_operator(laplacian, "laplacian", needed=True)
        check_closure(conditions, n)
        self.laplacian, self.conditions = laplacian, conditions
        self.stiffness = number(stiffness, "stiffness", 0)
        self.reaction = function(reaction, "reaction")
        self.mass = check_mass(mass, conditions, n, laplacian.active)

    @property
    def diffusive(self):
        return True

    @property
    def contractive(self):
        return self.reaction is None and self.conditions is None

    def linear(self, t, u):
        inner = _homogeneous(self.conditions, self.laplacian(u))
        return _balanced(self.laplacian(inner) * -jnp.asarray(self.stiffness), self.mass)

    def rest(self, t, u, args):
        if self.reaction is None:
            return jnp.zeros_like(u)
        return _same_shape(user(self.reaction, "reaction", t, u, args), u, "reaction")


class CahnHilliard(AbstractEvolution):
    r"""Separation of two phases, $\partial_t u = M\,\Delta_S(W'(u) - \epsilon^2\,\Delta_S u)$.

    $W = (u^2 - 1)^2 / 4$ by default: the phases are u = ±1, the interface is some $4\epsilon$
    wide. For implicit steps the linear part is $M\,\Delta_S(s\,u - \epsilon^2\Delta_S u)$ with
    $s = 2 \ge W''/1$ in the phases, so that what is left to explicit steps does not stiffen.

    Args:
        laplacian: the Laplace–Beltrami operator.
        width: ε, in units of length.
        mobility: M, in units of length² / time.
        potential: W', a function of u.
        splitting: s.
        conditions: no-flux conditions from `close` or `with_ghosts`, for u and the chemical
            potential; None for closed surfaces.
        mass: weights m, `(n,)`: $\sum_i m_i u_i$ is then conserved to round-off.

    Differentiable: in every array, forward and reverse.
    Raises:
        ValueError: `mass` with boundary conditions.

    Example:
        >>> laplacian = js.laplace_beltrami(js.sphere(300))
        >>> problem = js.CahnHilliard(laplacian, width=0.2)
        >>> bool(jnp.abs(problem.rate(0.0, jnp.ones(300), None)).max() < 1e-9)  # a phase stays
        True
    """

    laplacian: AbstractOperator
    width: ArrayLike
    mobility: ArrayLike
    potential: Callable
    splitting: ArrayLike
    conditions: Closure | None
    mass: Float[Array, " n"] | None

    def __init__(
        self,
        laplacian: AbstractOperator,
        *,
        width: ArrayLike,
        mobility: ArrayLike = 1.0,
        potential: Callable = lambda u: u**3 - u,
        splitting: ArrayLike = 2.0,
        conditions: Closure | None = None,
        mass: Float[Array, " n"] | None = None,
    ):
        n = check_operator(laplacian, "laplacian", needed=True)
        check_closure(conditions, n)
        if function(potential, "potential") is None:
            raise TypeError("potential is None, expected a function of u")
        self.laplacian, self.conditions, self.potential = laplacian, conditions, potential
        self.width = number(width, "width", 0)
        self.mobility = number(mobility, "mobility", 0)
        self.splitting = number(splitting, "splitting", 0)
        self.mass = check_mass(mass, conditions, n, laplacian.active)

    @property
    def diffusive(self):
        return True

    def _driven(self, potential):
        potential = _homogeneous(self.conditions, potential)
        return _balanced(self.laplacian(potential) * jnp.asarray(self.mobility), self.mass)

    def linear(self, t, u):
        return self._driven(self.splitting * u - self.width**2 * self.laplacian(u))

    def rest(self, t, u, args):
        return self._driven(self._force(u) - self.splitting * u)

    def rate(self, t, u, args):
        # In one pass: two applications of the Laplacian, not three.
        u = self.closed(t, u)
        return self._free(self._driven(self._force(u) - self.width**2 * self.laplacian(u)))

    def _force(self, u):
        return _same_shape(user(self.potential, "potential", u), u, "potential")


class WaveEquation(AbstractEvolution):
    r"""Waves, $\partial_t^2 u + \gamma\,\partial_t u = c^2\,\Delta_S u + f(t, u)$.

    The state is the pair $(u, \partial_t u)$, each of shape `(n,)` or `(n, k)`.

    Args:
        laplacian: the Laplace–Beltrami operator or $\nabla\cdot(A\,\nabla\,\cdot)$.
        speed: c in units of length / time: a number, `(n,)`, or a function of time that
            returns one of these.
        damping: γ in units of 1 / time: a number, `(n,)`, or a function of time.
        forcing: `(t, u, args) -> f`; None for none.
        stabilization: an operator that acts on $\partial_t u$, added to the right-hand side:
            `hyperviscosity` where waves near the spacing of the points grow.
        conditions: from `close` or `with_ghosts`; None for closed surfaces.

    Differentiable: in every array, forward and reverse.

    Example:
        >>> cloud = js.sphere(500)
        >>> z = cloud.points[:, 2]
        >>> problem = js.WaveEquation(js.laplace_beltrami(cloud))
        >>> u, _ = js.integrate(problem, (z, 0 * z), t1=1.0, rtol=1e-6).ys
        >>> bool(jnp.abs(u[-1] - jnp.cos(jnp.sqrt(2.0)) * z).max() < 0.01)
        True
    """

    laplacian: AbstractOperator
    speed: InTime
    damping: InTime
    forcing: Callable | None
    stabilization: AbstractOperator | None
    conditions: Closure | None

    def __init__(
        self,
        laplacian: AbstractOperator,
        *,
        speed: InTime = 1.0,
        damping: InTime = 0.0,
        forcing: Callable | None = None,
        stabilization: AbstractOperator | None = None,
        conditions: Closure | None = None,
    ):
        n = check_operator(laplacian, "laplacian", needed=True)
        check_operator(stabilization, "stabilization", n)
        check_closure(conditions, n)
        self.laplacian, self.stabilization, self.conditions = laplacian, stabilization, conditions
        on = laplacian.active
        self.speed = coefficient(speed, "speed", on=on)
        self.damping = coefficient(damping, "damping", on=on)
        self.forcing = function(forcing, "forcing")

    def closed(self, t, u):
        if self.conditions is None:
            return u
        value, velocity = u
        # The bound velocities are the derivatives of the bound values in time.
        fill = lambda t, value: self.conditions(value, t)
        t = jnp.asarray(t, value.dtype)
        return jax.jvp(fill, (t, value), (jnp.ones_like(t), velocity))

    def linear(self, t, u):
        value, velocity = u
        speed = _per_point(_at(self.speed, "speed", t), value)
        return velocity, speed**2 * self.laplacian(value)

    def rest(self, t, u, args):
        value, velocity = u
        rate = -_per_point(_at(self.damping, "damping", t), velocity) * velocity
        if self.stabilization is not None:
            rate = rate + self.stabilization(velocity)
        if self.forcing is not None:
            rate = rate + _same_shape(
                user(self.forcing, "forcing", t, value, args), value, "forcing"
            )
        return jnp.zeros_like(value), rate


# --- pieces --------------------------------------------------------------------------------


def _known_active(*parts) -> Bool[Array | np.ndarray, " n"] | None:
    """What the first operator among them that knows says."""
    known = [part.active for part in parts if isinstance(part, AbstractOperator)]
    return next((active for active in known if active is not None), None)


def _at(value: InTime, name: str, t):
    return user(value, name, t) if callable(value) else value


def _add(a: PyTree, b: PyTree) -> PyTree:
    return jax.tree.map(jnp.add, a, b)


def _per_point(values: ArrayLike, field: Array, keep: int = 0) -> Array:
    """Values `(n, *rest)`, `rest` of `keep` axes, with axes inserted to go with a field."""
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


def _diffused(laplacian: AbstractOperator, diffusivity: ArrayLike, u: Field) -> Field:
    r"""$\nabla\cdot(D\,\nabla u)$ from the Laplacian alone.

    For D in space, $\tfrac12 (D\,\Delta u + \Delta(D u) - u\,\Delta D)$: the Laplacian's weights
    times the mean of D at both ends, as in `diffusion`.
    """
    d = jnp.asarray(diffusivity)
    if d.ndim == 0 or (u.ndim == 2 and d.shape == u.shape[1:]):
        return d * laplacian(u)
    if (
        d.shape[0] != u.shape[0]
        or d.ndim > 2
        or (d.ndim == 2 and d.shape[1] not in (1, *u.shape[1:]))
    ):
        raise ValueError(
            f"diffusivity has shape {d.shape}: with fields {u.shape} it is a number, one per "
            "species, one per point, or both"
        )
    d = _per_point(d, u) if d.ndim == 1 else d if u.ndim == 2 else d[:, 0]
    return 0.5 * (d * laplacian(u) + laplacian(d * u) - u * laplacian(d))


def _balanced(rate: Field, mass) -> Field:
    """The rate nearest to the one given, in the norm of these weights, that keeps the mass."""
    if mass is None:
        return rate
    return rate - jnp.tensordot(mass / jnp.sum(mass), rate, axes=1)


def _homogeneous(conditions, u: Field) -> Field:
    return u if conditions is None else conditions.homogeneous(u)


def _same_shape(value, u: Field, name: str) -> Array:
    value = as_float(value, f"what {name} returns")
    if value.shape != u.shape:
        raise ValueError(f"{name} returns shape {value.shape}, the field has {u.shape}")
    return value


def _along(gradient: Stencil, velocity, conservative: bool) -> Stencil:
    r"""$u \mapsto \nabla\cdot(v\,u)$ or $v\cdot\nabla u$ as one stencil."""
    v = _checked_velocity(velocity, gradient)
    v = jnp.moveaxis(take(v, gradient.indices), -1, 1) if conservative else v.T[None]
    weights = jnp.sum(gradient.weights * v, axis=1)
    known = (gradient.diagnostics, gradient.border, gradient.active)
    return Stencil(gradient.indices, weights, (), (), *known)


def _advected(gradient: Stencil, velocity, u: Field, conservative: bool) -> Field:
    v = _per_point(_checked_velocity(velocity, gradient), u[..., None], keep=1)
    if conservative:
        divergence = divergence_of(gradient)
        return divergence(u[..., None] * v)
    return jnp.sum(gradient(u) * v, axis=-1)


def _checked_velocity(velocity, gradient: Stencil) -> Array:
    velocity, want = as_float(velocity, "velocity"), (gradient.n, *gradient.out_shape)
    if velocity.shape != want:
        raise ValueError(f"velocity has shape {velocity.shape}, expected {want}")
    return switched_off(gradient.active, finite(velocity, "velocity", gradient.active))
