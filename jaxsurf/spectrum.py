r"""What an operator does to time integration: its outermost and its slowest eigenvalues."""

from __future__ import annotations

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from .stencils.stencil import AbstractOperator, check_scalar


class Spectrum(NamedTuple):
    """Outer eigenvalues of an operator.

    Args:
        radius: largest modulus.
        abscissa: largest real part.
    """

    radius: float
    abscissa: float


def spectral_estimate(operator: AbstractOperator, *, steps: int = 40, degree: int = 24) -> Spectrum:
    r"""Largest modulus and largest real part of an operator's eigenvalues, by Arnoldi's method.

    The modulus comes from the Krylov space of the operator A. The real part from that of a
    Chebyshev polynomial of A, which is at most 1 on the left 98 per cent of $[-\rho, 0]$ and
    grows steeply from there to the right: slow and growing modes stand out. Both times the
    eigenvalues are those of A projected on the space.

    Args:
        operator: takes and gives scalar fields; concrete.
        steps: dimension of the first space; the second has half of it.
        degree: of the polynomial. In all, A is applied `(degree + 3) * steps / 2` times, about.

    Returns:
        The two numbers, in units of the operator. An explicit step of length dt is stable if
        dt times the radius is within the solver's limit and the abscissa is not positive.

    Accuracy: the radius within a few per cent, from below; the abscissa of a stable
    Laplacian is that of the constants, zero, up to 1e-6 of the radius
    (`tests/test_spectrum.py`). A positive one beyond that is a mode that grows.
    Raises:
        ValueError: an operator with components.

    Example:
        >>> spectrum = js.spectral_estimate(js.laplace_beltrami(js.sphere(1_000)))
        >>> bool(spectrum.abscissa < 1e-6 * spectrum.radius)
        True
    """
    check_scalar(operator)
    start = jnp.asarray(np.random.default_rng(0).normal(size=operator.n))
    steps = min(steps, operator.n - 1)
    radius = float(np.abs(_ritz_values(operator, operator, start, steps)).max())
    slow = _Chebyshev(operator, jnp.asarray(radius), degree)
    abscissa = float(_ritz_values(operator, slow, start, max(steps // 2, 1)).real.max())
    return Spectrum(radius, abscissa)


class _Chebyshev(eqx.Module):
    """Chebyshev polynomial of an operator, stretched over the left of its spectrum."""

    operator: AbstractOperator
    radius: jax.Array
    degree: int = eqx.field(static=True)

    def __call__(self, v):
        center, half = 0.51 * self.radius, 0.49 * self.radius

        def shifted(v):
            return (self.operator(v) + center * v) / half

        def recur(pair, _):
            last, now = pair
            return (now, 2 * shifted(now) - last), None

        return jax.lax.scan(recur, (v, shifted(v)), length=self.degree - 1)[0][1]


def _ritz_values(operator, generator, start, steps: int) -> np.ndarray:
    """Eigenvalues of the operator projected on the Krylov space of another one."""
    return np.linalg.eigvals(np.asarray(_projected(operator, generator, start, steps)))


@eqx.filter_jit
def _projected(operator, generator, start, steps: int):
    space = jnp.zeros((steps + 1, start.size), start.dtype)
    space = space.at[0].set(start / jnp.linalg.norm(start))

    def extend(space, j):
        v = generator(space[j])
        for _ in range(2):  # Gram-Schmidt, twice is enough
            v = v - space.T @ (space @ v)
        return space.at[j + 1].set(v / jnp.linalg.norm(v)), None

    space, _ = jax.lax.scan(extend, space, jnp.arange(steps))
    return space @ operator(space.T)
