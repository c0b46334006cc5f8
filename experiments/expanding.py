r"""What E13, E14 and E18 share: the unit sphere that grows as r = 1 + t/2, and x y on it.

The velocity is half the normal (paper 002, eqs. 30 and 47). On that sphere $\nabla\cdot v = 1/r$,
$\Delta_S(x y) = -6\,x y / r^2$, and x y grows as $r'\,2/r = 1/r$ along the path of a point. The
points are those of Fibonacci, in numbers as the paper's, whose own are irregular.
"""

from __future__ import annotations

import jax.numpy as jnp

import jaxsurf as js

# Smoothing lengths of the paper, and its numbers of points.
SIZES = {0.4: 480, 0.2: 1_806, 0.1: 7_446, 0.05: 30_054}

GROWTH = js.Motion(lambda t, surface, fields, args: 0.5 * surface.cloud.normals)


def radius(t):
    return 1 + 0.5 * t


def product(points):
    return points[:, 0] * points[:, 1]


def heat(surface: js.Discretization) -> js.AdvectionDiffusionReaction:
    """Whose solution is exp(-6 t) x y (eq. 31)."""
    shape = product(surface.cloud.points)

    def forcing(t, u, args):
        r = radius(t)
        return (-6 + 2 / r + 6 / r**2) * jnp.exp(-6 * t) * shape

    return js.AdvectionDiffusionReaction(surface.laplacian, reaction=forcing)


def decayed(points, t: float):
    return jnp.exp(-6 * t) * product(points)
