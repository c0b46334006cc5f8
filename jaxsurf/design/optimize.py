r"""One call from an objective on surfaces to the shape that minimises it."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import optax
from jaxtyping import Array, Float, PyTree

from ..arguments import flag, floating, further, real, whole
from ..failures import needs_values
from ..time.checkpoint import Checkpoint
from .asked import check_asked, check_projection, constraints
from .lagrangian import Asked, strong
from .loop import Loop
from .outcome import OptimizationError, ShapeOptimization
from .shape import AbstractShape


def optimize_shape(
    objective: Callable[..., Float[Array, ""]],
    shape: AbstractShape,
    theta: PyTree[Float[Array, "..."] | float],
    *,
    optimizer: optax.GradientTransformation,
    equalities: Mapping[str, Callable] | None = None,
    inequalities: Mapping[str, Callable] | None = None,
    project: Callable[[PyTree], PyTree] | None = None,
    args: tuple = (),
    steps: int = 100,
    rtol: float = 1e-4,
    ctol: float = 1e-4,
    penalty: float | None = None,
    renew: bool = True,
    callback: Callable[[ShapeOptimization], bool | None] | None = None,
    checkpoint: Checkpoint | None = None,
    throw: bool = True,
) -> ShapeOptimization:
    r"""Parameters that minimise a function of a surface, under constraints on it.

    Constraints are met by an augmented Lagrangian: multipliers that are corrected whenever its
    gradient has fallen to a tenth of the objective's, then a hundredth and so on, or every 20
    steps, and a penalty that grows fourfold where that gradient has fallen and the violation has
    not. One that stays is minimised alone: if it stays then too, constraints contradict each other
    (not asked under a projection). Steps after which the surface folds or passes through itself, or
    a number is not finite, are halved. Neighbours are found anew once the surface was sheared or
    stretched by about an eighth (`AbstractShape.renewed`), and points of level sets, and of maps
    with `onto`, spread evenly again; points are chosen anew where a level set in `bounds` has other
    parts (`js.LevelSetShape`); the optimiser keeps its state, and nothing is compiled again. Only
    L-BFGS begins again where the points that are chosen cannot follow back to the step before.

    Args:
        objective: $f(S)$, of a `Discretization` and `args`; returns a number.
        shape: the family of surfaces.
        theta: where to start, any pytree of floating-point arrays.
        optimizer: of optax: `optax.lbfgs()`, `optax.adam(1e-2)`, a chain.
        equalities: $h(S) = 0$, functions like the objective by their names, of numbers or arrays;
            best of size one, like `lambda s: js.volume(s) - 1`.
        inequalities: $g(S) \le 0$, likewise; -inf, as of a switched-off point, is met.
        project: takes parameters to the nearest that are allowed, at the start and after every
            step of a first-order method: one of `optax.projections`, say. L-BFGS is refused: its
            search along a line does not know of it.
        args: further arguments of all these. Neither other values of them compile anything, nor
            other numbers in functions of the same code.
        steps: at most.
        rtol: it has converged where the gradient of the Lagrangian, less what a projection takes of
            it, is this share of the objective's, at the start or where multipliers were corrected
            last, whichever is larger,
        ctol: and constraints are kept to this.
        penalty: $\mu$ at first, in units of the objective over those of a constraint squared;
            if None ten times the first objective, at least 10, and less where constraints are so
            far off that they cost twenty objectives with less: much less yet, and to give a
            constraint up may cost less than to keep it.
        renew: find neighbours anew, and points where there are other parts. If False they are
            those of `shape`, and known to the program, as `js.solve` asks for without a
            preconditioner.
        callback: called with the `ShapeOptimization` so far after each step; True ends it, None
            and False do not.
        checkpoint: where all is written after every so many steps; if the file is there, the same
            run, of more `steps` too, goes on from it and ends in the same bits; what a file of more
            steps than are asked for holds is returned as it is.
        throw: raise where it cannot go on; if False, see `stopped`.

    Returns:
        `ShapeOptimization`: `theta`, `surface`, `objective`, `multipliers`, `history`, of the last
        step, which with methods of first order need not be the lowest. Steps that are used up are
        no error; `stopped` says by how much constraints are off then.

    Accuracy: of the functions; gradients are exact for fixed neighbours. In float32 the radius of
        a ball is found within 1e-3 (`tests/test_optimize.py::test_single_precision`).
    Raises:
        TypeError: functions, a shape, an optimiser, a checkpoint that are none; parameters that are
            no floating-point arrays; a callback that returns something else.
        ValueError: a first surface or value that is not good, in the words of `shape` or by name;
            numbers out of range; functions that return something else; traced arrays.
        OptimizationError: no good step is left, or constraints contradict each other; with the
            last good shape as its `solution`.

    Example:
        >>> surface = js.discretize(js.sphere(300), method=js.GFDM(degree=2))
        >>> shape = js.MappedShape(lambda x, axes: axes * x, surface)
        >>> found = js.optimize_shape(
        ...     lambda surface: surface.areas.sum(), shape, jnp.array([1.3, 1.0, 0.8]),
        ...     equalities={"volume": lambda surface: js.volume(surface) - 4 * jnp.pi / 3},
        ...     optimizer=optax.lbfgs(),
        ... )
        >>> found.converged, bool(jnp.allclose(found.theta, 1, atol=1e-2))
        (True, True)
    """
    asked = constraints(equalities, "equalities"), constraints(inequalities, "inequalities")
    functions = dict(objective=objective, project=project, callback=callback)
    check_asked(functions, shape, optimizer, asked, checkpoint)
    theta, args = strong(floating(theta, "theta")), further(args)
    check_projection(project, optimizer, theta)
    numbers = dict(
        steps=whole(steps, "steps", least=1),
        rtol=real(rtol, "rtol", least=0),
        ctol=real(ctol, "ctol", above=0),
        penalty=None if penalty is None else real(penalty, "penalty", above=0),
        renew=flag(renew, "renew"),
    )
    needs_values("theta, shape, args and tolerances", theta, shape, args, numbers)
    wanted = Asked(objective, *asked, project)
    loop = Loop(wanted, args, optimizer, numbers, callback, checkpoint)
    found, failed = loop.run(shape, theta)
    if failed and throw:
        raise OptimizationError(found.stopped, found)
    return found
