"""What comes of an optimisation of shapes."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float, PyTree

from ..discretization import Discretization
from .shape import AbstractShape

# What is told of every step.
COLUMNS = (
    "objective", "gradient", "violation", "penalty", "refused", "renewed", "rebuilt", "seconds",
)  # fmt: skip


class ShapeOptimization(eqx.Module):
    """The last good shape, and the way there: made by `optimize_shape`.

    Args:
        theta: its parameters.
        shape: the family, with the neighbours that there were last.
        objective: its value.
        equalities, inequalities: what the constraints are there, by their names.
        multipliers: derivatives of the objective in what the constraints ask for, less their sign.
        history: by names `(steps + 1,)`: `objective`, norm of the `gradient` of the Lagrangian,
            `violation`, `penalty`, how often a step was `refused`, whether neighbours were
            `renewed`, whether points were chosen anew (`rebuilt`), `seconds`; every constraint by
            its own name, `(steps + 1, ...)`.
        converged: whether both tolerances were reached.
        stopped: why it ended.

    Example:
        >>> surface = js.discretize(js.sphere(200), method=js.GFDM(degree=2))
        >>> shape = js.MappedShape(lambda x, a: a * x, surface)
        >>> bowl = lambda surface: (jnp.mean(surface.cloud.points**2) - 0.5) ** 2
        >>> found = js.optimize_shape(bowl, shape, 1.0, optimizer=optax.lbfgs())
        >>> found.converged, found.history["objective"].shape == found.history["seconds"].shape
        (True, True)
    """

    theta: PyTree[Float[Array, "..."]]
    shape: AbstractShape
    objective: Float[Array, ""]
    equalities: dict[str, Array]
    inequalities: dict[str, Array]
    multipliers: dict[str, Array]
    history: dict[str, np.ndarray]
    converged: bool
    stopped: str

    @property
    def surface(self) -> Discretization:
        """The surface at theta."""
        return self.shape(self.theta)

    def __repr__(self):
        rows = self.history
        told = ("refused", "renewed", "rebuilt")
        counts = ", ".join(f"{int(rows[name].sum())} {name}" for name in told)
        constrained = self.equalities or self.inequalities
        about = f", violation {rows['violation'][-1]:.2g}" if constrained else ""
        return (
            f"ShapeOptimization(objective {float(self.objective):.6g}{about}, gradient "
            f"{rows['gradient'][-1]:.2g} from {rows['gradient'][0]:.2g}, "
            f"{len(rows['seconds']) - 1} steps, {counts}; {self.stopped})"
        )


class OptimizationError(RuntimeError):
    """An optimisation that could not go on.

    Args:
        message: why.
        solution: what there is, a `ShapeOptimization` with the last good shape, or an `Inversion`.

    Example:
        >>> surface = js.discretize(js.sphere(200), method=js.GFDM(degree=2))
        >>> shape = js.MappedShape(lambda x, a: a * x, surface)
        >>> size = lambda surface: jnp.mean(surface.cloud.points**2)
        >>> hole = lambda surface: jnp.where(size(surface) > 0.2, size(surface), jnp.nan)
        >>> try:
        ...     found = js.optimize_shape(hole, shape, 1.0, optimizer=optax.sgd(0.3))
        ... except js.OptimizationError as error:
        ...     print(bool(size(error.solution.surface) > 0.2))
        True
    """

    def __init__(self, message: str, solution: Any):
        super().__init__(message)
        self.solution = solution
