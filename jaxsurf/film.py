"""Surfaces that change with time in pictures: sheets and films, in one frame and colour map."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from jaxtyping import Array, Float

from jaxsurf.arguments import instance, real, whole
from jaxsurf.cloud import PointCloud
from jaxsurf.plot import (
    Colors,
    Scene,
    add_bar,
    check_arguments,
    draw,
    in_rows,
    pyplot_module,
    values_of,
)
from jaxsurf.raster import camera_of
from jaxsurf.series import Frame, frames_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# So many pictures of a film say which colours it needs.
_LOOKED_AT = 8
# From here on, of 255, colours of a film are made white.
_WHITE = 248


def plot_series(
    clouds: PointCloud | Sequence[PointCloud],
    field: Sequence | Float[Array, "m n"] | None = None,
    *,
    times: Sequence[float] | Float[Array, " m"] | None = None,
    path: str | Path | None = None,
    columns: int = 4,
    dpi: int = 160,
    label: str | None = None,
    cmap: str | None = None,
    limits: tuple[float, float] | None = None,
    view: tuple[float, float, float] = (1.0, -1.7, 0.9),
    up: tuple[float, float, float] = (0.0, 0.0, 1.0),
    pixels: int = 400,
) -> Figure:
    """A surface at several times on one sheet, in the same frame and the same colours.

    Args:
        clouds: at each time, as `evolve` gives them; or one for all.
        field: values at each time, or an array with time first; None shows the shape alone.
        times: above the pictures; their numbers if None.
        path: picture file to write (PNG, PDF, …); none if None.
        columns: most pictures in a row.
        dpi: dots per inch of the file.
        label, cmap, limits, view, up, pixels: as in `plot_cloud`.

    Returns:
        The matplotlib figure.

    Raises:
        ValueError, TypeError: as `plot_cloud`; other numbers of clouds, fields and times.
        ImportError: matplotlib is absent.

    Example:
        >>> ball = js.sphere(300)
        >>> clouds = [js.PointCloud(r * ball.points, ball.normals) for r in (1, 2)]
        >>> figure = js.plot_series(clouds, times=[0.0, 1.0], pixels=60)
        >>> len(figure.axes)
        2
    """
    pyplot, film = pyplot_module(), Film.of(clouds, field, times, cmap, limits, view, up, pixels)
    whole(columns, "columns", least=1)
    real(dpi, "dpi", above=0)
    if path is not None:
        instance(path, (str, Path), "path")
    rows, columns = in_rows(len(film.frames), columns)
    figure = pyplot.figure(figsize=(3.2 * columns + 0.6, 3.0 * rows), layout="constrained")
    axes = [figure.add_subplot(rows, columns, i + 1) for i in range(len(film.frames))]
    for i, ax in enumerate(axes):
        film.draw(ax, i)
    if film.colors is not None:
        add_bar(figure, axes, film.colors, label)
    if path is not None:
        figure.savefig(path, dpi=dpi)
        pyplot.close(figure)
    return figure


def animate(
    path: str | Path,
    clouds: PointCloud | Sequence[PointCloud],
    field: Sequence | Float[Array, "m n"] | None = None,
    *,
    times: Sequence[float] | Float[Array, " m"] | None = None,
    fps: float = 12,
    dpi: int = 100,
    label: str | None = None,
    cmap: str | None = None,
    limits: tuple[float, float] | None = None,
    view: tuple[float, float, float] = (1.0, -1.7, 0.9),
    up: tuple[float, float, float] = (0.0, 0.0, 1.0),
    pixels: int = 400,
) -> None:
    """Film of a surface and a field on it, one picture for each time.

    Args:
        path: .gif, or .mp4 where ffmpeg is installed; overwritten if it exists.
        clouds, field, times: as in `plot_series`.
        fps: pictures a second.
        dpi: dots per inch of a picture of 5 by 4 inches.
        label, cmap, limits, view, up, pixels: as in `plot_cloud`.

    Raises:
        ValueError, TypeError: as `plot_series`; another suffix.
        ImportError: matplotlib is absent, or for .mp4 ffmpeg.

    Example:
        >>> import pathlib, tempfile
        >>> cloud, folder = js.sphere(300), tempfile.TemporaryDirectory()
        >>> path = pathlib.Path(folder.name) / "wave.gif"
        >>> js.animate(path, cloud, [cloud.points[:, 2], -cloud.points[:, 2]], dpi=30, pixels=40)
        >>> path.stat().st_size > 500
        True
    """
    pyplot, film = pyplot_module(), Film.of(clouds, field, times, cmap, limits, view, up, pixels)
    real(fps, "fps", above=0)
    real(dpi, "dpi", above=0)
    writer = _writer(Path(instance(path, (str, Path), "path")), fps)
    figure, ax = pyplot.subplots(figsize=(5, 4), layout="constrained")
    if film.colors is not None:
        add_bar(figure, ax, film.colors, label)
    with writer.saving(figure, path, dpi):
        for i in range(len(film.frames)):
            ax.clear()
            film.draw(ax, i)
            writer.grab_frame()
    pyplot.close(figure)


def _writer(path: Path, fps: float):
    from matplotlib.animation import FFMpegWriter, PillowWriter

    class Gif(PillowWriter):
        """All pictures in the same 256 colours: else each has its own, and the bar flickers."""

        def finish(self):
            pictures = vars(self)["_frames"]
            pictures[:] = in_same_colors(pictures)
            super().finish()

    kinds: dict[str, Any] = {".gif": Gif, ".mp4": FFMpegWriter}
    if path.suffix.lower() not in kinds:
        raise ValueError(f"{path}: unknown suffix {path.suffix!r}; films are .gif or .mp4")
    kind = kinds[path.suffix.lower()]
    if not kind.isAvailable():
        raise ImportError(f"{path}: films of this kind need ffmpeg; .gif needs nothing more")
    return kind(fps=fps)


def in_same_colors(pictures: list) -> list:
    """Pictures of one size by Pillow, in a palette made from some of them, first and last."""
    from PIL import Image

    chosen = np.unique(np.linspace(0, len(pictures) - 1, _LOOKED_AT).round().astype(int))
    some = np.concatenate([np.asarray(pictures[i].convert("RGB")) for i in chosen])
    palette = Image.fromarray(some).quantize(256)
    colors = np.asarray(palette.getpalette()).reshape(-1, 3)
    colors[colors.min(axis=1) >= _WHITE] = 255  # else paper is grey
    palette.putpalette(colors.ravel().tolist())
    return [picture.convert("RGB").quantize(palette=palette) for picture in pictures]


class Film(NamedTuple):
    """Pictures in one frame and one set of colours."""

    frames: list[Frame]
    values: list[np.ndarray | None]
    colors: Colors | None
    extent: tuple[float, float, float, float]
    scene: Callable[[PointCloud], Scene]

    @staticmethod
    def of(clouds, field, times, cmap, limits, view, up, pixels) -> Film:
        frames = frames_of(clouds, {} if field is None else {"field": field}, times)
        values: list[np.ndarray | None] = []
        for i, (_, cloud, fields) in enumerate(frames):
            check_arguments(cloud, cmap, limits, pixels)
            values += [values_of(value, cloud, f"field {i}") for value in fields.values()] or [None]
        known = [v for v in values if v is not None]
        colors = Colors.of(np.concatenate(known), cmap, limits) if known else None
        seen = [_seen(frame.cloud, view, up) for frame in frames]
        low = np.min([x.min(axis=0) for x in seen], axis=0)
        high = np.max([x.max(axis=0) for x in seen], axis=0)
        margin = 0.08 * float((high - low).max())
        (left, bottom), (right, top) = low - margin, high + margin
        scene = lambda cloud: Scene.of(cloud, view, up, pixels)
        return Film(frames, values, colors, (left, right, bottom, top), scene)

    def draw(self, ax, i: int) -> None:
        time, cloud, _ = self.frames[i]
        draw(
            ax,
            self.scene(cloud),
            self.values[i],
            self.colors,
            f"{i}" if time is None else f"t = {time:.3g}",
        )
        ax.set_xlim(self.extent[:2])
        ax.set_ylim(self.extent[2:])


def _seen(cloud: PointCloud, view, up) -> Float[np.ndarray, "m 2"]:
    """Where the points are in a picture."""
    points = np.asarray(cloud.points, float)[cloud.host_active]
    if not len(points):
        raise ValueError("nothing to draw: no point is switched on")
    return points if cloud.dim == 2 else points @ camera_of(view, up)[:2].T
