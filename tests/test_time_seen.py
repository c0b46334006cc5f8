"""What is seen of a run between its ends: boundary values, conditions that end it, times."""

import functools

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

import jaxsurf as js
from jaxsurf.time.checkpoint import digest

SURFACE = js.discretize(js.sphere(300))
Z = SURFACE.cloud.points[:, 2]
BOUND = np.asarray(Z > 0.5)
FIRST = int(np.argmax(BOUND))
HEAT = js.AdvectionDiffusionReaction(SURFACE.laplacian)


def exact(t):
    return jnp.exp(-2 * t) * Z


def bound(values):
    return js.eliminate(SURFACE, js.dirichlet(BOUND, lambda t: values(t)[BOUND]))


BOUND_HEAT = js.AdvectionDiffusionReaction(SURFACE.laplacian, closure=bound(exact))
WAVE = js.WaveEquation(SURFACE.laplacian, closure=bound(lambda t: jnp.cos(np.sqrt(2) * t) * Z))


class Fallen(eqx.Module):
    """Whether a bound value has fallen below a share of its first."""

    share: float

    def __call__(self, t, y, args, **_):
        return jax.tree.leaves(y)[0][FIRST] < self.share * Z[FIRST]


def test_boundary_values_are_filled_in_between_steps():
    solution = js.integrate(
        BOUND_HEAT, Z, t1=0.5, rtol=1e-6, atol=1e-8, saveat=dfx.SaveAt(dense=True)
    )
    for t in (0.0, 0.23, 0.5):
        np.testing.assert_allclose(solution.evaluate(t)[BOUND], exact(t)[BOUND], rtol=1e-12)
        np.testing.assert_allclose(solution.evaluate(t), exact(t), atol=5e-3)
    change = solution.evaluate(0.1, 0.3)
    np.testing.assert_allclose(change, solution.evaluate(0.3) - solution.evaluate(0.1), atol=1e-15)
    rate = solution.derivative(0.23)
    np.testing.assert_allclose(rate[BOUND], -2 * exact(0.23)[BOUND], rtol=1e-12)
    step = 1e-5
    change = solution.evaluate(0.23 + step) - solution.evaluate(0.23 - step)
    np.testing.assert_allclose(rate, change / (2 * step), atol=1e-6)


@pytest.mark.parametrize("compiled", [False, True])
@pytest.mark.parametrize("kind", [Fallen, lambda share: lambda *a, **_: Fallen(share)(*a)])
def test_conditions_see_boundary_values(kind, compiled):
    def last(t1):
        how = dict(t1=t1, dt0=0.01, solver=js.IMEX(order=2), event=dfx.Event(kind(0.5)))
        return js.integrate(BOUND_HEAT, Z, **how).ts[-1]

    # The first step after the time itself.
    assert 0.3466 < float((jax.jit(last) if compiled else last)(2.0)) < 0.3566


def test_conditions_of_runs_backwards_are_told_the_time():
    ended = lambda event: js.integrate(
        WAVE, (Z, 0 * Z), t1=-1.0, dt0=-0.01, solver=dfx.Tsit5(), event=dfx.Event(event)
    ).ts[-1]
    assert -0.52 < float(ended(lambda t, y, args, **_: t < -0.5)) <= -0.5
    time = float(np.arccos(0.5) / np.sqrt(2))
    assert -time - 0.02 < float(ended(Fallen(0.5))) <= -time


def test_times_that_round_off_takes_are_refused():
    u = Z.astype(jnp.float32)
    heat = js.AdvectionDiffusionReaction(js.discretize(js.sphere(300)).laplacian)
    with pytest.raises(ValueError, match=r"t0 and t1 are 1e\+08 both in float32"):
        js.integrate(heat, u, t0=1e8, t1=1e8 + 1)
    for state, t0 in ((u, 1e4), (Z, 1e13)):
        with pytest.raises(ValueError, match=r"dt0 = 0\.001 is lost in times from 1"):
            js.integrate(heat, state, t0=t0, t1=t0 + 1, dt0=1e-3)
    # Of no time nothing is lost.
    still = js.integrate(heat, Z, t0=1e17, t1=1e17)
    np.testing.assert_array_equal(still.ys[-1], Z)


def test_what_a_checkpoint_did_not_reach_is_infinite(tmp_path):
    saveat = dfx.SaveAt(ts=jnp.linspace(0, 0.5, 6))
    event = dfx.Event(lambda t, y, args, **_: t > 0.2)
    plain, parts = (
        js.integrate(HEAT, Z, t1=0.5, saveat=saveat, event=event, checkpoint=checkpoint)
        for checkpoint in (None, js.Checkpoint(tmp_path / "run", every=0.5))
    )
    assert np.isinf(plain.ys[-1]).all()
    assert parts.stats["summary"].startswith("RKC2: ")
    assert "to t = 0.2" in parts.stats["summary"]
    np.testing.assert_allclose(parts.ys, plain.ys, atol=1e-12)
    np.testing.assert_array_equal(parts.ts, plain.ts)


LEVEL = [0.45]


class Below(eqx.Module):
    def __call__(self, t, y, args, **_):
        return jnp.max(y) < LEVEL[0]


def test_a_condition_that_computes_something_else_is_another_run(tmp_path):
    how = dict(t1=1.0, event=dfx.Event(Below()))
    checkpoint = js.Checkpoint(tmp_path / "run", every=0.1)
    first = js.integrate(HEAT, Z, checkpoint=checkpoint, **how)
    again = js.integrate(HEAT, Z, checkpoint=checkpoint, **how)
    np.testing.assert_array_equal(again.ts, first.ts)
    assert again.stats["summary"] == first.stats["summary"]
    assert again.stats["solver"] == first.stats["solver"]
    LEVEL[0] = 0.25
    with pytest.raises(ValueError, match="checkpoint of another run"):
        js.integrate(HEAT, Z, checkpoint=checkpoint, **how)


class Thinning(js.AbstractEvolution):
    """Diffusion by a coefficient that is frozen for a step."""

    closure: None
    laplacian: js.AbstractOperator
    coefficient: object = None

    def at(self, t, u):
        held = lambda problem: problem.coefficient
        return eqx.tree_at(held, self, 1 + 0.5 * u**2, is_leaf=lambda x: x is None)

    def linear(self, t, u):
        return self.coefficient * self.laplacian(u)

    def rest(self, t, u, args):
        return -u


class Fed(Thinning):
    """With a source where it does not belong."""

    def linear(self, t, u):
        return super().linear(t, u) + 1


def test_a_linear_part_that_is_not_linear_is_refused():
    for solver in (js.IMEX(order=3), None):
        with pytest.raises(ValueError, match=r"linear of Fed .* gives 1.0 at point 0"):
            js.integrate(Fed(None, SURFACE.laplacian), Z, t1=0.5, solver=solver)


def test_problems_on_moving_surfaces_have_two_phases():
    growth = js.Motion(lambda t, surface, fields, args: 0.3 * surface.cloud.normals)
    given = dict(t1=0.1, fields=0.5 * Z + 0.2, problem=lambda s: Thinning(None, s.laplacian))
    wanted = js.evolve(
        growth, SURFACE.cloud, solver=dfx.Tsit5(), rtol=1e-8, atol=1e-10, **given
    ).fields[-1]
    errors = []
    for dt0 in (0.05, 0.025):
        found = js.evolve(growth, SURFACE.cloud, solver=js.IMEX(order=2), dt0=dt0, **given)
        errors.append(float(jnp.abs(found.fields[-1] - wanted).max()))
    assert errors[-1] < 2e-3
    assert errors[0] / errors[1] > 2.0**1.6, errors


class Turning(js.AbstractMotion):
    slides = True
    slide: object

    def velocity(self, t, surface, fields, args):
        return 0 * surface.cloud.normals

    def sliding(self, t, surface, fields, args):
        return self.slide(surface)


@pytest.mark.parametrize(
    "slide",
    [lambda s: jnp.array([1.0, 0.0, 0.0]), lambda s: s.cloud.points[:, :1], lambda s: 1.0],
)
def test_points_slide_by_a_vector_each(slide):
    with pytest.raises(ValueError, match=r"sliding of Turning has shape .*\(300, 3\)"):
        js.evolve(Turning(slide), SURFACE.cloud, t1=0.1, fields=Z, solver=dfx.Tsit5())


def test_what_slides_stays_on_the_surface():
    with pytest.raises(ValueError, match=r"sliding of Turning leaves the surface at point 0: 1 of"):
        js.evolve(Turning(lambda s: s.cloud.normals), SURFACE.cloud, t1=0.1, fields=Z)


@pytest.mark.parametrize(
    "wrong", [lambda s: jnp.array([0.0, 0.0, 1.0]), lambda s: s.cloud.points[:, :1]]
)
def test_each_part_of_a_sum_is_a_vector_for_each_point(wrong):
    grow = js.Motion(lambda t, surface, fields, args: surface.cloud.normals)
    both = grow + 0.5 * js.Motion(lambda t, surface, fields, args: wrong(surface))
    with pytest.raises(ValueError, match=r"velocity of Motion has shape .*\(300, 3\)"):
        js.evolve(both, SURFACE.cloud, t1=0.1)


RATE = 0.001


@pytest.mark.parametrize("kind", ["compiled", "object", "partial", "of its module"])
def test_optimisers_are_told_apart_by_what_their_schedules_do(kind):
    class Schedule:
        def __init__(self, rate):
            self.rate = rate

        def __call__(self, count):
            return self.rate

    def of_module(rate):
        global RATE
        RATE = rate
        return lambda count: RATE

    made = {
        "compiled": lambda rate: jax.jit(lambda count: rate + 0 * count),
        "object": Schedule,
        "partial": lambda rate: functools.partial(lambda rate, count: rate, rate),
        "of its module": of_module,
    }[kind]
    told = [digest(optax.sgd(made(rate))) for rate in (1e-3, 1e-3, 2e-3)]
    assert told[0] == told[1] != told[2]
