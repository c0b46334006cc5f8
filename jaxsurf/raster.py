"""A surface of bare points as pixels: disks in the tangent planes, the foremost ones blended."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree

from jaxsurf.arguments import on_host

CLAY = (0.83, 0.80, 0.75)
# Radius of the disk drawn for a point, in mean distances to its six nearest neighbours.
_DISK = 1.35
# Sum of disk weights that makes a pixel part of the surface: about 1.9 inside, half on a border.
_COVER = 0.6
# Sine of how far over the horizon points still support the outline of the side that is seen.
_RIM = 0.5
# Rendered finer than shown and averaged, for smooth outlines.
_FINER = 2


class Raster(NamedTuple):
    """A surface seen from one side: which points make up each pixel, before any colour."""

    pixel: Int[np.ndarray, " pairs"]
    point: Int[np.ndarray, " pairs"]
    share: Float[np.ndarray, " pairs"]
    normals: Float[np.ndarray, "rows columns 3"]
    covered: Bool[np.ndarray, "rows columns"]
    behind: Bool[np.ndarray, "rows columns"]
    extent: tuple[float, float, float, float]

    def paint(self, values, colors: Any) -> np.ndarray:
        """Picture with red, green, blue and coverage."""
        image = np.zeros((*self.covered.shape, 4), np.float32)
        image[..., :3] = CLAY
        if colors is not None:
            mean = np.bincount(
                self.pixel, self.share * values[self.point], minlength=self.covered.size
            )
            image[..., :3] = colors(mean.reshape(self.covered.shape))
        image[..., :3] = _light(image[..., :3], self.normals, self.behind, strong=colors is None)
        # Average with colours weighed by coverage, so that no dark rim appears on the outline.
        image[..., 3] = self.covered
        image[..., :3] *= image[..., 3:]
        rows, columns = (size // _FINER for size in self.covered.shape)
        image = image.reshape(rows, _FINER, columns, _FINER, 4).mean(axis=(1, 3))
        image[..., :3] /= np.maximum(image[..., 3:], 1e-9)
        return np.clip(image, 0, 1)


def _direction(value, name: str) -> np.ndarray:
    vector = on_host(value, name, (3,))
    length = np.linalg.norm(vector)
    if not (np.isfinite(length) and length > 0):
        raise ValueError(f"{name} = {value} has length {length}, expected a direction")
    return vector / length


def camera_of(view, up) -> np.ndarray:
    """Rows: to the right, up, and towards the viewer."""
    toward = _direction(view, "view")
    right = np.cross(_direction(up, "up"), toward)
    if not np.linalg.norm(right) > 1e-6:
        raise ValueError(f"view {tuple(view)} is along up {tuple(up)}: which way is up?")
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(toward, right), toward])


def rasterize(points, normals, *, closed: bool, camera, pixels: int) -> Raster:
    x, normal = points @ camera.T, normals @ camera.T
    radius = _DISK * _spacing(points)
    margin = np.median(radius)
    low, high = x[:, :2].min(axis=0) - margin, x[:, :2].max(axis=0) + margin
    step = float((high - low).max()) / (pixels * _FINER)
    columns, rows = np.ceil((high - low) / step / _FINER).astype(int) * _FINER
    size = rows * columns
    radius = np.maximum(radius, 1.5 * step)
    pairs = _covered(x, normal, radius, low, step, (columns, rows))
    if closed:
        pairs = _before_backs(*pairs, side=normal[:, 2], size=size)
    pixel, point, share = _front(*pairs, side=normal[:, 2], radius=radius, size=size)
    sums = [np.bincount(pixel, share * c[point], minlength=size) for c in normal.T]
    mean = np.stack(sums, axis=1).astype(np.float32)
    mean /= np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), 1e-9)
    behind = mean[:, 2] < -0.25
    mean[behind] *= -1
    shape = (rows, columns)
    covered = np.bincount(pixel, minlength=size).reshape(shape) > 0
    extent = (low[0], low[0] + columns * step, low[1], low[1] + rows * step)
    shown = mean.reshape(*shape, 3)
    return Raster(pixel, point, share, shown, covered, behind.reshape(shape), extent)


def _before_backs(pixel, point, far, depth, *, side, size: int):
    """Without what shows its back where anything faces the viewer: that hides it, if it is closed.

    Elsewhere an open surface is seen from inside, whose border nobody marked.
    """
    weight = np.where(side[point] >= 0, (1 - far) ** 2, 0)
    faced = np.bincount(pixel, weight, minlength=size) > _COVER
    kept = (side[point] > -_RIM) | ~faced[pixel]
    return pixel[kept], point[kept], far[kept], depth[kept]


def _front(pixel, point, far, depth, *, side, radius, size: int):
    """The pairs on the foremost sheet of every pixel, with shares that add up to one there.

    Args:
        far: squares of the distances on the disks in units of their radii.
    """
    side, radius = side.astype(np.float32), radius.astype(np.float32)
    found = []
    for _ in range(4):
        foremost = np.full(2 * size, -np.inf, np.float32)
        core = far < 0.36
        place = pixel[core] + size * (side[point[core]] < 0)
        np.maximum.at(foremost, place, depth[core])
        front = foremost.reshape(2, size)
        behind = front[1] > front[0] + np.float32(0.7 * np.median(radius))
        # Across the horizon both sides of a sheet belong together, elsewhere they are two.
        same = np.where(behind[pixel], -side[point], side[point]) > -_RIM
        near = np.where(behind, front[1], front.max(axis=0))
        seen = same & (depth > near[pixel] - np.float32(0.7) * radius[point])
        share = np.where(seen, (1 - far) ** 2, 0)
        weight = np.bincount(pixel, share, minlength=size).astype(np.float32)
        # Disks stick out beyond the outline, but few at a time: look through those, above all
        # where they show their backs.
        solid = weight > np.where(behind, np.float32(2.2 * _COVER), np.float32(_COVER))
        solid = solid[pixel]
        take = seen & solid
        found.append((pixel[take], point[take], share[take] / weight[pixel[take]]))
        unseen = ~solid & ~seen
        if not unseen.any():
            break
        pixel, point, far, depth = pixel[unseen], point[unseen], far[unseen], depth[unseen]
    return tuple(np.concatenate(parts) for parts in zip(*found))


def _spacing(points):
    k = min(7, len(points))
    if k == 1:
        return np.ones(1)
    return cKDTree(points).query(points, k=k)[0][:, 1:].mean(axis=1)


def _covered(x, n, r, low, step, shape):
    """Pairs of pixel and point where the point's tangent disk covers the pixel.

    A disk covers, in each row of pixels, those between the ends of a chord of the ellipse that is
    seen of it: they are written down row by row, without trying any others.

    Returns pixel, point, squared distance on the disk in units of its radius, and depth.
    """
    columns, rows = shape
    # Disks seen from the side keep some thickness, or they would leave gaps.
    slope = -n[:, :2] / np.copysign(np.maximum(np.abs(n[:, 2:]), 0.15), n[:, 2:])
    # Squared distance on the disk: a dx² + 2 b dx dy + c dy².
    a, b, c = 1 + slope[:, 0] ** 2, slope[:, 0] * slope[:, 1], 1 + slope[:, 1] ** 2
    height = r * np.sqrt(a / (a * c - b * b))
    first = np.maximum(np.ceil((x[:, 1] - height - low[1]) / step - 0.5), 0).astype(int)
    last = np.minimum(np.floor((x[:, 1] + height - low[1]) / step - 0.5), rows - 1).astype(int)
    disk, row = _expanded(first, last)
    dy = (row + 0.5) * step + low[1] - x[disk, 1]
    a, b, c, r = a[disk], b[disk] * dy, c[disk] * dy * dy, r[disk]
    half = np.sqrt(np.maximum(b * b - a * (c - r * r), 0)) / a
    middle = (x[disk, 0] - b / a - low[0]) / step - 0.5
    first = np.maximum(np.ceil(middle - half / step), 0).astype(int)
    last = np.minimum(np.floor(middle + half / step), columns - 1).astype(int)
    chord, column = _expanded(first, last)
    # From here on there are millions of pairs: small types, and nothing computed twice.
    inverse, slope = 1 / r, slope[disk]
    rise = x[disk, 2] + slope[:, 1] * dy
    start = low[0] + 0.5 * step - x[disk, 0]
    dx = (column * np.float32(step)) + start.astype(np.float32)[chord]
    a, b, c = ((v * inverse**2).astype(np.float32)[chord] for v in (a, 2 * b, c))
    far = np.minimum((a * dx + b) * dx + c, np.float32(1))
    depth = rise.astype(np.float32)[chord] + slope[:, 0].astype(np.float32)[chord] * dx
    pixel = (row * columns).astype(np.int32)[chord] + column
    return pixel, disk[chord], far, depth


def _expanded(first, last):
    """Every whole number from `first` to `last` of each row, and which row it is of."""
    count = np.maximum(last - first + 1, 0)
    row = np.repeat(np.arange(len(first), dtype=np.int32), count)
    shift = (first - (np.cumsum(count) - count)).astype(np.int32)
    return row, np.arange(len(row), dtype=np.int32) + shift[row]


def _light(color, normal, behind, *, strong: bool):
    """Diffuse light from the upper left, a faint sky, a soft highlight, and a darker back.

    Weaker on colours that mean something than on bare clay.
    """
    key = np.array([-0.45, 0.55, 0.75])
    key /= np.linalg.norm(key)
    half = key + np.array([0.0, 0.0, 1.0])
    half /= np.linalg.norm(half)
    ambient, direct = (0.38, 0.62) if strong else (0.56, 0.46)
    shade = ambient + direct * np.maximum(normal @ key, 0) + 0.05 * normal[..., 1]
    gloss = 0.14 * np.maximum(normal @ half, 0) ** 30
    return color * (shade * (1 - 0.35 * behind))[..., None] + (gloss * ~behind)[..., None]
