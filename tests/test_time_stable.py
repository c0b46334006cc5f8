"""Steps of given length that would make rubbish of a field are refused, for every solver."""

import re

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxsurf as js
from jaxsurf.time.amplification import amplification_of, log_radius

from .helpers import ring

ANGLES, RING, GRADIENT = ring(24)
TURN = jnp.stack([-jnp.sin(ANGLES), jnp.cos(ANGLES)], axis=1)
NOISE = jnp.asarray(np.random.default_rng(0).normal(size=24))


def turning(velocity=lambda t: 30 * TURN, **given):
    given = dict(diffusivity=1e-4, gradient=GRADIENT) | given
    return js.AdvectionDiffusionReaction(RING, velocity=velocity, **given)


def decaying(t, u, args):
    return -u


def held():
    """A part of the circle, whose last points are held."""
    marked = jnp.arange(24) < 2
    points = jnp.stack([jnp.cos(ANGLES), jnp.sin(ANGLES)], axis=1)
    cloud = js.PointCloud(points, points)
    return js.eliminate(cloud, js.dirichlet(marked))


CASES = {
    "advection and reaction": lambda: turning(30 * TURN, reaction=decaying),
    "a closure": lambda: turning(30 * TURN, closure=held()),
    "a velocity in time": turning,
    "a velocity that begins later": lambda: turning(lambda t: 30 * jnp.sin(t) * TURN),
}


@pytest.mark.parametrize("solver", [js.RKC2(), dfx.ReversibleHeun(), dfx.LeapfrogMidpoint()])
@pytest.mark.parametrize("case", CASES)
def test_what_would_grow_is_refused(case, solver):
    """All of these came back as a success, with values from 1e30 to 1e230."""
    how = dict(t1=8.0, dt0=0.2 if isinstance(solver, js.RKC2) else 0.1, solver=solver)
    problem = CASES[case]()
    with pytest.raises(ValueError, match="is unstable"):
        js.integrate(problem, NOISE, **how)
    code = jax.jit(lambda u: js.integrate(problem, u, **how, throw=False).result)
    assert code(NOISE) == dfx.RESULTS.nonlinear_divergence


def test_the_limit_of_chebyshev_steps_is_where_they_begin_to_grow():
    problem = turning(30 * TURN, diffusivity=0.3, reaction=lambda t, u, args: 0.01 * u)
    with pytest.raises(ValueError, match="RKC2 is stable up to") as caught:
        js.integrate(problem, NOISE, t1=40.0, dt0=0.2, solver=js.RKC2())
    limit = float(re.findall(r"up to ([\d.e+-]+),", str(caught.value))[0])
    u = js.integrate(problem, NOISE, t1=300 * limit, dt0=0.9 * limit, solver=js.RKC2()).ys[-1]
    assert float(jnp.abs(u).max()) < 3 * float(jnp.abs(NOISE).max())
    # Diffusion alone is stable for any step, and so is what grows by itself.
    heat = js.AdvectionDiffusionReaction(RING, reaction=lambda t, u, args: 0.5 * u)
    u = js.integrate(heat, 1 + 0 * NOISE, t1=4.0, dt0=0.5, solver=js.RKC2()).ys[-1]
    np.testing.assert_allclose(u, np.exp(2.0), rtol=2e-2)


@pytest.mark.parametrize(
    "solver",
    [
        js.RKC2(), js.RKC2(spectral_radius=300.0), js.IMEX(order=4), dfx.Heun(),
        dfx.HalfSolver(dfx.Euler()), dfx.LeapfrogMidpoint(), dfx.ReversibleHeun(),
        js.AdamsBashforth2(),
    ],
    ids=[
        "RKC2", "RKC2, radius given", "IMEX", "Heun", "halves", "leapfrog", "reversible",
        "Bashforth",
    ],
)  # fmt: skip
def test_amplification_is_what_a_solver_does(solver):
    """The norm of a field after many steps of a linear problem, and the radius of one step."""
    matrix = np.random.default_rng(1).normal(size=(3, 3)) - 3 * np.eye(3)
    product = lambda t, u, args: jnp.asarray(matrix) @ u
    one = isinstance(solver, js.IMEX)
    half = lambda t, u, args: product(t, u, args) / 2
    terms = dfx.MultiTerm(*[dfx.ODETerm(half)] * 2) if one else dfx.ODETerm(product)
    step, count = 0.1, 400
    parts = [step * matrix / 2] * 2 if one else [step * matrix]
    found = amplification_of(solver)(step, parts)
    expected = float(log_radius(found))
    np.testing.assert_allclose(log_radius(jnp.asarray(found)), expected, rtol=1e-6)
    save = dfx.SaveAt(ts=step * np.array([count / 2, count]))
    given = dict(saveat=save, stepsize_controller=dfx.ConstantStepSize(), throw=False)
    start = jnp.array([1.0, 2.0, -1.0])
    ys = dfx.diffeqsolve(terms, solver, 0.0, step * count, step, start, **given).ys
    half_way, end = np.log(np.linalg.norm(ys, axis=1))
    np.testing.assert_allclose((end - half_way) / (count / 2), expected, atol=0.02)


def test_steps_to_given_times_are_looked_at():
    problem = turning(30 * TURN, reaction=decaying)
    steps = dfx.StepTo(jnp.linspace(0, 8.0, 21))
    with pytest.raises(ValueError, match=r"a step of 0.4 is unstable: Tsit5 .* a controller that"):
        js.integrate(problem, NOISE, t1=8.0, controller=steps, solver=dfx.Tsit5())
    fine = dfx.StepTo(jnp.linspace(0, 0.5, 101))
    js.integrate(problem, NOISE, t1=0.5, controller=fine, solver=dfx.Tsit5())


class Midpoint(dfx.AbstractSolver):
    """A solver of one's own; with a matrix of the problem it is no function of its terms."""

    matrix: jax.Array | None = None

    term_structure = dfx.AbstractTerm
    interpolation_cls = dfx.LocalLinearInterpolation

    def order(self, terms):
        return 2

    def init(self, terms, t0, t1, y0, args):
        return None

    def func(self, terms, t0, y0, args):
        return terms.vf(t0, y0, args)

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        y0 = y0 if self.matrix is None else self.matrix @ y0
        half = y0 + terms.vf_prod(t0, y0, args, terms.contr(t0, t1)) / 2
        y1 = y0 + terms.vf_prod((t0 + t1) / 2, half, args, terms.contr(t0, t1))
        return y1, None, dict(y0=y0, y1=y1), None, dfx.RESULTS.successful


class Growing(dfx.AbstractStepSizeController):
    """A controller of one's own, whose steps grow up to a length, whatever their errors."""

    longest: float

    def wrap(self, direction):
        return self

    def init(self, terms, t0, t1, y0, dt0, args, func, error_order):
        return t0 + 0.01, None

    def adapt_step_size(self, t0, t1, y0, y1, args, y_error, error_order, state):
        end = t1 + jnp.minimum(1.3 * (t1 - t0), self.longest)
        return jnp.asarray(True), t1, end, jnp.asarray(False), state, dfx.RESULTS.successful


class Leapfrog(Midpoint):
    """With the state before, and a first step of Euler's."""

    def init(self, terms, t0, t1, y0, args):
        return y0 - terms.vf_prod(t0, y0, args, terms.contr(t0, t1))

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        y1 = solver_state + 2 * terms.vf_prod(t0, y0, args, terms.contr(t0, t1))
        return y1, None, dict(y0=y0, y1=y1), y0, dfx.RESULTS.successful


class BackwardDifferences(Midpoint):
    """Of second order, on vectors, by the Jacobian; its first step is Euler's, and too long."""

    def init(self, terms, t0, t1, y0, args):
        return y0, jnp.asarray(True)

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        before, first = solver_state
        rate = lambda y: terms.vf_prod(t1, y, args, terms.contr(t0, t1))
        matrix = jnp.eye(y0.size) - 2 / 3 * jax.jacobian(rate)(y0)
        later = jnp.linalg.solve(matrix, (4 * y0 - before) / 3)
        y1 = jnp.where(first, y0 + rate(y0), later)
        return y1, None, dict(y0=y0, y1=y1), (y0, jnp.asarray(False)), dfx.RESULTS.successful


def test_solvers_with_a_memory_are_measured_behind_their_start():
    """The first came back with 6e50, the second was refused."""
    heat = js.AdvectionDiffusionReaction(RING, reaction=lambda t, u, args: 0.2 * u)
    step = 0.25 * float(ANGLES[1]) ** 2
    run = lambda solver, dt: js.integrate(heat, NOISE, t1=100 * dt, dt0=dt, solver=solver).ys[-1]
    with pytest.raises(ValueError, match="Leapfrog is stable"):
        run(Leapfrog(), 0.5 * step)
    end = run(BackwardDifferences(), 5 * step)
    decayed = np.mean(NOISE) * np.exp(0.2 * 500 * step)
    assert abs(float(jnp.mean(end)) - decayed) < 0.1 * abs(decayed)


class Adapting(Growing):
    """By the error of each step: near the limit of stability, now and then beyond it."""

    def adapt_step_size(self, t0, t1, y0, y1, args, y_error, error_order, state):
        error = jnp.sqrt(jnp.mean((y_error / (self.longest * (1e-3 + jnp.abs(y1)))) ** 2))
        keep = error < 1
        factor = jnp.clip(0.9 * (error + 1e-10) ** (-1 / error_order), 0.2, 3.0)
        step = (t1 - t0) * jnp.where(keep, factor, jnp.minimum(factor, 0.9))
        start = jnp.where(keep, t1, t0)
        return keep, start, start + step, jnp.asarray(False), state, dfx.RESULTS.successful


def test_what_grows_by_itself_is_not_laid_to_steps_that_follow_errors():
    """It was stopped when it had grown a hundredfold."""
    growth = js.AdvectionDiffusionReaction(RING, reaction=lambda t, u, args: 3 * u)
    how = dict(t1=3.0, solver=dfx.Heun(), controller=Adapting(1e-2))
    end = js.integrate(growth, 1 + 0.1 * NOISE, **how).ys[-1]
    mean = 1 + 0.1 * float(jnp.mean(NOISE))
    np.testing.assert_allclose(float(jnp.mean(end)), mean * np.exp(9.0), rtol=2e-2)


def test_a_solver_of_ones_own_is_looked_at():
    """Fields came back with values of 2e13; nothing bounds what a reaction may make of them."""
    heat = js.AdvectionDiffusionReaction(RING, reaction=lambda t, u, args: 0.2 * u)
    limit = 2 / (4 / float(ANGLES[1]) ** 2 - 0.2)
    run = lambda dt, solver: js.integrate(heat, NOISE, t1=200 * dt, dt0=dt, solver=solver)
    assert float(jnp.abs(run(0.95 * limit, Midpoint()).ys[-1]).max()) < 10
    with pytest.raises(
        ValueError, match=rf"Midpoint is stable up to {limit:.2g}.*Shorter steps, or js.RKC2"
    ):
        run(1.1 * limit, Midpoint())
    # Nothing can be said of this one, and nothing is.
    assert run(0.95 * limit, Midpoint(jnp.eye(24))).result == dfx.RESULTS.successful


def test_steps_that_lead_beyond_all_numbers_are_refused_in_single_precision():
    """Sixteen of them overflow, and that was taken for stable."""
    rate = -np.linspace(0, 320, 8)
    with jax.enable_x64(False):
        for dt, grows in ((1e-3, False), (0.05, True), (0.2, True), (5.0, True)):
            z = jnp.asarray(np.diag(dt * rate), jnp.float32)
            growth = amplification_of(Midpoint()).growth(jnp.float32(dt), [z])
            assert bool(growth > 1) == grows


@pytest.mark.parametrize("solver", [dfx.Heun(), Midpoint(), js.IMEX(order=2)])
def test_steps_of_a_controller_of_ones_own_are_watched(solver):
    """Fields came back with values of 2e9 to 2e13, from zero too."""
    pushed = lambda t, u, args: 0.2 * u + jnp.cos(5 * ANGLES)
    fast = turning(30 * TURN, reaction=pushed)
    for start in (NOISE, 0 * NOISE):
        run = lambda longest, problem=fast, start=start, **given: js.integrate(
            problem, start, t1=8.0, solver=solver, controller=Growing(longest), **given
        )
        with pytest.raises(js.IntegrationError, match=r"stable in steps up to .*=Growing"):
            run(0.4)
        assert run(0.4, throw=False).result == dfx.RESULTS.nonlinear_divergence
    code = jax.jit(lambda u: run(0.4, start=u, throw=False).result)
    assert code(NOISE) == dfx.RESULTS.nonlinear_divergence
    # What grows by itself is left alone, by a hundredfold too.
    growth = js.AdvectionDiffusionReaction(RING, reaction=lambda t, u, args: u)
    end = run(0.03, growth, 1 + 0 * NOISE).ys[-1]
    np.testing.assert_allclose(end, np.exp(8.0), rtol=5e-3)


def test_what_is_stiff_between_the_times_looked_at_is_found_as_it_grows():
    """A damping that lasts for two steps made 5e6 of a field of size one; growth is none of it."""
    pulse = lambda t, u, args: jnp.where((t > 0.53) & (t < 0.55), -3e3, 0.0) * u
    run = lambda reaction, **given: js.integrate(
        js.AdvectionDiffusionReaction(RING, reaction=reaction), NOISE, t1=0.6, **given
    )
    given = dict(solver=js.IMEX(order=2), dt0=0.01)
    with pytest.raises(ValueError, match=r"dt0 = 0.01 is unstable at t = 0.5[345]"):
        run(pulse, **given)
    assert float(jnp.abs(run(pulse, **given, throw=False).ys[-1]).max()) > 1e4
    assert float(jnp.abs(run(pulse).ys[-1]).max()) < 1e-3
    grown = run(lambda t, u, args: (15 + jnp.sin(t)) * u, **given)
    assert float(jnp.abs(grown.ys[-1]).max()) > 1e3


def test_backwards_in_time_the_rate_has_the_other_sign():
    growth = js.AdvectionDiffusionReaction(
        gradient=GRADIENT, velocity=0 * TURN, reaction=lambda t, u, args: 500 * u
    )
    with pytest.warns(UserWarning, match="upwind"), pytest.raises(ValueError, match="is unstable"):
        js.integrate(growth, NOISE, t0=1.0, t1=0.0, dt0=-0.05, solver=dfx.Tsit5())


def test_two_halves_are_two_steps():
    """Twice as long steps are stable as of the method that is halved: they were refused."""
    radius = 2 * (1 - np.cos(np.pi)) / float(ANGLES[1]) ** 2
    heat, how = js.AdvectionDiffusionReaction(RING), dict(solver=dfx.HalfSolver(dfx.Euler()))
    u = js.integrate(heat, NOISE, t1=3.0, dt0=3.8 / radius, **how).ys[-1]
    assert float(jnp.abs(u).max()) <= float(jnp.abs(NOISE).max())
    with pytest.raises(ValueError, match="HalfSolver is stable up to"):
        js.integrate(heat, NOISE, t1=30.0, dt0=4.3 / radius, **how)


def test_implicit_explicit_solvers_of_diffrax_are_looked_at():
    roots = dfx.VeryChord(rtol=1e-8, atol=1e-10)
    problem = turning(30 * TURN, reaction=decaying)
    for solver in (dfx.KenCarp4(root_finder=roots), dfx.Sil3(root_finder=roots)):
        with pytest.raises(ValueError, match=r"is stable up to .* of the explicit part"):
            js.integrate(problem, NOISE, t1=8.0, dt0=0.2, solver=solver)


CIRCLE = js.discretize(js.circle(60), method=js.GFDM(degree=4))
SLOW = js.Motion(lambda t, surface, fields, args: 0.01 * surface.cloud.normals)


def spun(surface):
    x = surface.cloud.points
    velocity = 30 * jnp.stack([-x[:, 1], x[:, 0]], axis=1)
    given = dict(diffusivity=1e-4, gradient=surface.gradient, velocity=velocity)
    return js.AdvectionDiffusionReaction(surface.laplacian, **given)


def quick_decay(surface):
    fast = lambda t, u, args: -500 * u
    return js.AdvectionDiffusionReaction(surface.laplacian, reaction=fast)


@pytest.mark.parametrize(
    "solver, problem, step",
    [
        (js.IMEX(), quick_decay, 0.02),
        (js.IMEX(order=1), quick_decay, 0.02),
        (js.IMEX(order=2), spun, 0.05),
        (js.RKC2(), spun, 0.05),
    ],
    ids=["IMEX, reaction", "IMEX1, reaction", "IMEX, advection", "RKC2, advection"],
)
def test_on_surfaces_that_move(solver, problem, step):
    """Fields came back with values of 1e109, 1e122 and 1e91."""
    u = jnp.asarray(np.random.default_rng(0).normal(size=60))
    given = dict(fields=u, problem=problem, solver=solver)
    with pytest.raises(ValueError, match="is unstable") as caught:
        js.evolve(SLOW, CIRCLE, t1=1.0, dt0=step, **given)
    limit = float(re.findall(r"up to ([\d.e+-]+),", str(caught.value))[0])
    end = js.evolve(SLOW, CIRCLE, t1=min(1.0, 100 * limit), dt0=0.9 * limit, **given)
    assert float(jnp.abs(end.fields[-1]).max()) < 5 * float(jnp.abs(u).max())


def test_implicit_parts_of_motions_may_be_as_stiff_as_they_like():
    flow = js.evolve(js.MeanCurvatureFlow(), CIRCLE, t1=0.2, solver=js.IMEX(order=2), dt0=0.02)
    radii = jnp.linalg.norm(flow.clouds[-1].points, axis=1)
    np.testing.assert_allclose(radii, np.sqrt(1 - 0.2), rtol=2e-3)
