"""Orthonormal tangent frames."""

from __future__ import annotations

import jax
import numpy as np
from jaxtyping import Array, Float

from .arguments import as_float
from .compiling import AnyArray, namespace
from .failures import is_concrete, raise_at


def tangent_frames(normals: Float[Array, "*n d"]) -> Float[Array, "*n d d"]:
    r"""Right-handed orthonormal frames whose last row is the normal.

    In space $t_1, t_2$ come from rotating the z axis (for $n_z<0$ the −z axis) onto n by the
    shortest way, so that a frame is a rational function of its normal on each half.

    Args:
        normals: unit normals, `(n, d)` with d = 2 or 3.

    Returns:
        Rows (t, n) for d = 2 and (t1, t2, n) for d = 3, `(n, d, d)`.

    Accuracy: orthonormal to 1e-14 in float64, 1e-6 in float32
        (`tests/test_frames.py::test_frames_are_rotations`).
    Differentiable: forward and reverse; the frame jumps where $n_z$ changes sign.
    Raises:
        ValueError: wrong shape; on concrete arrays also normals that are not of length one.
        TypeError: no array of real numbers.
    Source: Duff et al. 2017, Building an orthonormal basis, revisited.

    Example:
        >>> js.tangent_frames(jnp.array([[0.0, 1.0]]))[0].tolist()
        [[1.0, -0.0], [0.0, 1.0]]
    """
    normals = as_float(normals, "normals", (..., 2), (..., 3))
    if is_concrete(normals):
        length = np.atleast_1d(np.linalg.norm(np.asarray(normals), axis=-1))
        off = ~(np.abs(length - 1) < 100 * np.sqrt(np.finfo(normals.dtype).eps))
        raise_at(off.ravel(), "normal {i} has length {v}, expected 1", length.ravel())
    return _compiled(normals)


def frames_of(normals: Float[AnyArray, "*n d"]) -> Float[AnyArray, "*n d d"]:
    """`tangent_frames` of normals that are not looked at, such as those of switched-off rows."""
    xp = namespace(normals)
    return xp.moveaxis(axes_of(xp.moveaxis(normals, -1, 0)), (0, 1), (-2, -1))


def axes_of(normals: Float[AnyArray, "d *n"]) -> Float[AnyArray, "d d *n"]:
    """The same for what has its points along the last axis, as the axes of the frames then."""
    stack = namespace(normals).stack
    if len(normals) == 2:
        x, y = normals
        return stack([stack([y, -x]), normals])
    x, y, z = normals
    side = namespace(normals).where(z >= 0, 1, -1).astype(normals.dtype)
    bend = -1 / (z + side)
    shear = x * y * bend
    first = stack([1 + side * x * x * bend, side * shear, -side * x])
    second = stack([shear, side + y * y * bend, -y])
    return stack([first, second, normals])


_compiled = jax.jit(frames_of)
