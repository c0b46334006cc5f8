"""What an optimisation asks of what it is given."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax

from ..arguments import instance, traced_call
from ..discretization import Discretization
from ..time.checkpoint import Checkpoint
from .lagrangian import CROSSED, Values
from .outcome import COLUMNS
from .shape import AbstractShape

# What is wrong with a surface, by its code.
FAR = 4
ILL = {
    1: "points or normals are not finite",
    2: "the surface folds",
    3: "the objective, a constraint or the gradient is not finite",
    FAR: "lists of neighbours do not reach",
    CROSSED: "the surface passes through itself",
}


def constraints(given: Any, name: str) -> dict[str, Callable]:
    """Constraints by their names."""
    if given is None:
        return {}
    instance(given, Mapping, name, '{"volume": lambda surface: js.volume(surface) - 1}, say')
    for key, f in given.items():
        if not isinstance(key, str):
            raise TypeError(f"{name} has the name {key!r}, expected text")
        if not callable(f):
            raise TypeError(f"{name}[{key!r}] is a {type(f).__name__}, expected a function")
    return dict(given)


def check_asked(functions, shape, optimizer, asked, checkpoint) -> None:
    for name, f in functions.items():
        if not callable(f) and (f is not None or name == "objective"):
            raise TypeError(f"{name} is a {type(f).__name__}, expected a function")
    instance(shape, AbstractShape, "shape", "js.star_shape(surface, 4) or js.MappedShape, say")
    instance(optimizer, optax.GradientTransformation, "optimizer", "optax.lbfgs(), say")
    if checkpoint is not None:
        instance(checkpoint, Checkpoint, "checkpoint", 'js.Checkpoint("run.npz", every=10)')
    taken = [name for some in asked for name in some]
    for name in taken:
        if name in COLUMNS or taken.count(name) > 1:
            raise ValueError(f"a constraint is called {name!r}: that name is taken")


def check_projection(project: Callable | None, optimizer, theta) -> None:
    """Refuse what is no projection of parameters, and L-BFGS beside one."""
    if project is None:
        return
    shapes = lambda tree: jax.tree.map(lambda x: (jnp.shape(x), jnp.result_type(x)), tree)
    given, found = (
        shapes(theta),
        shapes(jax.eval_shape(lambda theta: traced_call(project, "project", theta), theta)),
    )
    if given != found:
        raise ValueError(f"project returns {found} (shapes and types), expected {given}")
    is_lbfgs = lambda x: isinstance(x, optax.ScaleByLBFGSState)
    state = jax.eval_shape(optimizer.init, theta)
    if any(map(is_lbfgs, jax.tree.leaves(state, is_leaf=is_lbfgs))):
        raise ValueError(
            "project with L-BFGS: its search along a line does not know of it; take a method of "
            "first order, optax.adam(1e-2) say, or inequalities"
        )


def is_only_far(surface: Discretization) -> bool:
    """Whether nothing is wrong with a surface but its lists."""
    try:
        return set(np.asarray(surface.code).tolist()) <= {0, FAR}
    except ValueError:  # it has no operators
        return False


def refuse_start(theta, values: Values) -> None:
    """Say what is not good at the start, which a projection may have moved."""
    code = int(values.code)
    if not all(np.isfinite(np.asarray(x)).all() for x in jax.tree.leaves(theta)):
        raise ValueError(f"project makes {theta} of the first theta, expected finite numbers")
    _refuse_numbers("objective", values.objective)
    for name, x in values.equalities.items():
        _refuse_numbers(f"constraint {name!r}", x)
    for name, x in values.inequalities.items():
        # One that is -inf is met, whatever comes: that of a switched-off point, say.
        _refuse_numbers(f"constraint {name!r}", np.where(np.isneginf(x), 0, x))
    if code == 3:
        raise ValueError("the gradient at the first theta is not finite, where the objective is")
    if code:
        raise ValueError(f"at the first theta {ILL[code]}")


def _refuse_numbers(what: str, given: Any) -> None:
    """Name the first that is not finite, and tell how many there are."""
    x = np.asarray(given)
    where = np.argwhere(~np.isfinite(x)).tolist()
    if where:
        entry = f" in entry {', '.join(map(str, where[0]))}" if x.ndim else ""
        more = f" (and {len(where) - 1} more)" if len(where) > 1 else ""
        value = x[tuple(where[0])]
        raise ValueError(f"{what} is {value} at the first theta{entry}{more}, expected a number")
