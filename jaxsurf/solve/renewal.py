r"""The numbers of a multigrid hierarchy, computed again in compiled code on patterns found once.

Columns of which no row has two have one colour (Curtis, Powell and Reid 1974): their entries are
read off one product. So the prolongation and $P^T A P$ take products of A with some tens of
fields, whatever A is made of. What stands outside the patterns, as neighbours found anew bring it,
is lumped such that constants are treated as A treats them.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ..machine import COLORS
from ..stencils.padded import PaddedMatrix
from ..stencils.stencil import prepared
from .aggregation import damped_step, noise, stretched
from .reduced import check_kinds

Fields = Float[Array, "n c"]


class Pattern(eqx.Module):
    """Where a matrix has entries, and colours of its columns.

    Args:
        entries, transposed: True where it and its transpose have one; None for a dense matrix.
        color: of every column.
        count: of the colours.
    """

    entries: PaddedMatrix | None
    transposed: PaddedMatrix | None
    color: Int[Array, " p"]
    count: int = eqx.field(static=True)

    @classmethod
    def of(cls, matrix, entries: PaddedMatrix, transposed: PaddedMatrix) -> Pattern:
        """Of a CSR matrix, in the layouts of padded ones; on the host."""
        from pyamg.graph import vertex_coloring

        ones = matrix.astype(np.float32)
        ones.data[:] = 1
        color = vertex_coloring((ones.T @ ones).tocsr())
        padded = np.append(color, np.zeros(len(transposed.indices[0]) - len(color), color.dtype))
        mask = lambda a: jax.tree.map(
            lambda x: jnp.asarray(np.asarray(x) != 0) if eqx.is_inexact_array(x) else x, a
        )
        return cls(mask(entries), mask(transposed), jnp.asarray(padded), _rounded(color.max() + 1))

    @classmethod
    def dense(cls, size: int) -> Pattern:
        return cls(None, None, jnp.arange(size), _rounded(size))

    def matrix(self, apply: Callable[[Fields], Fields], constant, home) -> tuple[Any, Any]:
        """A matrix of which products are known, and its transpose.

        Args:
            apply: of fields side by side.
            constant: a field to which the product is right.
            home: column of every row to which entries outside the pattern are added.
        """

        def products(colors):
            own = self.color[:, None] == colors
            return apply(jnp.where(own, constant[:, None], 0))

        colors = jnp.arange(self.count, dtype=self.color.dtype).reshape(-1, COLORS)
        sums = jnp.moveaxis(jax.lax.map(products, colors), 0, 1).reshape(-1, self.count)
        size = jnp.where(constant > 0, constant, 1)
        if self.entries is None or self.transposed is None:
            return sums[:, : len(size)] / size, None
        held = _filled(self.entries, lambda i, j: sums[i, self.color[j]])
        left = jnp.sum(sums, axis=1) - held(jnp.ones_like(size))
        home = self.color.at[home].get(mode="fill", fill_value=self.count)
        sums = sums.at[jnp.arange(len(sums)), home].add(left, mode="drop")
        entry = lambda i, j: sums[i, self.color[j]] / size[j]
        return _filled(self.entries, entry), _filled(self.transposed, lambda j, i: entry(i, j))


def _rounded(count) -> int:
    return -(-int(count) // COLORS) * COLORS


def _filled(pattern: PaddedMatrix, entry: Callable[[Array, Array], Array]) -> PaddedMatrix:
    """Entries by their rows and columns."""
    rows, columns, extra = pattern.extra
    here = jnp.arange(pattern.indices.shape[1])
    weights = jnp.where(pattern.weights, entry(here, pattern.indices), 0)
    return PaddedMatrix(
        pattern.indices, weights, (rows, columns, jnp.where(extra, entry(rows, columns), 0))
    )


class Coarsening(eqx.Module):
    """What is kept of one level: aggregates and patterns.

    Args:
        aggregate: of every unknown; past the end for one that has none.
        prolong: of the prolongation.
        coarse: of the operators on the next level.
    """

    aggregate: Int[Array, " n"]
    prolong: Pattern
    coarse: Pattern

    @classmethod
    def of(cls, tentative, prolong, coarse, level, below=None) -> Coarsening:
        """From what was set up on the host.

        Args:
            tentative, prolong, coarse: CSR matrices.
            level: with `prolong` and `restrict`.
            below: the matrix of the next level and its transpose, padded; None if it is dense.
        """
        room = level.restrict.indices.shape[1]
        aggregate = np.full(level.prolong.indices.shape[1], room)
        aggregate[np.flatnonzero(np.diff(tentative.indptr))] = tentative.indices
        pattern = Pattern.of(prolong, level.prolong, level.restrict)
        dense = Pattern.dense(room) if below is None else Pattern.of(coarse, *below)
        return cls(jnp.asarray(aggregate), pattern, dense)

    def transfers(self, A, inverse, radius, constant) -> tuple[Any, Any, Float[Array, " m"]]:
        """Prolongation, its transpose and the constant on the next level, of a matrix."""
        # Columns of the tentative prolongation have norm one.
        zero = jnp.zeros(len(self.prolong.color), constant.dtype)
        coarse = jnp.sqrt(zero.at[self.aggregate].add(constant**2, mode="drop"))
        known = lambda x: x.at[self.aggregate].get(mode="fill", fill_value=0)
        share = (constant * known(inverted(coarse)))[:, None]
        step = damped_step(inverse, radius)[:, None]

        def smoothed(e):
            x = share * known(e)
            return x + step * A(x)

        return *self.prolong.matrix(smoothed, coarse, self.aggregate), coarse

    def product(self, A, prolong, restrict, constant) -> tuple[Any, Any]:
        """The matrix on the next level, and its transpose."""
        coarse = lambda e: restrict(A(prolong(e)))
        return self.coarse.matrix(coarse, constant, jnp.arange(len(constant)))


def check_renewal(plan, n: int, operator, closure) -> tuple[Any, ...]:
    """The plan, and a problem that it serves, as constants."""
    if plan is None:
        raise ValueError(
            "the hierarchy was made without what renewing needs: pass renewable=True to "
            "js.multigrid or js.step_preconditioner"
        )
    check_kinds(operator, closure)
    if operator.n != n:
        raise ValueError(f"operator for {operator.n} points, the hierarchy has {n}")
    return plan, *jax.lax.stop_gradient((prepared(operator), closure))


def plan_of(made: list, patterns: list) -> tuple[Coarsening, ...]:
    """What is kept of all levels, from the arguments of `Coarsening.of` but the last."""
    below = [*patterns[1:], None]
    return tuple(Coarsening.of(t, p, c, v, b) for (t, p, c, v), b in zip(made, below))


class Renewed(NamedTuple):
    """A level: its matrices and their transposes, the first one's divisor and radius, transfers."""

    matrices: tuple
    transposed: tuple
    divisor: Float[Array, " n"]
    radius: Float[Array, ""]
    prolong: PaddedMatrix
    restrict: PaddedMatrix


def renewed_levels(
    plan: tuple[Coarsening, ...], matrices: tuple[Any, ...], divisor, constant, on
) -> tuple[list[Renewed], tuple, Float[Array, " m"]]:
    """All levels of matrices with one hierarchy, that of the first; the coarsest ones, dense.

    Args:
        matrices: products with fields side by side.
        divisor: of the first.
        constant: on its free points.
        on: True at points that are on; None if all are.
    """
    levels: list[Renewed] = []
    transposed: tuple = (None,) * len(matrices)
    for step in plan:
        if levels:
            divisor = divisor_of(matrices[0])
            on = divisor != 0
        A, inverse = matrices[0], inverted(divisor)
        radius = radius_of(A, inverse, on)
        prolong, restrict, constant = step.transfers(A, inverse, radius, constant)
        levels.append(Renewed(matrices, transposed, divisor, radius, prolong, restrict))
        below = [step.product(A, prolong, restrict, constant) for A in matrices]
        matrices, transposed = zip(*below)
    if not plan:
        matrices = tuple(A(jnp.eye(len(constant), dtype=constant.dtype)) for A in matrices)
    return levels, matrices, constant


def inverted(x):
    """One over it; zero where it is zero."""
    return jnp.where(x == 0, 0, 1 / jnp.where(x == 0, 1, x))


def narrowed(tree, dtype):
    """In the precision of the cycle."""
    return jax.tree.map(lambda x: x.astype(dtype) if eqx.is_inexact_array(x) else x, tree)


def moduli(operator):
    """An operator or matrix that is its modulus, or somewhat more where entries add up."""
    return jax.tree.map(lambda x: jnp.abs(x) if eqx.is_inexact_array(x) else x, operator)


def free_divisor(operator, matrix, restriction):
    """As `aggregation.divisor` of P A E, zero where points are not free; and P 1.

    Of the diagonal of A: E has none of free points.
    """
    try:
        diagonal = operator.diagonal
    except ValueError as error:
        raise ValueError(
            f"{error}. In compiled code multigrid needs it: make js.multigrid(operator) outside, "
            "of this operator or one near it, and pass it as `preconditioner`"
        ) from None
    free = restriction(jnp.ones_like(diagonal))
    below = stretched(diagonal, moduli(matrix)(free) / 2)
    return jnp.where(free > 0, below, 0), free


def divisor_of(matrix: PaddedMatrix) -> Float[Array, " m"]:
    """As `aggregation.divisor`."""
    rows, columns, extra = matrix.extra
    here = jnp.arange(matrix.indices.shape[1])
    weights = jnp.where(matrix.indices == here, matrix.weights, 0)
    beside = (rows, columns, jnp.where(rows == columns, extra, 0))
    own, ones = PaddedMatrix(matrix.indices, weights, beside), jnp.ones(len(here), weights.dtype)
    return stretched(own(ones), moduli(matrix)(ones) / 2)


def radius_of(matrix, inverse, on, steps: int = 8) -> Float[Array, ""]:
    """As `aggregation.jacobi_radius`."""

    def step(v, _):
        v = inverse * matrix(v)
        size = jnp.linalg.norm(v)
        return v / size, size

    on = jnp.ones(len(inverse), bool) if on is None else on
    start = jnp.where(on, noise(jnp.cumsum(on) - 1).astype(inverse.dtype), 0)
    return jax.lax.scan(step, start, None, length=steps)[1][-1]
