"""The command: its headline numbers, its files, and one line for every mistake."""

import re
import subprocess
import sys
from pathlib import Path

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

import jaxsurf as js
from jaxsurf import demo
from jaxsurf.cli import main
from jaxsurf.formats.by_suffix import contents_of
from jaxsurf.heat import Heat, carried, cell_areas, diffuse, spot

from .helpers import check_derivative

_DATA = Path("../shared/data")


def run(capsys, *arguments) -> tuple[int, str, str]:
    code = main(["demo", *map(str, arguments)])
    out, err = capsys.readouterr()
    return code, out, err


def stages_told(err: str) -> list[str]:
    """What is said of the progress where there is no terminal: a line for each stage, in order."""
    told = [re.fullmatch(r" *[\d.]+ s  (\d)/6 (\w+)", row) for row in err.splitlines()]
    assert [int(found[1]) for found in told] == list(range(1, len(told) + 1))
    return [found[2] for found in told]


def line(report: str, label: str) -> str:
    return next(row for row in report.splitlines() if row.startswith(label))


def number(report: str, label: str, before: str) -> float:
    """The number that follows some words in the line of a label."""
    found = re.search(re.escape(before) + r"\s*(-?[\d.,]+(e[+-]?\d+)?)", line(report, label))
    return float(found[1].replace(",", ""))


def check_files(folder: Path, n: int) -> None:
    picture = (folder / "demo.png").read_bytes()
    assert picture.startswith(b"\x89PNG") and len(picture) > 50_000
    fields = contents_of(folder / "demo.vtu").fields
    for name in ("mean_curvature", "Gauss_curvature", "heat_0", "heat_2", "sensitivity", "area"):
        assert fields[name].shape == (n,) and np.isfinite(fields[name]).all()
    # Heat spreads: its peak falls, nothing is overheated or undercooled by much.
    assert fields["heat_0"].max() == 1
    assert fields["heat_2"].max() < 0.5
    assert fields["heat_2"].min() > -1e-3


def test_demo(tmp_path, capsys):
    # Few points: nearly all of the time is compilation.
    code, report, err = run(capsys, "--points", 3_000, "--out", tmp_path)
    assert code == 0 and stages_told(err) == list(demo.STAGES)
    assert "points           3,000" in report
    # How long it took, in all and by stages.
    took = float(re.search(r"\ndone in ([\d.]+) s on \d+ cores", report)[1])
    assert took == pytest.approx(sum(map(float, line(report, "  total").split()[1:])), abs=0.2)
    assert "GFDM(degree=4)" in line(report, "method")
    assert number(report, "heat conserved", "to") < 1e-12
    assert 1e-6 < number(report, "heat conserved", "correction to") < 5e-3
    assert number(report, "  difference", "relative difference") < 1e-6
    # The largest modulus of the fourth-order Laplacian is 4.6 / h² on even points.
    h = number(report, "points", ", ")
    assert 3 < number(report, "spectrum", "modulus") * h**2 < 7
    assert abs(number(report, "spectrum", "real part")) < 1e-3
    # Gauss curvature of the outer equator of the tori: 1 / (0.4 (1 + 0.4)).
    assert abs(number(report, "Gauss curvature", "to") - 1 / 0.56) < 0.02
    # What is not said in the report is not said at all.
    assert all("bends within one stencil" in row for row in report.splitlines() if "note" in row)
    check_files(tmp_path, 3_000)


@pytest.mark.slow
@pytest.mark.skipif(not _DATA.is_dir(), reason="no folder ../shared/data with the scans")
def test_demo_on_a_scan(tmp_path, capsys):
    # No normals in the file, unused vertices, holes, ears thinner than a stencil.
    path = _DATA / "stanford-bunny.obj"
    arguments = ("--surface", path, "--points", 2_000, "--method", "dcpse2", "--out", tmp_path)
    code, report, err = run(capsys, *arguments)
    assert code == 0 and stages_told(err) == list(demo.STAGES)
    assert "1113 vertices belong to no triangle" in report
    assert "on borders" in line(report, "points")
    assert number(report, "  difference", "relative difference") < 1e-6
    assert number(report, "heat conserved", "to") < 0.1
    check_files(tmp_path, 2_000)


def write_grid(path: Path) -> None:
    """A wavy rectangle as a mesh, without normals."""
    m = 40
    x, y = np.meshgrid(np.linspace(0, 3, m), np.linspace(0, 3, m), indexing="ij")
    vertices = np.stack([x, y, 0.2 * np.sin(x) * np.cos(y)], axis=-1).reshape(-1, 3)
    i = (np.arange(m - 1)[:, None] * m + np.arange(m - 1)).ravel()
    faces = np.concatenate([np.stack(t, 1) for t in ((i, i + m, i + 1), (i + 1, i + m, i + m + 1))])
    rows = [f"v {a} {b} {c}" for a, b, c in vertices] + [f"f {a} {b} {c}" for a, b, c in faces + 1]
    path.write_text("\n".join(rows) + "\n")


def test_surface_from_file(tmp_path):
    path = tmp_path / "grid.obj"
    write_grid(path)
    own, even = demo.surface_from_file(path, "all"), demo.surface_from_file(path, 900)
    assert own.cloud.n == 1_600 and even.cloud.n == 900
    np.testing.assert_allclose(own.moved(2.0).points, 2 * own.cloud.points)
    assert int(own.cloud.boundary.sum()) == 4 * 39
    # A list of points has nothing to resample, and does not tell where its border is.
    cloud = js.sphere(300)
    js.write(tmp_path / "points.xyz", cloud)
    for n in (None, "all"):
        assert demo.surface_from_file(tmp_path / "points.xyz", n).cloud.n == 300
    with pytest.raises(ValueError, match="no triangles to sample 100 points on"):
        demo.surface_from_file(tmp_path / "points.xyz", 100)
    with pytest.raises(ValueError, match="no point looks like a border point"):
        demo.surface_from_file(tmp_path / "points.xyz", border=True)
    with pytest.raises(ValueError, match="triangles tell where the border is"):
        demo.surface_from_file(path, border=True)
    js.write(tmp_path / "sheet.xyz", js.PointCloud(own.cloud.points, own.cloud.normals))
    sheet = demo.surface_from_file(tmp_path / "sheet.xyz", border=True).cloud
    np.testing.assert_array_equal(sheet.boundary, own.cloud.boundary)


def test_heat_takes_shorter_steps_for_eigenvalues_beside_the_real_axis():
    """Coarse scans have some: 40 steps, as many as the radius asks for, were refused."""
    surface = js.discretize(js.circle(60), method=js.GFDM(degree=2))
    plain, x, start = surface.laplacian, surface.cloud.points, spot(surface.cloud, 0, 0.5)
    around = jnp.stack([-x[:, 1], x[:, 0]])
    turning = jnp.sum(surface.gradient.weights * around, axis=1)
    skew = plain.of_weights(plain.weights + 10 * turning)
    for laplacian, steps in ((plain, (40, 40)), (skew, (41, 60))):
        heat = Heat.within(1.0, laplacian, js.spectral_estimate(laplacian).radius)
        assert steps[0] <= heat.steps <= steps[1]
        peaks = jnp.max(jnp.abs(diffuse(laplacian, None, start, heat)), axis=1)
        assert peaks[2] < peaks[1] < peaks[0] == 1
    with pytest.raises(ValueError, match="is unstable"):
        diffuse(skew, None, start, heat._replace(steps=40))


@pytest.mark.parametrize("dim", [2, 3])
def test_cell_areas(dim):
    cloud = js.sphere(2_000) if dim == 3 else js.circle(200)
    areas = cell_areas(cloud, js.find_neighbors(cloud, k=20 if dim == 3 else 7))
    measure = 4 * np.pi if dim == 3 else 2 * np.pi
    assert abs(float(areas.sum()) / measure - 1) < 2e-3
    assert float(jnp.std(areas) / jnp.mean(areas)) < 0.02
    # Second moment of a coordinate: a third (a half) of the measure.
    moment = float(areas @ cloud.points[:, -1] ** 2) / measure
    assert abs(moment - 1 / dim) < 1e-3


@pytest.mark.parametrize("dim, n, off", [(2, 200, 1e-3), (3, 1_000, 1e-2), (3, 4_000, 5e-3)])
def test_areas_that_a_motion_carries_along(dim, n, off):
    """As a linear map stretches the tangent planes, on average."""
    cloud = js.sphere(n) if dim == 3 else js.circle(n)
    neighbors = js.find_neighbors(cloud, k=20 if dim == 3 else 7)
    areas, axes = cell_areas(cloud, neighbors), jnp.array([1.0, 0.7, 1.3])[:dim]

    def carried_to(axes):
        normals = cloud.normals / axes
        normals = normals / jnp.linalg.norm(normals, axis=1, keepdims=True)
        return carried(areas, cloud, js.PointCloud(cloud.points * axes, normals), neighbors)

    np.testing.assert_allclose(carried_to(jnp.ones(dim)), areas, rtol=1e-14)
    stretch = jnp.prod(axes) * jnp.linalg.norm(cloud.normals / axes, axis=1)
    error = carried_to(axes) / (areas * stretch) - 1
    assert float(jnp.sqrt(jnp.mean(error**2))) < off
    check_derivative(lambda axes: jnp.sum(carried_to(axes) ** 2), axes, rtol=1e-7)


def test_meshes_of_few_triangles_are_taken_as_they_are(tmp_path, capsys):
    """The eight corners of a box allow no smooth fit; a wall that stands on it is left out."""
    corners = [f"v {x} {y} {z}\n" for x in (0, 1) for y in (0, 1) for z in (0, 1)]
    sides = "1 2 4 3", "5 7 8 6", "1 5 6 2", "3 4 8 7", "1 3 7 5", "2 6 8 4"
    box = "".join([*corners, *(f"f {side}\n" for side in sides)])
    path = tmp_path / "box.obj"
    path.write_text(box)
    code, _, err = run(capsys, "--surface", path, "--out", tmp_path)
    assert code == 2 and "at least 17" in err
    assert demo.surface_from_file(path, 500, smooth=False).cloud.n == 500
    path.write_text(box + "v 0 0 -1\nf 1 3 9\n")
    options = "--surface", path, "--points", 600, "--flat", "--out", tmp_path
    code, _, err = run(capsys, *options)
    assert code == 2 and "largest_part" in err
    _, report, _ = run(capsys, *options, "--largest-part")
    assert "points           600" in report and "dropped, so that no edge" in report


def test_the_spot_keeps_away_from_a_border():
    """The middle of the picture of an open cylinder is on its rim, where temperatures are held."""
    cloud = js.surface_of_revolution(lambda s: (1 + 0 * s, s), 600)
    surface = demo.Surface(cloud, "a tube", ("scale", 1.0), lambda value: cloud)
    held = np.asarray(cloud.points)[np.asarray(cloud.boundary)]
    away = np.linalg.norm(np.asarray(cloud.points)[:, None] - held, axis=2).min(axis=1)
    here = away[demo.central_point(surface)]
    assert here >= min(surface.size / 3, away.max()) > 0.3


def test_heat_without_bound_is_one_line(tmp_path, monkeypatch, capsys):
    def grows(*arguments):
        raise eqx.EquinoxRuntimeError("what runs within jit ends with")

    monkeypatch.setattr(demo, "_with_gradient", grows)
    code, out, err = run(capsys, "--points", 600, "--out", tmp_path)
    *_, error = err.splitlines()
    assert code == 2 and out == "" and "eigenvalues of the operator have real parts up to" in error


@pytest.mark.parametrize(
    "arguments, words",
    [
        (["--surface", "nowhere.obj"], "nowhere.obj: no such file"),
        (["--surface", "empty.obj"], "empty.obj: empty file"),
        (["--surface", "broken.obj"], "broken.obj"),
        (["--surface", "notes.txt"], "unknown suffix"),
        (["--time", "-1"], "time = -1.0, expected a positive number"),
        (["--time", "nan"], "time = nan, expected a positive number"),
        (["--points", "2"], "n = 2 points, needs at least 4"),
        (["--points", "40"], "needs at least"),
        (["--out", "notes.txt"], "notes.txt"),
    ],
)
def test_bad_input_is_one_line(arguments, words, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    Path("empty.obj").write_text("")
    Path("broken.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1\nf 1 2 3\n")
    Path("notes.txt").write_text("hello\n")
    code, out, err = run(capsys, *arguments)
    assert code == 2 and out == ""
    *progress, error = err.splitlines()
    assert words in error and error.startswith("jaxsurf demo: error: ")
    assert stages_told("\n".join(progress)) == list(demo.STAGES)[: len(progress)]


@pytest.mark.parametrize(
    "arguments",
    [[], ["dance"], ["demo", "--points", "many"], ["demo", "--points", "-5"],
     ["demo", "--method", "fem"], ["demo", "--points", "all"], ["demo", "--flat"],
     ["demo", "--largest-part"], ["demo", "--border"]],
)  # fmt: skip
def test_bad_arguments(arguments, capsys):
    with pytest.raises(SystemExit) as stop:
        main(arguments)
    assert stop.value.code == 2
    assert "error:" in capsys.readouterr().err


def test_module_and_version():
    command = [sys.executable, "-m", "jaxsurf", "--version"]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert done.stdout == f"jaxsurf {js.__version__}\n"


def test_growth_is_not_healthy():
    """An unstable run or a wrong gradient must not end with exit code 0."""

    class Result(demo.Demo):
        stable, disagreement = True, 1e-9

        def __init__(self):
            pass

    result = Result()
    assert demo.healthy(result)
    Result.stable = False
    assert not demo.healthy(result)
    Result.stable, Result.disagreement = True, float("nan")
    assert not demo.healthy(result)
