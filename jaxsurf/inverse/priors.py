r"""What is known of unknowns before any data: Gaussian priors, as maps of white noise.

Inverse problems are solved in these coordinates: $\theta = \bar\theta + A \xi$ with
$\xi \sim N(0, 1)$, so that the penalty of the prior is $|\xi|^2 / 2$ and its covariance $A A^T$.
"""

from __future__ import annotations

import abc
import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..arguments import as_float, finite, instance, real, shaped, switched_off
from ..compiling import sized_jit
from ..discretization import Discretization
from ..failures import check, needs_values, not_positive
from ..machine import SOLVED
from ..solve.precondition import AbstractPreconditioner, multigrid
from ..solve.steady import solve
from ..stencils.algebra import AbstractOperator


class AbstractPrior(eqx.Module):
    r"""A Gaussian distribution of one array of unknowns, $\theta = \bar\theta + A \xi$.

    Own ones have these three methods, all of them linear in what they take but for the mean.

    Example:
        >>> isinstance(js.GaussianPrior(0.5), js.AbstractPrior)
        True
    """

    @abc.abstractmethod
    def color(self, xi: Float[Array, "*m"]) -> Float[Array, "*m"]:
        r"""Unknowns of white noise, $\bar\theta + A \xi$."""

    @abc.abstractmethod
    def whiten(self, theta: Float[Array, "*m"]) -> Float[Array, "*m"]:
        r"""The noise that they are made of, $A^{-1} (\theta - \bar\theta)$."""

    @abc.abstractmethod
    def variance(self, theta: Float[Array, "*m"]) -> Float[Array, "*m"]:
        r"""The diagonal of $A A^T$, for unknowns of this shape."""


class GaussianPrior(AbstractPrior):
    r"""Unknowns that are independent of each other: $\theta \sim N(\bar\theta, \sigma^2)$.

    Args:
        deviation: $\sigma > 0$, a number or one for each unknown.
        mean: $\bar\theta$, likewise.

    Accuracy: exact up to rounding, in float32 too.
    Differentiable: in both arrays.
    Raises:
        TypeError: no numbers.
        ValueError: a deviation that is not positive; what is not finite.

    Example:
        >>> prior = js.GaussianPrior(deviation=0.5, mean=2.0)
        >>> float(prior.color(jnp.array(1.0))), float(prior.whiten(jnp.array(2.5)))
        (2.5, 1.0)
    """

    deviation: Float[Array, "*m"] = eqx.field(converter=lambda x: as_float(x, "deviation"))
    mean: Float[Array, "*m"] = eqx.field(default=0.0, converter=lambda x: as_float(x, "mean"))

    def __check_init__(self):
        text = "deviation {v:g} of unknown {i}, expected a positive number{more}"
        check(self.deviation, not_positive, text)
        check(self.mean, lambda x: ~np.isfinite(x), "mean {v:g} of unknown {i} is not finite{more}")

        try:
            jnp.broadcast_shapes(self.deviation.shape, self.mean.shape)
        except ValueError:
            raise ValueError(
                f"mean has shape {self.mean.shape}, the deviation {self.deviation.shape}"
            ) from None

    def color(self, xi):
        xi = self._fitting(xi, "xi")
        return (self.mean + self.deviation * xi).astype(jnp.result_type(xi))

    def whiten(self, theta):
        theta = self._fitting(theta, "theta")
        return ((theta - self.mean) / self.deviation).astype(jnp.result_type(theta))

    def _fitting(self, x, name: str):
        x = as_float(x, name)
        own = jnp.broadcast_shapes(self.deviation.shape, self.mean.shape)
        return shaped(x, name, own) if own else x

    def variance(self, theta):
        deviation = jnp.broadcast_to(self.deviation, jnp.shape(theta))
        return deviation.astype(jnp.result_type(theta)) ** 2


class MaternPrior(AbstractPrior):
    r"""A random field on a surface whose values at near points are alike (Matérn's covariance).

    The field is the solution of $\tau (\kappa^2 - \Delta_S)(\theta - \bar\theta) = W$ with white
    noise W (Lindgren, Rue and Lindström 2011, Section 2, with $\alpha = 2$), of the symmetric
    Laplacian and masses of the surface: $A = (\kappa^2 - \Delta_S)^{-1} m^{-1/2} / \tau$.
    On a surface the smoothness is $\nu = 1$: values are mean-square differentiable just not; on
    a curve it is 3/2. Components of a field `(n, c)` are independent of each other.

    Args:
        surface: where the field lives.
        deviation: of its values, $\sigma$. $\tau$ is that of the plane (or line), to which a
            closed surface is near if it is some lengths long; `variance` has what it is.
        length: at this distance, in units of the points, the correlation has fallen to about 0.14:
            $\sqrt{8 \nu} / \kappa$.
        mean: $\bar\theta$, a number or field.

    Accuracy: second order: deviations of fields of length 1 on the unit sphere are 5 % above those
        of the series at n = 1,000, where the spacing is a ninth of that, and 3 % at n = 2,000
        (`tests/test_inverse.py::test_fields_have_the_variance_of_their_series`). In float32 solves
        are to 1e-4.
    Differentiable: `color` and `whiten`, in the noise and field; forward and reverse.
    Raises:
        TypeError: no surface; no numbers.
        ValueError: a deviation or length that is not positive; a mean of the wrong shape; a traced
            surface.

    Example:
        >>> surface = js.discretize(js.sphere(500), method=js.GFDM(degree=2))
        >>> prior = js.MaternPrior(surface, deviation=0.5, length=1.0)
        >>> field = prior.color(jax.random.normal(jax.random.key(0), (500,)))
        >>> field.shape, bool(jnp.std(field) < 1.5)
        ((500,), True)
    """

    operator: AbstractOperator
    preconditioner: AbstractPreconditioner
    mass: Float[Array, " n"]
    tau: Float[Array, ""]
    mean: Float[Array, "*n"]

    def __init__(
        self,
        surface: Discretization,
        deviation: float,
        length: float,
        mean: Float[Array, "*n"] | float = 0.0,
    ):
        instance(surface, Discretization, "surface", "js.discretize(cloud)")
        deviation = real(deviation, "deviation", above=0)
        length = real(length, "length", above=0)
        needs_values("surface, deviation and length", surface, deviation, length)
        dimension = surface.cloud.dim - 1
        nu = 2 - dimension / 2
        kappa = math.sqrt(8 * nu) / float(length)
        volume = (4 * math.pi) ** (dimension / 2) * math.gamma(2) / math.gamma(nu)
        tau = 1 / (math.sqrt(volume) * kappa**nu * float(deviation))
        laplacian = surface.symmetric_laplacian
        self.mass = surface.cell_areas
        self.operator = kappa**2 - laplacian
        self.preconditioner = multigrid(self.operator, mean_zero=False)
        self.tau = jnp.asarray(tau, self.mass.dtype)
        on = surface.cloud.active
        known = shaped(finite(as_float(mean, "mean"), "mean", on), "mean", (), (surface.n,))
        self.mean = switched_off(on, known).astype(self.mass.dtype)

    def color(self, xi):
        xi = as_float(xi, "xi", (*self.mass.shape, ...))
        on = self.operator.active
        root = jnp.sqrt(switched_off(on, self.mass, 1))
        noise = switched_off(on, (xi.T / root).T) / self.tau
        return (self.mean + self._solved(noise).T).T

    def whiten(self, theta):
        theta = as_float(theta, "theta", (*self.mass.shape, ...))
        off = self.operator((theta.T - self.mean).T)
        return self.tau * (jnp.sqrt(self.mass) * off.T).T

    def variance(self, theta):
        known = _variance(self, self.mass.shape[0])
        return jnp.broadcast_to(known, jnp.shape(theta)[::-1]).T

    def _solved(self, noise):
        inverse = self.preconditioner
        return solve(self.operator, noise, preconditioner=inverse, mean_zero=False).value


@sized_jit
def _variance(prior: MaternPrior, n: int):
    r"""Row by row of $A$, the inverse being symmetric in the inner product of the masses."""
    mass = switched_off(prior.operator.active, prior.mass, 1)

    def of_block(rows):
        unit = jnp.zeros((n, SOLVED), mass.dtype).at[rows, jnp.arange(SOLVED)].set(1 / mass[rows])
        columns = prior._solved(unit)
        return jnp.sum(prior.mass[:, None] * columns**2, axis=0) / prior.tau**2

    rows = jnp.arange(-(-n // SOLVED) * SOLVED).reshape(-1, SOLVED)
    found = jax.lax.map(of_block, jnp.minimum(rows, n - 1)).reshape(-1)[:n]
    return switched_off(prior.operator.active, found)
