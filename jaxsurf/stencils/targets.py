r"""The differential operators that stencils approximate, as right-hand sides of moment systems."""

from __future__ import annotations

import abc

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .monomials import derivative_at_origin, multi_indices


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

    @abc.abstractmethod
    def assemble(self, weights: Float[Array, "c k"], axes: Float[Array, "t d"]):
        """Components `(..., k)` in space, from those along the rows of `axes`."""

    def moments(self, dim: int, low: int, high: int) -> np.ndarray:
        """Right-hand sides `(m, c)` for the basis of degree `low` to `high`."""
        start = len(multi_indices(dim, 0, low - 1))
        return np.stack(self.columns(dim, high), axis=1)[start:]


class Laplacian(AbstractTarget):
    r"""$\Delta$; one component."""

    order = 2

    def columns(self, dim, high):
        return [sum(derivative_at_origin(dim, high, _unit(dim, a, a)) for a in range(dim))]

    def assemble(self, weights, axes):
        return weights[0]


class Gradient(AbstractTarget):
    r"""$\nabla$; d components."""

    order = 1

    def columns(self, dim, high):
        return [derivative_at_origin(dim, high, _unit(dim, a)) for a in range(dim)]

    def assemble(self, weights, axes):
        return axes.T @ weights


class Hessian(AbstractTarget):
    r"""All second derivatives; a symmetric `(d, d)` matrix."""

    order = 2

    def columns(self, dim, high):
        rows, cols = np.triu_indices(dim)
        pairs = zip(rows.tolist(), cols.tolist())
        return [derivative_at_origin(dim, high, _unit(dim, a, b)) for a, b in pairs]

    def assemble(self, weights, axes):
        dim = axes.shape[0]
        rows, cols = np.triu_indices(dim)
        full = jnp.zeros((dim, dim, weights.shape[1]), weights.dtype)
        full = full.at[rows, cols].set(weights).at[cols, rows].set(weights)
        return jnp.einsum("ap,abk,bq->pqk", axes, full, axes)


class Partial(AbstractTarget):
    r"""A single derivative $D^\alpha$ in flat space."""

    alpha: tuple[int, ...] = eqx.field(static=True)

    @property
    def order(self):
        return sum(self.alpha)

    def columns(self, dim, high):
        return [derivative_at_origin(dim, high, self.alpha)]

    def assemble(self, weights, axes):
        return weights[0]
