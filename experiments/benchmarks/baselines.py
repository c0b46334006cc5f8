"""What a user would write by hand: GFDM in batched NumPy, and in a few lines of plain JAX."""

from __future__ import annotations

import itertools

import jax
import jax.numpy as jnp
import numpy as np


def _powers(degree: int) -> list[tuple[int, int]]:
    return [(a, s - a) for s, a in itertools.product(range(degree + 1), repeat=2) if a <= s]


def _right_side(degree: int) -> np.ndarray:
    return np.array([2.0 * (p in ((2, 0), (0, 2))) for p in _powers(degree)])


def numpy_gfdm(points, normals, index, degree: int, block: int = 4096) -> np.ndarray:
    """Laplacian weights `(n, k)`: normal equations and LAPACK in blocks."""
    weights = np.empty(index.shape)
    b = _right_side(degree)
    for start in range(0, len(points), block):
        rows = slice(start, start + block)
        n = normals[rows]
        helper = np.where(np.abs(n[:, :1]) < 0.9, [[1.0, 0, 0]], [[0, 1.0, 0]])
        t1 = np.cross(n, helper)
        t1 /= np.linalg.norm(t1, axis=1, keepdims=True)
        frame = np.stack([t1, np.cross(n, t1)], axis=2)
        offsets = points[index[rows]] - points[rows, None]
        r2 = np.einsum("nkd,nkd->nk", offsets, offsets)
        scale = np.sqrt(r2.max(axis=1) / 8)
        x, y = np.moveaxis(offsets @ frame / scale[:, None, None], 2, 0)
        v = np.stack([x**p * y**q for p, q in _powers(degree)], axis=2)
        w = np.exp(-r2 / scale[:, None] ** 2)
        gram = v.transpose(0, 2, 1) @ (w[:, :, None] * v)
        a = np.linalg.solve(gram, np.broadcast_to(b[:, None], (len(n), len(b), 1)))
        weights[rows] = w * (v @ a)[:, :, 0] / scale[:, None] ** 2
    return weights


def plain_jax_gfdm(points, normals, index, degree: int):
    """The same in plain JAX: `vmap` over all points, differentiated as it stands."""
    powers, b = _powers(degree), jnp.asarray(_right_side(degree))

    def one(x, n, neighbors):
        helper = jnp.where(jnp.abs(n[0]) < 0.9, jnp.array([1.0, 0, 0]), jnp.array([0, 1.0, 0]))
        t1 = jnp.cross(n, helper)
        t1 = t1 / jnp.linalg.norm(t1)
        d = points[neighbors] - x
        r2 = jnp.sum(d * d, axis=1)
        scale = jnp.sqrt(jnp.max(r2) / 8)
        p, q = d @ t1 / scale, d @ jnp.cross(n, t1) / scale
        v = jnp.stack([p**i * q**j for i, j in powers], axis=1)
        w = jnp.exp(-r2 / scale**2)
        return w * (v @ jnp.linalg.solve(v.T @ (w[:, None] * v), b)) / scale**2

    return jax.vmap(one)(points, normals, index)
