r"""Equations of fourth order in space, or of second order in time."""

from __future__ import annotations

from collections.abc import Callable

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from ..arguments import traced_call as user
from ..boundary import Closure
from ..stencils.algebra import AbstractOperator
from .coefficients import (
    InTime,
    check_closure,
    check_mass,
    check_operator,
    coefficient,
    function,
    number,
)
from .implicit import IMEX
from .problem import AbstractEvolution, at_time, balanced, homogeneous, per_point, same_shape


class _FourthOrder(AbstractEvolution):
    """What equations with the Laplacian applied twice have in common."""

    laplacian: eqx.AbstractVar[AbstractOperator]

    @property
    def diffusive(self):
        return True

    @property
    def n(self):
        return self.laplacian.n

    def suggested_solver(self):
        return IMEX(order=3), "IMEX(order=3): fourth order in space is too stiff for explicit steps"


class BiharmonicDiffusion(_FourthOrder):
    r"""Diffusion of fourth order, $\partial_t u = -\kappa\,\Delta_S^2 u + f(t, u)$.

    Args:
        laplacian: the Laplace–Beltrami operator; it is applied twice.
        stiffness: κ in units of length⁴ / time, a number.
        reaction: `(t, u, args) -> f`; None for none.
        closure: from `eliminate` or `with_ghosts`, for u and, with zero data, for its
            Laplacian; None for closed surfaces.
        mass: weights m, `(n,)`: $\sum_i m_i u_i$ is then conserved to round-off.

    Accuracy: on scattered points two orders below the Laplacian's. In float32 within 1e-3 of the
    exponential (`tests/test_time_forms.py`).
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
    closure: Closure | None
    mass: Float[Array, " n"] | None

    def __init__(
        self,
        laplacian: AbstractOperator,
        *,
        stiffness: ArrayLike = 1.0,
        reaction: Callable | None = None,
        closure: Closure | None = None,
        mass: Float[Array, " n"] | None = None,
    ):
        n = check_operator(laplacian, "laplacian", needed=True)
        check_closure(closure, n)
        self.laplacian, self.closure = laplacian, closure
        self.stiffness = number(stiffness, "stiffness", 0)
        self.reaction = function(reaction, "reaction")
        self.mass = check_mass(mass, closure, n, laplacian.active)

    @property
    def contractive(self):
        return self.reaction is None and self.closure is None

    def factors(self, g, u0):
        return jnp.full(2, jnp.sqrt(g * self.stiffness))

    def linear(self, t, u):
        inner = homogeneous(self.closure, self.laplacian(u))
        return balanced(self.laplacian(inner) * -jnp.asarray(self.stiffness), self.mass)

    def rest(self, t, u, args):
        if self.reaction is None:
            return jnp.zeros_like(u)
        return same_shape(user(self.reaction, "reaction", t, u, args), u, "reaction")


class CahnHilliard(_FourthOrder):
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
        closure: no-flux conditions from `eliminate` or `with_ghosts`, for u and the chemical
            potential; None for closed surfaces.
        mass: weights m, `(n,)`: $\sum_i m_i u_i$ is then conserved to round-off.

    Accuracy: in float32 within 1e-3 of double precision (`tests/test_time_forms.py`).
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
    closure: Closure | None
    mass: Float[Array, " n"] | None

    def __init__(
        self,
        laplacian: AbstractOperator,
        *,
        width: ArrayLike,
        mobility: ArrayLike = 1.0,
        potential: Callable = lambda u: u**3 - u,
        splitting: ArrayLike = 2.0,
        closure: Closure | None = None,
        mass: Float[Array, " n"] | None = None,
    ):
        n = check_operator(laplacian, "laplacian", needed=True)
        check_closure(closure, n)
        if function(potential, "potential") is None:
            raise TypeError("potential is None, expected a function of u")
        self.laplacian, self.closure, self.potential = laplacian, closure, potential
        self.width = number(width, "width", 0)
        self.mobility = number(mobility, "mobility", 0)
        self.splitting = number(splitting, "splitting", 0)
        self.mass = check_mass(mass, closure, n, laplacian.active)

    def factors(self, g, u0):
        r"""$1 - s\,\Delta + q\,\Delta^2$ with $s = g M s_0$, $q = g M \epsilon^2$."""
        total, product = g * self.mobility * self.splitting, g * self.mobility * self.width**2
        # Complex factors have the modulus √q.
        half = jnp.sqrt(jnp.maximum((total / 2) ** 2 - product, 0))
        large = jnp.maximum(total / 2 + half, jnp.sqrt(product))
        return jnp.stack([large, product / jnp.where(large > 0, large, 1)])

    def _driven(self, potential):
        potential = homogeneous(self.closure, potential)
        return balanced(self.laplacian(potential) * jnp.asarray(self.mobility), self.mass)

    def linear(self, t, u):
        return self._driven(self.splitting * u - self.width**2 * self.laplacian(u))

    def rest(self, t, u, args):
        return self._driven(self._force(u) - self.splitting * u)

    def rate(self, t, u, args):
        # In one pass: two applications of the Laplacian, not three.
        u = self.closed(t, u)
        return self._free(self._driven(self._force(u) - self.width**2 * self.laplacian(u)))

    def _force(self, u):
        return same_shape(user(self.potential, "potential", u), u, "potential")


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
        closure: from `eliminate` or `with_ghosts`; None for closed surfaces.

    Accuracy: in float32 within 1e-3 of the exponential (`tests/test_time_forms.py`).
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
    closure: Closure | None

    def __init__(
        self,
        laplacian: AbstractOperator,
        *,
        speed: InTime = 1.0,
        damping: InTime = 0.0,
        forcing: Callable | None = None,
        stabilization: AbstractOperator | None = None,
        closure: Closure | None = None,
    ):
        n = check_operator(laplacian, "laplacian", needed=True)
        check_operator(stabilization, "stabilization", n)
        check_closure(closure, n)
        self.laplacian, self.stabilization, self.closure = laplacian, stabilization, closure
        on = laplacian.active
        self.speed = coefficient(speed, "speed", on=on)
        self.damping = coefficient(damping, "damping", on=on)
        self.forcing = function(forcing, "forcing")

    @property
    def n(self):
        return self.laplacian.n

    def suggested_solver(self):
        return dfx.Tsit5(), "Tsit5: waves are not stiff"

    def closed(self, t, u):
        if self.closure is None:
            return u
        value, velocity = u
        # The bound velocities are the derivatives of the bound values in time.
        fill = lambda t, value: self.closure(value, t)
        t = jnp.asarray(t, value.dtype)
        return jax.jvp(fill, (t, value), (jnp.ones_like(t), velocity))

    def dilution(self, u, divergence):
        """Of the velocity alone: Suchde and Kuhnert 2019, eq. 42."""
        value, velocity = u
        return jnp.zeros_like(value), -per_point(divergence, velocity) * velocity

    def linear(self, t, u):
        value, velocity = u
        speed = per_point(at_time(self.speed, "speed", t), value)
        return velocity, speed**2 * self.laplacian(value)

    def rest(self, t, u, args):
        value, velocity = u
        rate = -per_point(at_time(self.damping, "damping", t), velocity) * velocity
        if self.stabilization is not None:
            rate = rate + self.stabilization(velocity)
        if self.forcing is not None:
            rate = rate + same_shape(
                user(self.forcing, "forcing", t, value, args), value, "forcing"
            )
        return jnp.zeros_like(value), rate
