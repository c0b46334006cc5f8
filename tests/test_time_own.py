r"""Problems of one's own, whose geometry is part of the state."""

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxsurf as js

CLOUD = js.sphere(200)
SURFACE = js.discretize(CLOUD, method=js.GFDM(degree=2))
Z = CLOUD.points[:, 2]
# Rate of growth, diffusivity, end.
GROWTH, DIFFUSIVITY, END = 0.5, 0.3, 0.2


class Grown(js.AbstractEvolution):
    r"""Heat that is carried and diluted by a surface that grows, $\dot x = a x$."""

    conditions: None
    surface: js.Discretization
    laplacian: js.AbstractOperator | None
    growth: jax.Array

    def at(self, t, state):
        moved = self.surface.moved(state[0]).laplacian
        return eqx.tree_at(lambda p: p.laplacian, self, moved, is_leaf=lambda x: x is None)

    def linear(self, t, state):
        points, u = state
        return jnp.zeros_like(points), DIFFUSIVITY * self.laplacian(u)

    def rest(self, t, state, args):
        points, u = state
        return self.growth * points, -2 * self.growth * u

    def factors(self, g, state):
        return None, g[None] * DIFFUSIVITY

    def suggested_solver(self):
        return js.IMEX(order=2), "IMEX(order=2): by its author"


def grown(growth=GROWTH):
    return Grown(None, SURFACE, None, jnp.asarray(growth))


def end(growth, solver, steps=4):
    kinds = dict(t1=END, dt0=END / steps, solver=solver)
    points, u = js.integrate(grown(growth), (CLOUD.points, Z), **kinds).ys
    return points[-1], u[-1]


def exact(eigenvalue, t=END, a=GROWTH):
    """The factor of a field with this eigenvalue on the unit sphere."""
    return np.exp(-2 * a * t + DIFFUSIVITY * eigenvalue * (1 - np.exp(-2 * a * t)) / (2 * a))


@pytest.mark.parametrize(
    "solver",
    [js.IMEX(order=2), js.RKC2(), js.SDIRK(order=3), dfx.Heun()],
    ids=lambda solver: type(solver).__name__,
)
def test_heat_on_a_growing_sphere(solver):
    """To what steps of second order leave; the Laplacian is homogeneous in lengths, of degree -2."""
    points, u = end(GROWTH, solver)
    assert float(jnp.abs(points - np.exp(GROWTH * END) * CLOUD.points).max()) < 1e-3
    factor = float(jnp.vdot(Z, u) / jnp.vdot(Z, Z))
    eigenvalue = float(jnp.vdot(Z, SURFACE.laplacian(Z)) / jnp.vdot(Z, Z))
    assert abs(eigenvalue + 2) < 0.1
    assert abs(factor / exact(eigenvalue) - 1) < 2e-3
    assert abs(factor / exact(-2) - 1) < 1e-2
