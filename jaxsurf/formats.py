"""What files hold: raw points, faces, normals and fields, one function per format.

OBJ, OFF and XYZ are plain text and parsed here: common readers refuse textured OBJ files, drop
unused vertices or take a truncated file for a short one. PLY, STL and VTK go through meshio,
guarded against files that end early.
"""

from __future__ import annotations

import codecs
import io
import re
import tempfile
from collections.abc import Callable
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from types import ModuleType

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray as Array

from jaxsurf.arguments import instance, raise_at

# Rows of three columns in text files are normals if they are this close to length one: what two
# decimals leave.
_UNIT = 0.01


@dataclass(frozen=True, eq=False)
class Contents:
    """What a file holds, before any check of its meaning.

    Args:
        points: `(n, 3)`, or `(n, 2)` for a plane curve.
        faces: polygons as vertex numbers from 0, one array `(m, corners)` per run of equal size.
        normals: `(n, d)` as found, of any length; None if there are none.
        fields: other values per point, `(n,)` or `(n, c)`.
        notes: what was converted on the way, in words.
    """

    points: Float[Array, "n d"]
    faces: list[Int[Array, "m corners"]] = field(default_factory=list)
    normals: Float[Array, "n d"] | None = None
    fields: dict[str, Array] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)


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
        if reader is not _xyz:
            raise ValueError(f"{path}: columns belong to .xyz files, this is {path.suffix!r}")
        reader = partial(_xyz, columns=columns)
    if reader is None:
        known = ", ".join(_READERS)
        raise ValueError(f"{path}: unknown suffix {path.suffix!r}; known are {known}")
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


def meshio() -> ModuleType:
    """The optional package meshio, or an error that says how to get it."""
    try:
        import meshio
    except ImportError as error:
        raise ImportError(
            "PLY, STL and VTK files need the package meshio: pip install 'jaxsurf[files]'"
        ) from error
    return meshio


# --- text formats --------------------------------------------------------------------------


def _obj(path: Path) -> Contents:
    points: list[list[float]] = []
    directions: list[list[float]] = []
    runs: list[list[list[int]]] = []
    corner_normals: list[tuple[int, int]] = []
    bare_corners = 0
    for number, line in _lines(path):
        word, *rest = line.split()
        try:
            if word == "v":
                points.append(_numbers(rest, 3))
            elif word == "vn":
                directions.append(_numbers(rest, 3))
            elif word == "f":
                if len(rest) < 3:
                    raise ValueError(f"a face with {len(rest)} corners, at least 3 are needed")
                face = []
                for corner in rest:
                    index, *others = corner.split("/")
                    # Negative numbers count back from the last vertex so far.
                    i = int(index)
                    face.append(i - 1 if i > 0 else len(points) + i if i < 0 else -1)
                    if len(others) == 2 and others[1]:
                        j = int(others[1])
                        corner_normals.append((face[-1], j - 1 if j > 0 else len(directions) + j))
                    else:
                        bare_corners += 1
                if not runs or len(runs[-1][-1]) != len(face):
                    runs.append([])
                runs[-1].append(face)
        except ValueError as error:
            raise ValueError(f"line {number}: {error}") from None
    x = np.array(points, float).reshape(-1, 3)
    faces = [np.array(run) for run in runs]
    normals, notes = None, []
    if corner_normals and bare_corners:
        notes.append(f"normals ignored: {bare_corners} corners of faces have none")
    elif corner_normals:
        normals = _from_corners(np.array(corner_normals), np.array(directions), len(x))
    elif directions and not runs and len(directions) == len(points):
        normals = np.array(directions)
    elif directions:
        notes.append(f"{len(directions)} normals ignored: no face refers to them")
    return Contents(x, faces, normals, notes=notes)


def _from_corners(corners, directions, n):
    """Mean over the corners at each vertex of their unit normals."""
    if len(directions) == 0 or corners[:, 1].min() < 0 or corners[:, 1].max() >= len(directions):
        raise ValueError(
            f"a face names normal {corners[:, 1].max() + 1}, there are {len(directions)}"
        )
    if corners[:, 0].min() < 0 or corners[:, 0].max() >= n:
        return None  # the faces themselves are about to be refused
    total = np.zeros((n, 3))
    unit = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    pairs = np.unique(corners, axis=0)
    np.add.at(total, pairs[:, 0], unit[pairs[:, 1]])
    return total


def _off(path: Path) -> Contents:
    lines = _lines(path)
    number, first = next(lines, (1, ""))
    kind = re.match(r"(C|N|CN)?OFF\b", first)
    if kind is None:
        raise ValueError(f"line {number}: expected OFF, COFF or NOFF, found {first[:20]!r}")
    counts = first[kind.end() :].split()
    if not counts:
        number, line = next(lines, (number, ""))
        counts = line.split()
    try:
        n, m = int(counts[0]), int(counts[1])
    except (IndexError, ValueError):
        raise ValueError(
            f"line {number}: expected the numbers of vertices and faces, found {counts}"
        ) from None
    with_normals = "N" in (kind.group(1) or "")
    rows: list[list[float]] = []
    runs: list[list[list[int]]] = []
    found = 0
    for number, line in lines:
        word = line.split()
        try:
            if len(rows) < n:
                rows.append(_numbers(word, 6 if with_normals else 3))
                continue
            if found == m:
                break
            size = int(word[0])
            if size < 3 or len(word) < size + 1:
                raise ValueError(f"expected a face of {size} corners, found {len(word) - 1}")
            face = [int(w) for w in word[1 : size + 1]]
        except ValueError as error:
            raise ValueError(f"line {number}: {error}") from None
        if not runs or len(runs[-1][-1]) != size:
            runs.append([])
        runs[-1].append(face)
        found += 1
    _complete("vertices", n, len(rows))
    _complete("faces", m, found)
    x = np.array(rows, float).reshape(-1, 6 if with_normals else 3)
    return Contents(x[:, :3], [np.array(run) for run in runs], x[:, 3:] if with_normals else None)


def _xyz(path: Path, columns: str | None = None) -> Contents:
    with path.open(encoding="utf-8-sig", errors="replace") as file:
        text = file.read()
    rows = np.loadtxt(io.StringIO(text), comments="#", ndmin=2)
    count = rows.shape[1]
    if columns is None:
        # A first comment that names every column, as `write` leaves it.
        first = text.lstrip().split("\n", 1)[0]
        title = first[1:].split() if first.startswith("#") else []
        if len(title) == count and title[:2] == ["x", "y"]:
            columns = " ".join(title)
    names = _guessed(rows) if columns is None else columns.split()
    if len(names) != count:
        raise ValueError(f"columns names {len(names)} ({' '.join(names)}), there are {count}")
    if len(set(names)) < len(names):
        raise ValueError(f"columns names one twice: {' '.join(names)}")
    column = dict(zip(names, rows.T, strict=True))
    if not {"x", "y"} <= column.keys():
        raise ValueError(f"columns must name x and y, not only {' '.join(names)}")
    axes = [a for a in "xyz" if a in column]
    points = np.stack([column.pop(a) for a in axes], axis=1)
    parts = [a for a in ("nx", "ny", "nz") if a in column]
    if parts and parts != ["n" + a for a in axes]:
        raise ValueError(f"columns name {' '.join(parts)} of the normals of {' '.join(axes)}")
    normals = np.stack([column.pop(a) for a in parts], axis=1) if parts else None
    return Contents(points, normals=normals, fields=column)


def _guessed(rows: Float[Array, "n c"]) -> list[str]:
    """What the columns are, where their number and the length of the normals leave no doubt."""
    known = {2: "x y", 3: "x y z", 4: "x y nx ny", 6: "x y z nx ny nz"}
    count = rows.shape[1]
    if count not in known:
        raise ValueError(
            f"{count} columns; expected x y [nx ny] in the plane or x y z [nx ny nz] in space. "
            "Name others, as in columns='x y z value'"
        )
    if count > 3:
        last = rows[:, count // 2 :]
        length = np.linalg.norm(last, axis=1)
        other = "x y z value" if count == 4 else "x y z r g b"
        raise_at(
            ~(np.abs(length - 1) <= _UNIT),
            f"{count} columns, of which the last {count // 2} are no unit normals: row {{i}} has "
            f"length {{v:.4g}}, expected 1. Say what they are with columns='{other}' or "
            f"columns='{known[count]}' (directions of any length)",
            length,
        )
    return known[count].split()


def _lines(path: Path):
    """Lines that say something, with their numbers; comments and continuations resolved."""
    pending = ""
    with path.open(encoding="utf-8-sig", errors="replace") as file:
        for number, line in enumerate(file, 1):
            line = pending + line.split("#", 1)[0].strip()
            if line.endswith("\\"):
                pending = line[:-1] + " "
            elif line:
                pending = ""
                yield number, line


def _numbers(words: list[str], count: int) -> list[float]:
    if len(words) < count:
        raise ValueError(f"expected {count} numbers, found {len(words)}")
    return [float(w) for w in words[:count]]


def _complete(what: str, announced: int, found: int) -> None:
    if found < announced:
        raise ValueError(f"truncated: {announced} {what} announced, {found} found")


# --- through meshio ------------------------------------------------------------------------

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


def _ply(path: Path) -> Contents:
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
        _complete(f"bytes of the element {what}", counts.get(what, 0), len(data))
    face = re.search(rb"element\s+face\b.*?\n((?:\s*property.*\n)*)", header)
    if b"format binary" in header and face and len(face[1].strip().splitlines()) > 1:
        # meshio would read these property after property instead of face after face.
        raise ValueError("binary faces with more properties than their vertices; save as ASCII")
    if counts.get("face") == 0:
        header = re.sub(rb"element\s+face\s+0.*?\n(?:\s*property.*\n)*", b"", header)
    mesh = _through(meshio().ply.read, io.BytesIO(header + data[end:]))
    _complete("vertices", counts.get("vertex", 0), len(mesh.points))
    sizes = [len(c.data) for c in mesh.cells if np.ndim(c.data) == 2 and c.data.shape[1] >= 3]
    _complete("faces", counts.get("face", 0), sum(sizes))
    return _contents(mesh)


_PLY_TYPES = {b"uchar": b"uint8", b"char": b"int8", b"ushort": b"uint16", b"float64": b"double"}


def _stl(path: Path) -> Contents:
    data = _bytes(path)
    announced = int(np.frombuffer(data[80:84], "<u4")[0]) if len(data) >= 84 else 0
    binary = len(data) == 84 + 50 * announced
    if not binary and not data.lstrip().startswith(b"solid"):
        _complete("bytes", 84 + 50 * announced, len(data))
    if not binary and b"endsolid" not in data[-1000:]:
        raise ValueError("truncated: no endsolid")
    with _unmarked(path, data) as plain:
        contents = _contents(_through(meshio().stl.read, plain))
    corners = 3 * sum(map(len, contents.faces))
    note = f"{corners} corners of triangles merged into {len(contents.points)} vertices"
    return Contents(contents.points, contents.faces, notes=[note])


def _vtk(path: Path) -> Contents:
    data = _bytes(path)
    # Checked before a reader reserves memory for what a line announces.
    for count in re.findall(rb"(?m)^(?:POINTS|CELLS|POINT_DATA|CELL_DATA)\s+(\d+)", data):
        _complete("entries", int(count), len(data))
    with _unmarked(path, data) as plain:
        return _contents(_through(meshio().vtk.read, plain))


def _vtu(path: Path) -> Contents:
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


def _native(value: Array) -> Array:
    return value.astype(value.dtype.newbyteorder("="))


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
    data = {k: _native(np.asarray(v)) for k, v in mesh.point_data.items()}
    normals = None
    for name in ("normals", "Normals"):
        if normals is None and name in data and data[name].shape == points.shape:
            normals = data.pop(name).astype(float)
    if normals is None and {"nx", "ny", "nz"} <= data.keys():
        normals = np.stack([data.pop(k) for k in ("nx", "ny", "nz")], axis=1).astype(float)
    return Contents(points, faces, normals, data, notes)


_READERS = {
    ".obj": _obj,
    ".off": _off,
    ".ply": _ply,
    ".stl": _stl,
    ".vtk": _vtk,
    ".vtu": _vtu,
    ".xyz": _xyz,
}
