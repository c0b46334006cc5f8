"""The command line of the experiments, and that a bound that is not kept is seen."""

import importlib
import inspect
import json
import math
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

import jaxsurf as js
from experiments import __main__ as command
from experiments import e01_circle_laplacian as e01
from experiments import e06_ellipsoid_curvature as e06
from experiments import surfaces
from experiments.benchmarks import prompt, shapes
from experiments.report import Row, slope, table

ROOT = Path(__file__).resolve().parents[1]


# All but the neural one, which fits a network first: it tells its slope itself.
OBJECTIVES = [name for name in shapes.SIZES if name != "neural-bunny"]


@pytest.mark.slow
@pytest.mark.parametrize("name", OBJECTIVES)
def test_derivatives_of_objectives(name):
    """What an experiment minimises, less its line of first order, is of second order."""
    module = importlib.import_module(f"experiments.{command.EXPERIMENTS[name][0]}")
    f, theta = module.problem(shapes.SIZES[name][1])
    flat, unravel = ravel_pytree(theta)
    noise = np.random.default_rng(0).normal(size=flat.shape)
    direction = unravel(jnp.asarray(noise * np.linalg.norm(flat) / np.linalg.norm(noise)))
    steps = jnp.array([1e-3, 5e-4, 2.5e-4])
    found = js.taylor_remainders(jax.jit(f), theta, direction, steps=steps)
    assert abs(found.slope - 2) < 0.05, found


def test_list_names_every_experiment(capsys):
    assert command.main(["list"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines] == list(command.EXPERIMENTS)
    assert all(len(line.split()) > 3 for line in lines)


def test_list_needs_no_package_of_a_single_experiment():
    program = (
        "import sys; sys.modules.update(skfem=None, matplotlib=None)\n"
        "from experiments.__main__ import main; sys.exit(main(['list']))"
    )
    call = [sys.executable, "-c", program]
    done = subprocess.run(call, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0 and "E8" in done.stdout, done.stderr


def test_bounds_of_numpy_numbers():
    """Their comparisons are not the `False` that a failure is counted by."""
    assert Row("e", np.float64(2.0), bound=1.0).holds is False


def test_unknown_names_are_refused(tmp_path, capsys):
    with pytest.raises(SystemExit):
        command.main(["run", "E1", "E99", "--out", str(tmp_path / "none")])
    assert "E99" in capsys.readouterr().err
    assert not (tmp_path / "none").exists()


def test_a_failed_bound_is_reported(tmp_path, monkeypatch, capsys):
    rows = [Row("error", 2.0, bound=1.0), Row("other", 1.0)]
    monkeypatch.setattr(e01, "run", lambda quick, out: rows)
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


@pytest.mark.core
def test_first_calls_of_all_public_functions_are_timed():
    """The README's claim is about all of them."""
    timed = inspect.getsource(prompt)
    functions = [name for name, value in vars(js).items() if inspect.isfunction(value)]
    assert len(functions) > 60
    assert not [name for name in functions if f"js.{name}(" not in timed]
