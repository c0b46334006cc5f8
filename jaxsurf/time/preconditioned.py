r"""Multigrid for the linear systems of implicit steps."""

from __future__ import annotations

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.tree_util import Partial
from jaxtyping import Array, ArrayLike, Float

from ..arguments import instance
from ..solve.precondition import Multigrid
from ..solve.shifted import ShiftedMultigrid, shifted_multigrid
from ..stencils.algebra import AbstractOperator
from ..stencils.lineax import Square, matrix_free
from .pde import AbstractEvolution, AdvectionDiffusionReaction, BiharmonicDiffusion, CahnHilliard


class StepPreconditioner(eqx.Module):
    r"""Approximate inverses of $1 - g L$: made by `step_preconditioner`.

    Args:
        hierarchy: of the Laplacian.
        shifts: function of g to the $s_i$ of $1 - g L \approx \prod_i (1 - s_i \Delta)$, `(m,)`
            or `(m, c)` for c species of their own.
        shape: of the field.
    """

    hierarchy: ShiftedMultigrid
    shifts: Callable[[Array], Float[Array, "m *c"]]
    shape: tuple[int, ...] = eqx.field(static=True)

    def __call__(self, g: ArrayLike) -> StepInverse:
        g = jnp.asarray(g)
        shifts = jax.lax.stop_gradient(self.shifts(g))
        cycles = [
            jax.tree.map(self.hierarchy.at, list(row)) if row.ndim else self.hierarchy.at(row)
            for row in shifts
        ]
        return StepInverse(cycles, jax.ShapeDtypeStruct(self.shape, g.dtype))

    def renewed(self, problem: AbstractEvolution) -> StepPreconditioner:
        """That of another problem on the same points: same aggregates, other numbers.

        Runs under `jit`, `vmap` and `grad`, see `Multigrid.renewed`. A constant for derivatives.

        Raises:
            TypeError: no problem.
            ValueError: made without `renewable=True`; a problem that has none, or of another size.
        """
        laplacian, shifts = _factors(problem, self.shape)
        hierarchy = self.hierarchy.renewed(laplacian, conditions=problem.conditions)
        return StepPreconditioner(hierarchy, shifts, self.shape)


@matrix_free
class StepInverse(Square):
    """One cycle after another.

    Args:
        cycles: each for all columns of a field, or a list with one for every column.
        structure: of the field.
    """

    cycles: list[Multigrid | list[Multigrid]]
    structure: jax.ShapeDtypeStruct = eqx.field(static=True)

    def mv(self, vector):
        for cycle in self.cycles:
            if isinstance(cycle, list):
                columns = [one(v) for one, v in zip(cycle, vector.T)]
                vector = jnp.stack(columns, axis=1)
            else:
                vector = cycle(vector) if vector.ndim == 1 else jax.vmap(cycle, 1, 1)(vector)
        return vector

    def transpose(self):
        turned = [
            [one.transpose() for one in cycle] if isinstance(cycle, list) else cycle.transpose()
            for cycle in reversed(self.cycles)
        ]
        return StepInverse(turned, self.structure)

    def in_structure(self):
        return self.structure


def step_preconditioner(
    problem: AbstractEvolution, u0: Float[Array, "n *c"], *, renewable: bool = False
) -> StepPreconditioner:
    r"""Multigrid for `IMEX(preconditioner=...)`, for steps of any length.

    Without it the linear systems take a number of Krylov steps that grows like $\sqrt{\Delta t}
    / h$ for diffusion and like $\sqrt{\Delta t} / h^2$ for equations of fourth order, whose
    linear part is factored: $1 + g\,\kappa\,\Delta^2 \approx (1 - \sqrt{g \kappa}\,\Delta)^2$.

    Args:
        problem: `AdvectionDiffusionReaction`, `BiharmonicDiffusion` or `CahnHilliard`, with
            concrete arrays. A diffusivity in space counts with its mean, one in time as at t = 0.
        u0: a state, for its shape.
        renewable: keep what `renewed(problem)`, a method of the result, needs to serve other
            operators in compiled code.

    Returns:
        A function of g, for traced g too; a constant for derivatives.

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
    laplacian, shifts = _factors(problem, getattr(u0, "shape", ()))
    if not hasattr(u0, "shape") or u0.ndim not in (1, 2) or u0.shape[0] != laplacian.n:
        shape = u0.shape if hasattr(u0, "shape") else type(u0).__name__
        raise ValueError(f"u0 is {shape}, expected an array ({laplacian.n},) or ({laplacian.n}, c)")
    hierarchy = shifted_multigrid(laplacian, conditions=problem.conditions, renewable=renewable)
    return StepPreconditioner(hierarchy, shifts, jnp.shape(u0))


def _factors(problem, shape: tuple[int, ...]) -> tuple[AbstractOperator, Partial]:
    """The Laplacian of a problem, and the function of g to the shifts."""
    hint = "like AdvectionDiffusionReaction(laplacian)"
    instance(problem, AbstractEvolution, "problem", hint)
    laplacian = getattr(problem, "laplacian", None)
    if isinstance(problem, AdvectionDiffusionReaction) and laplacian is not None:
        d = problem.diffusivity
        d = d(0.0) if callable(d) else d
        shifts = Partial(_diffusive, _mean(d, shape[1:], problem.active))
    elif isinstance(problem, BiharmonicDiffusion):
        shifts = Partial(_biharmonic, jnp.asarray(problem.stiffness))
    elif isinstance(problem, CahnHilliard):
        numbers = (problem.mobility, problem.splitting, problem.width)
        shifts = Partial(_cahn_hilliard, *map(jnp.asarray, numbers))
    else:
        kind = type(problem).__name__
        raise ValueError(
            f"there is no preconditioner for problem = {kind}: it has no diffusion, or none known"
        )
    assert laplacian is not None
    return laplacian, shifts


def _mean(diffusivity, species: tuple[int, ...], on) -> Array:
    """Over the points that are on: a number, or one for every species."""
    d = jnp.asarray(diffusivity)
    per_species = bool(species) and d.shape[-1:] == species
    d = d.reshape(-1, *species) if per_species else d
    counted = None
    if on is not None and d.shape[:1] == on.shape:
        counted = on.reshape(-1, *[1] * (d.ndim - 1))
    return jnp.mean(d, axis=0 if per_species else None, where=counted)


def _diffusive(diffusivity, g):
    return (g * diffusivity)[None]


def _biharmonic(stiffness, g):
    return jnp.full(2, jnp.sqrt(g * stiffness))


def _cahn_hilliard(mobility, splitting, width, g):
    r"""$1 - s\,\Delta + q\,\Delta^2$ with $s = g M s_0$, $q = g M \epsilon^2$."""
    total, product = g * mobility * splitting, g * mobility * width**2
    # Complex factors have the modulus √q.
    half = jnp.sqrt(jnp.maximum((total / 2) ** 2 - product, 0))
    large = jnp.maximum(total / 2 + half, jnp.sqrt(product))
    return jnp.stack([large, product / jnp.where(large > 0, large, 1)])
