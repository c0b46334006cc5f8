"""The meshes of well-known scans that are handed out beside the project."""

from __future__ import annotations

from pathlib import Path

import jaxsurf as js
from jaxsurf.io import read

FOLDER = Path(__file__).resolve().parents[2] / "shared" / "data"
BUNNY = FOLDER / "stanford-bunny.obj"
_ARMADILLO = FOLDER / "armadillo.obj"
_SPOT = FOLDER / "spot.obj"


def bunny(n: int | None = None) -> js.PointCloud:
    """The vertices of the bunny, or n quasi-uniform points on it.

    Raises:
        FileNotFoundError: the mesh is absent.
    """
    return _scan(BUNNY, n)


def armadillo(n: int | None = None) -> js.PointCloud:
    """The vertices of the Armadillo, or n quasi-uniform points on it.

    Raises:
        FileNotFoundError: the mesh is absent.
    """
    return _scan(_ARMADILLO, n)


def spot(n: int | None = None) -> js.PointCloud:
    """The vertices of the cow Spot, or n quasi-uniform points on it.

    Raises:
        FileNotFoundError: the mesh is absent.
    """
    return _scan(_SPOT, n)


def _scan(path: Path, n: int | None) -> js.PointCloud:
    if not path.exists():
        raise FileNotFoundError(f"{path} is absent: put the mesh of the Stanford repository there")
    return read(path, n=n)
