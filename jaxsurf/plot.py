"""Pictures of fields on point clouds, drawn from the points and normals alone."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from jaxtyping import Array, Float, Real
from scipy.spatial import cKDTree

from jaxsurf.arguments import instance, on_host, real, whole
from jaxsurf.cloud import PointCloud
from jaxsurf.failures import needs_values, raise_at
from jaxsurf.raster import CLAY, Raster, camera_of, rasterize

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Of a surface along the longer side, unless more are asked for.
_MOST = 600


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
    pixels: int | None = None,
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
        pixels: along the longer side; if None twice as many as the axes have on the screen, and at
            most 600.

    Returns:
        The axes.

    Raises:
        ValueError: a field of another shape than `(n,)` (both given) or with values that are not
            finite, named by index; `view` along `up`; limits that are no interval.
        TypeError: no cloud, or a field that is no array of real numbers.
        ImportError: matplotlib is absent.

    Example:
        >>> cloud = js.sphere(500)
        >>> ax = js.plot_cloud(cloud, cloud.points[:, 2], label="height", pixels=100)
    """
    pyplot = pyplot_module()
    check_arguments(cloud, cmap, limits, _MOST if pixels is None else pixels)
    values = None if field is None else values_of(field, cloud, "field")
    if ax is None:
        ax = pyplot.subplots(figsize=(6, 5), layout="constrained")[1]
    if pixels is None:
        extent = ax.get_window_extent()
        pixels = min(_MOST, max(1, math.ceil(2 * max(extent.width, extent.height))))
    scene = Scene.of(cloud, view, up, pixels)
    return _panel(ax, scene, values, label=label, title=title, cmap=cmap, limits=limits)


def _panel(ax, scene: Scene, values, *, label=None, title=None, cmap=None, limits=None) -> Axes:
    colors = None if values is None else Colors.of(values, cmap, limits)
    draw(ax, scene, values, colors, title)
    if colors is not None:
        add_bar(ax.figure, ax, colors, label)
    return ax


def draw(ax, scene: Scene, values, colors: Colors | None, title: str | None) -> None:
    if scene.raster is None:
        _draw_curve(ax, scene.points, scene.normals, values, colors)
    else:
        image, extent = scene.raster.paint(values, colors), scene.raster.extent
        ax.imshow(image, extent=extent, origin="lower", interpolation="antialiased")
    ax.set_aspect("equal")
    ax.set_axis_off()
    if title is not None:
        ax.set_title(title, fontsize="medium")


def add_bar(figure, axes, colors: Colors, label: str | None) -> None:
    bar = figure.colorbar(
        colors.mappable(),
        ax=axes,
        shrink=0.72,
        aspect=28,
        pad=0.02,
        extend=colors.extend,
        panchor=False,
    )
    bar.outline.set_visible(False)
    bar.ax.tick_params(length=2.5, labelsize="small")
    bar.ax.locator_params(nbins=5)
    if label is not None:
        bar.set_label(label)


def plot_fields(
    cloud: PointCloud,
    fields: Mapping[str, Real[Array | np.ndarray, " n"] | None],
    *,
    path: str | Path | None = None,
    columns: int = 3,
    dpi: int = 160,
    cmap: str | None = None,
    limits: tuple[float, float] | None = None,
    view: tuple[float, float, float] = (1.0, -1.7, 0.9),
    up: tuple[float, float, float] = (0.0, 0.0, 1.0),
    pixels: int = _MOST,
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
        ValueError, TypeError: as `plot_cloud`; no fields, or no mapping of them.
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
    pyplot = pyplot_module()
    check_arguments(cloud, cmap, limits, pixels)
    if not instance(fields, Mapping, "fields", "{title: values}"):
        raise ValueError("no fields to draw: fields is empty")
    whole(columns, "columns", least=1)
    real(dpi, "dpi", above=0)
    if path is not None:
        instance(path, (str, Path), "path")
    values = {
        k: None if v is None else values_of(v, cloud, f"field {k!r}") for k, v in fields.items()
    }
    scene = Scene.of(cloud, view, up, pixels)
    rows, columns = in_rows(len(fields), columns)
    size = (4.2 * columns + 0.3, 3.8 * rows)
    figure = pyplot.figure(figsize=size, layout="constrained")
    for i, (title, field) in enumerate(values.items()):
        ax = figure.add_subplot(rows, columns, i + 1)
        _panel(ax, scene, field, title=title, cmap=cmap, limits=limits)
    if path is not None:
        figure.savefig(path, dpi=dpi)
        # Written: leave nothing behind for a display.
        pyplot.close(figure)
    return figure


def in_rows(count: int, most: int) -> tuple[int, int]:
    """Rows and columns of so many pictures, at most so many in a row: rows about as long."""
    rows = -(-count // most)
    return rows, -(-count // rows)


def pyplot_module():
    try:
        from matplotlib import pyplot
    except ImportError as error:
        raise ImportError(
            "pictures need the package matplotlib: pip install 'jaxsurf[pictures]'"
        ) from error
    return pyplot


class Scene(NamedTuple):
    """What is seen, before any field: points that are on, and for surfaces the raster."""

    points: Float[np.ndarray, "m d"]
    normals: Float[np.ndarray, "m d"]
    raster: Raster | None

    @staticmethod
    def of(cloud: PointCloud, view, up, pixels: int) -> Scene:
        on = cloud.host_active
        points, normals = np.asarray(cloud.points, float)[on], np.asarray(cloud.normals, float)[on]
        if not len(points):
            raise ValueError("nothing to draw: no point is switched on")
        if cloud.dim == 2:
            return Scene(points, normals, None)
        closed, camera = cloud.boundary is None, camera_of(view, up)
        raster = rasterize(points, normals, closed=closed, camera=camera, pixels=pixels)
        return Scene(points, normals, raster)


def values_of(field, cloud: PointCloud, name: str) -> np.ndarray:
    values, on = on_host(field, name, (cloud.n,)), cloud.host_active
    raise_at(on & ~np.isfinite(values), f"{name} is {{v}} at point {{i}}", values)
    return values[on]


def check_arguments(cloud, cmap, limits, pixels) -> None:
    instance(cloud, PointCloud, "cloud", "js.PointCloud(points, normals) makes one")
    needs_values("cloud", cloud, instead="draw outside jit, vmap and grad")
    whole(pixels, "pixels", least=1)
    if cmap is not None:
        from matplotlib import colormaps

        if cmap not in colormaps:
            raise ValueError(f"cmap is {cmap!r}, expected the name of a colour map of matplotlib")
    if limits is not None:
        ends = on_host(limits, "limits", (2,))
        if not (ends[0] < ends[1] and np.isfinite(ends).all()):
            raise ValueError(f"limits are {limits}, expected 2 numbers, the smaller one first")


# --- colours -------------------------------------------------------------------------------


class Colors(NamedTuple):
    cmap: str
    low: float
    high: float
    extend: str

    @staticmethod
    def of(values, cmap, limits) -> Colors:
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
        return Colors(cmap or ("coolwarm" if signed else "viridis"), low, high, extend)

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
    paint = [CLAY] if values is None else colors(values)
    strokes = np.stack([points - along, points + along], axis=1)
    ax.add_collection(LineCollection(list(strokes), colors=paint, linewidths=4, capstyle="round"))
    ax.autoscale_view()
    ax.margins(0.08)
