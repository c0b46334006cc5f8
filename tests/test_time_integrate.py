"""The call that integrates: choices, outputs, events, failures, files, memory."""

import logging

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxsurf as js

# Minutes in all.
pytestmark = pytest.mark.slow

CLOUD = js.sphere(300)
LAPLACIAN = js.laplace_beltrami(CLOUD)
Z = CLOUD.points[:, 2]
HEAT = js.AdvectionDiffusionReaction(LAPLACIAN)


@pytest.mark.core
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


# --- failures ------------------------------------------------------------------------------


@pytest.mark.core
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


def test_unstable_constant_steps_stop_at_the_last_finite_state():
    radius = js.spectral_estimate(LAPLACIAN).radius
    noise = jnp.asarray(np.random.default_rng(0).normal(size=CLOUD.n))
    with pytest.raises(js.IntegrationError, match="diverged") as caught:
        js.integrate(HEAT, noise, t1=1e6, dt0=50 / radius, solver=dfx.Tsit5())
    assert bool(jnp.all(jnp.isfinite(caught.value.state)))
    quiet = js.integrate(HEAT, noise, t1=1e6, dt0=50 / radius, solver=dfx.Tsit5(), throw=False)
    assert quiet.result == dfx.RESULTS.nonlinear_divergence
    assert bool(jnp.all(jnp.isfinite(quiet.ys[-1])))


def test_too_few_steps():
    with pytest.raises(js.IntegrationError, match="largest number of steps") as caught:
        js.integrate(HEAT, Z, t1=1.0, dt0=0.01, max_steps=10)
    assert caught.value.time == pytest.approx(0.1)
    np.testing.assert_allclose(caught.value.state, jnp.exp(-0.2) * Z, atol=1e-2)


def test_failure_under_jit_is_an_error_of_the_run_time():
    run = eqx.filter_jit(lambda u: js.integrate(HEAT, u, t1=1.0, dt0=0.01, max_steps=10).ys)
    with pytest.raises(RuntimeError, match="maximum number of solver steps"):
        jax.block_until_ready(run(Z))


@pytest.mark.core
@pytest.mark.parametrize(
    "arguments, message",
    [
        (dict(u0=Z.at[7].set(jnp.nan), t1=1.0), "state at point 7 is not finite"),
        (dict(u0=Z, t1=jnp.inf), "t1 = inf is not finite"),
        (dict(u0=Z, t1=1.0, dt0=-0.1), "dt0 = -0.1 does not lead from 0.0 to 1.0"),
        (dict(u0=Z[:10], t1=1.0), r"field has shape \(10,\)"),
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


@pytest.mark.core
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

    write, count = module._write, 0

    def write_and_die(*args):
        nonlocal count
        write(*args)
        count += 1
        if count == 2:
            raise Stop

    monkeypatch.setattr(module, "_write", write_and_die)
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


@pytest.mark.core
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


# --- long runs -----------------------------------------------------------------------------


@pytest.mark.slow
def test_a_hundred_thousand_explicit_steps_of_diffusion_do_not_grow():
    radius = js.spectral_estimate(LAPLACIAN).radius
    noise = jnp.asarray(np.random.default_rng(0).normal(size=CLOUD.n))
    dt = 2.0 / radius
    u = js.integrate(HEAT, noise, t1=1e5 * dt, dt0=dt, solver=dfx.Tsit5())
    assert int(u.stats["num_steps"]) in (100_000, 100_001)
    assert float(jnp.ptp(u.ys[-1])) < 1e-10
    assert float(jnp.abs(u.ys[-1]).max()) < float(jnp.abs(noise).max())
