"""Problems in time in their other forms: mapped, differentiated, in single precision."""

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg

import jaxsurf as js

from .helpers import check_derivatives, operations, relative_error
from .test_solve_forms import single

pytestmark = pytest.mark.slow

METHOD = js.GFDM(degree=2)
CLOUD = js.sphere(200)
LISTS = js.find_neighbors(CLOUD, k=24)
LAPLACIAN = js.laplace_beltrami(CLOUD, LISTS, method=METHOD)
X, Y, Z = CLOUD.points.T
WAVE = jnp.exp(0.5 * X) - 1


class Drift(js.AbstractEvolution):
    """A problem of one's own: diffusion, and a reaction that pulls towards the values ±1."""

    closure: None
    laplacian: js.AbstractOperator
    pull: jax.Array

    def linear(self, t, u):
        return self.laplacian(u)

    def rest(self, t, u, args):
        return self.pull * (u - u**3)


def waves(laplacian, speed, u):
    return js.WaveEquation(laplacian, speed=speed, damping=0.3), (u, 0 * u)


# Each a function of the operator, a number and the state; the number; the solver.
PROBLEMS = {
    "CahnHilliard": (
        lambda laplacian, width, u: (js.CahnHilliard(laplacian, width=width), u),
        0.5, js.IMEX(order=4),
    ),
    "WaveEquation": (waves, 1.3, dfx.Tsit5()),
    "BiharmonicDiffusion": (
        lambda laplacian, k, u: (js.BiharmonicDiffusion(laplacian, stiffness=k), u),
        0.2, js.IMEX(order=3),
    ),
    "AbstractEvolution": (
        lambda laplacian, pull, u: (Drift(None, laplacian, pull), u), 2.0, js.SDIRK(order=4),
    ),
}  # fmt: skip


def run(name, laplacian, u0, cycles: bool = False):
    """The state at t = 0.1, as a function of the problem's own number."""
    made, number, solver = PROBLEMS[name]
    if cycles:  # set up for one number, used for others
        solver = js.IMEX(
            order=3, preconditioner=js.step_preconditioner(made(laplacian, number, u0)[0], u0)
        )

    def end(number):
        problem, start = made(laplacian, number, u0)
        ys = js.integrate(problem, start, t1=0.1, dt0=0.0125, solver=solver).ys
        return jnp.stack([y[-1] for y in jax.tree.leaves(ys)])

    return end


def two_of(name):
    return PROBLEMS[name][1] * jnp.array([1.0, 1.5])


@pytest.fixture(scope="module")
def alone():
    """The states that two numbers of a problem lead to, each by itself."""
    found = {}

    def states(name):
        if name not in found:
            end = jax.jit(run(name, LAPLACIAN, WAVE))
            found[name] = [end(number) for number in two_of(name)]
        return found[name]

    return states


def test_mapped(alone):
    """Linear systems are solved to 4e-10 of their right-hand sides, mapped or not."""
    name = "AbstractEvolution"
    found = jax.jit(jax.vmap(run(name, LAPLACIAN, WAVE)))(two_of(name))
    assert relative_error(found, jnp.stack(alone(name))) < 1e-8


def exponential_of(name, number):
    """The state of a linear problem, by the exponential of its matrix."""
    matrix, u = LAPLACIAN.to_scipy().toarray(), np.asarray(WAVE)
    if name == "BiharmonicDiffusion":
        return scipy.linalg.expm(-0.1 * number * matrix @ matrix) @ u
    own = np.eye(len(u))
    both = np.block([[0 * own, own], [number**2 * matrix, -0.3 * own]])
    return scipy.linalg.expm(0.1 * both) @ np.append(u, 0 * u)


@pytest.mark.parametrize("name", PROBLEMS)
def test_mapped_in_single_precision(name, alone):
    """Two numbers at once, to 1e-3: against exponentials, or each by itself in 64 bits.

    For the stiffest problem with multigrid.
    """
    numbers = two_of(name)
    with jax.enable_x64(False):
        cycles = name == "BiharmonicDiffusion"
        end = run(name, *single((LAPLACIAN, WAVE)), cycles)
        found = jax.jit(jax.vmap(end))(single(numbers))
        assert found.dtype == jnp.float32
    if name in ("BiharmonicDiffusion", "WaveEquation"):
        expected = [exponential_of(name, float(number)) for number in numbers]
    else:
        expected = [state.ravel() for state in alone(name)]
    assert relative_error(expected[1], expected[0]) > 1e-2  # there are two of them
    for i in range(2):
        assert relative_error(np.asarray(found[i], float).ravel(), expected[i]) < 1e-3


@pytest.mark.parametrize("name", ["BiharmonicDiffusion", "AbstractEvolution"])
def test_rates_are_differentiable_in_every_array(name):
    """In the operator, the problem's own number and the state."""
    made, number, _ = PROBLEMS[name]

    def total(weights, number, u):
        problem, u = made(js.Stencil(LAPLACIAN.indices, weights), number, u)
        split = problem.implicit_rate(0.0, u, None) + 2 * problem.explicit_rate(0.0, u, None)
        return jnp.vdot(jnp.cos(Y), split + 3 * problem.rate(0.0, u, None))

    check_derivatives(total, LAPLACIAN.weights, jnp.asarray(number), WAVE, step=1e-3)


@pytest.mark.parametrize("adjoint", [None, dfx.ForwardMode()], ids=["reverse", "forward"])
def test_derivatives_at_a_state_of_zeros(adjoint):
    """Where an unknown initial state is often started from; the problem is linear."""

    def last(u):
        problem = js.AdvectionDiffusionReaction(LAPLACIAN, diffusivity=0.3)
        return js.integrate(problem, u, t0=0.0, t1=0.1, dt0=0.02, adjoint=adjoint).ys[-1]

    image = last(WAVE)
    if adjoint is None:
        slope = jax.grad(lambda u: jnp.vdot(X, last(u)))(0 * X)
        assert abs(jnp.vdot(slope, WAVE) / jnp.vdot(X, image) - 1) < 1e-9
    else:
        slope = jax.jvp(last, (0 * X,), (WAVE,))[1]
        assert relative_error(slope, image) < 1e-9


def test_inverses_of_steps_under_transformations():
    """Of 1 - g L for two g at once, as one after the other; in single precision to 1e-4."""
    field = jnp.exp(X) * Y

    def inverse(laplacian, field):
        problem = js.CahnHilliard(laplacian, width=0.3)
        made = js.step_preconditioner(problem, field)
        return lambda g: made(g).mv(field)

    plain = inverse(LAPLACIAN, field)
    one = jax.jit(plain)
    steps = jnp.array([1e-3, 1e-1])
    alone = jnp.stack([one(g) for g in steps])
    assert relative_error(alone[1], alone[0]) > 0.1
    # The cycles are in single precision in any case.
    np.testing.assert_allclose(jax.jit(jax.vmap(plain))(steps), alone, rtol=1e-5, atol=1e-6)
    with jax.enable_x64(False):
        found = jax.jit(inverse(*single((LAPLACIAN, field))))(jnp.float32(0.1))
        assert found.dtype == jnp.float32
    assert relative_error(np.asarray(found, float), alone[1]) < 1e-4


# --- steady states --------------------------------------------------------------------------


def rest_of(laplacian, start):
    """The mean of the steady state of u' = Δu - (u - a), that is a, and when it was met."""
    problem = js.AdvectionDiffusionReaction(laplacian, reaction=lambda t, u, args: args - u)

    def mean(a):
        found = js.integrate(problem, start, t1=1e3, args=a, event=js.steady_state())
        return jnp.mean(found.ys[-1]), found.ts[-1]

    return mean


def test_steady_states_mapped_and_differentiated():
    """Each ends at a time of its own, as alone; what is left is of the size of the tolerance."""
    values = jnp.array([1.0, 30.0])
    mapped = jax.jit(jax.vmap(jax.value_and_grad(rest_of(LAPLACIAN, Z), has_aux=True)))
    (found, times), slopes = mapped(values)
    alone = jax.jit(rest_of(LAPLACIAN, Z))
    np.testing.assert_allclose(
        jnp.stack([found, times], axis=1), [alone(a) for a in values], rtol=1e-9
    )
    np.testing.assert_allclose(found, values, rtol=1e-3)
    np.testing.assert_allclose(slopes, 1.0, rtol=1e-3)
    assert times.max() < 20 and times[0] != times[1]


def test_steady_state_in_single_precision():
    with jax.enable_x64(False):
        value, time = jax.jit(rest_of(*single((LAPLACIAN, Z))))(jnp.float32(3))
        assert value.dtype == time.dtype == jnp.float32
    np.testing.assert_allclose(value, 3, rtol=1e-3)
    assert time < 20


# --- damping --------------------------------------------------------------------------------


def test_hyperviscosity_under_transformations():
    """In the operator, the speed and the radius; proportional to the speed; also in float32."""
    radius = jnp.asarray(js.spectral_estimate(LAPLACIAN).radius)

    def damped(weights, speed, radius, u):
        operator = js.Stencil(LAPLACIAN.indices, weights)
        return js.hyperviscosity(operator, speed, spectral_radius=radius)(u)

    total = lambda *at: jnp.vdot(jnp.cos(Y), damped(*at))
    inputs = (LAPLACIAN.weights, jnp.asarray(1.5), radius, WAVE)
    check_derivatives(total, *inputs, step=1e-3)
    speeds = jnp.array([1.5, 3.0])
    plain = js.hyperviscosity(LAPLACIAN, 1.5)(WAVE)
    mapped = jax.jit(jax.vmap(lambda speed: damped(inputs[0], speed, *inputs[2:])))(speeds)
    size = float(jnp.abs(plain).max())
    np.testing.assert_allclose(mapped, jnp.stack([plain, 2 * plain]), atol=1e-10 * size)
    with jax.enable_x64(False):
        laplacian, u = single((LAPLACIAN, WAVE))
        found = js.hyperviscosity(laplacian, 1.5, spectral_radius=float(radius))(u)
        assert found.dtype == jnp.float32
    np.testing.assert_allclose(found, plain, atol=2e-3 * size)  # as for `biharmonic`


def test_upwinding_mapped_and_in_single_precision():
    """Proportional to the velocity; without 64 bits to 2e-4, as other operators."""
    angles = jnp.linspace(0, 2 * jnp.pi, 60, endpoint=False)
    points = jnp.stack([jnp.cos(angles), jnp.sin(angles)], axis=1)
    circle, turn = js.PointCloud(points, points), points[:, ::-1] * jnp.array([-1.0, 1.0])
    lists, u = js.find_neighbors(circle, k=9), jnp.sin(3 * angles)

    def damped(cloud, lists, velocity, u):
        return js.upwind_viscosity(cloud, velocity, neighbors=lists, method=METHOD)(u)

    both = jnp.stack([turn, 2 * turn])
    found = jax.jit(jax.vmap(lambda v: damped(circle, lists, v, u)))(both)
    # That of upwind differences, h u'' / 2, to the accuracy of the second derivative.
    expected = -np.sin(np.pi / 60) * 9 * u
    size = float(jnp.abs(expected).max())
    np.testing.assert_allclose(found[0], expected, atol=0.05 * size)
    np.testing.assert_allclose(found[1], 2 * found[0], atol=1e-10 * size)
    with jax.enable_x64(False):
        circle, lists, turn, u = single((circle, lists, turn, u))
        alone = jax.jit(lambda v: damped(circle, lists, v, u))(turn)
        assert alone.dtype == jnp.float32
    np.testing.assert_allclose(alone, found[0], atol=2e-4 * size)


@pytest.mark.parametrize(
    "solver, places",
    [
        (js.RKC2(), 1),
        (js.IMEX(order=3), 1),
        # Newton's residual is at three more: its start, its derivative, its steps.
        (js.SDIRK(order=3), 4),
        # So are steps of given length, which are looked at.
        (js.AdamsBashforth2(), 2),
    ],
    ids=lambda x: type(x).__name__,
)
def test_a_rate_stands_at_few_places_of_the_program(solver, places):
    """It may take seconds to compile."""
    problem = js.AdvectionDiffusionReaction(LAPLACIAN, reaction=lambda t, u, args: jax.lax.erf(u))
    given = dict(dt0=0.01) if isinstance(solver, js.AdamsBashforth2) else {}
    run = lambda u: js.integrate(problem, u, t1=0.1, solver=solver, **given).ys
    program = jax.make_jaxpr(run)(WAVE).jaxpr
    assert sum(op.primitive.name == "erf" for op in operations(program)) == places


class Path(dfx.AbstractPath):
    """Of two controls, t and t squared."""

    t0: float = 0.0
    t1: float = 1.0

    def evaluate(self, t0, t1=None, left=True):
        at = lambda t: jnp.stack([t, t**2])
        return at(t0) if t1 is None else at(t1) - at(t0)


@pytest.mark.parametrize("solver", [js.IMEX(order=3), js.SDIRK(order=3), js.AdamsBashforth2()])
def test_rates_need_not_look_like_states(solver):
    """With two controls a rate has two columns: x' = -x + 2 t, from 1."""
    rate = lambda t, y, args: jnp.stack([-y, jnp.ones_like(y)], axis=1)
    control, nothing = dfx.ControlTerm(rate, Path()), dfx.ODETerm(lambda t, y, args: 0 * y)
    terms = dfx.MultiTerm(control, nothing) if isinstance(solver, js.IMEX) else control
    end = dfx.diffeqsolve(terms, solver, 0.0, 1.0, 0.01, jnp.ones(3)).ys[-1]
    np.testing.assert_allclose(end, 3 * np.exp(-1), rtol=1e-4)
