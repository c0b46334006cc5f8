r"""The differential operators that stencils approximate, as right-hand sides of moment systems."""

from __future__ import annotations

import abc
import math

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..fits.monomials import derivative_at_origin, multi_indices


def _unit(dim: int, *axes: int) -> tuple[int, ...]:
    return tuple(axes.count(a) for a in range(dim))


class AbstractTarget(eqx.Module):
    r"""One or several derivatives $D^\alpha$ of the same order $|\alpha|$."""

    @property
    @abc.abstractmethod
    def order(self) -> int:
        r"""$|\alpha|$."""

    @abc.abstractmethod
    def columns(self, dim: int, high: int) -> list[np.ndarray]:
        """Values of each derivative at 0 on all monomials of degree 0 to `high`."""

    def in_units(self, weights: Float[Array, "c k *p"], length: Float[Array, "*p"], dim: int):
        """Weights on d coordinates, from those on coordinates divided by a length."""
        return weights / length**self.order

    def assemble(
        self, weights: Float[Array, "c k *p"], axes: Float[Array, "t d *p"]
    ) -> Float[Array, "... k *p"]:
        """Components in space from derivatives along the rows of `axes`."""
        return self.components(weights)

    def components(self, weights: Float[Array, "c k *p"]) -> Float[Array, "... k *p"]:
        """Components from derivatives along the axes of space."""
        return weights[0]

    def moments(self, dim: int, low: int, high: int) -> np.ndarray:
        """Right-hand sides `(m, c)` for the basis of degree `low` to `high`."""
        start = len(multi_indices(dim, 0, low - 1))
        return np.stack(self.columns(dim, high), axis=1)[start:]


class Laplacian(AbstractTarget):
    r"""$\Delta$; one component."""

    order = 2

    def columns(self, dim, high):
        return [sum(derivative_at_origin(dim, high, _unit(dim, a, a)) for a in range(dim))]


class Gradient(AbstractTarget):
    r"""$\nabla$; d components."""

    order = 1

    def columns(self, dim, high):
        return [derivative_at_origin(dim, high, _unit(dim, a)) for a in range(dim)]

    def assemble(self, weights, axes):
        return jnp.sum(axes[:, :, None] * weights[:, None], axis=0)

    def components(self, weights):
        return weights


class Hessian(AbstractTarget):
    r"""All second derivatives; a symmetric `(d, d)` matrix."""

    order = 2

    def columns(self, dim, high):
        rows, cols = np.triu_indices(dim)
        pairs = zip(rows.tolist(), cols.tolist())
        return [derivative_at_origin(dim, high, _unit(dim, a, b)) for a, b in pairs]

    def assemble(self, weights, axes):
        matrix = self.components(weights)
        half = jnp.sum(axes[:, :, None, None] * matrix[:, None], axis=0)
        return jnp.sum(axes[:, None, :, None] * half.swapaxes(0, 1)[:, :, None], axis=0)

    def components(self, weights):
        dim = math.isqrt(2 * len(weights))
        rows, cols = np.triu_indices(dim)
        matrix = jnp.zeros((dim, dim, *weights.shape[1:]), weights.dtype)
        return matrix.at[rows, cols].set(weights).at[cols, rows].set(weights)


class Joint(AbstractTarget):
    """Several operators at once, in the tangent plane.

    For methods whose moments are the same for all orders of derivatives.
    """

    targets: tuple[AbstractTarget, ...]

    order = property(lambda self: max(target.order for target in self.targets))

    def columns(self, dim, high):
        return [column for target in self.targets for column in target.columns(dim, high)]

    def _parts(self, weights, dim: int):
        start = 0
        for target in self.targets:
            count = len(target.columns(dim, target.order))
            yield target, weights[start : start + count]
            start += count

    def in_units(self, weights, length, dim):
        parts = self._parts(weights, dim)
        return jnp.concatenate([target.in_units(part, length, dim) for target, part in parts])

    def assemble(self, weights, axes):
        # Apart, so that a compiler leaves out those that nobody asks for.
        return tuple(
            target.assemble(part, axes) for target, part in self._parts(weights, len(axes))
        )


class Partial(AbstractTarget):
    r"""A single derivative $D^\alpha$ in flat space."""

    alpha: tuple[int, ...] = eqx.field(static=True)

    order = property(lambda self: sum(self.alpha))

    def columns(self, dim, high):
        return [derivative_at_origin(dim, high, self.alpha)]
