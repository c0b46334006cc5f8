r"""RBF-FD: polyharmonic splines with polynomials (Flyer et al., J. Comput. Phys. 321, 2016)."""

from __future__ import annotations

import functools
import itertools

import equinox as eqx
import jax
import jax.numpy as jnp

from ..arguments import whole
from ..frames import tangent_frames
from .method import AbstractMethod, Diagnostics, Neighborhood, check_positive, with_center
from .monomials import monomials, polynomial_count
from .plane import needed_polynomials
from .targets import AbstractTarget


class RBFFD(AbstractMethod):
    r"""Tangent-plane RBF-FD with polyharmonic splines and polynomials of a given degree.

    Fields are interpolated by $\sum_j a_j |x - x_j|^m$ plus a polynomial of degree p, and the
    interpolant is differentiated: with $\Phi_{ij} = |x_i - x_j|^m$ and the monomials P the weights
    w of an operator L solve $\Phi w + P \lambda = L\phi$, $P^T w = L P$. Polynomials give the
    order, splines stability where points are uneven. These have no length, and so no width and no
    cut-off: weights are smooth for fixed neighbours, and jump where a list of them changes.

    Args:
        degree: polynomial degree p; gradients then converge like $h^p$ and the Laplacian like
            $h^{p-1}$, or $h^p$ for even p on even points.
        exponent: power m of the distance, odd, from 3 to 2 p + 1.

    Raises:
        ValueError: a degree below 1, an exponent that is even or out of range.

    Example:
        >>> cloud = js.sphere(300)
        >>> z = cloud.points[:, 2]
        >>> operator = js.laplace_beltrami(cloud, method=js.RBFFD(degree=4))
        >>> bool(jnp.abs(operator(z) + 2 * z).max() < 0.02)
        True
    """

    degree: int = eqx.field(static=True, default=2)
    exponent: int = eqx.field(static=True, default=3, kw_only=True)

    def __check_init__(self):
        check_positive(self, degree=True)
        whole(self.exponent, "RBFFD: exponent", least=3, most=2 * self.degree + 1)
        if self.exponent % 2 == 0:
            raise ValueError(f"RBFFD: exponent = {self.exponent}, expected an odd number")

    def neighbor_count(self, dim):
        return 2 * polynomial_count(dim - 1, self.degree) + 1

    def basis_size(self, dim, target):
        return needed_polynomials(self.degree, dim, target)

    batch_size = property(lambda self: 64)
    polynomial_degree = property(lambda self: max(self.degree, 2))
    shares_moments = property(lambda self: True)
    least_dominance = property(lambda self: 0.0)  # as stable as with more, `experiments.stability`

    def weights(self, neighborhood: Neighborhood, target: AbstractTarget):
        # LAPACK wants matrices last: the points of the block come first.
        offsets = jnp.moveaxis(neighborhood.offsets, (0, 1), (-2, -1))
        tangents = tangent_frames(neighborhood.normals[0].T)[..., :-1, :]
        k, on = len(neighborhood.mask), jnp.moveaxis(neighborhood.mask, 0, -1)
        # The farthest. The weights do not depend on the unit: it may be taken as constant.
        unit = jnp.max(jnp.where(neighborhood.mask, neighborhood.squared, 0), axis=0)
        unit = jax.lax.stop_gradient(jnp.sqrt(jnp.where(unit > 0, unit, 1)))
        x = jnp.einsum("...kd,...td->t...k", offsets, tangents) / unit[..., None]
        a, b = _matrix(x, on, self), _right_hand_side(x, on, self, target)
        solution, condition = _solve(a, b, k)
        error = jnp.max(jnp.abs(a @ solution - b)[..., k:, :], axis=(-2, -1))
        residual = error / jnp.max(jnp.abs(b[..., k:, :]), axis=(-2, -1))
        eta = jnp.moveaxis(solution[..., :k, :], (-1, -2), (0, 1))
        eta = with_center(target.in_units(eta, unit, len(x)))
        reach = unit * (1 + 4 * jnp.finfo(unit.dtype).eps)  # of a support that holds the farthest
        diagnostics = Diagnostics.of(neighborhood, condition, residual, reach, 0)
        return target.assemble(eta, jnp.moveaxis(tangents, (-2, -1), (0, 1))), diagnostics


def _matrix(x, on, method):
    """Of coordinates `(t, *p, k)`; slots that are off have rows of the identity."""
    phi = _power(sum((c[..., None] - c[..., None, :]) ** 2 for c in x), method.exponent)
    identity = jnp.eye(x.shape[-1], dtype=x.dtype) * ~on[..., None]
    phi = jnp.where(on[..., None] & on[..., None, :], phi, identity)
    p = jnp.where(on, monomials(x, method.degree), 0)
    zero = jnp.zeros((*on.shape[:-1], len(p), len(p)), x.dtype)
    return jnp.block([[phi, jnp.moveaxis(p, 0, -1)], [jnp.moveaxis(p, 0, -2), zero]])


def _right_hand_side(x, on, method, target):
    """Targets of all |x - x_j|^m, by their Taylor coefficients at 0, and of all monomials."""
    m, square = method.exponent, jnp.sum(x**2, axis=0)
    value, first, second = (_power(square, m - less) for less in (0, 2, 4))
    taylor = [value, *(-m * first * c for c in x)]
    for a, b in itertools.combinations_with_replacement(x, 2):
        mixed = m * (m - 2) * second * a * b
        taylor.append((mixed + m * first) / 2 if a is b else mixed)
    splines, wanted = (target.moments(len(x), 0, d).astype(x.dtype) for d in (2, method.degree))
    splines = jnp.where(on[..., None], jnp.tensordot(jnp.stack(taylor), splines, (0, 0)), 0)
    wanted = jnp.broadcast_to(wanted, (*on.shape[:-1], *wanted.shape))
    return jnp.concatenate([splines, wanted], axis=-2)


def _power(r2, exponent):
    """A power of the distance: 0, with derivative 0, at 0."""
    return jnp.where(r2 > 0, jnp.sqrt(jnp.where(r2 > 0, r2, 1)) ** exponent, 0)


@functools.partial(jax.custom_jvp, nondiff_argnums=(2,))
def _solve(a, b, k):
    """Solution s, with the derivative $A^{-1}(db - dA s)$, and a condition estimate."""
    solve, condition = _factor(a, k)
    return solve(b), condition


@_solve.defjvp
def _solve_jvp(k, primals, tangents):
    solve, condition = _factor(primals[0], k)
    solution = solve(primals[1])
    moved = solve(tangents[1] - tangents[0] @ solution)
    return (solution, condition), (moved, jnp.zeros_like(condition))


def _factor(a, k):
    """As `systems.factor`: a shift of the size of round-off, which a refinement takes away."""
    shift = jnp.where(jnp.arange(a.shape[-1]) < k, 0, 4 * a.shape[-1] * jnp.finfo(a.dtype).eps)
    factors = jax.scipy.linalg.lu_factor(a - jnp.diag(shift))

    def solve(b):
        first = jax.scipy.linalg.lu_solve(factors, b)
        return first + jax.scipy.linalg.lu_solve(factors, b - a @ first)

    pivot = jnp.abs(jnp.diagonal(factors[0], axis1=-2, axis2=-1))
    return solve, jnp.max(pivot, axis=-1) / jnp.min(pivot, axis=-1)
