"""Point clouds: positions, unit normals, and what is known about each point."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from scipy.spatial import cKDTree

from .arguments import POINTS, as_float, is_array
from .failures import is_concrete, not_finite, not_positive, raise_at
from .indices import mask

# How far the length of a normal may be from one, by the bytes of a number: what normals that were
# written with eight digits, or normalised in single precision, are off.
_LENGTH = {2: 1e-2, 4: 1e-5, 8: 1.49e-6}


class PointCloud(eqx.Module):
    """A surface (or a plane curve) given by points and unit normals.

    The order of the points is kept as given. Values are checked where the arrays are
    concrete; under `jit`, `vmap` and `grad` only shapes are, so that a cloud can be built
    from traced points.

    Args:
        points: positions, `(n, d)` with d = 2 (a curve in the plane) or 3 (a surface).
        normals: unit normals, `(n, d)`, consistently oriented.
        boundary: True for points on a border of the surface, `(n,)`; None for a closed surface.
        active: False for rows that exist but are switched off, `(n,)`; None if all are on. What
            stands in such rows, here and in fields, has no part in anything: the others get what
            they would get without them. Results are zero there, and so are derivatives.
        spacing: distance to the nearest neighbours, `(n,)`, in the units of `points`; None to
            let operators derive it from the neighbours.

    Raises:
        TypeError: points, normals or spacing that are not real numbers, a border or activity
            that is no mask of bools.
        ValueError: wrong shapes, fewer than one point; on concrete arrays also points that are not
            finite, and so large or so close that squared distances leave the range of their type,
            normals that are not of length one, all named by index.

    Example:
        >>> angle = 2 * np.pi * np.arange(50) / 50
        >>> points = np.stack([np.cos(angle), np.sin(angle)], axis=1)
        >>> cloud = js.PointCloud(points, points)
        >>> cloud.n, cloud.dim
        (50, 2)
    """

    points: Float[Array, "n d"]
    normals: Float[Array, "n d"]
    boundary: Bool[Array, " n"] | None
    active: Bool[Array, " n"] | None
    spacing: Float[Array, " n"] | None

    def __init__(
        self,
        points: Float[Array, "n d"],
        normals: Float[Array, "n d"],
        *,
        boundary: Bool[Array, " n"] | None = None,
        active: Bool[Array, " n"] | None = None,
        spacing: Float[Array, " n"] | None = None,
    ):
        self.points = as_float(points, "points", *POINTS)
        dtype, shape = self.points.dtype, self.points.shape
        if shape[0] < 1:
            raise ValueError(f"points have shape {shape}: 0 points, at least 1 is needed")
        self.normals = as_float(normals, "normals", shape).astype(dtype)
        self.boundary = None if boundary is None else mask(boundary, shape[0], "boundary")
        self.active = None if active is None else mask(active, shape[0], "active")
        if spacing is not None:
            spacing = as_float(spacing, "spacing", shape[:1]).astype(dtype)
        self.spacing = spacing

    def __check_init__(self):
        if is_concrete(self.points, self.normals, self.active, self.spacing):
            self._check_values()

    def _check_values(self):
        on = self.host_active
        points, normals = np.asarray(self.points), np.asarray(self.normals)
        info = np.finfo(points.dtype)
        raise_at(on & not_finite(points), "point {i} is not finite: {v}", points)
        size, largest = np.abs(points).max(axis=1), 0.1 * float(info.max) ** 0.5
        raise_at(
            on & (size > largest),
            f"point {{i}} has a coordinate of size {{v:.3g}}, at most {largest:.1g} can be "
            f"calculated with in {points.dtype}: use other units",
            size,
        )
        seen = points[on]
        extent = float(np.ptp(seen, axis=0).max()) if len(seen) else 0.0
        least = 1e4 * float(info.tiny) ** 0.5  # the spacing is a small part of the extent
        if 0 < extent < least:
            raise ValueError(
                f"points lie within {extent:.3g} of each other, at least {least:.1g} can be "
                f"calculated with in {points.dtype}: use other units"
            )
        length = np.sqrt(np.sum(np.square(normals, dtype=float), axis=1))
        off = ~(np.abs(length - 1) < _LENGTH[points.dtype.itemsize])
        raise_at(on & off, "normal {i} has length {v}, expected 1", np.round(length, 7))
        if self.spacing is not None:
            text = "spacing of point {i} is {v}, expected a positive number"
            raise_at(on & not_positive(np.asarray(self.spacing)), text, self.spacing)

    def __repr__(self):
        if not is_array(self.points):
            return f"PointCloud({self.points!r})"
        about = [f"{self.n:,} points in {self.dim}-d", str(self.points.dtype)]
        if is_concrete(self.points, self.active) and self.points.ndim == 2:
            points = np.asarray(self.points, float)[self.host_active]
            if len(points) > 1:
                some = points[:: max(1, len(points) // 1000)]
                nearest = cKDTree(points).query(some, [2])[0]
                about.append(f"spacing {np.median(nearest):.3g}")
            if len(points) < self.n:
                about.append(f"{self.n - len(points):,} switched off")
        if self.boundary is None:
            about.append("closed")
        elif is_concrete(self.boundary):
            about.append(f"{int(np.sum(np.asarray(self.boundary))):,} on the border")
        return f"PointCloud({', '.join(about)})"

    @property
    def n(self) -> int:
        """Number of rows, switched-off ones included."""
        return self.points.shape[0]

    @property
    def dim(self) -> int:
        """Dimension d of the space around the surface: 2 or 3."""
        return self.points.shape[1]

    @property
    def host_active(self) -> Bool[np.ndarray, " n"]:
        """Which rows are switched on, as a NumPy array; concrete clouds only."""
        return np.ones(self.n, bool) if self.active is None else np.asarray(self.active)

    @property
    def seen(self) -> PointCloud:
        """The cloud with numbers in place of what stands in switched-off rows, NaN maybe."""
        if self.active is None:
            return self
        where, on = np.where if isinstance(self.points, np.ndarray) else jnp.where, self.active
        axis = np.eye(self.dim, dtype=self.points.dtype)[0]
        new = [where(on[:, None], self.points, 0), where(on[:, None], self.normals, axis)]
        spacing = None if self.spacing is None else where(on, self.spacing, 1)
        parts = lambda cloud: (cloud.points, cloud.normals, cloud.spacing)
        return eqx.tree_at(parts, self, (*new, spacing), is_leaf=lambda x: x is None)

    def permuted(self, order: Int[Array, " n"]) -> PointCloud:
        """The same cloud with row `order[i]` in place i."""
        return jax.tree.map(lambda a: a[order], self)
