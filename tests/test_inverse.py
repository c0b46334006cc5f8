"""Unknowns from noisy data: the likeliest ones, and how sure they are."""

import functools

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

import jaxsurf as js

from .helpers import count_compilations, relative_error

pytestmark = pytest.mark.slow

N = 200
TIMES = jnp.linspace(0.1, 2.0, 40)


@functools.cache
def ball(n=N):
    return js.discretize(js.sphere(n), method=js.GFDM(degree=2))


def decay(rate):
    return jnp.exp(-rate * TIMES)


def noise(shape, seed=0):
    return jnp.asarray(np.random.default_rng(seed).normal(size=shape))


def screened(source):
    """A linear model: readings of the solution of u - Δu = f."""
    return js.solve(1 - ball().laplacian, source, mean_zero=False).value[::8]


@pytest.mark.parametrize("optimizer", [None, optax.lbfgs()], ids=["Gauss-Newton", "L-BFGS"])
def test_a_rate_and_its_deviation(optimizer):
    data = decay(1.5) + 0.01 * noise(40)
    found = js.solve_inverse(decay, jnp.array(1.0), data, noise=0.01, optimizer=optimizer)
    assert found.converged
    slopes = TIMES * decay(found.theta) / 0.01
    exact = 1 / jnp.linalg.norm(slopes)
    # The minimum: residuals are normal to the model, to a share of a deviation.
    off = slopes @ (decay(found.theta) - data) / 0.01
    assert abs(off) * exact < 1e-3
    posterior = found.posterior()
    assert abs(posterior.deviation / exact - 1) < 1e-6
    assert abs(found.theta - 1.5) < 3 * exact
    assert abs(found.misfit - 1) < 0.5
    assert relative_error(found.predictions, decay(found.theta)) < 1e-12
    lifetime = posterior.deviation_of(lambda rate: 1 / rate)
    assert abs(lifetime / (exact / found.theta**2) - 1) < 1e-6


def test_what_data_do_not_tell_has_no_posterior():
    """Neither by steps of first order, which find something, nor where data cease to depend."""
    three = lambda a: a * jnp.ones(3)
    ask = functools.partial(js.solve_inverse, noise=0.1)
    descend = functools.partial(ask, optimizer=optax.lbfgs())
    for model, unknowns, words in (
        (lambda a: three(a[0]), 2, "no datum depends on unknown 1"),
        (lambda a: three(a[0] * a[1]), 2, "data do not tell 2 unknowns"),
        (lambda a: a[:3], 4, "3 data for 4 unknowns"),
    ):
        found = descend(model, jnp.ones(unknowns), three(2.0))
        assert found.converged
        with pytest.raises(ValueError, match=f"{words}.* at what was found"):
            found.posterior()
    faded = ask(lambda a: a[0] * a[1] ** jnp.arange(3), jnp.ones(2), jnp.zeros(3))
    with pytest.raises(ValueError, match="no datum depends on unknown 1"):
        faded.posterior()
    with pytest.raises(js.OptimizationError, match="vanishes at the first theta"):
        descend(lambda a: three(a**2), jnp.array(0.0), three(2.0))


def test_single_precision():
    times = TIMES.astype(jnp.float32)
    model = lambda rate: jnp.exp(-rate * times)
    data = (decay(1.5) + 0.01 * noise(40)).astype(jnp.float32)
    double = js.solve_inverse(decay, jnp.array(1.0), data.astype(float), noise=0.01)
    found = js.solve_inverse(model, jnp.array(1.0, jnp.float32), data, noise=jnp.float32(0.01))
    assert found.converged and found.theta.dtype == jnp.float32
    deviation = double.posterior().deviation
    assert abs(found.theta - double.theta) < 0.05 * deviation
    assert abs(found.posterior().deviation / deviation - 1) < 1e-2


def test_a_linear_model_has_the_posterior_of_linear_algebra():
    """A field with a prior and an offset without: mean, deviations, samples by dense matrices."""
    surface, sigma = ball(), 0.02
    prior = js.MaternPrior(surface, deviation=1.0, length=1.5, mean=0.3)
    model = lambda theta: screened(theta["source"]) + theta["offset"]
    start = {"source": jnp.zeros(N), "offset": jnp.array(0.0)}
    data = model({"source": surface.cloud.points[:, 2], "offset": jnp.array(0.5)})
    data = data + sigma * noise(data.shape)
    priors = {"source": prior, "offset": None}
    found = js.solve_inverse(model, start, data, noise=sigma, prior=priors, tol=1e-6)
    assert found.converged
    F = jax.jacrev(lambda source: screened(source))(jnp.zeros(N))
    P = jax.jacfwd(prior.whiten)(jnp.zeros(N))
    G = jnp.concatenate([F, jnp.ones((len(F), 1))], axis=1) / sigma
    H = G.T @ G + jax.scipy.linalg.block_diag(P.T @ P, jnp.zeros((1, 1)))
    right = G.T @ (data / sigma) + jnp.append(P.T @ P @ jnp.full(N, 0.3), 0.0)
    mean, covariance = jnp.linalg.solve(H, right), jnp.linalg.inv(H)
    deviation = jnp.sqrt(jnp.diag(covariance))
    assert jnp.abs((found.theta["source"] - mean[:N]) / deviation[:N]).max() < 1e-4
    assert abs(found.theta["offset"] - mean[N]) < 1e-4 * deviation[N]
    posterior = found.posterior()
    assert relative_error(posterior.deviation["source"], deviation[:N]) < 1e-5
    assert abs(posterior.deviation["offset"] / deviation[N] - 1) < 1e-5
    a = posterior.deviation_of(lambda theta: jnp.stack([theta["source"][3], theta["offset"]]))
    assert relative_error(a, deviation[jnp.array([3, N])]) < 1e-5
    samples = posterior.samples(jax.random.key(0), 2_000)
    both = jnp.concatenate([samples["source"][:, :5], samples["offset"][:, None]], axis=1)
    rows = jnp.array([0, 1, 2, 3, 4, N])
    seen, wanted = jnp.cov(both.T), covariance[rows][:, rows]
    scale = jnp.outer(deviation[rows], deviation[rows])
    assert jnp.abs((seen - wanted) / scale).max() < 0.1


def test_an_initial_state_from_later_readings():
    """Both modes of `js.integrate` are taken, unasked for; the known data come back."""
    surface = ball()
    z = surface.cloud.points[:, 2]

    def model(u):
        problem = js.AdvectionDiffusionReaction(surface.laplacian, diffusivity=0.3)
        return js.integrate(problem, u, t0=0.0, t1=0.2, dt0=0.05).ys[-1][::4]

    data = model(z)
    prior = js.MaternPrior(surface, deviation=1.0, length=2.0)
    found = js.solve_inverse(model, jnp.zeros(N), data, noise=1e-3, prior=prior)
    assert found.converged
    deviation = found.posterior().deviation
    assert jnp.abs((found.theta - z) / deviation).max() < 3
    assert jnp.abs(found.theta - z).max() < 0.2
    told = dfx.RecursiveCheckpointAdjoint(8)

    def reverse_only(u):
        problem = js.AdvectionDiffusionReaction(surface.laplacian, diffusivity=0.3)
        return js.integrate(problem, u, t0=0.0, t1=0.2, dt0=0.05, adjoint=told).ys[-1][::4]

    with pytest.raises(TypeError, match="forward mode"):
        js.solve_inverse(reverse_only, jnp.zeros(N), data, noise=1e-3, prior=prior)


def test_a_conductivity_is_found_where_it_is_heated():
    surface = ball()
    x = surface.cloud.points
    true = 0.5 * x[:, 0]
    sources = jnp.stack([x[:, 0], x[:, 1], x[:, 2]], axis=1)

    def model(log_conductivity):
        operator = surface.diffusion(jnp.exp(log_conductivity))
        return js.solve(0.1 - operator, sources, mean_zero=False).value[::4]

    data = model(true)
    data = data + 0.01 * noise(data.shape)
    prior = js.MaternPrior(surface, deviation=0.5, length=2.0)
    found = js.solve_inverse(model, jnp.zeros(N), data, noise=0.01, prior=prior)
    posterior = found.posterior()
    # As many data as the field has taken up are fitted, noise included.
    taken = jnp.sum(posterior.factor**2) / data.size
    assert found.converged and abs(found.misfit - (1 - taken)) < 0.3
    error = found.theta - true
    assert jnp.sqrt(jnp.mean(error**2)) < 0.3 * jnp.sqrt(jnp.mean(true**2))
    inside = jnp.abs(error) < 2 * posterior.deviation
    assert jnp.mean(inside) > 0.8


def test_fields_have_the_variance_of_their_series():
    length, errors = 1.0, []
    degrees = np.arange(400)
    for n in (500, 1_000):
        prior = js.MaternPrior(ball(n), deviation=0.5, length=length)
        kappa = np.sqrt(8) / length
        modes = (2 * degrees + 1) / (kappa**2 + degrees * (degrees + 1)) ** 2
        exact = modes.sum() / (4 * np.pi) / float(prior.tau) ** 2
        variance = prior.variance(jnp.zeros(n))
        errors.append(float(jnp.mean(variance)) ** 0.5 / exact**0.5 - 1)
        assert variance.max() < 1.1 * variance.min()
    assert 0 < errors[1] < 0.06 and errors[1] < 0.75 * errors[0]


def test_maps_of_priors_are_inverse_to_each_other():
    xi = noise(N)
    for prior in (
        js.MaternPrior(ball(), deviation=0.5, length=1.0, mean=2.0),
        js.GaussianPrior(0.5, mean=jnp.linspace(0, 1, N)),
    ):
        assert relative_error(prior.whiten(prior.color(xi)), xi) < 1e-6
        spread = jax.jacfwd(prior.color)(xi)
        assert relative_error(jnp.sum(spread**2, axis=1), prior.variance(xi)) < 1e-6
        mapped = jax.jit(jax.vmap(prior.color))(jnp.stack([xi, 2 * xi]))
        assert relative_error(mapped[1], prior.color(2 * xi)) < 1e-7


def test_priors_in_single_precision():
    xi = noise(N).astype(jnp.float32)
    cloud = ball().cloud
    points, normals = (a.astype(jnp.float32) for a in (cloud.points, cloud.normals))
    surface = js.discretize(js.PointCloud(points, normals), method=js.GFDM(degree=2))
    for single, double in (
        (js.MaternPrior(surface, 0.5, 1.0), js.MaternPrior(ball(), 0.5, 1.0)),
        (js.GaussianPrior(jnp.float32(0.5)), js.GaussianPrior(0.5)),
    ):
        field = single.color(xi)
        assert field.dtype == jnp.float32
        assert relative_error(field, double.color(xi.astype(float))) < 1e-2


def test_fields_know_nothing_of_points_that_are_off():
    cloud = ball().cloud
    on = np.arange(N) % 3 > 0
    masked = js.PointCloud(cloud.points, cloud.normals, active=jnp.asarray(on))
    alone = js.PointCloud(cloud.points[on], cloud.normals[on])
    method, xi = js.GFDM(degree=2), noise(N)
    whole, part = (
        js.MaternPrior(js.discretize(c, method=method), 0.5, 1.0, mean=mean)
        for c, mean in ((masked, jnp.where(jnp.asarray(on), 1.0, jnp.nan)), (alone, 1.0))
    )
    assert relative_error(whole.color(xi)[on], part.color(xi[on])) < 1e-6
    assert relative_error(whole.whiten(xi)[on], part.whiten(xi[on])) < 1e-9
    assert relative_error(whole.variance(xi)[on], part.variance(xi[on])) < 1e-6
    assert not whole.whiten(xi)[~on].any() and not whole.variance(xi)[~on].any()
    assert not whole.color(xi)[~on].any()


@pytest.mark.parametrize("count", [2, N])
def test_components_of_fields_are_independent(count):
    """As many as points too, where a mass of a point could be taken for one of a component."""
    prior = js.MaternPrior(ball(), 0.5, 1.0, mean=ball().cloud.points[:, 0])
    xi = noise((N, count))
    fields = prior.color(xi)
    for i in (0, 1):
        assert relative_error(fields[:, i], prior.color(xi[:, i])) < 1e-6
    assert relative_error(prior.whiten(fields), xi) < 1e-6
    assert relative_error(prior.variance(xi)[:, 1], prior.variance(xi[:, 1])) < 1e-12


def test_other_data_compile_nothing():
    data = decay(1.5)
    js.solve_inverse(decay, jnp.array(1.0), data, noise=0.01)
    with count_compilations() as names:
        js.solve_inverse(decay, jnp.array(1.2), 1.1 * data, noise=0.02)
    assert not names, names


def test_data_that_the_model_misses_do_not_take_steps_to_and_fro():
    """Where it misses the second half, J bends by 1.97 and 1.07 of what Gauss and Newton take."""
    theta, missed = jnp.zeros(2), jnp.array([-0.628, 0.5])
    data = jnp.concatenate([jnp.ones(2), missed])
    model = lambda theta: jnp.concatenate([theta, theta**2])
    found = js.solve_inverse(model, theta, data, noise=1.0, tol=1e-6)
    rate = lambda x: x - 1 + 2 * x * (x**2 - missed)
    # Steps that are only halved: 209.
    assert found.converged and len(found.history["energy"]) < 15
    assert jnp.abs(rate(found.theta)).max() < 1e-5


@pytest.mark.parametrize("unit", [1.0, 1e8])
def test_steps_of_first_order_converge_in_any_unit(unit):
    """Of an unknown without a prior, whose derivative may be as small as one likes."""
    exact = decay(1.5)
    ask = lambda start: js.solve_inverse(
        lambda q: (q / unit) * exact, start, 2 * exact, noise=0.01, optimizer=optax.lbfgs()
    )
    found = ask(jnp.array(unit))
    assert found.converged
    assert abs(found.theta / unit - 2) < 1e-4
    # Where it begins at the likeliest there is nothing left to measure by.
    assert ask(found.theta).converged


def test_unknowns_keep_their_precision():
    """In double precision those of single, with or without a prior, beside others; and all of it in
    single, where products of the first gradient are infinite (the step was zero: converged)."""
    a = jnp.arange(6.0).reshape(3, 2) + 1
    model = lambda x: jnp.concatenate([a @ x["free"] + x["known"][0], a @ x["known"][1]])
    single = lambda *shape: jnp.zeros(shape, jnp.float32)
    start = {"free": single(2), "known": (single(), jnp.zeros(2))}
    one = js.GaussianPrior(1.0)
    found = js.solve_inverse(
        model, start, jnp.ones(6), noise=0.1, prior={"free": None, "known": (one, one)}
    )
    assert found.converged
    for tree in (found.theta, found.posterior().deviation):
        assert jax.tree.map(lambda x: x.dtype, tree) == jax.tree.map(lambda x: x.dtype, start)
    b = np.random.default_rng(0).normal(size=(30, 12))
    with jax.enable_x64(False):
        b, truth = jnp.asarray(b, jnp.float32), jnp.linspace(-1e4, 1e4, 12)
        found = js.solve_inverse(
            lambda x: b @ x, jnp.zeros(12), b @ truth, noise=0.01, prior=js.GaussianPrior(1e4)
        )
        assert jnp.abs(found.theta - truth).max() < 0.1


def test_directions_that_data_do_not_see_are_left():
    """The derivative in the first unknown vanishes where J is least."""
    model = lambda x: jnp.stack([x[0] ** 2, x[1], x[0] ** 2 + x[1]])
    data = jnp.array([-1.0, 0.3, -0.7])
    found = js.solve_inverse(model, jnp.array([1.0, 0.0]), data, noise=0.1)
    np.testing.assert_allclose(found.theta, [0, -0.2], atol=1e-2)
