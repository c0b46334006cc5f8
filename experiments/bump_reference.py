r"""Reference for the bump of paper 001, Section 4.5: finite elements in the parameter plane.

On the graph z = u(x) the diffusion equation reads
$\int \sqrt g\,\partial_t f\,v + \int \sqrt g\,\nabla v\cdot g^{-1}\nabla f = 0$ with
$g = I + \nabla u\,\nabla u^T$; no-flux borders are natural. Everything is symmetric in y, so
half the square is enough. Quadratic elements (scikit-fem) on a grid refined around the bump and the
initial field; in time the L-stable SDIRK method of third order, with steps that grow.
"""

from __future__ import annotations

import dataclasses

import jax.numpy as jnp
import numpy as np
import scipy.sparse.linalg
import skfem
from jaxtyping import Array, Float
from scipy.interpolate import CubicSpline

CENTRE, RADIUS, SIGMA, HALF = np.array([-0.5, 0.0]), 0.25, 0.2, 2.0
PROBES = {"x0": np.array([-0.5, 0.0]), "x1": 0.25 * np.sqrt(2) * np.array([-1.0, 1.0])}

_GAMMA = 0.43586652150845967


def zeta(d2):
    """The cut-off Gaussian as a function of d²."""
    inside = d2 < 0.975**2
    return jnp.where(inside, jnp.exp(-1 / (1 - jnp.where(inside, d2, 0))), 0)


def height(alpha: float, x, y):
    """z of the surface."""
    return alpha * zeta(((x - CENTRE[0]) ** 2 + (y - CENTRE[1]) ** 2) / RADIUS**2)


def initial(points: Float[Array, "n 3"]) -> Float[Array, " n"]:
    """The initial field at points in space."""
    return zeta(jnp.sum(jnp.asarray(points) ** 2, axis=-1) / SIGMA**2) / SIGMA**2


@dataclasses.dataclass(frozen=True)
class History:
    """The field at the probes over time.

    Args:
        times: `(m,)`.
        values: by name of the probe, `(m,)` each.
        unknowns: degrees of freedom of the computation.
    """

    times: Float[np.ndarray, " m"]
    values: dict[str, Float[np.ndarray, " m"]]
    unknowns: int

    def peak(self, probe: str) -> float:
        """Largest value over time, between the times by a cubic spline."""
        spline = CubicSpline(self.times, self.values[probe])
        roots = spline.derivative().roots(extrapolate=False)
        return float(np.max(spline(np.concatenate([roots, self.times[[0, -1]]]))))

    def at(self, probe: str, times) -> Float[np.ndarray, " m"]:
        return CubicSpline(self.times, self.values[probe])(times)


def solve(alpha: float, *, spacing: float, step: float = 1.0, end: float = 1.0) -> History:
    """Finite elements with a given spacing around the bump.

    Args:
        alpha: height of the bump.
        spacing: of the grid where the field and the surface vary fast.
        step: factor of the time steps, 1 for 380 steps.
        end: last time.
    """
    xs = _graded(-HALF, HALF, -0.8, 0.3, spacing)
    ys = _graded(0.0, HALF, 0.0, 0.4, spacing)
    basis = skfem.Basis(skfem.MeshTri.init_tensor(xs, ys), skfem.ElementTriP2(), intorder=8)

    def slopes(x):
        # The height depends on d² alone: chain rule by hand, as quadrature points are many.
        dx, dy = x[0] - CENTRE[0], x[1] - CENTRE[1]
        d2 = (dx**2 + dy**2) / RADIUS**2
        inside = d2 < 0.975**2
        q = np.where(inside, 1 - np.where(inside, d2, 0), 1)
        rate = np.where(inside, -2 * alpha * np.exp(-1 / q) / (q * RADIUS) ** 2, 0)
        return rate * dx, rate * dy

    @skfem.BilinearForm
    def mass_form(u, v, w):
        p, q = slopes(w.x)
        return np.sqrt(1 + p**2 + q**2) * u * v

    @skfem.BilinearForm
    def stiffness_form(u, v, w):
        p, q = slopes(w.x)
        g = 1 + p**2 + q**2
        along = (p * u.grad[0] + q * u.grad[1]) * (p * v.grad[0] + q * v.grad[1]) / g
        return np.sqrt(g) * (u.grad[0] * v.grad[0] + u.grad[1] * v.grad[1] - along)

    mass, stiffness = mass_form.assemble(basis).tocsc(), stiffness_form.assemble(basis).tocsc()

    @skfem.LinearForm
    def load(v, w):
        p, q = slopes(w.x)
        z = np.asarray(height(alpha, w.x[0], w.x[1]))
        start = np.asarray(initial(np.stack([w.x[0], w.x[1], z], axis=-1)))
        return np.sqrt(1 + p**2 + q**2) * start * v

    u = scipy.sparse.linalg.spsolve(mass, load.assemble(basis))
    probe = basis.probes(np.stack(list(PROBES.values()), axis=1))
    times, values = [0.0], [probe @ u]
    for stop, dt in ((0.02, 2e-4), (0.2, 1e-3), (1.0, 8e-3)):
        count = round((min(stop, end) - times[-1]) / (dt * step))
        if count < 1:
            break
        dt = (min(stop, end) - times[-1]) / count
        factor = scipy.sparse.linalg.splu(mass + _GAMMA * dt * stiffness)
        for _ in range(count):
            u = _advance(factor.solve, stiffness, u, dt)
            times.append(times[-1] + dt)
            values.append(probe @ u)
    columns = np.array(values).T
    return History(np.array(times), dict(zip(PROBES, columns)), basis.N)


def _advance(solve, stiffness, u, dt):
    """One step of the SDIRK method of order 3 by Alexander (1977), L-stable."""
    g = _GAMMA
    b1 = -(6 * g**2 - 16 * g + 1) / 4
    b2 = (6 * g**2 - 20 * g + 5) / 4
    k1 = -solve(stiffness @ u)
    k2 = -solve(stiffness @ (u + dt * (1 - g) / 2 * k1))
    k3 = -solve(stiffness @ (u + dt * (b1 * k1 + b2 * k2)))
    return u + dt * (b1 * k1 + b2 * k2 + g * k3)


def _graded(low, high, fine_low, fine_high, spacing) -> Float[np.ndarray, " m"]:
    """Grid lines: evenly spaced in the middle, then growing by 8 per cent up to a tenth."""
    inner = np.linspace(fine_low, fine_high, round((fine_high - fine_low) / spacing) + 1)

    def outward(length):
        steps = [spacing]
        while sum(steps) < length:
            steps.append(min(1.08 * steps[-1], max(0.1 * spacing / 0.01, spacing)))
        place = np.cumsum(steps)
        return place * length / place[-1] if length > 0 else np.zeros(0)

    left = fine_low - outward(fine_low - low)[::-1]
    right = fine_high + outward(high - fine_high)
    return np.concatenate([left, inner, right])
