"""Files, meshes and pictures."""

import functools
import tempfile
from pathlib import Path

import numpy as np

import jaxsurf as js

from . import Case

NAN = float("nan")
FOLDER = tempfile.TemporaryDirectory()


@functools.cache
def sphere() -> js.PointCloud:
    return js.sphere(100)


@functools.cache
def tetrahedron() -> js.TriangleMesh:
    return js.TriangleMesh(CORNERS, FACES)


def text(name: str, content: str) -> Path:
    path = Path(FOLDER.name) / name
    path.write_text(content)
    return path


def rows(*columns) -> str:
    return "\n".join(" ".join(map(str, row)) for row in np.column_stack(columns))


def new(name: str) -> Path:
    return Path(FOLDER.name) / f"new-{name}"


CORNERS = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
FACES = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]])
FIN = np.concatenate([FACES, [[0, 1, 4]]])
FIVE = np.concatenate([CORNERS, [[0.5, -1, -1]]])
SPACE = np.random.default_rng(0).normal(size=(20, 3))
OBJ = "v 0 0 0\nv 1 0 0\nv 0 1 0\n"
LINES = "".join(f"v {x} {y} {z}\n" for x, y, z in CORNERS)
MESH = LINES + "f 1 3 2\nf 1 2 4\nf 2 3 4\nf 1 4 3\n"


def xyz(name: str, *columns) -> Path:
    return text(name, rows(*columns))


READ = [
    Case("read", "a number for a path", lambda: js.read(7), ("path", "7", "Path")),
    Case("read", "None for a path", lambda: js.read(None), ("path", "None", "Path")),
    Case("read", "suffix of a picture", lambda: js.read("a.png"), ("a.png", ".obj")),
    Case("read", "empty file", lambda: js.read(text("a.obj", "")), ("a.obj", "empty")),
    Case(
        "read",
        "number of points that is not whole",
        lambda: js.read(text("b.obj", MESH), n=20.5),
        ("n is 20.5", "whole number"),
    ),
    Case("read", "no points", lambda: js.read(text("b.obj", MESH), n=0), ("n = 0", "at least 1")),
    Case(
        "read",
        "negative spacing",
        lambda: js.read(text("b.obj", MESH), spacing=-1.0),
        ("spacing = -1", "above 0"),
    ),
    Case(
        "read",
        "spacing as text",
        lambda: js.read(text("b.obj", MESH), spacing="fine"),
        ("spacing", "'fine'", "real number"),
    ),
    Case(
        "read",
        "spacing that no memory holds",
        lambda: js.read(text("b.obj", MESH), spacing=1e-200, smooth=False),
        ("spacing", "1e-200", "at most 2147483647"),
    ),
    Case(
        "read",
        "degree 2.5",
        lambda: js.read(text("b.obj", MESH), degree=2.5),
        ("degree is 2.5", "whole number"),
    ),
    Case("read", "degree 0", lambda: js.read(text("b.obj", MESH), degree=0), ("degree = 0",)),
    Case(
        "read",
        "smooth as text",
        lambda: js.read(text("b.obj", MESH), smooth="no"),
        ("smooth", "'no'", "bool"),
    ),
    Case(
        "read",
        "normals as text",
        lambda: js.read(text("b.obj", MESH), normals="no"),
        ("normals", "'no'", "bool"),
    ),
    Case(
        "read",
        "negative seed",
        lambda: js.read(text("b.obj", MESH), n=20, seed=-1),
        ("seed = -1", "at least 0"),
    ),
    Case(
        "read",
        "too few vertices for the degree",
        lambda: js.read(text("b.obj", MESH)),
        ("b.obj", "4 vertices", "at least 17"),
    ),
    Case(
        "read",
        "one point",
        lambda: js.read(text("c.xyz", "0 0 0\n")),
        ("c.xyz", "too few points: 1"),
    ),
    Case(
        "read",
        "a value in the fourth column",
        lambda: js.read(xyz("d.xyz", SPACE, SPACE[:, 0])),
        ("d.xyz", "4 columns", "columns='x y z value'"),
    ),
    Case(
        "read",
        "colours in columns four to six",
        lambda: js.read(xyz("e.xyz", SPACE, np.tile([1.0, 0.0, 0.0], (20, 1)))),
        ("e.xyz", "6 columns", "columns='x y z r g b'"),
    ),
    Case(
        "read",
        "too few names of columns",
        lambda: js.read(xyz("d.xyz", SPACE, SPACE[:, 0]), columns="x y z"),
        ("columns names 3", "there are 4"),
    ),
    Case(
        "read",
        "a column named twice",
        lambda: js.read(xyz("d.xyz", SPACE, SPACE[:, 0]), columns="x y z z"),
        ("columns", "twice", "x y z z"),
    ),
    Case(
        "read",
        "columns without y",
        lambda: js.read(xyz("f.xyz", SPACE), columns="x u v"),
        ("columns", "x and y", "x u v"),
    ),
    Case(
        "read",
        "normals in space of points in the plane",
        lambda: js.read(xyz("g.xyz", SPACE, SPACE[:, :2]), columns="x y nx ny nz"),
        ("columns", "nx ny nz", "x y"),
    ),
    Case(
        "read",
        "columns as a list",
        lambda: js.read(xyz("f.xyz", SPACE), columns=["x", "y", "z"]),
        ("columns", "list", "str"),
    ),
    Case(
        "read",
        "columns of a mesh",
        lambda: js.read(text("b.obj", MESH), columns="x y z"),
        ("b.obj", "columns", ".xyz", ".obj"),
    ),
    Case(
        "read",
        "a fin on an edge",
        lambda: js.read(text("h.obj", MESH + "v 0.5 -1 -1\nf 1 2 5\n")),
        ("h.obj", "shared by 3 triangles", "largest_part=True", "faces=False"),
    ),
    Case(
        "read",
        "points of size 1e200",
        lambda: js.read(xyz("i.xyz", 1e200 * SPACE), degree=2),
        ("i.xyz", "points", "e+199", "at most"),
    ),
    Case(
        "read",
        "two points that coincide",
        lambda: js.read(xyz("j.xyz", np.concatenate([SPACE, SPACE[3:4]]))),
        ("j.xyz", "points 3 and 20 coincide"),
    ),
    Case("read_fields", "a number for a path", lambda: js.read_fields(7), ("path", "7", "Path")),
    Case("read_fields", "unknown suffix", lambda: js.read_fields("a.csv"), ("a.csv", ".vtu")),
    Case(
        "read_fields",
        "empty file",
        lambda: js.read_fields(text("a.vtu", "")),
        ("a.vtu", "empty"),
    ),
    Case(
        "read_fields",
        "no XML",
        lambda: js.read_fields(text("b.vtu", "hello")),
        ("b.vtu", "not readable"),
    ),
    Case(
        "read_fields",
        "columns of other files",
        lambda: js.read_fields(text("b.vtu", "hello"), columns="x y"),
        ("b.vtu", "columns", ".xyz"),
    ),
    Case(
        "read_fields",
        "columns that may be anything",
        lambda: js.read_fields(xyz("d.xyz", SPACE, SPACE[:, 0])),
        ("d.xyz", "columns='x y z value'"),
    ),
    Case(
        "read_fields",
        "a file without fields",
        lambda: js.read_fields(xyz("f.xyz", SPACE)),
        right=lambda found: found == {},
    ),
]


def refused(label, words, fields, *, suffix="vtu", cloud=sphere):
    def call():
        js.write(new(f"a.{suffix}"), cloud(), fields)

    return Case("write", label, call, words)


WRITE = [
    refused("an array for fields", ("fields", "(100,)", "{name: values}"), np.zeros(100)),
    refused("a list of fields", ("fields", "list", "{name: values}"), [np.zeros(100)]),
    refused("a name that is no text", ("fields", "3 (int)", "text"), {3: np.zeros(100)}),
    refused("an empty name", ("VTU", "''"), {"": np.zeros(100)}),
    refused("a control character", ("VTU", "'a\\x00'"), {"a\x00": np.zeros(100)}),
    refused("too few rows", ("'u'", "(99,)", "(100,)", "(100, c)"), {"u": np.zeros(99)}),
    refused("a scalar", ("'u'", "()", "(100,)"), {"u": 1.0}),
    refused("no values", ("'u'", "object"), {"u": np.full(100, None)}),
    refused("text values", ("'u'", "expected real numbers"), {"u": np.full(100, "a")}),
    refused("ragged values", ("'u'", "array of numbers"), {"u": [[1.0], [1.0, 2.0]]}),
    refused("complex values", ("'u'", "complex128"), {"u": np.zeros(100, complex)}),
    refused("a taken name", ("'boundary'", "taken"), {"boundary": np.zeros(100)}),
    refused("a blank in PLY", ("PLY", "'my u'"), {"my u": np.zeros(100)}, suffix="ply"),
    refused("a blank in VTK", ("VTK", "'my u'"), {"my u": np.zeros(100)}, suffix="vtk"),
    refused("fields in XYZ", ("XYZ", "u"), {"u": np.zeros(100)}, suffix="xyz"),
    refused("a suffix to read only", (".stl", ".vtu"), None, suffix="stl"),
    refused(
        "points for a cloud", ("cloud", "(5, 3)", "PointCloud"), None, cloud=lambda: np.ones((5, 3))
    ),
    Case("write", "None for a path", lambda: js.write(None, sphere()), ("path", "None")),
]


def mesh(label, words, vertices=CORNERS, triangles=FACES, right=None):
    return [
        Case(name, label, lambda make=make: make(vertices, triangles), words, right)
        for name, make in (("TriangleMesh", js.TriangleMesh), ("clean_mesh", js.clean_mesh))
    ]


MESHES = [
    *mesh("vertices in the plane", ("vertices", "(n, 3)", "(4, 2)"), CORNERS[:, :2]),
    *mesh("complex vertices", ("vertices", "complex"), CORNERS + 1j),
    *mesh("vertices as text", ("vertices", "real numbers"), "corners"),
    *mesh("no vertices", ("vertices", "None", "real numbers"), None),
    *mesh("ragged vertices", ("vertices", "array of numbers"), [[0.0], [1.0, 2.0]]),
    *mesh("a vertex that is not finite", ("vertex 0", "finite"), CORNERS + [[NAN]] * 4),
    *mesh("quadrilaterals", ("triangles", "(m, 3)", "(1, 4)"), CORNERS, [[0, 1, 2, 3]]),
    *mesh("vertex numbers out of range", ("triangle 0", "there are 4"), CORNERS, [[0, 1, 4]]),
    *mesh("half a vertex number", ("triangles", "whole"), CORNERS, [[0, 1, 1.5]]),
    *mesh("vertex numbers as text", ("triangles", "real numbers"), CORNERS, [["a", "b", "c"]]),
    *mesh("a fin", ("vertex 0 to 1", "3 triangles", "largest_part=True"), FIVE, FIN),
    *mesh("vertices of size 1e200", ("vertices", "1e+200", "at most"), 1e200 * CORNERS),
    Case(
        "TriangleMesh",
        "a vertex named twice",
        lambda: js.TriangleMesh(CORNERS, [[0, 1, 1]]),
        ("triangle 0", "twice"),
    ),
    Case(
        "TriangleMesh",
        "vertex numbers of another kind",
        lambda: js.TriangleMesh(CORNERS, FACES.astype(np.int16)),
        right=lambda m: m.closed,
    ),
    Case("clean_mesh", "no triangles", lambda: js.clean_mesh(CORNERS, np.empty((0, 3))), ("no t",)),
    Case(
        "clean_mesh",
        "what a fin stands on",
        lambda: js.clean_mesh(FIVE[:4], FACES, largest_part=True)[0],
        right=lambda m: m.closed and len(m.triangles) == 4,
    ),
    Case("sample_mesh", "a cloud", lambda: js.sample_mesh(sphere(), n=20), ("mesh", "TriangleM")),
    Case("sample_mesh", "n = 20.5", lambda: js.sample_mesh(tetrahedron(), n=20.5), ("n is 20.5",)),
    Case("sample_mesh", "n = 0", lambda: js.sample_mesh(tetrahedron(), n=0), ("n = 0", "10")),
    Case("sample_mesh", "n = '9'", lambda: js.sample_mesh(tetrahedron(), n="9"), ("n is '9'",)),
    Case(
        "sample_mesh",
        "neither n nor spacing",
        lambda: js.sample_mesh(tetrahedron()),
        ("n = None", "spacing = None"),
    ),
    Case(
        "sample_mesh",
        "spacing that is not a number",
        lambda: js.sample_mesh(tetrahedron(), spacing=NAN),
        ("spacing = nan", "above 0"),
    ),
    Case(
        "sample_mesh",
        "spacing so small that no memory holds the points",
        lambda: js.sample_mesh(tetrahedron(), spacing=1e-9),
        ("spacing = 1e-09", "at most 2147483647"),
    ),
    Case(
        "sample_mesh",
        "too few vertices for the degree",
        lambda: js.sample_mesh(tetrahedron(), n=50),
        ("4 vertices", "at least 17"),
    ),
    Case(
        "sample_mesh",
        "degree 2.5",
        lambda: js.sample_mesh(tetrahedron(), n=50, degree=2.5),
        ("degree is 2.5",),
    ),
]


def drawn(label, words, *args, **options):
    return Case("plot_cloud", label, lambda: js.plot_cloud(sphere(), *args, **options), words)


PICTURES = [
    Case("plot_cloud", "an array", lambda: js.plot_cloud(SPACE), ("cloud", "(20, 3)", "PointCl")),
    drawn("too few values", ("field", "(99,)", "(100,)"), np.zeros(99)),
    drawn("a vector field", ("field", "(100, 3)", "(100,)"), np.zeros((100, 3))),
    drawn("a value that is not finite", ("field", "nan", "point 0"), np.full(100, NAN)),
    drawn("complex values", ("field", "complex"), np.zeros(100, complex)),
    drawn("text", ("field", "real numbers"), "height"),
    drawn("limits turned round", ("limits", "1", "0"), np.zeros(100), limits=(1.0, 0.0)),
    drawn("one limit", ("limits", "2"), np.zeros(100), limits=(1.0,)),
    drawn("limits that are not finite", ("limits", "nan"), np.zeros(100), limits=(0.0, NAN)),
    drawn("a view in the plane", ("view", "(2,)", "(3,)"), view=(1.0, 0.0)),
    drawn("a view of length zero", ("view", "0"), view=(0.0, 0.0, 0.0)),
    drawn("a view along up", ("view", "up"), view=(0.0, 0.0, 2.0)),
    drawn("half a pixel", ("pixels is 20.5", "whole"), pixels=20.5),
    drawn("no pixels", ("pixels = 0",), pixels=0),
    drawn("an unknown colour map", ("cmap", "'glow'"), np.zeros(100), cmap="glow"),
    Case(
        "plot_series",
        "two surfaces at three times",
        lambda: js.plot_series([sphere()] * 2, times=[0.0, 1.0, 2.0]),
        ("2 of clouds", "3 of times"),
    ),
    Case(
        "plot_series",
        "times that turn back",
        lambda: js.plot_series([sphere()] * 3, times=[0.0, 2.0, 1.0]),
        ("times", "after 2.0", "entry 1"),
    ),
    Case(
        "plot_series",
        "too few values at the second time",
        lambda: js.plot_series(sphere(), [np.zeros(100), np.zeros(99)]),
        ("field 1", "(99,)", "(100,)"),
    ),
    Case(
        "plot_series",
        "points for a surface",
        lambda: js.plot_series([sphere(), SPACE]),
        ("cloud 1", "(20, 3)", "PointCloud"),
    ),
    Case("plot_series", "no time", lambda: js.plot_series([]), ("clouds", "0", "at least 1")),
    Case(
        "animate",
        "one picture for a film",
        lambda: js.animate(new("film.png"), sphere(), [np.zeros(100)]),
        (".png", ".gif"),
    ),
    Case(
        "animate",
        "no pictures a second",
        lambda: js.animate(new("film.gif"), sphere(), [np.zeros(100)], fps=0),
        ("fps = 0", "above 0"),
    ),
    Case(
        "animate",
        "a number for a field",
        lambda: js.animate(new("film.gif"), sphere(), 1.0),
        ("field", "float", "sequence"),
    ),
    Case(
        "write",
        "times for a single file",
        lambda: js.write(new("a.vtu"), sphere(), times=[0.0]),
        ("times", ".pvd"),
    ),
    Case(
        "write",
        "a series without times",
        lambda: js.write(new("a.pvd"), [sphere()], {"u": [np.zeros(100)]}),
        ("times", ".pvd"),
    ),
    Case(
        "write",
        "one value for two times",
        lambda: js.write(new("a.pvd"), sphere(), {"u": [np.zeros(100)]}, times=[0.0, 1.0]),
        ("1 of field 'u'", "2 of times"),
    ),
    Case("plot_fields", "no fields", lambda: js.plot_fields(sphere(), {}), ("fields",)),
    Case(
        "plot_fields",
        "an array for fields",
        lambda: js.plot_fields(sphere(), np.zeros(100)),
        ("fields", "(100,)", "{title: values}"),
    ),
    Case(
        "plot_fields",
        "an array for a cloud",
        lambda: js.plot_fields(SPACE, {"u": None}),
        ("cloud", "(20, 3)", "PointCloud"),
    ),
    Case(
        "plot_fields",
        "no columns",
        lambda: js.plot_fields(sphere(), {"u": None}, columns=0),
        ("columns = 0", "at least 1"),
    ),
    Case(
        "plot_fields",
        "too few values",
        lambda: js.plot_fields(sphere(), {"u": np.zeros(99)}),
        ("u", "(99,)", "(100,)"),
    ),
    Case(
        "plot_fields",
        "a resolution of zero",
        lambda: js.plot_fields(sphere(), {"u": None}, dpi=0),
        ("dpi = 0", "above 0"),
    ),
    Case(
        "plot_fields",
        "a number for a path",
        lambda: js.plot_fields(sphere(), {"u": None}, path=3),
        ("path", "3", "Path"),
    ),
]

CASES = [*READ, *WRITE, *MESHES, *PICTURES]
