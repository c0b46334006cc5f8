"""Closed level sets {phi = 0} sampled on the host; the choice of points is not differentiated."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxsurf.arguments import real, whole
from jaxsurf.cloud import PointCloud
from jaxsurf.compiling import block_by_block
from jaxsurf.functions import Traced
from jaxsurf.shapes.implicit import Bounds, LevelSet, level_set_normals, program_of
from jaxsurf.shapes.order import sort_points
from jaxsurf.shapes.sampling import quasi_uniform
from jaxsurf.shapes.spacing import MOST, points_at
from jaxsurf.shapes.topology import Sides, checked_bounds

# Cells along the longest side of a box.
RESOLUTION = 48
# Steps of relaxation, in the plane and in space.
_RELAXED = {2: 200, 3: 40}
# Newton steps along a ray at most, and how many widths of the band a candidate may stray.
_STEPS, _STRAY = 30, 10


def level_set(
    phi: LevelSet,
    *,
    bounds: Bounds,
    n: int | None = None,
    spacing: float | None = None,
    resolution: int = RESOLUTION,
    steps: int | None = None,
    seed: int = 0,
) -> PointCloud:
    r"""Quasi-uniform points on the closed level set {phi = 0}, with exact normals.

    Random points in a band around the surface are moved onto it along the gradient of phi,
    thinned to n, and evened out by repulsion with re-projection; the area follows from the share
    of random points that fell into the band. Normals are $\nabla\phi/|\nabla\phi|$, so they
    point outwards where phi grows outwards. Runs on the host; the choice of points is not
    differentiable (use `project_to_level_set` on the result).

    Args:
        phi: function of one point `(d,)` that JAX can differentiate; d = 2 or 3 by `bounds`.
        bounds: lower and upper corner of a box that holds the whole level set.
        n: number of points; or give `spacing`.
        spacing: h, for n = area / h² points (length / h on a curve).
        resolution: cells along the longest side of the box in the search for the surface; parts
            thinner than a cell can be missed.
        steps: of relaxation; None for 40 on surfaces and 200 on curves.
        seed: of the random choice.

    Returns:
        Cloud of n points sorted along a space-filling curve.

    Accuracy: smallest distance above 0.75 h, holes below 0.9 h
        (`tests/test_shapes.py::test_level_set_is_even`); points on the level set to round-off. In
    float32 points are within 3e-6 of a unit sphere, normals within 1e-5 (`tests/test_shapes.py`).
    Raises:
        ValueError: no level set within the bounds, a level set that leaves them, a vanishing
            gradient on it, or not exactly one of n and spacing.

    Example:
        >>> cloud = js.level_set(lambda x: x @ x - 1, n=500, bounds=((-1.2,) * 3, (1.2,) * 3))
        >>> bool(jnp.abs(cloud.normals - cloud.points).max() < 1e-12)
        True
    """
    box = checked_bounds(bounds)
    dim = box.shape[1]
    if (n is None) == (spacing is None):
        raise ValueError("give exactly one of n and spacing")
    whole(resolution, "resolution", least=4, most=1_000)
    whole(seed, "seed", least=0)
    if steps is not None:
        whole(steps, "steps", least=0)
    if spacing is not None:
        real(spacing, "spacing", above=0)
    elif whole(n, "n", most=MOST) < 4:
        raise ValueError(f"n = {n} points, needs at least 4")
    look = watched(phi, dim)[1]
    sides = Sides.of(lambda x: look(x)[0], box, resolution)
    if n is None:
        measure = _candidates(look, sides, 50_000, seed)[2]
        n = points_at(spacing, measure, dim=dim)  # type: ignore[arg-type]
        if n < 4:
            raise ValueError(f"spacing = {spacing} gives n = {n} points, needs at least 4")
    return spread(phi, look, sides, n, steps=steps, seed=seed)


def watched(phi: LevelSet, dim: int) -> tuple[Callable, Callable]:
    """Values of phi, and values with gradients, of points on the host."""
    dtype = jnp.result_type(float)
    program = program_of(phi, jax.ShapeDtypeStruct((dim,), dtype))
    compiled = lambda f: block_by_block(partial(f, program), dtype)
    return compiled(_values), compiled(_values_and_gradients)


def spread(
    phi: LevelSet,
    look: Callable,
    sides: Sides,
    n: int,
    *,
    on: Callable[[np.ndarray], np.ndarray] | None = None,
    steps: int | None = None,
    seed: int = 0,
) -> PointCloud:
    """n points on a level set, or on those of its sheets that `on` says.

    Args:
        phi: the function.
        look: its values and gradients, on the host.
        sides: its signs on a grid.
        on: which of some points are on sheets that get points; None for all.
        steps, seed: as of `level_set`.
    """
    dim = len(sides.size)
    candidates, normals, measure = _candidates(look, sides, max(6 * n, 5_000), seed)
    if on is not None:
        kept = on(candidates)
        candidates, normals = candidates[kept], normals[kept]
        measure *= kept.mean()
    if len(candidates) < n:
        raise ValueError(f"only {len(candidates)} candidates for n = {n} points: finer resolution?")
    # Between steps of relaxation points need not be closer to the surface than this.
    rough = 1e-3 * (measure / n) ** (1 / (dim - 1))
    points, _ = quasi_uniform(
        candidates,
        n,
        lambda x: _onto(look, x, rough),
        measure=measure,
        normals=normals,
        steps=steps if steps is not None else _RELAXED[dim],
        seed=seed,
    )
    points = _onto(look, points)[0]
    chosen = jnp.asarray(points[sort_points(points)])
    return PointCloud(chosen, level_set_normals(phi, chosen))


def double_torus(thickness: float | Float[Array, ""] = 0.4) -> tuple[LevelSet, Bounds]:
    r"""A smooth closed surface of genus two, and bounds that hold it.

    Two tori of radii 1 and `thickness`, centres 2.2 apart, joined smoothly:
    $\phi = -k\log(e^{-T_+/k} + e^{-T_-/k})$ with k = 0.3 and
    $T_\pm = ((|y|^2 + 1 - r^2)^2 - 4(y_1^2 + y_2^2))/8r$ about either centre: polynomials, so
    that phi is smooth everywhere, and close to the distance near the surface. Its reach (the
    distance within which the closest point is unique) is 7.1 h for 10,000 points at the default
    thickness, so stencils of radius 4 h see a single sheet.

    Args:
        thickness: radius r of the tubes, between 0.3 and 0.55; may be traced.

    Returns:
        phi, and bounds for `level_set` that do not depend on the thickness.

    Differentiable: in the thickness.
    Raises:
        ValueError: thickness outside that range, where concrete.

    Example:
        >>> phi, bounds = js.double_torus(0.4)
        >>> cloud = js.level_set(phi, n=1_000, bounds=bounds)
        >>> def width(thickness):
        ...     phi, _ = js.double_torus(thickness)
        ...     return js.project_to_level_set(phi, cloud.points)[:, 0].max()
        >>> bool(0.9 < jax.grad(width)(0.4) < 1.1)
        True
    """
    # An array, not a constant of the program: other thicknesses run what is compiled.
    radius = jnp.asarray(real(thickness, "thickness", least=0.3, most=0.55), jnp.result_type(float))

    def phi(x):
        thickness = radius.astype(x.dtype)

        def torus(centre):
            y = x - jnp.array([centre, 0.0, 0.0], x.dtype)
            tube = (y @ y + 1 - thickness**2) ** 2 - 4 * (y[0] ** 2 + y[1] ** 2)
            return tube / (8 * thickness)

        smoothing = 0.3
        tubes = jnp.stack([torus(1.1), torus(-1.1)])
        return -smoothing * jax.nn.logsumexp(-tubes / smoothing)

    return phi, ((-2.9, -1.9, -1.0), (2.9, 1.9, 1.0))


@eqx.filter_jit
def _values(phi: Traced, points):
    return jax.vmap(phi)(points)


@eqx.filter_jit
def _values_and_gradients(phi: Traced, points):
    return jax.vmap(jax.value_and_grad(phi))(points)


def _onto(look, start: np.ndarray, limit: float | None = None, *, most: float = np.inf):
    """As `project_to_level_set`, on the host: points and normals, NaN where there are none.

    Args:
        look: values and gradients of phi.
        start: where the rays begin.
        limit: a shorter Newton step is the last; None for that of `project_to_level_set`.
        most: points further than this along their rays are given up.
    """
    if limit is None:
        eps = float(jnp.finfo(jnp.result_type(float)).eps)
        limit = eps ** (2 / 3) * np.abs(start).max(initial=eps)
    found, normals = np.full(start.shape, np.nan), np.full(start.shape, np.nan)
    with np.errstate(divide="ignore", invalid="ignore"):
        value, gradient = look(start)
        length = np.linalg.norm(gradient, axis=1)
        ray, t = gradient / length[:, None], -value / length
        left = np.flatnonzero(np.abs(t) <= most)
        gradient, step = gradient[left], t[left]
        for _ in range(_STEPS):
            done = np.abs(step) <= limit
            rows = left[done]
            found[rows] = start[rows] + t[rows, None] * ray[rows]
            length = np.linalg.norm(gradient[done], axis=1, keepdims=True)
            normals[rows] = gradient[done] / length
            left = left[~done & (np.abs(t[left]) <= most)]
            if not left.size:
                break
            value, gradient = look(start[left] + t[left, None] * ray[left])
            step = -value / np.sum(gradient * ray[left], axis=1)
            t[left] += step
    return found, normals


def _candidates(look, sides: Sides, m: int, seed: int):
    """At least about m points spread evenly over the surface, their normals, and its area."""
    rng = np.random.default_rng(seed)
    cells, size, box = sides.crossed_cells(), sides.size, sides.box
    dim = len(size)
    # Uniform in the band |distance| <= width means uniform over the surface, up to (width x
    # curvature)²; the dilated cells hold that band. About a sixth of each cell layer is in it.
    width = 0.5 * size.min()
    each = max(1, round(m * 4 * size.max() / size.min() / len(cells)))
    start = (cells[:, None] + size * rng.random((len(cells), each, dim))).reshape(-1, dim)
    points, normals = _onto(look, start, most=_STRAY * width)
    reached = np.isfinite(points).all(axis=1) & np.isfinite(normals).all(axis=1)
    near = np.zeros(len(start), bool)
    near[reached] = np.linalg.norm(points[reached] - start[reached], axis=1) <= width
    points, normals = points[near], normals[near]
    measure = float(near.sum() / each * size.prod() / (2 * width))
    outside = (points < box[0]) | (points > box[1])
    if outside.any():
        axis = int(np.argmax(outside.any(axis=0)))
        raise ValueError(f"the level set leaves the bounds along axis {axis}: give larger bounds")
    return points, normals, measure
