"""Which points of a cloud look like border points."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool
from scipy.spatial import cKDTree

from ..arguments import instance, real, whole
from ..cloud import PointCloud
from ..failures import needs_values
from ..frames import tangent_frames
from ..sheets import nearest

# Neighbours looked at for the largest empty angle, and the angle that makes a border.
_RING, _GAP = 16, 2.1


def detect_boundary(cloud: PointCloud, *, k: int = _RING, gap: float = _GAP) -> Bool[Array, " n"]:
    """Points of a cloud that look like border points, for `PointCloud.boundary`.

    Seen from an inner point the neighbours lie all around; at a border they leave an angle
    empty, about a half turn.

    Args:
        cloud: n points with unit normals, concrete.
        k: number of neighbours looked at, the point included.
        gap: empty angle in the tangent plane that makes a border point, in radians, below π.

    Returns:
        Mask `(n,)`. On very uneven points it may name inner points and leave border points
        out: look at it before use.

    Raises:
        TypeError: no cloud; k that is no whole number, gap that is no number.
        ValueError: traced arrays; k or gap out of range.

    Example:
        >>> bowl = lambda s: (jnp.sin(s), -jnp.cos(s))
        >>> cap = js.surface_of_revolution(bowl, 800)
        >>> bool((js.detect_boundary(cap) == cap.boundary).all())
        True
    """
    instance(cloud, PointCloud, "cloud")
    needs_values("cloud", cloud)
    whole(k, "k", least=3, most=cloud.n)
    real(gap, "gap", above=0, below=np.pi)
    on = cloud.host_active
    rows = np.flatnonzero(on)
    points, normals = np.asarray(cloud.points, float)[rows], np.asarray(cloud.normals)[rows]
    k = min(k, len(rows)) if cloud.dim == 3 else 3
    slots, mask = nearest(points, normals, cKDTree(points), k, 0.0)
    frames = np.asarray(tangent_frames(jnp.asarray(normals)))[:, :-1]
    offsets = np.einsum("nkd,ntd->nkt", points[slots] - points[:, None], frames)[:, 1:]
    used = mask[:, 1:]
    found = np.zeros(cloud.n, bool)
    if cloud.dim == 2:
        side = np.where(used, np.sign(offsets[..., 0]), 0)
        found[rows] = np.abs(side.sum(axis=1)) == used.sum(axis=1)
    else:
        angle = np.where(used, np.arctan2(offsets[..., 1], offsets[..., 0]), np.nan)
        angle = np.sort(angle, axis=1)  # unused slots last
        step = np.diff(angle, axis=1)
        around = 2 * np.pi - (np.nanmax(angle, axis=1) - np.nanmin(angle, axis=1))
        found[rows] = np.maximum(np.nanmax(step, axis=1, initial=0), around) > gap
    return jnp.asarray(found)
