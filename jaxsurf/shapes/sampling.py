"""Quasi-uniform points on any surface that can be projected onto.

Everything here runs once, on the host, and chooses points; it knows the surface only through
candidates spread over it and a function `project(points) -> (points, normals)` that puts points
back on it. Points on two sheets that face opposite ways never push each other, so that thin
shells are sampled as two surfaces. `measure` is area for surfaces and length for plane curves,
and the spacing that belongs to n points is h = (measure / n)^(1 / (d - 1)).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from scipy.spatial import cKDTree

from jaxsurf.arguments import in_range, instance, on_host, raise_at, real, whole
from jaxsurf.cloud import PointCloud

AnyArray = Array | np.ndarray
Project = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]

# Points are numbered in 32 bits.
MOST = 2**31 - 1
# A maximal Poisson-disk subset of about six random candidates a point, no two closer than this
# fraction of h, has about one point per h^(d-1).
_DISK = 0.70
# Repulsion: reach in units of h, strength, and number of neighbours looked at (the two rings of
# a hexagonal pattern within the reach are 18 points, of which the outer ones hardly push).
_REACH, _STRENGTH, _NEIGHBORS = 2.0, 0.5, 16
# Neighbours are searched again after this many steps: points move little in between.
_REFRESH = 4


class Quality(NamedTuple):
    """How even a sampling is, in units of h (see `measure_quality`)."""

    spacing: float
    smallest: float
    mean: float
    hole: float | None


def ideal_spacing(measure: float, n: int, *, dim: int = 3) -> float:
    """h = (measure / n)^(1 / (d - 1)): the spacing of n points on a surface of that area.

    Example:
        >>> round(ideal_spacing(4 * np.pi, 10_000), 4)
        0.0354
    """
    return float((measure / n) ** (1 / (dim - 1)))


def points_at(spacing: float, measure: float, *, dim: int = 3) -> int:
    """How many points h apart a surface of that area holds.

    Raises:
        ValueError: more than can be numbered.

    Example:
        >>> points_at(0.1, 4 * np.pi)
        1257
    """
    with np.errstate(over="ignore", divide="ignore"):
        n = float(np.divide(measure, float(spacing) ** (dim - 1)))
    if not n <= MOST:
        raise ValueError(f"spacing = {spacing} gives n = {n:.3g} points, at most {MOST} fit")
    return round(n)


def in_blocks(function: Callable, dtype, *, rows: int = 4_096) -> Callable:
    """A compiled function of points called on blocks of one shape, so that it compiles once.

    Args:
        function: of `rows` points or numbers; returns arrays with as many rows.
        dtype: of what it is given.
        rows: in a block.

    Example:
        >>> in_blocks(lambda x: 2 * x, float, rows=3)(np.arange(5)).tolist()
        [0.0, 2.0, 4.0, 6.0, 8.0]
    """

    def call(points):
        points = np.asarray(points, dtype)
        blocks = []
        for first in range(0, max(len(points), 1), rows):
            block = points[first : first + rows]
            padding = [(0, rows - len(block))] + [(0, 0)] * (points.ndim - 1)
            result = function(jnp.asarray(np.pad(block, padding)))
            blocks.append(jax.tree.map(np.asarray, result))
        return jax.tree.map(lambda *parts: np.concatenate(parts)[: len(points)], *blocks)

    return call


def poisson_disk(
    candidates: Float[AnyArray, "m d"],
    radius: float,
    *,
    normals: Float[AnyArray, "m d"] | None = None,
    seed: int = 0,
) -> Int[np.ndarray, " kept"]:
    """A random subset of the candidates, no two closer than `radius`, that cannot be enlarged.

    Args:
        candidates: points spread over the surface, `(m, d)`; several per disk.
        radius: smallest distance between two points kept, in the units of the points.
        normals: `(m, d)`; if given, points whose normals oppose each other may be closer.
        seed: of the random order in which candidates are tried.

    Returns:
        Sorted indices of the candidates that are kept.

    Raises:
        ValueError: the radius is not positive, candidates that are not finite (named by index),
            or shapes that do not belong together.
        TypeError: arrays or numbers of other kinds.

    Example:
        >>> points = np.random.default_rng(0).random((500, 2))
        >>> kept = points[poisson_disk(points, 0.1)]
        >>> gaps = np.linalg.norm(kept[:, None] - kept[None], axis=-1) + np.eye(len(kept))
        >>> bool(gaps.min() >= 0.1)
        True
    """
    candidates = _points(candidates, "candidates")
    real(radius, "radius", above=0)
    whole(seed, "seed", least=0)
    if normals is not None:
        normals = _like(normals, candidates, "normals")
    rank = np.random.default_rng(seed).permutation(len(candidates))
    pairs = cKDTree(candidates).query_pairs(radius, output_type="ndarray")
    if normals is not None:
        pairs = pairs[_same_sheet(normals[pairs[:, 0]], normals[pairs[:, 1]])]
    earlier = rank[pairs[:, 0]] < rank[pairs[:, 1]]
    first, second = np.where(earlier, pairs.T, pairs.T[::-1])
    # All candidates that come before every rival still in the race are taken at once: the result
    # is that of trying them one by one in the order of their rank.
    kept = np.zeros(len(candidates), bool)
    racing = np.ones(len(candidates), bool)
    while racing.any():
        beaten = np.zeros(len(candidates), bool)
        beaten[second] = True
        winners = racing & ~beaten
        kept |= winners
        racing &= ~winners
        racing[second[winners[first]]] = False
        still = racing[first] & racing[second]
        first, second = first[still], second[still]
    return np.flatnonzero(kept)


def thin(
    candidates: np.ndarray, n: int, *, normals: np.ndarray | None = None, seed: int = 0
) -> np.ndarray:
    """Exactly n of the candidates, spread like a Poisson-disk sample.

    Args:
        candidates: points spread over the surface, `(m, d)`; five or more times n.
        n: how many to keep.
        normals: `(m, d)`; if given, sheets that face opposite ways are thinned independently.
        seed: of the random choice.

    Returns:
        Sorted indices, `(n,)`.

    Raises:
        ValueError: fewer candidates than n (both numbers given).

    Accuracy: smallest distance about 0.7 h (`tests/test_sampling.py::test_thin_is_a_disk_sample`).

    Example:
        >>> thin(np.random.default_rng(0).random((600, 2)), 100).shape
        (100,)
    """
    candidates = _points(candidates, "candidates")
    m, dim = candidates.shape
    if not 0 < whole(n, "n") <= m:
        raise ValueError(f"cannot choose n = {n} of {m} candidates")
    if n == m:
        return np.arange(m)
    radius = _DISK * _candidate_spacing(candidates) * (m / n) ** (1 / (dim - 1))
    best = np.arange(m)
    for attempt in range(12):
        kept = poisson_disk(candidates, radius, normals=normals, seed=seed + attempt)
        if n <= len(kept) < len(best):
            best = kept
        if n <= len(best) <= max(1.05 * n, n + 2):
            break
        radius *= (len(kept) / (1.02 * n)) ** (1 / (dim - 1))
    return _drop_closest(candidates, best, n)


def relax(
    points: np.ndarray,
    project: Project,
    *,
    spacing: float,
    steps: int = 40,
    fixed: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    r"""Even out points by short-range repulsion along the surface.

    Each step moves $x_i$ by $\tfrac h2 \sum_j (1 - r_{ij}/2h)_+^2\,(x_i - x_j)/r_{ij}$, without
    its normal part and by at most h/5, and projects it back.

    Args:
        points: on or near the surface, `(n, d)`.
        project: puts points on the surface; returns points and unit normals.
        spacing: h of these n points, see `ideal_spacing`.
        steps: how many; 40 suffice after `thin`.
        fixed: True for points that push but do not move, `(n,)`, such as those on a border.

    Returns:
        Points and normals, `(n, d)` each.

    Raises:
        ValueError: `project` cannot put a given point on the surface, named by point.

    Accuracy: after `thin`, smallest distance above 0.75 h and no hole of radius above 0.9 h
        (`tests/test_sampling.py::test_relaxed_points_are_even`).

    Example:
        >>> def project(x):
        ...     x = x / np.linalg.norm(x, axis=1, keepdims=True)
        ...     return x, x
        >>> points = np.random.default_rng(0).normal(size=(500, 3))
        >>> h = ideal_spacing(4 * np.pi, 500)
        >>> points, normals = relax(points, project, spacing=h, steps=100)
        >>> measure_quality(points, measure=4 * np.pi).smallest > 0.7
        True
    """
    real(spacing, "spacing", above=0)
    whole(steps, "steps", least=0)
    points, normals = _projected(_points(points, "points"), project)
    free = np.ones(len(points), bool) if fixed is None else ~np.asarray(fixed)
    if len(points) < 2 or not free.any():
        return points, normals
    reach = _REACH * spacing
    for step in range(steps):
        if step % _REFRESH == 0:
            k = min(_NEIGHBORS + 1, len(points))
            near = cKDTree(points).query(points[free], k=k)[1][:, 1:]
        away = points[free, None] - points[near]
        # The floor only keeps two coinciding points from dividing by zero.
        distance = np.maximum(np.linalg.norm(away, axis=-1), 1e-9 * spacing)
        push = np.maximum(1 - distance / reach, 0) ** 2 / distance
        push *= _same_sheet(normals[free, None], normals[near])
        move = _STRENGTH * spacing * np.einsum("ik,ikd->id", push, away)
        move -= normals[free] * np.sum(move * normals[free], axis=1, keepdims=True)
        length = np.maximum(np.linalg.norm(move, axis=1, keepdims=True), 1e-300)
        moved = points[free] + move * np.minimum(1, 0.2 * spacing / length)
        onto, found = (np.asarray(a, float) for a in project(moved))
        # A point moved to where the surface cannot be found again waits for the next step.
        ok = np.isfinite(onto).all(axis=1) & np.isfinite(found).all(axis=1)
        rows = np.flatnonzero(free)[ok]
        points[rows], normals[rows] = onto[ok], found[ok]
    return points, normals


def quasi_uniform(
    candidates: np.ndarray,
    n: int,
    project: Project,
    *,
    measure: float,
    normals: np.ndarray | None = None,
    fixed: tuple[np.ndarray, np.ndarray] | None = None,
    steps: int = 40,
    seed: int = 0,
) -> tuple[np.ndarray, np.ndarray]:
    """Exactly n evenly spaced points on a surface: `thin`, then `relax`.

    Args:
        candidates: points spread over the surface, `(m, d)`; five or more times n.
        n: number of points, fixed ones included.
        project: puts points on the surface; returns points and unit normals.
        measure: area of the surface (length of a curve).
        normals: of the candidates, `(m, d)`, to keep apart the sheets of a thin shell.
        fixed: points and normals, say of a border, that come first in the result, unmoved.
        steps: of relaxation.
        seed: of the random choice.

    Returns:
        Points and normals, `(n, d)` each, the fixed ones first and the others in no order.

    Raises:
        ValueError: too few candidates, or more fixed points than n.

    Accuracy: as `relax`; 10,000 points on a sphere take about a second on one core.

    Example:
        >>> def project(x):
        ...     x = x / np.linalg.norm(x, axis=1, keepdims=True)
        ...     return x, x
        >>> candidates = project(np.random.default_rng(0).normal(size=(6_000, 3)))[0]
        >>> points, _ = quasi_uniform(candidates, 1_000, project, measure=4 * np.pi)
        >>> measure_quality(points, measure=4 * np.pi).smallest > 0.75
        True
    """
    candidates = np.asarray(candidates, float)
    spacing = ideal_spacing(measure, n, dim=candidates.shape[1])
    if fixed is None or len(fixed[0]) == 0:
        chosen = thin(candidates, n, normals=normals, seed=seed)
        return relax(candidates[chosen], project, spacing=spacing, steps=steps)
    held, held_normals = (np.asarray(a, float) for a in fixed)
    if len(held) >= n:
        raise ValueError(f"{len(held)} fixed points leave none of n = {n} to place")
    distance, nearest = cKDTree(held).query(candidates)
    clear = distance >= _DISK * spacing
    if normals is not None:
        normals = np.asarray(normals, float)
        clear |= ~_same_sheet(normals, held_normals[nearest])
    candidates = candidates[clear]
    chosen = thin(
        candidates, n - len(held), normals=None if normals is None else normals[clear], seed=seed
    )
    is_held = np.arange(n) < len(held)
    points, found = relax(
        np.concatenate([held, candidates[chosen]]),
        project,
        spacing=spacing,
        steps=steps,
        fixed=is_held,
    )
    points[is_held], found[is_held] = held, held_normals
    return points, found


def jitter(
    cloud: PointCloud,
    project: Project,
    *,
    spacing: float,
    fraction: float = 0.25,
    seed: int = 0,
) -> PointCloud:
    """Move every point uniformly within a ball of a fraction of the spacing, then project back.

    The usual test of an operator on points that are uneven but not clustered. Points on the
    boundary and rows that are switched off stay.

    Args:
        cloud: n points.
        project: puts points on the surface; returns points and unit normals.
        spacing: h, see `ideal_spacing`.
        fraction: radius of the ball in units of the spacing.
        seed: of the random moves.

    Returns:
        A cloud in the same order, with the normals that `project` gives.

    Raises:
        ValueError: `spacing` not positive, `fraction` negative, or a point that `project` cannot
            put on the surface (named).
        TypeError: no cloud, or `project` is no function that returns points and normals.

    Example:
        >>> cloud = js.sphere(1_000)
        >>> h = ideal_spacing(4 * np.pi, 1_000)
        >>> moved = jitter(cloud, js.shapes.analytic.sphere_projection(), spacing=h)
        >>> bool(jnp.linalg.norm(moved.points - cloud.points, axis=1).max() <= 0.26 * h)
        True
    """
    instance(cloud, PointCloud, "cloud", "js.PointCloud(points, normals) makes one")
    real(spacing, "spacing", above=0)
    real(fraction, "fraction", least=0)
    whole(seed, "seed", least=0)
    points = on_host(cloud.points, "cloud.points")
    normals = on_host(cloud.normals, "cloud.normals")
    on = cloud.host_active
    stays = ~on
    if cloud.boundary is not None:
        stays = stays | np.asarray(cloud.boundary)
    # Not the stream of `default_rng(seed)`, from which the points themselves may have come.
    rng = np.random.default_rng((seed, 1))
    direction = rng.normal(size=points[on].shape)
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    length = fraction * spacing * rng.random((len(direction), 1)) ** (1 / cloud.dim)
    moved = points.copy()
    moved[on] += length * direction
    points[~stays], normals[~stays] = _projected(moved[~stays], project)
    x = jnp.asarray(points, cloud.points.dtype)
    new = PointCloud(x, jnp.asarray(normals), active=cloud.active)
    return eqx.tree_at(lambda c: (c.points, c.normals), cloud, (new.points, new.normals))


def measure_quality(
    points: Float[AnyArray, "n d"],
    *,
    measure: float,
    normals: Float[AnyArray, "n d"] | None = None,
    probes: Float[AnyArray, "q d"] | None = None,
) -> Quality:
    """Smallest and mean distance to the nearest neighbour, and the largest hole, over h.

    A hexagonal pattern has 1.07, 1.07 and 0.62.

    Args:
        points: `(n, d)`.
        measure: area of the surface (length of a curve).
        normals: `(n, d)`; if given, neighbours that face the opposite way do not count.
        probes: many points on the surface; the hole is the largest distance from a probe to its
            nearest point. None leaves it out.

    Example:
        >>> q = measure_quality(js.sphere(1_000).points, measure=4 * np.pi)
        >>> q.smallest > 0.85
        True
    """
    points = np.asarray(points, float)
    spacing = ideal_spacing(measure, len(points), dim=points.shape[1])
    tree = cKDTree(points)
    distance, near = tree.query(points, k=min(len(points), 2 if normals is None else 9))
    if normals is not None:
        normals = np.asarray(normals, float)
        distance = np.where(_same_sheet(normals[:, None], normals[near]), distance, np.inf)
    nearest = distance[:, 1:].min(axis=1) / spacing
    hole = None if probes is None else float(tree.query(np.asarray(probes))[0].max() / spacing)
    return Quality(spacing, float(nearest.min()), float(nearest.mean()), hole)


def _same_sheet(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.sum(a * b, axis=-1) > 0


def _points(values, name: str) -> np.ndarray:
    points = on_host(values, name)
    if points.ndim != 2 or points.shape[1] not in (2, 3):
        raise ValueError(f"{name} must have shape (m, 2) or (m, 3), not {points.shape}")
    raise_at(~np.isfinite(points).all(axis=1), f"{name}: point {{i}} is not finite: {{v}}", points)
    return in_range(points, name)


def _like(values, points: np.ndarray, name: str) -> np.ndarray:
    array = on_host(values, name)
    if array.shape != points.shape:
        raise ValueError(f"{name} have shape {array.shape}, expected {points.shape}")
    return array


def _projected(points: np.ndarray, project: Project) -> tuple[np.ndarray, np.ndarray]:
    if not callable(project):
        raise TypeError(f"project is a {type(project).__name__}, expected a function")
    result = project(points)
    if not (isinstance(result, tuple) and len(result) == 2):
        raise TypeError("project must return a pair: points and unit normals")
    onto = _like(result[0], points, "the points that project returns")
    normals = _like(result[1], points, "the normals that project returns")
    finite = np.isfinite(onto).all(axis=1) & np.isfinite(normals).all(axis=1)
    raise_at(~finite, "projection failed for point {i} at {v}", points)
    return onto, normals


def _candidate_spacing(candidates: np.ndarray) -> float:
    """(measure / m)^(1 / (d - 1)) of m random candidates, guessed from a part of them."""
    dim, k = candidates.shape[1], min(16, len(candidates) - 1)
    some = candidates[:: max(1, len(candidates) // 2000)]
    radius = np.median(cKDTree(candidates).query(some, k=k + 1)[0][:, -1])
    ball = 2 * radius if dim == 2 else np.pi * radius**2
    extent = float(np.ptp(candidates, axis=0).max())
    return max(float((ball / k) ** (1 / (dim - 1))), 1e-9 * extent)


def _drop_closest(candidates: np.ndarray, kept: np.ndarray, n: int) -> np.ndarray:
    """Leave out one of each of the closest pairs, never two that share a neighbour, until n."""
    while len(kept) > n:
        distance, near = cKDTree(candidates[kept]).query(candidates[kept], k=2)
        held = np.zeros(len(kept), bool)
        dropped: list[int] = []
        for i in np.argsort(distance[:, 1], kind="stable"):
            if len(dropped) == len(kept) - n:
                break
            if not held[i]:
                dropped.append(i)
                held[near[i]] = True
        kept = np.delete(kept, dropped)
    return kept
