r"""Runge–Kutta–Chebyshev: explicit steps whose stable length grows with the square of the work."""

from __future__ import annotations

from typing import ClassVar, NamedTuple, get_args

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, Int, PyTree

from ..arguments import real, whole
from ..functions import numbers_as_arrays
from .chebyshev import End, Loop, Radius, Step
from .states import dtype_of, zeros_like_result

# Steps between two estimates of the spectral radius, applications in the first and in later ones.
_REFRESH, _FIRST, _LATER = 25, 20, 4
# The age of an estimate before there is one.
_UNKNOWN = -1


class _State(NamedTuple):
    """What one step hands to the next.

    Args:
        rate: right-hand side at the current state; of none before the first step.
        radius: estimate of the spectral radius of its Jacobian.
        direction: field that the Jacobian stretches most.
        age: steps since the estimate; -1 before the first.
    """

    rate: PyTree[Array]
    radius: Float[Array, ""]
    direction: PyTree[Array]
    age: Int[Array, ""]


class RKC2(dfx.AbstractAdaptiveSolver):
    r"""Runge–Kutta–Chebyshev method of second order with as many stages as stability asks for.

    With s stages a step is stable for eigenvalues in $[-0.65\,s^2/\Delta t, 0]$ and a thin strip
    around it: s explicit stages do the work of $s^2/4$ stages of a common explicit method.
    For diffusion, of any even order, without strong advection. A diffrax solver:
    pass it to `js.integrate` or to `diffrax.diffeqsolve` with an `ODETerm`.

    $s = 1 + \lfloor\sqrt{1 + 1.54\,\Delta t\,\rho}\rfloor$ follows from the step and the spectral
    radius ρ of the right-hand side's Jacobian. The number of stages is a value, not a shape:
    nothing is compiled again when it changes.

    Args:
        spectral_radius: ρ, or a bound of it; if None, estimated by power iterations at the
            first step and again every 25 steps, with a margin of 20 per cent.
        max_stages: the largest s. A step that needs more is refused: an adaptive controller
            shortens it, with a constant step the integration stops with a result code.
        loop: how the loop over stages is differentiated: `"checkpointed"` in reverse mode,
            `"lax"` in forward mode (with `diffrax.ForwardMode`), `"bounded"` in both (with
            `diffrax.DirectAdjoint`). `js.integrate` sets it.

    Accuracy: second order; the embedded estimate of the local error is of third order
    (`tests/test_time_explicit.py`). In float32 values are within 1e-3 and derivatives within 1e-2
    at the default tolerances (`tests/test_time_pde.py`).
    Differentiable: forward and reverse, in the state and everything the right-hand side
    depends on. The number of stages and ρ are not differentiated.
    Raises:
        ValueError: fewer than two stages allowed.
    Source: Sommeijer, Shampine and Verwer, RKC: an explicit solver for parabolic PDEs,
        J. Comput. Appl. Math. 88 (1998), Section 2.

    Example:
        >>> laplacian = js.laplace_beltrami(js.sphere(500))
        >>> import diffrax
        >>> term = diffrax.ODETerm(lambda t, u, args: laplacian(u))
        >>> z = js.sphere(500).points[:, 2]
        >>> u = diffrax.diffeqsolve(term, js.RKC2(), 0.0, 0.5, 0.05, z).ys[0]
        >>> bool(jnp.abs(u - jnp.exp(-1.0) * z).max() < 0.01)
        True
    """

    spectral_radius: ArrayLike | None
    max_stages: int = eqx.field(static=True)
    loop: Loop = eqx.field(static=True)

    term_structure: ClassVar = dfx.AbstractTerm
    interpolation_cls: ClassVar = dfx.ThirdOrderHermitePolynomialInterpolation

    def __init__(
        self,
        spectral_radius: ArrayLike | None = None,
        max_stages: int = 200,
        loop: Loop = "checkpointed",
    ):
        if spectral_radius is not None:
            spectral_radius = numbers_as_arrays(real(spectral_radius, "spectral_radius", above=0))
        if loop not in get_args(Loop):
            raise ValueError(f"loop = {loop!r}, expected one of {', '.join(get_args(Loop))}")
        self.spectral_radius, self.loop = spectral_radius, loop
        self.max_stages = whole(max_stages, "max_stages", least=2)

    def order(self, terms):
        return 2

    def error_order(self, terms):
        return 3

    @property
    def reach(self) -> float:
        """Longest stable step, times the spectral radius."""
        return (self.max_stages - 1) ** 2 / 1.54 - 1

    def func(self, terms, t0, y0, args):
        return terms.vf(t0, y0, args)

    def init(self, terms, t0, t1, y0, args):
        # The first step finds it, where all others do.
        rate = zeros_like_result(lambda: terms.vf(t0, y0, args))
        radius, direction = self.spectral_radius, None
        if radius is None:
            radius, direction = 0, jax.tree.map(_noise, y0)
        return _State(
            rate, jnp.asarray(radius, dtype_of(y0)), direction, jnp.asarray(_UNKNOWN, jnp.int32)
        )

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        span = terms.contr(t0, t1)
        weigh = lambda rate: terms.prod(rate, span)
        rate = lambda c, y: terms.vf(t0 + c * (t1 - t0), y, args)
        step = Step(rate, weigh, y0, solver_state.rate, self.max_stages)
        fresh = jnp.asarray(made_jump) | (solver_state.age == _UNKNOWN)
        end = step(t1 - t0, self._known(solver_state), fresh, self.loop)
        k0, k1 = weigh(end.rate0), weigh(end.rate)
        y1, enough = end.y, end.enough
        error = jax.tree.map(lambda a, b, p, q: 0.8 * (a - b) + 0.4 * (p + q), y0, y1, k0, k1)
        error = jax.tree.map(lambda e: jnp.where(enough, e, jnp.inf), error)
        result = dfx.RESULTS.where(enough, dfx.RESULTS.successful, dfx.RESULTS.nonlinear_divergence)
        dense = dict(y0=y0, y1=y1, k0=k0, k1=k1)
        return y1, error, dense, self._later(solver_state, end), result

    def _known(self, state: _State) -> Radius:
        if self.spectral_radius is not None:
            return Radius(state.radius)
        later = jnp.where(state.age < _REFRESH, 0, _LATER)
        turns = jnp.where(state.age == _UNKNOWN, _FIRST, later)
        return Radius(state.radius, state.direction, turns)

    def _later(self, state: _State, end: End) -> _State:
        age = state.age
        if self.spectral_radius is None:
            age = jnp.where(jnp.asarray(end.radius.turns) > 0, 0, age)
        return _State(end.rate, end.radius.value, end.radius.direction, age + 1)


def _noise(y: Array) -> Array:
    return jnp.asarray(np.random.default_rng(0).normal(size=y.shape), y.dtype)
