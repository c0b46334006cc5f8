r"""How well data determine unknowns: the Gaussian at the minimum (Laplace's approximation).

With the Jacobian G of the residual in white noise, its columns $G_1$ of unknowns with a prior and
$G_0$ of those without, $S = 1 + G_1 G_1^T = L L^T$ and $T = G_0^T S^{-1} G_0$, the covariance of
the noise is $T^{-1}$ for those without, $1 - G_1^T S^{-1} G_1 + B T^{-1} B^T$ with
$B = G_1^T S^{-1} G_0$ for those with, and $-B T^{-1}$ between them: nothing of size p × p.
"""

from __future__ import annotations

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jax.scipy.linalg import solve_triangular
from jaxtyping import Array, Float, PyTree

from ..arguments import traced_call, whole
from ..compiling import sized_jit
from .asked import told_apart
from .problem import Problem, each, jacobian


class Posterior(eqx.Module):
    r"""Unknowns as far as data and priors determine them: made by `Inversion.posterior`.

    A Gaussian with the mean `mean` and the inverse of the Gauss–Newton Hessian as its covariance:
    exact where the model is linear.

    Args:
        mean: the unknowns that were found.
        deviation: standard deviation of each, of the same shapes.

    Accuracy: of the model and its derivatives; the deviation of the mean of 40 readings of a decay
        is within 1e-6 of the exact one (`tests/test_inverse.py`).
    Raises:
        ValueError: unknowns without a prior that the data do not tell apart.

    Example:
        >>> times = jnp.linspace(0.1, 2, 40)
        >>> decay = lambda rate: jnp.exp(-rate * times)
        >>> data = decay(1.5) + 0.01 * jax.random.normal(jax.random.key(0), (40,))
        >>> posterior = js.solve_inverse(decay, jnp.array(1.0), data, noise=0.01).posterior()
        >>> bool(abs(posterior.mean - 1.5) < 3 * posterior.deviation)
        True
    """

    mean: PyTree[Array]
    problem: Problem
    xi: PyTree[Array]
    known: Float[Array, " p"]
    factor: Float[Array, "k p"]
    rest: Float[Array, "p z"]

    @property
    def deviation(self) -> PyTree[Array]:
        """Standard deviation of each unknown; a field on n points takes n solves of its prior."""
        return _deviation(self)

    def deviation_of(self, quantity: Callable[[PyTree], Array]) -> Array:
        """Standard deviation of a differentiable function of the unknowns, to first order.

        Args:
            quantity: of unknowns like `mean`; returns an array of few numbers.

        Raises:
            TypeError: a quantity that is no function to such an array.
        """
        found = jax.eval_shape(lambda x: traced_call(quantity, "quantity", x), self.mean)
        if not jnp.issubdtype(getattr(found, "dtype", object), jnp.floating):
            what = getattr(found, "dtype", type(found).__name__)
            raise TypeError(f"quantity returns {what}, expected an array of floating-point numbers")
        rows = jax.jacrev(quantity)(self.mean)
        shape = found.shape
        rows = jax.tree.map(lambda a: a.reshape(-1, *a.shape[len(shape) :]), rows)
        flat = _in_noise(self, rows)
        before = jnp.sum((flat * self.known) ** 2, axis=1)
        less = jnp.sum((self.factor @ flat.T) ** 2, axis=0)
        more = jnp.sum((flat @ self.rest) ** 2, axis=1)
        return jnp.sqrt(jnp.maximum(before - less + more, 0)).reshape(shape)

    def samples(self, key: Array, count: int) -> PyTree[Array]:
        """Unknowns drawn from it, `(count, ...)` of each.

        Args:
            key: of `jax.random`.
            count: how many.
        """
        return _samples(self, key, whole(count, "count", least=1))


def posterior_of(problem: Problem, xi: PyTree, mean: PyTree, scaled: bool) -> Posterior:
    """That of unknowns found, in units that data could see at the start or not."""
    flat, unravel = ravel_pytree(xi)
    known = ravel_pytree(problem.known(unravel(jnp.ones_like(flat))))[0]
    m = sum(x.size for x in jax.tree.leaves(problem.data))
    slopes = jacobian(problem, xi, mean, rows=m <= flat.size).astype(flat.dtype)
    told_apart(np.asarray(slopes)[:, np.asarray(known) == 0], "what was found", scaled=scaled)
    factor, rest = _factors(slopes, known, int(jnp.sum(known == 0)))
    return Posterior(mean, problem, xi, known, factor, rest)


@sized_jit
def _factors(slopes, known, free: int):
    r"""$L^{-1} G_1$, and the root of what those without a prior add, $(T^{-1/2}, -B T^{-1/2})$."""
    if slopes.shape[0] > slopes.shape[1]:  # fewer rows with the same products
        slopes = jnp.linalg.qr(slopes, mode="r")
    ours = slopes * known
    root = jnp.linalg.cholesky(jnp.eye(len(ours), dtype=ours.dtype) + ours @ ours.T)
    factor = solve_triangular(root, ours, lower=True)
    if not free:
        return factor, jnp.zeros((slopes.shape[1], 0), slopes.dtype)
    where = jnp.nonzero(known == 0, size=free)[0]
    theirs = solve_triangular(root, slopes[:, where], lower=True)
    _, upper = jnp.linalg.qr(theirs)
    spread = solve_triangular(upper, jnp.eye(free, dtype=upper.dtype), lower=False)
    rest = -(factor.T @ theirs) @ spread
    return factor, rest.at[where].set(spread)


@sized_jit
def _in_noise(posterior: Posterior, rows):
    """Derivatives in the noise, of those in the unknowns."""
    pull = jax.vjp(posterior.problem.theta, posterior.xi)[1]
    return jax.vmap(lambda row: ravel_pytree(pull(row))[0])(rows)


@sized_jit
def _deviation(posterior: Posterior):
    problem, xi = posterior.problem, posterior.xi
    unravel = ravel_pytree(xi)[1]
    linear = jax.linearize(problem.theta, xi)[1]
    squares = lambda rows: jax.tree.map(
        lambda x: jnp.sum(x**2, axis=0), jax.lax.map(lambda row: linear(unravel(row)), rows)
    )
    prior = each(
        lambda prior, x: jnp.zeros_like(x) if prior is None else prior.variance(x),
        problem.prior, posterior.mean,
    )  # fmt: skip
    less, more = squares(posterior.factor), squares(posterior.rest.T)
    variance = jax.tree.map(lambda a, b, c: a - b + c, prior, less, more)
    return jax.tree.map(lambda v: jnp.sqrt(jnp.maximum(v, 0)), variance)


@sized_jit
def _samples(posterior: Posterior, key, count: int):
    unravel = ravel_pytree(posterior.xi)[1]
    linear = jax.linearize(posterior.problem.theta, posterior.xi)[1]
    # The covariance of those with a prior is 1 - F^T F: its root by that of F F^T.
    factor, p = posterior.factor, posterior.known.size
    values, vectors = jnp.linalg.eigh(factor @ factor.T)
    values = jnp.clip(values, 0, 1)
    shrink = (jnp.sqrt(1 - values) - 1) / jnp.where(values > 0, values, 1)

    def one(key):
        first, second = jax.random.split(key)
        z = posterior.known * jax.random.normal(first, (p,), factor.dtype)
        z = z + factor.T @ (vectors @ (shrink * (vectors.T @ (factor @ z))))
        w = jax.random.normal(second, (posterior.rest.shape[1],), factor.dtype)
        return jax.tree.map(jnp.add, posterior.mean, linear(unravel(z + posterior.rest @ w)))

    return jax.lax.map(one, jax.random.split(key, count))
