"""The closest-point method on the unit sphere, as a baseline.

Ruuth and Merriman, J. Comput. Phys. 227 (2008): a field on the surface is extended to a band of
grid points, constant along the normals, by interpolation at their closest points; there, the
Laplacian of space is that of the surface.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sparse

# Second derivative on a line, by order of accuracy: weights at 0, ±1, ±2 spacings.
_SECOND_DERIVATIVE = {2: (-2.0, 1.0), 4: (-5 / 2, 4 / 3, -1 / 12)}


@dataclass(frozen=True)
class ClosestPointSphere:
    """Band of a grid around the unit sphere with its two matrices.

    Args:
        closest: closest points of the band's grid points, `(m, 3)`.
        extend: values at the closest points from values on the band, by tensor-product Lagrange
            interpolation.
        laplacian: Laplacian of the grid, on the band.
    """

    closest: np.ndarray
    extend: sparse.csr_matrix
    laplacian: sparse.csr_matrix
    grid: _Grid

    def evaluation(self, points: np.ndarray) -> sparse.csr_matrix:
        """Matrix from values on the band to the surface Laplacian at points of the surface."""
        return self.grid.interpolation(points) @ self.laplacian


@dataclass(frozen=True)
class _Grid:
    h: float
    degree: int
    count: int
    number: np.ndarray  # place in the band of every grid point, -1 outside

    def interpolation(self, points: np.ndarray) -> sparse.csr_matrix:
        """Lagrange interpolation of the given degree on the grid points around each point."""
        p = self.degree
        position = points / self.h + self.number.shape[0] // 2
        base = np.floor(position).astype(int) - (p - 1) // 2
        t = position - base
        nodes = np.arange(p + 1)
        factors = np.ones((p + 1, *t.shape))
        for i, j in itertools.permutations(nodes, 2):
            factors[i] *= (t - j) / (i - j)
        columns, weights = [], []
        for shift in itertools.product(nodes, repeat=3):
            columns.append(self.number[tuple((base + shift).T)])
            weights.append(np.prod([factors[s, :, a] for a, s in enumerate(shift)], axis=0))
        columns, weights = np.stack(columns, axis=1), np.stack(weights, axis=1)
        if columns.min() < 0:
            raise ValueError("the band is too narrow for the interpolation")
        starts = np.arange(0, columns.size + 1, columns.shape[1])
        shape = (len(points), self.count)
        return sparse.csr_matrix((weights.ravel(), columns.ravel(), starts), shape=shape)


def closest_point_sphere(h: float, order: int) -> ClosestPointSphere:
    """The method at grid spacing h with finite differences of the given order (2 or 4).

    Interpolation of degree order + 1, the band as narrow as that allows.
    """
    degree = order + 1
    reach = (degree + 1) / 2
    stencil = order // 2
    # Half width of the band (Ruuth and Merriman 2008, Section 3), with a little room.
    width = 1.0001 * h * np.sqrt(2 * reach**2 + (stencil + reach) ** 2)
    half = int(np.ceil((1 + width) / h)) + 3
    axis = np.arange(-half, half + 1) * h
    x, y, z = np.meshgrid(axis, axis, axis, indexing="ij", sparse=True)
    radius = np.sqrt(x**2 + y**2 + z**2)
    inside = np.abs(radius - 1) <= width
    number = np.full(inside.shape, -1)
    number[inside] = np.arange(inside.sum())
    cells = np.argwhere(inside)
    points = (cells - half) * h
    closest = points / np.linalg.norm(points, axis=1, keepdims=True)
    grid = _Grid(h, degree, len(points), number)

    rows = np.arange(len(points))
    centre, *others = _SECOND_DERIVATIVE[order]
    parts = [(rows, rows, np.full(len(rows), 3 * centre))]
    for axis_index, (step, weight) in itertools.product(range(3), enumerate(others, start=1)):
        for sign in (-1, 1):
            shifted = cells.copy()
            shifted[:, axis_index] += sign * step
            j = number[tuple(shifted.T)]
            parts.append((rows[j >= 0], j[j >= 0], np.full(int(np.sum(j >= 0)), weight)))
    i, j, w = (np.concatenate(p) for p in zip(*parts))
    laplacian = sparse.csr_matrix((w / h**2, (i, j)), shape=(len(rows), len(rows)))
    return ClosestPointSphere(closest, grid.interpolation(closest), laplacian, grid)
