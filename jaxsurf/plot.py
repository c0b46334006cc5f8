"""Pictures of fields on point clouds, drawn from the points and normals alone."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from jaxtyping import Array, Bool, Float
from scipy import sparse
from scipy.spatial import cKDTree

from jaxsurf.arguments import raise_at
from jaxsurf.cloud import PointCloud

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_CLAY = (0.83, 0.80, 0.75)
# Radius of the disk drawn for a point, in mean distances to its six nearest neighbours.
_DISK = 1.35
# Sum of disk weights that makes a pixel part of the surface: about 1.9 inside, half on a border.
_COVER = 0.6
# Sine of how far over the horizon points are taken to support the outline.
_RIM = 0.5
# Rendered finer than shown and averaged, for smooth outlines.
_FINER = 2


def plot_cloud(
    cloud: PointCloud,
    field: Float[Array, " n"] | None = None,
    *,
    ax: Axes | None = None,
    label: str | None = None,
    title: str | None = None,
    cmap: str | None = None,
    limits: tuple[float, float] | None = None,
    view: tuple[float, float, float] = (1.0, -1.7, 0.9),
    up: tuple[float, float, float] = (0.0, 0.0, 1.0),
    pixels: int = 600,
) -> Axes:
    """Picture of a field on a surface, or on a curve in the plane.

    A surface is seen from far away (orthographic), lit from the upper left. Every point is drawn
    as a small disk in its tangent plane, and disks that overlap are blended, so that the surface
    looks closed without a mesh. The back of an open surface is drawn darker.

    Args:
        cloud: n points.
        field: values to show as colours; None shows the shape alone.
        ax: matplotlib axes to draw in; new ones if None.
        label: of the colour bar.
        title: above the picture.
        cmap: matplotlib colour map; if None, a diverging one centred at zero for fields of both
            signs, else a perceptually uniform one.
        limits: values at the ends of the colour map; if None the range of the field, less the
            outermost half per cent where these are outliers that would take most of the colours
            (the colour bar then has a pointed end).
        view: direction from the surface to the viewer.
        up: direction that points up in the picture.
        pixels: along the longer side.

    Returns:
        The axes.

    Raises:
        ValueError: a field of another shape than `(n,)` (both given) or with values that are not
            finite, named by index; `view` along `up`.
        ImportError: matplotlib is absent.

    Example:
        >>> cloud = js.sphere(500)
        >>> ax = js.plot_cloud(cloud, cloud.points[:, 2], label="height", pixels=100)
    """
    pyplot = _matplotlib()
    values = None if field is None else _checked(field, cloud)
    scene = _Scene.of(cloud, view, up, pixels)
    if ax is None:
        ax = pyplot.subplots(figsize=(6, 5), layout="constrained")[1]
    return _draw(ax, scene, values, label=label, title=title, cmap=cmap, limits=limits)


def _draw(ax, scene: _Scene, values, *, label=None, title=None, cmap=None, limits=None) -> Axes:
    colors = None if values is None else _Colors.of(values, cmap, limits)
    if scene.raster is None:
        _draw_curve(ax, scene.points, scene.normals, values, colors)
    else:
        image, extent = scene.raster.paint(values, colors), scene.raster.extent
        ax.imshow(image, extent=extent, origin="lower", interpolation="antialiased")
    ax.set_aspect("equal")
    ax.set_axis_off()
    if title is not None:
        ax.set_title(title, fontsize="medium")
    if colors is not None:
        bar = ax.figure.colorbar(
            colors.mappable(), ax=ax, shrink=0.72, aspect=28, pad=0.02, extend=colors.extend
        )
        bar.outline.set_visible(False)
        bar.ax.tick_params(length=2.5, labelsize="small")
        bar.ax.locator_params(nbins=5)
        if label is not None:
            bar.set_label(label)
    return ax


def plot_fields(
    cloud: PointCloud,
    fields: Mapping[str, Float[Array, " n"] | None],
    *,
    path: str | Path | None = None,
    columns: int = 3,
    dpi: int = 160,
    cmap: str | None = None,
    limits: tuple[float, float] | None = None,
    view: tuple[float, float, float] = (1.0, -1.7, 0.9),
    up: tuple[float, float, float] = (0.0, 0.0, 1.0),
    pixels: int = 600,
) -> Figure:
    """Several fields on the same cloud, side by side.

    Args:
        cloud: n points.
        fields: values by title; None shows the shape alone.
        path: picture file to write (PNG, PDF, …); none if None.
        columns: most panels in a row.
        dpi: dots per inch of the file.
        cmap, limits, view, up, pixels: as in `plot_cloud`.

    Returns:
        The matplotlib figure.

    Raises:
        ValueError: as `plot_cloud`; no fields.
        ImportError: matplotlib is absent.

    Example:
        >>> import pathlib, tempfile
        >>> cloud, folder = js.sphere(500), tempfile.TemporaryDirectory()
        >>> fields = {"x": cloud.points[:, 0], "z": cloud.points[:, 2]}
        >>> path = pathlib.Path(folder.name) / "sphere.png"
        >>> figure = js.plot_fields(cloud, fields, path=path, pixels=100)
        >>> path.stat().st_size > 1_000
        True
    """
    if not fields:
        raise ValueError("no fields to draw")
    pyplot = _matplotlib()
    values = {k: None if v is None else _checked(v, cloud) for k, v in fields.items()}
    scene = _Scene.of(cloud, view, up, pixels)
    columns = min(columns, len(fields))
    rows = -(-len(fields) // columns)
    size = (4.2 * columns + 0.3, 3.8 * rows)
    figure = pyplot.figure(figsize=size, layout="constrained")
    for i, (title, field) in enumerate(values.items()):
        ax = figure.add_subplot(rows, columns, i + 1)
        _draw(ax, scene, field, title=title, cmap=cmap, limits=limits)
    if path is not None:
        figure.savefig(path, dpi=dpi)
        # Written: leave nothing behind for a display.
        pyplot.close(figure)
    return figure


def _matplotlib():
    try:
        from matplotlib import pyplot
    except ImportError as error:
        raise ImportError(
            "pictures need the package matplotlib: pip install 'jaxsurf[pictures]'"
        ) from error
    return pyplot


class _Scene(NamedTuple):
    """What is seen, before any field: points that are on, and for surfaces the raster."""

    points: Float[np.ndarray, "m d"]
    normals: Float[np.ndarray, "m d"]
    raster: _Raster | None

    @staticmethod
    def of(cloud: PointCloud, view, up, pixels: int) -> _Scene:
        on = cloud.host_active
        points, normals = np.asarray(cloud.points, float)[on], np.asarray(cloud.normals, float)[on]
        if not len(points):
            raise ValueError("nothing to draw: no point is switched on")
        if cloud.dim == 2:
            return _Scene(points, normals, None)
        closed, camera = cloud.boundary is None, _camera(view, up)
        raster = _rasterize(points, normals, closed=closed, camera=camera, pixels=pixels)
        return _Scene(points, normals, raster)


def _checked(field, cloud: PointCloud) -> np.ndarray:
    values, on = np.asarray(field, float), cloud.host_active
    if values.shape != (cloud.n,):
        raise ValueError(f"field has shape {values.shape}, expected ({cloud.n},)")
    raise_at(on & ~np.isfinite(values), "field is {v} at point {i}", values)
    return values[on]


# --- colours -------------------------------------------------------------------------------


class _Colors(NamedTuple):
    cmap: str
    low: float
    high: float
    extend: str

    @staticmethod
    def of(values, cmap, limits) -> _Colors:
        least, most = float(values.min()), float(values.max())
        low, high = limits or _limits(values)
        signed = min(-low, high) > 0.02 * max(-low, high)
        if signed and limits is None:
            high = max(-low, high)
            low = -high
        if not low < high:
            # One value everywhere: any interval around it gives one colour.
            low, high = low - (abs(low) or 1) / 2, high + (abs(high) or 1) / 2
        under, over = least < low - 1e-9 * (high - low), most > high + 1e-9 * (high - low)
        extend = {(0, 0): "neither", (1, 0): "min", (0, 1): "max", (1, 1): "both"}[under, over]
        return _Colors(cmap or ("coolwarm" if signed else "viridis"), low, high, extend)

    def mappable(self):
        from matplotlib.cm import ScalarMappable
        from matplotlib.colors import Normalize

        return ScalarMappable(Normalize(self.low, self.high), self.cmap)

    def __call__(self, values):
        return self.mappable().to_rgba(values)[..., :3]


def _limits(values) -> tuple[float, float]:
    low, high = float(values.min()), float(values.max())
    inner_low, inner_high = map(float, np.quantile(values, [0.005, 0.995]))
    far = 0.25 * (inner_high - inner_low)
    if far == 0:
        return low, high
    return (
        inner_low if low < inner_low - far else low,
        inner_high if high > inner_high + far else high,
    )


# --- curves --------------------------------------------------------------------------------


def _draw_curve(ax, points, normals, values, colors) -> None:
    from matplotlib.collections import LineCollection

    k = min(3, len(points))
    reach = cKDTree(points).query(points, k=k)[0][:, -1:] if k > 1 else np.ones((1, 1))
    along = np.stack([normals[:, 1], -normals[:, 0]], axis=1) * reach * 0.6
    paint = [_CLAY] if values is None else colors(values)
    strokes = np.stack([points - along, points + along], axis=1)
    ax.add_collection(LineCollection(list(strokes), colors=paint, linewidths=4, capstyle="round"))
    ax.autoscale_view()
    ax.margins(0.08)


# --- surfaces ------------------------------------------------------------------------------


class _Raster(NamedTuple):
    """A surface seen from one side: which points make up each pixel, before any colour."""

    blend: sparse.csr_array
    normals: Float[np.ndarray, "rows columns 3"]
    covered: Bool[np.ndarray, "rows columns"]
    behind: Bool[np.ndarray, "rows columns"]
    extent: tuple[float, float, float, float]

    def paint(self, values, colors: _Colors | None) -> np.ndarray:
        """Picture with red, green, blue and coverage."""
        image = np.zeros((*self.covered.shape, 4))
        image[..., :3] = _CLAY
        if colors is not None:
            image[..., :3] = colors((self.blend @ values).reshape(self.covered.shape))
        image[..., :3] = _light(image[..., :3], self.normals, self.behind, strong=colors is None)
        # Average with colours weighed by coverage, so that no dark rim appears on the outline.
        image[..., 3] = self.covered
        image[..., :3] *= image[..., 3:]
        rows, columns = (size // _FINER for size in self.covered.shape)
        image = image.reshape(rows, _FINER, columns, _FINER, 4).mean(axis=(1, 3))
        image[..., :3] /= np.maximum(image[..., 3:], 1e-9)
        return np.clip(image, 0, 1)


def _camera(view, up) -> np.ndarray:
    """Rows: to the right, up, and towards the viewer."""
    toward = np.asarray(view, float)
    toward = toward / np.linalg.norm(toward)
    right = np.cross(np.asarray(up, float), toward)
    if not np.linalg.norm(right) > 1e-6 * np.linalg.norm(up):
        raise ValueError(f"view {tuple(view)} is along up {tuple(up)}: which way is up?")
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(toward, right), toward])


def _rasterize(points, normals, *, closed: bool, camera, pixels: int) -> _Raster:
    x, normal = points @ camera.T, normals @ camera.T
    radius = _DISK * _spacing(points)
    margin = np.median(radius)
    low, high = x[:, :2].min(axis=0) - margin, x[:, :2].max(axis=0) + margin
    step = float((high - low).max()) / (pixels * _FINER)
    columns, rows = np.ceil((high - low) / step / _FINER).astype(int) * _FINER
    size = rows * columns
    chosen = np.flatnonzero(normal[:, 2] > -_RIM) if closed else np.arange(len(x))
    radius = np.maximum(radius, 1.5 * step)
    pairs = _covered(chosen, x, normal, radius, low, step, (columns, rows))
    pixel, point, share = _front(*pairs, side=normal[:, 2], radius=radius, size=size)
    blend = sparse.csr_array((share, (pixel, point)), shape=(size, len(x)))
    mean = blend @ normal
    mean /= np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), 1e-9)
    behind = mean[:, 2] < -0.25
    mean[behind] *= -1
    shape = (rows, columns)
    covered = np.bincount(pixel, minlength=size).reshape(shape) > 0
    extent = (low[0], low[0] + columns * step, low[1], low[1] + rows * step)
    return _Raster(blend, mean.reshape(*shape, 3), covered, behind.reshape(shape), extent)


def _front(pixel, point, far, depth, *, side, radius, size: int):
    """The pairs on the foremost sheet of every pixel, with shares that add up to one there."""
    found = []
    for _ in range(4):
        front = np.full((2, size), -np.inf)
        core = far < 0.6
        turned = (side[point[core]] < 0).astype(int)
        np.maximum.at(front, (turned, pixel[core]), depth[core])
        behind = front[1] > front[0] + 0.7 * np.median(radius)
        # Across the horizon both sides of a sheet belong together, elsewhere they are two.
        same = np.where(behind[pixel], -side[point], side[point]) > -_RIM
        near = front[behind.astype(int), np.arange(size)]
        near = np.where(behind, near, front.max(axis=0))
        seen = same & (depth > near[pixel] - 0.7 * radius[point])
        share = np.where(seen, (1 - far**2) ** 2, 0)
        weight = np.bincount(pixel, share, minlength=size)
        # Disks stick out beyond the outline, but few at a time: look through those, above all
        # where they show their backs.
        solid = weight > np.where(behind, 2.2 * _COVER, _COVER)
        take = seen & solid[pixel]
        found.append((pixel[take], point[take], share[take] / weight[pixel[take]]))
        rest = ~solid[pixel] & ~seen
        if not rest.any():
            break
        pixel, point, far, depth = pixel[rest], point[rest], far[rest], depth[rest]
    return tuple(np.concatenate(parts) for parts in zip(*found))


def _spacing(points):
    k = min(7, len(points))
    if k == 1:
        return np.ones(1)
    return cKDTree(points).query(points, k=k)[0][:, 1:].mean(axis=1)


def _covered(chosen, x, normal, radius, low, step, shape):
    """Pairs of pixel and point where the point's tangent disk covers the pixel.

    Returns pixel, point, distance on the disk in units of its radius, and depth.
    """
    center = (x[:, :2] - low) / step
    reach = _round_up(np.ceil(radius / step))
    found = []
    # Disks of about the same size share one square of offsets.
    for r in np.unique(reach[chosen]):
        some = chosen[reach[chosen] == r]
        offset = np.stack(np.meshgrid(np.arange(-r, r + 1), np.arange(-r, r + 1)), -1)
        offset = offset.reshape(-1, 2)
        offset = offset[(offset**2).sum(axis=1) <= (r + 1) ** 2]
        for block in np.array_split(some, len(some) * len(offset) // 1_000_000 + 1):
            cell = np.floor(center[block])[:, None].astype(int) + offset
            d = (cell + 0.5 - center[block][:, None]) * step
            n = normal[block]
            # Disks seen from the side keep some thickness, or they would leave gaps.
            steep = np.copysign(np.maximum(np.abs(n[:, 2:]), 0.15), n[:, 2:])
            dz = -(n[:, :1] * d[..., 0] + n[:, 1:2] * d[..., 1]) / steep
            far = np.sqrt(d[..., 0] ** 2 + d[..., 1] ** 2 + dz**2) / radius[block, None]
            good = (far < 1) & (cell >= 0).all(axis=-1) & (cell < shape).all(axis=-1)
            i, j = np.nonzero(good)
            pixel = cell[i, j, 1] * shape[0] + cell[i, j, 0]
            found.append((pixel, block[i], far[i, j], x[block[i], 2] + dz[i, j]))
    return tuple(np.concatenate(parts) for parts in zip(*found))


def _round_up(size):
    return np.ceil(2 ** (np.ceil(2 * np.log2(np.maximum(size, 1))) / 2)).astype(int)


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
