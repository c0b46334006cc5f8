r"""What an integration consists of: terms, solver and controller that go together, checked."""

from __future__ import annotations

import logging
from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PyTree

from ..arguments import as_float, is_concrete, raise_at
from .chebyshev import Loop
from .explicit import RKC2
from .implicit import IMEX
from .pde import (
    AbstractEvolution,
    AdvectionDiffusionReaction,
    BiharmonicDiffusion,
    CahnHilliard,
    WaveEquation,
)

_log = logging.getLogger(__name__)

# Copies of the state kept for the reverse pass.
_CHECKPOINTS = 64
# A step this much shorter than the whole interval means that something diverges.
_SHORTEST = 1e-11


def choose_solver(problem: AbstractEvolution) -> tuple[dfx.AbstractSolver, str]:
    """A solver that suits the kind of problem, and why.

    Only the kind counts, not the values, so that the choice is the same under `jit` and
    `grad`. Reactions faster than diffusion on the smallest scale call for `SDIRK`, which is
    yours to pass.

    Args:
        problem: what is to be integrated.

    Returns:
        The solver and a sentence.

    Example:
        >>> js.choose_solver(js.WaveEquation(js.laplace_beltrami(js.sphere(500))))[1]
        'Tsit5: waves are not stiff'
    """
    if isinstance(problem, WaveEquation):
        return dfx.Tsit5(), "Tsit5: waves are not stiff"
    if isinstance(problem, BiharmonicDiffusion | CahnHilliard):
        return IMEX(order=3), "IMEX(order=3): fourth order in space is too stiff for explicit steps"
    if isinstance(problem, AdvectionDiffusionReaction):
        moving = problem.advection is not None or problem.velocity is not None
        if problem.laplacian is None:
            return dfx.Tsit5(), "Tsit5: advection is not stiff"
        if moving:
            return IMEX(order=3), "IMEX(order=3): advection explicit, diffusion implicit"
        return RKC2(), "RKC2: diffusion, by explicit steps with many stages"
    return IMEX(order=3), "IMEX(order=3): a linear part of unknown stiffness"


class Run(eqx.Module):
    """Everything `diffeqsolve` takes, checked and in one precision."""

    problem: AbstractEvolution
    terms: PyTree
    solver: dfx.AbstractSolver
    why: str = eqx.field(static=True)
    t0: Array
    t1: Array
    dt0: Array | None
    u0: PyTree[Array]
    args: Any
    controller: dfx.AbstractStepSizeController
    adjoint: dfx.AbstractAdjoint
    concrete: bool = eqx.field(static=True)

    @classmethod
    def of(cls, problem, u0, t0, t1, solver, dt0, rtol, atol, controller, adjoint, args) -> Run:
        u0 = jax.tree.map(as_float, u0)
        real = jnp.finfo(jnp.result_type(*jax.tree.leaves(u0))).dtype
        t0, t1 = jnp.asarray(t0, real), jnp.asarray(t1, real)
        dt0 = None if dt0 is None else jnp.asarray(dt0, real)
        leaves = jax.tree.leaves((problem, u0, t0, t1, args))
        concrete = is_concrete(*leaves)
        if is_concrete(t0, t1, dt0):
            _check_times(t0, t1, dt0)
        if concrete:
            _check_state(problem, t0, u0, args)
        why = "given"
        if solver is None:
            solver, why = choose_solver(problem)
        adjoint = dfx.RecursiveCheckpointAdjoint(_CHECKPOINTS) if adjoint is None else adjoint
        if isinstance(solver, RKC2):
            solver = _looped(solver, adjoint)
        if controller is None and dt0 is None:
            shortest = _SHORTEST * jnp.abs(t1 - t0)
            controller = dfx.PIDController(rtol, atol, dtmin=shortest, force_dtmin=False)
        elif controller is None:
            controller = dfx.ConstantStepSize()
        if not isinstance(controller, dfx.AbstractAdaptiveStepSizeController):
            controller = Guarded(controller)
        _log.info("%s over [%s, %s] by %s", type(problem).__name__, t0, t1, why)
        return cls(
            problem, _terms(problem, solver), solver, why, t0, t1, dt0,
            u0, args, controller, adjoint, concrete,
        )  # fmt: skip


def _terms(problem: AbstractEvolution, solver: dfx.AbstractSolver):
    """The right-hand side, in two parts for solvers that treat them differently."""
    if not _takes_two(solver):
        return dfx.ODETerm(problem.rate)
    return dfx.MultiTerm(dfx.ODETerm(problem.explicit_rate), dfx.ODETerm(problem.implicit_rate))


def _takes_two(solver: dfx.AbstractSolver) -> bool:
    return getattr(solver.term_structure, "__origin__", None) is dfx.MultiTerm


def _looped(solver: RKC2, adjoint: dfx.AbstractAdjoint) -> RKC2:
    """With the kind of loop that the adjoint can differentiate."""
    loop: Loop = "checkpointed"
    if isinstance(adjoint, dfx.ForwardMode):
        loop = "lax"
    elif isinstance(adjoint, dfx.DirectAdjoint):
        loop = "bounded"
    return RKC2(solver.spectral_radius, solver.max_stages, loop)


class Guarded(dfx.AbstractStepSizeController):
    """A controller of given steps that never accepts a state with entries that are not finite.

    It stops there with a result code, and the state before stays. (An adaptive controller
    refuses and shortens such steps by itself.)
    """

    controller: dfx.AbstractStepSizeController

    def wrap(self, direction):
        return Guarded(self.controller.wrap(direction))

    def init(self, terms, t0, t1, y0, dt0, args, func, error_order):
        return self.controller.init(terms, t0, t1, y0, dt0, args, func, error_order)

    def adapt_step_size(self, t0, t1, y0, y1_candidate, args, y_error, error_order, state):
        keep, start, end, jump, new_state, result = self.controller.adapt_step_size(
            t0, t1, y0, y1_candidate, args, y_error, error_order, state
        )
        leaves = [jnp.all(jnp.isfinite(leaf)) for leaf in jax.tree.leaves(y1_candidate)]
        finite = jnp.all(jnp.stack(leaves))
        result = dfx.RESULTS.where(finite, result, dfx.RESULTS.nonlinear_divergence)
        return keep & finite, jnp.where(finite, start, t0), end, jump, new_state, result


# --- checks --------------------------------------------------------------------------------


def _check_times(t0, t1, dt0) -> None:
    for name, value in (("t0", t0), ("t1", t1), ("dt0", dt0)):
        if value is not None and not bool(jnp.isfinite(value)):
            raise ValueError(f"{name} = {float(value)} is not finite")
    if dt0 is not None and not float(dt0 * jnp.sign(t1 - t0)) > 0 and t0 != t1:
        raise ValueError(f"a step dt0 = {float(dt0)} does not lead from {float(t0)} to {float(t1)}")


def _check_state(problem: AbstractEvolution, t0, u0, args) -> None:
    for leaf in jax.tree.leaves(u0):
        values = np.asarray(leaf)
        raise_at(_bad_rows(values), "the state at point {i} is not finite: {v}", values)
    rate = eqx.filter_jit(problem.rate)(t0, u0, args)
    have, want = (str(jax.tree.structure(tree)) for tree in (rate, u0))
    if have != want:
        raise ValueError(f"the state is a {want}, its rate a {have}")
    for leaf in jax.tree.leaves(rate):
        values = np.asarray(leaf)
        raise_at(_bad_rows(values), "the right-hand side at point {i} is not finite: {v}", values)


def _bad_rows(values: np.ndarray) -> np.ndarray:
    return ~np.isfinite(values.reshape(len(values), -1)).all(axis=1)
