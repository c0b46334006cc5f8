r"""Multigrid for the linear systems of implicit steps."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float, PyTree

from ..arguments import as_float
from ..functions import canonical
from ..solve.precondition import VCycle
from ..solve.shifted import ShiftedMultigrid, shifted_multigrid
from ..stencils.lineax import Square, matrix_free
from .problem import AbstractEvolution, checked_problem
from .states import dtype_of


class StepPreconditioner(eqx.Module):
    r"""Approximate inverses of $1 - g L$: made by `step_preconditioner`.

    Args:
        hierarchy: of the Laplacian.
        factors: function of g, see `AbstractEvolution.factors`.
        shapes: of the arrays of the state.
        structure: of the state.
    """

    hierarchy: ShiftedMultigrid
    factors: Callable
    shapes: tuple[jax.ShapeDtypeStruct, ...] = eqx.field(static=True)
    structure: Any = eqx.field(static=True)

    def __call__(self, g: ArrayLike) -> StepInverse:
        factors = jax.lax.stop_gradient(self.factors(jnp.asarray(g, self.shapes[0].dtype)))
        cycles = [self._cycles(rows) for rows in self.structure.flatten_up_to(factors)]
        return StepInverse(cycles, self.shapes, self.structure)

    def _cycles(self, rows: Float[Array, "m *c"] | None) -> list:
        at = lambda row: [self.hierarchy.at(s) for s in row] if row.ndim else self.hierarchy.at(row)
        return [] if rows is None else [at(row) for row in rows]

    def renewed(
        self, problem: AbstractEvolution, u0: PyTree[Array] | None = None
    ) -> StepPreconditioner:
        """That of another problem on the same points: same aggregates, other numbers.

        Runs under `jit`, `vmap` and `grad`, see `VCycle.renewed`. A constant for derivatives.

        Args:
            problem: of the kind that this was made for.
            u0: a state, where geometry is part of it.

        Raises:
            TypeError: no problem.
            ValueError: made without `renewable=True`; a problem that has none, or of another size.
        """
        if u0 is None:
            u0 = self.structure.unflatten(jnp.zeros(x.shape, x.dtype) for x in self.shapes)
        now, _, factors = _factored(problem, u0)
        hierarchy = self.hierarchy.renewed(now.laplacian, closure=now.closure)
        return StepPreconditioner(hierarchy, factors, self.shapes, self.structure)


@matrix_free
class StepInverse(Square):
    """One cycle after another.

    Args:
        cycles: for each array of the state, one after another: each for all columns, or a list
            with one for every column.
        shapes: of the arrays of the state.
        structure: of the state.
    """

    cycles: list[list[VCycle | list[VCycle]]]
    shapes: tuple[jax.ShapeDtypeStruct, ...] = eqx.field(static=True)
    structure: Any = eqx.field(static=True)

    def mv(self, vector):
        fields = self.structure.flatten_up_to(vector)
        return self.structure.unflatten(map(_through, self.cycles, fields))

    def transpose(self):
        turn = lambda cycle: (
            [one.transpose() for one in cycle] if isinstance(cycle, list) else cycle.transpose()
        )
        turned = [[turn(cycle) for cycle in reversed(cycles)] for cycles in self.cycles]
        return StepInverse(turned, self.shapes, self.structure)

    def in_structure(self):
        return self.structure.unflatten(self.shapes)


def _through(cycles: list[VCycle | list[VCycle]], field: Array) -> Array:
    for cycle in cycles:
        if isinstance(cycle, list):
            columns = [one(v) for one, v in zip(cycle, field.T)]
            field = jnp.stack(columns, axis=1)
        else:
            field = cycle(field) if field.ndim == 1 else jax.vmap(cycle, 1, 1)(field)
    return field


def step_preconditioner(
    problem: AbstractEvolution, u0: PyTree[Array], *, renewable: bool = False
) -> StepPreconditioner:
    r"""Multigrid for `IMEX(preconditioner=...)`, for steps of any length.

    Without it the linear systems take a number of Krylov steps that grows like $\sqrt{\Delta t}
    / h$ for diffusion and like $\sqrt{\Delta t} / h^2$ for equations of fourth order, whose
    linear part is factored: $1 + g\,\kappa\,\Delta^2 \approx (1 - \sqrt{g \kappa}\,\Delta)^2$.

    Args:
        problem: `AdvectionDiffusionReaction`, `BiharmonicDiffusion`, `CahnHilliard` or one of
            your own with a `laplacian` and `factors`, with concrete arrays. A diffusivity in
            space counts with its mean, one in time as at t = 0.
        u0: a state: its shape, and the geometry where that is part of it.
        renewable: keep what `renewed(problem)`, a method of the result, needs to serve other
            operators in compiled code.

    Returns:
        A function of g, for traced g too; a constant for derivatives.

    Accuracy: in float32 the inverse is within 1e-4 of that in double precision
    (`tests/test_time_forms.py`).
    Raises:
        ImportError: pyamg is not installed (extra `multigrid`).
        ValueError: another problem, no diffusion, traced arrays.

    Example:
        >>> cloud = js.sphere(1_000)
        >>> problem = js.BiharmonicDiffusion(js.laplace_beltrami(cloud))
        >>> u0 = cloud.points[:, 2]
        >>> solver = js.IMEX(preconditioner=js.step_preconditioner(problem, u0))
        >>> u = js.integrate(problem, u0, t1=0.1, solver=solver).ys[-1]
        >>> bool(jnp.abs(u - jnp.exp(-0.4) * u0).max() < 0.01)
        True
    """
    now, u0, factors = _factored(problem, u0)
    hierarchy = shifted_multigrid(now.laplacian, closure=now.closure, renewable=renewable)
    leaves, structure = jax.tree.flatten(u0)
    shapes = tuple(jax.ShapeDtypeStruct(x.shape, x.dtype) for x in leaves)
    return StepPreconditioner(hierarchy, factors, shapes, structure)


def _factored(problem, u0) -> tuple[Any, PyTree[Array], Callable]:
    """A problem frozen at a state, the state, and the function of g to the factors."""
    n = checked_problem(problem).n
    if n is not None and not hasattr(u0, "shape"):
        raise ValueError(f"u0 is {type(u0).__name__}, expected an array ({n},) or ({n}, c)")
    for leaf in jax.tree.leaves(u0):
        if jnp.ndim(leaf) not in (1, 2) or n not in (None, jnp.shape(leaf)[0]):
            raise ValueError(f"u0 is {jnp.shape(leaf)}, expected an array ({n},) or ({n}, c)")
    u0 = jax.tree.map(lambda x: as_float(x, "u0"), u0)
    t = jnp.zeros((), dtype_of(u0))
    now = problem.at(t, u0)
    factors = lambda g: now.factors(g, u0)
    rows = jax.eval_shape(factors, t)
    if getattr(now, "laplacian", None) is None or rows is None:
        raise ValueError(
            f"there is no preconditioner for problem = {type(problem).__name__}: it has no "
            "diffusion, or none known (no `laplacian` or no `factors`)"
        )
    _check_factors(type(problem).__name__, rows, u0)
    return now, u0, canonical(factors, t)


def _check_factors(name: str, rows: PyTree, u0: PyTree[Array]) -> None:
    """As `AbstractEvolution.factors` says."""

    def fits(row, leaf) -> bool:
        return row is None or row.ndim == 1 or (row.ndim == 2 and row.shape[1:] == leaf.shape[1:])

    none = lambda row: row is None
    wanted: Any = jax.tree.structure(u0)
    same = wanted == jax.tree.structure(rows, is_leaf=none)
    if not (same and all(map(fits, jax.tree.leaves(rows, is_leaf=none), jax.tree.leaves(u0)))):
        shapes = (jax.tree.map(lambda a: a.shape, tree) for tree in (rows, u0))
        raise ValueError(
            f"factors of {name} have shapes {next(shapes)}, expected (m,), (m, c) for c species, "
            f"or None for each array of the state, of shapes {next(shapes)}"
        )
