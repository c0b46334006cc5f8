"""Every experiment runs in its quick version and keeps its bounds."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from experiments.__main__ import EXPERIMENTS

ROOT = Path(__file__).resolve().parents[1]
# Those with bounds on what things cost, which hold of programs as users compile them.
TIMED = ("E3",)
# Those that run for about as long as they are compiled.
LONG = ("conductivity", "E16", "neural-bunny", "sphere-flow")


@pytest.mark.slow
@pytest.mark.parametrize("name", EXPERIMENTS)
def test_quick(name, tmp_path, environment, middle_environment, quick_environment):
    about = middle_environment if name in LONG else quick_environment
    about = environment if name in TIMED else about
    # Not double precision by the environment: the command itself must ask for it.
    about = {k: v for k, v in about.items() if k != "JAX_ENABLE_X64"}
    call = [sys.executable, "-m", "experiments", "run", name.lower(), "--quick", "--out", tmp_path]
    done = subprocess.run(call, cwd=ROOT, env=about, capture_output=True, text=True)
    if "skipped" in done.stdout:
        pytest.skip(done.stdout.splitlines()[-1])
    assert done.returncode == 0, done.stdout + done.stderr
    assert "bounds hold" in done.stdout
    result = json.loads((tmp_path / f"{name}.json").read_text())
    assert result["experiment"] == name and result["seconds"] > 0 and "jax" in result["versions"]
    rows = result["rows"]
    assert set(rows[0]) == {
        "quantity", "setting", "ours", "reference", "source", "bound", "holds",
    }  # fmt: skip
    assert all(row["holds"] is not False for row in rows)
    if name == "E1":  # second order in double precision; 1e-3 in single
        assert max(row["ours"] for row in rows if row["setting"] == {"n": 400}) < 1.5e-4
    for picture in tmp_path.glob("*.png"):
        assert picture.stat().st_size > 5_000
