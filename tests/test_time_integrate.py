"""The call that integrates: choices, outputs, events, failures, files, memory."""

import logging
import re
import warnings

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxsurf as js
from jaxsurf.time.guard import Guard, guarded

from .helpers import count_compilations, operations, ring

CLOUD = js.sphere(300)
LAPLACIAN = js.laplace_beltrami(CLOUD)
Z = CLOUD.points[:, 2]
HEAT = js.AdvectionDiffusionReaction(LAPLACIAN)
# A circle, of which the eigenvalues are known.
ANGLES, RING, RING_GRADIENT = ring(24)
SLOPES = -2 * (1 - np.cos(np.arange(24) * 2 * np.pi / 24)) / float(ANGLES[1]) ** 2
RING_HEAT = js.AdvectionDiffusionReaction(RING)
RING_TURN = jnp.stack([-jnp.sin(ANGLES), jnp.cos(ANGLES)], axis=1)
NOISE = jnp.asarray(np.random.default_rng(0).normal(size=24))


def test_the_choice_is_told(caplog):
    with caplog.at_level(logging.INFO, logger="jaxsurf"):
        solution = js.integrate(HEAT, Z, t1=0.1)
    assert "RKC2" in caplog.text
    assert solution.stats["solver"].startswith("RKC2: diffusion")
    given = js.integrate(HEAT, Z, t1=0.1, solver=js.IMEX(order=2))
    assert given.stats["solver"] == "IMEX: given"
    fourth = js.BiharmonicDiffusion(LAPLACIAN)
    assert isinstance(js.choose_solver(fourth)[0], js.IMEX)


def test_diffrax_solvers_and_controllers_are_taken():
    exact = jnp.exp(-0.2) * Z
    for solver in (dfx.Dopri5(), dfx.Bosh3()):
        u = js.integrate(HEAT, Z, t1=0.1, solver=solver).ys[-1]
        np.testing.assert_allclose(u, exact, atol=3e-3)
    controller = dfx.PIDController(rtol=1e-3, atol=1e-5, dtmax=0.01)
    solution = js.integrate(HEAT, Z, t1=0.1, controller=controller)
    assert int(solution.stats["num_accepted_steps"]) >= 10


def test_outputs():
    times = jnp.linspace(0, 0.4, 5)
    saveat = dfx.SaveAt(t0=True, ts=times[1:])
    solution = js.integrate(HEAT, Z, t1=0.4, saveat=saveat, rtol=1e-6, atol=1e-8)
    np.testing.assert_allclose(solution.ts, times, atol=1e-15)
    norms = jnp.linalg.norm(solution.ys, axis=1) / jnp.linalg.norm(Z)
    np.testing.assert_allclose(norms, jnp.exp(-2 * times), rtol=5e-3)
    total = dfx.SaveAt(
        subs=[dfx.SubSaveAt(t1=True), dfx.SubSaveAt(ts=times, fn=lambda t, y, args: y.sum())]
    )
    fields, sums = js.integrate(HEAT, Z, t1=0.4, saveat=total).ys
    assert fields.shape == (1, 300) and sums.shape == (5,)
    dense = js.integrate(HEAT, Z, t1=0.4, saveat=dfx.SaveAt(dense=True))
    np.testing.assert_allclose(dense.evaluate(0.2), jnp.exp(-0.4) * Z, atol=5e-3)


def test_back_in_time_for_a_wave():
    wave = js.WaveEquation(LAPLACIAN)
    there = js.integrate(wave, (Z, 0 * Z), t1=1.0, rtol=1e-8, atol=1e-9).ys
    back = js.integrate(wave, (there[0][-1], there[1][-1]), t0=1.0, t1=0.0, rtol=1e-8, atol=1e-9).ys
    np.testing.assert_allclose(back[0][-1], Z, atol=1e-6)


def test_steady_state_ends_the_run():
    solution = js.integrate(HEAT, 1 + Z, t1=1e3, event=js.steady_state())
    assert solution.result == dfx.RESULTS.event_occurred
    assert float(solution.ts[-1]) < 20
    np.testing.assert_allclose(solution.ys[-1], 1.0, atol=1e-3)


def test_progress_bar(capfd):
    js.integrate(HEAT, Z, t1=0.1, progress=True)
    jax.effects_barrier()
    assert "100" in capfd.readouterr().err


def test_a_given_step_is_kept():
    solution = js.integrate(HEAT, Z, t1=0.5, dt0=0.125)
    assert int(solution.stats["num_steps"]) == 4


def test_works_under_jit_and_vmap_as_outside():
    run = lambda u, d: js.integrate(
        js.AdvectionDiffusionReaction(LAPLACIAN, diffusivity=d), u, t1=0.2
    ).ys[-1]
    plain = run(Z, 0.5)
    np.testing.assert_allclose(jax.jit(run)(Z, 0.5), plain, rtol=1e-12)
    batch = jax.vmap(run)(jnp.stack([Z, 2 * Z]), jnp.array([0.5, 0.5]))
    np.testing.assert_allclose(batch[0], plain, rtol=1e-12)


def test_the_gradient_is_the_same_with_few_copies_of_the_state():
    def scalar(u, adjoint=None):
        return jnp.sum(js.integrate(HEAT, u, t1=0.5, dt0=0.01, adjoint=adjoint).ys[-1] ** 2)

    many = jax.grad(scalar)(Z)
    few = jax.grad(scalar)(Z, dfx.RecursiveCheckpointAdjoint(checkpoints=3))
    np.testing.assert_allclose(few, many, rtol=1e-12, atol=1e-15)


@pytest.mark.parametrize("solver, dt0", [(js.RKC2(), 0.05), (dfx.Tsit5(), None)])
def test_the_gradient_is_that_of_loops_with_all_numbers_apart(solver, dt0):
    """Also with an event, times between and several of them at once."""
    event = dfx.Event(lambda t, y, args, **_: jnp.max(y) < 0.5)
    saveat = dfx.SaveAt(ts=jnp.linspace(0, 0.4, 4), t1=True)

    def scalar(u, adjoint=None):
        found = js.integrate(
            HEAT, u, t1=0.5, dt0=dt0, solver=solver, event=event, saveat=saveat, adjoint=adjoint
        )
        ys = jnp.where(jnp.isfinite(found.ys), found.ys, 0)  # none after the event
        return jnp.sum(ys**2) + found.ts[-1]

    apart = dfx.RecursiveCheckpointAdjoint(64)
    batch = jnp.stack([Z, 1.5 * Z])
    together, alone = (
        jax.vmap(jax.value_and_grad(lambda u, adjoint=adjoint: scalar(u, adjoint)))(batch)
        for adjoint in (None, apart)
    )
    jax.tree.map(
        lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-15), together, alone
    )


def test_the_last_step_is_taken_where_the_state_of_every_step_is_kept():
    """Of 64 states at most; in times that are not exact."""

    def scalar(u, count, adjoint=None):
        run = js.integrate(HEAT, u, t0=0.1, t1=0.4, dt0=0.3 / count, adjoint=adjoint)
        return jnp.sum(run.ys**2)

    for count in (1, 61, 62, 63, 64, 65):
        value, slopes = jax.value_and_grad(scalar)(Z, count)
        assert float(scalar(Z, count)) == pytest.approx(float(value), rel=1e-13)
        other = jax.grad(scalar)(Z, count, dfx.RecursiveCheckpointAdjoint(100))
        np.testing.assert_allclose(slopes, other, rtol=1e-11, atol=1e-15)


def test_loops_differentiated_in_reverse_keep_their_counters_in_one_array():
    def copies(adjoint=None):
        """Arrays of 64 whole numbers that the loop over the steps carries."""

        def run(u):
            solution = js.integrate(HEAT, u, t1=0.5, dt0=0.05, solver=js.RKC2(), adjoint=adjoint)
            return jnp.sum(solution.ys)

        copied = lambda a: a.shape[:1] == (64,) and jnp.issubdtype(a.dtype, jnp.integer)
        program = operations(jax.make_jaxpr(jax.grad(run))(Z).jaxpr)
        loops = [operation for operation in program if operation.primitive.name == "while"]
        return max(sum(copied(v.aval) for v in loop.outvars) for loop in loops)

    assert copies() <= copies(dfx.RecursiveCheckpointAdjoint(64)) - 8


def test_derivatives_in_start_and_end_where_solutions_may_grow():
    """d/dt1 and d/dt0 of the decay by diffusion and reaction, at rate 2 + 1."""
    problem = js.AdvectionDiffusionReaction(LAPLACIAN, reaction=lambda t, u, args: -u)
    end = lambda times: jnp.vdot(Z, js.integrate(problem, Z, t0=times[0], t1=times[1]).ys[-1])
    value, slopes = jax.value_and_grad(end)(jnp.array([0.1, 0.3]))
    np.testing.assert_allclose(slopes, 3 * value * jnp.array([1, -1]), rtol=1e-2)


# --- failures ------------------------------------------------------------------------------


def test_forward_mode_by_an_adjoint_that_has_none():
    problem = js.AdvectionDiffusionReaction(LAPLACIAN)
    end = lambda factor: js.integrate(problem, factor * Z, t1=0.1).ys[-1]
    with pytest.raises(TypeError, match=r"reverse mode only: .* adjoint=diffrax.ForwardMode\(\)"):
        jax.jacfwd(end)(1.0)


def test_explosion_keeps_the_last_good_state():
    """u' = u² from 1 explodes at t = 1."""
    problem = js.AdvectionDiffusionReaction(LAPLACIAN, reaction=lambda t, u, args: u**2)
    with pytest.raises(js.IntegrationError, match="no step is short enough") as caught:
        js.integrate(problem, 1 + 0 * Z, t1=2.0)
    error = caught.value
    assert 0.99 < error.time < 1.01
    assert bool(jnp.all(jnp.isfinite(error.state))) and float(error.state.max()) > 100
    assert error.solution.result == dfx.RESULTS.dt_min_reached
    assert "steps were accepted" in str(error) and "RKC2" in str(error)


def test_an_infinite_trial_is_followed_by_a_shorter_step():
    """Infinite errors by infinite values are no number, nor would any step that follows be."""
    controller = guarded(dfx.PIDController(1e-5, 1e-7), Guard(jnp.array(jnp.inf), jnp.array(False)))
    y, infinite = jnp.ones(2), jnp.array([jnp.inf, 0.0])
    start = (jnp.array(1.0), jnp.array(1.0), False)
    kept, _, end, *_ = controller.adapt_step_size(0.0, 1.0, y, infinite, None, infinite, 5.0, start)
    assert not kept and 0 < end < 1


@pytest.mark.parametrize(
    "solver, limit", [(dfx.Tsit5(), 3.47), (dfx.Euler(), 2.0)], ids=["Tsit5", "Euler"]
)
def test_unstable_steps_are_refused_with_the_numbers(solver, limit):
    """The limits are where the stability polynomials leave the unit disk, known for these two."""
    radius = float(-SLOPES.min())
    for factor in (0.95, 1.1):
        how = dict(u0=NOISE, t1=400 * limit / radius, dt0=factor * limit / radius, solver=solver)
        if factor < 1:
            u = js.integrate(RING_HEAT, **how).ys[-1]
            assert float(jnp.abs(u).max()) <= float(jnp.abs(NOISE).max())
            continue
        with pytest.raises(ValueError, match="is unstable") as caught:
            js.integrate(RING_HEAT, **how)
        told = [
            float(x)
            for x in re.findall(r"up to ([\d.e+-]+), .* is ([\d.e+-]+);", str(caught.value))[0]
        ]
        np.testing.assert_allclose(told, [limit / radius, radius], rtol=0.02)
        quiet = js.integrate(RING_HEAT, throw=False, **how)
        assert quiet.result == dfx.RESULTS.nonlinear_divergence
        np.testing.assert_array_equal(quiet.ys[-1], NOISE)
        # Under `jit` a result code, also with a reaction.
        problem = js.AdvectionDiffusionReaction(RING, reaction=lambda t, u, args: -u)
        code = jax.jit(
            lambda u, how=how, p=problem: js.integrate(p, **how | dict(u0=u), throw=False).result
        )
        assert code(NOISE) == dfx.RESULTS.nonlinear_divergence


def test_explicit_steps_for_waves_are_judged_on_the_imaginary_axis():
    """Heun's method amplifies them by 1 + (ω Δt)⁴ / 8 each: many steps are too many."""
    wave = js.WaveEquation(RING)
    omega = np.sqrt(-SLOPES.min())
    start = (NOISE, 0 * NOISE)
    js.integrate(wave, start, t1=20 * 0.3 / omega, dt0=0.3 / omega, solver=dfx.Heun())
    with pytest.raises(ValueError, match="Heun is stable up to"):
        js.integrate(wave, start, t1=3_000 * 0.3 / omega, dt0=0.3 / omega, solver=dfx.Heun())
    growing = js.AdvectionDiffusionReaction(RING, reaction=lambda t, u, args: 5 * u)
    u = js.integrate(growing, 1 + 0 * NOISE, t1=1.0, dt0=0.01, solver=dfx.Tsit5()).ys[-1]
    np.testing.assert_allclose(u, np.exp(5.0), rtol=1e-6)  # what grows by itself may


@pytest.mark.parametrize("order", [2, 3, 4])
def test_imex_steps_whose_explicit_part_is_unstable_are_refused(order):
    """Turning with little diffusion, and a fast reaction: 1e121 came back as a success."""
    turn = dict(gradient=RING_GRADIENT, velocity=30 * RING_TURN)
    problem = js.AdvectionDiffusionReaction(RING, diffusivity=1e-4, **turn)
    solver = js.IMEX(order=order)
    with pytest.raises(ValueError, match=r"IMEX is stable up to .* of the explicit part") as caught:
        js.integrate(problem, NOISE, t1=20.0, dt0=0.2, solver=solver)
    limit = float(re.findall(r"up to ([\d.e+-]+),", str(caught.value))[0])
    u = js.integrate(problem, NOISE, t1=150 * limit, dt0=0.95 * limit, solver=solver).ys[-1]
    assert float(jnp.abs(u).max()) < 3 * float(jnp.abs(NOISE).max())
    with pytest.raises(ValueError, match="is unstable"):
        js.integrate(problem, NOISE, t1=150 * limit, dt0=1.1 * limit, solver=solver)
    decay = js.AdvectionDiffusionReaction(RING, reaction=lambda t, u, args: -500 * u)
    quiet = js.integrate(decay, NOISE, t1=3.0, dt0=0.05, solver=solver, throw=False)
    assert quiet.result == dfx.RESULTS.nonlinear_divergence
    # What is treated implicitly may be as stiff as it likes.
    u = js.integrate(RING_HEAT, NOISE, t1=6.0, dt0=1.0, solver=solver).ys[-1]
    assert float(jnp.abs(u).max()) < float(jnp.abs(NOISE).max())


def test_what_a_flow_compresses_grows_no_faster_than_that():
    """RKC2's steps are not made for advection alone: they are refused, or stopped where they are
    adapted to a tolerance that is none."""
    turn = dict(gradient=RING_GRADIENT, velocity=30 * RING_TURN)
    problem = js.AdvectionDiffusionReaction(RING, diffusivity=1e-4, **turn)
    with pytest.raises(ValueError, match="RKC2 is stable up to"):
        js.integrate(problem, NOISE, t1=40.0, dt0=0.2, solver=js.RKC2())
    loose = dict(controller=dfx.PIDController(rtol=1e3, atol=1e3, dtmax=0.2), dt0=0.2)
    with pytest.raises(js.IntegrationError, match="no solution of this problem grows beyond"):
        js.integrate(problem, NOISE, t1=40.0, solver=js.RKC2(), **loose)
    # Where it is compressed as much as that, it may: u' = u (1 + cos) at most.
    speed = (jnp.cos(ANGLES) - 1)[:, None] * RING_TURN
    squeezed = js.AdvectionDiffusionReaction(
        RING, diffusivity=1e-2, gradient=RING_GRADIENT, velocity=6 * speed
    )
    u = js.integrate(squeezed, 1 + 0 * NOISE, t1=3.0).ys[-1]
    assert float(u.max()) > 5


@pytest.mark.parametrize("steps", [dict(), dict(dt0=1e-3)], ids=["adaptive", "given steps"])
def test_what_cannot_grow_is_stopped_when_it_does(steps):
    """A traced negative diffusivity is seen by what it does; a concrete one is refused."""
    run = jax.jit(
        lambda d: js.integrate(
            js.AdvectionDiffusionReaction(RING, diffusivity=d), NOISE, t1=1.0, throw=False, **steps
        )
    )
    wrong = run(-1.0)
    assert wrong.result == dfx.RESULTS.nonlinear_divergence
    assert float(jnp.abs(wrong.ys[-1]).max()) < 1e3 * float(jnp.abs(NOISE).max())
    assert run(1.0).result == dfx.RESULTS.successful


def test_advection_without_damping_warns():
    problem = js.AdvectionDiffusionReaction(gradient=RING_GRADIENT, velocity=RING_TURN)
    assert "hyperviscosity" in js.choose_solver(problem)[1]
    with pytest.warns(UserWarning, match="upwind_viscosity"):
        solution = js.integrate(problem, jnp.sin(ANGLES), t1=0.1)
    assert "hyperviscosity" in solution.stats["solver"]


def test_a_state_below_the_tolerance_is_told():
    """Errors of `atol` are allowed: of fields smaller than that nothing may be left."""
    operator = js.laplace_beltrami(js.sphere(200), method=js.GFDM(degree=2))
    problem, z = js.AdvectionDiffusionReaction(operator), js.sphere(200).points[:, 2]
    with pytest.warns(UserWarning, match=r"u0 is at most 1e-09 in size and errors of atol = 1e-06"):
        js.integrate(problem, 1e-9 * z, t1=0.1)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        js.integrate(problem, 1e-9 * z, t1=0.1, atol=1e-15)
        js.integrate(problem, 0 * z, t1=0.1)


def test_very_many_steps_are_told():
    with pytest.warns(UserWarning, match=r"dt0 = 1e-06 makes 2e\+06 steps"):
        js.integrate(
            RING_HEAT, NOISE, t1=2.0, dt0=1e-6, event=dfx.Event(lambda t, y, args, **_: t > 1e-5)
        )


def test_too_few_steps():
    with pytest.raises(js.IntegrationError, match="largest number of steps") as caught:
        js.integrate(HEAT, Z, t1=1.0, dt0=0.01, max_steps=10)
    assert caught.value.time == pytest.approx(0.1)
    np.testing.assert_allclose(caught.value.state, jnp.exp(-0.2) * Z, atol=1e-2)


def test_failure_under_jit_is_an_error_of_the_run_time():
    run = eqx.filter_jit(lambda u: js.integrate(HEAT, u, t1=1.0, dt0=0.01, max_steps=10).ys)
    with pytest.raises(RuntimeError, match="maximum number of solver steps"):
        jax.block_until_ready(run(Z))


@pytest.mark.parametrize(
    "arguments, message",
    [
        (dict(u0=Z.at[7].set(jnp.nan), t1=1.0), "state at point 7 is not finite"),
        (dict(u0=Z, t1=jnp.inf), "t1 = inf, expected a finite number"),
        (dict(u0=Z, t1=1.0, dt0=-0.1), "dt0 = -0.1 does not lead from 0.0 to 1.0"),
        (dict(u0=Z[:10], t1=1.0), r"u0 has shape \(10,\), expected \(300,\)"),
    ],
)
def test_bad_input(arguments, message):
    with pytest.raises(ValueError, match=message):
        js.integrate(HEAT, **arguments)


def test_right_hand_side_that_is_not_finite():
    problem = js.AdvectionDiffusionReaction(LAPLACIAN, reaction=lambda t, u, args: jnp.log(u))
    with pytest.raises(ValueError, match=r"right-hand side at point \d+ is not finite"):
        js.integrate(problem, Z, t1=1.0)


# --- files ---------------------------------------------------------------------------------

TIMES = jnp.array([0.01, 0.1, 0.25, 0.5])
KINDS = {
    "adaptive RKC2": dict(rtol=1e-7, atol=1e-9),
    "constant steps": dict(dt0=0.01),
    "adaptive IMEX": dict(solver=js.IMEX(order=3), rtol=1e-7, atol=1e-9),
}


class Stop(Exception):
    pass


@pytest.mark.parametrize("kind", KINDS)
def test_a_run_that_was_killed_goes_on_bit_by_bit(kind, tmp_path, monkeypatch):
    u0 = jnp.exp(CLOUD.points[:, 0])
    reaction = lambda t, u, args: jnp.sin(9 * t) * u
    problem = js.AdvectionDiffusionReaction(LAPLACIAN, reaction=reaction)
    settings = KINDS[kind] | dict(t1=0.5, saveat=dfx.SaveAt(t0=True, ts=TIMES, t1=True))

    def run(name):
        checkpoint = js.Checkpoint(tmp_path / name, every=0.12)
        return js.integrate(problem, u0, checkpoint=checkpoint, **settings)

    whole = run("whole")
    plain = js.integrate(problem, u0, **settings)

    import jaxsurf.time.checkpoint as module

    write, count = module.written, 0

    def write_and_die(*args):
        nonlocal count
        write(*args)
        count += 1
        if count == 2:
            raise Stop

    monkeypatch.setattr(module, "written", write_and_die)
    with pytest.raises(Stop):
        run("killed")
    monkeypatch.undo()
    resumed = run("killed")
    for name in ("num_steps", "num_accepted_steps"):
        assert int(resumed.stats[name]) == int(whole.stats[name]) >= int(plain.stats[name])
    np.testing.assert_array_equal(resumed.ys, whole.ys)
    np.testing.assert_array_equal(resumed.ts, whole.ts)
    np.testing.assert_array_equal(whole.ts, plain.ts)
    # Parts end with steps of their own: equal to the tolerance, not to the bit.
    np.testing.assert_allclose(whole.ys, plain.ys, rtol=2e-5)
    # What is finished is read, not computed again.
    again = run("killed")
    np.testing.assert_array_equal(again.ys, whole.ys)


def test_a_checkpointed_run_that_ends_early(tmp_path):
    checkpoint = js.Checkpoint(tmp_path / "run.npz", every=4.0)
    saveat = dfx.SaveAt(ts=jnp.array([1.0, 999.0]), t1=True)
    solution = js.integrate(
        HEAT, 1 + Z, t1=1e3, event=js.steady_state(), checkpoint=checkpoint, saveat=saveat
    )
    assert solution.result == dfx.RESULTS.event_occurred
    assert np.isinf(solution.ts[1]) and 4 < float(solution.ts[2]) < 24
    np.testing.assert_allclose(solution.ys[0], 1 + jnp.exp(-2.0) * Z, atol=5e-3)
    np.testing.assert_allclose(solution.ys[2], 1.0, atol=1e-3)


def test_files_of_other_runs_are_refused(tmp_path):
    file = js.Checkpoint(tmp_path / "run.npz", every=0.05)
    js.integrate(HEAT, Z, t1=0.1, checkpoint=file)
    for changed in (dict(u0=2 * Z), dict(rtol=1e-5), dict(solver=js.IMEX(order=2))):
        with pytest.raises(ValueError, match="checkpoint of another run"):
            js.integrate(HEAT, **(dict(u0=Z, t1=0.1, checkpoint=file) | changed))
    (tmp_path / "run.npz").write_text("not an archive")
    with pytest.raises(ValueError, match="does not hold a checkpoint"):
        js.integrate(HEAT, Z, t1=0.1, checkpoint=file)
    with pytest.raises(ValueError, match="at t0, t1 and given times only"):
        js.integrate(HEAT, Z, t1=0.1, checkpoint=file, saveat=dfx.SaveAt(steps=True))
    with pytest.raises(ValueError, match="every = 0"):
        js.Checkpoint("x", every=0)


def changed(**how):
    """Runs that differ from the first in one function only, each from a lambda of its own."""
    problem = how.pop("problem", lambda: js.AdvectionDiffusionReaction(RING))
    return dict(u0=jnp.sin(ANGLES), t1=0.1) | how | dict(problem=problem())


heat = lambda **what: lambda: js.AdvectionDiffusionReaction(RING, **what)
moving = lambda **what: lambda: js.AdvectionDiffusionReaction(RING, gradient=RING_GRADIENT, **what)
wave = lambda **what: lambda: js.WaveEquation(RING, **what)
PAIRS = {
    "reaction": [changed(problem=heat(reaction=f)) for f in
                 (lambda t, u, a: -u, lambda t, u, a: 5 * u)],
    "number in a reaction": [changed(problem=heat(reaction=lambda t, u, a, k=k: k * u))
                             for k in (1.0, 2.0)],
    "velocity": [changed(problem=moving(velocity=lambda t, k=k: k * RING_TURN))
                 for k in (1.0, 2.0)],
    "diffusivity": [changed(problem=heat(diffusivity=lambda t, k=k: k + t)) for k in (1.0, 2.0)],
    "potential": [changed(problem=lambda k=k: js.CahnHilliard(
        RING, width=0.3, potential=lambda u: u**k - u)) for k in (3, 5)],
    "forcing": [changed(problem=wave(forcing=lambda t, u, a, k=k: k + 0 * u),
                        u0=(NOISE, NOISE)) for k in (1.0, 2.0)],
    "event": [changed(event=dfx.Event(lambda t, y, args, k=k, **_: y[1] < k))
              for k in (-1.0, -2.0)],
    "what is saved": [changed(saveat=dfx.SaveAt(t1=True, fn=lambda t, y, args, k=k: k * y))
                      for k in (1.0, 2.0)],
}  # fmt: skip


@pytest.mark.parametrize("kind", PAIRS)
def test_another_function_is_another_run(kind, tmp_path):
    first, second = PAIRS[kind]
    file = js.Checkpoint(tmp_path / "run.npz", every=0.06)
    before = js.integrate(checkpoint=file, **first)
    with pytest.raises(ValueError, match="checkpoint of another run"):
        js.integrate(checkpoint=file, **second)
    again = js.integrate(checkpoint=file, **first)
    for one, other in zip(jax.tree.leaves(before.ys), jax.tree.leaves(again.ys)):
        np.testing.assert_array_equal(one, other)


def test_damaged_files_are_refused(tmp_path):
    """Cut off anywhere, or a byte flipped: a ValueError, or what was written."""
    path = tmp_path / "run.npz"
    run = lambda: (
        js.integrate(RING_HEAT, NOISE, t1=0.1, checkpoint=js.Checkpoint(path, every=0.06)).ys
    )
    right, content = run(), path.read_bytes()
    damaged = [content[:cut] for cut in range(0, len(content), 97)]
    for k in range(0, len(content), 7):
        damaged.append(content[:k] + bytes([content[k] ^ 0x41]) + content[k + 1 :])
    refused = 0
    for wrong in damaged:
        path.write_bytes(wrong)
        try:
            np.testing.assert_array_equal(run(), right)
        except ValueError as error:
            assert type(error) is ValueError and str(path) in str(error)
            refused += 1
    assert refused > 0.5 * len(damaged)


# --- what is compiled ----------------------------------------------------------------------


@pytest.mark.parametrize(
    "how",
    [dict(), dict(solver=js.IMEX(order=3)), dict(solver=dfx.Tsit5(), dt0=0.01)],
    ids=["RKC2", "IMEX", "Tsit5"],
)
def test_other_numbers_and_other_lambdas_compile_nothing(how):
    def run(k, times=1.0):
        laplacian = js.Stencil(RING.indices, k * RING.weights)
        problem = js.AdvectionDiffusionReaction(
            laplacian, diffusivity=k, reaction=lambda t, u, args: args * u - k * u**3
        )
        settings = how | dict(t1=times, args=k, event=js.steady_state(rtol=1e-5 * k))
        if "dt0" in how:
            settings["dt0"] = how["dt0"] * k
        else:
            settings |= dict(rtol=1e-4 * k, atol=1e-6 * k)
        return js.integrate(problem, k * NOISE, **settings).ys[-1]

    first = run(1.0)
    run(0.8)  # what little is done outside
    with count_compilations() as programs:
        other = run(0.5, times=0.7)
    assert len(programs) == 0, programs
    assert float(jnp.abs(other - first).max()) > 1e-3


def test_a_solution_and_a_problem_in_a_line():
    solution = js.integrate(RING_HEAT, NOISE, t1=0.1)
    taken, refused = (int(solution.stats[f"num_{k}_steps"]) for k in ("accepted", "rejected"))
    assert f"RKC2: {taken} steps ({refused} refused) to t = 0.1" == solution.stats["summary"]
    text = "AdvectionDiffusionReaction(laplacian=<Stencil on 24 points>, diffusivity=1, "
    assert repr(RING_HEAT).startswith(text) and len(repr(RING_HEAT)) < 120


def test_the_last_bit_decides_nothing():
    """Start and operator changed in the last digit: the same steps and state."""
    u0 = jnp.exp(jnp.cos(ANGLES))
    for solver in (js.RKC2(), js.IMEX(order=3), dfx.Tsit5()):
        found = []
        for bit in (0.0, 1e-15, -1e-15):
            operator = js.Stencil(RING.indices, (1 + bit) * RING.weights)
            problem = js.AdvectionDiffusionReaction(operator, reaction=lambda t, u, args: -(u**3))
            found.append(js.integrate(problem, (1 + bit) * u0, t1=0.5, solver=solver))
        counts = [int(s.stats["num_steps"]) for s in found]
        assert counts[0] == counts[1] == counts[2]
        for other in found[1:]:
            np.testing.assert_allclose(other.ys, found[0].ys, rtol=1e-7)


# --- long runs -----------------------------------------------------------------------------


def test_a_hundred_thousand_explicit_steps_of_diffusion_do_not_grow():
    dt = 2.0 / float(-SLOPES.min())
    u = js.integrate(RING_HEAT, NOISE, t1=1e5 * dt, dt0=dt, solver=dfx.Tsit5())
    assert int(u.stats["num_steps"]) in (100_000, 100_001)
    assert float(jnp.ptp(u.ys[-1])) < 1e-10
    assert float(jnp.abs(u.ys[-1]).max()) < float(jnp.abs(NOISE).max())
