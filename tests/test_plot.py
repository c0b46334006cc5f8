import sys

import jax
import matplotlib
import numpy as np
import PIL.Image
import pytest
from scipy import ndimage

from jaxsurf import plot
from jaxsurf.cloud import PointCloud
from jaxsurf.film import animate, plot_series
from jaxsurf.plot import plot_cloud, plot_fields

matplotlib.use("Agg")


def sphere(n):
    i = np.arange(n) + 0.5
    z, angle = 1 - 2 * i / n, np.pi * (1 + 5**0.5) * i
    r = np.sqrt(1 - z**2)
    x = np.stack([r * np.cos(angle), r * np.sin(angle), z], axis=1)
    return PointCloud(x, x)


def circle(n):
    angle = 2 * np.pi * np.arange(n) / n
    x = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return PointCloud(x, x)


@pytest.fixture(autouse=True)
def _close_figures():
    yield
    matplotlib.pyplot.close("all")


def picture(ax):
    """The image drawn in the axes, upright, and its size in the units of the points."""
    image = ax.images[0]
    left, right, bottom, top = image.get_extent()
    return np.asarray(image.get_array())[::-1], (right - left, top - bottom)


@pytest.mark.parametrize("n", [300, 5_000])
def test_sphere_is_a_closed_disk(n):
    image, (width, height) = picture(plot_cloud(sphere(n), pixels=200))
    covered = image[..., 3]
    pixel = width * height / covered.size
    assert abs(covered.sum() * pixel / np.pi - 1) < (0.09 if n < 1_000 else 0.02)
    y, x = np.indices(covered.shape)
    center = (np.array(covered.shape) - 1) / 2
    inside = np.hypot(y - center[0], x - center[1]) * np.sqrt(pixel) < 0.97
    assert (covered[inside] == 1).all()


def test_an_open_surface_is_seen_from_inside():
    """Whether or not its border is marked."""
    whole = sphere(4_000)
    bowl = whole.points[:, 2] < 0
    cloud = PointCloud(whole.points[bowl], whole.normals[bowl])
    options = {"view": (0, 0, 1), "up": (0, 1, 0), "pixels": 200}
    image, (width, height) = picture(plot_cloud(cloud, cloud.points[:, 0], **options))
    covered = image[..., 3]
    assert abs(covered.sum() * width * height / covered.size / np.pi - 1) < 0.05
    h, w, _ = image.shape
    assert (covered[h // 4 : -h // 4, w // 4 : -w // 4] == 1).all()
    assert image[h // 2, w // 8, 2] > image[h // 2, w // 8, 0] + 0.1
    assert image[h // 2, -w // 8, 0] > image[h // 2, -w // 8, 2] + 0.1
    # Its near side hides some of the inside, and nothing shows between them.
    aslant, _ = picture(plot_cloud(cloud, view=(0.3, -0.5, 1), pixels=200))
    gaps = ndimage.binary_fill_holes(aslant[..., 3] > 0) & (aslant[..., 3] == 0)
    assert not gaps.any()


def test_light_comes_from_the_upper_left():
    image, _ = picture(plot_cloud(sphere(3_000), pixels=200))
    brightness = image[..., :3].sum(axis=-1)
    h, w = brightness.shape
    assert brightness[h // 4, w // 4] > 1.3 * brightness[3 * h // 4, 3 * w // 4]


def test_colours_follow_the_field_and_the_view():
    cloud = sphere(3_000)
    image, _ = picture(plot_cloud(cloud, cloud.points[:, 2], pixels=200, view=(1, 0, 0)))
    h, w, _ = image.shape
    red, blue = image[..., 0], image[..., 2]
    assert red[h // 8, w // 2] > 1.5 * blue[h // 8, w // 2]
    assert blue[-h // 8, w // 2] > 1.5 * red[-h // 8, w // 2]
    # From above, the northern half hides the southern one.
    options = {"view": (0, 0, 1), "up": (0, 1, 0), "pixels": 200}
    above, _ = picture(plot_cloud(cloud, cloud.points[:, 2], **options))
    covered = above[..., 3] == 1
    assert (above[..., 0] >= above[..., 2] - 0.08)[covered].all()


def test_back_of_an_open_surface_is_drawn_darker():
    ball = sphere(8_000)
    upper = np.asarray(ball.points[:, 2]) > 0
    x = ball.points[upper]
    bowl = PointCloud(x, x, boundary=np.asarray(x[:, 2]) < 0.02)
    outside, _ = picture(plot_cloud(bowl, pixels=150, view=(0, 0, 1), up=(0, 1, 0)))
    inside, _ = picture(plot_cloud(bowl, pixels=150, view=(0, 0, -1), up=(0, 1, 0)))
    h, w, _ = outside.shape
    assert inside[h // 2, w // 2, 3] == outside[h // 2, w // 2, 3] == 1
    assert inside[h // 2, w // 2, :3].sum() < 0.8 * outside[h // 2, w // 2, :3].sum()


def test_points_that_are_off_are_not_drawn():
    cloud = sphere(2_000)
    left = np.asarray(cloud.points[:, 0]) < 0
    half = PointCloud(cloud.points, cloud.normals, active=left)
    _, (width, height) = picture(plot_cloud(half, pixels=100, view=(0, 1, 0)))
    assert 0.4 < width / height < 0.65
    with pytest.raises(ValueError, match="no point is switched on"):
        plot_cloud(PointCloud(cloud.points, cloud.normals, active=np.zeros(2_000, bool)))


@pytest.mark.parametrize(
    ("values", "low", "high", "cmap", "extend"),
    [
        (np.linspace(-1, 3, 1_000), -3, 3, "coolwarm", "neither"),
        (np.linspace(1, 3, 1_000), 1, 3, "viridis", "neither"),
        (np.append(np.linspace(-1, 1, 999), 50), -1, 1, "coolwarm", "max"),
        (np.full(1_000, 2.0), 1, 3, "viridis", "neither"),
        (np.zeros(1_000), -0.5, 0.5, "coolwarm", "neither"),
    ],
)
def test_colour_map_and_limits(values, low, high, cmap, extend):
    colors = plot.Colors.of(values, None, None)
    assert np.allclose([colors.low, colors.high], [low, high], atol=0.02)
    assert colors.extend == extend
    if values.any():
        assert colors.cmap == cmap


def test_curve_and_colour_bar():
    cloud = circle(50)
    ax = plot_cloud(cloud, cloud.points[:, 0], label="temperature", title="ring")
    assert len(ax.collections[0].get_segments()) == 50
    assert ax.get_title() == "ring"
    assert ax.figure.axes[1].get_ylabel() == "temperature"


def test_panels_are_written(tmp_path):
    cloud, path = sphere(800), tmp_path / "panels.png"
    fields = {"shape": None, "x": cloud.points[:, 0], "y": cloud.points[:, 1]}
    figure = plot_fields(cloud, fields, path=path, columns=2, pixels=150, dpi=50)
    assert [ax.get_title() for ax in figure.axes if ax.get_title()] == ["shape", "x", "y"]
    image = matplotlib.image.imread(path)
    assert image.shape[0] > 200
    assert 0.05 < (image[..., :3].min(axis=-1) < 0.9).mean() < 0.9
    assert not matplotlib.pyplot.get_fignums()


def breathing():
    """A sphere that grows, and a field on it."""
    clouds = [PointCloud(r * sphere(600).points, sphere(600).normals) for r in (1.0, 1.5, 2.0)]
    return clouds, [cloud.points[:, 2] for cloud in clouds]


def test_a_sheet_has_one_frame_and_one_set_of_colours(tmp_path):
    clouds, field = breathing()
    times, path = [0.0, 0.5, 1.0], tmp_path / "sheet.png"
    figure = plot_series(clouds, field, times=times, path=path, columns=2, label="z", pixels=100)
    *panels, bar = figure.axes
    assert [ax.get_title() for ax in panels] == ["t = 0", "t = 0.5", "t = 1"]
    assert bar.get_ylabel() == "z"
    np.testing.assert_allclose(bar.get_ylim(), (-2, 2), atol=0.02)
    assert len({(ax.get_xlim(), ax.get_ylim()) for ax in panels}) == 1
    widths = [np.ptp(ax.images[0].get_extent()[:2]) for ax in panels]
    np.testing.assert_allclose(widths[2] / widths[0], 2, rtol=0.02)
    # The smallest sphere has the pale colours in the middle of the map only.
    images = [picture(ax)[0] for ax in panels]
    full = [np.abs(image[..., 0] - image[..., 2])[image[..., 3] == 1].mean() for image in images]
    assert full[0] < 0.75 * full[2]
    assert path.stat().st_size > 5_000


def test_a_film_has_a_picture_for_each_time(tmp_path):
    clouds, field = breathing()
    path = tmp_path / "film.gif"
    animate(path, clouds, field, times=[0.0, 0.5, 1.0], fps=10, dpi=40, pixels=60)
    film = PIL.Image.open(path)
    assert film.n_frames == 3 and film.info["duration"] == 100
    pictures = []
    for i in range(3):
        film.seek(i)
        pictures.append(np.asarray(film.convert("L"), float))
    assert pictures[0].shape == pictures[2].shape == (160, 200)
    dark = [(image < 250).sum() for image in pictures]
    assert dark[0] < dark[1] < dark[2]
    assert not matplotlib.pyplot.get_fignums()
    # One field on a surface that stays, and a curve.
    animate(path, sphere(300), np.stack([sphere(300).points[:, 2]] * 2), dpi=30, pixels=40)
    animate(path, [circle(40), circle(60)], dpi=30)
    assert PIL.Image.open(path).n_frames == 2


def test_films_stay_in_the_middle_and_in_their_colours(tmp_path):
    """Of a narrow surface whose field uses ever more of the map: the bar is the same throughout."""
    thin = lambda k: PointCloud(np.asarray(sphere(300).points) * [0.3, 0.3, k], sphere(300).normals)
    clouds = [thin(k) for k in (0.4, 1.0)]
    path = tmp_path / "film.gif"
    animate(path, clouds, [0 * clouds[0].points[:, 2], clouds[1].points[:, 2]], dpi=60, pixels=80)
    film, pictures = PIL.Image.open(path), []
    for i in range(2):
        film.seek(i)
        pictures.append(np.asarray(film.convert("RGB"), int))
    width = pictures[0].shape[1]
    bar = [picture[:, int(0.83 * width) :] for picture in pictures]
    assert np.abs(bar[0] - bar[1]).mean() < 0.2
    for picture in pictures:
        assert np.all(picture[0, 0] == 255)
        shape = picture[:, : int(0.83 * width)].min(axis=2) < 250
        assert abs(np.nonzero(shape)[1].mean() / width - 0.42) < 0.05


def test_bad_input():
    cloud = sphere(100)
    with pytest.raises(ValueError, match=r"field has shape \(99,\), expected \(100,\)"):
        plot_cloud(cloud, np.zeros(99))
    with pytest.raises(ValueError, match="field is nan at point 7"):
        plot_cloud(cloud, np.where(np.arange(100) == 7, np.nan, 0))
    with pytest.raises(ValueError, match="which way is up"):
        plot_cloud(cloud, view=(0, 0, 2))
    with pytest.raises(ValueError, match="no fields to draw"):
        plot_fields(cloud, {})
    with pytest.raises(ValueError, match="cloud must be concrete, not traced: draw outside jit"):
        jax.jit(plot_cloud)(cloud)


def test_without_matplotlib(monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with pytest.raises(ImportError, match=r"pip install 'jaxsurf\[pictures\]'"):
        plot_cloud(sphere(100))
