"""Runge–Kutta–Chebyshev: order, stability, number of stages, derivatives."""

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxsurf as js
from jaxsurf.time.chebyshev import table

CLOUD = js.sphere(300)
METHOD = js.DCPSE(order=2)
NEIGHBORS = js.choose_neighbors(CLOUD, method=METHOD)
LAPLACIAN = js.laplace_beltrami(CLOUD, NEIGHBORS, method=METHOD)
RADIUS = js.spectral_estimate(LAPLACIAN).radius


def stability_polynomial(s, z):
    """What a step of s stages makes of u' = λ u with Δt λ = z."""
    rows = table(s)[s]
    one = np.ones_like(z)
    last, before = one + rows[1, 3] * z, one
    for j in range(2, s + 1):
        mu, nu, mu_k, gamma_k, _ = rows[j]
        new = (1 - mu - nu) + mu * last + nu * before + mu_k * z * last + gamma_k * z
        last, before = new, last
    return last


@pytest.mark.parametrize("s", [2, 3, 5, 20, 100])
def test_stability_polynomial(s):
    z = np.array([-1e-2, -1e-3])
    defect = stability_polynomial(s, z) - np.exp(z)
    assert np.polyfit(np.log(-z), np.log(np.abs(defect)), 1)[0] > 2.9
    reach = (s - 1) ** 2 / 1.54 - 1  # the longest step that is taken with s stages
    z = -np.linspace(0, max(reach, 0.1), 4001)
    assert np.abs(stability_polynomial(s, z)).max() <= 1 + 1e-12
    assert np.abs(stability_polynomial(s, z[z < -1])).max(initial=0) < 0.97


def heat(dt, solver, u0, t1=0.5, **settings):
    term = dfx.ODETerm(lambda t, u, args: LAPLACIAN(u))
    return dfx.diffeqsolve(term, solver, 0.0, t1, dt, u0, **settings)


def test_second_order_for_a_nonlinear_problem_in_time():
    """u' = cos(t) u² of which the solution is known; all stages and their nodes count."""
    term = dfx.ODETerm(lambda t, u, args: jnp.cos(t) * u**2)
    u0 = jnp.array([0.2, 0.5])
    exact = u0 / (1 - u0 * np.sin(1.0))
    errors = []
    for dt in (0.1, 0.05, 0.025):
        solver = js.RKC2(spectral_radius=40 / dt)  # seven stages
        u = dfx.diffeqsolve(term, solver, 0.0, 1.0, dt, u0).ys[-1]
        errors.append(float(jnp.abs(u - exact).max()))
    assert errors[-1] < 2e-3
    assert np.polyfit(np.log([4, 2, 1]), np.log(errors), 1)[0] > 1.9


def test_error_estimate_is_an_upper_bound_of_the_local_error():
    """The published weights give 9/5 of the error for many stages: on the safe side."""
    term = dfx.ODETerm(lambda t, u, args: -u)
    solver = js.RKC2(spectral_radius=4_000.0)
    u0 = jnp.array([1.0])
    state = solver.init(term, 0.0, 0.1, u0, None)
    u1, error, *_ = solver.step(term, 0.0, 0.1, u0, None, state, False)
    ratio = float(error[0] / (u1[0] - np.exp(-0.1)))
    assert -2.0 < ratio < -1.5


def test_long_steps_are_stable_and_stages_grow_with_their_root():
    calls = 0

    def count(u):
        nonlocal calls
        calls += 1
        return u

    counted = dfx.ODETerm(
        lambda t, u, args: jax.pure_callback(count, u, LAPLACIAN(u), vmap_method="sequential")
    )
    noise = jnp.asarray(np.random.default_rng(0).normal(size=CLOUD.n))
    for reach in (100.0, 10_000.0):
        dt = reach / RADIUS
        calls = 0
        solution = dfx.diffeqsolve(counted, js.RKC2(1.05 * RADIUS), 0.0, 4 * dt, dt, noise)
        jax.block_until_ready(solution.ys)
        stages = 1 + int(np.sqrt(1 + 1.54 * 1.05 * reach))
        assert 4 * stages <= calls <= 4 * stages + 3  # one more at the start
        assert float(jnp.linalg.norm(solution.ys[-1])) < 0.5 * float(jnp.linalg.norm(noise))


def test_radius_is_estimated_when_it_is_not_given():
    u0 = jnp.exp(CLOUD.points[:, 2])
    given = heat(0.05, js.RKC2(1.2 * RADIUS), u0).ys[-1]
    found = heat(0.05, js.RKC2(), u0).ys[-1]
    np.testing.assert_array_less(jnp.abs(found - given), 2e-3)
    solver = js.RKC2()
    term = dfx.ODETerm(lambda t, u, args: LAPLACIAN(u))
    state = solver.init(term, 0.0, 0.1, u0, None)
    state = solver.step(term, 0.0, 0.1, u0, None, state, False)[3]  # the first step needs it
    assert 1.0 < float(state.radius) / RADIUS < 1.3


def test_too_many_stages_are_refused():
    u0 = jnp.exp(CLOUD.points[:, 2])
    solver = js.RKC2(RADIUS, max_stages=5)
    assert solver.reach == pytest.approx(16 / 1.54 - 1)
    stopped = heat(0.5, solver, u0, throw=False)
    assert stopped.result == dfx.RESULTS.nonlinear_divergence
    controller = dfx.PIDController(rtol=1e-3, atol=1e-6)
    adapted = heat(0.5, solver, u0, stepsize_controller=controller)
    assert float(0.5 / adapted.stats["num_accepted_steps"]) < 1.1 * solver.reach / RADIUS
    with pytest.raises(ValueError, match="max_stages = 1"):
        js.RKC2(max_stages=1)


def test_nothing_is_traced_again_when_the_number_of_stages_changes():
    traces = 0

    def rate(t, u, args):
        nonlocal traces
        traces += 1
        return LAPLACIAN(u)

    @jax.jit
    def run(u0, radius, dt):
        return dfx.diffeqsolve(dfx.ODETerm(rate), js.RKC2(radius), 0.0, 0.5, dt, u0).ys[-1]

    u0 = jnp.exp(CLOUD.points[:, 2])
    run(u0, RADIUS, 0.1)
    before = traces
    run(u0, 10 * RADIUS, 0.05)
    assert traces == before


@pytest.mark.parametrize("reach", [3.0, 900.0], ids=["3 stages", "38 stages: several intervals"])
def test_derivatives(reach):
    """In the state, the operator, and a parameter that the right-hand side closes over."""
    rng = np.random.default_rng(1)
    u0 = jnp.exp(CLOUD.points[:, 2])
    inputs = (u0, LAPLACIAN.weights, jnp.asarray(0.7))
    direction = jax.tree.map(lambda x: x * jnp.asarray(rng.normal(size=x.shape)), inputs)
    dt = reach / RADIUS

    def scalar(inputs, loop="checkpointed", adjoint=dfx.RecursiveCheckpointAdjoint()):
        u0, weights, factor = inputs
        laplacian = js.Stencil(LAPLACIAN.indices, weights)
        term = dfx.ODETerm(lambda t, u, args: laplacian(u) + factor * jnp.sin(t) * u * (1 - u))
        solver = js.RKC2(1.5 * RADIUS, loop=loop)
        u = dfx.diffeqsolve(term, solver, 0.0, 3 * dt, dt, u0, adjoint=adjoint).ys[-1]
        return jnp.sum(u**2 * CLOUD.points[:, 0] + u)

    moved = lambda h: jax.tree.map(lambda x, d: x + h * d, inputs, direction)
    value = jax.jit(scalar)
    slope = lambda h: float(value(moved(h)) - value(moved(-h))) / (2 * h)
    expected = (4 * slope(5e-5) - slope(1e-4)) / 3
    gradient = jax.jit(jax.grad(scalar))(inputs)
    reverse = sum(
        jax.tree.leaves(jax.tree.map(lambda g, d: float(jnp.vdot(g, d)), gradient, direction))
    )
    forward = jax.jit(
        lambda: jax.jvp(lambda x: scalar(x, "lax", dfx.ForwardMode()), (inputs,), (direction,))[1]
    )()
    np.testing.assert_allclose(reverse, expected, rtol=1e-6)
    np.testing.assert_allclose(float(forward), reverse, rtol=1e-10)


def test_derivatives_of_a_bounded_loop():
    """They were NaN in reverse: a length that is zero at the start of the stages was among them."""
    z = CLOUD.points[:, 2]
    dt = 2 / RADIUS

    def size(factor, loop, adjoint):
        how = dict(saveat=dfx.SaveAt(t1=True), adjoint=adjoint, max_steps=3)
        term = dfx.ODETerm(lambda t, u, args: LAPLACIAN(u))
        solver = js.RKC2(1.5 * RADIUS, max_stages=4, loop=loop)
        u = dfx.diffeqsolve(term, solver, 0.0, 2 * dt, dt, factor * z, **how).ys[-1]
        return jnp.sum(u**2)

    usual = jax.grad(size)(1.0, "checkpointed", dfx.RecursiveCheckpointAdjoint())
    found = jax.grad(size)(1.0, "bounded", dfx.DirectAdjoint())
    np.testing.assert_allclose(found, usual, rtol=1e-12)


@pytest.mark.parametrize("twice", [jax.hessian, lambda f: jax.grad(jax.grad(f))])
def test_second_derivatives(twice):
    """An error of JAX: derivatives went through power iterations, by what the rate closes over."""

    def size(factor):
        problem = js.AdvectionDiffusionReaction(LAPLACIAN, diffusivity=factor)
        how = dict(t1=0.1, dt0=0.02, solver=js.RKC2(), max_steps=8, adjoint=dfx.DirectAdjoint())
        return jnp.mean(js.integrate(problem, CLOUD.points[:, 2], **how).ys[-1] ** 2)

    # Of the mean of z² exp(-4 factor t).
    value, found = jax.jit(lambda x: (size(x), twice(size)(x)))(1.0)
    np.testing.assert_allclose(found, 0.4**2 * value, rtol=2e-2)


def test_states_of_several_parts_and_batches():
    u0 = jnp.exp(CLOUD.points[:, 2])
    term = dfx.ODETerm(lambda t, y, args: (LAPLACIAN(y[0]), LAPLACIAN(y[1])))
    solver = js.RKC2(1.2 * RADIUS)
    pair = dfx.diffeqsolve(term, solver, 0.0, 0.2, 0.1, (u0, 2 * u0)).ys
    np.testing.assert_allclose(pair[1], 2 * pair[0], rtol=1e-12)
    single = lambda u: heat(0.1, solver, u, t1=0.2).ys[-1]
    batch = eqx.filter_vmap(single)(jnp.stack([u0, 2 * u0]))
    np.testing.assert_allclose(batch[0], pair[0][-1], rtol=1e-12)


def test_output_between_steps_is_of_second_order():
    z = CLOUD.points[:, 2]
    times = jnp.linspace(0.0, 0.5, 21)
    ys = heat(0.05, js.RKC2(1.2 * RADIUS), z, saveat=dfx.SaveAt(ts=times)).ys
    decay = jnp.linalg.norm(ys, axis=1) / jnp.linalg.norm(z)
    np.testing.assert_allclose(decay, jnp.exp(-2 * times), rtol=3e-3)


def test_single_precision_stays_single():
    with jax.enable_x64(False):
        u0 = jnp.asarray(np.asarray(CLOUD.points[:, 2]), jnp.float32)
        laplacian = js.Stencil(LAPLACIAN.indices, jnp.asarray(LAPLACIAN.weights, jnp.float32))
        term = dfx.ODETerm(lambda t, u, args: laplacian(u))
        u = dfx.diffeqsolve(term, js.RKC2(), 0.0, 0.5, 0.1, u0).ys[-1]
    assert u.dtype == jnp.float32
    assert float(jnp.linalg.norm(u) / jnp.linalg.norm(u0)) == pytest.approx(np.exp(-1.0), rel=0.02)


def swing(t, y, args):
    """y'' = -(1 + sin(t)) y."""
    return jnp.stack([y[1], -(1 + jnp.sin(t)) * y[0]])


def bashforth(y0, steps=None, *, dt=None, dtype=jnp.float64):
    with_steps = {} if steps is None else {"stepsize_controller": dfx.StepTo(steps)}
    term, zero = dfx.ODETerm(swing), jnp.zeros((), dtype)
    return dfx.diffeqsolve(term, js.AdamsBashforth2(), zero, zero + 2, dt, y0, **with_steps).ys[-1]


@pytest.mark.parametrize("spread", [1.0, 1.5], ids=["one length", "several"])
def test_second_order_from_the_step_before(spread):
    y0 = jnp.array([1.0, 0.3])
    fine = dfx.PIDController(rtol=1e-12, atol=1e-12)
    exact = dfx.diffeqsolve(
        dfx.ODETerm(swing), dfx.Dopri8(), 0.0, 2.0, 0.01, y0, stepsize_controller=fine
    ).ys[-1]
    errors = []
    for count in (40, 80, 160):
        end = bashforth(y0, 2 * jnp.linspace(0, 1, count + 1) ** spread)
        errors.append(float(jnp.abs(end - exact).max()))
    assert errors[-1] < 5e-4
    assert np.polyfit(np.log([4, 2, 1]), np.log(errors), 1)[0] > 1.9


def test_derivatives_of_steps_from_the_step_before():
    y0, way = jnp.array([1.0, 0.3]), jnp.array([0.6, -0.8])
    end = jax.jit(lambda y: jnp.sum(bashforth(y, dt=0.05) ** 2))
    slope = (end(y0 + 1e-5 * way) - end(y0 - 1e-5 * way)) / 2e-5
    assert float(jax.grad(end)(y0) @ way) == pytest.approx(float(slope), rel=1e-7)
    several = jax.vmap(lambda y: bashforth(y, dt=0.05))(jnp.stack([y0, 2 * y0]))
    np.testing.assert_allclose(several[1], 2 * several[0], rtol=1e-12)
    single = bashforth(y0.astype(jnp.float32), dt=0.05, dtype=jnp.float32)
    assert single.dtype == jnp.float32
    np.testing.assert_allclose(single, several[0], atol=1e-5)


def test_after_a_jump_the_step_before_tells_nothing():
    """A step of y' = 1, and one of y' = -1 after it."""
    solver, y0, one = js.AdamsBashforth2(), jnp.array(0.0), jnp.array(1.0)
    up, down = (dfx.ODETerm(lambda t, y, args, sign=sign: sign * one) for sign in (1, -1))
    state = solver.init(up, 0.0, 0.1, y0, None)
    y1, _, _, state, _ = solver.step(up, 0.0, 0.1, y0, None, state, False)
    for jumped, expected in ((jnp.array(True), 0.0), (jnp.array(False), 0.2)):
        end = solver.step(down, 0.1, 0.2, y1, None, state, jumped)[0]
        assert float(end) == pytest.approx(expected, abs=1e-12)
