"""IMEX and SDIRK steps: order, stiffness, failure, derivatives, no matrices."""

import diffrax as dfx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import pytest

import jaxsurf as js
from jaxsurf.time.implicit import _IMEX, _SDIRK
from jaxsurf.time.relative import relative

from .helpers import made_in, ring

pytestmark = pytest.mark.slow

# A circle, as stiff as 300 points on the sphere, of which the eigenvalues are known.
ANGLES, LAPLACIAN, _ = ring(24)
N, X, Z = len(ANGLES), jnp.cos(ANGLES), jnp.sin(ANGLES)
SLOW = float(-2 * (1 - jnp.cos(ANGLES[1])) / ANGLES[1] ** 2)  # of cos and sin
SOLVERS = [
    js.IMEX(order=1),
    js.IMEX(order=2),
    js.IMEX(order=3),
    js.IMEX(order=4),
    js.SDIRK(order=3),
    js.SDIRK(order=4),
]
NAMES = [f"{type(s).__name__}{s.scheme}" for s in SOLVERS]


def trees(order):
    """Conditions for a Runge–Kutta method of this order: b·φ and its value, for b, c, A."""
    yield lambda b, c, A: b.sum(), 1
    if order >= 2:
        yield lambda b, c, A: b @ c, 1 / 2
    if order >= 3:
        yield lambda b, c, A: b @ c**2, 1 / 3
        yield lambda b, c, A: b @ A @ c, 1 / 6
    if order >= 4:
        yield lambda b, c, A: b @ c**3, 1 / 4
        yield lambda b, c, A: (b * c) @ A @ c, 1 / 8
        yield lambda b, c, A: b @ A @ c**2, 1 / 12


@pytest.mark.core
@pytest.mark.parametrize("order, tableau", [*_IMEX.items(), *_SDIRK.items()])
def test_tableaus_satisfy_the_order_conditions(order, tableau):
    """Also mixed ones (explicit and implicit matrices), and one order lower when embedded."""
    implicit = tableau.implicit + np.diag(tableau.diagonal)
    explicit = tableau.explicit
    assert np.ptp(tableau.diagonal[1:]) == 0
    c, parts = tableau.nodes, [*zip((explicit, implicit), tableau.weights, strict=True)]
    whole = order in _SDIRK and tableau is _SDIRK[order]
    for A, b in parts[1:] if whole else parts:
        np.testing.assert_allclose(A.sum(axis=1), c, atol=1e-12)
        for condition, value in trees(order):
            assert condition(b, c, A) == pytest.approx(value, abs=1e-12)
        for condition, value in trees(order - 1):
            assert condition(b - tableau.errors, c, A) == pytest.approx(value, abs=1e-12)


def reaction(t, u, args):
    return u - u**3 + 0.3 * jnp.sin(t) * args


def problem(factor=1.0, laplacian=LAPLACIAN):
    return js.AdvectionDiffusionReaction(laplacian, diffusivity=factor, reaction=reaction)


@pytest.fixture(scope="module")
def exact():
    u0 = jnp.exp(X) - 1
    tight = dict(solver=dfx.Dopri8(), rtol=1e-11, atol=1e-11)
    return u0, js.integrate(problem(), u0, t1=0.5, args=1.0, **tight).ys[-1]


_ANGLES8, MILD, _ = ring(8)  # eigenvalues down to -6.5
_X8 = jnp.cos(_ANGLES8)
_SLOW8 = float(-2 * (1 - jnp.cos(_ANGLES8[1])) / _ANGLES8[1] ** 2)


def mild(t):
    """A field that solves the equation with the reaction below, exactly in space."""
    return (1 + 0.5 * jnp.sin(2 * t)) * _X8


def manufactured_mild(t, u, args):
    v, change = mild(t), jnp.cos(2 * t) * _X8
    return (u - u**3) + change - _SLOW8 * v - (v - v**3)


@pytest.mark.parametrize("kind", [js.IMEX, js.SDIRK])
@pytest.mark.parametrize("order", [1, 2, 3, 4])
def test_order_of_steps_that_are_not_stiff(kind, order):
    """Linear systems solved well, no mode faster than the steps."""
    if kind is js.SDIRK and order < 3:
        pytest.skip(f"there is none of order {order}")
    one = js.AdvectionDiffusionReaction(MILD, reaction=manufactured_mild)
    solver = kind(order=order, tolerance=1e-10)
    errors = []
    # (IMEX of order 4 is there already, and BiCGStab stops short on its almost single mode.)
    early = kind is js.IMEX and order == 4
    counts = (8, 16) if early else (32, 128)
    for steps in counts:
        u = js.integrate(one, mild(0.0), t1=1.0, solver=solver, dt0=1 / steps).ys[-1]
        errors.append(float(jnp.abs(u - mild(1.0)).max()))
    assert errors[-1] < (1e-5 if early else {1: 1e-2, 2: 1e-5, 3: 1e-6, 4: 1e-8}[order])
    slope = np.log(errors[0] / errors[1]) / np.log(counts[1] / counts[0])
    assert slope > {1: 0.9, 2: 1.8, 3: 2.7, 4: 3.6}[order]


# Least slopes with stiff modes, each more than a method of one order less can have. The stages of
# SDIRK are of order 2: with modes faster than the steps its order is between 3 and its own.
STIFF = {"IMEX1": 0.9, "IMEX2": 1.9, "IMEX3": 2.9, "IMEX4": 3.9, "SDIRK3": 2.7, "SDIRK4": 3.4}


@pytest.mark.parametrize("solver", SOLVERS, ids=NAMES)
def test_order(solver, exact):
    u0, expected = exact
    errors = []
    for steps in (10, 20):
        u = js.integrate(problem(), u0, t1=0.5, args=1.0, solver=solver, dt0=0.5 / steps).ys[-1]
        errors.append(float(jnp.linalg.norm(u - expected) / jnp.linalg.norm(expected)))
    largest = {1: 5e-2, 2: 2e-3, 3: 5e-4, 4: 1e-4}[solver.scheme]
    assert errors[-1] < largest
    slope = np.log2(errors[0] / errors[1])
    assert slope > STIFF[f"{type(solver).__name__}{solver.scheme}"], slope


@pytest.mark.core
@pytest.mark.parametrize("solver", [js.IMEX(order=3), js.SDIRK(order=3)], ids=["IMEX", "SDIRK"])
def test_long_steps_damp_noise(solver):
    noise = jnp.asarray(np.random.default_rng(0).normal(size=N))
    radius = js.spectral_estimate(LAPLACIAN).radius
    dt = 1e4 / radius
    u = js.integrate(
        js.AdvectionDiffusionReaction(LAPLACIAN), noise, t1=2 * dt, dt0=dt, solver=solver
    )
    assert float(jnp.ptp(u.ys[-1])) < 1e-3


def test_stiff_reaction():
    """Robertson's kinetics at every point, rate constants 0.04 to 3e7, against SciPy's Radau."""
    from scipy.integrate import solve_ivp

    def rate(u):
        a, b, c = u[..., 0], u[..., 1], u[..., 2]
        slow, fast = 0.04 * a - 1e4 * b * c, 3e7 * b**2
        return jnp.stack([-slow, slow - fast, fast], axis=-1)

    reference = solve_ivp(
        lambda t, u: np.asarray(rate(u)), (0, 40), [1, 0, 0], method="Radau", rtol=1e-8, atol=1e-12
    ).y[:, -1]
    cloud = js.sphere(100)
    u0 = jnp.zeros((100, 3)).at[:, 0].set(1)
    kinetics = js.AdvectionDiffusionReaction(
        js.laplace_beltrami(cloud), diffusivity=0.1, reaction=lambda t, u, args: rate(u)
    )
    # A tolerance for the linear systems that small concentrations need too.
    solver = js.SDIRK(order=4, tolerance=1e-12)
    solution = js.integrate(kinetics, u0, t1=40.0, solver=solver, rtol=1e-5, atol=1e-9)
    np.testing.assert_allclose(solution.ys[-1], np.tile(reference, (100, 1)), rtol=1e-3)
    assert int(solution.stats["num_steps"]) < 200


@pytest.mark.parametrize(
    "solver",
    [js.RKC2(max_stages=30), dfx.Tsit5(), js.IMEX(order=3), js.SDIRK(order=4)],
    ids=["RKC2", "Tsit5", "IMEX3", "SDIRK4"],  # orders differ by their tableaux alone
)
def test_derivatives(solver):
    """In the state, the operator, a coefficient and `args`; and no n × n array on the way."""
    # Explicit steps of 0.1 would be unstable, and are refused.
    dt0 = 0.02 if isinstance(solver, dfx.Tsit5) else 0.1
    weigh, operator = X, LAPLACIAN
    u0 = jnp.exp(Z) - 1
    inputs = (u0, LAPLACIAN.weights, jnp.asarray(0.8), jnp.asarray(0.5))
    rng = np.random.default_rng(0)
    direction = jax.tree.map(lambda x: x * jnp.asarray(rng.normal(size=x.shape)), inputs)

    def scalar(inputs, adjoint=dfx.RecursiveCheckpointAdjoint(checkpoints=2)):
        u0, weights, factor, args = inputs
        changed = problem(factor, js.Stencil(operator.indices, weights))
        how = dict(solver=solver, dt0=dt0, args=args, adjoint=adjoint)
        u = js.integrate(changed, u0, t1=0.2, **how)
        return jnp.sum(u.ys[-1] ** 2 * (1 + weigh))

    value, gradient = jax.jit(scalar), jax.jit(jax.grad(scalar))
    moved = lambda h: jax.tree.map(lambda x, d: x + h * d, inputs, direction)
    slope = lambda h: float(value(moved(h)) - value(moved(-h))) / (2 * h)
    expected = (4 * slope(1e-4) - slope(2e-4)) / 3
    products = jax.tree.map(lambda g, d: float(jnp.vdot(g, d)), gradient(inputs), direction)
    np.testing.assert_allclose(sum(jax.tree.leaves(products)), expected, rtol=1e-6)
    tangent = jax.jit(
        lambda: jax.jvp(lambda x: scalar(x, dfx.ForwardMode()), (inputs,), (direction,))
    )
    np.testing.assert_allclose(float(tangent()[1]), expected, rtol=1e-6)

    n = 200  # the look at stability keeps 51 pairs of vectors
    _, wide, _ = ring(n)
    inputs = (jnp.ones(n), wide.weights, *inputs[2:])
    dt0 = dt0 / 50
    weigh, operator = jnp.ones(n), wide
    program = jax.make_jaxpr(jax.grad(scalar))(inputs)
    assert max(np.prod(shape, dtype=int) for shape, _ in made_in(program.jaxpr)) < n**2


def test_linear_systems_that_are_not_solved_are_reported():
    u0 = jnp.exp(Z)
    weak = js.IMEX(order=3, solver=lx.BiCGStab(rtol=0.0, atol=1e-10, max_steps=2), tolerance=1e-10)
    with pytest.raises(js.IntegrationError, match="a system in it was not solved") as caught:
        js.integrate(js.AdvectionDiffusionReaction(LAPLACIAN), u0, t1=1.0, dt0=0.5, solver=weak)
    assert caught.value.time == 0.0
    np.testing.assert_array_equal(caught.value.state, u0)


def jumping(t, u, args):
    return jnp.where(t < 0.5, 0.0, 10.0) + 0 * u


@pytest.mark.parametrize(
    "solver", [js.RKC2(), js.IMEX(order=3), js.SDIRK(order=3)], ids=["RKC2", "IMEX", "SDIRK"]
)
def test_a_jump_of_the_forcing_is_taken_note_of(solver):
    """The rate at the start of a step is that before the jump: it must be computed anew."""
    one = js.AdvectionDiffusionReaction(LAPLACIAN, reaction=jumping)
    inner = dfx.PIDController(rtol=1e-6, atol=1e-8)
    controller = dfx.ClipStepSizeController(inner, jump_ts=jnp.array([0.5]))
    solution = js.integrate(one, 0 * X, t1=1.0, solver=solver, controller=controller)
    np.testing.assert_allclose(solution.ys[-1], 5.0, rtol=1e-8)
    assert int(solution.stats["num_rejected_steps"]) == 0


@pytest.mark.parametrize("field", ["zero", "constant", "eigenvector"])
def test_systems_with_a_simple_answer_are_solved(field):
    """A multiple of the right-hand side solves them: BiCGStab alone divides zero by zero."""
    right = dict(zero=0 * X, constant=1 + 0 * X, eigenvector=X)[field]
    operator = lx.FunctionLinearOperator(
        lambda u: u - 0.1 * LAPLACIAN(u), jax.eval_shape(lambda: X)
    )
    found = lx.linear_solve(operator, right, relative(None, None, right), throw=False)
    assert found.result == lx.RESULTS.successful
    np.testing.assert_allclose(operator.mv(found.value), right, atol=1e-8)


def test_derivatives_by_systems_that_are_not_solved_are_refused():
    """Newton steps may be solved roughly, and converge; the tangent has one chance."""
    weak = lx.BiCGStab(rtol=0.0, atol=1e-12, max_steps=3)
    solver = js.SDIRK(order=3, solver=weak, tolerance=1e-8, newton_steps=200)
    one = js.AdvectionDiffusionReaction(LAPLACIAN)

    def scalar(factor, adjoint=None):
        u = js.integrate(one, factor * jnp.exp(X), t1=0.5, dt0=0.5, solver=solver, adjoint=adjoint)
        return jnp.sum(u.ys[-1] ** 2)

    assert np.isfinite(scalar(1.0))

    def refused(derivative):
        """Not a number, or an error of the linear solver."""
        try:
            return np.isnan(derivative())
        except RuntimeError as error:
            return "linear solve" in str(error)

    forward = lambda x: scalar(x, dfx.ForwardMode())
    assert refused(lambda: jax.jvp(forward, (1.0,), (1.0,))[1])
    assert refused(lambda: jax.grad(scalar)(1.0))


def test_newton_that_fails_shortens_the_step():
    """u' = -u³ · 1e4 from u = 10: a step of the whole interval is out of reach."""
    one = js.AdvectionDiffusionReaction(LAPLACIAN, reaction=lambda t, u, args: -1e4 * u**3)
    u0 = jnp.full(N, 10.0)
    solver = js.SDIRK(order=3, newton_steps=2)
    solution = js.integrate(one, u0, t1=1e-2, solver=solver, rtol=1e-3, atol=1e-6)
    exact = 1 / np.sqrt(1 / 100 + 2e4 * 1e-2)
    np.testing.assert_allclose(solution.ys[-1], exact, rtol=1e-2)
    with pytest.raises(js.IntegrationError, match="diverged"):
        js.integrate(one, u0, t1=10.0, dt0=10.0, solver=solver)


@pytest.mark.core
@pytest.mark.parametrize("kind", [js.IMEX, js.SDIRK])
def test_unknown_order(kind):
    with pytest.raises(ValueError, match="order = 7, there are"):
        kind(order=7)
