"""Level sets {phi = 0} of any JAX function: sampling, projection, exact normals and curvature.

Sampling chooses points once, on the host, and is not differentiated. Their position is: rebuild
it from the chosen points with `project_to_level_set` and `level_set_normals` under `jax.grad`,
and derivatives with respect to everything that `phi` depends on follow.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float
from scipy import ndimage

from jaxsurf.arguments import (
    as_float,
    differentiable,
    finite,
    in_range,
    is_concrete,
    on_host,
    raise_at,
    real,
    whole,
)
from jaxsurf.cloud import PointCloud
from jaxsurf.compiling import block_by_block
from jaxsurf.functions import Traced, canonical
from jaxsurf.shapes.order import sort_points
from jaxsurf.shapes.sampling import quasi_uniform
from jaxsurf.shapes.spacing import MOST, points_at

LevelSet = Callable[[Float[Array, " d"]], Float[Array, ""]]
Bounds = tuple[tuple[float, ...], tuple[float, ...]]

# Newton steps along a ray at most, and how many widths of the band a candidate may stray.
_STEPS, _STRAY = 30, 10


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
    whole(resolution, "resolution", least=4, most=1_000)
    whole(seed, "seed", least=0)
    if steps is not None:
        whole(steps, "steps", least=0)
    if spacing is not None:
        real(spacing, "spacing", above=0)
    elif whole(n, "n", most=MOST) < 4:
        raise ValueError(f"n = {n} points, needs at least 4")
    dtype = jnp.result_type(float)
    program = _program(phi, jax.ShapeDtypeStruct((dim,), dtype))
    look = block_by_block(partial(_values_and_gradients, program), dtype)

    cells, size = _crossed_cells(look, box, resolution)
    if n is None:
        measure = _candidates(look, cells, size, box, 50_000, seed)[2]
        n = points_at(spacing, measure, dim=dim)  # type: ignore[arg-type]
        if n < 4:
            raise ValueError(f"spacing = {spacing} gives n = {n} points, needs at least 4")
    candidates, normals, measure = _candidates(look, cells, size, box, max(6 * n, 5_000), seed)
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
        steps=steps if steps is not None else (40 if dim == 3 else 200),
        seed=seed,
    )
    points = _onto(look, points)[0]
    chosen = jnp.asarray(points[sort_points(points)])
    return PointCloud(chosen, level_set_normals(phi, chosen))


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
    points = _checked_points(points)
    whole(max_steps, "max_steps", least=1)
    if tolerance is None:
        eps = float(jnp.finfo(points.dtype).eps)
        limit = eps ** (2 / 3) * jnp.max(jnp.abs(lax.stop_gradient(points)), initial=eps)
    else:
        limit = jnp.asarray(real(tolerance, "tolerance", above=0), points.dtype)
    program = _program(phi, points[0] if len(points) else jnp.zeros(points.shape[1:]))
    found, step = _projected(program, points, limit, jnp.asarray(max_steps))
    if throw and is_concrete(found, step):
        step = np.abs(np.asarray(step))
        raise_at(
            ~(step <= np.asarray(limit)),
            f"projection of point {{i}} did not converge: last step {{v}}, tolerance {limit:.2g}, "
            f"{max_steps} steps (too far from the level set, or the gradient vanishes)",
            step,
        )
    return found


@eqx.filter_jit
def _projected(phi: Traced, points, limit, max_steps):
    # The loop must not see tangents, also not those of parameters that phi has captured: reverse
    # mode cannot go through it.
    frozen = jax.tree.map(lax.stop_gradient, phi)

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

    return jax.vmap(single)(points)


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
    points = _checked_points(points)
    normals, length = _directions(_program(phi, points), points)
    if is_concrete(length):
        size = np.asarray(length)
        bad = ~(np.isfinite(size) & (size > 0))
        raise_at(bad, "gradient of phi at point {i} has length {v}", size)
    return normals


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
    Raises:
        ValueError: the gradient vanishes or is not finite, named by point, on concrete arrays.
        TypeError: phi is no function that JAX can trace.

    Example:
        >>> mean, gauss = level_set_curvature(lambda x: x @ x - 4, jnp.array([[0.0, 0.0, 2.0]]))
        >>> float(mean[0]), float(gauss[0])
        (0.5, 0.25)
    """

    points = _checked_points(points)
    mean, gauss = _curvatures(_program(phi, points), points)
    if is_concrete(mean, gauss):
        values = np.asarray(mean)
        bad = ~(np.isfinite(values) & np.isfinite(np.asarray(gauss)))
        raise_at(bad, "curvature at point {i} is {v}: the gradient of phi vanishes", values)
    return mean, gauss


@eqx.filter_jit
def _curvatures(phi: Traced, points):
    def single(point):
        gradient, hessian = jax.grad(phi)(point), jax.hessian(phi)(point)
        length = jnp.linalg.norm(gradient)
        normal = gradient / length
        tangential = jnp.eye(point.size, dtype=point.dtype) - jnp.outer(normal, normal)
        shape = tangential @ hessian @ tangential / length
        trace = jnp.trace(shape)
        return trace / (point.size - 1), (trace**2 - jnp.sum(shape * shape.T)) / 2

    return jax.vmap(single)(points)


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


def _program(phi: LevelSet, points) -> Traced:
    """The level-set function as a program, for points of this kind."""
    point = jax.ShapeDtypeStruct(points.shape[-1:], points.dtype)
    value = differentiable(phi, "phi", point)
    if not isinstance(value, jax.ShapeDtypeStruct) or value.shape != ():
        what = getattr(value, "shape", f"a {type(value).__name__}")
        raise ValueError(f"phi must return a scalar for one point, its values have shape {what}")
    if not jnp.issubdtype(value.dtype, jnp.floating):
        raise TypeError(f"phi returns {value.dtype}, expected a real number")
    return canonical(phi, jnp.zeros(point.shape, point.dtype))


def _checked_points(points) -> Float[Array, "n d"]:
    points = as_float(points, "points")
    if points.ndim != 2 or points.shape[1] not in (2, 3):
        raise ValueError(f"points must have shape (n, 2) or (n, 3), not {points.shape}")
    return finite(points, "points")


@eqx.filter_jit
def _values_and_gradients(phi: Traced, points):
    return jax.vmap(jax.value_and_grad(phi))(points)


@eqx.filter_jit
def _directions(phi: Traced, points):
    gradients = jax.vmap(jax.grad(phi))(points)
    length = jnp.linalg.norm(gradients, axis=1)
    return gradients / length[:, None], length


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


def _checked_bounds(bounds) -> np.ndarray:
    box = on_host(bounds, "bounds")
    if box.ndim != 2 or box.shape[0] != 2 or box.shape[1] not in (2, 3):
        raise ValueError(
            f"bounds must be two corners in 2 or 3 dimensions, shape (2, d), not {box.shape}"
        )
    if not (np.isfinite(box).all() and (box[1] > box[0]).all()):
        raise ValueError(f"upper corner {box[1]} must exceed lower corner {box[0]} on every axis")
    return in_range(box, "bounds")


def _crossed_cells(look, box: np.ndarray, resolution: int) -> tuple[np.ndarray, np.ndarray]:
    """Lower corners of the grid cells in and next to which phi changes sign, and their size."""
    side = box[1] - box[0]
    counts = np.maximum(np.ceil(resolution * side / side.max() - 1e-9).astype(int), 4)
    size = side / counts
    axes = [box[0, a] + size[a] * np.arange(counts[a] + 1) for a in range(len(side))]
    nodes = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    phi = look(nodes.reshape(-1, len(side)))[0].reshape(counts + 1)
    inside, unknown = _signs(phi, nodes)
    if inside.all() or not inside.any():
        raise ValueError(
            f"phi has no zero within the bounds: it goes from {np.nanmin(phi):.3g} to "
            f"{np.nanmax(phi):.3g} on a grid of {' x '.join(map(str, counts))} cells{unknown}"
        )
    for axis in range(len(side)):
        for end, name in ((0, "lower"), (-1, "upper")):
            face = np.take(inside, end, axis=axis)
            if face.any() and not face.all():
                raise ValueError(
                    f"the level set leaves the bounds through the {name} side of axis {axis}: "
                    f"give larger bounds (only closed level sets can be sampled){unknown}"
                )
    crossed = ndimage.minimum_filter(inside, size=2) != ndimage.maximum_filter(inside, size=2)
    crossed = crossed[(slice(1, None),) * len(side)]
    crossed = ndimage.binary_dilation(crossed, np.ones((3,) * len(side)))
    return box[0] + size * np.argwhere(crossed), size


def _signs(phi: np.ndarray, nodes: np.ndarray) -> tuple[np.ndarray, str]:
    """Where phi < 0, and a note on nodes where it is no number.

    Such nodes, like the centre of a star shape, are on the side that all nodes around them are on.
    """
    inside, lost = phi < 0, np.isnan(phi)
    if not lost.any():
        return inside, ""
    if lost.all():
        raise ValueError("phi is not a number anywhere within the bounds")
    around = np.ones((3,) * phi.ndim)
    label, _ = ndimage.label(lost, around)
    for part, box in enumerate(ndimage.find_objects(label), 1):
        wide = tuple(slice(max(s.start - 1, 0), s.stop + 1) for s in box)
        here = label[wide] == part
        rim = ndimage.binary_dilation(here, around) & ~lost[wide]
        sides = inside[wide][rim]
        if sides.any() and not sides.all():
            place = nodes[wide][here][0]
            raise ValueError(f"phi is not a number at {place}, next to where it changes sign")
        inside[wide][here] = sides.any()
    first = nodes[lost][0]
    return inside, f" (phi is not a number at {first} and {lost.sum() - 1} other nodes)"


def _candidates(look, cells, size, box, m: int, seed: int):
    """At least about m points spread evenly over the surface, their normals, and its area."""
    rng = np.random.default_rng(seed)
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
