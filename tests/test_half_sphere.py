"""Half a sphere: a marked border about which nothing is said is refused by whatever solves on it.

With no flux through the equator its modes are those of the sphere that are even in z.
"""

import jax.numpy as jnp
import numpy as np
import pytest

import jaxsurf as js

METHOD = js.GFDM(degree=2)


@pytest.fixture(scope="module")
def half():
    cloud = js.surface_of_revolution(
        lambda s: (jnp.cos(s), jnp.sin(s)), 600, interval=(0.0, np.pi / 2)
    )
    return cloud, js.laplace_beltrami(cloud, method=METHOD)


def asked(half, conditions):
    """Everything that solves, under conditions."""
    cloud, laplacian = half
    screened = 1 - laplacian
    f = 1.0 + cloud.points[:, 2]
    heat = js.AdvectionDiffusionReaction(laplacian, closure=conditions)
    gradient = js.surface_gradient(cloud, method=METHOD)
    turn = jnp.cross(jnp.array([0.0, 0.0, 1.0]), cloud.points)
    turning = {"gradient": gradient, "closure": conditions}
    given = js.AdvectionDiffusionReaction(None, velocity=turn, **turning)
    in_time = js.AdvectionDiffusionReaction(None, velocity=lambda t: turn, **turning)
    return {
        "solve": lambda: js.solve(screened, f, closure=conditions),
        "solve_nonlinear": lambda: js.solve_nonlinear(
            screened, lambda u, _: u**3, 0 * f, rhs=f, closure=conditions
        ),
        "eigenmodes": lambda: js.eigenmodes(laplacian, 3, closure=conditions),
        "heat": lambda: js.integrate(heat, f, t1=0.1),
        "transport": lambda: js.integrate(given, f, t1=0.1),
        "transport in time": lambda: js.integrate(in_time, f, t1=0.1),
    }


@pytest.mark.parametrize(
    "name",
    ["solve", "solve_nonlinear", "eigenmodes", "heat", "transport", "transport in time"],
)
def test_nothing_is_said_about_the_border(half, name):
    with pytest.raises(ValueError, match=r"under no condition.*js\.eliminate.*js\.free"):
        asked(half, None)[name]()


def test_no_flux(half):
    """Of the harmonics of the sphere those that are even in z are left."""
    cloud, laplacian = half
    closed = js.eliminate(cloud, js.neumann(cloud.boundary))
    values = np.asarray(js.eigenmodes(laplacian, 3, closure=closed).values)
    np.testing.assert_allclose(values, [0, 2, 2], atol=0.02)
    x = cloud.points[:, 0]
    found = js.solve(1 - laplacian, 3 * x, closure=closed).value
    assert float(jnp.abs(found - x).max()) < 0.01
    heat = js.AdvectionDiffusionReaction(laplacian, closure=closed)
    cooled = js.integrate(heat, x, t1=0.5).ys[-1]
    assert float(jnp.abs(cooled - np.exp(-1.0) * x).max()) < 0.01


def test_a_border_that_is_free(half):
    """What is said to be free is taken as it is: nothing is bound, and the solution is there."""
    cloud, laplacian = half
    free = js.eliminate(cloud, js.free(cloud.boundary))
    z = cloud.points[:, 2]
    found = js.solve(1 - laplacian, 3 * z, closure=free)
    assert float(found.stats["relative_residual"]) < 1e-7
