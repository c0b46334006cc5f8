"""Multigrid for the systems of implicit steps: convergence, transpose, and what uses it."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxsurf as js
from jaxsurf.solve.shifted import shifted_multigrid

from .helpers import jittered_sphere

pytest.importorskip("pyamg")

CLOUD = jittered_sphere(1_500)
LAPLACIAN = js.laplace_beltrami(CLOUD)
Z = CLOUD.points[:, 2]
NOISE = jnp.asarray(np.random.default_rng(0).normal(size=CLOUD.n))


@pytest.mark.parametrize("closed", [True, False])
def test_cycles_reduce_the_residual_for_every_step(closed):
    conditions = None if closed else js.eliminate(CLOUD, js.dirichlet(jnp.abs(Z) < 0.1, 0.0))
    hierarchy = shifted_multigrid(LAPLACIAN, closure=conditions)

    @jax.jit
    def residual_after(g, cycles: int = 4):
        within = lambda v: v if conditions is None else conditions.restrict(v)
        fill = lambda v: v if conditions is None else conditions.homogeneous(v)
        cycle, x, b = hierarchy.at(g), 0 * NOISE, within(NOISE)
        for _ in range(cycles):
            x = x + cycle(b - (x - g * within(LAPLACIAN(fill(x)))))
        r = b - (x - g * within(LAPLACIAN(fill(x))))
        return jnp.linalg.norm(r) / jnp.linalg.norm(b)

    for g in (1e-7, 1e-4, 1e-2, 1.0, 1e3):
        assert float(residual_after(g)) < 1e-2


def test_the_transpose_is_exact():
    u0 = jnp.stack([Z, NOISE], axis=1)
    species = js.AdvectionDiffusionReaction(LAPLACIAN, diffusivity=jnp.array([1.0, 10.0]))
    for problem, field in (
        (js.CahnHilliard(LAPLACIAN, width=0.1), NOISE),
        (species, u0),
        (js.AdvectionDiffusionReaction(LAPLACIAN, diffusivity=1 + 0.1 * Z), u0),
    ):
        inverse = js.step_preconditioner(problem, field)(0.02)
        other = jnp.cos(field)
        one = jnp.vdot(other, inverse.mv(field))
        np.testing.assert_allclose(one, jnp.vdot(inverse.transpose().mv(other), field), rtol=1e-5)


@pytest.mark.slow
def test_steps_and_gradients_are_the_same_with_it():
    """Long steps of fourth order: some hundred Krylov steps without."""
    problem = lambda s: js.BiharmonicDiffusion(LAPLACIAN, stiffness=s)
    plain = js.IMEX(order=2)
    with_cycles = js.IMEX(order=2, preconditioner=js.step_preconditioner(problem(0.02), Z))

    def scalar(s, u, solver):
        end = js.integrate(problem(s), u, t1=0.2, dt0=0.1, solver=solver).ys[-1]
        return jnp.sum(end**2 * (1 + CLOUD.points[:, 0]))

    u0 = jnp.exp(Z)
    gradient = jax.grad(scalar, argnums=(0, 1))
    for a, b in zip(gradient(0.02, u0, plain), gradient(0.02, u0, with_cycles)):
        np.testing.assert_allclose(a, b, rtol=1e-6, atol=1e-9)


def test_misuse():
    with pytest.raises(ValueError, match="no preconditioner for problem = WaveEquation"):
        js.step_preconditioner(js.WaveEquation(LAPLACIAN), Z)
    with pytest.raises(ValueError, match="concrete arrays"):
        jax.jit(lambda w: shifted_multigrid(js.Stencil(LAPLACIAN.indices, w)).mass)(
            LAPLACIAN.weights
        )
