r"""Points added in holes and merged where they crowd, with fields on them."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, Int, PyTree
from scipy.spatial import cKDTree

from ..arguments import as_float, finite, flag, instance, real, switched_off, whole
from ..compiling import on_device
from ..discretization import Discretization, discretize
from ..failures import needs_values, raise_at, warn
from ..interpolation import interpolated
from .holes import border_gaps, close_pairs, fillings
from .rows import Rows, compact, exchanged

# Each round fills the largest holes that do not touch, so the number of points may triple in it.
_ROUNDS = 30
# Of the polynomials where those of the operators swing.
_LOWER = 2


class Adaptation(eqx.Module):
    r"""How far points are to be apart: where they are added, and where they are merged.

    A hole is an empty circle through points whose centre is inside their triangle (on plane curves
    a gap). A point goes into each, on the local polynomial surface of the operators' degree; two
    points that are too close become one between them. Fields are interpolated by the same
    polynomials. Points of a border stay where they are, and new ones go into its gaps, on the curve
    through those that there are.

    Args:
        spacing: distance h between neighbours, in length: a cloud has about area / h² points. A
            number, or a function `(t, surface, fields, args) -> (n,)` of operations of JAX.
        hole: radius of the largest empty circle, in spacings.
        closest: distance at which two points become one, in spacings.
        every: the longest time between two looks; besides, there is one whenever a neighbourhood
            has been stretched or has shrunk by 15 %, or two points have neared by 30 %. For
            spacings that change in time.
        conserve: add a constant to each field after each change, so that its integral stays.
        capacity: most points there may be, in arrays that have this length from the start, so that
            nothing compiles on the way. None: they grow by half, or more, when they are full.

    Raises:
        TypeError: a spacing that is no number or function; other arguments that are no numbers.
        ValueError: a spacing, hole, closest distance, time or capacity that is not positive; holes
            so small that points in them would be too close.
    Source: Suchde and Kuhnert 2019, Sections 3.4 and 3.5 (there 0.45 and 0.2 of a smoothing length,
        which is two spacings here); new points are on local polynomials instead of eqs. 8 and 9.

    Example:
        >>> adaptation = js.Adaptation(spacing=0.15)
        >>> grow = js.Motion(lambda t, surface, fields, args: surface.cloud.normals)
        >>> run = js.evolve(grow, js.sphere(600), t1=0.5, adapt=adaptation)
        >>> run.clouds[-1].n > 1000, run.stats["renewals"] > 0
        (True, True)
    """

    spacing: Float[Array, ""] | Callable
    hole: float = eqx.field(static=True)
    closest: float = eqx.field(static=True)
    every: float | None = eqx.field(static=True)
    conserve: bool = eqx.field(static=True)
    capacity: int | None = eqx.field(static=True)

    def __init__(
        self,
        spacing: ArrayLike | Callable,
        *,
        hole: float = 0.9,
        closest: float = 0.4,
        every: float | None = None,
        conserve: bool = False,
        capacity: int | None = None,
    ):
        self.spacing = (
            spacing if callable(spacing) else jnp.asarray(real(spacing, "spacing", above=0))
        )
        self.hole = float(real(hole, "hole", above=0))
        self.closest = float(real(closest, "closest", above=0))
        if self.closest > 0.75 * self.hole:
            raise ValueError(
                f"closest = {self.closest:g}, expected at most {0.75 * self.hole:g}, "
                "three quarters of hole: points put into holes would be merged again"
            )
        self.every = None if every is None else float(real(every, "every", above=0))
        self.conserve = flag(conserve, "conserve")
        self.capacity = None if capacity is None else whole(capacity, "capacity", least=1)

    def at(self, t, surface: Discretization, fields, args) -> Float[np.ndarray, " n"]:
        """The spacing wanted at each point."""
        if not callable(self.spacing):
            return np.full(surface.n, float(self.spacing))
        given = as_float(self.spacing(t, surface, fields, args), "spacing", (surface.n,), ())
        h, on = np.broadcast_to(np.asarray(given, float), surface.n), surface.cloud.host_active
        text = "the spacing wanted at point {i} is {v}, expected a positive number"
        raise_at(on & ~((h > 0) & np.isfinite(h)), text, h)
        return np.where(on, h, 1.0)


class Adapted(NamedTuple):
    """A surface with other points, made by `adapt_points`.

    Args:
        surface: with its neighbours found anew.
        fields: on it.
        added, merged: how many points were put into holes, how many pairs became one.

    Example:
        >>> js.adapt_points(js.discretize(js.sphere(500)), js.Adaptation(spacing=1.0)).added
        0
    """

    surface: Discretization
    fields: PyTree[Array]
    added: int
    merged: int


def adapt_points(
    surface: Discretization,
    adaptation: Adaptation,
    fields: PyTree[Array] = (),
    *,
    t: ArrayLike = 0.0,
    args: Any = None,
) -> Adapted:
    r"""Add and merge points until no hole and no crowd is left.

    Args:
        surface: from `discretize`.
        adaptation: the spacing wanted.
        fields: on the surface, `(n, *c)`, or several as a tuple.
        t, args: handed to a spacing that is a function.

    Returns:
        `surface`, `fields`, `added`, `merged`. Rows that were switched off are gone.

    Accuracy: new points are off the surface by $O(h^{p+1})$ with p the degree of the method's
        polynomials, as `Discretization.interpolate` of smooth fields
        (`tests/test_adaptation.py::test_corrected_points_are_nearer_and_local_surfaces_better`);
        in float32 within 1e-5.
    Not differentiable: which points there are is decided on the host.
    Raises:
        TypeError: arguments of other kinds.
        ValueError: a traced surface; fields of another shape or not finite; more points than the
            capacity, or too few to fit polynomials; holes that are left after 30 rounds.
    Source: as `Adaptation`.

    Example:
        >>> surface = js.discretize(js.sphere(500), method=js.GFDM(degree=4))
        >>> finer, u, added, merged = js.adapt_points(
        ...     surface, js.Adaptation(spacing=0.1), surface.cloud.points[:, 2]
        ... )
        >>> bool(jnp.abs(u - finer.cloud.points[:, 2]).max() < 1e-3), finer.n > 1000, merged
        (True, True, 0)
    """
    instance(surface, Discretization, "surface", "js.discretize(cloud) makes one")
    checked_adaptation(adaptation, surface)
    field = lambda u: finite(
        as_float(u, "fields", (surface.n, ...)), "fields", surface.cloud.active
    )
    fields = jax.tree.map(field, fields)
    spacing = adaptation.at(t, surface, fields, args)
    after, new, added, merged = changed(surface, fields, adaptation, spacing)
    if not added + merged:
        kept = (surface, fields) if surface.cloud.active is None else compact(surface, fields)
        return Adapted(*kept, 0, 0)
    after, new = compact(after, new)
    after = discretize(after.cloud, method=surface.method)
    if adaptation.conserve:
        new = conserved(surface, fields, after, new)
    return Adapted(after, new, added, merged)


def checked_adaptation(adaptation: Any, surface: Discretization) -> None:
    """Refuse what is none, and surfaces that are traced."""
    instance(adaptation, Adaptation, "adapt", "js.Adaptation(spacing=...)")
    needs_values("the surface whose points are adapted", surface)


def changed(
    surface: Discretization,
    fields: PyTree[Array],
    adaptation: Adaptation,
    spacing: Float[np.ndarray, " n"],
) -> tuple[Discretization, PyTree[Array], int, int]:
    """A surface with lists of the usual size and its fields, in longer arrays if need be."""
    rows, added, merged = Rows.of(surface, fields, spacing), 0, 0
    for _ in range(_ROUNDS):
        found = _sought(surface, rows, adaptation)
        pairs = found.pairs
        if not len(pairs) + len(found.feet) + len(found.holes):
            return surface, rows.fields, added, merged
        try:
            coming = _placed(surface, rows, found, adaptation.closest)
        except ValueError as error:
            left = int(surface.cloud.host_active.sum())
            raise ValueError(
                f"no points can be added or merged where {left} are left: the spacing wanted may "
                f"be too large for the surface and the degree of its method ({error})"
            ) from error
        new = len(coming.points) - len(pairs)
        if not len(pairs) + new:
            return surface, rows.fields, added, merged
        added, merged = added + new, merged + len(pairs)
        surface, rows = exchanged(surface, rows, pairs.ravel(), coming, adaptation.capacity)
    raise ValueError(
        f"{new} holes and {len(pairs)} crowded pairs of points are left after {_ROUNDS} "
        "rounds: the spacing wanted may change too much between neighbours"
    )


class _Sought(NamedTuple):
    """Where points are to change.

    Args:
        pairs: that crowd, the one that stays first.
        feet, normals: places in the gaps of a border.
        holes: places near holes inside.
        spacing: wanted in the gaps, then in the holes.
    """

    pairs: Int[np.ndarray, "m 2"]
    feet: Float[np.ndarray, "b d"]
    normals: Float[np.ndarray, "b d"]
    holes: Float[np.ndarray, "h d"]
    spacing: Float[np.ndarray, " m"]


def _sought(surface: Discretization, rows: Rows, adaptation: Adaptation) -> _Sought:
    cloud, lists, border = surface.cloud, surface.neighbors, surface.border
    spacing, rank = np.asarray(rows.spacing), np.asarray(rows.rank)
    feet, normals, wide = np.zeros((0, cloud.dim)), np.zeros((0, cloud.dim)), np.zeros(0)
    radius = adaptation.hole * spacing
    if border is not None and cloud.dim == 3:
        feet, normals, wide = border_gaps(cloud, border, radius)
    pairs = close_pairs(cloud, lists, adaptation.closest * spacing, rank)
    holes, size = fillings(cloud, lists, radius)
    wanted = np.concatenate([wide, size]) / adaptation.hole
    return _Sought(pairs, feet, normals, holes, wanted)


def _placed(surface: Discretization, rows: Rows, found: _Sought, closest: float) -> Rows:
    """One point for each pair, and one for each gap and hole."""
    cloud, x, rank = surface.cloud, np.asarray(rows.points), np.asarray(rows.rank)
    pairs, edge = found.pairs, slice(len(found.pairs), len(found.pairs) + len(found.feet))
    # What is on a border stays where it is.
    stays = rank[pairs[:, :1]] > 0
    kept = np.where(stays, x[pairs[:, 0]], np.mean(x[pairs], axis=1))
    at = np.concatenate([kept, found.feet, found.holes])
    arrays = cloud.points, cloud.normals, rows.fields
    made = _interpolated(surface, surface.method.polynomial_degree, at, arrays)
    # Where the points do not resolve a surface its polynomials swing, the more the higher their
    # degree, and a point that lands on another would be merged with it, and come again.
    tree, near = cKDTree(x[cloud.host_active]), closest * found.spacing[len(found.feet) :]
    lands = lambda points: edge.stop + np.flatnonzero(tree.query(points[edge.stop :])[0] < near)
    left = swung = lands(made[0])
    if len(swung):
        lower = _interpolated(surface, _LOWER, at[swung], arrays)
        made = jax.tree.map(functools.partial(_replaced, swung), made, lower)
        left = lands(made[0])
    if len(left):
        warn(
            f"{len(left)} holes are left, the first at {at[left[0]].round(4)}: local polynomials "
            "lead from there to points that there are, so the surface is not resolved there"
        )
    points, normals, fields = made
    points[edge], normals[edge] = found.feet, found.normals
    merged = np.minimum(*np.asarray(rows.spacing)[pairs].T)
    spacing = np.concatenate([merged, found.spacing]).astype(rows.spacing.dtype)
    ranks = np.zeros(len(at), rank.dtype)
    ranks[: len(pairs)], ranks[edge] = rank[pairs[:, 0]], 1
    some = np.setdiff1d(np.arange(len(at)), left)
    coming = (points, normals, fields, spacing, ranks)
    return Rows(*jax.tree.map(lambda u: on_device(u[some]), coming))


def conserved(before: Discretization, old, after: Discretization, new) -> PyTree[Array]:
    """Fields with a constant added, so that their integrals are what they were."""
    area = jnp.sum(after.areas)

    def corrected(u, v):
        lost = before.integrate(u) - after.integrate(v)
        return switched_off(after.cloud.active, v + (lost / area).astype(v.dtype))

    return jax.tree.map(corrected, old, new)


def _interpolated(surface: Discretization, degree: int, at, arrays) -> PyTree[np.ndarray]:
    """Points, normals and fields at some places above the surface, in one go.

    In NumPy where their number counts: nothing is compiled for it.
    """
    leaves, structure = jax.tree.flatten(arrays)
    together = np.concatenate([np.asarray(u).reshape(len(u), -1) for u in leaves], axis=1)
    cloud, count = surface.cloud, len(at)
    places = on_device(at.astype(cloud.points.dtype))
    found = interpolated(cloud, surface.neighbors, degree, places, on_device(together))
    parts = np.split(np.array(found), np.cumsum([u.size // len(u) for u in leaves])[:-1], axis=1)
    parts = [v.reshape(count, *u.shape[1:]).astype(u.dtype) for u, v in zip(leaves, parts)]
    points, normals, fields = jax.tree.unflatten(structure, parts)
    return points, normals / np.linalg.norm(normals, axis=1, keepdims=True), fields


def _replaced(rows: np.ndarray, values: np.ndarray, new: np.ndarray) -> np.ndarray:
    values[rows] = new
    return values
