"""Every notebook runs from top to bottom, and ends by asserting its headline number."""

import importlib.util
import warnings
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow

# Compiled for longer than they run.
COMPILED = ("shape_optimisation",)
_FOLDER = Path(__file__).parent.parent / "notebooks"
_NOTEBOOKS = sorted(_FOLDER.glob("*.ipynb"))
_MISSING = [name for name in ("nbclient", "ipykernel") if not importlib.util.find_spec(name)]
_NEEDED = f"needs {', '.join(_MISSING)}: pip install 'jaxsurf[notebooks]'"


@pytest.mark.core
def test_there_are_notebooks():
    names = ["inverse_problems", "moving_surfaces", "patterns", "quickstart", "shape_optimisation"]
    assert [path.stem for path in _NOTEBOOKS] == names


@pytest.mark.skipif(bool(_MISSING), reason=_NEEDED)
@pytest.mark.parametrize("path", _NOTEBOOKS, ids=lambda path: path.stem)
def test_notebook_runs(path, middle_environment, quick_environment):
    import nbformat
    from nbclient import NotebookClient

    notebook = nbformat.read(path, as_version=4)
    code = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert "assert " in code[-1].source
    # Committed with its pictures, and small enough for that.
    assert any("image/png" in str(cell.outputs) for cell in code)
    assert path.stat().st_size < 2_000_000
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of the machinery that starts kernels
        client = NotebookClient(notebook, timeout=300, resources={"metadata": {"path": _FOLDER}})
        quick = path.stem in COMPILED
        client.execute(env=quick_environment if quick else middle_environment)
    printed = [output.get("name") for cell in code for output in cell.outputs]
    assert "stderr" not in printed, "a cell warns"
