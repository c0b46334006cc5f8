r"""Gradients that are smooth along a surface, as a transformation for optax."""

from __future__ import annotations

from typing import NamedTuple

import jax
import numpy as np
import optax
from jaxtyping import Array, Float

from ..arguments import instance, real, switched_off
from ..boundary import Closure
from ..compiling import host_jit
from ..conditions import Where, dirichlet, free
from ..discretization import Discretization
from ..failures import needs_values
from ..indices import indices_of
from ..onesided import eliminate
from ..solve.precondition import AbstractPreconditioner, multigrid
from ..solve.steady import solve
from ..stencils.algebra import AbstractOperator


class SobolevState(NamedTuple):
    r"""What a smoothed gradient is solved for with: arguments of a program, not constants in it."""

    operator: AbstractOperator
    inverse: AbstractPreconditioner
    mass: Float[Array, " n"]
    closure: Closure | None


def sobolev_gradient(
    surface: Discretization, length: float, *, held: Where | None = None
) -> optax.GradientTransformation:
    r"""Replaces derivatives at points by the gradient in a Sobolev space, for `optax.chain`.

    A derivative of a functional in the values of a field, g, becomes the field s with
    $\int_S s v + \ell^2\, \nabla s \cdot \nabla v\,dS = \sum_i g_i v_i$ for all v: the solution of
    $(1 - \ell^2 \Delta_S)\, s = g / m$ with the masses m of the points. For `NormalShape` that is
    a displacement which is smooth over the length $\ell$; steps along it keep a surface smooth,
    and since g/m is the derivative per area, their size does not depend on the number of points.

        optimizer=optax.chain(js.sobolev_gradient(surface, 0.3), optax.sgd(0.1))

    Args:
        surface: whose points the parameters belong to, as they are when it is called.
        length: $\ell$, in units of the points.
        held: points where s and v are zero, as of a border that is not to move: a mask `(n,)` or
            indices. At all others of a border s is free, $\partial_\nu s = 0$. (What is cut off
            afterwards, as by a `project`, leaves a kink, and such steps may go uphill.)

    Returns:
        The transformation; every array of parameters has one row for each point, `(n,)` or
        `(n, c)`. L-BFGS asks for plain gradients; this is for first-order methods.

    Accuracy: second order, that of `surface.symmetric_laplacian`; with it s always points
        downhill. In float32 within 1e-3 (`tests/test_sobolev.py`).
    Raises:
        TypeError: no discretisation, a length that is no number.
        ValueError: a length that is not positive; parameters of another shape; a traced surface;
            points held that there are not, or all of them.

    Example:
        >>> surface = js.discretize(js.sphere(300), method=js.GFDM(degree=2))
        >>> smooth = js.sobolev_gradient(surface, length=1.0)
        >>> z, mass = surface.cloud.points[:, 2], surface.cell_areas
        >>> s, _ = smooth.update(mass * z, smooth.init(z))  # -Laplacian of z is 2 z
        >>> bool(jnp.allclose(s, z / 3, atol=1e-2))
        True
    """
    instance(surface, Discretization, "surface", "js.discretize(cloud)")
    real(length, "length", above=0)
    needs_values("surface and length", surface, length)
    operator = 1 - float(length) ** 2 * surface.symmetric_laplacian
    closure = _closure(surface, held)
    inverse = multigrid(operator, closure=closure, mean_zero=False)
    mass = switched_off(surface.cloud.active, surface.cell_areas, 1)
    n = surface.n

    def checked(tree):
        for path, leaf in jax.tree_util.tree_leaves_with_path(tree):
            if np.shape(leaf)[:1] != (n,):
                name = jax.tree_util.keystr(path)
                raise ValueError(
                    f"parameters{name} have shape {np.shape(leaf)}, the surface has {n} points"
                )
        return tree

    def init(params):
        checked(params)
        return SobolevState(operator, inverse, mass, closure)

    def update(updates, state, params=None):
        return jax.tree.map(lambda g: _smoothed(state, g), checked(updates)), state

    return optax.GradientTransformation(init, update)


def _closure(surface: Discretization, held: Where | None) -> Closure | None:
    """Zero at these points, and no condition at others of a border; None where there are none."""
    rows = indices_of(() if held is None else held, surface.n, "held")
    if not rows.size:
        return None
    conditions = [dirichlet(rows.tolist())]
    if surface.border is not None:
        others = np.setdiff1d(surface.border.points, rows)
        conditions += [free(others.tolist())] if others.size else []
    return eliminate(surface.cloud, conditions)


@host_jit
def _per_mass(g, mass):
    return (g.T / mass).T


def _smoothed(state: SobolevState, g: Float[Array, "n *c"]) -> Float[Array, "n *c"]:
    on = state.operator.active
    per_area = switched_off(on, _per_mass(g, state.mass))
    operator, inverse, _, closure = state
    found = solve(operator, per_area, closure=closure, preconditioner=inverse, mean_zero=False)
    return found.value
