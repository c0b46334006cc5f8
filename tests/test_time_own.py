r"""Problems of one's own, whose geometry is part of the state."""

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxsurf as js

pytestmark = pytest.mark.slow
CLOUD = js.sphere(200)
SURFACE = js.discretize(CLOUD, method=js.GFDM(degree=2))
Z = CLOUD.points[:, 2]
# Rate of growth, diffusivity, end.
GROWTH, DIFFUSIVITY, END = 0.5, 0.3, 0.2


class Grown(js.AbstractEvolution):
    r"""Heat that is carried and diluted by a surface that grows, $\dot x = a x$."""

    closure: None
    surface: js.Discretization
    laplacian: js.AbstractOperator | None
    growth: jax.Array

    def at(self, t, state):
        moved = self.surface.moved(state[0]).laplacian
        return eqx.tree_at(lambda p: p.laplacian, self, moved, is_leaf=lambda x: x is None)

    def linear(self, t, state):
        points, u = state
        return jnp.zeros_like(points), DIFFUSIVITY * self.laplacian(u)

    def rest(self, t, state, args):
        points, u = state
        return self.growth * points, -2 * self.growth * u

    def factors(self, g, state):
        return None, g[None] * DIFFUSIVITY

    def suggested_solver(self):
        return js.IMEX(order=2), "IMEX(order=2): by its author"


def grown(growth=GROWTH):
    return Grown(None, SURFACE, None, jnp.asarray(growth))


def end(growth, solver, steps=4):
    kinds = dict(t1=END, dt0=END / steps, solver=solver)
    points, u = js.integrate(grown(growth), (CLOUD.points, Z), **kinds).ys
    return points[-1], u[-1]


def exact(eigenvalue, t=END, a=GROWTH):
    """The factor of a field with this eigenvalue on the unit sphere."""
    return np.exp(-2 * a * t + DIFFUSIVITY * eigenvalue * (1 - np.exp(-2 * a * t)) / (2 * a))


@pytest.mark.parametrize(
    "solver",
    [js.IMEX(order=2), js.RKC2(), js.SDIRK(order=3), dfx.Heun()],
    ids=lambda solver: type(solver).__name__,
)
def test_heat_on_a_growing_sphere(solver):
    """To what steps leave; the Laplacian goes like 1 / length²."""
    points, u = end(GROWTH, solver)
    assert float(jnp.abs(points - np.exp(GROWTH * END) * CLOUD.points).max()) < 1e-3
    factor = float(jnp.vdot(Z, u) / jnp.vdot(Z, Z))
    eigenvalue = float(jnp.vdot(Z, SURFACE.laplacian(Z)) / jnp.vdot(Z, Z))
    assert abs(eigenvalue + 2) < 0.1
    assert abs(factor / exact(eigenvalue) - 1) < 2e-3
    assert abs(factor / exact(-2) - 1) < 1e-2


def test_derivatives_through_the_geometry():
    """In the rate of growth: through points, stencils and linear solves (to 4e-10)."""
    weights = jnp.exp(CLOUD.points[:, 0])
    f = lambda a: jnp.vdot(weights, Z * end(a, js.IMEX(order=2), steps=2)[1])
    h = 1e-3
    difference = (f(GROWTH + h) - f(GROWTH - h)) / (2 * h)
    third = abs(float(f(GROWTH))) * END**3  # of the size of the third derivative
    assert abs(float(jax.grad(f)(GROWTH) - difference)) < 5e-6 * abs(difference) + h**2 * third


@pytest.mark.core
def test_a_problem_of_ones_own_is_preconditioned():
    """The cycles invert 1 - g L at the geometry of the state, and leave the points alone."""
    problem, state = grown(), (CLOUD.points, jnp.exp(Z))
    assert js.choose_solver(problem)[1].endswith("by its author")
    g = 0.5
    inverse = js.step_preconditioner(problem, state)(g)
    frozen = problem.at(0.0, state)
    left = jax.tree.map(lambda y, k: y - g * k, state, frozen.linear(0.0, state))
    points, u = inverse.mv(left)
    assert bool(jnp.all(points == CLOUD.points))
    assert float(jnp.linalg.norm(u - state[1]) / jnp.linalg.norm(state[1])) < 0.1
    transposed = inverse.transpose()
    a, b = jnp.sin(3 * Z), jnp.cos(2 * CLOUD.points[:, 0])
    zero = 0 * CLOUD.points
    one, other = jnp.vdot(a, inverse.mv((zero, b))[1]), jnp.vdot(transposed.mv((zero, a))[1], b)
    size = jnp.linalg.norm(a) * jnp.linalg.norm(b)
    assert abs(float(one - other)) < 1e-6 * float(size)  # cycles run in single precision


class Misfactored(Grown):
    wrong: object

    def factors(self, g, state):
        return self.wrong(g)


@pytest.mark.core
@pytest.mark.parametrize(
    "wrong", [lambda g: (None, g), lambda g: (None, jnp.ones((2, 3)) * g), lambda g: g[None]]
)
def test_factors_of_another_shape_are_named(wrong):
    problem = Misfactored(None, SURFACE, None, jnp.asarray(GROWTH), wrong)
    with pytest.raises(ValueError, match=r"factors of Misfactored have shapes .*expected \(m,\)"):
        js.step_preconditioner(problem, (CLOUD.points, Z))


@pytest.mark.core
def test_a_preconditioner_of_other_points_is_named():
    other = js.AdvectionDiffusionReaction(js.discretize(js.sphere(300)).laplacian)
    inverse = js.step_preconditioner(other, jnp.zeros(300))
    problem = js.AdvectionDiffusionReaction(SURFACE.laplacian)
    for solver in (js.IMEX(preconditioner=inverse), js.SDIRK(preconditioner=inverse)):
        with pytest.raises(ValueError, match=r"preconditioner is of .* \(300,\), .* \(200,\)"):
            js.integrate(problem, Z, t1=0.1, dt0=0.05, solver=solver)


@pytest.mark.core
def test_what_was_passed_stays_readable():
    turn = jnp.cross(jnp.array([0.0, 0.0, 1.0]), CLOUD.points)
    problem = js.AdvectionDiffusionReaction(gradient=SURFACE.gradient, velocity=turn)
    assert bool(jnp.all(problem.velocity == turn)) and problem.gradient is SURFACE.gradient
