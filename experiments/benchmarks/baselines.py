"""GFDM in batched NumPy, the same stencil, and in a few lines of plain JAX, a simpler one."""

from __future__ import annotations

import itertools

import jax
import jax.numpy as jnp
import numpy as np


def _powers(degree: int) -> list[tuple[int, int]]:
    return [(a, s - a) for s, a in itertools.product(range(degree + 1), repeat=2) if a <= s]


def _right_side(degree: int) -> np.ndarray:
    return np.array([2.0 * (p in ((2, 0), (0, 2))) for p in _powers(degree)])


def numpy_gfdm(points, normals, index, degree: int, block: int = 1024) -> np.ndarray:
    """The weights of `js.GFDM(degree)`, `(n, k)`, in batched NumPy: blocks that fit the cache."""
    weights = np.empty(index.shape)
    b = _right_side(degree)[1:, None]
    epsilon = 0.36 if degree <= 2 else 0.315
    for start in range(0, len(points), block):
        rows = slice(start, start + block)
        frame = _numpy_frames(normals[rows])
        offsets = points[index[rows]] - points[rows, None]
        r2 = np.einsum("nkd,nkd->nk", offsets, offsets)
        radius = _numpy_support(r2)
        width = epsilon * radius
        x, y = np.moveaxis(offsets @ frame / width[:, None, None], 2, 0)
        powers = [(np.ones_like(x), np.ones_like(y))]
        for _ in range(degree):
            powers.append((powers[-1][0] * x, powers[-1][1] * y))
        v = np.stack([powers[p][0] * powers[q][1] for p, q in _powers(degree)[1:]], axis=2)
        s4 = np.minimum(r2 / radius[:, None] ** 2, 1) ** 4
        w = np.exp(-r2 / width[:, None] ** 2) * (1 - s4) ** 3
        gram = v.transpose(0, 2, 1) @ (w[:, :, None] * v)
        a = np.linalg.solve(gram, np.broadcast_to(b, (len(gram), *b.shape)))
        found = w * (v @ a)[:, :, 0] / width[:, None] ** 2
        found[:, 0] = -found[:, 1:].sum(axis=1)
        weights[rows] = found
    return weights


def _numpy_frames(n):
    """Tangents as columns, `(n, 3, 2)` (Duff et al. 2017)."""
    x, y, z = n.T
    side = np.where(z >= 0, 1.0, -1.0)
    bend = -1 / (z + side)
    first = np.stack([1 + side * x * x * bend, side * x * y * bend, -side * x], axis=1)
    second = np.stack([x * y * bend, side + y * y * bend, -y], axis=1)
    return np.stack([first, second], axis=2)


def _numpy_support(r2):
    """Radius at which neighbours counted with (1 - s)^3 are 0.76 / 4 of the list, by Newton."""
    target = 0.19 * r2.shape[1]
    t = 0.5 * np.log(1.52 * r2.mean(axis=1))
    for _ in range(20):
        s = np.minimum(r2 * np.exp(-2 * t)[:, None], 1)
        rest = (1 - s) ** 2
        count, slope = (rest * (1 - s)).sum(axis=1), 6 * (s * rest).sum(axis=1)
        step = np.log(target / count) * count / slope
        t += step
        if np.abs(step).max() < 1e-12:
            break
    return np.exp(t)


def plain_jax_gfdm(points, normals, index, degree: int):
    """A simpler stencil in plain JAX: `vmap` over all points, differentiated as it stands."""
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
