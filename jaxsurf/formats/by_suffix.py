"""Which format a file has, and what it holds."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

from jaxsurf.arguments import instance
from jaxsurf.formats.contents import Contents
from jaxsurf.formats.text import obj, off, xyz
from jaxsurf.formats.through_meshio import ply, stl, vtk, vtu


def contents_of(path: str | Path, columns: str | None = None) -> Contents:
    """Contents of a file, by its suffix.

    Args:
        path: file.
        columns: names of the columns of an XYZ file, see `jaxsurf.read`.

    Raises:
        OSError: no such file.
        ValueError: empty, truncated or unreadable file, unknown suffix; the message begins with
            the path.
        ImportError: meshio is needed and absent.
    """
    path = Path(instance(path, (str, Path), "path"))
    reader: Callable[[Path], Contents] | None = _READERS.get(path.suffix.lower())
    if columns is not None:
        instance(columns, str, "columns", "names with blanks between, like 'x y z value'")
        if reader is not xyz:
            raise ValueError(f"{path}: columns belong to .xyz files, this is {path.suffix!r}")
        reader = partial(xyz, columns=columns)
    if reader is None:
        known = ", ".join(_READERS)
        more = f": read the .vtu files in {path.with_suffix('')}" if path.suffix == ".pvd" else ""
        raise ValueError(f"{path}: unknown suffix {path.suffix!r}; known are {known}{more}")
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file")
    if path.stat().st_size == 0:
        raise ValueError(f"{path}: empty file")
    try:
        contents = reader(path)
        if not len(contents.points):
            raise ValueError("no points")
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error
    return contents


_READERS = {
    ".obj": obj,
    ".off": off,
    ".ply": ply,
    ".stl": stl,
    ".vtk": vtk,
    ".vtu": vtu,
    ".xyz": xyz,
}
