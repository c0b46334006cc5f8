"""Every experiment runs in its quick version and keeps its bounds."""

import functools
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


# Of the others so many share a process, in which what they have in common is compiled once.
TOGETHER = 10


def _with(name: str) -> tuple[str, ...]:
    """Those that run in one process with it."""
    if name in (*TIMED, *LONG):
        return (name,)
    others = [other for other in EXPERIMENTS if other not in (*TIMED, *LONG)]
    first = others.index(name) // TOGETHER * TOGETHER
    return tuple(others[first : first + TOGETHER])


@pytest.fixture(scope="module")
def ran(tmp_path_factory, environment, middle_environment, quick_environment):
    """What an experiment printed, what went wrong in its process, and the folder of its results."""

    @functools.cache
    def run(*names):
        about = middle_environment if names[0] in LONG else quick_environment
        about = environment if names[0] in TIMED else about
        # Not double precision by the environment: the command itself must ask for it.
        about = {k: v for k, v in about.items() if k != "JAX_ENABLE_X64"}
        out = tmp_path_factory.mktemp(names[0])
        call = [sys.executable, "-m", "experiments", "run", *map(str.lower, names)]
        call += ["--quick", "--out", out]
        return subprocess.run(call, cwd=ROOT, env=about, capture_output=True, text=True), out

    def of(name):
        names = _with(name)
        done, out = run(*names)
        printed = done.stdout.partition(f"{name}: {EXPERIMENTS[name][1]}\n")[2]
        for other in names[names.index(name) + 1 :]:
            printed = printed.partition(f"{other}: {EXPERIMENTS[other][1]}\n")[0]
        return printed, done.stderr, out

    return of


@pytest.mark.slow
@pytest.mark.parametrize("name", EXPERIMENTS)
def test_quick(name, ran):
    printed, errors, out = ran(name)
    if "skipped" in printed:
        pytest.skip(printed.splitlines()[-1])
    assert "bounds hold" in printed and "FAILS" not in printed, printed + errors
    result = json.loads((out / f"{name}.json").read_text())
    assert result["experiment"] == name and result["seconds"] > 0 and "jax" in result["versions"]
    rows = result["rows"]
    assert set(rows[0]) == {
        "quantity", "setting", "ours", "reference", "source", "bound", "holds",
    }  # fmt: skip
    assert all(row["holds"] is not False for row in rows)
    if name == "E1":  # second order in double precision; 1e-3 in single
        assert max(row["ours"] for row in rows if row["setting"] == {"n": 400}) < 1.5e-4
    for picture in out.glob("*.png"):
        assert picture.stat().st_size > 5_000
