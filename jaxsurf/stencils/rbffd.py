r"""RBF-FD: polyharmonic splines with polynomials (Flyer et al., J. Comput. Phys. 321, 2016)."""

from __future__ import annotations

import itertools

import equinox as eqx
import jax
import jax.numpy as jnp

from ..arguments import whole
from ..fits.monomials import monomials, polynomial_count
from ..frames import tangent_frames
from .method import AbstractMethod, Diagnostics, Neighborhood, needed_polynomials, with_center
from .targets import AbstractTarget


class RBFFD(AbstractMethod):
    r"""Tangent-plane RBF-FD with polyharmonic splines and polynomials of a given degree.

    With $\Phi_{ij} = |x_i - x_j|^m$ and the monomials P, the weights w of an operator L solve
    $\Phi w + P \lambda = L\phi$, $P^T w = L P$. Splines, which need no width and no support, make
    uneven points stable; weights are smooth for fixed neighbours, and jump where these change.

    Args:
        degree: polynomial degree p; gradients then converge like $h^p$ and the Laplacian like
            $h^{p-1}$, or $h^p$ for even p on even points.
        exponent: power m of the distance, odd, from 3 to 2 p + 1; by default the least odd one
            above p, at most 7: higher ones may be unstable on random points.

    Raises:
        ValueError: a degree below 1, an exponent that is even or out of range.

    Example:
        >>> cloud = js.sphere(500)
        >>> operator = js.laplace_beltrami(cloud, method=js.RBFFD(degree=4))
        >>> bool(jnp.abs(operator(cloud.points) + 2 * cloud.points).max() < 0.02)
        True
    """

    degree: int = eqx.field(static=True, default=2)
    exponent: int | None = eqx.field(static=True, default=None, kw_only=True)

    def __check_init__(self):
        most = 2 * whole(self.degree, "RBFFD: degree", least=1) + 1
        if self.exponent is not None:
            if whole(self.exponent, "RBFFD: exponent", least=3, most=most) % 2 == 0:
                raise ValueError(f"RBFFD: exponent = {self.exponent}, expected an odd number")

    def neighbor_count(self, dim):
        return 2 * polynomial_count(dim - 1, self.degree) + 1

    def basis_size(self, dim, target):
        return needed_polynomials(self.degree, dim, target)

    power = property(lambda self: self.exponent or min(self.degree + 1 + self.degree % 2, 7))
    batch_size = 64
    polynomial_degree = property(lambda self: max(self.degree, 2))
    shares_moments = True
    least_dominance = 0.0  # as stable as with more, `experiments.stability`

    def weights(self, neighborhood: Neighborhood, target: AbstractTarget):
        tangents = tangent_frames(neighborhood.normals[0].T)[..., :-1, :]  # points first: LAPACK
        k, on = len(neighborhood.mask), jnp.moveaxis(neighborhood.mask, 0, -1)
        # The farthest. The weights do not depend on the unit: it may be taken as constant.
        unit = jnp.max(jnp.where(neighborhood.mask, neighborhood.squared, 0), axis=0)
        unit = jax.lax.stop_gradient(jnp.sqrt(jnp.where(unit > 0, unit, 1)))
        x = jnp.einsum("kd...,...td->t...k", neighborhood.offsets, tangents) / unit[..., None]
        a, b = _matrix(x, on, self), _right_hand_side(x, on, self, target)
        solution, condition = _solve(a, b, k)
        error, size = (jnp.max(jnp.abs(v[..., k:, :]), (-2, -1)) for v in (a @ solution - b, b))
        eta = jnp.moveaxis(solution[..., :k, :], (-1, -2), (0, 1))
        eta = with_center(target.in_units(eta, unit, len(x)))
        diagnostics = Diagnostics.of(neighborhood, condition, error / size, unit, 0)
        return target.assemble(eta, jnp.moveaxis(tangents, (-2, -1), (0, 1))), diagnostics


def _matrix(x, on, method):
    """Of coordinates `(t, *p, k)`; slots that are off have rows of the identity."""
    phi = _power(sum((c[..., None] - c[..., None, :]) ** 2 for c in x), method.power)
    phi = jnp.where(on[..., None] & on[..., None, :], phi, jnp.eye(x.shape[-1], dtype=x.dtype))
    p = jnp.where(on, monomials(x, method.degree), 0)
    zero = jnp.zeros((*on.shape[:-1], len(p), len(p)), x.dtype)
    return jnp.block([[phi, jnp.moveaxis(p, 0, -1)], [jnp.moveaxis(p, 0, -2), zero]])


def _right_hand_side(x, on, method, target):
    """Targets of all |x - x_j|^m, by their Taylor coefficients at 0, and of all monomials."""
    m, square = method.power, jnp.sum(x**2, axis=0)
    value, first, second = (_power(square, m - less) for less in (0, 2, 4))
    taylor = [value, *(-m * first * c for c in x)]
    for a, b in itertools.combinations_with_replacement(x, 2):
        taylor.append(m * ((m - 2) * second * a * b + (a is b) * first) / (1 + (a is b)))
    splines, wanted = (target.moments(len(x), 0, d).astype(x.dtype) for d in (2, method.degree))
    splines = jnp.where(on[..., None], jnp.tensordot(jnp.stack(taylor), splines, (0, 0)), 0)
    wanted = jnp.broadcast_to(wanted, (*on.shape[:-1], *wanted.shape))
    return jnp.concatenate([splines, wanted], axis=-2)


def _power(r2, exponent):
    """A power of the distance, constant below round-off (a guard r2 > 0 has failed: fused into
    several loops, r2 is 0 in one and, with fused multiply-adds, not in another)."""
    least = jnp.finfo(r2.dtype).eps ** 2
    return jnp.sqrt(jnp.where(r2 > least, r2, least)) ** exponent


def _solve(a, b, k):
    """Solution, differentiated by solves with the same factors, and a condition estimate."""
    fixed = jax.lax.stop_gradient(a)
    # Shift and refinement as in `systems.factor`: dependent polynomials show in the residual.
    shift = jnp.where(jnp.arange(a.shape[-1]) < k, 0, 4 * a.shape[-1] * jnp.finfo(a.dtype).eps)
    factors = jax.scipy.linalg.lu_factor(fixed - jnp.diag(shift))

    def solve(_, b):
        first = jax.scipy.linalg.lu_solve(factors, b)
        return first + jax.scipy.linalg.lu_solve(factors, b - fixed @ first)

    solution = jax.lax.custom_linear_solve(lambda s: a @ s, b, solve, symmetric=True)
    pivot = jnp.abs(jnp.diagonal(factors[0], axis1=-2, axis2=-1))
    return solution, jnp.max(pivot, axis=-1) / jnp.min(pivot, axis=-1)
