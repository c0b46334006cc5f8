"""Level sets {phi = 0} of any JAX function: sampling, projection, exact normals and curvature.

Sampling chooses points once, on the host, and is not differentiated. Their position is: rebuild
it from the chosen points with `project_to_level_set` and `level_set_normals` under `jax.grad`,
and derivatives with respect to everything that `phi` depends on follow.
"""

from __future__ import annotations

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float
from scipy import ndimage

from jaxsurf.arguments import is_concrete, raise_at
from jaxsurf.cloud import PointCloud
from jaxsurf.shapes.order import sort_points
from jaxsurf.shapes.sampling import Project, quasi_uniform

LevelSet = Callable[[Float[Array, " d"]], Float[Array, ""]]
Bounds = tuple[tuple[float, ...], tuple[float, ...]]

# Rows handed to a compiled function at a time: one shape, hence one compilation, for the grid,
# the candidates and the relaxed points alike.
_CHUNK = 16_384


def level_set(
    phi: LevelSet,
    *,
    bounds: Bounds,
    n: int | None = None,
    spacing: float | None = None,
    resolution: int = 48,
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
        (`tests/test_shapes.py::test_level_set_is_even`); points on the level set to round-off.
    Raises:
        ValueError: no level set within the bounds, a level set that leaves them, a vanishing
            gradient on it, or not exactly one of n and spacing.

    Example:
        >>> cloud = level_set(lambda x: x @ x - 1, n=500, bounds=((-1.2,) * 3, (1.2,) * 3))
        >>> bool(jnp.abs(cloud.normals - cloud.points).max() < 1e-12)
        True
    """
    box = _checked_bounds(bounds)
    dim = box.shape[1]
    if (n is None) == (spacing is None):
        raise ValueError("give exactly one of n and spacing")
    if spacing is not None and not spacing > 0:
        raise ValueError(f"spacing is {spacing}, expected a positive number")
    if n is not None and n < 4:
        raise ValueError(f"n = {n} points, needs at least 4")
    if resolution < 4:
        raise ValueError(f"resolution = {resolution} cells, needs at least 4")
    dtype = jnp.result_type(float)

    def onto(points):
        found = project_to_level_set(phi, points, throw=False)
        return found, level_set_normals(phi, found)

    values = _in_chunks(jax.jit(jax.vmap(phi)), dtype)
    project: Project = _in_chunks(jax.jit(onto), dtype)

    cells, size = _crossed_cells(values, box, resolution)
    if n is None:
        measure = _candidates(project, cells, size, box, 50_000, seed)[2]
        n = round(measure / spacing ** (dim - 1))  # type: ignore[operator]
        if n < 4:
            raise ValueError(f"spacing = {spacing} gives n = {n} points, needs at least 4")
    candidates, normals, measure = _candidates(project, cells, size, box, max(6 * n, 5_000), seed)
    if len(candidates) < n:
        raise ValueError(f"only {len(candidates)} candidates for n = {n} points: finer resolution?")
    points, _ = quasi_uniform(
        candidates,
        n,
        project,
        measure=measure,
        normals=normals,
        steps=steps if steps is not None else (40 if dim == 3 else 200),
        seed=seed,
    )
    points = points[sort_points(points)]
    return PointCloud(jnp.asarray(points), level_set_normals(phi, jnp.asarray(points)))


def project_to_level_set(
    phi: LevelSet,
    points: Float[Array, "n d"],
    *,
    tolerance: float | None = None,
    max_steps: int = 30,
    throw: bool = True,
) -> Float[Array, "n d"]:
    r"""Move points onto {phi = 0} along the straight line through each in the direction of ∇phi.

    $x = y + t\,g$ with $g = \nabla\phi(y)/|\nabla\phi(y)|$ and $\phi(y + t g) = 0$, solved by
    Newton's method in t.

    Args:
        phi: function of one point `(d,)`; may depend on traced parameters.
        points: near the level set, `(n, d)`: within the distance at which lines along the
            gradient still meet it.
        tolerance: a last Newton step longer than this is a failure, in the units of the points;
            None for eps^(2/3) times the largest coordinate.
        max_steps: of Newton's method.
        throw: raise where it fails; if False, and under `jit` and `grad`, such points are NaN.

    Returns:
        Points on the level set, `(n, d)`, to round-off.

    Differentiable: forward and reverse and to any order, in `points` and in everything that
        `phi` depends on, by the implicit function theorem: the iteration is not unrolled. A point
        that starts on the surface moves by −∂phi ∇phi/|∇phi|² per unit of a parameter.
    Raises:
        ValueError: no convergence, or ∇phi = 0, named by point, on concrete arrays.

    Example:
        >>> def height(radius):
        ...     points = jnp.array([[0.6, 0.0, 0.8]])
        ...     return project_to_level_set(lambda x: x @ x - radius**2, points)[0, 2]
        >>> bool(jnp.isclose(jax.grad(height)(1.0), 0.8))
        True
    """
    points = jnp.asarray(points)
    eps = float(jnp.finfo(points.dtype).eps)
    if tolerance is None:
        limit = eps ** (2 / 3) * jnp.max(jnp.abs(lax.stop_gradient(points)), initial=eps)
    else:
        limit = jnp.asarray(tolerance, points.dtype)
    # The loop must not see tangents, also not those of parameters that phi has captured: reverse
    # mode cannot go through it. So phi is opened up and its captured values are frozen too.
    frozen = jax.tree.map(
        lambda leaf: lax.stop_gradient(leaf) if eqx.is_array(leaf) else leaf,
        eqx.filter_closure_convert(phi, jax.ShapeDtypeStruct(points.shape[1:], points.dtype)),
    )

    def single(start):
        g = jax.grad(phi)(start)
        # A zero gradient gives NaN here, and the point is reported.
        g = g / jnp.linalg.norm(g)
        there, step = _newton_on_ray(frozen, start, g, limit, max_steps)
        t = lax.custom_root(
            lambda s: phi(start + s * g),
            there,
            lambda _, guess: guess,
            lambda slope, y: y / slope(jnp.ones_like(y)),
        )
        good = jnp.abs(step) <= limit
        return jnp.where(good, start + t * g, jnp.nan), step

    found, step = jax.vmap(single)(points)
    if throw and is_concrete(found, step):
        step = np.abs(np.asarray(step))
        raise_at(
            ~(step <= np.asarray(limit)),
            f"projection of point {{i}} did not converge: last step {{v}}, tolerance {limit:.2g}, "
            f"{max_steps} steps (too far from the level set, or the gradient vanishes)",
            step,
        )
    return found


def level_set_normals(phi: LevelSet, points: Float[Array, "n d"]) -> Float[Array, "n d"]:
    r"""Unit normals $\nabla\phi/|\nabla\phi|$ at each point.

    Args:
        phi: function of one point `(d,)`.
        points: `(n, d)`.

    Returns:
        `(n, d)`, outward where phi grows outwards.

    Differentiable: forward and reverse, in the points and in what `phi` depends on.
    Raises:
        ValueError: the gradient vanishes or is not finite, named by point, on concrete arrays.

    Example:
        >>> level_set_normals(lambda x: x @ x - 1, jnp.array([[0.0, 2.0]])).tolist()
        [[0.0, 1.0]]
    """
    gradients = jax.vmap(jax.grad(phi))(jnp.asarray(points))
    length = jnp.linalg.norm(gradients, axis=1, keepdims=True)
    if is_concrete(length):
        size = np.asarray(length)[:, 0]
        bad = ~(np.isfinite(size) & (size > 0))
        raise_at(bad, "gradient of phi at point {i} has length {v}", size)
    return gradients / length


def level_set_curvature(
    phi: LevelSet, points: Float[Array, "n d"]
) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
    r"""Exact mean and Gauss curvature of the level sets of phi through each point.

    With the shape operator $S = P\,\nabla^2\phi\,P/|\nabla\phi|$, $P = I - n n^T$:
    $H = \operatorname{tr} S/(d-1) = \nabla\cdot n/(d-1)$, which is +1 on the unit sphere with
    phi growing outwards, and $K = \tfrac12((\operatorname{tr} S)^2 - \operatorname{tr} S^2)$.
    For a curve in the plane H is its curvature and K is zero.

    Args:
        phi: function of one point `(d,)`, twice differentiable.
        points: `(n, d)`.

    Returns:
        Mean curvature in 1/length and Gauss curvature in 1/length², `(n,)` each.

    Differentiable: forward and reverse, in the points and in what `phi` depends on.

    Example:
        >>> mean, gauss = level_set_curvature(lambda x: x @ x - 4, jnp.array([[0.0, 0.0, 2.0]]))
        >>> float(mean[0]), float(gauss[0])
        (0.5, 0.25)
    """

    def single(point):
        gradient, hessian = jax.grad(phi)(point), jax.hessian(phi)(point)
        length = jnp.linalg.norm(gradient)
        normal = gradient / length
        tangential = jnp.eye(point.size, dtype=point.dtype) - jnp.outer(normal, normal)
        shape = tangential @ hessian @ tangential / length
        trace = jnp.trace(shape)
        return trace / (point.size - 1), (trace**2 - jnp.sum(shape * shape.T)) / 2

    return jax.vmap(single)(jnp.asarray(points))


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
        >>> phi, bounds = double_torus(0.4)
        >>> cloud = level_set(phi, n=1_000, bounds=bounds)
        >>> def width(thickness):
        ...     return project_to_level_set(double_torus(thickness)[0], cloud.points)[:, 0].max()
        >>> bool(0.9 < jax.grad(width)(0.4) < 1.1)
        True
    """
    if is_concrete(jnp.asarray(thickness)) and not 0.3 <= thickness <= 0.55:
        raise ValueError(f"thickness is {thickness}, expected a number from 0.3 to 0.55")

    def phi(x):
        def torus(centre):
            y = x - jnp.array([centre, 0.0, 0.0], x.dtype)
            tube = (y @ y + 1 - thickness**2) ** 2 - 4 * (y[0] ** 2 + y[1] ** 2)
            return tube / (8 * thickness)

        smoothing = 0.3
        tubes = jnp.stack([torus(1.1), torus(-1.1)])
        return -smoothing * jax.nn.logsumexp(-tubes / smoothing)

    return phi, ((-2.9, -1.9, -1.0), (2.9, 1.9, 1.0))


def _newton_on_ray(phi, start, direction, limit, max_steps):
    """Root t of phi(start + t direction), and the last step taken."""

    def body(state):
        t, _, count = state
        value, slope = jax.jvp(phi, (start + t * direction,), (direction,))
        # An exact zero with zero slope is still a failure: the position is not determined.
        step = -value / slope
        return t + step, step, count + 1

    def unfinished(state):
        _, step, count = state
        return (jnp.abs(step) > limit) & (count < max_steps)

    start, direction = lax.stop_gradient((start, direction))
    zero = jnp.zeros((), start.dtype)
    t, step, _ = lax.while_loop(unfinished, body, (zero, zero + jnp.inf, 0))
    return t, step


def _checked_bounds(bounds) -> np.ndarray:
    box = np.asarray(bounds, float)
    if box.ndim != 2 or box.shape[0] != 2 or box.shape[1] not in (2, 3):
        raise ValueError(
            f"bounds must be two corners in 2 or 3 dimensions, shape (2, d), not {box.shape}"
        )
    if not (np.isfinite(box).all() and (box[1] > box[0]).all()):
        raise ValueError(f"upper corner {box[1]} must exceed lower corner {box[0]} on every axis")
    return box


def _in_chunks(function, dtype):
    """Call a compiled function on blocks of one shape and gather the results as NumPy arrays."""

    def call(points):
        points = np.asarray(points, dtype)
        blocks = []
        for first in range(0, len(points), _CHUNK):
            block = points[first : first + _CHUNK]
            filler = np.broadcast_to(block[-1], (_CHUNK - len(block), block.shape[1]))
            result = function(jnp.asarray(np.concatenate([block, filler])))
            blocks.append(jax.tree.map(np.asarray, result))
        return jax.tree.map(lambda *parts: np.concatenate(parts)[: len(points)], *blocks)

    return call


def _crossed_cells(values, box: np.ndarray, resolution: int) -> tuple[np.ndarray, np.ndarray]:
    """Lower corners of the grid cells in and next to which phi changes sign, and their size."""
    side = box[1] - box[0]
    counts = np.maximum(np.ceil(resolution * side / side.max() - 1e-9).astype(int), 4)
    size = side / counts
    axes = [box[0, a] + size[a] * np.arange(counts[a] + 1) for a in range(len(side))]
    nodes = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(side))
    phi = values(nodes)
    if phi.ndim != 1:
        raise ValueError(f"phi must return a scalar, its values have shape {phi.shape[1:]}")
    raise_at(np.isnan(phi), "phi is not a number at {v}", nodes)
    inside = (phi < 0).reshape(counts + 1)
    if inside.all() or not inside.any():
        raise ValueError(
            f"phi has no zero within the bounds: it goes from {phi.min():.3g} to {phi.max():.3g} "
            f"on a grid of {' x '.join(map(str, counts))} cells"
        )
    for axis in range(len(side)):
        for end, name in ((0, "lower"), (-1, "upper")):
            face = np.take(inside, end, axis=axis)
            if face.any() and not face.all():
                raise ValueError(
                    f"the level set leaves the bounds through the {name} side of axis {axis}: "
                    "give larger bounds (only closed level sets can be sampled)"
                )
    crossed = ndimage.minimum_filter(inside, size=2) != ndimage.maximum_filter(inside, size=2)
    crossed = crossed[(slice(1, None),) * len(side)]
    crossed = ndimage.binary_dilation(crossed, np.ones((3,) * len(side)))
    return box[0] + size * np.argwhere(crossed), size


def _candidates(project: Project, cells, size, box, m: int, seed: int):
    """At least about m points spread evenly over the surface, their normals, and its area."""
    rng = np.random.default_rng(seed)
    dim = len(size)
    # Uniform in the band |distance| <= width means uniform over the surface, up to (width x
    # curvature)²; the dilated cells hold that band. About a sixth of each cell layer is in it.
    width = 0.5 * size.min()
    each = max(1, round(m * 4 * size.max() / size.min() / len(cells)))
    start = (cells[:, None] + size * rng.random((len(cells), each, dim))).reshape(-1, dim)
    points, normals = project(start)
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
