r"""Advection, diffusion and reaction."""

from __future__ import annotations

from collections.abc import Callable

import diffrax as dfx
import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from ..arguments import as_float, finite, flag, instance, switched_off
from ..arguments import traced_call as user
from ..boundary import Closure
from ..compiling import at_once
from ..failures import is_concrete, raise_at
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
)
from .explicit import RKC2
from .implicit import IMEX
from .problem import (
    AbstractEvolution,
    Field,
    at_time,
    balanced,
    known_active,
    per_point,
    same_shape,
)

_UNDAMPED = (
    "without diffusion or damping short waves may grow on scattered points: see "
    "`stabilization=`, `hyperviscosity` and `upwind_viscosity`"
)


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
        velocity: tangential, `(n, d)`, or a function of time that returns one; in the conservative
            form that is checked, of a function at both ends.
        reaction: `(t, u, args) -> f`, of the shape of u; None for none.
        conservative: the form above; if False $v\cdot\nabla u$ in place of $\nabla\cdot(v\,u)$.
        stabilization: an operator added to the right-hand side, that damps what advection
            cannot resolve: `hyperviscosity` or `upwind_viscosity`.
        closure: from `eliminate` or `with_ghosts`; None for closed surfaces.
        mass: weights m, `(n,)`. If given, transport is corrected by the smallest change that
            keeps $\sum_i m_i u_i$: a shift of the rate by its mean. Conserves to round-off, where a
            surface moves to the accuracy of the operators.

    Accuracy: that of the operators; the correction of the mass is of the size of their error. In
    float32 values are within 1e-3 and derivatives within 1e-2 at the default tolerances
    (`tests/test_time_pde.py`).
    Differentiable: in every array, forward and reverse.
    Raises:
        ValueError: a velocity without a gradient, or with a normal part; neither laplacian nor
            velocity; a diffusivity whose shape fits neither points nor species, `mass` with
            boundary conditions. From `integrate`: minus a Laplacian.

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
    velocity: InTime | None
    reaction: Callable | None
    conservative: bool = eqx.field(static=True)
    stabilization: AbstractOperator | None
    closure: Closure | None
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
        closure: Closure | None = None,
        mass: Float[Array, " n"] | None = None,
    ):
        if laplacian is None and velocity is None:
            raise ValueError("neither a laplacian nor a velocity: nothing moves the field")
        n = check_operator(laplacian, "laplacian")
        n = check_operator(gradient, "gradient", n, out=None)
        check_operator(stabilization, "stabilization", n)
        check_closure(closure, n)
        on = known_active(laplacian, gradient, stabilization)
        self.laplacian = laplacian
        self.diffusivity = coefficient(diffusivity, "diffusivity", 0, on)
        self.reaction, self.stabilization = function(reaction, "reaction"), stabilization
        self.conservative, self.closure = flag(conservative, "conservative"), closure
        self.mass = check_mass(mass, closure, n, on)
        self.advection, self.gradient, self.velocity = None, None, None
        if velocity is not None:
            if gradient is None:
                raise ValueError("a velocity needs the surface gradient, pass `gradient`")
            instance(gradient, Stencil, "gradient", "from js.surface_gradient")
            self.gradient, self.velocity = gradient, velocity
            if not callable(velocity):  # one stencil of scalars does the work of d
                self.velocity = _checked_velocity(velocity, gradient)
                if conservative:
                    _check_tangential(self.velocity, gradient)
                self.advection = _along(gradient, self.velocity, conservative)

    @property
    def moving(self) -> bool:
        """True with a velocity."""
        return self.velocity is not None

    diffusive = property(lambda self: self.laplacian is not None)

    @property
    def contractive(self):
        compressed = self.moving and self.conservative
        return self.reaction is None and self.closure is None and not compressed

    @property
    def _grows(self):
        known = self.advection is not None and self.conservative
        if not known or self.reaction is not None or self.closure is not None:
            return super()._grows
        assert self.advection is not None and self.gradient is not None
        one = jnp.ones(self.n, self.gradient.weights.dtype)
        return jnp.max(jnp.abs(self.advection(one)))  # that of the divergence

    @property
    def n(self):
        return next(op.n for op in (self.laplacian, self.gradient) if op is not None)

    @property
    def caution(self):
        undamped = self.laplacian is None and self.stabilization is None
        return _UNDAMPED if undamped else None

    def check(self, t):
        if callable(self.velocity) and self.conservative and self.gradient is not None:
            v = _checked_velocity(user(self.velocity, "velocity", t), self.gradient)
            _check_tangential(v, self.gradient)
        if self.laplacian is None:
            return
        if isinstance(self.laplacian, Stencil) and is_concrete(self.laplacian.weights):
            with at_once():  # also within something that is traced
                mean = float(np.mean(np.asarray(self.laplacian.diagonal)))
            if mean > 0:
                raise ValueError(
                    f"the diagonal of `laplacian` has the mean {mean:.3g}, expected one below 0: "
                    "this is minus a Laplacian, and diffusion by it has no solution"
                )
        if not callable(self.diffusivity):
            return
        values = user(self.diffusivity, "diffusivity", t)
        if is_concrete(values) and not (np.asarray(values) >= 0).all():
            raise ValueError(
                f"diffusivity is {np.min(values):g} at t = {float(t):g}, expected at least 0"
            )

    def suggested_solver(self):
        if self.laplacian is None:
            note = f"; {self.caution}" if self.caution else ""
            return dfx.Tsit5(), f"Tsit5: advection is not stiff{note}"
        if self.moving:
            return IMEX(order=3), "IMEX(order=3): advection explicit, diffusion implicit"
        return RKC2(), "RKC2: diffusion, by explicit steps with many stages"

    def factors(self, g, u0):
        """With the mean of a diffusivity in space, that at t = 0 of one in time."""
        if self.laplacian is None:
            return None
        d = jnp.asarray(at_time(self.diffusivity, "diffusivity", 0.0))
        species = u0.shape[1:]
        each = species and d.shape[-1:] == species
        d = d.reshape(-1, *species) if each else d
        on = None
        if self.active is not None and d.shape[:1] == self.active.shape:
            on = self.active.reshape(-1, *[1] * (d.ndim - 1))
        return g * jnp.mean(d, axis=0 if each else None, where=on)[None]

    def linear(self, t, u):
        if self.laplacian is None:
            return jnp.zeros_like(u)
        return balanced(
            _diffused(self.laplacian, at_time(self.diffusivity, "diffusivity", t), u), self.mass
        )

    def rest(self, t, u, args):
        rate = jnp.zeros_like(u)
        if self.advection is not None:
            rate = rate - self.advection(u)
        elif callable(self.velocity) and self.gradient is not None:
            v = user(self.velocity, "velocity", t)
            rate = rate - _advected(self.gradient, v, u, self.conservative)
        if self.stabilization is not None:
            rate = rate + self.stabilization(u)
        rate = balanced(rate, self.mass if self.conservative else None)
        if self.reaction is not None:
            rate = rate + same_shape(user(self.reaction, "reaction", t, u, args), u, "reaction")
        return rate


# --- pieces --------------------------------------------------------------------------------


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
    d = per_point(d, u) if d.ndim == 1 else d if u.ndim == 2 else d[:, 0]
    return 0.5 * (d * laplacian(u) + laplacian(d * u) - u * laplacian(d))


def _along(gradient: Stencil, velocity, conservative: bool) -> Stencil:
    r"""$u \mapsto \nabla\cdot(v\,u)$ or $v\cdot\nabla u$ as one stencil."""
    v = velocity
    v = jnp.moveaxis(take(v, gradient.indices), -1, 1) if conservative else v.T[None]
    return gradient.of_weights(jnp.sum(gradient.weights * v, axis=1))


def _advected(gradient: Stencil, velocity, u: Field, conservative: bool) -> Field:
    v = per_point(_checked_velocity(velocity, gradient), u[..., None], keep=1)
    if conservative:
        return divergence_of(gradient)(u[..., None] * v)
    return jnp.sum(gradient(u) * v, axis=-1)


# The sine of the angle that velocities may be off the tangent plane: 3 degrees at the fastest.
_OFF = 0.05


def _check_tangential(velocity, gradient: Stencil) -> None:
    """A divergence sees what is normal in a velocity, which is none of a surface at rest."""
    if not is_concrete(velocity, gradient.weights):
        return
    weights, velocity = np.nan_to_num(np.asarray(gradient.weights)), np.asarray(velocity)
    # Rows of a gradient are tangential, those of DC-PSE nearly; in a plane nothing is normal.
    sizes, axes = np.linalg.eigh(np.einsum("kin,kjn->nij", weights, weights))
    normal = np.abs(np.einsum("ni,ni->n", velocity, axes[:, :, 0]))
    most = _OFF * np.linalg.norm(velocity, axis=1).max()
    raise_at(
        (normal > most) & (sizes[:, 0] < 0.2 * sizes[:, 1]),
        f"the velocity at point {{i}} has the normal part {{v:.3g}}, expected at most {most:.3g}: "
        "that of a surface at rest is tangential. Take the normal part away, or take "
        "conservative=False, which does not see it",
        normal,
    )


def _checked_velocity(velocity, gradient: Stencil) -> Array:
    velocity = as_float(velocity, "velocity", (gradient.n, *gradient.out_shape))
    return switched_off(gradient.active, finite(velocity, "velocity", gradient.active))
