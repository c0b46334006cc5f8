"""PLY, STL and VTK files, read by meshio, guarded against files that end early."""

from __future__ import annotations

import codecs
import io
import re
import tempfile
from collections.abc import Callable
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType

import numpy as np

from jaxsurf.formats.contents import Contents, complete


def meshio() -> ModuleType:
    """The optional package meshio, or an error that says how to get it."""
    try:
        import meshio
    except ImportError as error:
        raise ImportError(
            "PLY, STL and VTK files need the package meshio: pip install 'jaxsurf[files]'"
        ) from error
    return meshio


_SURFACE_CELLS = ("triangle", "quad", "polygon")


def _through(reader: Callable, source):
    try:
        # It guesses at a size from the text of an ASCII file.
        with np.errstate(over="ignore"):
            return reader(source)
    # They raise whatever their parsing stumbles over.
    except Exception as error:
        raise ValueError(f"not readable ({type(error).__name__}: {error})") from error


def _bytes(path: Path) -> bytes:
    return path.read_bytes().removeprefix(codecs.BOM_UTF8)


def ply(path: Path) -> Contents:
    data = _bytes(path)
    found = re.search(rb"\nend_header[ \t]*\r?\n", data)
    if not data.startswith(b"ply") or found is None:
        raise ValueError("not a PLY file, or truncated within its header")
    end = found.start() + 1
    # Both names are in use; meshio knows the first only.
    header = re.sub(rb"\bvertex_index\b", b"vertex_indices", data[:end])
    # It takes unsigned bytes of a binary file for signed ones, and knows not all names of types.
    for name, known in _PLY_TYPES.items():
        header = re.sub(rb"(?m)^(\s*property\s+)%b\s" % name, rb"\1%b " % known, header)
    counts = {k.decode(): int(v) for k, v in re.findall(rb"element\s+(\w+)\s+(\d+)", header)}
    for what in ("vertex", "face"):
        # Checked before a reader reserves memory for what the header announces.
        complete(f"bytes of the element {what}", counts.get(what, 0), len(data))
    face = re.search(rb"element\s+face\b.*?\n((?:\s*property.*\n)*)", header)
    if b"format binary" in header and face and len(face[1].strip().splitlines()) > 1:
        # meshio would read these property after property instead of face after face.
        raise ValueError("binary faces with more properties than their vertices; save as ASCII")
    if counts.get("face") == 0:
        header = re.sub(rb"element\s+face\s+0.*?\n(?:\s*property.*\n)*", b"", header)
    mesh = _through(meshio().ply.read, io.BytesIO(header + data[end:]))
    complete("vertices", counts.get("vertex", 0), len(mesh.points))
    sizes = [len(c.data) for c in mesh.cells if np.ndim(c.data) == 2 and c.data.shape[1] >= 3]
    complete("faces", counts.get("face", 0), sum(sizes))
    return _contents(mesh)


_PLY_TYPES = {b"uchar": b"uint8", b"char": b"int8", b"ushort": b"uint16", b"float64": b"double"}


def stl(path: Path) -> Contents:
    data = _bytes(path)
    announced = int(np.frombuffer(data[80:84], "<u4")[0]) if len(data) >= 84 else 0
    binary = len(data) == 84 + 50 * announced
    if not binary and not data.lstrip().startswith(b"solid"):
        complete("bytes", 84 + 50 * announced, len(data))
    if not binary and b"endsolid" not in data[-1000:]:
        raise ValueError("truncated: no endsolid")
    with _unmarked(path, data) as plain:
        contents = _contents(_through(meshio().stl.read, plain))
    corners = 3 * sum(map(len, contents.faces))
    note = f"{corners} corners of triangles merged into {len(contents.points)} vertices"
    return Contents(contents.points, contents.faces, notes=[note])


def vtk(path: Path) -> Contents:
    data = _bytes(path)
    # Checked before a reader reserves memory for what a line announces.
    for count in re.findall(rb"(?m)^(?:POINTS|CELLS|POINT_DATA|CELL_DATA)\s+(\d+)", data):
        complete("entries", int(count), len(data))
    with _unmarked(path, data) as plain:
        return _contents(_through(meshio().vtk.read, plain))


def vtu(path: Path) -> Contents:
    with _unmarked(path, _bytes(path)) as plain:
        return _contents(_through(meshio().vtu.read, plain))


@contextmanager
def _unmarked(path: Path, data: bytes):
    """The file, or a copy without the mark of UTF-8 at its start: these readers need a file."""
    if path.stat().st_size == len(data):
        yield path
        return
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder) / path.name
        copy.write_bytes(data)
        yield copy


def _contents(mesh) -> Contents:
    points = np.asarray(mesh.points, float)
    if points.ndim == 2 and points.shape[1] == 2:
        points = np.pad(points, ((0, 0), (0, 1)))
    faces, notes = [], []
    for cells in mesh.cells:
        if cells.type in _SURFACE_CELLS:
            faces.append(np.asarray(cells.data, np.int64))
        elif cells.type == "line":
            notes.append(f"{len(cells.data)} line cells ignored")
        elif cells.type != "vertex":
            raise ValueError(f"cells of type {cells.type!r} do not make a surface of polygons")
    # VTK files are big-endian.
    native = lambda v: v.astype(v.dtype.newbyteorder("="))
    data = {k: native(np.asarray(v)) for k, v in mesh.point_data.items()}
    normals = None
    for name in ("normals", "Normals"):
        if normals is None and name in data and data[name].shape == points.shape:
            normals = data.pop(name).astype(float)
    if normals is None and {"nx", "ny", "nz"} <= data.keys():
        normals = np.stack([data.pop(k) for k in ("nx", "ny", "nz")], axis=1).astype(float)
    return Contents(points, faces, normals, data, notes)
