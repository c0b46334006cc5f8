"""A Krylov solver that stops on the true residual, in the interface of lineax."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from ..arguments import real, whole
from ..failures import is_concrete
from ..stencils.algebra import AbstractOperator
from ..stencils.lineax import Action

_Results = lx.RESULTS


class BiCGStab(lx.AbstractLinearSolver):
    r"""Stabilised biconjugate gradients with right preconditioning (van der Vorst 1992).

    Stops when $\|b - A x\|_2 \le \max(\mathtt{rtol}\,\|b\|_2, \mathtt{atol})$, with the
    residual computed afresh: where the one carried along by recursion has drifted away from it,
    and where the recursion breaks down, the iteration starts again from the last iterate. (The
    solver of the same name in lineax compares component by component, which no right-hand
    side that passes through zero can meet.) Fields may be any pytree.

    Args:
        rtol: tolerance relative to the norm of the right-hand side.
        atol: absolute tolerance.
        max_steps: most steps, of two products with the operator each.
        enough: this share of the norm of the right-hand side is good enough where round-off ends
            the iteration before its tolerance is reached.

    Raises:
        ValueError: a tolerance that is negative or not finite, or rtol or enough ≥ 1;
            max_steps < 1.
        TypeError: no numbers.

    Example:
        >>> import lineax as lx
        >>> operator = lx.MatrixLinearOperator(jnp.array([[2.0, 1.0], [0.0, 3.0]]))
        >>> solution = lx.linear_solve(operator, jnp.array([4.0, 6.0]), js.BiCGStab(rtol=1e-6))
        >>> bool(jnp.abs(solution.value - jnp.array([1.0, 2.0])).max() < 1e-5)
        True
    """

    rtol: Any = 1e-8
    atol: Any = 0.0
    max_steps: Any = 1000
    enough: Any = 0.0

    def __check_init__(self):
        real(self.rtol, "rtol", least=0, below=1)
        real(self.enough, "enough", least=0, below=1)
        real(self.atol, "atol", least=0)
        if is_concrete(self.max_steps):
            whole(self.max_steps, "max_steps", least=1)

    def init(self, operator, options):
        del options
        if operator.in_structure() != operator.out_structure():
            raise ValueError("BiCGStab needs a square operator")
        return lx.linearise(operator)

    def compute(self, state, vector, options):
        b, unravel = ravel_pytree(vector)
        flat = lambda f: lambda x: ravel_pytree(f(unravel(x)))[0]
        preconditioner = options.get("preconditioner")
        apply = flat(state.mv)
        precondition = (lambda r: r) if preconditioner is None else flat(preconditioner.mv)
        finite = jnp.all(jnp.isfinite(b))
        # At size one, as squares of 1e-300 are zero.
        scale = scale_of(b)
        b = b / scale
        norm = jnp.linalg.norm(b)
        target = jnp.maximum(self.rtol * norm, self.atol / scale)
        x, r = jnp.zeros_like(b), b
        if "y0" in options:
            x = ravel_pytree(options["y0"])[0] / scale
            r = b - apply(x)

        def pass_(carry):
            """Steps until the recursive residual is small or cannot go on."""
            x, r, size, steps, _ = carry
            run = jax.lax.while_loop(
                lambda run: run.goes_on & (run.size > target) & (run.steps < self.max_steps),
                lambda run: run.step(apply, precondition),
                _Run.begin(x, r, steps),
            )
            r = b - apply(run.x)
            now = jnp.linalg.norm(r)
            # A pass that gains little has met round-off, or a system that is singular.
            return run.x, r, now, run.steps, now < 0.5 * size

        def unfinished(carry):
            _, _, size, steps, gains = carry
            return gains & (size > target) & (steps < self.max_steps)

        size = jnp.linalg.norm(r)
        start = (x, r, size, jnp.asarray(0), jnp.isfinite(size))
        x, _, size, steps, _ = jax.lax.while_loop(unfinished, pass_, start)
        result = _Results.where(
            steps >= self.max_steps, _Results.max_steps_reached, _Results.stagnation
        )
        reached = size <= jnp.maximum(target, self.enough * norm)
        result = _Results.where(reached, _Results.successful, result)
        result = _Results.where(finite, result, _Results.nonfinite_input)
        return unravel(scale * x), result, {"num_steps": steps, "max_steps": self.max_steps}

    def transpose(self, state, options):
        transposed = {}
        if "preconditioner" in options:
            transposed["preconditioner"] = options["preconditioner"].transpose()
        return state.transpose(), transposed

    def conj(self, state, options):
        return lx.conj(state), options

    def assume_full_rank(self):
        return True


def solve_system(
    matrix: AbstractOperator, b: Float[Array, " n"], solver, inverse: AbstractOperator
) -> lx.Solution:
    """Solve by a solver of lineax, with an approximate inverse; does not raise."""
    options = {"preconditioner": Action(inverse, b.dtype)}
    return lx.linear_solve(Action(matrix, b.dtype), b, solver, options=options, throw=False)


def scale_of(x: Float[Array, " n"]) -> Float[Array, ""]:
    """The largest modulus; one if that is zero or no number."""
    size = jnp.max(jnp.abs(x))
    return jax.lax.stop_gradient(jnp.where((size > 0) & jnp.isfinite(size), size, 1))


def tolerances_as_arrays(solver):
    """A solver with its tolerances as arrays: programs are then compiled once for all of them."""
    kinds = (float, int) if isinstance(solver, BiCGStab) else float
    return jax.tree.map(lambda x: np.asarray(x) if isinstance(x, kinds) else x, solver)


class _Run(eqx.Module):
    """State of one run: iterate, residual, shadow residual, directions and their products."""

    x: jax.Array
    r: jax.Array
    shadow: jax.Array
    p: jax.Array
    v: jax.Array
    rho: jax.Array
    alpha: jax.Array
    omega: jax.Array
    size: jax.Array
    steps: jax.Array
    goes_on: jax.Array

    @classmethod
    def begin(cls, x, r, steps):
        one, zero = jnp.ones((), r.dtype), jnp.zeros_like(r)
        return cls(x, r, r, zero, zero, one, one, one, jnp.linalg.norm(r), steps, jnp.array(True))

    def step(self, apply, precondition):
        rho = jnp.vdot(self.shadow, self.r)
        beta = (rho / self.rho) * (self.alpha / self.omega)
        p = self.r + beta * (self.p - self.omega * self.v)

        def half(i, carry):
            """Along p as far as the shadow does not see the rest, then along that to its least.

            One body for both, so that the operator and its preconditioner are compiled once.
            """
            x, r, v, alpha, _ = carry
            first = i == 0
            d_hat = precondition(jnp.where(first, p, r))
            w = apply(d_hat)
            other = jnp.where(first, self.shadow, w)
            factor = jnp.where(first, rho, jnp.vdot(w, r)) / jnp.vdot(other, w)
            # A residual of zero is the solution; then w = 0 as well.
            factor = jnp.where(first | jnp.any(r != 0), factor, 0)
            v, alpha = jnp.where(first, w, v), jnp.where(first, factor, alpha)
            return x + factor * d_hat, r - factor * w, v, alpha, factor

        start = (self.x, self.r, self.v, self.alpha, self.omega)
        x, r, v, alpha, omega = jax.lax.fori_loop(0, 2, half, start)
        size = jnp.linalg.norm(r)
        # The shadow residual has to see the residual, and omega must not vanish.
        eps = jnp.finfo(r.dtype).eps
        seen = jnp.abs(rho) > eps * jnp.linalg.norm(self.shadow) * self.size
        sound = jnp.isfinite(size) & seen
        keep = lambda new, old: jnp.where(sound, new, old)
        return _Run(
            keep(x, self.x), keep(r, self.r), self.shadow, p, v, rho, alpha, omega,
            keep(size, self.size), self.steps + 1, sound & (omega != 0),
        )  # fmt: skip
