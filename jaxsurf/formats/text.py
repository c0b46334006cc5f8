"""OBJ, OFF and XYZ files, which are plain text."""

from __future__ import annotations

import io
import re
from pathlib import Path

import numpy as np

from jaxsurf.formats.contents import Contents, complete


def obj(path: Path) -> Contents:
    points: list[list[float]] = []
    directions: list[list[float]] = []
    runs: list[list[list[int]]] = []
    corner_normals: list[tuple[int, int]] = []
    bare_corners = 0
    for number, line in _lines(path):
        word, *words = line.split()
        try:
            if word == "v":
                points.append(_numbers(words, 3))
            elif word == "vn":
                directions.append(_numbers(words, 3))
            elif word == "f":
                if len(words) < 3:
                    raise ValueError(f"a face with {len(words)} corners, at least 3 are needed")
                face = []
                for corner in words:
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
    with np.errstate(invalid="ignore"):  # of length 0: refused where they are used
        unit = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    pairs = np.unique(corners, axis=0)
    np.add.at(total, pairs[:, 0], unit[pairs[:, 1]])
    return total


def off(path: Path) -> Contents:
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
    complete("vertices", n, len(rows))
    complete("faces", m, found)
    x = np.array(rows, float).reshape(-1, 6 if with_normals else 3)
    return Contents(x[:, :3], [np.array(run) for run in runs], x[:, 3:] if with_normals else None)


def xyz(path: Path, columns: str | None = None) -> Contents:
    with path.open(encoding="utf-8-sig", errors="replace") as file:
        text = file.read()
    try:
        rows = np.loadtxt(io.StringIO(text), comments="#", ndmin=2)
    except ValueError as error:
        expected = "numbers with blanks between them are expected, and # before titles"
        raise ValueError(f"{error}; {expected}") from None
    count = rows.shape[1]
    if columns is None:
        # A first comment that names every column, as `write` leaves it.
        first = text.lstrip().split("\n", 1)[0]
        title = first[1:].split() if first.startswith("#") else []
        if len(title) == count and title[:2] == ["x", "y"]:
            columns = " ".join(title)
    names = _named(count) if columns is None else columns.split()
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


def _named(count: int) -> list[str]:
    """What as many columns are that nothing names: coordinates alone leave no doubt."""
    if count in (2, 3):
        return ["x", "y", "z"][:count]
    some = {4: ("x y z value", "x y nx ny"), 6: ("x y z nx ny nz", "x y z r g b")}
    ways = " or ".join(f"columns='{names}'" for names in some.get(count, ("x y z value",)))
    raise ValueError(
        f"{count} columns, which may be anything; expected x y or x y z. Name them with {ways}, or "
        "so in a first line (# x y z ...)"
    )


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
