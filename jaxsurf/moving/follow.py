"""A run on the host, in stretches of fixed neighbours and, if asked for, parts on disk."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from tqdm import tqdm

from ..compiling import on_device
from ..discretization import Discretization, discretize
from ..failures import is_concrete
from ..functions import canonical
from ..motion import unreached
from ..renew import NeighborSearch
from ..time.checkpoint import Checkpoint, digest
from ..time.integrate import IntegrationError, integrate
from ..time.run import planned
from .adaptation import Adaptation, changed, conserved
from .contact import Contact, parts_after, watched, without_other_parts
from .parts import File, Place, Progress, ends_of
from .problem import Moving, fitted_normals, joined, parted
from .surgery import rejoined
from .wear import Worn, uneven

# Room to find neighbours in where points are added, in units of what they need: arrays for it that
# are too short are made anew, and a program with them, which takes many times as long as to search.
_ROOM = 2.0
# Sheets that approach are looked at before a step has taken them nearer by this share of the
# distance at which they touch.
_PAST = 0.05
_BAR = "t = {n:.4g} of {total:.4g} |{bar}| {percentage:3.0f}% [{elapsed}<{remaining}]"
# Of the way that is left; a surface that cannot be followed this far is an error.
_LEAST = 1e-6
# Looks at points are due early by this share of the time between them: round-off makes none.
_EARLY = 0.01


class ClosesOverTraced(Exception):
    """What a function closes over is being differentiated or compiled: nobody can look at it."""


def followed(
    moving: Moving,
    state,
    t0,
    times,
    options,
    adapt: Adaptation | None,
    contact: Contact | None,
    checkpoint: Checkpoint | None,
    progress: bool,
) -> tuple:
    """Times, surfaces with fields, statistics and changes of an `Evolution`."""
    times, start = np.asarray(times, state[0].dtype), np.asarray(t0, state[0].dtype)
    ends, file = times[-1:], None
    if checkpoint is not None:
        ends = ends_of(start, times[-1], checkpoint.every)
        kinds = (adapt, contact)
        file = File(checkpoint, _digest(moving, state, start, times, options, kinds, checkpoint))
    run = _Run(moving, state, start, options, adapt, contact)
    saved: list = [run.saved] * len(times)
    now = Progress(np.array(0), run.place, saved, run.counts, run.changes)
    if file is not None:
        now, run.solver = file.read(now, adapt is None)
    if adapt is not None and not now.part:
        run.change(run.moving.surface)
        now = now._replace(place=run.place, changes=run.changes)
    saved = list(now.saved)
    with tqdm(total=float(times[-1] - start), disable=not progress, bar_format=_BAR) as bar:
        run.tell = lambda t: bar.update(float(t - start) - bar.n)
        for part in range(int(now.part), len(ends)):
            t, end = ends[part - 1] if part else start, ends[part]
            if file is not None:  # from nothing but what is on disk
                run.goes_on(t, now)
            here = (part == 0) & (times == t) | (times > t) & (times <= end)
            for i in [*np.flatnonzero(here), None]:
                run.to(end if i is None else times[i])
                if i is not None and not run.gone:
                    saved[i] = run.saved
            now = Progress(np.array(part + 1), run.place, saved, run.counts, run.changes)
            if run.gone:
                break
            if file is not None:
                file.write(now)
    steps, refused, renewals = map(int, now.counts)
    stats = {"steps": steps, "refused": refused, "renewals": renewals, "solver": run.solver}
    count = np.sum(times < run.t) if run.gone else len(times)
    rows = [(place.surface, parted(place.state)[1]) for place in saved[:count]]
    changes = None if adapt is None else np.asarray(now.changes)
    return jnp.asarray(times[:count]), rows, stats, changes


def _digest(moving: Moving, state, start, times, options, kinds, checkpoint: Checkpoint) -> str:
    """Of all that a run hangs on; functions by what they compute."""
    unset = dict.fromkeys(("controller", "saveat", "event", "max_steps"))
    plan = planned(moving, state, start, times[-1], **options, **unset, progress=False, throw=True)
    adapt = kinds[0]
    if adapt is not None and callable(adapt.spacing):
        known = (moving.surface, parted(state)[1], options["args"])
        kinds = (*kinds, canonical(adapt.spacing, jnp.asarray(start), *known))
    return digest((checkpoint.every, times, moving.surface.neighbors, kinds, plan.run))


class _Run:
    """A run under way: points, fields and lists now, and what it took to come here."""

    def __init__(self, moving: Moving, state, t, options, adapt, contact):
        self.moving, self.state, self.t, self.start = moving, state, t, t
        self.options, self.solver, self.gone = options, "", False
        self.adapt: Adaptation | None = adapt
        self.contact: Contact | None = contact
        self.search: NeighborSearch | None = None
        self.parts = np.full(moving.surface.n, -1)
        self.counts, self.changes = np.zeros(3, int), np.zeros((0, 6))
        self.tell: Callable = lambda t: None
        self.watch()

    def goes_on(self, t, now: Progress) -> None:
        """From what is on disk, or would be."""
        self.moving = Moving.of(now.place.surface, self.moving.motion, self.moving.on)
        self.t, self.state, self.search = t, now.place.state, None
        self.counts, self.changes = np.asarray(now.counts), np.asarray(now.changes)
        self.parts = np.full(now.place.surface.n, -1)
        self.watch()

    def watch(self) -> None:
        """Sheets that are near each other, from where lists were found."""
        surface, self.free = self.moving.surface, None
        if self.contact is not None:
            lists = surface.cloud, surface.neighbors, self.parts
            free, faced, self.parts = watched(self.contact, *lists)
            free = np.where(surface.cloud.host_active, free, np.inf)
            self.free = jnp.asarray(free, surface.cloud.points.dtype)
            self.moving = Moving.of(surface, self.moving.motion, self.moving.on, faced)

    @property
    def place(self) -> Place:
        surface = self.moving.surface
        plain = Discretization(surface.cloud, surface.neighbors, surface.method, surface.border)
        return Place(plain, self.state)

    @property
    def saved(self) -> Place:
        surface = self.now()
        if float(self.t) > float(self.start) and (surface is None or self.folds(surface)):
            # Lists or normals have ceased to serve: others may.
            before = vars(self).copy()
            try:
                self.renew()
            except ValueError:
                vars(self).update(before)
            if self.gone:
                return self.place
            surface = self.now()
        with self.when():
            surface = surface or self.moving.surface_at(self.state[0])
        fields = self.moving.fields(self.t, self.state, self.options["args"])
        return Place(surface, joined(self.state[0], fields))

    def now(self) -> Discretization | None:
        """The surface there, if there is one; what was wrong with it would have been an error."""
        with contextlib.suppress(ValueError):
            surface = self.moving.surface_at(self.state[0])
            return eqx.tree_at(lambda s: s.found, surface, None, is_leaf=lambda x: x is None)
        return None

    def folds(self, surface: Discretization) -> bool:
        """Whether a corner is about to: neighbours no longer close cells, and contact would cut."""
        if self.contact is None or not self.contact.deletes:
            return False
        return not _has_areas(surface) and _has_areas(self.moving.surface)

    def count(self, steps: int, refused: int, renewals: int) -> None:
        self.counts = self.counts + np.array([steps, refused, renewals])

    def to(self, target) -> None:
        """To a later time, with neighbours found anew and points adapted on the way."""
        end = target
        while float(self.t) < float(target) and not self.gone:
            due = self.next_change()
            end = min(end, due, self.next_look())
            surface, neighbors = self.moving.surface, self.moving.surface.neighbors
            start, adapts = surface.cloud.points, self.adapt is not None
            event = dfx.Event(Worn(start, neighbors, self.free, adapts))
            solution, reached, new = self.stretch(end, event)
            stats = solution.stats
            steps, refused = (int(stats[f"num_{kind}_steps"]) for kind in ("accepted", "rejected"))
            self.solver = stats["solver"]
            left = reached - self.t > _LEAST * (target - self.t)
            if left and (
                np.asarray(unreached(start, new[0], neighbors)).any()
                or self.may_cross(new[0])
                or (adapts and np.asarray(uneven(start, new[0], neighbors, times=2)).any())
            ):
                # The last step went farther than the neighbours serve: half of the way first.
                end = self.t + (reached - self.t) / 2
                self.count(0, steps + refused, 0)
                continue
            self.count(steps, refused, 0)
            self.t, self.state, end = reached, new, target
            self.tell(reached)
            ended = solution.result == dfx.RESULTS.event_occurred or float(reached) < float(target)
            if ended or self.next_change() > due:
                self.renew()

    def stretch(self, end, event: dfx.Event) -> tuple[dfx.Solution, Any, tuple]:
        """What came of it on the lists that there are, how far it went, and the state there."""
        given = dict(t0=self.t, t1=end, event=event, **self.options)
        try:
            solution = integrate(self.moving, self.state, **given)
        except IntegrationError as error:
            # Lists may have ceased to serve before they looked worn: others may take it farther.
            if error.time - self.t <= _LEAST * (end - self.t):
                raise
            return error.solution, np.asarray(error.time, self.t.dtype), error.state
        assert solution.ts is not None and solution.ys is not None
        ts, ys = _seen((solution.ts, solution.ys))
        last = lambda y: np.asarray(y)[-1]  # which compiles nothing
        return solution, last(ts), jax.tree.map(lambda y: on_device(last(y)), ys)

    def next_change(self):
        """When points are looked at whatever they have done: at multiples of a time from the start,
        so that neither what is saved nor parts put it off."""
        if self.adapt is None or self.adapt.every is None:
            return np.inf
        every = self.adapt.every
        passed = np.floor(float(self.t - self.start) / every + _EARLY)
        return self.start + np.asarray((passed + 1) * every, self.start.dtype)

    def next_look(self) -> float:
        """When sheets are to be looked at again, at the speed that they have now."""
        if self.contact is None or self.free is None:
            return np.inf
        velocity = _seen(_velocity(self.moving, self.t, self.state, self.options["args"]))
        speed = np.linalg.norm(np.asarray(velocity, float), axis=1)
        limit = np.asarray(self.free, float) + _PAST / 2 * float(self.contact.distance)
        return float(self.t) + np.min(limit / np.maximum(speed, np.finfo(float).tiny))

    def may_cross(self, points) -> bool:
        """Whether sheets were so near each other that they may have crossed."""
        if self.contact is None or self.free is None:
            return False
        limit = self.free + _PAST * self.contact.distance
        from_here = np.asarray(points) - np.asarray(self.moving.surface.cloud.points)
        return bool(np.any(np.sum(from_here**2, axis=1) > np.asarray(limit) ** 2))

    def renew(self) -> None:
        """Normals and neighbours found anew, and points changed."""
        surface, cloud = self.moving.surface, self.moving.cloud_at(self.state[0])
        with self.when():
            normals = fitted_normals(surface, cloud.points, cloud.normals)
            cloud = eqx.tree_at(lambda c: c.normals, cloud, normals)
            if self.search is None:
                self.search = self.room(surface)
            surface = Discretization(cloud, surface.neighbors, surface.method, surface.border)
            self.count(0, 0, 1)
            if self.adapt is None or not self.change(surface):
                self.begin(surface)

    @contextlib.contextmanager
    def when(self):
        """An error says at what time."""
        try:
            yield
        except ValueError as error:
            raise ValueError(f"at t = {float(self.t):g}: {error}") from error

    def room(self, surface: Discretization) -> NeighborSearch:
        """To find neighbours in, of points that may come to be denser."""
        margin = 1.25 if self.adapt is None else _ROOM
        lists = surface.cloud, surface.neighbors, surface.method
        return NeighborSearch.allocated(*lists, margin, known=True)

    def begin(self, surface: Discretization) -> None:
        """On a surface whose lists were found for other points."""
        cloud, found = surface.cloud, None
        if self.search is not None:
            # Where there is no room; any other error will be raised again.
            with contextlib.suppress(ValueError):
                found = surface.moved(cloud.points, cloud.normals, search=self.search)
        if found is None:
            try:
                found = discretize(cloud, method=surface.method)
            except ValueError as error:
                raise ValueError(f"neighbours could not be found anew: {error}") from error
            self.search = self.room(found)
        found = without_other_parts(found, self.contact, self.parts)
        self.moving = Moving.of(found, self.moving.motion, self.moving.on)
        self.watch()

    def change(self, surface: Discretization) -> bool:
        """Sheets that touch rejoined, points added and merged, if need be."""
        adapt, contact, args = self.adapt, self.contact, self.options["args"]
        assert adapt is not None
        old = fields = parted(self.state)[1]
        spacing, after, met = adapt.at(self.t, surface, fields, args), surface, (0, 0, 0)
        if contact is not None and contact.deletes:
            distance = float(contact.distance)
            left, fields, found = rejoined(surface, fields, distance, spacing, adapt.capacity)
            if found is not None:
                met = (found.pinched, found.joined, found.vanished)
            if left is None:
                self.gone = True
                return self.changed(0, 0, *met)
            if found is not None:
                after, spacing = left, adapt.at(self.t, left, fields, args)
        after, fields, added, merged = changed(after, fields, adapt, spacing)
        if not self.changed(added, merged, *met):
            return False
        self.parts = parts_after(self.parts, surface.cloud.points, after.cloud.points)
        self.begin(after)
        if adapt.conserve:
            fields = conserved(surface, old, self.moving.surface, fields)
        self.state = joined(after.cloud.points, fields)
        return True

    def changed(self, *count: int) -> bool:
        """Noted, if anything was."""
        if any(count):
            self.changes = np.append(self.changes, [[float(self.t), *count]], axis=0)
        return any(count)


def _seen(tree):
    """Arrays that can be looked at."""
    if not is_concrete(tree):
        raise ClosesOverTraced
    return tree


def _has_areas(surface: Discretization) -> bool:
    """Whether neighbours close all cells, as those in folds of scans do not."""
    with contextlib.suppress(ValueError):
        return surface.areas.size > 0
    return False


@eqx.filter_jit
def _velocity(moving: Moving, t, state, args) -> Float[Array, "n d"]:
    return moving.rate(t, state, args)[0]
