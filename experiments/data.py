"""The meshes of the Stanford repository that are handed out beside the project."""

from __future__ import annotations

from pathlib import Path

import jaxsurf as js
from jaxsurf.io import read

FOLDER = Path(__file__).resolve().parents[2] / "shared" / "data"
_BUNNY = FOLDER / "stanford-bunny.obj"


def bunny(n: int | None = None) -> js.PointCloud:
    """The vertices of the bunny, or n quasi-uniform points on it.

    Raises:
        FileNotFoundError: the mesh is absent.
    """
    if not _BUNNY.exists():
        raise FileNotFoundError(f"{_BUNNY} is absent: put the Stanford bunny there")
    return read(_BUNNY, n=n)
