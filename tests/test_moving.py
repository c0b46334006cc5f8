r"""Surfaces that move, and equations on them, against exact solutions."""

import warnings

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxsurf as js
from jaxsurf.moving.eversion import told_extinction
from jaxsurf.moving.problem import Moving

from .helpers import count_compilations, killed

CLOUD = js.sphere(200)
SURFACE = js.discretize(CLOUD, method=js.GFDM(degree=2))
X, Y, Z = CLOUD.points.T
# Rate at which the radius of a sphere grows.
RATE = 0.5


def growing(t, surface, fields, args):
    return args * surface.cloud.normals


def heat(surface):
    return js.AdvectionDiffusionReaction(surface.laplacian)


def grown(rate=RATE, cloud=SURFACE, u=X * Y, **options):
    """Heat on a sphere that grows."""
    options = dict(t1=1.0, fields=u, problem=heat, args=rate) | options
    return js.evolve(js.Motion(growing), cloud, **options)


def exact(eigenvalue, t=1.0, rate=RATE):
    r"""Factor of a field: $r^{-2}\exp(\lambda\int r^{-2})$."""
    r = 1 + rate * t
    return r**-2 * np.exp(eigenvalue * (1 - 1 / r) / rate)


@pytest.mark.slow
@pytest.mark.parametrize("order, slope, largest", [(1, 0.9, 0.3), (3, 2.7, 1e-3)])
def test_solvers_keep_their_order_though_the_geometry_moves(order, slope, largest):
    """Steps halved; the eigenvalue is that of the stencils, so that only time is judged."""
    eigenvalue = float(jnp.vdot(X * Y, SURFACE.laplacian(X * Y)) / jnp.vdot(X * Y, X * Y))
    errors = []
    for steps in (16, 32):
        end = grown(solver=js.IMEX(order=order), dt0=1 / steps)
        factor = float(jnp.vdot(X * Y, end.fields[-1]) / jnp.vdot(X * Y, X * Y))
        errors.append(abs(factor / exact(eigenvalue) - 1))
        radius = jnp.linalg.norm(end.clouds[-1].points, axis=1)
        assert float(jnp.abs(radius - 1.5).max()) < 1e-10
    assert np.log2(errors[0] / errors[1]) > slope and errors[1] < largest, errors


@pytest.mark.slow
def test_a_sphere_shrinks_by_its_curvature():
    """r² falls by twice the time, but for the error of the stencils, Δx = -2 c x."""
    end = js.evolve(js.MeanCurvatureFlow(), SURFACE, t1=0.2, solver=js.IMEX(order=2), dt0=0.02)
    points = CLOUD.points
    c = -float(jnp.vdot(points, SURFACE.laplacian(points)) / jnp.vdot(points, points)) / 2
    assert abs(c - 1) < 0.05
    radius = jnp.linalg.norm(end.clouds[-1].points, axis=1)
    assert abs(float(jnp.mean(radius)) / (1 - 0.4 * c) ** 0.5 - 1) < 1e-3
    turned = jnp.sum(end.clouds[-1].normals * points, axis=1)
    assert float(turned.min()) > 1 - 1e-6


@pytest.mark.parametrize("size, place", [(1.0, 0.0), (1.0, 1e3), (1e-6, 0.0), (1e6, -1e2)])
def test_neither_place_nor_unit_of_length_makes_steps_coarse(size, place):
    """A circle shrinks as r² = 1 - t, in units of its radius; tolerances are of those too."""
    assert shrunk(size, place, float) < 1e-3


def test_round_off_far_from_the_origin_shortens_no_steps():
    """Single precision has 1e-5 radii left there, as large as the tolerance."""
    assert shrunk(1.0, 100.0, np.float32) < 3e-3


def shrunk(size, place, dtype):
    circle = js.circle(60)
    points = (size * (circle.points + place)).astype(dtype)
    cloud = js.PointCloud(points, circle.normals.astype(dtype))
    end = js.evolve(js.MeanCurvatureFlow(), cloud, t1=0.5 * size**2).clouds[-1]
    radius = jnp.linalg.norm(end.points / size - place, axis=1)
    return float(jnp.abs(radius / 0.5**0.5 - 1).max())


def test_fields_below_the_tolerance_are_told():
    """Beside points that are not."""
    with pytest.warns(UserWarning, match=r"fields is at most .* errors of atol = 1e-07"):
        grown(u=1e-9 * X, t1=0.1)


@pytest.mark.slow
def test_an_ellipsoid_that_keeps_its_volume_loses_area():
    surface = js.discretize(js.ellipsoid(200, (1.2, 1.0, 0.85)), method=js.GFDM(degree=2))
    flow = js.MeanCurvatureFlow(keep_volume=True)
    found = js.evolve(flow, surface, t1=0.03, saveat=[0.0], solver=dfx.Heun(), dt0=0.01)
    history = found.history
    assert np.all(np.diff(history["area"]) < 0)
    np.testing.assert_allclose(history["volume"], history["volume"][0], rtol=2e-3)


@pytest.mark.slow
def test_neighbours_are_found_anew_where_a_surface_is_sheared():
    """Latitudes that turn at different speeds leave the sphere and z as they are."""

    def shear(t, surface, fields, args):
        x, y, z = surface.cloud.points.T
        return 3 * z[:, None] * jnp.stack([-y, x, 0 * x], axis=1)

    found = js.evolve(js.Motion(shear), SURFACE, t1=0.6, fields=Z, problem=heat)
    assert found.stats["renewals"] > 0
    np.testing.assert_allclose(jnp.linalg.norm(found.clouds[-1].points, axis=1), 1, atol=1e-4)
    # As far from exp(-2t) z as the Laplacians of start and end are from -2 z.
    wrong = [float(jnp.abs(s.laplacian(Z) + 2 * Z).max()) for s in (SURFACE, found.surfaces[-1])]
    np.testing.assert_allclose(found.fields[-1], np.exp(-1.2) * Z, atol=0.6 * max(wrong))
    wanted = np.asarray(js.find_neighbors(found.clouds[-1], k=10).indices)
    nearest = np.asarray(found.surfaces[-1].neighbors.indices)
    assert all(set(a) <= set(b) for a, b in zip(wanted, nearest))


def slanting(t, surface, fields, args):
    return args * jnp.eye(3)[0] * surface.cloud.points[:, 2:]


@pytest.mark.slow
def test_steps_that_go_farther_than_the_neighbours_serve_are_shortened():
    """To the solver a single step would do: the velocity of each point is constant."""
    found = js.evolve(js.Motion(slanting), SURFACE, t1=1.0, args=1.0, fields=(X, Y))
    assert found.stats["refused"] > 0 and found.stats["renewals"] > 0
    np.testing.assert_allclose(found.clouds[-1].points[:, 0], X + Z, atol=1e-6)
    sheared = js.discretize(found.clouds[-1], method=SURFACE.method)
    assert jnp.all(found.surfaces[-1].code == 0) and jnp.all(sheared.code == 0)
    # Normals of a linear map of the sphere; it ends in tips as sharp as one spacing.
    normals = jnp.stack([X, Y, Z - X], axis=1)
    normals = normals / jnp.linalg.norm(normals, axis=1, keepdims=True)
    assert float(jnp.min(jnp.sum(normals * found.clouds[-1].normals, axis=1))) > 0.95


def test_an_error_of_a_surface_says_when():
    """A circle that is pressed flat, where a fold is seen when it is saved."""
    flat = js.Motion(lambda t, surface, *_: surface.cloud.points * jnp.array([0.0, -3.0]))
    with pytest.raises(ValueError, match=r"at t = 2: point \d+: .* a fold"):
        js.evolve(flat, js.circle(60), t1=2.0)


@pytest.mark.slow
def test_a_run_that_was_killed_ends_in_the_same_bits(tmp_path, monkeypatch):
    """Neighbours are found anew on the way; what is saved before and after comes back."""

    def run(name, rate=1.2):
        checkpoint = js.Checkpoint(tmp_path / name, every=0.3)
        given = dict(saveat=[0.0, 0.2, 0.7], args=rate, fields=(X, Y), checkpoint=checkpoint)
        return js.evolve(js.Motion(slanting), SURFACE, t1=1.0, **given)

    whole = run("whole")
    assert whole.stats["renewals"] > 0 and whole.ts.tolist() == [0.0, 0.2, 0.7, 1.0]
    np.testing.assert_allclose(whole.clouds[-1].points[:, 0], X + 1.2 * Z, atol=1e-6)
    arrays = lambda run: jax.tree.leaves((run.ts, run.surfaces, run.fields))
    # From the middle, and from the end.
    for again in (killed(run, monkeypatch, writes=2), run("whole")):
        assert again.stats | {"solver": ""} == whole.stats | {"solver": ""}
        for one, other in zip(arrays(again), arrays(whole), strict=True):
            np.testing.assert_array_equal(one, other)
    with pytest.raises(ValueError, match="whole is a checkpoint of another run"):
        run("whole", rate=1.3)


@pytest.mark.slow
def test_waves_are_diluted_in_their_velocity():
    r"""$\phi = \sin(\sqrt 6 t)\,x y$ with the forcing that belongs to it (E18)."""
    root = 6**0.5

    def problem(surface):
        x, y, _ = surface.cloud.points.T

        def forcing(t, u, args):
            # Dφ/Dt = (c √6 + s 2 r'/r) x y along the path of a point, s and c of √6 t.
            s, c, g = jnp.sin(root * t), jnp.cos(root * t), RATE / (1 + RATE * t)
            second = -6 * s + 4 * root * c * g + 2 * s * g**2
            first = root * c + 2 * s * g
            return (second + 2 * g * first + 6 * s / (1 + RATE * t) ** 2) * x * y

        return js.WaveEquation(surface.laplacian, forcing=forcing)

    start = (0 * X, root * X * Y)
    end = grown(u=start, problem=problem, rtol=1e-6)
    x, y, _ = end.clouds[-1].points.T
    u = np.sin(root) * x * y
    assert float(jnp.linalg.norm(end.fields[-1][0] - u) / jnp.linalg.norm(u)) < 2e-2


def test_waves_on_a_border_that_moves_have_the_velocity_of_what_they_are_given_there():
    """Values that ride on the rim of a bowl that grows change with its place, too."""
    root, t = 6**0.5, 0.7
    bowl = js.surface_of_revolution(
        lambda s: (jnp.sin(s), -jnp.cos(s)), 200, interval=(0, np.pi / 2)
    )
    rim = np.flatnonzero(bowl.boundary)

    def problem(surface):
        x, y, _ = surface.cloud.points[rim].T
        given = js.dirichlet(rim, lambda t: jnp.sin(root * t) * x * y)
        return js.WaveEquation(surface.laplacian, closure=js.eliminate(surface, given))

    moving = Moving.of(js.discretize(bowl, method=SURFACE.method), js.Motion(growing), problem)
    product = bowl.points[:, 0] * bowl.points[:, 1]
    sine, cosine = np.sin(root * t), np.cos(root * t)
    exact = sine * product, (root * cosine + 2 * RATE * sine) * product
    state = bowl.points, tuple(jnp.where(bowl.boundary, 7.0, u) for u in exact)
    for found, wanted in zip(moving.fields(t, state, RATE), exact):
        np.testing.assert_allclose(found, wanted, atol=1e-12)


@pytest.mark.slow
def test_derivatives_through_the_motion():
    """In rate, points and fields, against differences: all in one program."""
    weights = jnp.exp(X)

    def f(rate, points, u):
        cloud = js.PointCloud(points, CLOUD.normals)
        surface = js.Discretization(cloud, SURFACE.neighbors, SURFACE.method)
        end = grown(rate, surface, u, t1=0.06, solver=dfx.Heun(), dt0=0.02)
        return jnp.vdot(weights, end.fields[-1]) + jnp.sum(weights * end.clouds[-1].points[:, 0])

    at = (jnp.asarray(RATE), CLOUD.points, Z)
    slopes = jax.jit(jax.grad(f, argnums=(0, 1, 2)))(*at)
    value = jax.jit(f)
    ways = jnp.asarray(0.3), 0.1 * jnp.sin(3 * CLOUD.points[:, ::-1]), jnp.cos(2 * Y)
    for i, way in enumerate(ways):
        h = 1e-4
        above, below = (
            value(*(a + e * way if j == i else a for j, a in enumerate(at))) for e in (h, -h)
        )
        difference = (above - below) / (2 * h)
        assert abs(float(jnp.vdot(slopes[i], way) - difference)) < 1e-6 * abs(difference) + 1e-8


@pytest.mark.slow
def test_mapped_and_in_single_precision():
    """Two rates at once; and all of it in float32."""
    end = lambda rate: (
        js.evolve(js.Motion(growing), SURFACE, t1=1.0, args=rate, solver=dfx.Heun(), dt0=0.5)
        .clouds[-1]
        .points
    )
    both = jax.jit(jax.vmap(end))(jnp.array([0.5, 0.25]))
    np.testing.assert_allclose(both, [1.5 * CLOUD.points, 1.25 * CLOUD.points], atol=1e-12)
    single = js.PointCloud(*(a.astype(jnp.float32) for a in (CLOUD.points, CLOUD.normals)))
    options = dict(args=np.float32(0.5), method=SURFACE.method, solver=dfx.Heun(), dt0=0.5)
    # 0.7 is less in single precision, and is reached all the same.
    found = js.evolve(js.Motion(growing), single, t1=0.7, **options).clouds[-1].points
    assert found.dtype == jnp.float32
    np.testing.assert_allclose(found, 1.35 * CLOUD.points, atol=1e-5)


@pytest.mark.slow
def test_a_compiled_motion_that_outruns_its_neighbours_is_an_error():
    flat = lambda t, surface, fields, args: args * surface.cloud.points * jnp.array([0, 0, -1.0])
    end = lambda rate: (
        js.evolve(js.Motion(flat), SURFACE, t1=1.0, args=rate, solver=dfx.Heun(), dt0=0.1)
        .clouds[-1]
        .points
    )
    with pytest.raises(Exception, match="does not keep the neighbours"):
        jax.block_until_ready(jax.jit(end)(jnp.asarray(4.0)))


@pytest.mark.core
def test_a_rigid_motion_and_what_is_saved():
    """Rotation about an axis: points and normals to the tolerance of the steps; other numbers."""
    axis = jnp.array([1.0, 0.0, 1.0])
    spin = lambda t, surface, fields, args: args * jnp.cross(axis, surface.cloud.points)
    run = lambda speed, **options: js.evolve(
        js.Motion(spin), SURFACE, t1=np.pi / 2**0.5, fields=Z, args=speed, rtol=1e-8, **options
    )
    found = run(1.0, saveat=[0.0, 0.5])
    assert found.ts.tolist() == [0.0, 0.5, np.pi / 2**0.5]
    half = 2 * np.outer(axis, axis) / 2 - np.eye(3)  # by half a turn
    np.testing.assert_allclose(found.clouds[-1].points, CLOUD.points @ half.T, atol=1e-6)
    np.testing.assert_allclose(found.clouds[-1].normals, CLOUD.normals @ half.T, atol=1e-6)
    np.testing.assert_array_equal(found.clouds[0].points, CLOUD.points)
    assert bool(jnp.all(found.fields[-1] == Z)) and found.stats["renewals"] == 0
    assert "200 points" in repr(found) and "Tsit5" in repr(found)
    solver = found.stats["solver"]
    assert solver.startswith("Tsit5")
    back = run(-1.0).clouds[-1].points
    np.testing.assert_allclose(back, CLOUD.points @ half.T, atol=1e-6)


def test_heat_stays_within_borders_that_move_with_it():
    """On a band of a cylinder that heat inflates: r' = phi / 2 with phi r kept, so r² = 1 + t.

    What stands at the border at the start is no heat that there is: nobody looks at it.
    """
    band = js.surface_of_revolution(lambda s: (1.0 + 0 * s, s), 600)
    heat = lambda surface: js.AdvectionDiffusionReaction(
        surface.laplacian, closure=js.without_flux(surface)
    )
    motion = js.Motion(lambda t, surface, phi, args: phi[:, None] * surface.cloud.normals / 2)
    start = jnp.where(band.boundary, 100.0, 1.0)
    given = dict(fields=start, problem=heat, method=js.GFDM(degree=2))
    adapt = js.Adaptation(0.1, capacity=900)
    run = js.evolve(motion, band, t1=0.5, saveat=[0.0], adapt=adapt, **given)
    end, phi = run.clouds[-1], run.fields[-1]
    radius = jnp.linalg.norm(end.points[:, :2], axis=1)
    assert jnp.abs(radius - 1.5**0.5).max() < 1e-2
    assert jnp.abs(phi - 1.5**-0.5).max() < 1e-2
    mass = run.history["mass"]
    assert abs(mass[1] / mass[0] - 1) < 1e-2


def test_conditions_of_a_surface_also_where_it_is_traced():
    """Its neighbours and border are taken, which nothing can search for there."""
    bowl = js.surface_of_revolution(
        lambda s: (jnp.sin(s), -jnp.cos(s)), 200, interval=(0, np.pi / 2)
    )
    rim, product = np.flatnonzero(bowl.boundary), bowl.points[:, 0] * bowl.points[:, 1]

    def filled(scale):
        moved = js.discretize(bowl, method=SURFACE.method).moved(scale * bowl.points)
        # Nothing of x y leaves through the rim, where z = 0.
        flux = js.robin(rim, a=1.0, b=1.0, value=product[rim])
        return js.eliminate(moved, flux)(jnp.where(bowl.boundary, 0, product))

    for scale in (1.0, 1.5):
        found = jax.jit(filled)(scale)
        np.testing.assert_allclose(found, filled(scale), atol=1e-9)
        np.testing.assert_allclose(found, product, atol=5e-3)


def test_a_flow_of_a_border_is_refused_for_what_it_is():
    bowl = js.surface_of_revolution(
        lambda s: (jnp.sin(s), -jnp.cos(s)), 200, interval=(0, np.pi / 2)
    )
    heat = lambda s: js.AdvectionDiffusionReaction(s.laplacian, closure=js.without_flux(s))
    given = dict(t1=0.1, fields=bowl.points[:, 0], problem=heat)
    with pytest.raises(
        ValueError, match=r"more\) lies on the border, but MeanCurv.* closed surfaces"
    ):
        js.evolve(js.MeanCurvatureFlow(), bowl, **given)


def test_operators_of_another_surface_do_not_pass_in_silence():
    """A Laplacian made before is that of the surface at t0, whatever becomes of it."""
    stays = lambda _: js.AdvectionDiffusionReaction(SURFACE.laplacian)
    with pytest.warns(UserWarning, match="not made from the surface") as told:
        grown(t1=0.1, problem=stays)
    assert {str(one.message)[:20] for one in told} == {"an operator of the p"}
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        grown(t1=0.1)


def test_a_second_run_compiles_nothing():
    """The problem looks at the surface beneath tracers, by functions that are new each time."""
    given = dict(t1=0.1, problem=heat, solver=dfx.Heun(), dt0=0.05)
    grown(**given)
    with count_compilations() as names:
        again = grown(rate=1.1 * RATE, **given)
    assert not names, names
    assert again.stats["steps"] == 2


def test_the_volume_is_told_of_closed_surfaces_wherever_they_are():
    still = js.Motion(lambda t, surface, *_: 0 * surface.cloud.points)
    told = lambda cloud: js.evolve(still, cloud, t1=1.0).history["volume"][-1]
    far = js.discretize(js.PointCloud(CLOUD.points + 1e4, CLOUD.normals), method=SURFACE.method)
    np.testing.assert_allclose(told(far), js.volume(SURFACE), rtol=1e-8)
    angles = jnp.linspace(0, jnp.pi, 40)
    arc = jnp.stack([jnp.cos(angles), jnp.sin(angles)], axis=1)
    assert np.isnan(told(js.PointCloud(arc, arc, boundary=np.arange(40) % 39 == 0)))


def test_a_surface_that_shrinks_to_nothing_is_told():
    """By the error of a flow that goes on past that; not of one that stops for another reason."""
    stopped = lambda x: js.IntegrationError("stopped", None, 0.5, (x,))
    vanished = told_extinction(SURFACE, stopped(3 + 2e-4 * CLOUD.points))
    assert "stopped. The surface has shrunk to 0.0002 of its size: it vanishes" in str(vanished)
    assert vanished.time == 0.5
    assert str(told_extinction(SURFACE, stopped(0.3 * CLOUD.points))) == "stopped"


def test_a_surface_that_is_turned_inside_out_is_told():
    """By steps over the moment at which it is a point: it is smooth on either side."""
    inwards = js.Motion(lambda t, surface, *_: -surface.cloud.normals)
    options = dict(dt0=0.75, solver=dfx.Euler())
    with pytest.warns(UserWarning, match="inside out at t = 1.5: since t = 0"):
        assert js.evolve(inwards, CLOUD, t1=1.5, **options).history["volume"][0] < 0
    bowl = CLOUD.points[:, 2] < -0.3
    bowl = js.PointCloud(CLOUD.points[bowl], CLOUD.normals[bowl])
    flips = js.Motion(lambda t, surface, *_: -2 * surface.cloud.points.at[:, :2].set(0))
    with warnings.catch_warnings():
        warnings.filterwarnings("error", message=".*inside out")
        js.evolve(inwards, CLOUD, t1=0.75, **options)  # a ball still, if a small one
        js.evolve(flips, bowl, t1=1.5, **options)  # nothing is inside


def test_progress_bar(capfd):
    """In units of t, in few digits: 0.1 + 0.2 is 0.30000000000000004."""
    drift = js.Motion(lambda t, surface, fields, args: 0 * surface.cloud.normals)
    js.evolve(drift, js.circle(60), t1=0.1 + 0.2, saveat=[0.1], progress=True)
    told = capfd.readouterr().err
    assert "t = 0.3 of 0.3" in told and "0000" not in told


def test_where_a_surface_has_no_areas_a_step_is_refused_not_an_error():
    """A step that is tried may tear it: the rate is then no number, by which steps are refused."""
    surface = js.discretize(js.sphere(200), method=js.GFDM(degree=2))
    moving = Moving.of(surface, js.MeanCurvatureFlow(keep_volume=True), None)
    rate = jax.jit(lambda x: moving.rate(0.0, (x,), None)[0])
    torn = np.random.default_rng(0).permutation(surface.cloud.points)
    assert np.all(np.abs(rate(surface.cloud.points)) < 0.1)
    assert np.all(np.isnan(rate(jnp.asarray(torn))))
