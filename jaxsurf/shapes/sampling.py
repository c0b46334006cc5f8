"""Quasi-uniform points on any surface that can be projected onto.

Everything here runs once, on the host, and chooses points; it knows the surface only through
candidates spread over it and a function `project(points) -> (points, normals)` that puts points
back on it. Points on two sheets that face opposite ways never push each other, so that thin
shells are sampled as two surfaces. `measure` is area for surfaces and length for plane curves,
and the spacing that belongs to n points is h (`ideal_spacing`).
"""

from __future__ import annotations

from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from scipy.spatial import cKDTree

from jaxsurf.arguments import instance, on_host, real, whole
from jaxsurf.cloud import PointCloud
from jaxsurf.failures import not_finite, raise_at
from jaxsurf.shapes.spacing import ideal_spacing, same_sheet
from jaxsurf.shapes.thinning import DISK, checked_points, thin

Project = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]

# Repulsion: reach in units of h, strength, and number of neighbours looked at (the two rings of
# a hexagonal pattern within the reach are 18 points, of which the outer ones hardly push).
_REACH, _STRENGTH, _NEIGHBORS = 2.0, 0.5, 16
# Neighbours are searched again after this many steps: points move little in between.
_REFRESH = 4


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
        >>> js.shapes.spacing.measure_quality(points, measure=4 * np.pi).smallest > 0.7
        True
    """
    real(spacing, "spacing", above=0)
    whole(steps, "steps", least=0)
    points, normals = _projected(checked_points(points, "points"), project)
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
        push *= same_sheet(normals[free, None], normals[near])
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
        >>> js.shapes.spacing.measure_quality(points, measure=4 * np.pi).smallest > 0.75
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
    clear = distance >= DISK * spacing
    if normals is not None:
        normals = np.asarray(normals, float)
        clear |= ~same_sheet(normals, held_normals[nearest])
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
        spacing: h, as a rule (area / n)^(1/2), of curves length / n.
        fraction: radius of the ball in units of the spacing.
        seed: of the random moves.

    Returns:
        A cloud in the same order, with the normals that `project` gives.

    Accuracy: in float32 points are within 1e-6 of a unit sphere (`tests/test_io.py`).
    Raises:
        ValueError: `spacing` not positive, `fraction` negative, or a point that `project` cannot
            put on the surface (named).
        TypeError: no cloud, or `project` is no function that returns points and normals.

    Example:
        >>> cloud = js.sphere(1_000)
        >>> h = (4 * jnp.pi / 1_000) ** 0.5
        >>> def project(points):
        ...     normals = points / jnp.linalg.norm(points, axis=1, keepdims=True)
        ...     return normals, normals
        >>> moved = js.jitter(cloud, project, spacing=h)
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


def _projected(points: np.ndarray, project: Project) -> tuple[np.ndarray, np.ndarray]:
    if not callable(project):
        raise TypeError(f"project is a {type(project).__name__}, expected a function")
    result = project(points)
    if not (isinstance(result, tuple) and len(result) == 2):
        raise TypeError("project must return a pair: points and unit normals")
    onto = on_host(result[0], "the points that project returns", points.shape)
    normals = on_host(result[1], "the normals that project returns", points.shape)
    bad = not_finite(onto) | not_finite(normals)
    raise_at(bad, "projection failed for point {i} at {v}", points)
    return onto, normals
