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
