r"""Implicit Runge–Kutta steps without matrices: every linear system by a Krylov method."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, ClassVar

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
from jaxtyping import Array, ArrayLike, PyTree

from ..arguments import instance, real, whole
from ..functions import numbers_as_arrays
from .phases import frozen_at
from .relative import relative, tolerance_of
from .states import added, dtype_of, root_mean_square, zeros_like_result

Preconditioner = Callable[[Any], lx.AbstractLinearOperator]


class Tableau(eqx.Module):
    """Coefficients of an additive Runge–Kutta method whose stages are solved one after another.

    Args:
        explicit, implicit: strictly lower matrices.
        diagonal: of the implicit part; all entries but the first, which is zero, are equal.
        nodes: times of the stages, as fractions of the step.
        weights: of the result, a row for each part, explicit and implicit.
        errors: weights of the result minus those of the embedded one.
    """

    explicit: np.ndarray
    implicit: np.ndarray
    diagonal: np.ndarray
    nodes: np.ndarray
    weights: np.ndarray
    errors: np.ndarray

    @property
    def gamma(self) -> float:
        """The share of a step that every implicit stage solves for."""
        return float(self.diagonal[1])

    @classmethod
    def of(cls, explicit: dfx.ButcherTableau, implicit: dfx.ButcherTableau) -> Tableau:
        return cls(
            _lower(explicit.a_lower),
            _lower(implicit.a_lower),
            np.asarray(implicit.a_diagonal),
            np.append(0.0, implicit.c),
            np.stack([explicit.b_sol, implicit.b_sol]),
            np.asarray(implicit.b_error),
        )


def _lower(rows: Sequence[np.ndarray]) -> np.ndarray:
    matrix = np.zeros((len(rows) + 1, len(rows) + 1))
    for i, row in enumerate(rows, 1):
        matrix[i, :i] = row
    return matrix


def _ark2() -> Tableau:
    """Giraldo, Kelly and Constantinescu (2013), eqs. 3.8 and 3.9."""
    root = np.sqrt(2.0)
    gamma, delta = 1 - 1 / root, 1 / (2 * root)
    last = (3 + 2 * root) / 6
    weights = np.array([delta, delta, gamma])
    embedded = np.array([(4 - root) / 8, (4 - root) / 8, delta])
    return Tableau(
        _lower([np.array([2 * gamma]), np.array([1 - last, last])]),
        _lower([np.array([gamma]), np.array([delta, delta])]),
        np.array([0, gamma, gamma]),
        np.array([0, 2 * gamma, 1]),
        np.stack([weights, weights]),
        weights - embedded,
    )


def _euler() -> Tableau:
    """Ascher, Ruuth and Spiteri (1997), Section 2.1; compared with the trapezoidal rule."""
    lower, ends = np.array([[0.0, 0], [1, 0]]), np.array([0.0, 1])
    return Tableau(lower, 0 * lower, ends, ends, np.eye(2), np.array([-0.5, 0.5]))


_IMEX = {
    1: _euler(),
    2: _ark2(),
    3: Tableau.of(*dfx.KenCarp3.tableau.tableaus),
    4: Tableau.of(*dfx.KenCarp4.tableau.tableaus),
}
_SDIRK = {
    order: Tableau.of(tableau, tableau)
    for order, tableau in ((3, dfx.Kvaerno3.tableau), (4, dfx.Kvaerno4.tableau))
}


class _Implicit(dfx.AbstractAdaptiveSolver):
    """What `IMEX` and `SDIRK` are set up with."""

    scheme: int = eqx.field(static=True)
    solver: lx.AbstractLinearSolver | None
    tolerance: ArrayLike | None
    preconditioner: Preconditioner | None

    interpolation_cls: ClassVar = dfx.ThirdOrderHermitePolynomialInterpolation

    def _set(self, order: int, schemes: dict, solver, tolerance, preconditioner):
        if whole(order, "order") not in schemes:
            raise ValueError(f"order = {order}, there are {', '.join(map(str, sorted(schemes)))}")
        if solver is not None:
            instance(solver, lx.AbstractLinearSolver, "solver", "one of lineax, like lx.GMRES(...)")
        if tolerance is not None:
            tolerance = numbers_as_arrays(real(tolerance, "tolerance", above=0, below=1))
        if preconditioner is not None and not callable(preconditioner):
            kind = type(preconditioner).__name__
            raise TypeError(f"preconditioner is a {kind}, expected a function of γ Δt")
        self.scheme, self.solver = order, solver
        self.tolerance, self.preconditioner = tolerance, preconditioner

    def order(self, terms):
        return self.scheme

    def error_order(self, terms):
        return max(self.scheme, 2)  # steps of first order are compared with some of second


class IMEX(_Implicit):
    r"""Implicit–explicit Runge–Kutta steps: the stiff linear part L implicit, the rest explicit.

    Each stage solves $(I - \gamma\,\Delta t\,L)\,y = r$ by a Krylov method on the action of L.
    A diffrax solver for `MultiTerm(ODETerm(rest), ODETerm(linear))`; `js.integrate` makes
    the terms.

    Args:
        order: 1 (Euler's methods, explicit and implicit), 2 (three stages; Giraldo, Kelly and
            Constantinescu 2013), 3 or 4 (four and six stages; Kennedy and Carpenter 2003), each
            with an embedded method of the order next to it. All are L-stable in the implicit part.
        solver: of the linear systems; by default `js.BiCGStab` with this tolerance.
        tolerance: largest residual of a linear system over its right-hand side; by default
            the 0.6th power of the rounding unit, 4e-10 in double precision.
        preconditioner: function of $\gamma\,\Delta t$ that returns an approximate inverse of
            $I - \gamma\,\Delta t\,L$ as a lineax operator; None for small steps.

    Accuracy: of that order in the step where no mode is faster than the steps: more than 0.9,
    1.8, 2.7 and 3.6 (`tests/test_time_implicit.py::test_order_of_steps_that_are_not_stiff`). In
    float32 values are within 1e-3 and derivatives within 1e-2 at the default tolerances
    (`tests/test_time_pde.py`, of orders 2 to 4).
    Differentiable: forward and reverse, by the implicit function theorem; nothing of size n × n
    is ever made.
    Raises:
        ValueError: another order.

    Example:
        >>> laplacian = js.laplace_beltrami(js.sphere(500))
        >>> problem = js.AdvectionDiffusionReaction(laplacian)
        >>> z = js.sphere(500).points[:, 2]
        >>> u = js.integrate(problem, z, t1=0.5, solver=js.IMEX(order=3)).ys[-1]
        >>> bool(jnp.abs(u - jnp.exp(-1.0) * z).max() < 0.01)
        True
    """

    term_structure: ClassVar = dfx.MultiTerm[tuple[dfx.AbstractTerm, dfx.AbstractTerm]]

    def __init__(
        self,
        order: int = 3,
        *,
        solver: lx.AbstractLinearSolver | None = None,
        tolerance: ArrayLike | None = None,
        preconditioner: Preconditioner | None = None,
    ):
        self._set(order, _IMEX, solver, tolerance, preconditioner)

    @property
    def tableau(self) -> Tableau:
        """Its coefficients."""
        return _IMEX[self.scheme]

    def func(self, terms, t0, y0, args):
        return added(*(term.vf(t0, y0, args) for term in terms.terms))

    def init(self, terms, t0, t1, y0, args):
        return _before(terms.terms, t0, y0, args)

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        rates, are_known = solver_state
        terms, rates = frozen_at(terms, t0, y0, rates)
        implicit = terms.terms[1]
        span = implicit.contr(t0, t1)
        solver = relative(self.solver, self.tolerance, y0)

        tableau = self.tableau
        options = _options(self.preconditioner, tableau.gamma * (t1 - t0), y0)

        def solve(t, known, start):
            def left_side(y):
                change = implicit.vf_prod(t, y, args, span)
                return jax.tree.map(lambda y, k: y - tableau.gamma * k, y, change)

            operator = lx.FunctionLinearOperator(left_side, jax.eval_shape(lambda: y0))
            residual = jax.tree.map(jnp.subtract, known, operator.mv(start))
            found = lx.linear_solve(operator, residual, solver, options=options, throw=False)
            y = jax.tree.map(jnp.add, start, found.value)
            return y, dfx.RESULTS.promote(found.result)

        both = tuple(terms.terms)
        return _steps(tableau, both, solve, (t0, t1), y0, args, (rates, are_known), made_jump)


class SDIRK(_Implicit):
    r"""Singly diagonally implicit Runge–Kutta steps by Newton–Krylov: for stiff reactions.

    Each stage solves $y - \gamma\,\Delta t\,f(t, y) = r$ for the whole right-hand side f by
    Newton's method; its linear systems by a Krylov method on Jacobian–vector products. A
    diffrax solver for an `ODETerm`.

    Args:
        order: 3 (four stages) or 4 (five), with an embedded method one order lower (Kværnø
            2004). L-stable.
        solver, tolerance: as in `IMEX`; a stage has converged when the norm of its residual is
            below the tolerance times that of the state.
        preconditioner: function of $\gamma\,\Delta t$ that returns an approximate inverse of
            $I - \gamma\,\Delta t\,f'$; None for small steps.
        newton_steps: largest number of Newton steps; a stage that needs more is refused, and
            an adaptive controller shortens the step.

    Accuracy: of that order in the step where no mode is faster than the steps: more than 2.7
    and 3.6 (`tests/test_time_implicit.py::test_order_of_steps_that_are_not_stiff`). Where
    modes are faster than the steps, whose stages are of order 2, order 4 falls towards 3: 3.5 with
    10 to 20 steps (`test_order` there). In float32 values are within 1e-3 and derivatives within
    1e-2 at the default tolerances (`tests/test_time_pde.py`).
    Differentiable: forward and reverse, by the implicit function theorem; nothing of size n × n
    is ever made.
    Raises:
        ValueError: another order.

    Example:
        >>> cloud = js.sphere(300)
        >>> problem = js.AdvectionDiffusionReaction(js.laplace_beltrami(cloud))
        >>> u0 = cloud.points[:, 2]
        >>> u = js.integrate(problem, u0, t1=0.1, solver=js.SDIRK(order=3), dt0=0.05).ys[-1]
        >>> bool(jnp.abs(u - jnp.exp(-0.2) * u0).max() < 0.01)
        True
    """

    newton_steps: int = eqx.field(static=True)

    term_structure: ClassVar = dfx.AbstractTerm

    def __init__(
        self,
        order: int = 3,
        *,
        solver: lx.AbstractLinearSolver | None = None,
        tolerance: ArrayLike | None = None,
        preconditioner: Preconditioner | None = None,
        newton_steps: int = 12,
    ):
        self._set(order, _SDIRK, solver, tolerance, preconditioner)
        self.newton_steps = whole(newton_steps, "newton_steps", least=1)

    def func(self, terms, t0, y0, args):
        return terms.vf(t0, y0, args)

    def init(self, terms, t0, t1, y0, args):
        return _before((terms,), t0, y0, args)

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        span = terms.contr(t0, t1)
        tolerance = tolerance_of(self.tolerance, y0)

        tableau = _SDIRK[self.scheme]
        options = _options(self.preconditioner, tableau.gamma * (t1 - t0), y0)

        def solve(t, known, start):
            def residual(y):
                change = terms.vf_prod(t, y, args, span)
                return jax.tree.map(lambda y, k, r: y - tableau.gamma * k - r, y, change, known)

            inner = relative(self.solver, _FORCING, y0, partial=True)
            outer = relative(self.solver, self.tolerance, y0)
            structure = jax.eval_shape(lambda: y0)

            def newton(residual, start):
                target = tolerance * jnp.maximum(root_mean_square(start), root_mean_square(known))

                def unfinished(carry):
                    _, r, count = carry
                    return (root_mean_square(r) > target) & (count < self.newton_steps)

                def improve(carry):
                    y, r, count = carry
                    slope = lx.FunctionLinearOperator(jax.linearize(residual, y)[1], structure)
                    step = lx.linear_solve(slope, r, inner, options=options, throw=False).value
                    y = jax.tree.map(jnp.subtract, y, step)
                    return y, residual(y), count + 1

                carry = (start, residual(start), 0)
                y, r, _ = jax.lax.while_loop(unfinished, improve, carry)
                return y, (root_mean_square(r) <= target).astype(root_mean_square(r).dtype)

            def tangent(slope, vector):
                operator = lx.FunctionLinearOperator(slope, structure)
                return lx.linear_solve(operator, vector, outer, options=options, throw=False).value

            y, converged = jax.lax.custom_root(residual, start, newton, tangent, has_aux=True)
            return y, dfx.RESULTS.where(
                converged > 0, dfx.RESULTS.successful, dfx.RESULTS.nonlinear_divergence
            )

        return _steps(tableau, (terms,), solve, (t0, t1), y0, args, solver_state, made_jump)


def _options(preconditioner: Preconditioner | None, shift, y0) -> dict:
    """For the linear solves of all stages of a step, whose matrices are the same but for f'."""
    if preconditioner is None:
        return {}
    inverse = preconditioner(shift)
    wanted, given = (jax.tree.map(lambda a: a.shape, x) for x in (y0, inverse.in_structure()))
    if given != wanted:
        raise ValueError(f"preconditioner is of a state of shapes {given}, this one has {wanted}")
    return {"preconditioner": inverse}


# Residual of a Newton step's linear system over its right-hand side.
_FORCING = 1e-2


def _before(terms, t0, y0, args) -> tuple:
    """What the first step is handed: rates of none, and that they are not known."""
    rates = zeros_like_result(lambda: tuple(term.vf(t0, y0, args) for term in terms))
    return rates, jnp.asarray(False)


def _steps(tableau: Tableau, terms, solve, times, y0, args, state, made_jump):
    """All stages of one step, for one term (implicit) or two (explicit, implicit).

    One loop, in which a solve and the rates after it, which take seconds to compile, stand once.
    Its first turn finds the rates at the start where they are not known, its last those at the end.

    Args:
        solve: (t, r, start) -> y with y - γ Δt f(t, y) = r, and its result code.
        state: rates of the terms at the start, from the step before, and whether they are known.
        made_jump: True if rates jump at the start.
    """
    t0, t1 = times
    rates, are_known = state
    fresh = jnp.asarray(made_jump) | ~are_known
    span = [term.contr(t0, t1) for term in terms]
    count, real = len(tableau.nodes), dtype_of(y0)
    matrices = zip((tableau.explicit, tableau.implicit), tableau.weights)
    rows = (
        jnp.arange(count + 1),
        jnp.asarray(np.append(tableau.nodes, 1.0), real),
        [jnp.asarray(np.vstack(pair), real) for pair in [*matrices][-len(terms) :]],
    )
    fine = dfx.RESULTS.where(jnp.asarray(True), *[dfx.RESULTS.successful] * 2)
    # Increments, term by term and stage by stage.
    room = [jax.tree.map(lambda y: jnp.zeros((count, *y.shape), y.dtype), y0) for _ in terms]

    def turn(carry, row):
        y, rates, room, ok = carry
        i, node, weights = row
        known, t = y0, t0 + node * (t1 - t0)
        for w, increments in zip(weights, room):
            known = _combined(known, w, increments)
        is_stage = (i > 0) & (i < count)
        y, result = jax.lax.cond(is_stage, solve, lambda t, known, _: (known, fine), t, known, y)
        ok = dfx.RESULTS.where(ok == dfx.RESULTS.successful, result, ok)
        found = lambda: tuple(term.vf(t, y, args) for term in terms)
        rates = jax.lax.cond(fresh | (i > 0), found, lambda: rates)
        new = [term.prod(rate, s) for term, rate, s in zip(terms, rates, span)]
        # Those at the end have no room.
        room = jax.tree.map(lambda r, k: r.at[i].set(k, mode="drop"), room, new)
        return (y, rates, room, ok), None

    (y1, rates, room, ok), _ = jax.lax.scan(turn, (y0, rates, room, fine), rows)
    total = added(*room)
    zero = jax.tree.map(jnp.zeros_like, y0)
    error = _combined(zero, jnp.asarray(tableau.errors, real), total)
    # Nothing of a step whose equations were not solved is to be kept.
    solved = ok == dfx.RESULTS.successful
    error = jax.tree.map(lambda e: jnp.where(solved, e, jnp.inf), error)
    y1 = jax.tree.map(lambda y: jnp.where(solved, y, jnp.nan), y1)
    k0 = jax.tree.map(lambda k: k[0], total)
    k1 = added(*(term.prod(rate, s) for term, rate, s in zip(terms, rates, span)))
    return y1, error, dict(y0=y0, y1=y1, k0=k0, k1=k1), (rates, solved), ok


def _combined(y: PyTree[Array], weights: Array, increments: PyTree[Array]) -> PyTree[Array]:
    """y plus the weighted sum of increments that are stacked along the first axis."""
    return jax.tree.map(lambda y, k: y + jnp.tensordot(weights, k, axes=1), y, increments)
