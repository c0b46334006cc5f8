"""Hierarchies whose numbers are computed again: the host's numbers, its steps, derivatives."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxsurf as js
from jaxsurf.solve import precondition, shifted

from .helpers import count_compilations, jittered_sphere

pytest.importorskip("pyamg")

# Minutes in all.
pytestmark = pytest.mark.slow

N = 1_000
CLOUD = jittered_sphere(N)
X, Y, Z = CLOUD.points.T
SURFACE = js.discretize(CLOUD, method=js.GFDM(degree=2))
BAND = js.dirichlet(jnp.abs(Z) < 0.1, 0.0)
F = jnp.exp(CLOUD.points @ jnp.array([1.0, 2.0, 1.5]))


@pytest.fixture(autouse=True)
def _three_levels(monkeypatch):
    monkeypatch.setattr(precondition, "_COARSEST", 60)


def twisted(t):
    """The sphere twisted about its axis and stretched."""
    angle = 0.5 * t * Z
    x, y = X * jnp.cos(angle) - Y * jnp.sin(angle), X * jnp.sin(angle) + Y * jnp.cos(angle)
    return jnp.stack([x * (1 + 0.15 * t * x), y, Z * (1 + 0.1 * t * jnp.sin(3 * y))], 1)


def other_operator(t, method, k):
    """A Laplacian at other points, with lists of its own."""
    points = twisted(t)
    cloud = js.PointCloud(points, js.estimate_normals(points))
    lists = js.find_neighbors(cloud, k=k)
    return js.laplace_beltrami(cloud, lists, method=method)


def assert_same(one, other, rtol=1e-6):
    """Up to round-off in single precision."""
    one, other = np.asarray(one, float), np.asarray(other, float)
    np.testing.assert_allclose(other, one, rtol=0, atol=rtol * np.abs(one).max(initial=0))


@pytest.mark.parametrize(
    "kind", [pytest.param("closed", marks=pytest.mark.core), "dirichlet", "masked"]
)
def test_at_the_same_weights_the_numbers_are_those_of_the_host(kind):
    cloud = js.PointCloud(CLOUD.points, CLOUD.normals, active=jnp.arange(N) % 3 > 0)
    operator = SURFACE.laplacian
    if kind == "masked":
        operator = js.laplace_beltrami(cloud, method=SURFACE.method)
    conditions = js.eliminate(CLOUD, BAND) if kind == "dirichlet" else None
    host = js.multigrid(operator, closure=conditions, renewable=True)
    renewed = host.renewed(operator, closure=conditions)
    assert renewed.sizes == host.sizes and len(host.levels) == 2
    for a, b in zip(host.levels, renewed.levels):
        assert_same(a.inverse, b.inverse)
        assert_same(a.damping, b.damping)
        for here, there in ((a.prolong, b.prolong), (a.restrict, b.restrict)):
            assert_same(here.weights, there.weights)
            assert_same(here.extra[2], there.extra[2])
    a, b = host.levels[1], renewed.levels[1]
    assert_same(a.matrix.weights, b.matrix.weights)
    assert_same(a.transposed.weights, b.transposed.weights)
    assert_same(host.coarsest, renewed.coarsest)
    # The finest matrix is the operator itself.
    r = F if conditions is None else conditions.restrict(F)
    r = r if operator.active is None else jnp.where(operator.active, r, 0)
    assert_same(host(r), renewed(r), 1e-5)
    assert_same(host.transpose()(r), renewed.transpose()(r), 1e-5)


@pytest.mark.parametrize("closed", [True, False])
@pytest.mark.parametrize("method", [js.GFDM(degree=2), js.GFDM(degree=4)])
def test_steps_are_those_of_a_hierarchy_made_anew(method, closed):
    """On a deformed sphere with neighbours found anew; another one compiles nothing."""
    k = method.neighbor_count(3)
    first = js.laplace_beltrami(CLOUD, js.find_neighbors(CLOUD, k=k), method=method)
    conditions = None if closed else js.eliminate(CLOUD, BAND)
    cycle = js.multigrid(first, closure=conditions, renewable=True)

    def steps(preconditioner, operator):
        options = {"closure": conditions, "project": True, "preconditioner": preconditioner}
        return js.solve(operator, F, **options).stats["num_steps"]

    @jax.jit
    def with_renewed(operator):
        return steps(cycle.renewed(operator, closure=conditions), operator)

    with_renewed(first)
    for t in (0.5, 1.0):
        operator = other_operator(t, method, k)
        assert operator.weights.shape == first.weights.shape
        moved = np.sort(operator.indices, axis=0) != np.sort(first.indices, axis=0)
        assert moved.any(axis=0).mean() > 0.3  # of the lists
        with count_compilations() as names:
            count = int(with_renewed(operator))
        assert not names, names
        anew = js.multigrid(operator, closure=conditions)
        assert count <= 1.3 * int(steps(anew, operator))


@pytest.mark.parametrize("given", [True, False])
def test_derivatives_in_points_through_compiled_solves(given):
    """With aggregates found outside by weights, or, by neighbours alone, while it is compiled."""
    cycle = js.multigrid(SURFACE.laplacian, renewable=True)
    weights = 1 + X

    def solution(t):
        laplacian = SURFACE.moved(twisted(t)).laplacian
        options = {"project": True, "rtol": 1e-12, "mean_zero": True}
        if given:
            options["preconditioner"] = cycle.renewed(laplacian)
        return js.solve(laplacian, F, **options)

    @jax.jit
    def scalar(t):
        return jnp.sum(weights * solution(t).value ** 2)

    step = 1e-4
    difference = (scalar(0.5 + step) - scalar(0.5 - step)) / (2 * step)
    np.testing.assert_allclose(jax.jit(jax.grad(scalar))(0.5), difference, rtol=1e-6)


@pytest.mark.parametrize("kind", ["closed", "dirichlet", "screened"])
def test_aggregates_found_by_neighbours_serve_as_well(kind):
    surface = js.discretize(CLOUD, method=js.GFDM(degree=4))
    conditions = js.eliminate(CLOUD, BAND) if kind == "dirichlet" else None
    options = {"project": True, "closure": conditions, "mean_zero": kind == "closed"}

    def solution(t):
        laplacian = surface.moved(twisted(t)).laplacian
        return js.solve(1 - laplacian if kind == "screened" else laplacian, F, **options)

    compiled, host = jax.jit(solution)(0.5), solution(0.5)
    assert compiled.stats["num_steps"] <= 1.3 * host.stats["num_steps"]
    assert_same(host.value, compiled.value, 1e-6)


@pytest.mark.core
def test_weights_and_newton_in_compiled_code():
    laplacian, total = SURFACE.laplacian, SURFACE.areas.sum()
    moved = lambda t: js.Stencil(laplacian.indices, t * laplacian.weights)
    weights = jax.jit(lambda t: js.conservative_weights(moved(t), total))(2.0)
    np.testing.assert_allclose(weights, js.conservative_weights(laplacian, total), rtol=1e-8)
    reaction = lambda u, args: -u - u**3
    newton = lambda t: js.solve_nonlinear(moved(t), reaction, F, rhs=-F).value
    np.testing.assert_allclose(jax.jit(newton)(2.0), newton(2.0), rtol=1e-6)


def test_vmap_over_weights():
    laplacian = SURFACE.laplacian
    cycle = js.multigrid(laplacian, renewable=True)
    cycled = lambda factor: cycle.renewed(factor * laplacian)(F - jnp.mean(F))
    factors = jnp.array([1.0, 3.0])
    one, three = jax.jit(jax.vmap(cycled))(factors)
    assert_same(cycled(1.0), one, 1e-5)
    assert_same(one / 3, three, 1e-5)


def test_sums_and_compositions():
    laplacian = SURFACE.laplacian
    screened = 1 - laplacian
    cycle = js.multigrid(screened @ screened, renewable=True)
    # Traced indices do not show where the centre is: a sum of a stencil and a number.
    renewed = jax.jit(lambda a: cycle.renewed((1 - a) @ (1 - a))(F))(laplacian)
    assert_same(cycle(F), renewed, 1e-5)


@pytest.mark.parametrize("closed", [True, False])
def test_hierarchies_for_all_steps(closed):
    laplacian = SURFACE.laplacian
    conditions = None if closed else js.eliminate(CLOUD, BAND)
    host = shifted.shifted_multigrid(laplacian, closure=conditions, renewable=True)
    renewed = host.renewed(laplacian, closure=conditions)
    assert len(host.pairs) == 2
    for a, b in zip(host.pairs, renewed.pairs):
        for name in ("mass_diagonal", "stiff_diagonal", "radius"):
            assert_same(getattr(a, name), getattr(b, name))
        assert_same(a.prolong.weights, b.prolong.weights)
    for name in ("mass", "stiff", "mass_transposed", "stiff_transposed"):
        a, b = (getattr(hierarchy.pairs[1], name) for hierarchy in (host, renewed))
        assert_same(a.weights, b.weights)
    assert_same(host.mass, renewed.mass)
    assert_same(host.stiff, renewed.stiff)
    r = F if conditions is None else conditions.restrict(F)
    for g in (1e-4, 0.1):
        assert_same(host.at(g)(r), renewed.at(g)(r), 1e-5)
        assert_same(host.at(g).transpose()(r), renewed.at(g).transpose()(r), 1e-5)


def test_implicit_steps_on_another_surface():
    method = js.GFDM(degree=2)
    k = method.neighbor_count(3)
    problem = lambda laplacian: js.BiharmonicDiffusion(laplacian, stiffness=0.01)
    first = other_operator(0.0, method, k)
    made = js.step_preconditioner(problem(first), F, renewable=True)

    @jax.jit
    def left(operator):
        """Of the residual after four cycles."""
        inverse = made.renewed(problem(operator))(0.1)
        x = jnp.zeros_like(F)
        residual = lambda x: F - x - 0.001 * operator(operator(x))
        for _ in range(4):
            x = x + inverse.mv(residual(x))
        return jnp.linalg.norm(residual(x)) / jnp.linalg.norm(F)

    operator = other_operator(1.0, method, k)
    anew = js.step_preconditioner(problem(operator), F)(0.1)
    x = jnp.zeros_like(F)
    for _ in range(4):
        x = x + anew.mv(F - x - 0.001 * operator(operator(x)))
    best = jnp.linalg.norm(F - x - 0.001 * operator(operator(x))) / jnp.linalg.norm(F)
    assert float(left(operator)) <= max(1e-2, 10 * float(best))


@pytest.mark.core
def test_what_cannot_be_renewed_is_told():
    laplacian = SURFACE.laplacian
    with pytest.raises(ValueError, match="renewable=True"):
        js.multigrid(laplacian).renewed(laplacian)
    cycle = js.multigrid(laplacian, renewable=True)
    with pytest.raises(ValueError, match=r"300 points, the hierarchy has 1000"):
        cycle.renewed(js.laplace_beltrami(js.sphere(300)))
    with pytest.raises(ValueError, match="diagonal of a Composition"):
        cycle.renewed(laplacian @ laplacian)
    made = js.step_preconditioner(js.BiharmonicDiffusion(laplacian), Z)
    with pytest.raises(ValueError, match="renewable=True"):
        made.renewed(js.BiharmonicDiffusion(laplacian))


@pytest.mark.core
def test_sums_with_compositions_take_a_preconditioner_from_outside():
    stiff = lambda surface: 1 + 1e-2 * surface.laplacian @ surface.laplacian
    cycle = js.multigrid(stiff(SURFACE))

    def energy(points, preconditioner=None):
        given = dict(mean_zero=False, preconditioner=preconditioner, rtol=1e-10)
        return F @ js.solve(stiff(SURFACE.moved(points)), F, **given).value

    points = SURFACE.cloud.points
    with pytest.raises(ValueError, match=r"make js\.multigrid\(operator\) outside"):
        jax.jit(energy)(points)
    compiled = jax.jit(lambda points: energy(points, cycle))
    assert js.taylor_remainders(compiled, points, 0.1 * points[:, ::-1]).slope > 1.9
