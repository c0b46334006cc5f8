"""The command line of the experiments, and that a bound that is not kept is seen."""

import json
import math
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import jaxsurf as js
from experiments import __main__ as command
from experiments import e06_ellipsoid_curvature as e06
from experiments import surfaces
from experiments.report import Row, slope, table

ROOT = Path(__file__).resolve().parents[1]


def _run(*arguments):
    # Not double precision by the environment: the command itself must ask for it.
    environment = {k: v for k, v in os.environ.items() if k != "JAX_ENABLE_X64"}
    call = [sys.executable, "-m", "experiments", *map(str, arguments)]
    return subprocess.run(call, cwd=ROOT, env=environment, capture_output=True, text=True)


def test_list_names_every_experiment(capsys):
    assert command.main(["list"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines] == list(command.EXPERIMENTS)
    assert all(len(line.split()) > 3 for line in lines)


def test_run_prints_and_writes_what_it_measured(tmp_path):
    done = _run("run", "e1", "--quick", "--out", tmp_path / "new")
    assert done.returncode == 0, done.stderr
    assert "reference" in done.stdout and "holds" in done.stdout
    result = json.loads((tmp_path / "new" / "E1.json").read_text())
    assert result["experiment"] == "E1" and result["seconds"] > 0 and "jax" in result["versions"]
    bounded = [row for row in result["rows"] if row["bound"] is not None]
    assert len(bounded) >= 2 and all(row["holds"] is True for row in bounded)
    assert set(result["rows"][0]) == {
        "quantity", "setting", "ours", "reference", "source", "bound", "holds",
    }  # fmt: skip
    finest = [row["ours"] for row in result["rows"] if row["setting"] == {"n": 400}]
    assert max(finest) < 1.5e-4  # second order in double precision; 1e-3 in single
    assert (tmp_path / "new" / "E1.png").stat().st_size > 5_000


@pytest.mark.slow
@pytest.mark.parametrize("name", ["cahn-hilliard", "geodesics", "transport", "turing", "waves"])
def test_applications_keep_their_bounds(name, tmp_path):
    done = _run("run", name, "--quick", "--out", tmp_path)
    if "skipped" in done.stdout:
        pytest.skip(done.stdout.splitlines()[-1])
    assert done.returncode == 0, done.stdout + done.stderr
    rows = json.loads((tmp_path / f"{name}.json").read_text())["rows"]
    assert sum(row["holds"] is True for row in rows) >= 3
    assert all(row["holds"] is not False for row in rows)
    assert next(tmp_path.glob("*.png")).stat().st_size > 20_000


def test_bounds_of_numpy_numbers():
    """Their comparisons are not the `False` that a failure is counted by."""
    assert Row("e", np.float64(2.0), bound=1.0).holds is False


def test_unknown_names_are_refused(tmp_path, capsys):
    with pytest.raises(SystemExit):
        command.main(["run", "E1", "E99", "--out", str(tmp_path / "none")])
    assert "E99" in capsys.readouterr().err
    assert not (tmp_path / "none").exists()


def test_a_failed_bound_is_reported(tmp_path, monkeypatch, capsys):
    class Failing:
        TITLE = "fails"

        @staticmethod
        def run(quick, out):
            return [Row("error", 2.0, bound=1.0), Row("other", 1.0)]

    monkeypatch.setitem(command.EXPERIMENTS, "E1", Failing)
    assert command.main(["run", "E1", "--out", str(tmp_path)]) == 1
    assert "FAILS" in capsys.readouterr().out
    rows = json.loads((tmp_path / "E1.json").read_text())["rows"]
    assert [row["holds"] for row in rows] == [False, None]


def test_bounds():
    assert Row("e", 1.0, bound=1.0).holds and not Row("e", 1.1, bound=1.0).holds
    assert Row("order, at least", 2.0, bound=1.8, at_least=True).holds
    assert not Row("order, at least", 1.7, bound=1.8, at_least=True).holds
    assert Row("e", math.nan, bound=1.0).holds is False
    assert Row("e", math.nan).as_json()["ours"] is None
    with pytest.raises(ValueError, match="from below"):
        Row("order", 2.0, bound=1.8, at_least=True)
    assert "FAILS" in table([Row("e", 2.0, bound=1.0)])


def test_slope_of_a_power():
    h = np.array([0.1, 0.05, 0.025])
    assert abs(slope(h, 3 * h**4) - 4) < 1e-12


@pytest.mark.parametrize("make", [surfaces.sphere, surfaces.ellipsoid, surfaces.torus])
def test_surfaces_are_what_they_say(make):
    surface = make()
    for kind in ("regular", "jittered", "Poisson disk", "random"):
        cloud = surface.cloud(kind, 300)
        assert cloud.n == 300
        on, normals = surface.project(np.asarray(cloud.points))
        assert np.abs(on - cloud.points).max() < 1e-12
        assert np.abs(normals - cloud.normals).max() < 1e-7
    # The mean of z^2 over independent points, and the divergence theorem for the field.
    cloud = surface.cloud("random", 4_000)
    u, laplacian = (np.asarray(a) for a in surface.exact(cloud))
    assert abs(laplacian.mean()) < 4 * laplacian.std() / np.sqrt(4_000)
    assert u.std() > 0.1


def test_the_grid_of_the_ellipsoid_has_the_published_number_of_points():
    u, v = e06.parameter_grid(128)
    assert len(u) == len(v) == 32_258
    cloud = e06.grid_cloud(*e06.parameter_grid(12))
    mean, gauss = e06.published_curvature(*e06.parameter_grid(12))
    exact = js.level_set_curvature(surfaces.ellipsoid().phi, cloud.points)
    np.testing.assert_allclose(mean, exact[0], rtol=1e-12)
    np.testing.assert_allclose(gauss, exact[1], rtol=1e-12)
