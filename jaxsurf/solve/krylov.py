"""A Krylov solver that stops on the true residual, in the interface of lineax."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx

_Results = lx.RESULTS


class BiCGStab(lx.AbstractLinearSolver):
    r"""Stabilised biconjugate gradients with right preconditioning (van der Vorst 1992).

    Stops when $\|b - A x\|_2 \le \max(\mathtt{rtol}\,\|b\|_2, \mathtt{atol})$, with the
    residual computed afresh: where the one carried along by recursion has drifted away from it,
    and where the recursion breaks down, the iteration starts again from the last iterate. (The
    solver of the same name in lineax compares component by component, which no right-hand
    side that passes through zero can meet.)

    Args:
        rtol: tolerance relative to the norm of the right-hand side.
        atol: absolute tolerance.
        max_steps: most steps, of two products with the operator each.

    Example:
        >>> import lineax as lx
        >>> operator = lx.MatrixLinearOperator(jnp.array([[2.0, 1.0], [0.0, 3.0]]))
        >>> solution = lx.linear_solve(operator, jnp.array([4.0, 6.0]), js.BiCGStab(rtol=1e-6))
        >>> bool(jnp.abs(solution.value - jnp.array([1.0, 2.0])).max() < 1e-5)
        True
    """

    rtol: float = 1e-8
    atol: float = 0.0
    max_steps: int = 1000

    def init(self, operator, options):
        del options
        if operator.in_structure() != operator.out_structure():
            raise ValueError("BiCGStab needs a square operator")
        return lx.linearise(operator)

    def compute(self, state, vector, options):
        preconditioner = options.get("preconditioner")
        apply = state.mv
        precondition = (lambda r: r) if preconditioner is None else preconditioner.mv
        x = options.get("y0", jnp.zeros_like(vector))
        target = jnp.maximum(self.rtol * jnp.linalg.norm(vector), self.atol)

        def pass_(carry):
            """Steps until the recursive residual is small or cannot go on."""
            x, r, size, _, steps, _ = carry
            run = _Run.begin(x, r, steps)
            run = jax.lax.while_loop(
                lambda run: run.goes_on & (run.size > target) & (run.steps < self.max_steps),
                lambda run: run.step(apply, precondition),
                run,
            )
            r = vector - apply(run.x)
            now = jnp.linalg.norm(r)
            # A pass that gains little has met round-off, or a system that is singular.
            return run.x, r, now, size, run.steps, now < 0.5 * size

        def unfinished(carry):
            _, _, size, _, steps, gains = carry
            return gains & (size > target) & (steps < self.max_steps)

        r = vector - apply(x)
        size = jnp.linalg.norm(r)
        start = (x, r, size, size, jnp.asarray(0), jnp.isfinite(size))
        x, _, size, _, steps, _ = jax.lax.while_loop(unfinished, pass_, start)
        result = _Results.where(
            steps >= self.max_steps, _Results.max_steps_reached, _Results.stagnation
        )
        result = _Results.where(size <= target, _Results.successful, result)
        result = _Results.where(jnp.all(jnp.isfinite(vector)), result, _Results.nonfinite_input)
        return x, result, {"num_steps": steps, "max_steps": self.max_steps}

    def transpose(self, state, options):
        turned = {}
        if "preconditioner" in options:
            turned["preconditioner"] = options["preconditioner"].transpose()
        return state.transpose(), turned

    def conj(self, state, options):
        return lx.conj(state), options

    def assume_full_rank(self):
        return True


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
        p_hat = precondition(p)
        v = apply(p_hat)
        alpha = rho / jnp.vdot(self.shadow, v)
        s = self.r - alpha * v
        s_hat = precondition(s)
        t = apply(s_hat)
        omega = jnp.vdot(t, s) / jnp.vdot(t, t)
        # s = 0 is the solution; then t = 0 as well.
        omega = jnp.where(jnp.any(s != 0), omega, 0)
        x = self.x + alpha * p_hat + omega * s_hat
        r = s - omega * t
        size = jnp.linalg.norm(r)
        # The shadow residual has to see the residual, and omega must not vanish.
        seen = jnp.abs(rho) > _eps(r) * jnp.linalg.norm(self.shadow) * self.size
        sound = jnp.isfinite(size) & seen
        keep = lambda new, old: jnp.where(sound, new, old)
        return _Run(
            keep(x, self.x), keep(r, self.r), self.shadow, p, v, rho, alpha, omega,
            keep(size, self.size), self.steps + 1, sound & (omega != 0),
        )  # fmt: skip


def _eps(x):
    return jnp.finfo(x.dtype).eps
