"""Steady problems with a reaction: convergence, the gradient, and failures that speak."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest

import jaxsurf as js

from .helpers import check_derivatives


@pytest.fixture(scope="module")
def problem():
    cloud = js.sphere(600)
    operator = -js.laplace_beltrami(cloud)
    return cloud, operator, js.multigrid(operator + 1)


def test_known_solution_in_few_steps():
    cloud = js.sphere(1_000)
    operator = -js.laplace_beltrami(cloud)
    z = cloud.points[:, 2]
    for reaction, args in [(lambda u, a: a * u + u**3, 1.0), (lambda u, a: jnp.exp(a * u), 3.0)]:
        rhs = 2 * z + reaction(z, args)
        found = js.solve_nonlinear(operator, reaction, 0 * z, args=args, rhs=rhs)
        assert found.result == optx.RESULTS.successful
        assert int(found.stats["num_steps"]) <= 7
        left = rhs - operator(found.value) - reaction(found.value, args)
        assert float(jnp.linalg.norm(left)) < 2e-8 * float(jnp.linalg.norm(rhs))
        assert float(jnp.abs(found.value - z).max()) < 2e-3


def test_line_search_saves_a_start_from_afar(problem):
    cloud, operator, _ = problem
    z = cloud.points[:, 2]
    rhs = 2 * z + z + jnp.arctan(20 * z)
    found = js.solve_nonlinear(operator, lambda u, _: u + jnp.arctan(20 * u), 50 + 0 * z, rhs=rhs)
    assert float(jnp.abs(found.value - z).max()) < 2e-2


def test_conditions_hold(problem):
    cloud, operator, _ = problem
    z = cloud.points[:, 2]
    cap = z > 0.8
    conditions = js.eliminate(cloud, js.dirichlet(cap, z[cap]))
    rhs = 3 * z + z**3
    found = js.solve_nonlinear(operator, lambda u, _: u + u**3, 0 * z, rhs=rhs, closure=conditions)
    assert float(jnp.abs(found.value - z)[cap].max()) < 1e-14
    assert float(jnp.abs(found.value - z).max()) < 2e-3


def test_derivatives(problem):
    cloud, operator, preconditioner = problem
    z = cloud.points[:, 2]

    def total(weights, strength, rhs):
        moved = eqx.tree_at(lambda o: o.weights, operator, weights)
        found = js.solve_nonlinear(
            moved, lambda u, a: u + a * u**3, 0 * z, args=strength, rhs=rhs,
            preconditioner=preconditioner, rtol=1e-13,
        )  # fmt: skip
        return jnp.sum(found.value**3 * z)

    strength, rhs = 1 + z**2, 3 * z + z**3
    check_derivatives(total, operator.weights, strength, rhs, step=1e-2)


def test_matrix_free(problem):
    cloud, operator, preconditioner = problem
    z = cloud.points[:, 2]

    def total(rhs):
        reaction = lambda u, _: u + u**3
        solve = js.solve_nonlinear
        return jnp.sum(
            solve(operator, reaction, 0 * z, rhs=rhs, preconditioner=preconditioner).value
        )

    n = cloud.n
    assert f"{n},{n}" not in str(jax.make_jaxpr(jax.grad(total))(z))


def test_failures_speak(problem):
    cloud, operator, _ = problem
    z = cloud.points[:, 2]
    with pytest.raises(ValueError, match="slope zero"):
        js.solve_nonlinear(operator, lambda u, _: u**3, 0 * z, rhs=z)
    # The integral of exp(u) cannot be negative: there is no solution.
    no_solution = (operator, lambda u, _: jnp.exp(u), 0 * z)
    with pytest.raises(RuntimeError, match=r"relative residual .* Newton steps"):
        js.solve_nonlinear(*no_solution, rhs=z - 2)
    kept = js.solve_nonlinear(*no_solution, rhs=z - 2, throw=False)
    assert kept.result != optx.RESULTS.successful
    assert bool(jnp.isfinite(kept.value).all())
    with pytest.raises(ValueError, match="u0 is not finite at point 4"):
        js.solve_nonlinear(operator, lambda u, _: u, (0 * z).at[4].set(np.inf))
    with pytest.raises(ValueError, match=r"u0 has shape \(3,\)"):
        js.solve_nonlinear(operator, lambda u, _: u, jnp.zeros(3))


def test_a_reaction_that_couples_points(problem):
    """Its whole derivative counts, in values and in gradients: here one by a stencil."""
    cloud, operator, preconditioner = problem
    z = cloud.points[:, 2]
    # r(u) = u + u³ + (mean of neighbours of u²).
    near = js.Stencil(operator.indices[:8], jnp.full((8, cloud.n), 0.1))

    def total(strength, rhs):
        found = js.solve_nonlinear(
            operator, lambda u, a: u + u**3 + a * near(u**2), 0 * z, args=strength, rhs=rhs,
            preconditioner=preconditioner, rtol=1e-13,
        )  # fmt: skip
        return jnp.sum(found.value**3 * z)

    strength, rhs = 1 + z**2, 3 * z + z**3
    check_derivatives(total, strength, rhs, step=1e-2)
