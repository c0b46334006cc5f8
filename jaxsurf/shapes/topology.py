"""Which sheets a level set has, from the signs of phi on a grid."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy import ndimage
from scipy.spatial import cKDTree

from jaxsurf.arguments import in_range, on_host


def checked_bounds(bounds) -> np.ndarray:
    """Lower and upper corner of a box, `(2, d)`."""
    box = on_host(bounds, "bounds", (2, 2), (2, 3))
    if not (np.isfinite(box).all() and (box[1] > box[0]).all()):
        raise ValueError(f"upper corner {box[1]} must exceed lower corner {box[0]} on every axis")
    return in_range(box, "bounds")


class Sides(NamedTuple):
    """On which side of a level set the nodes of a grid over a box are.

    Args:
        inside: where phi < 0, one axis for each of the box, whose faces are all on one side.
        box: lower and upper corner.
        size: of a cell.
    """

    inside: np.ndarray
    box: np.ndarray
    size: np.ndarray

    @classmethod
    def of(cls, values: Callable, box: np.ndarray, resolution: int) -> Sides:
        """From values of phi at points `(m, d)`, with so many cells along the longest side."""
        side = box[1] - box[0]
        counts = np.maximum(np.ceil(resolution * side / side.max() - 1e-9).astype(int), 4)
        size = side / counts
        axes = [box[0, a] + size[a] * np.arange(counts[a] + 1) for a in range(len(side))]
        nodes = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
        phi = values(nodes.reshape(-1, len(side))).reshape(counts + 1)
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
        return cls(inside, box, size)

    def crossed_cells(self) -> np.ndarray:
        """Lower corners of the cells in and next to which phi changes sign."""
        inside, d = self.inside, self.inside.ndim
        crossed = ndimage.minimum_filter(inside, size=2) != ndimage.maximum_filter(inside, size=2)
        crossed = crossed[(slice(1, None),) * d]
        crossed = ndimage.binary_dilation(crossed, np.ones((3,) * d))
        return self.box[0] + self.size * np.argwhere(crossed)

    def sheets(self) -> Sheets:
        """Each divides one component of the inside from one of the outside."""
        d = self.inside.ndim
        inner, within = ndimage.label(self.inside)
        outer, without = ndimage.label(~self.inside, np.ones((3,) * d))
        edges, pairs = [], []
        for axis in range(d):
            both = [slice(None)] * d, [slice(None)] * d
            both[0][axis], both[1][axis] = slice(None, -1), slice(1, None)
            one, two = map(tuple, both)
            crossed = self.inside[one] != self.inside[two]
            edges.append(np.argwhere(crossed) + 0.5 * np.eye(d)[axis])
            pairs.append((inner[one] + inner[two])[crossed] * (without + 1)
                         + (outer[one] + outer[two])[crossed])  # fmt: skip
        _, sheet, counts = np.unique(np.concatenate(pairs), return_inverse=True, return_counts=True)
        middles = self.box[0] + self.size * np.concatenate(edges)
        # Euler's number is that of parts, less that of tunnels, and that of cavities. In the plane
        # there are no tunnels.
        cavities = without - (not self.inside.flat[0])
        tunnels = within + cavities - _euler(self.inside) if d == 3 else 0
        return Sheets(middles, sheet, counts / counts.sum(), tunnels)


class Sheets(NamedTuple):
    """The connected parts of a level set.

    Args:
        middles: of the grid's edges that cross it, `(m, d)`.
        sheet: which part each of them is of.
        share: of all edges, and so about of the area, that each part has.
        tunnels: through all that they enclose: 1 for a torus.
    """

    middles: np.ndarray
    sheet: np.ndarray
    share: np.ndarray
    tunnels: int

    def at(self, points: np.ndarray) -> np.ndarray:
        """The part that each point is on."""
        return self.sheet[cKDTree(self.middles).query(points)[1]]

    def counts(self, points: np.ndarray) -> np.ndarray:
        """How many points each part has."""
        return np.bincount(self.at(points), minlength=len(self.share))


def _euler(inside: np.ndarray) -> int:
    """Euler's number of the nodes inside, with the edges, squares and cubes that they span."""
    number = 0
    for axes in itertools.product((False, True), repeat=inside.ndim):
        spanned = inside
        for axis in np.flatnonzero(axes):
            n = spanned.shape[axis] - 1
            spanned = spanned.take(np.arange(n), axis) & spanned.take(np.arange(1, n + 1), axis)
        number += (-1) ** sum(axes) * int(spanned.sum())
    return number


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
