"""Derivatives through motion past what the first neighbours serve: lists found anew, points added.

What the host decides (which points there are, what is cut) has no derivative. Between such
decisions a run is differentiated in parts, each on a surface made of the last: with its neighbours
found anew in compiled code, or with points that are carried by those around them.
"""

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxsurf as js

DIFFUSIVITY = 0.1
STEPS = dict(solver=dfx.Heun(), dt0=0.05)
pytestmark = pytest.mark.slow


def heat(surface):
    return js.AdvectionDiffusionReaction(surface.laplacian, diffusivity=DIFFUSIVITY)


def difference(f, at, h=1e-4):
    return float((f(at + h) - f(at - h)) / (2 * h))


def test_across_neighbours_found_anew():
    """Latitudes that turn at different speeds: the lists of the start do not reach to the end."""
    surface = js.discretize(js.sphere(300), method=js.GFDM(degree=2))
    search, start = surface.search(margin=2.0), surface.cloud.points
    weights = jnp.exp(start[:, 0])

    def shear(t, surface, fields, args):
        x, y, z = surface.cloud.points.T
        return args * z[:, None] * jnp.stack([-y, x, 0 * x], axis=1)

    go_on = lambda rate, surface, u, end: js.evolve(
        js.Motion(shear), surface, t1=end, args=rate, fields=u, problem=heat, **STEPS
    )

    def in_parts(rate):
        run = go_on(rate, surface, start[:, 2], 0.3)
        half, cloud = run.surfaces[-1], run.clouds[-1]
        anew = half.moved(cloud.points, cloud.normals, search=search)
        end = go_on(rate, anew, run.fields[-1], 0.3)
        return jnp.vdot(weights, end.fields[-1] + end.clouds[-1].points[:, 0]), anew.neighbors

    value, slope = jax.jit(jax.value_and_grad(in_parts, has_aux=True)), 2.5
    (_, lists), found = value(slope)
    changed = np.sort(lists.indices[:, :36], axis=1) != np.sort(
        surface.neighbors.indices[:, :36], axis=1
    )
    assert np.mean(np.any(changed, axis=1)) > 0.5
    assert abs(float(found) / difference(lambda rate: value(rate)[0][0], slope) - 1) < 1e-5
    with pytest.raises(Exception, match="does not keep the neighbours"):
        whole = lambda rate: go_on(rate, surface, start[:, 2], 0.6).fields[-1]
        jax.block_until_ready(jax.jit(whole)(slope))


def test_across_points_added():
    r"""On a sphere of radius $r = 1 + a t$ that is filled up at t = 1, with heat of $x y$ on it.

    $u = r^{-2} e^{-6 D \int r^{-2}} x y / r^2$ in the points of the start: an integral of $u^2$ is
    known as a function of a, and so is its derivative.
    """
    surface = js.discretize(js.sphere(400), method=js.GFDM(degree=3))
    motion = js.Motion(lambda t, surface, fields, args: args * surface.cloud.normals)
    x, y, _ = surface.cloud.points.T
    go_on = lambda rate, surface, u, t0: js.evolve(
        motion, surface, t0=t0, t1=t0 + 1, args=rate, fields=u, problem=heat, **shorter
    )
    at, shorter = jnp.asarray(0.3), STEPS | dict(dt0=0.025)
    first = go_on(at, surface, x * y, 0.0)
    half = first.surfaces[-1]
    filled = js.adapt_points(half, js.Adaptation(0.17)).surface
    assert filled.n > surface.n + 50

    def energy(rate):
        run = go_on(rate, surface, x * y, 0.0)
        carried = lambda values: half.interpolate(values, filled.cloud.points)
        moved = filled.moved(
            filled.cloud.points + carried(run.clouds[-1].points - half.cloud.points)
        )
        end = go_on(rate, moved, carried(run.fields[-1]), 1.0)
        return end.surfaces[-1].integrate(end.fields[-1] ** 2)

    def exact(a):
        r = 1 + 2 * a
        return 4 * jnp.pi / 15 * jnp.exp(-12 * DIFFUSIVITY * 2 / r) / r**2

    run = jax.jit(jax.value_and_grad(energy))
    value, slope = run(at)
    assert abs(float(slope) / difference(lambda rate: run(rate)[0], at) - 1) < 1e-5
    assert abs(float(value / exact(at)) - 1) < 2e-3
    assert abs(float(slope / jax.grad(exact)(at)) - 1) < 2e-3


def test_what_functions_close_over_is_differentiated_too():
    r"""A circle of radius $1 + a t$, by a factor of a motion and by what a velocity closes over."""
    surface = js.discretize(js.circle(40), method=js.GFDM(degree=2))
    outward = lambda t, surface, *_: surface.cloud.normals
    end = lambda motion, **given: js.evolve(motion, surface, t1=0.1, **given).clouds[-1].points
    factor = lambda a: end(a * js.Motion(outward), **STEPS)[0, 0]
    closed = lambda a, **given: end(js.Motion(lambda *s: a * outward(*s)), **STEPS, **given)[0, 0]
    for f in (factor, closed):
        np.testing.assert_allclose(jax.value_and_grad(f)(1.0), [1.1, 0.1], rtol=1e-9)
        np.testing.assert_allclose(jax.jit(f)(1.0), 1.1, rtol=1e-9)
        np.testing.assert_allclose(jax.vmap(f)(jnp.array([1.0, 2.0])), [1.1, 1.2], rtol=1e-9)
    constant = jax.jit(lambda b: b * closed(1.0))
    np.testing.assert_allclose(constant(2.0), 2.2, rtol=1e-9)
    with pytest.raises(ValueError, match="adapt needs concrete arrays"):
        jax.grad(lambda a: closed(a, adapt=js.Adaptation(0.16)))(1.0)


def test_forward_mode_and_derivatives_in_the_end():
    r"""A circle of radius $1 + a t$."""
    surface = js.discretize(js.circle(40), method=js.GFDM(degree=2))
    motion = js.Motion(lambda t, surface, fields, args: args * surface.cloud.normals)
    radius = lambda a, t, **given: (
        js.evolve(motion, surface, t1=t, args=a, **given).clouds[-1].points[0, 0]
    )
    forward = lambda a: radius(a, 0.1, adjoint=dfx.ForwardMode())
    np.testing.assert_allclose(jax.jvp(forward, (1.0,), (1.0,)), [1.1, 0.1], rtol=1e-9)
    slopes = jax.grad(radius, argnums=(0, 1))(1.0, 0.1)
    np.testing.assert_allclose(slopes, [0.1, 1.0], rtol=1e-6)


def test_times_that_are_traced_and_arrays_of_times_in_compiled_code():
    surface = js.discretize(js.circle(40), method=js.GFDM(degree=2))
    motion = js.Motion(lambda t, surface, fields, args: args * surface.cloud.normals)

    def radii(a, times):
        run = js.evolve(motion, surface, t1=0.1, saveat=times, args=a, **STEPS)
        return run.ts, jnp.stack([cloud.points[0, 0] for cloud in run.clouds])

    times = jnp.array([0.0, 0.05, 0.1])
    ts, found = jax.jit(lambda a: radii(a, times))(1.0)
    assert ts.tolist() == times.tolist()
    np.testing.assert_allclose(found, 1 + times, rtol=1e-9)
    ts, found = jax.jit(lambda times: radii(1.0, times))(times[:2])
    assert ts.tolist() == times.tolist()
    np.testing.assert_allclose(found, 1 + times, rtol=1e-9)
