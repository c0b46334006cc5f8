r"""One call from a motion and a surface to where it is later, with fields on it."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, PyTree

from ..arguments import as_float, as_many, finite, instance, is_array, real, switched_off
from ..cloud import PointCloud
from ..design.functionals import volume
from ..discretization import Discretization, discretize
from ..failures import is_concrete, needs_values, raise_at, refuse, without_derivatives
from ..kept import Kept
from ..motion import CODES
from ..stencils.method import AbstractMethod
from ..stencils.usual import USUAL
from ..time.asked import check_coefficients
from ..time.checkpoint import Checkpoint
from ..time.higher import WaveEquation
from ..time.integrate import IntegrationError, integrate
from ..time.problem import AbstractEvolution, checked_problem
from ..time.states import tell_small
from .adaptation import Adaptation, checked_adaptation
from .contact import Contact, checked_contact
from .eversion import tell_eversion, told_extinction
from .follow import ClosesOverTraced, followed
from .motions import AbstractMotion, checked_motion
from .problem import Moving, joined, parted
from .rows import compact

_EVENTS = ("t", "added", "merged", "pinched", "joined", "vanished")


class Evolution(eqx.Module):
    """A surface and fields on it over time: made by `evolve`.

    Args:
        ts: times, `(m,)`.
        rows: surface and fields at each, with the rows that are switched off.
        stats: how many steps were taken and refused, how often neighbours were found anew; the
            solver and why.
        changes: of the points, by adaptation and contact: see `history`.

    Example:
        >>> motion = js.Motion(lambda t, surface, fields, args: surface.cloud.normals)
        >>> solution = js.evolve(motion, js.sphere(300), t1=1.0, saveat=[0.0, 0.5])
        >>> solution.ts.tolist(), solution.clouds[1].n
        ([0.0, 0.5, 1.0], 300)
    """

    ts: Float[Array, " m"]
    rows: list[tuple[Discretization, PyTree[Array]]]
    stats: dict[str, Any]
    changes: Float[np.ndarray, "e 6"] | None = None

    @Kept
    def _seen(self) -> list[tuple[Discretization, PyTree[Array]]]:
        off = [surface.cloud.active is not None for surface, _ in self.rows]
        known = is_concrete(self.ts, [(surface.cloud.points, u) for surface, u in self.rows])
        return [compact(*row) if some and known else row for some, row in zip(off, self.rows)]

    @property
    def surfaces(self) -> list[Discretization]:
        """The surface at each time, of the rows that are on (under `jit` of all, see `rows`)."""
        return [surface for surface, _ in self._seen]

    @property
    def fields(self) -> list[PyTree[Array]]:
        """The fields at each time, of the structure given, with a row for each row of `clouds`."""
        return [fields for _, fields in self._seen]

    @property
    def clouds(self) -> list[PointCloud]:
        """The cloud at each time."""
        return [surface.cloud for surface in self.surfaces]

    @property
    def events(self) -> dict[str, Float[np.ndarray, " e"]]:
        """When, "t", points were "added" and pairs "merged", necks "pinched", gaps "joined", parts
        "vanished", and how many of each; empty without adaptation."""
        return {} if self.changes is None else dict(zip(_EVENTS, self.changes.T))

    @property
    def history(self) -> dict[str, Any]:
        r"""Number of points, area, enclosed volume and integrals of the fields at each time.

        The volume is `js.volume` of closed surfaces, NaN of others. With adaptation also `events`.
        Raises what `areas` does.
        """
        rows = [_measured(*row) for row in self.rows]
        none = dict.fromkeys(("n", "area", "volume", "mass"), jnp.zeros(0))
        told = jax.tree.map(lambda *values: jnp.stack(values), *rows) if rows else none
        history = {"t": self.ts} | told
        return history if self.changes is None else history | {"events": self.events}

    def __repr__(self):
        if not is_concrete(self.ts):
            return "Evolution(traced)"
        steps = ", ".join(f"{name} {value}" for name, value in self.stats.items())
        if not len(self.ts):
            return f"Evolution(no times: nothing was left of the surface at the first, {steps})"
        first, last = float(self.ts[0]), float(self.ts[-1])
        return (
            f"Evolution({len(self.surfaces)} times from {first:g} to {last:g}, "
            f"{self.clouds[-1].n} points, {steps})"
        )


def evolve(
    motion: AbstractMotion,
    cloud: PointCloud | Discretization,
    *,
    t1: ArrayLike,
    t0: ArrayLike = 0.0,
    fields: PyTree[Array] = (),
    problem: Callable[[Discretization], AbstractEvolution] | None = None,
    method: AbstractMethod | None = None,
    saveat: Sequence[float] | ArrayLike | None = None,
    solver: dfx.AbstractSolver | None = None,
    dt0: ArrayLike | None = None,
    rtol: float = 1e-5,
    atol: float = 1e-7,
    args: Any = None,
    adjoint: dfx.AbstractAdjoint | None = None,
    adapt: Adaptation | None = None,
    contact: Contact | None = None,
    checkpoint: Checkpoint | None = None,
    progress: bool = False,
) -> Evolution:
    r"""Move a surface, and integrate an equation on it.

    Points and fields are one state, $\dot x = v$ and $\dot u + u\,\nabla_S\cdot v = f(u)$ along the
    path of each point; the surface is made anew from the points of every stage, so that a solver
    keeps its order. Neighbours stay the same until the surface has been sheared or stretched by
    about an eighth; they and the normals are then found anew, between two steps.

    Args:
        motion: `Motion(velocity)`, `MeanCurvatureFlow()`, or one of your own.
        cloud: n points with unit normals at t0, or a surface from `discretize`.
        t1, t0: end and start.
        fields: on the cloud, `(n, *c)`, or several as a tuple; none by default.
        problem: makes the problem of the fields from the surface, say
            `lambda surface: js.AdvectionDiffusionReaction(surface.laplacian)`; and the conditions
            at its border, by `eliminate(surface, ...)` or `without_flux(surface)`. What it
            conserves is diluted as the surface grows; of a `WaveEquation` that is
            $\partial_t u$. If None, fields go with the points unchanged.
        method: of the operators; `GFDM(degree=4)` if None, or that of a surface given.
        saveat: times to save; t1 is always saved (beside traced times once more).
        solver, dt0, rtol, atol: as for `integrate`; the solver that suits motion and problem if
            None. Of positions the tolerances are relative to the surface: as if its middle were the
            origin, and the root mean square of the distances from there the unit of length; `atol`
            is above zero.
        args: handed to velocity, reactions and forcings: what is differentiated goes in here, or
            in `cloud` and `fields`.
        adjoint: how to differentiate, as for `integrate`.
        adapt: add points in holes and merge those that crowd, at the start and on the way. What
            the problem, the velocity or a spacing takes must then not have one row per point, but
            be computed from the surface; the support of operators follows from the neighbours.
        contact: what happens where sheets come near each other; if None, they cross. Where nothing
            is left of a surface, the run ends: times after that are not in `ts`.
        checkpoint: write all to disk now and then, and go on from there if it is; a run that was
            killed ends in the same bits as one that was not. After an error the last good state is
            on disk.
        progress: show a bar.

    Returns:
        `Evolution`: `ts`; `clouds`, `surfaces` and `fields` at each, of the rows that are on
        (under `jit` of all); `history`.

    Accuracy: in time that of the solver; in space that of the method; in float32 points are within
        1e-5 (`tests/test_moving.py`).
    Differentiable: reverse (forward with `adjoint=diffrax.ForwardMode()`), under `jit`, with the
        neighbours that there were at t0, which must then serve until t1. For longer, in parts: from
        `surface.moved(points, normals, search=search)`, with neighbours found anew. How steps were
        chosen is not differentiated: give `dt0` where that matters. What the host
        decides, by `adapt` and `contact`, has no derivative; across points that were added it is
        that of a surface whose new points are carried by those around them,
        `surface.interpolate` (`tests/test_moving_gradients.py`). It is not defined across a cut.
    Raises:
        TypeError: arguments of other kinds.
        ValueError: wrong shapes; times that are not in order; on concrete arrays a surface that
            folds (named by index, see `Discretization.code`), a fit that turns a normal over; a
            border, by a motion that holds derivatives of positions.
            Differentiated or compiled, an error of the run time.
        IntegrationError: the end was not reached, see `integrate`. (A checkpoint is refused as
            there: damaged, or of another run.)
    Source: Suchde and Kuhnert 2019, eqs. 28 and 42; in time by the method of lines instead.

    Example:
        >>> def velocity(t, surface, fields, args):
        ...     return 0.5 * surface.cloud.normals
        >>> cloud = js.sphere(500)
        >>> heat = lambda surface: js.AdvectionDiffusionReaction(surface.laplacian)
        >>> u0 = cloud.points[:, 0] * cloud.points[:, 1]
        >>> given = dict(fields=u0, problem=heat, method=js.GFDM(degree=4))
        >>> solution = js.evolve(js.Motion(velocity), cloud, t1=1.0, **given)
        >>> exact = 1.5**-2 * jnp.exp(-12 * (1 - 1 / 1.5)) * u0
        >>> bool(jnp.abs(solution.fields[-1] - exact).max() < 1e-2 * exact.max())
        True
    """
    surface = _discretized(checked_motion(motion), cloud, method)
    n = surface.n
    on = surface.cloud.active
    field = lambda u: finite(switched_off(on, as_float(u, "fields", (n, ...))), "fields")
    fields = jax.tree.map(field, fields)
    _check_types(fields, surface.cloud.points)
    concrete = is_concrete(surface, fields, args, t0, t1, saveat, motion)
    if motion.derivatives and concrete:
        _check_closed(motion, surface)
    looked: dict[str, Any] = {"adapt": adapt, "contact": contact, "checkpoint": checkpoint}
    if not concrete:
        _refuse_looks(looked)
    if contact is not None and checked_contact(contact).deletes and adapt is None:
        raise ValueError("contact of kind 'delete' needs adapt: new parts are filled with points")
    if adapt is not None:
        surface, fields = _with_rows(surface, fields, adapt)
    times = _times(t0, t1, saveat)
    if dt0 is None:
        real(atol, "atol", above=0)  # coordinates pass through zero, where rtol allows no error
    if problem is not None:
        if not callable(problem) or isinstance(problem, AbstractEvolution):
            raise TypeError(
                f"problem is a {type(problem).__name__}, expected a function of the surface: "
                "lambda surface: js.AdvectionDiffusionReaction(surface.laplacian), say"
            )
        _check_problem(checked_problem(problem(surface)), fields, surface.n)
        check_coefficients(problem(surface), t0, t1)
        if dt0 is None:
            tell_small(fields, atol, "fields")
    if concrete:
        motion.check(t0, surface, fields, args)
    options = dict(solver=solver, dt0=dt0, rtol=rtol, atol=atol, args=args, adjoint=adjoint)
    moving, state = Moving.of(surface, motion, problem), joined(surface.cloud.points, fields)
    if checkpoint is not None:
        instance(checkpoint, Checkpoint, "checkpoint", "js.Checkpoint(path, every=...)")
    if concrete:
        try:
            found = Evolution(
                *followed(moving, state, t0, times, options, adapt, contact, checkpoint, progress)
            )
            if surface.border is None:
                tell_eversion(surface, t0, found.ts, [row[0] for row in found.rows])
            return found
        except ClosesOverTraced:
            _refuse_looks(looked)
        except IntegrationError as error:
            raise (error if looked["adapt"] else told_extinction(surface, error)) from None
    return _kept(moving, state, t0, times, options)


def _check_types(fields, points) -> None:
    for u in jax.tree.leaves(fields):
        if u.dtype != points.dtype:
            raise TypeError(
                f"fields are {u.dtype}, points {points.dtype}: one state holds both, of one type"
            )


def _refuse_looks(looked: dict[str, Any]) -> None:
    for name, value in looked.items():
        if value is not None:
            raise ValueError(f"{name} needs concrete arrays: it is the host that looks at them")


def _check_closed(motion: AbstractMotion, surface: Discretization) -> None:
    """Refuse flows of a border, of which nothing says how it moves."""
    if surface.border is not None:
        text = (
            f"point {{i}}{{more}} lies on the border, but {motion!r} is of closed surfaces only: "
        )
        marked = np.zeros(surface.n, bool)
        marked[np.asarray(surface.border.points)] = True
        raise_at(marked, text + "conditions of a problem hold for its fields, not for positions")


def _check_problem(made: AbstractEvolution, fields, n: int) -> None:
    """Refuse one of other points or fields than there are."""
    if made.n is not None:
        as_many("problem makes operators", made.n, "the surface", n)
    if not jax.tree.leaves(fields):
        raise ValueError("problem is given, but no fields: fields = () has 0 arrays, at least 1")
    kind = type(fields).__name__
    if isinstance(made, WaveEquation):
        if not (isinstance(fields, tuple) and len(fields) == 2):
            raise ValueError(f"fields is a {kind}, a wave needs 2 arrays: values and velocities")
        value, rate = map(jnp.shape, fields)
        if value != rate:
            raise ValueError(f"fields of a wave have shapes {value} and {rate}, expected one shape")
    elif made.n is not None and not is_array(fields):
        count = len(jax.tree.leaves(fields))
        raise ValueError(
            f"fields is a {kind} of {count}, {type(made).__name__} has 1 array, (n,) or (n, c): "
            "several species are its columns"
        )


def _discretized(motion, cloud, method) -> Discretization:
    if isinstance(cloud, Discretization):
        if method is not None:
            raise ValueError(f"method = {method!r}, but the surface given has {cloud.method!r}")
        return cloud
    instance(cloud, PointCloud, "cloud", "js.PointCloud(points, normals), or js.discretize(cloud)")
    known = without_derivatives(cloud)
    needs_values("cloud", known, instead="under jit and vmap pass js.discretize(cloud, neighbors)")
    return discretize(cloud, method=USUAL if method is None else method)


def _with_rows(
    surface: Discretization, fields, adapt: Adaptation
) -> tuple[Discretization, PyTree[Array]]:
    """With rows that can be switched on, and nothing else that is given per point."""
    checked_adaptation(adapt, surface)
    room = max(0, (adapt.capacity or 0) - surface.n)
    on = jnp.pad(jnp.asarray(surface.cloud.host_active), (0, room))
    more = lambda u: jnp.pad(u, ((0, room), *((0, 0),) * (u.ndim - 1)))
    cloud, marked = surface.cloud, surface.cloud.boundary
    marked = None if marked is None else jnp.pad(marked, (0, room))
    cloud = PointCloud(more(cloud.points), more(cloud.normals), active=on, boundary=marked)
    return discretize(cloud, method=surface.method), jax.tree.map(more, fields)


def _times(t0, t1, saveat) -> list:
    """When to save, t1 last."""
    for name, value in (("t0", t0), ("t1", t1)):
        real(value, name)
    if isinstance(saveat, str) or not (saveat is None or np.iterable(saveat)):
        raise TypeError(f"saveat is a {type(saveat).__name__}, expected a sequence of times")
    if is_array(saveat) and is_concrete(saveat):
        saveat = np.asarray(saveat)  # whose entries are numbers, also in compiled code
    saved = [] if saveat is None else list(saveat)
    for value in saved:
        real(value, "saveat")
    if not is_concrete(t0, t1, *saved):
        return [*saved, t1]
    values = np.asarray([float(t0), *map(float, saved), float(t1)])
    if not values[-1] > values[0]:
        raise ValueError(f"t1 = {values[-1]:g}, expected above t0 = {values[0]:g}")
    text = "saveat does not rise after {v} (entry {i}), or leaves the run from t0 to t1"
    raise_at(np.diff(values)[1:-1] <= 0, text, values[1:-2])
    raise_at(
        (values[1:-1] < values[0]) | (values[1:-1] > values[-1]),
        f"saveat is {{v}} at entry {{i}}, expected within {values[0]:g} and {values[-1]:g}",
        values[1:-1],
    )
    return [*saved, *([t1] if not saved or values[-2] < values[-1] else [])]


# --- a run that is traced: the same neighbours all the way ----------------------------------


def _kept(moving: Moving, state, t, times, options) -> Evolution:
    rows = []
    for target in times:
        if target is not t:
            found = integrate(moving, state, t0=t, t1=target, **options)
            t, state = target, jax.tree.map(lambda y: y[-1], found.ys)
        code = moving.surface_at(parted(state)[0]).code
        text = (
            "the surface does not keep the neighbours it had at t0, which derivatives and compiled "
            "runs ask for: make it shorter, or go on in parts from `surface.moved(points, normals, "
            "search=search)`; outside jit and grad the run finds them anew. What it may be: "
        ) + "; ".join(f"{number}: {text}" for number, text in CODES.items())
        # Whatever is looked at of it, fields alone or points.
        kept = functools.partial(refuse, bad=jnp.any(code > 0), message=text)
        state = jax.tree.map(kept, state)
        fields = moving.fields(target, state, options["args"])
        rows.append((moving.surface_at(parted(state)[0]), fields))
    return Evolution(jnp.stack([jnp.asarray(s) for s in times]), rows, {})


# --- what is told of it --------------------------------------------------------------------


def _measured(surface: Discretization, fields) -> dict[str, Any]:
    cloud = surface.cloud
    none = jnp.full((), jnp.nan, cloud.points.dtype)
    return {
        "n": jnp.asarray(cloud.n if cloud.active is None else jnp.sum(cloud.active)),
        "area": jnp.sum(surface.areas),
        "volume": volume(surface) if surface.border is None else none,
        "mass": jax.tree.map(surface.integrate, fields),
    }
