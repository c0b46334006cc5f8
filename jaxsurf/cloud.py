"""Point clouds: positions, unit normals, and what is known about each point."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from .arguments import as_float, is_concrete, raise_at


class PointCloud(eqx.Module):
    """A surface (or a plane curve) given by points and unit normals.

    The order of the points is kept as given. Values are checked where the arrays are
    concrete; under `jit`, `vmap` and `grad` only shapes are, so that a cloud can be built
    from traced points.

    Args:
        points: positions, `(n, d)` with d = 2 (a curve in the plane) or 3 (a surface).
        normals: unit normals, `(n, d)`, consistently oriented.
        boundary: True for points on a border of the surface, `(n,)`; None for a closed surface.
        active: False for rows that exist but are switched off, `(n,)`; None if all are on.
        spacing: distance to the nearest neighbours, `(n,)`, in the units of `points`; None to
            let operators derive it from the neighbours.

    Raises:
        ValueError: wrong shapes; on concrete arrays also non-finite points and normals that
            are not of length one, named by index.
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
        self.points = as_float(points)
        self.normals = jnp.asarray(normals, self.points.dtype)
        self.boundary = None if boundary is None else jnp.asarray(boundary, bool)
        self.active = None if active is None else jnp.asarray(active, bool)
        self.spacing = None if spacing is None else jnp.asarray(spacing, self.points.dtype)

    def __check_init__(self):
        shape = self.points.shape
        if len(shape) != 2 or shape[1] not in (2, 3):
            raise ValueError(f"points must have shape (n, 2) or (n, 3), not {shape}")
        if self.normals.shape != shape:
            raise ValueError(f"normals have shape {self.normals.shape}, points {shape}")
        for name in ("boundary", "active", "spacing"):
            value = getattr(self, name)
            if value is not None and value.shape != shape[:1]:
                raise ValueError(f"{name} has shape {value.shape}, expected {shape[:1]}")
        if is_concrete(self.points, self.normals, self.active, self.spacing):
            self._check_values()

    def _check_values(self):
        on = self.host_active
        points, normals = np.asarray(self.points), np.asarray(self.normals)
        raise_at(on & ~np.isfinite(points).all(axis=1), "point {i} is not finite: {v}", points)
        length = np.linalg.norm(normals, axis=1)
        off = ~(np.abs(length - 1) < 100 * np.sqrt(np.finfo(points.dtype).eps))
        raise_at(on & off, "normal {i} has length {v}, expected 1", length)
        if self.spacing is not None:
            spacing = np.asarray(self.spacing)
            bad = ~(np.isfinite(spacing) & (spacing > 0))
            raise_at(on & bad, "spacing of point {i} is {v}, expected a positive number", spacing)

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

    def permuted(self, order: Int[Array, " n"]) -> PointCloud:
        """The same cloud with row `order[i]` in place i."""
        return jax.tree.map(lambda a: a[order], self)
