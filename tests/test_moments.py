import itertools
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize

from jaxsurf.fits.kernels import gaussian, support, taper
from jaxsurf.fits.lines import are_steep, line_solve
from jaxsurf.fits.lines import moments as moments_of_lines
from jaxsurf.fits.moments import (
    blockwise,
    in_blocks,
    moment_solve,
    out_of_blocks,
    polynomial_fit,
)
from jaxsurf.fits.monomials import (
    differentiation,
    monomials,
    monomials_on_lines,
    multi_indices,
)
from jaxsurf.fits.polygon import _root
from jaxsurf.fits.sums import spread, sums, total
from jaxsurf.stencils.method import power_mean, ramp
from jaxsurf.stencils.targets import Gradient, Hessian, Laplacian, Partial

from .helpers import check_derivative, check_derivatives, operations


def _plain_sums(rows, axis):
    return [jnp.sum(row, axis=axis) for row in rows]


def _plain_spread(rows, axis, size):
    return [jnp.repeat(jnp.expand_dims(row, axis), size, axis) for row in rows]


@pytest.mark.parametrize("compiled", [False, True])
@pytest.mark.parametrize(
    "ours, plain, shape, rest",
    [(sums, _plain_sums, (2, 40, 3), (1,)), (spread, _plain_spread, (2, 3), (1, 40))],
)
def test_many_sums_in_one_pass(ours, plain, shape, rest, compiled):
    """Values, both modes of derivatives, second ones, and batches with rows that all share."""
    rng = np.random.default_rng(0)
    a, b, d = (jnp.asarray(rng.normal(size=shape)) for _ in range(3))

    def both(f):
        def value(a, b):
            # Nothing of the second row counts: it has no cotangent.
            first, _, third = f([a * b, a, jnp.sin(a)], *rest)
            return jnp.sum(first**2 * third)

        tangent = lambda a, b: jax.jvp(value, (a, b), (d, d))[1]
        found = (value, jax.grad(value, (0, 1)), tangent, jax.grad(tangent))
        batches = jax.vmap(jax.grad(value), (2, None)), jax.vmap(jax.grad(value), (None, 0))
        args = (jnp.stack([a, b], axis=2), b), (a, jnp.stack([a, b]))
        run = jax.jit if compiled else lambda f: f
        return [run(f)(a, b) for f in found] + [run(f)(*x) for f, x in zip(batches, args)]

    for one, other in zip(jax.tree.leaves(both(ours)), jax.tree.leaves(both(plain)), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-12, atol=1e-12)


@pytest.mark.skipif(jax.default_backend() != "cpu", reason="of the compiler for CPUs")
@pytest.mark.parametrize("transposed", [False, True])
def test_sums_are_one_reduction(transposed):
    """Also as what is transposed to copies."""

    def f(a):
        if not transposed:
            return sums([a, a**2, a**3], 0)
        rows = jax.vjp(lambda *rows: spread(rows, 0, 40), a[0], a[1], a[2])[1]
        return rows([a, a**2, a**3])

    program = jax.jit(f).lower(jnp.ones((40, 5))).compile().as_text()
    assert program.count(" reduce(") == 1
    assert " reduce-window(" not in program


@pytest.mark.parametrize("count", [1, 32, 33, 66, 100])
def test_a_sum_in_parts(count):
    """Over either axis, of what is true too, its derivative, and as one program."""
    a = jnp.asarray(np.random.default_rng(count).normal(size=(count, 7)))
    np.testing.assert_allclose(total(a), a.sum(axis=0), rtol=1e-13, atol=1e-13)
    np.testing.assert_allclose(total(a.T, axis=1), a.sum(axis=0), rtol=1e-13, atol=1e-13)
    np.testing.assert_array_equal(total(a > 0), (a > 0).sum(axis=0))
    slope = jax.grad(lambda a: jnp.sum(total(a**2) ** 2))(a)
    np.testing.assert_allclose(slope, 4 * a * jnp.sum(a**2, axis=0), rtol=1e-12)
    program = jax.jit(lambda a, b: total(a * b)).lower(a, a).compile().as_text()
    assert jax.default_backend() != "cpu" or " reduce-window(" not in program


@pytest.mark.parametrize("high", [3, 4, 5])
def test_gradients_store_nothing_that_hangs_on_numbers_alone(high):
    """Loops over columns stay in one piece, and of blocks no index and no mask is kept."""
    rng = np.random.default_rng(0)
    x, w = (jnp.asarray(rng.uniform(size=s)) for s in ((2, 3, 40, 4), (2, 40, 4)))
    b = jnp.ones((len(multi_indices(3, 1, high)), 1))

    def f(x, w):
        block = lambda part: moment_solve(part[0], part[1], b, 1, high)[0]
        return jnp.sum(blockwise(block, (x, w)) ** 2)

    program = list(operations(jax.make_jaxpr(jax.grad(f, (0, 1)))(x, w).jaxpr))
    of = lambda kind: [e for e in program if e.primitive.name == kind]
    assert len(of("while")) > 5
    stored = [v.aval.dtype for e in of("scan") for v in e.outvars[e.params["num_carry"] :]]
    assert {a.kind for a in stored} == {"f"}


@pytest.mark.parametrize("dim, high", [(1, 4), (2, 5), (3, 6)])
def test_monomials_are_powers(dim, high):
    x = np.random.default_rng(0).normal(size=(dim, 7))
    indices = multi_indices(dim, 0, high)
    assert len(indices) == math.comb(dim + high, dim)
    expected = np.prod(x[None] ** indices[:, :, None], axis=1)
    np.testing.assert_allclose(monomials(jnp.asarray(x), high), expected, rtol=1e-13)


def test_monomials_on_lines_are_polynomials():
    foot, along = np.random.default_rng(0).normal(size=(2, 3, 7))
    rows = monomials_on_lines(list(jnp.asarray(foot)), list(jnp.asarray(along)), 5)
    found = [sum(c * 0.7**i for i, c in enumerate(row)) for row in rows]
    expected = monomials(jnp.asarray(foot + 0.7 * along), 5)
    np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-13)


def test_roots_near_and_far():
    """Of x + a x^2 = 1: by three steps and by more, and second derivatives; and none."""

    def found(a):
        return _root(1, [-jnp.ones_like(a), jnp.ones_like(a), a])

    exact = lambda a: (jnp.sqrt(1 + 4 * a) - 1) / (2 * a)
    for a in (jnp.full(3, 1e-4), jnp.array([1e-4, 0.3, 2.0])):
        root, lost = found(a)
        assert not lost.any()
        np.testing.assert_allclose(root, exact(a), rtol=1e-11)
    total = lambda f: lambda a: jnp.sum(f(a))
    ours, theirs = (
        jax.vmap(jax.grad(jax.grad(total(f))))(jnp.array([0.1, 0.3]))
        for f in (lambda a: found(a[None])[0], exact)
    )
    np.testing.assert_allclose(ours, theirs, rtol=1e-9)
    # A slope that turns away is not followed.
    none, lost = _root(1, [jnp.array([-1e9]), jnp.array([1.0]), jnp.array([0.0])])
    assert lost.tolist() == [True] and none.tolist() == [1]


def test_differentiation_matrices_differentiate():
    x = jnp.array([[0.3], [-0.7], [1.1]])
    a = np.random.default_rng(1).normal(size=len(multi_indices(3, 0, 4)))

    def polynomial(x):
        return (a @ monomials(x, 4))[0]

    gradient = jax.grad(polynomial)(x)[:, 0]
    matrices = differentiation(3, 4)
    np.testing.assert_allclose([(d @ a) @ monomials(x, 4)[:, 0] for d in matrices], gradient)


@pytest.mark.parametrize("low, high", [(0, 3), (1, 3), (1, 5)])
def test_moments_are_met(low, high):
    rng = np.random.default_rng(2)
    x, w = jnp.asarray(rng.uniform(-1, 1, (3, 200))), jnp.asarray(rng.uniform(0.1, 1, 200))
    b = jnp.asarray(np.concatenate([t.moments(3, low, high) for t in (Laplacian(), Hessian())], 1))
    eta, condition, residual = moment_solve(x, w, b, low, high)
    basis = monomials(x, high)[len(multi_indices(3, 0, low - 1)) :]
    np.testing.assert_allclose(basis @ eta.T, b, atol=1e-11)
    assert residual < 1e-12
    gram = (basis * w) @ basis.T
    scale = 1 / np.sqrt(np.diag(gram))
    exact = np.linalg.cond(gram * scale * scale[:, None])
    assert exact / 1000 < condition <= exact


def test_weights_are_the_smallest_that_meet_the_moments():
    rng = np.random.default_rng(3)
    x, w = jnp.asarray(rng.uniform(-1, 1, (2, 20))), jnp.asarray(rng.uniform(0.1, 1, 20))
    b = jnp.asarray(Laplacian().moments(2, 1, 3))
    eta = moment_solve(x, w, b, 1, 3)[0][0]
    basis = np.asarray(monomials(x, 3)[1:])
    root = np.sqrt(np.asarray(w))
    expected = root * np.linalg.lstsq(basis * root, np.asarray(b[:, 0]), rcond=None)[0]
    np.testing.assert_allclose(eta, expected, rtol=1e-10, atol=1e-10)


def test_targets():
    assert Partial((2, 1)).moments(2, 0, 3)[7] == 2 and Partial((2, 1)).order == 3
    rows = Gradient().moments(3, 0, 1)
    np.testing.assert_array_equal(rows, [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    weights = jnp.arange(3.0)[:, None]
    turn = jnp.array([[0.6, 0.8], [-0.8, 0.6]])
    full = Hessian().assemble(weights, turn)[:, :, 0]
    np.testing.assert_allclose(full, turn.T @ jnp.array([[0.0, 1.0], [1.0, 2.0]]) @ turn)


@pytest.mark.parametrize("which", ["x", "w"])
def test_derivative_of_weights(which):
    rng = np.random.default_rng(4)
    x, w = jnp.asarray(rng.uniform(-1, 1, (3, 120))), jnp.asarray(rng.uniform(0.1, 1, 120))
    g = jnp.asarray(rng.normal(size=(3, 120)))
    b = jnp.asarray(Gradient().moments(3, 0, 3))

    def f(value):
        arguments = (value, w) if which == "x" else (x, value)
        return jnp.sum(g * moment_solve(*arguments, b, 0, 3)[0])

    check_derivative(f, x if which == "x" else w, step=1e-4, rtol=1e-8)


def test_derivative_where_points_have_no_weight():
    rng = np.random.default_rng(5)
    x, w = jnp.asarray(rng.uniform(-1, 1, (2, 30))), jnp.asarray(rng.uniform(0.1, 1, 30))
    x, w = x.at[:, 20:].set(0), w.at[20:].set(0)
    b = jnp.asarray(Laplacian().moments(2, 1, 3))
    padded = jax.grad(lambda x: jnp.sum(jnp.sin(moment_solve(x, w, b, 1, 3)[0])))(x)
    short = jax.grad(lambda x: jnp.sum(jnp.sin(moment_solve(x, w[:20], b, 1, 3)[0])))(x[:, :20])
    np.testing.assert_allclose(padded[:, :20], short, rtol=1e-10)
    assert jnp.isfinite(padded).all()


def test_degenerate_points_are_reported():
    x = jnp.stack([jnp.linspace(-1, 1, 30), jnp.zeros(30)])  # all on a line
    b = jnp.asarray(Laplacian().moments(2, 1, 2))
    _, condition, residual = moment_solve(x, jnp.ones(30), b, 1, 2)
    assert condition > 1e12 and residual > 0.1


def test_blocks_equal_one_batch():
    x = jnp.arange(70.0).reshape(2, 35)
    for size in (1, 8, 35):
        found = blockwise(lambda block: jnp.sum(block**2, axis=0), in_blocks(x, size))
        np.testing.assert_array_equal(out_of_blocks(found, 35), (x**2).sum(0))


@pytest.mark.parametrize("high", [2, 5])  # a small system and a large one
def test_points_of_a_block_do_not_mix(high):
    rng = np.random.default_rng(8)
    x, w = jnp.asarray(rng.uniform(-1, 1, (3, 200, 3))), jnp.asarray(rng.uniform(0.1, 1, (200, 3)))
    b = jnp.asarray(Hessian().moments(3, 1, high))
    eta, condition, residual = moment_solve(x, w, b, 1, high)
    for i in range(3):
        alone = moment_solve(x[..., i], w[..., i], b, 1, high)
        np.testing.assert_allclose(eta[..., i], alone[0], rtol=1e-9, atol=1e-11)
        np.testing.assert_allclose(condition[i], alone[1], rtol=1e-9)
        assert residual[i] < 1e-11


def test_taper_is_twice_differentiable_at_the_edge():
    def slope(f):
        return jax.vmap(jax.grad(f))

    cut, edge = taper, jnp.array([1 - 1e-6, 1 + 1e-6])
    for derivative in (cut, slope(cut), slope(jax.grad(cut))):
        values = derivative(edge)
        assert abs(values[0] - values[1]) < 1e-2 and values[1] == 0
    assert gaussian(jnp.array(0.0), 0.3, 1.0) == 1


@pytest.mark.parametrize("dim", [1, 2, 3])
def test_support_scales_and_does_not_jump(dim):
    grid = np.array(list(itertools.product(range(-6, 7), repeat=dim)), float)
    r2 = np.sort(np.sum(grid**2, axis=1))
    k = {1: 9, 2: 37, 3: 100}[dim]
    on = jnp.ones(k, bool)
    radius = support(jnp.asarray(r2[:k]), on, dim=dim)
    assert radius**2 < r2[k]  # the support ends before the list does
    np.testing.assert_allclose(support(jnp.asarray(9 * r2[:k]), on, dim=dim), 3 * radius)
    # Points beyond the support have no say, whether they are listed or not.
    moved = jnp.asarray(r2[:k]).at[-1].mul(1.5)
    np.testing.assert_allclose(support(moved, on, dim=dim), radius, rtol=1e-6)


def test_a_mean_that_is_nearly_the_largest():
    """Its derivatives, second ones too and where two are the largest; and of nothing it is zero."""
    values, counted = (jnp.asarray(np.random.default_rng(1).uniform(0.1, 1, (9, 3))) for _ in "ab")
    values = values.at[:2, 0].set(2.0)
    largest = values.max(axis=0)
    mean = power_mean(values, jnp.ones_like(values))
    assert bool(jnp.all((mean < largest) & (mean > 9 ** (-1 / 32) * largest * (1 - 1e-12))))
    check_derivatives(lambda *a: power_mean(*a)[0], values, counted, rtol=1e-7)
    slope = lambda values: jax.grad(lambda values: jnp.sum(power_mean(values, counted)))(values)
    check_derivative(lambda values: jnp.vdot(slope(values), counted), values, rtol=1e-6)
    none = jnp.zeros((4, 2))
    for a, b in ((none, none + 1), (none + 1, none)):
        assert not power_mean(a, b).any()
        assert not any(d.any() for d in jax.grad(lambda *ab: power_mean(*ab).sum(), (0, 1))(a, b))
    # Second derivatives of small ones too, in single precision.
    for scale in (1.0, 0.2, 0.1, 1e-3):
        small, counts = jnp.float32(scale) * jnp.float32(values), jnp.float32(counted)
        assert power_mean(small, counts).dtype == jnp.float32
        np.testing.assert_allclose(
            power_mean(small, counts), scale * power_mean(values, counted), rtol=1e-5
        )
        slopes = jax.grad(lambda a, counts: power_mean(a, counts).sum())
        bend = jax.jvp(slopes, (small, counts), (small, 0 * counts))[1]
        assert bool(jnp.isfinite(bend).all())


def test_a_ramp():
    x = jnp.array([-jnp.inf, -1.0, 0.0, 0.3, 1.0, 2.0, jnp.inf])
    np.testing.assert_allclose(ramp(x), [0, 0, 0, 0.16308, 1, 1, 1], rtol=1e-12)
    slopes = jax.vmap(jax.grad(ramp))(x)
    np.testing.assert_allclose(slopes, [0, 0, 0, 30 * 0.21**2, 0, 0, 0], rtol=1e-12)


def test_derivative_of_support():
    r2 = jnp.asarray(np.sort(np.random.default_rng(0).uniform(0, 1, 30)))
    r2 = r2.at[0].set(0)
    check_derivative(lambda r: support(r, jnp.ones(30, bool), dim=2), r2, rtol=1e-7)


@pytest.mark.parametrize("nearest", [1e-6, 2e-4, 0.01])
def test_support_of_a_list_most_of_which_is_far(nearest):
    r2 = jnp.asarray([0, nearest, *np.linspace(0.3, 1, 14)]) ** 2
    found = support(r2, jnp.ones(16, bool), dim=3)
    target = 0.76 * 16 / 105 * 16
    counted = lambda radius: np.sum(np.maximum(1 - r2 / radius**2, 0) ** 3)
    expected = scipy.optimize.brentq(lambda radius: counted(radius) - target, 1e-8, 1, xtol=1e-15)
    np.testing.assert_allclose(found, expected, rtol=1e-9)


def test_support_reads_nothing_that_is_switched_off():
    r2 = jnp.asarray(np.random.default_rng(0).uniform(0, 1, (12, 3))).at[0].set(0)
    mask = jnp.ones((12, 3), bool).at[5:8, 1].set(False)
    expected = support(r2, mask, dim=2)
    for nothing in (jnp.nan, jnp.inf):
        found = support(jnp.where(mask, r2, nothing), mask, dim=2)
        np.testing.assert_array_equal(found, expected)


@pytest.mark.parametrize("dim, rise", [(2, 1), (2, 0.05), (3, 1), (3, 0.05), (3, None)])
def test_lines_have_the_weights_of_their_points(dim, rise):
    """Each is followed by the coordinate that changes most along it."""
    rng = np.random.default_rng(dim)
    count, lines, low, high = 5, 24, 1, 3
    along = rng.normal(size=(dim, 1, lines, 2)) * 0.2
    along[-1] = rng.normal(size=along.shape[1:]) * 0.2 if rise is None else rise
    steps = np.linspace(-0.8, 0.8, count).reshape(1, count, 1, 1)
    x = jnp.asarray(rng.uniform(-1, 1, (dim, 1, lines, 2)) + steps * along)
    w = jnp.exp(-jnp.sum(x**2, axis=0)) * (np.arange(lines) < lines - 3)[:, None]
    b = jnp.asarray(rng.normal(size=(len(multi_indices(dim, low, high)), 2)))
    assert bool(are_steep(x, w)) == (rise == 1)

    def one_by_one(x, w):
        every = x.reshape(dim, -1, 2), w.reshape(-1, 2)
        wide = jnp.broadcast_to(b[:, :, None], (*b.shape, 2))
        eta, condition, _ = moment_solve(*every, wide, low, high)
        return jnp.sum(eta.reshape(2, count, lines, 2), axis=1), condition

    def by_lines(x, w):
        return line_solve(x, w, b, low, high)[:2]

    ways = (jnp.asarray(rng.normal(size=x.shape)), w * rng.normal(size=w.shape))
    (want, condition), (d_want, _) = jax.jit(lambda: jax.jvp(one_by_one, (x, w), ways))()
    (have, other), (d_have, _) = jax.jit(lambda: jax.jvp(by_lines, (x, w), ways))()
    slack = 10 * float(jnp.max(condition)) * np.finfo(float).eps
    np.testing.assert_allclose(other, condition, rtol=1e-6)
    for a, c in ((have, want), (d_have, d_want)):
        assert float(jnp.max(jnp.abs(a - c))) < slack * float(jnp.max(jnp.abs(c)))
    assert not have[:, -3:].any()


@pytest.mark.parametrize("steep", [True, False])
def test_moments_of_lines_do_not_go_through_their_points(steep):
    """Nor where lines lie in all directions: 1,300 to 1,900 operations for a line, not 11,000."""
    rng = np.random.default_rng(0)
    x, w = jnp.asarray(rng.normal(size=(3, 7, 40, 48))), jnp.asarray(rng.uniform(size=(7, 40, 48)))
    program = jax.jit(lambda x, w: moments_of_lines(x, w, 10, steep)).lower(x, w).compile()
    assert program.cost_analysis()["flops"] < 2_500 * w[0].size


def test_what_a_fit_leaves_is_computed_once():
    """Not once for each monomial: 450 operations for each neighbour, not 850."""
    rng = np.random.default_rng(0)
    x, w, z = (jnp.asarray(rng.uniform(size=s)) for s in ((2, 30, 50), (30, 50), (1, 30, 50)))
    program = jax.jit(lambda *a: polynomial_fit(*a, 1, 4)).lower(x, w, z).compile()
    assert program.cost_analysis()["flops"] < 600 * w.size


def test_a_weight_that_is_no_number_spoils_a_fit():
    x = jnp.asarray(np.random.default_rng(0).uniform(size=(2, 30, 4)))
    w = jnp.ones((30, 4)).at[0, 0].set(jnp.nan)
    fitted = jax.jit(lambda *a: polynomial_fit(*a, 1, 2)[0])(x, w, x[:1])
    assert np.isnan(fitted[..., 0]).all() and np.isfinite(fitted[..., 1:]).all()
