"""Eigenvalues and compliance, whose error is of second order in that of the solution."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg

import jaxsurf as js

from .helpers import check_remainders

pytestmark = pytest.mark.slow

R, r, SCREENING = 1.0, 0.5, 1.0
METHOD = js.GFDM(degree=4)


@functools.cache
def reference(n):
    return js.discretize(js.torus(n, R, r), method=METHOD)


def torus(n, radii):
    surface = reference(n)
    x, normals = surface.cloud.points, surface.cloud.normals
    return surface.moved(radii[0] * (x - r * normals) / R + radii[1] * normals, normals)


def found(n, radii):
    """The lowest pair of eigenvalues above 0, the next one or pair, and the compliance of x."""
    surface = torus(n, radii)
    values = js.eigenvalues(surface, 5)
    work = js.compliance(surface, surface.cloud.points[:, 0], screening=SCREENING)
    return jnp.array([values[1] + values[2], values[3] + values[4], work])


def plain(n, radii):
    """The same, of the Laplacian alone."""
    surface = torus(n, radii)
    values = js.eigenmodes(surface.laplacian, 5).values
    x = surface.cloud.points[:, 0]
    u = js.solve(-surface.laplacian + SCREENING, x, rtol=1e-11).value
    return jnp.array([values[1] + values[2], values[3] + values[4], surface.inner(x, u)])


def exact(radii, count=63):
    r"""By Fourier series around the tube, for each wave number m around the axis.

    Minus the Laplacian of $U(\theta) e^{im\phi}$ is $-(wU')'/(r^2 w) + m^2 U/w^2$, with
    $w = R + r\cos\theta$.
    """
    R, r = radii
    theta = 2 * np.pi * np.arange(count) / count
    derivative = np.real(np.fft.ifft(
        1j * np.fft.fftfreq(count, 1 / count)[:, None] * np.fft.fft(np.eye(count), axis=0), axis=0
    ))  # fmt: skip
    w = R + r * np.cos(theta)

    def operator(m):
        along = -(derivative @ (w[:, None] * derivative)) / (r**2 * w[:, None])
        return along + np.diag((m / w) ** 2)

    # Of m = 0 once, of the others twice.
    each = [np.repeat(scipy.linalg.eigvals(operator(m)).real, 1 + (m > 0)) for m in range(5)]
    values = np.sort(np.concatenate(each))
    u = np.linalg.solve(operator(1) + SCREENING * np.eye(count), w)
    work = np.pi * r * np.sum(w**2 * u) * 2 * np.pi / count
    return np.array([values[1:3].sum(), values[3:5].sum(), work])


def errors(f, n):
    radii, dot, step = np.array([R, r]), np.array([0.3, 1.0]), 1e-3
    value, slope = jax.jvp(lambda a: f(n, a), (jnp.asarray(radii),), (jnp.asarray(dot),))
    sides = [exact(radii + k * step * dot) for k in (-2, -1, 1, 2)]
    wanted = (sides[0] - 8 * sides[1] + 8 * sides[2] - sides[3]) / (12 * step)
    return np.abs([value / exact(radii) - 1, slope / wanted - 1])


def test_values_and_shape_derivatives_on_the_torus():
    coarse, fine = errors(found, 500), errors(found, 2_000)
    assert (fine[0] < 4e-5).all() and (fine[1] < 2e-4).all(), fine
    assert (np.log2(coarse / fine) > 3.5).all(), (coarse, fine)
    # What the Laplacian alone gives has the order too, and many times the error.
    assert (errors(plain, 2_000)[0] > 10 * fine[0]).all()


def test_derivatives_in_the_geometry():
    """On an ellipsoid whose axes change: nothing of first order is left."""
    surface = js.discretize(js.sphere(300), method=METHOD)
    shape = js.MappedShape(lambda x, axes: axes * x, surface)
    load = jnp.exp(surface.cloud.points[:, 0])
    functionals = {
        "single values": lambda s: js.eigenvalues(s, 4) @ jnp.array([0.0, 1.0, -2.0, 0.5]),
        "free": lambda s: js.compliance(s, load),
        "screened": lambda s: js.compliance(s, load, screening=2.0),
    }
    check_remainders(functionals, shape)


def test_values_on_the_sphere():
    """As accurate as the gradient: the modes of even degree, which are better, gain nothing."""
    surface = js.discretize(js.sphere(2_000), method=js.GFDM(degree=4))
    exact = np.repeat([0, 2, 6, 12], [1, 3, 5, 7])
    np.testing.assert_allclose(js.eigenvalues(surface, 16), exact, atol=1e-3)


def test_ritz_values_of_a_group_that_k_cuts_off():
    """The whole group counts, and so nothing depends on which of its functions come first."""
    surface = js.discretize(js.sphere(400), method=METHOD)
    np.testing.assert_allclose(
        js.eigenvalues(surface, 2), js.eigenvalues(surface, 4)[:2], rtol=1e-9, atol=1e-12
    )
    assert abs(js.eigenvalues(surface, 1)[0]) < 1e-20


def test_eigenvalues_mapped_and_in_single_precision():
    angle = np.linspace(0, 2 * np.pi, 60, endpoint=False)
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=1).astype(np.float32)
    cloud = js.PointCloud(jnp.asarray(circle), jnp.asarray(circle))
    surface = js.discretize(cloud, js.find_neighbors(cloud, k=9), method=METHOD)
    values = jax.vmap(lambda a: js.eigenvalues(surface.moved(a * cloud.points, cloud.normals), 5))
    radii = jnp.array([1.0, 2.0], jnp.float32)
    found = jax.jit(values)(radii)
    assert found.dtype == jnp.float32
    wanted = np.array([0, 1, 1, 4, 4]) / np.array([[1], [4]])
    np.testing.assert_allclose(found, wanted, rtol=1e-3, atol=1e-5)


def test_methods_whose_gradient_is_too_coarse_keep_the_values_of_the_laplacian():
    """With degree 2 Ritz values of the third harmonics are five times as far off."""
    surface = js.discretize(js.sphere(400), method=js.GFDM(degree=2))
    x, values = surface.cloud.points, js.eigenvalues(surface, 9)
    np.testing.assert_array_equal(values, js.eigenmodes(surface.laplacian, 9).values)
    load = x[:, 0] * x[:, 1]
    u = js.solve(-surface.laplacian + 1.0, load, rtol=1e-10).value
    work = js.compliance(surface, load, screening=1.0)
    np.testing.assert_allclose(work, surface.inner(load, u), rtol=1e-8)


def test_compliance_of_traced_lists_says_how_it_is_compiled():
    surface = js.discretize(js.sphere(300), method=js.GFDM(degree=2))
    points, load = surface.cloud.points, surface.cloud.points[:, 2]
    with pytest.raises(ValueError, match=r"neighbours of the surface.*surface\.moved\(points\)"):
        jax.jit(js.compliance)(surface, load)
    found = jax.jit(lambda points: js.compliance(surface.moved(points), load))(points)
    assert abs(found / js.compliance(surface, load) - 1) < 1e-9


def test_compliance_where_round_off_ends_the_solve():
    """On a curve the condition grows with n², on a thin tube with its points along; both failed."""
    n = 1_000
    surface = js.discretize(js.circle(n))
    t = 2 * jnp.pi * jnp.arange(n) / n
    for screening in (0.0, 1.0):
        work = js.compliance(surface, jnp.cos(t), screening=screening)
        np.testing.assert_allclose(work, jnp.pi / (1 + screening), rtol=1e-11)
    stretched = lambda a: surface.moved(a * surface.cloud.points)
    slope = jax.grad(lambda a: js.compliance(stretched(a), jnp.cos(t)))(1.0)
    np.testing.assert_allclose(slope, 3 * jnp.pi, rtol=1e-7)
    tube = js.discretize(js.torus(4_000, 1.0, 0.02))
    work = js.compliance(tube, tube.cloud.points[:, 0])  # almost that of a circle, times its girth
    np.testing.assert_allclose(work, 0.04 * jnp.pi**2, rtol=1e-2)
