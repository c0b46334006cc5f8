"""Closed level sets {phi = 0} sampled on the host; the choice of points is not differentiated."""

from __future__ import annotations

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy import ndimage

from jaxsurf.arguments import in_range, on_host, real, whole
from jaxsurf.cloud import PointCloud
from jaxsurf.compiling import block_by_block
from jaxsurf.functions import Traced
from jaxsurf.shapes.implicit import Bounds, LevelSet, level_set_normals, program_of
from jaxsurf.shapes.order import sort_points
from jaxsurf.shapes.sampling import quasi_uniform
from jaxsurf.shapes.spacing import MOST, points_at

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
        (`tests/test_shapes.py::test_level_set_is_even`); points on the level set to round-off. In
    float32 points are within 3e-6 of a unit sphere, normals within 1e-5 (`tests/test_shapes.py`).
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
    program = program_of(phi, jax.ShapeDtypeStruct((dim,), dtype))
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
        ...     return js.project_to_level_set(double_torus(thickness)[0], cloud.points)[:, 0].max()
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


def _checked_bounds(bounds) -> np.ndarray:
    box = on_host(bounds, "bounds", (2, 2), (2, 3))
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
