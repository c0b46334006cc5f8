"""Problems in time against exact solutions: every term of them, conditions, mass."""

import diffrax as dfx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import pytest
import scipy.linalg

import jaxsurf as js

from .helpers import check_derivative, jittered_sphere, relative_error, ring

pytestmark = pytest.mark.slow

CLOUD = js.sphere(600)
METHOD = js.DCPSE(order=4)
NEIGHBORS = js.choose_neighbors(CLOUD, method=METHOD)
LAPLACIAN = js.laplace_beltrami(CLOUD, NEIGHBORS, method=METHOD)
GRADIENT = js.surface_gradient(CLOUD, NEIGHBORS, method=METHOD)
X, Y, Z = CLOUD.points.T
TURN = jnp.cross(jnp.array([0.0, 0.0, 1.0]), CLOUD.points)  # one radian per unit of time


@pytest.mark.core
def test_two_species_with_their_own_diffusivities_and_a_reaction():
    """z decays with 2 D, xy with 6 D; the reaction turns the two species into each other."""
    u0 = jnp.stack([Z + X * Y, 0 * Z], axis=1)
    problem = js.AdvectionDiffusionReaction(
        LAPLACIAN,
        diffusivity=jnp.array([0.5, 0.5]),
        reaction=lambda t, u, args: args * jnp.stack([-u[:, 1], u[:, 0]], axis=1),
    )
    u = js.integrate(problem, u0, t1=0.5, args=2.0, rtol=1e-6, atol=1e-8).ys[-1]
    total = np.exp(-0.5) * Z + np.exp(-1.5) * X * Y
    exact = jnp.stack([np.cos(1.0) * total, np.sin(1.0) * total], axis=1)
    assert relative_error(u, exact) < 3e-4


@pytest.mark.parametrize("in_time", [False, True])
def test_diffusivity_in_space_and_time(in_time):
    """The rate itself against the operator made for it, for fields with and without species."""
    d = 1 + 0.5 * Z
    direct = js.diffusion(CLOUD, d, neighbors=NEIGHBORS, method=METHOD)
    u = jnp.exp(X)
    diffusivity = (lambda t: (1 + t) * d) if in_time else 2 * d
    for shape in (diffusivity, lambda t: 2 * d[:, None] * jnp.ones(2)):
        problem = js.AdvectionDiffusionReaction(LAPLACIAN, diffusivity=shape)
        if shape is diffusivity:
            np.testing.assert_allclose(problem.rate(1.0, u, None), 2 * direct(u), atol=1e-9)
        pair = jnp.stack([u, Y], axis=1)
        np.testing.assert_allclose(problem.rate(1.0, pair, None), 2 * direct(pair), atol=1e-9)


@pytest.mark.parametrize("conservative", [True, False])
def test_rotation_carries_the_field_along(conservative):
    """A quarter of a turn, with a velocity that is fixed and with one that is not."""
    damping = js.hyperviscosity(LAPLACIAN, 1.0, power=3, strength=0.3)
    u0 = jnp.exp(X + 0.5 * Z)
    exact = jnp.exp(Y + 0.5 * Z)
    for velocity in (TURN, lambda t: 2 * jnp.sin(t * np.pi / (np.pi / 2)) ** 2 * TURN):
        problem = js.AdvectionDiffusionReaction(
            gradient=GRADIENT, velocity=velocity, conservative=conservative, stabilization=damping
        )
        u = js.integrate(problem, u0, t1=np.pi / 2, rtol=1e-6, atol=1e-8).ys[-1]
        assert relative_error(u, exact) < 1e-3
        pair = js.integrate(problem, jnp.stack([u0, 2 * u0], 1), t1=np.pi / 2, rtol=1e-6, atol=1e-8)
        np.testing.assert_allclose(pair.ys[-1], jnp.stack([u, 2 * u], axis=1), rtol=1e-4)


def test_compressible_flow():
    """v = grad z: the two forms differ by u times the divergence, -2 z."""
    v = jnp.array([0.0, 0.0, 1.0]) - Z[:, None] * CLOUD.points
    u = jnp.exp(X)
    one, other = (
        js.AdvectionDiffusionReaction(gradient=GRADIENT, velocity=v, conservative=c)
        for c in (True, False)
    )
    difference = one.rate(0.0, u, None) - other.rate(0.0, u, None)
    assert relative_error(difference, 2 * Z * u) < 2e-3
    moving = js.AdvectionDiffusionReaction(gradient=GRADIENT, velocity=lambda t: v)
    np.testing.assert_allclose(moving.rate(0.0, u, None), one.rate(0.0, u, None), atol=1e-10)


def test_advection_diffusion_decays_and_turns():
    u0 = X
    problem = js.AdvectionDiffusionReaction(
        LAPLACIAN, diffusivity=0.2, gradient=GRADIENT, velocity=TURN
    )
    assert isinstance(js.choose_solver(problem)[0], js.IMEX)
    u = js.integrate(problem, u0, t1=1.0, rtol=1e-6, atol=1e-8).ys[-1]
    exact = np.exp(-0.4) * (np.cos(1.0) * X + np.sin(1.0) * Y)
    assert relative_error(u, exact) < 2e-4


@pytest.mark.parametrize("cloud", [js.sphere(300), jittered_sphere(300)], ids=["even", "jittered"])
def test_damping_moves_all_eigenvalues_of_advection_to_the_left(cloud):
    neighbors = js.choose_neighbors(cloud, method=METHOD)
    gradient = js.surface_gradient(cloud, neighbors, method=METHOD)
    laplacian = js.laplace_beltrami(cloud, neighbors, method=METHOD)
    velocity = jnp.cross(jnp.array([0.6, 0.0, 0.8]), cloud.points)
    bare = js.AdvectionDiffusionReaction(gradient=gradient, velocity=velocity, conservative=False)
    matrix = -bare.advection.to_scipy().toarray()
    growth = lambda extra: scipy.linalg.eigvals(matrix + extra.to_scipy().toarray()).real.max()
    assert scipy.linalg.eigvals(matrix).real.max() > 1e-3
    assert growth(js.hyperviscosity(laplacian, 1.0, power=2, strength=0.3)) < 1e-10
    assert growth(js.hyperviscosity(laplacian, 1.0, power=3)) < 1e-4
    upwind = js.upwind_viscosity(cloud, velocity, neighbors=neighbors, method=METHOD)
    assert growth(upwind) < 1e-10


def test_hyperviscosity_is_of_high_order():
    errors = []
    for n in (500, 2_000):
        cloud = js.sphere(n)
        damping = js.hyperviscosity(js.laplace_beltrami(cloud), 1.0, power=2)
        u = jnp.exp(cloud.points[:, 0])
        errors.append(float(jnp.abs(damping(u)).max()))
    assert np.log2(errors[0] / errors[1]) > 2.7  # h halves, h³


@pytest.mark.parametrize("damping", [0.0, 0.5])
def test_standing_wave(damping):
    """u = e^(-γt/2) cos(ω t) z, ω² = 2 c² - γ²/4, the forcing constant."""
    problem = js.WaveEquation(
        LAPLACIAN, speed=2.0, damping=damping, forcing=lambda t, u, args: args + 0 * u
    )
    decay, omega = damping / 2, np.sqrt(8 - damping**2 / 4)
    start = (Z, -decay * Z)
    solution = js.integrate(problem, start, t1=2.0, rtol=1e-8, atol=1e-9, args=0.0)
    exact = np.exp(-decay * 2) * np.cos(omega * 2) * Z
    assert float(jnp.abs(solution.ys[0][-1] - exact).max()) < 1e-3
    assert isinstance(js.choose_solver(problem)[0], dfx.Tsit5)
    if damping == 0:  # u'' = 1: constants gain t² / 2
        lifted = js.integrate(problem, start, t1=2.0, rtol=1e-8, atol=1e-9, args=1.0).ys[0][-1]
        np.testing.assert_allclose(lifted - solution.ys[0][-1], 2.0, atol=1e-5)


def test_biharmonic_decay():
    problem = js.BiharmonicDiffusion(LAPLACIAN, stiffness=0.1)
    u = js.integrate(problem, X * Y, t1=0.2, rtol=1e-6, atol=1e-8).ys[-1]
    assert relative_error(u, np.exp(-0.1 * 36 * 0.2) * X * Y) < 2e-3


def test_cahn_hilliard_separates_keeps_its_mass_and_loses_energy():
    cloud = js.sphere(600)
    laplacian = js.laplace_beltrami(cloud)
    width = 0.3
    weights = jnp.full(cloud.n, 4 * np.pi / cloud.n)
    problem = js.CahnHilliard(laplacian, width=width, mass=weights)
    u0 = 0.2 + 0.05 * jnp.asarray(np.random.default_rng(0).normal(size=cloud.n))
    times = jnp.array([0.0, 0.1, 1.0, 5.0])
    ys = js.integrate(problem, u0, t1=5.0, rtol=1e-3, atol=1e-5, saveat=dfx.SaveAt(ts=times)).ys
    energy = [
        float(weights @ ((u**2 - 1) ** 2 / 4 - 0.5 * width**2 * u * laplacian(u))) for u in ys
    ]
    assert energy[0] > energy[1] > energy[2] > energy[3]
    # From 0.05; the interface is a fifth of the way round, so that neither phase is pure.
    assert float(ys[-1].max()) > 0.7 and float(ys[-1].min()) < -0.7
    mass = ys @ weights
    np.testing.assert_allclose(mass, mass[0], rtol=1e-13)
    # The two ways to write the right-hand side are one.
    split = problem.explicit_rate(0.0, u0, None) + problem.implicit_rate(0.0, u0, None)
    np.testing.assert_allclose(split, problem.rate(0.0, u0, None), atol=1e-8)


@pytest.mark.parametrize("solver", [js.RKC2(), js.IMEX(order=3), js.SDIRK(order=3)],
                         ids=["RKC2", "IMEX", "SDIRK"])  # fmt: skip
def test_mass_to_the_order_of_the_method_and_to_roundoff(solver):
    cloud = jittered_sphere(500)
    weights = jnp.asarray(np.random.default_rng(0).uniform(0.9, 1.1, size=500))
    u0 = jnp.exp(cloud.points[:, 0])
    drift = []
    for mass in (None, weights):
        problem = js.AdvectionDiffusionReaction(js.laplace_beltrami(cloud), mass=mass)
        u = js.integrate(problem, u0, t1=0.5, solver=solver, dt0=0.05).ys[-1]
        drift.append(abs(float(weights @ (u - u0)) / float(weights @ u0)))
    assert 1e-10 < drift[0] < 2e-2
    assert drift[1] < 1e-14


@pytest.mark.core
def test_conditions():
    """Values that move with time on a band around the equator: z decays."""
    cloud = js.sphere(1_000)
    z = cloud.points[:, 2]
    near = jnp.abs(z) < 0.1
    laplacian = js.laplace_beltrami(cloud)
    closure = js.eliminate(cloud, [js.dirichlet(near, lambda t: jnp.exp(-2 * t) * z[near])])
    problem = js.AdvectionDiffusionReaction(laplacian, closure=closure)
    for solver in (js.RKC2(), js.IMEX(order=3), js.SDIRK(order=3)):
        u = js.integrate(problem, z, t1=0.5, solver=solver, rtol=1e-6, atol=1e-7).ys[-1]
        np.testing.assert_array_equal(u[near], closure(u, 0.5)[near])
        assert relative_error(u, np.exp(-1.0) * z) < 3e-3
    split = problem.explicit_rate(0.3, z, None) + problem.implicit_rate(0.3, z, None)
    np.testing.assert_allclose(split, problem.rate(0.3, z, None), atol=1e-10)


def test_wave_conditions_bind_the_velocity_too():
    near = jnp.abs(Z) < 0.1
    omega = np.sqrt(2.0)
    closure = js.eliminate(CLOUD, [js.dirichlet(near, lambda t: jnp.cos(omega * t) * Z[near])])
    problem = js.WaveEquation(LAPLACIAN, closure=closure)
    value, velocity = js.integrate(problem, (Z, 0 * Z), t1=1.0, rtol=1e-7, atol=1e-8).ys
    assert float(jnp.abs(value[-1] - np.cos(omega) * Z).max()) < 2e-3
    assert float(jnp.abs(velocity[-1] + omega * np.sin(omega) * Z).max()) < 5e-3


def test_rates_are_differentiable_in_every_array():
    v0 = TURN
    u = jnp.exp(X)

    def scalar(arrays):
        weights, factor, velocity = arrays
        problem = js.AdvectionDiffusionReaction(
            js.Stencil(LAPLACIAN.indices, weights), diffusivity=factor,
            gradient=GRADIENT, velocity=velocity,
        )  # fmt: skip
        return jnp.sum(problem.rate(0.0, u, None) * Y)

    arrays = (LAPLACIAN.weights, 1 + 0.1 * Z, v0)
    direction = jax.tree.map(jnp.sin, arrays)
    moved = lambda h: scalar(jax.tree.map(lambda a, d: a + h * d, arrays, direction))
    expected = float(moved(1e-4) - moved(-1e-4)) / 2e-4
    products = jax.tree.map(jnp.vdot, jax.grad(scalar)(arrays), direction)
    np.testing.assert_allclose(float(sum(products)), expected, rtol=1e-8)


@pytest.mark.core
@pytest.mark.parametrize(
    "arguments, message",
    [
        (dict(), "neither a laplacian nor a velocity"),
        (dict(velocity=TURN), "needs the surface gradient"),
        (dict(velocity=TURN[:5], gradient=GRADIENT), r"velocity has shape \(5, 3\), expected"),
        (dict(laplacian=LAPLACIAN, mass=jnp.zeros(600)), "add up to 0.0"),
    ],
)
def test_misuse(arguments, message):
    with pytest.raises(ValueError, match=message):
        js.AdvectionDiffusionReaction(**arguments)


@pytest.mark.core
def test_known_weights_of_the_mass_in_compiled_code():
    def rate(u, mass):
        return js.AdvectionDiffusionReaction(LAPLACIAN, mass=mass).rate(0.0, u, None)

    weights = jnp.ones(600)
    known = jax.jit(lambda u: rate(u, weights))(X)
    traced = jax.jit(rate)(X, weights)
    for compiled in (known, traced):
        np.testing.assert_allclose(compiled, rate(X, weights), rtol=1e-10, atol=1e-10)


def test_misuse_seen_in_the_rate():
    shape = js.AdvectionDiffusionReaction(LAPLACIAN, diffusivity=jnp.ones(3))
    with pytest.raises(ValueError, match=r"diffusivity has shape \(3,\)"):
        shape.rate(0.0, X, None)
    wrong = js.AdvectionDiffusionReaction(LAPLACIAN, reaction=lambda t, u, args: u[:2])
    with pytest.raises(ValueError, match=r"reaction returns shape \(2,\), the field has \(600,\)"):
        wrong.rate(0.0, X, None)
    with pytest.raises(ValueError, match="power = 0"):
        js.hyperviscosity(LAPLACIAN, 1.0, power=0)
    with pytest.raises(ValueError, match="strength = -1"):
        js.hyperviscosity(LAPLACIAN, 1.0, strength=-1)
    with pytest.raises(ValueError, match="velocity has shape"):
        js.upwind_viscosity(CLOUD, TURN[:3])


# --- derivatives of whole integrations, conditions, problems of one's own -------------------

ANGLES, RING, _ = ring(16)
WAVY = jnp.exp(jnp.cos(ANGLES))


def wave_of(inputs):
    u0, weights, speed, damping = inputs
    problem = js.WaveEquation(js.Stencil(RING.indices, weights), speed=speed, damping=damping)
    return problem, (u0, jnp.sin(ANGLES)), dict(solver=dfx.Tsit5())


def phases_of(inputs):
    u0, weights, width, mobility = inputs
    operator = js.Stencil(RING.indices, weights)
    return js.CahnHilliard(operator, width=width, mobility=mobility), u0, dict(solver=js.IMEX())


@pytest.mark.parametrize(
    "made, numbers",
    [(wave_of, (1.3, 0.4)), (phases_of, (0.5, 0.2))],
    ids=["waves: speed and damping", "phases: width and mobility"],
)
def test_derivatives_of_waves_and_phases(made, numbers):
    """In the state, the operator and both parameters, each against differences of its own."""
    inputs = (WAVY - 1, RING.weights, *map(jnp.asarray, numbers))

    def scalar(inputs, adjoint=None):
        problem, u0, how = made(inputs)
        ys = js.integrate(problem, u0, t1=0.1, dt0=0.02, adjoint=adjoint, **how).ys
        return sum(jnp.sum(y[-1] ** 2 * (1 + jnp.cos(ANGLES))) for y in jax.tree.leaves(ys))

    value, gradient = jax.jit(scalar), jax.jit(jax.grad(scalar))(inputs)
    tangent = jax.jit(lambda d: jax.jvp(lambda x: scalar(x, dfx.ForwardMode()), (inputs,), (d,))[1])
    for k in range(4):
        direction = jax.tree.map(jnp.zeros_like, inputs)
        move = jnp.asarray(np.random.default_rng(k).normal(size=jnp.shape(inputs[k])))
        direction = (*direction[:k], move * inputs[k], *direction[k + 1 :])
        moved = lambda h, d=direction: jax.tree.map(lambda x, d: x + h * d, inputs, d)
        slope = lambda h, at=moved: float(value(at(h)) - value(at(-h))) / (2 * h)
        expected = (4 * slope(1e-4) - slope(2e-4)) / 3
        reverse = float(jnp.vdot(gradient[k], direction[k]))
        np.testing.assert_allclose(reverse, expected, rtol=1e-6)
        np.testing.assert_allclose(float(tangent(direction)), reverse, rtol=1e-8)


def square(n):
    return js.graph(lambda x, y: 0.0 * x, (n, n))


@pytest.mark.parametrize("ghosts", [False, True], ids=["closed", "ghosts"])
@pytest.mark.parametrize("kind", ["neumann", "robin"])
def test_heat_under_flux_conditions(kind, ghosts):
    """On a square with conditions at x = ±1: sin(π x / 2) with ∂u = 0, cos(x) with u = -b ∂u."""
    cloud, method = square(13), js.GFDM(degree=4)
    x = cloud.points[:, 0]
    side = np.abs(np.abs(np.asarray(x)) - 1) < 1e-9
    a, wave = (np.pi / 2, jnp.sin) if kind == "neumann" else (1.0, jnp.cos)
    # At corners the border has a conormal of its own, between those of the sides.
    outward = None if ghosts else jnp.stack([x, 0 * x, 0 * x], axis=1)[side]
    if kind == "neumann":
        flux = js.neumann(side, conormals=outward)
    else:
        flux = js.robin(side, a=1.0, b=1 / np.tan(1.0), conormals=outward)
    rest = js.neumann(np.asarray(cloud.boundary) & ~side)
    if ghosts:
        wide, closure = js.with_ghosts(cloud, [flux, rest], method=method)
    else:
        wide, closure = cloud, js.eliminate(cloud, [flux, rest], method=method)
    problem = js.AdvectionDiffusionReaction(
        js.laplace_beltrami(wide, method=method), closure=closure
    )
    u0 = closure.extend(wave(a * x)) if ghosts else wave(a * x)
    solution = js.integrate(problem, u0, t1=0.2, rtol=1e-5, atol=1e-7)
    exact = np.exp(-(a**2) * 0.2) * wave(a * x)
    assert float(jnp.abs(solution.ys[-1][: cloud.n] - exact).max()) < 0.02 * np.exp(-(a**2) * 0.2)
    # Without a word on the border it is refused.
    if not ghosts:
        with pytest.raises(ValueError, match=r"js\.free"):
            js.integrate(js.AdvectionDiffusionReaction(problem.laplacian), u0, t1=0.2)


class Swing(js.AbstractEvolution):
    """A pair of fields that turn into each other, stiffly damped: a problem of one's own."""

    closure: None
    laplacian: js.Stencil
    speed: float

    def linear(self, t, u):
        return tuple(0.01 * self.laplacian(self.laplacian(-part)) for part in u)

    def rest(self, t, u, args):
        return -self.speed * u[1], self.speed * u[0]


def test_a_problem_and_a_preconditioner_of_ones_own():
    c = jnp.cos(ANGLES)
    rate = -2 * (1 - np.cos(float(ANGLES[1]))) / float(ANGLES[1]) ** 2
    problem = Swing(None, RING, 2.0)
    assert js.choose_solver(problem)[1].startswith("IMEX")
    steps, top = [], 1.5 * float(jnp.abs(RING.weights[0]).max()) ** 2

    def inverse(g):
        """The diagonal of 1 + 0.01 g L², approximately."""
        steps.append(g)
        scale = lambda u: jax.tree.map(lambda v: v / (1 + 0.01 * g * top), u)
        return lx.FunctionLinearOperator(scale, jax.eval_shape(lambda: (c, c)))

    exact = np.exp(-0.01 * rate**2) * jnp.stack([np.cos(2.0) * c, np.sin(2.0) * c])
    for solver in (None, js.IMEX(order=3, preconditioner=inverse)):
        u = js.integrate(problem, (c, 0 * c), t1=1.0, solver=solver, rtol=1e-6, atol=1e-8).ys
        np.testing.assert_allclose(jnp.stack([part[-1] for part in u]), exact, atol=1e-4)
    assert steps


def test_upwinding_takes_the_neighbours_given_also_under_jit():
    cloud = js.PointCloud(CLOUD.points, CLOUD.normals)  # no spacing of its own
    make = lambda v, near: js.upwind_viscosity(cloud, v, neighbors=near).weights
    near = js.choose_neighbors(cloud)
    moved = jax.jit(
        lambda p, v: js.upwind_viscosity(js.PointCloud(p, p), v, neighbors=near).weights
    )
    np.testing.assert_allclose(moved(cloud.points, TURN), make(TURN, near), rtol=1e-8, atol=1e-8)


def test_upwinding_is_differentiable():
    """In the velocity and in the points, that come with normals of their own."""
    cloud = js.sphere(100)
    near = js.choose_neighbors(cloud)
    u, turn = jnp.sin(3 * cloud.points[:, 0]), jnp.cross(jnp.ones(3), cloud.points)

    def damped(points, velocity):
        made = js.PointCloud(points, cloud.normals)
        return jnp.sum(js.upwind_viscosity(made, velocity, neighbors=near)(u) ** 2)

    check_derivative(lambda v: damped(cloud.points, v), turn)
    check_derivative(lambda p: damped(p, turn), cloud.points, rtol=1e-5)


SINGLE = [js.RKC2(), js.IMEX(order=3), js.SDIRK(order=3), dfx.Tsit5()]


@pytest.mark.parametrize("solver", SINGLE, ids=lambda s: type(s).__name__)
def test_single_precision(solver):
    """Without 64 bits: values to 1e-3, derivatives to 1e-2, at tolerances of the default size."""
    with jax.enable_x64(False):
        narrow = lambda x: jnp.asarray(np.asarray(x), jnp.float32)
        operator = js.Stencil(RING.indices, narrow(RING.weights))
        u0, rate = narrow(WAVY), -2 * (1 - np.cos(np.pi / 8)) / (np.pi / 8) ** 2

        def end(d, u0):
            problem = js.AdvectionDiffusionReaction(operator, diffusivity=d)
            return js.integrate(problem, u0, t1=0.5, solver=solver).ys[-1]

        wave = narrow(jnp.cos(ANGLES))
        u = end(1.0, wave)
        assert u.dtype == jnp.float32
        np.testing.assert_allclose(u, np.exp(rate / 2) * np.asarray(wave), atol=1e-3)
        slope = jax.grad(lambda d: jnp.vdot(end(d, wave), wave))(1.0)
        exact = rate / 2 * np.exp(rate / 2) * float(jnp.vdot(wave, wave))
        np.testing.assert_allclose(float(slope), exact, rtol=1e-2)
        with pytest.raises(ValueError, match="jax_enable_x64"):
            js.integrate(js.AdvectionDiffusionReaction(operator), u0, t1=0.5, rtol=1e-8)
