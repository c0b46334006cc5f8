r"""Weights of a Laplacian that is symmetric and never lets heat grow, on any cloud.

With positive masses m, $m_i (L u)_i = \sum_j s_{ij} (u_j - u_i)$ with $s_{ij} = s_{ji} > 0$ is
symmetric and negative semi-definite in the inner product of the masses, keeps constants and the
mass, and obeys the maximum principle, whatever the numbers s. They are chosen for consistency:
for polynomials p of degree 1 and 2 over the tangent plane of every point

$$\sum_j s_{ij}\,(p(x_j) - p(x_i)) = m_i\,\Delta p(x_i) - \int_{\Gamma_i} \partial_\nu p,$$

the last term where the surface has a border. Of all such s those are taken which are nearest to a
kernel k, $\min \sum_{ij} k_{ij}\,\psi(s_{ij} / k_{ij})$ with
$\psi(\sigma) = \sigma^2/2 - (1-\delta)\,\sigma - \delta \log \sigma$: least squares with a
logarithmic barrier. The dual problem is smooth, convex and without conditions: five multipliers
$\mu_i$ for each point of a surface,

$$s_{ij} = k_{ij}\, f(\varphi_{ij}\cdot\mu_i + \varphi_{ji}\cdot\mu_j), \qquad f^{-1} = \psi',$$

with $\varphi_{ij}$ the monomials of point j seen from i. A small multiple of $|\mu|^2$ is added,
so that points which cannot be consistent are so in the sense of least squares.
"""

from __future__ import annotations

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from .borders.border import Border
from .cloud import PointCloud
from .compiling import sized_jit
from .fits import systems
from .fits.kernels import gaussian
from .fits.plane import Neighborhood, TangentPlane, dot
from .neighbors import Neighbors
from .stencils.gathers import take
from .stencils.method import with_center
from .stencils.stencil import Stencil

# Share of the barrier.
_BARRIER = 0.1
# Weight of |mu|^2: what is left of the conditions is that times the multipliers.
_SLACK = 1e-2
# Most steps of Newton's method and of conjugate gradients, and the least share of a step.
_NEWTON, _STEPS = 30, 1000
_LEAST = 0.5**10


class Pairs(eqx.Module):
    """What is known of each pair, seen from its first point.

    Args:
        indices: the other point.
        near, far: monomials of the other point seen from the first, and the other way round.
        kernel: the weights they start from.
        wanted: the moments of each point.
        unit: that moments are measured in.
    """

    indices: Int[Array, "k n"]
    near: Float[Array, "b k n"]
    far: Float[Array, "b k n"]
    kernel: Float[Array, "k n"]
    wanted: Float[Array, "b n"]
    unit: Float[Array, " n"]

    @classmethod
    def of(cls, cloud, neighbors, masses, flux) -> Pairs:
        """All pairs of points that are in each other's lists."""
        seen, indices = cloud.seen, neighbors.indices.T
        mask = neighbors.mask.T & _mutual(indices, neighbors.mask.T)
        columns = lambda a: jnp.stack([take(column, indices) for column in a.T], axis=1)
        points, normals = columns(seen.points), columns(seen.normals)
        offsets = points - seen.points.T
        around = Neighborhood(offsets, normals, neighbors.mask.T, neighbors.radius)
        plane = TangentPlane.of(around, 2)
        t, n = len(plane.tangents), cloud.n
        width, radius = (take(a, indices) for a in (plane.width, plane.radius))
        far = [
            -dot(offsets, jnp.stack([take(a, indices) for a in axis], axis=1)) / width
            for axis in plane.tangents
        ]
        on = mask & (masses > 0) & take(masses > 0, indices)
        on = on.at[0].set(False)
        size = jnp.sqrt(jnp.where(masses > 0, masses, 1)) / plane.width
        r2, root2 = around.squared, 2**0.5
        kernel = gaussian(r2, root2 * plane.width, plane.radius, on)
        kernel = kernel * gaussian(r2, root2 * width, radius, on)
        near = _monomials(plane.points)
        # Such that the second moments are those wanted, but for what neighbours differ.
        trace = jnp.sum(kernel * jnp.sum(near[t : 2 * t], axis=0), axis=0) / (2 * t)
        share = size / jnp.sqrt(jnp.where(trace > 0, trace, 1))
        kernel = kernel * share * take(share, indices)
        unit = size**2
        wanted = jnp.zeros((len(near), n), near.dtype).at[t : 2 * t].set(2.0) * unit
        if flux is not None:
            along = jnp.sum(plane.tangents * flux.T, axis=1)
            wanted = wanted.at[:t].add(-along / plane.width)
        wanted = jnp.where(masses > 0, wanted, 0)
        return cls(indices, near, _monomials(jnp.stack(far)), kernel, wanted, unit)

    def forces(self, mu):
        """What the multipliers say of each pair."""
        others = jnp.stack([take(m, self.indices) for m in mu])
        return jnp.sum(self.near * mu[:, None] + self.far * others, axis=0)

    def moments(self, weights):
        return jnp.sum(weights * self.near, axis=1)

    def rest(self, mu):
        """What is left of the conditions: the gradient of the dual problem."""
        s = self.kernel * _positive(self.forces(mu))[0]
        return self.moments(s) - self.wanted + _SLACK * self.unit * mu

    def solved(self, mu, rhs, rtol, linear_solve):
        """The inverse of the derivative of `rest`, applied."""
        h = self.kernel * _positive(self.forces(mu))[1]
        own = jnp.sum((h * self.near)[:, None] * self.near, axis=2)
        one = jnp.eye(len(own), dtype=h.dtype)[..., None] * jnp.ones_like(self.unit)
        invert, _ = systems.factor(jax.lax.stop_gradient(own + _SLACK * one * self.unit))
        inverse = invert(one, refined=False)
        precondition = lambda r: jnp.sum(inverse * r, axis=1)
        apply = lambda v: self.moments(h * self.forces(v)) + _SLACK * self.unit * v
        solve = lambda apply, r: _conjugate_gradients(apply, r, precondition, rtol)
        return linear_solve(apply, rhs, solve)


def _monomials(q: Float[Array, "t *p"]) -> Float[Array, "b *p"]:
    """Of degree one and two, squares first; such that rotations keep the sum of their squares."""
    t = len(q)
    mixed = [2**0.5 * q[a] * q[b] for a in range(t) for b in range(a)]
    return jnp.stack([*q, *(q * q), *mixed])


def _mutual(indices: Int[Array, "k n"], mask: Bool[Array, "k n"]) -> Bool[Array, "k n"]:
    """Whether a point is in the list of each in its own."""
    own = jnp.arange(indices.shape[1], dtype=indices.dtype)

    def look(found, slot):
        other, on = slot
        return found | ((take(other, indices) == own) & take(on, indices)), None

    return jax.lax.scan(look, jnp.zeros(indices.shape, bool), (indices, mask))[0]


def _positive(y):
    """f and its derivative; f(0) = 1."""
    z = y + 1 - _BARRIER
    root = jnp.sqrt(z * z + 4 * _BARRIER)
    # Without cancellation where z is negative.
    f = jnp.where(z > 0, (z + root) / 2, 2 * _BARRIER / (root - jnp.minimum(z, 0)))
    return f, f / root


def _conjugate_gradients(apply, b, precondition, rtol):
    z = precondition(b)
    first = jnp.sum(b * z)

    def step(state):
        x, r, p, rho, steps = state
        q = apply(p)
        alpha = rho / jnp.sum(p * q)
        r = r - alpha * q
        z = precondition(r)
        new = jnp.sum(r * z)
        return x + alpha * p, r, z + new / rho * p, new, steps + 1

    goes_on = lambda state: (state[3] > rtol**2 * first) & (state[4] < _STEPS)
    return jax.lax.while_loop(goes_on, step, (jnp.zeros_like(b), b, z, first, 0))[0]


def symmetrised(
    laplacian: Stencil, cloud: PointCloud, neighbors: Neighbors, masses, border: Border | None
) -> Stencil:
    """The symmetric operator on the slots of another Laplacian of the same lists."""
    flux = None if border is None else outflow(cloud, border)
    weights, left = positive_weights(cloud, neighbors, masses, flux)
    operator = laplacian.of_weights(_per_mass(weights, masses))
    # No border: the condition there is part of it.
    parts, none = lambda o: (o.diagnostics.residual, o.border), lambda x: x is None
    return eqx.tree_at(parts, operator, (left, None), is_leaf=none)


@sized_jit
def _per_mass(weights, masses):
    return with_center((weights / jnp.where(masses > 0, masses, 1))[None])[0]


@sized_jit
def positive_weights(cloud, neighbors, masses, flux):
    r"""The weights $s_{ij}$, `(k, n)`, and what is left of the conditions, `(n,)`.

    Args:
        masses: positive, `(n,)`; zero at points that are switched off.
        flux: conormals times the length of border at each point, `(n, d)`; None without border.
    """
    pairs = Pairs.of(cloud, neighbors, masses, flux)
    mu = _implied(pairs, _multipliers(jax.lax.stop_gradient(pairs)))
    s = pairs.kernel * _positive(pairs.forces(mu))[0]
    left = jnp.max(jnp.abs(pairs.moments(s) - pairs.wanted), axis=0) / (2 * pairs.unit)
    return s, jax.lax.stop_gradient(left)


@jax.custom_jvp
def _implied(pairs: Pairs, mu):
    """The multipliers as a function of the pairs: where nothing is left of the conditions."""
    return mu


@_implied.defjvp
def _implied_jvp(primals, tangents):
    (pairs, mu), (change, _) = primals, tangents
    rest = jax.jvp(lambda pairs: pairs.rest(mu), (pairs,), (change,))[1]
    exact = functools.partial(jax.lax.custom_linear_solve, symmetric=True)
    return mu, -pairs.solved(mu, rest, _tolerance(rest), exact)


def _tolerance(values) -> float:
    return float(np.finfo(values.dtype).eps) ** 0.6


def _multipliers(pairs: Pairs):
    """Newton's method, in steps that are halved until they no longer go far beyond the minimum."""
    direct = lambda apply, rhs, solve: solve(apply, rhs)

    def step(state):
        mu, rest, size, count = state
        move = -pairs.solved(mu, rest, jnp.minimum(0.03, size), direct)
        slope = jnp.abs(jnp.sum(move * rest))

        def halve(trial):
            new = mu + trial[0] / 2 * move
            return trial[0] / 2, new, pairs.rest(new)

        beyond = lambda trial: (jnp.sum(move * trial[2]) > slope / 2) & (trial[0] > _LEAST)
        start = (jnp.full((), 2, mu.dtype), mu, move * slope / jnp.sum(move**2))
        _, mu, rest = jax.lax.while_loop(beyond, halve, start)
        return mu, rest, jnp.max(jnp.abs(rest) / pairs.unit), count + 1

    goes_on = lambda state: (state[2] > _tolerance(pairs.near)) & (state[3] < _NEWTON)
    mu = jnp.zeros_like(pairs.wanted)
    state = (mu, pairs.rest(mu), jnp.full((), jnp.inf, mu.dtype), 0)
    return jax.lax.while_loop(goes_on, step, state)[0]


def outflow(cloud: PointCloud, border: Border) -> Float[Array, "n d"]:
    """Conormals times the length of the border that belongs to each point."""
    total = jnp.zeros_like(cloud.points)
    for side, step in enumerate((-1, 1)):
        rows, mask = border.rows[side], border.mask[side]
        own = jnp.argmax((rows == border.points[:, None]) & mask, axis=1)
        other = jnp.take_along_axis(rows, own[:, None] + step, axis=1)[:, 0]
        half = (cloud.points[other] - cloud.points[border.points]) / 2
        length = jnp.linalg.norm(half, axis=1) if cloud.dim == 3 else 0.5
        part = border.side_conormals(cloud, side) * jnp.reshape(length, (-1, 1))
        total = total.at[border.points].add(part)
    return total
