"""Files: every format there and back, what is wrong with them, what they leave open."""

import sys
import tempfile
import warnings
from pathlib import Path
from xml.etree import ElementTree

import jax
import jax.numpy as jnp
import meshio
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import jaxsurf as js
from jaxsurf.cloud import PointCloud
from jaxsurf.io import read, read_fields, write
from jaxsurf.shapes.analytic import sphere_projection

from .test_meshes import ball_mesh, cube_mesh, fibonacci, mobius, real, sheet, torus_grid


def ellipsoid(n, axes=(1.0, 0.8, 0.6)):
    x = fibonacci(n) * axes
    normals = x / np.array(axes) ** 2
    return PointCloud(x, normals / np.linalg.norm(normals, axis=1, keepdims=True))


def write_obj(path, vertices, faces, extra=""):
    lines = [f"v {x!r} {y!r} {z!r}" for x, y, z in vertices.tolist()]
    lines += ["f " + " ".join(str(i + 1) for i in face) for face in faces]
    path.write_text("\n".join(lines) + "\n" + extra)
    return path


def quietly(path, **options):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return read(path, **options)


# --- meshes --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "suffix", ["obj", "off", "ply", "ascii.ply", "stl", "ascii.stl", "vtk", "vtu"]
)
def test_every_mesh_format(tmp_path, suffix):
    mesh = ball_mesh(400)
    path = tmp_path / f"ball.{suffix}"
    kind = suffix.split(".")[-1]
    options = {"binary": "ascii" not in suffix} if kind in ("ply", "stl") else {}
    meshio.write(
        path,
        meshio.Mesh(mesh.vertices, [("triangle", mesh.triangles.astype(np.int32))]),
        kind,
        **options,
    )
    cloud = quietly(path)
    x = np.asarray(cloud.points)
    assert cloud.boundary is None and cloud.n == 400
    if kind != "stl":
        assert np.abs(x - mesh.vertices).max() < 1e-12
    # Binary STL has single precision, and its own order.
    assert np.abs(np.linalg.norm(x, axis=1) - 1).max() < 1e-6
    assert np.abs(np.asarray(cloud.normals) - x).max() < 2e-3


def test_mesh_normals(tmp_path):
    errors, flat = [], []
    for n in (1_000, 4_000):
        mesh = ball_mesh(n, (1, 0.8, 0.6))
        path = write_obj(tmp_path / "a.obj", mesh.vertices, mesh.triangles)
        exact = mesh.vertices / np.array([1, 0.8, 0.6]) ** 2
        exact /= np.linalg.norm(exact, axis=1, keepdims=True)
        errors.append(np.abs(np.asarray(read(path).normals) - exact).max())
        flat.append(np.abs(np.asarray(read(path, smooth=False).normals) - exact).max())
    assert flat[1] > 1e-3
    assert errors[1] < 3e-4
    assert np.log2(errors[0] / errors[1]) > 3.3


def test_border_of_an_open_mesh(tmp_path):
    square = sheet(12)
    cloud = read(write_obj(tmp_path / "square.obj", square.vertices, square.triangles))
    x = np.asarray(cloud.points)
    on_edge = ((x[:, :2] == 0) | (x[:, :2] == 1)).any(axis=1)
    assert (np.asarray(cloud.boundary) == on_edge).all() and on_edge.sum() == 44
    assert np.allclose(cloud.normals, [0, 0, 1])


def test_resampling_while_reading(tmp_path):
    mesh = ball_mesh(2_000)
    path = write_obj(tmp_path / "ball.obj", mesh.vertices, mesh.triangles)
    assert read(path, n=700).n == 700
    assert abs(read(path, spacing=0.1).n - 1_257) < 10


def test_polygons_are_cut_and_stated(tmp_path):
    vertices, triangles = torus_grid(30, 16)
    m = len(triangles) // 2
    quads = np.c_[triangles[:m], triangles[m:, 2]]
    path = write_obj(tmp_path / "quads.obj", vertices, quads.tolist())
    with pytest.warns(UserWarning, match="quads.obj: 480 polygons with more than three corners"):
        cloud = read(path)
    whole = read(write_obj(tmp_path / "triangles.obj", vertices, triangles.tolist()))
    assert cloud.n == 480 and cloud.boundary is None
    assert np.allclose(cloud.normals, whole.normals, atol=1e-3)
    off = tmp_path / "quads.off"
    rows = [" ".join(map(str, v)) for v in vertices.tolist()]
    rows += [" ".join(map(str, (4, *q))) + " 0.5 0.5 0.5" for q in quads.tolist()]
    off.write_text("OFF 480 480 0 # torus\n\n" + "\n".join(rows))
    assert np.allclose(quietly(off).normals, whole.normals, atol=1e-3)


def test_textured_obj_with_relative_numbers_and_continuations(tmp_path):
    path = tmp_path / "corner.obj"
    path.write_text(
        "# a comment\nmtllib none.mtl\no part\n"
        "v 0 0 0 0.5 0.5 0.5\nv 1 0 0 1 1 1\nv 0 1 0 0 0 0\nvt 0 0\nvt 1 1\nvt 0.5 0\nvt 1 0\n"
        "vn 0 0 2\nusemtl red\ns off\nf -3/1/1 -2/2/1 \\\n -1/3/1\nv 1 1 0\nf 2/2/1 4/4/1 3/3/-1\n"
    )
    cloud = read(path)
    assert cloud.points.tolist() == [[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]]
    assert cloud.normals.tolist() == [[0, 0, 1]] * 4
    assert cloud.boundary.all()


def test_normals_of_a_file_are_kept(tmp_path):
    mesh = ball_mesh(100)
    tilted = mesh.vertices + np.array([0, 0, 0.3])
    extra = "".join(f"vn {x} {y} {z}\n" for x, y, z in tilted.tolist())
    faces = [" ".join(f"{i + 1}//{i + 1}" for i in t) for t in mesh.triangles.tolist()]
    path = write_obj(
        tmp_path / "n.obj", mesh.vertices, [], extra + "".join(f"f {f}\n" for f in faces)
    )
    expected = tilted / np.linalg.norm(tilted, axis=1, keepdims=True)
    assert np.allclose(read(path).normals, expected)
    ply = tmp_path / "n.ply"
    data = dict(zip(("nx", "ny", "nz"), tilted.T))
    meshio.write(ply, meshio.Mesh(mesh.vertices, [("triangle", mesh.triangles)], point_data=data))
    assert np.allclose(read(ply).normals, expected)


def test_normals_of_a_file_beside_the_triangles(tmp_path):
    """They were of first order, or of the other side once resampled, without a word."""
    mesh = ball_mesh(400)
    weighted = mesh.vertex_normals

    def written(name, normals, triangles):
        lines = [f"vn {x} {y} {z}\n" for x, y, z in normals.tolist()]
        lines += [
            "f " + " ".join(f"{i + 1}//{i + 1}" for i in t) + "\n" for t in triangles.tolist()
        ]
        return write_obj(tmp_path / name, mesh.vertices, [], "".join(lines))

    plain = written("plain.obj", weighted, mesh.triangles)
    with pytest.warns(UserWarning, match=r"normals in the file are .* rad off .* normals=False"):
        cloud = read(plain)
    np.testing.assert_allclose(cloud.normals, weighted, atol=1e-12)
    fitted = read(plain, normals=False).normals
    assert np.abs(fitted - mesh.vertices).max() < 0.2 * np.abs(weighted - mesh.vertices).max()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        read(written("exact.obj", mesh.vertices, mesh.triangles))
        read(plain, smooth=False)
    turned = written("turned.obj", mesh.vertices, mesh.triangles[:, ::-1])
    for sizes in ({}, {"n": 300}):
        with pytest.warns(UserWarning, match="796 of 796 triangles normals point to the other"):
            cloud = read(turned, **sizes)
        assert float(jnp.sum(cloud.points * cloud.normals, axis=1).min()) > 0.9
    # Which nobody asks for where points are others.
    none = written("none.obj", 0 * weighted, mesh.triangles)
    assert read(none, n=300).n == 300
    with pytest.raises(ValueError, match=r"expected a direction .*normals=False"):
        read(none)


def test_every_piece_has_the_side_of_its_normals(tmp_path):
    one, other = ball_mesh(400), ball_mesh(200)
    x = np.concatenate([one.vertices, other.vertices + np.array([3, 0, 0])])
    n = np.concatenate([one.vertices, other.vertices])
    faces = np.concatenate([one.triangles, 400 + other.triangles[:, ::-1]])
    lines = [f"vn {a} {b} {c}\n" for a, b, c in n.tolist()]
    lines += ["f " + " ".join(f"{i + 1}//{i + 1}" for i in t) + "\n" for t in faces.tolist()]
    path = write_obj(tmp_path / "two.obj", x, [], "".join(lines))
    with pytest.warns(UserWarning, match="396 of 1192 triangles"):
        cloud = read(path, n=500)
    away = cloud.points - jnp.where(cloud.points[:, :1] > 1.5, jnp.array([3.0, 0, 0]), 0)
    assert float(jnp.sum(away * cloud.normals, axis=1).min()) > 0.9


def test_exact_normals_of_a_coarse_mesh_are_no_worse_than_fits(tmp_path):
    x, t = torus_grid(48, 20)
    center = x * [1, 1, 0]
    normals = (x - center / np.linalg.norm(center, axis=1, keepdims=True)) / 0.4
    lines = [f"vn {a} {b} {c}\n" for a, b, c in normals.tolist()]
    lines += ["f " + " ".join(f"{i + 1}//{i + 1}" for i in row) + "\n" for row in t.tolist()]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        cloud = read(write_obj(tmp_path / "exact.obj", x, [], "".join(lines)))
    np.testing.assert_allclose(cloud.normals, normals, atol=1e-12)


def test_a_list_with_commas_says_what_is_expected(tmp_path):
    path = tmp_path / "a.xyz"
    path.write_text("1,2,3\n4,5,6\n")
    with pytest.raises(ValueError, match="blanks between them are expected"):
        read(path)


def test_stl_corners_are_merged_and_stated(tmp_path):
    mesh = ball_mesh(100)
    path = tmp_path / "ball.stl"
    meshio.write(path, meshio.Mesh(mesh.vertices, [("triangle", mesh.triangles)]))
    with pytest.warns(UserWarning, match="588 corners of triangles merged into 100 vertices"):
        assert read(path).n == 100


def test_unused_vertices_are_stated(tmp_path):
    mesh = ball_mesh(100)
    vertices = np.concatenate([[[7.0, 7, 7]], mesh.vertices, [[8.0, 8, 8]]])
    path = write_obj(tmp_path / "stray.obj", vertices, (mesh.triangles + 1).tolist())
    with pytest.warns(
        UserWarning, match=r"2 vertices belong to no triangle, dropped \(first: \[0\]"
    ):
        assert read(path).n == 100


def test_ply_as_others_write_it(tmp_path):
    mesh = ball_mesh(60)
    text = (
        "ply\nformat ascii 1.0\ncomment by hand\nelement vertex 60\nproperty double x\n"
        "property double y\nproperty double z\nproperty uchar red\nelement face 116\n"
        "property list uchar int vertex_index\nend_header\n"
    )
    text += "".join("{!r} {!r} {!r} 200\n".format(*v) for v in mesh.vertices.tolist())
    text += "".join("3 {} {} {}\n".format(*t) for t in mesh.triangles.tolist())
    path = tmp_path / "by_hand.ply"
    path.write_text(text)
    assert np.allclose(read(path).points, mesh.vertices)
    assert (read_fields(path)["red"] == 200).all()


# --- lists of points -----------------------------------------------------------------------


@pytest.mark.parametrize("suffix", ["vtu", "vtk", "ply"])
def test_cloud_and_fields_come_back(tmp_path, suffix):
    ball = ellipsoid(300)
    cloud = PointCloud(
        ball.points,
        ball.normals,
        boundary=ball.points[:, 2] > 0.5,
        active=ball.points[:, 0] < 0.9,
        spacing=jnp.full(300, 0.1),
    )
    fields = {
        "height": cloud.points[:, 2],
        "count": jnp.arange(300),
        "flag": cloud.points[:, 1] > 0,
        "velocity": jnp.cross(cloud.normals, cloud.points),
        "stress": cloud.points[:, :, None] * cloud.normals[:, None, :],
    }
    path = tmp_path / f"cloud.{suffix}"
    write(path, cloud, fields)
    back, found = read(path), read_fields(path)
    assert np.abs(back.points - cloud.points).max() < 1e-15
    assert np.abs(back.normals - cloud.normals).max() < 1e-15
    assert (back.boundary == cloud.boundary).all() and (back.active == cloud.active).all()
    assert np.allclose(back.spacing, 0.1)
    for name in ("height", "count", "flag"):
        assert (found[name] == np.asarray(fields[name])).all()
    if suffix == "ply":
        assert (found["velocity_1"] == np.asarray(fields["velocity"])[:, 1]).all()
        assert (found["stress_5"] == np.asarray(fields["stress"])[:, 1, 2]).all()
    else:
        assert all(value.dtype.isnative for value in found.values())
        assert (found["velocity"] == np.asarray(fields["velocity"])).all()
        assert (found["stress"] == np.asarray(fields["stress"])).all()
        assert set(found) == set(fields)


def test_a_series_is_read_by_its_files(tmp_path):
    ball = ellipsoid(50)
    write(tmp_path / "run.pvd", ball, times=[0.0, 1.0])
    with pytest.raises(ValueError, match=r"'\.pvd'.*read the \.vtu files in .*run$"):
        read(tmp_path / "run.pvd")


def test_paraview_gets_a_vertex_for_every_point(tmp_path):
    path = tmp_path / "cloud.vtu"
    write(path, ellipsoid(50), {"v": jnp.ones((50, 3), jnp.float32)})
    mesh = meshio.read(path)
    assert [(c.type, c.data.ravel().tolist()) for c in mesh.cells] == [("vertex", list(range(50)))]
    assert mesh.point_data["normals"].shape == mesh.point_data["v"].shape == (50, 3)
    assert mesh.point_data["v"].dtype == np.float32


@pytest.mark.parametrize("suffix", ["vtu", "ply", "xyz"])
def test_plane_curve_comes_back(tmp_path, suffix):
    angle = 2 * np.pi * np.arange(40) / 40
    x = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    path = tmp_path / f"curve.{suffix}"
    fields = {"v": x, "T": x[:, :, None] * x[:, None]} if suffix == "vtu" else None
    write(path, PointCloud(x, x), fields)
    back = read(path)
    assert back.dim == 2 and np.abs(back.points - x).max() < 1e-15
    if fields:
        assert (read_fields(path)["v"] == np.pad(x, ((0, 0), (0, 1)))).all()
        assert (read_fields(path)["T"][:, :2, :2] == fields["T"]).all()


def test_points_alone_get_normals(tmp_path):
    cloud = ellipsoid(1_000)
    for name in ("points.xyz", "points.obj", "points.off"):
        path = tmp_path / name
        rows = [" ".join(map(repr, p)) for p in np.asarray(cloud.points).tolist()]
        if name.endswith("obj"):
            rows = ["v " + row for row in rows]
        path.write_text(("OFF\n1000 0 0\n" if name.endswith("off") else "") + "\n".join(rows))
        back = read(path)
        assert (back.points == cloud.points).all() and back.boundary is None
        assert np.abs(back.normals - cloud.normals).max() < 3e-3


# --- bad files -----------------------------------------------------------------------------

TRIANGLE = "v 0 0 0\nv 1 0 0\nv 0 1 0\n"
PLY = (
    "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\n"
    "property float z\nelement face 1\nproperty list uchar int vertex_indices\nend_header\n"
)
POINTS_PLY = PLY.replace("element face 1\nproperty list uchar int vertex_indices\n", "")


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("a.obj", "", "a.obj: empty file"),
        ("a.obj", "# nothing\n", "a.obj: no points"),
        ("a.foo", "x", r"a.foo: unknown suffix '.foo'; known are .obj, .off, .ply"),
        ("a.obj", TRIANGLE + "f 1 2 9\n", r"a.obj: triangle 0 names the vertices \[0 1 8\]"),
        ("a.obj", TRIANGLE + "f 0 1 2\n", r"a.obj: triangle 0 names the vertices \[-1 +0 +1\]"),
        ("a.obj", TRIANGLE + "f 1 2\n", "a.obj: line 4: a face with 2 corners"),
        ("a.obj", "v 0 0 0\nv 1 0\n", "a.obj: line 2: expected 3 numbers, found 2"),
        ("a.obj", "v 0 0 zero\n", "a.obj: line 1: could not convert"),
        ("a.obj", "v 0 0 nan\n" + TRIANGLE + "f 1 2 3\n", "a.obj: vertex 0 is not finite"),
        ("a.obj", TRIANGLE + "f 1//1 2//1 3//1\n", "a.obj: a face names normal 1, there are 0"),
        ("a.obj", TRIANGLE + "vn 0 0 0\nf 1//1 2//1 3//1\n", "a.obj: normal 0 is"),
        (
            "a.obj",
            TRIANGLE + "f 1 2 3\n",
            "a.obj: 3 vertices, normals of degree 4 need at least 17",
        ),
        ("a.off", "8 6 0\n", "a.off: line 1: expected OFF"),
        ("a.off", "OFF\n", "a.off: line 1: expected the numbers of vertices and faces"),
        ("a.off", "OFF\n3 1 0\n0 0 0\n", "a.off: truncated: 3 vertices announced, 1 found"),
        ("a.off", "OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n", "a.off: truncated: 1 faces announced, 0"),
        ("a.off", "OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1", "a.off: line 6: expected a face of 3"),
        (
            "a.ply",
            "ply\nformat ascii 1.0\n",
            "a.ply: not a PLY file, or truncated within its header",
        ),
        ("a.ply", POINTS_PLY + "0 0 0\n", "a.ply: truncated: 3 vertices announced, 1 found"),
        ("a.ply", PLY + "0 0 0\n1 0 0\n0 1 0\n", "a.ply: (not readable|truncated)"),
        ("a.stl", "solid x\nfacet normal 0 0 1\nouter loop\n", "a.stl: truncated: no endsolid"),
        ("a.stl", "x" * 200, "a.stl: truncated: .* bytes announced, 200 found"),
        ("a.vtk", "# vtk DataFile Version 3.0\nx\nASCII\n", "a.vtk: not readable"),
        ("a.vtu", "<VTKFile><Unstr", "a.vtu: not readable"),
        ("a.xyz", "0 0 0\n1 0\n", "a.xyz: "),
        ("a.xyz", "0 0 0 1 1\n", "a.xyz: 5 columns, .* expected x y or x y z"),
        ("a.xyz", "0 0 0\n1 0 inf\n", "a.xyz: point 1 is not finite"),
        (
            "a.xyz",
            "# x y z nx ny nz\n0 0 0 0 0 1\n1 0 0 0 0 0\n",
            r"a.xyz: normal 1 is \[0. 0. 0.\]",
        ),
        ("a.xyz", "0 0 0\n1 0 0\n0 0 0\n", "a.xyz: points 0 and 2 coincide"),
    ],
)
@pytest.mark.filterwarnings("ignore:.*input contained no data")
def test_bad_files(tmp_path, name, text, message):
    path = tmp_path / name
    path.write_text(text)
    with pytest.raises(ValueError, match=message):
        quietly(path)


def test_bad_surfaces(tmp_path):
    vertices, triangles = mobius()
    path = write_obj(tmp_path / "band.obj", vertices, triangles.tolist())
    with pytest.raises(ValueError, match=r"band\.obj: the surface has only one side"):
        read(path)
    fins = np.concatenate([cube_mesh().triangles, [[0, 1, 6]]])
    path = write_obj(tmp_path / "fins.obj", cube_mesh().vertices, fins.tolist())
    with pytest.raises(ValueError, match=r"fins.obj: the edge from .* is shared by \d triangles"):
        read(path)
    path = tmp_path / "tetra.vtu"
    meshio.write(path, meshio.Mesh(np.eye(4, 3), [("tetra", [[0, 1, 2, 3]])]))
    with pytest.raises(ValueError, match=r"tetra\.vtu: cells of type 'tetra'"):
        read(path)


def test_truncated_binary_files(tmp_path):
    mesh = ball_mesh(100)
    for kind, keep in (
        ("ply", 1_500),
        ("ply", 3_500),
        ("stl", 5_000),
        ("vtu", 900),
        ("vtk", 2_000),
    ):
        path = tmp_path / f"whole.{kind}"
        options = {"binary": True} if kind == "stl" else {}
        cells = [("triangle", mesh.triangles.astype(np.int32))]
        meshio.write(path, meshio.Mesh(mesh.vertices, cells), **options)
        part = tmp_path / f"part.{kind}"
        part.write_bytes(path.read_bytes()[:keep])
        with pytest.raises(ValueError, match=rf"part.{kind}: (truncated|not readable)"):
            quietly(part)


def test_missing_file_and_missing_reader(tmp_path, monkeypatch):
    with pytest.raises(OSError, match=r"none\.obj: no such file"):
        read(tmp_path / "none.obj")
    write(tmp_path / "a.vtu", ellipsoid(50))
    monkeypatch.setitem(sys.modules, "meshio", None)
    with pytest.raises(ImportError, match=r"pip install 'jaxsurf\[files\]'"):
        read(tmp_path / "a.vtu")


def test_a_list_of_points_is_not_resampled(tmp_path):
    write(tmp_path / "a.xyz", ellipsoid(50))
    with pytest.raises(ValueError, match=r"a\.xyz: a list of points without triangles"):
        read(tmp_path / "a.xyz", n=20)


@pytest.mark.parametrize(
    ("name", "fields", "message"),
    [
        ("a.vtu", {"u": np.zeros(49)}, r"field 'u' has shape \(49,\), expected \(50,\)"),
        ("a.vtu", {"u": np.zeros((50, 2, 3))}, r"field 'u' has shape \(50, 2, 3\)"),
        ("a.vtu", {"u": np.zeros(50, complex)}, "field 'u' holds complex128"),
        ("a.vtu", {"normals": np.zeros((50, 3))}, "the name 'normals' is taken"),
        ("a.ply", {"x": np.zeros(50)}, "the name 'x' is taken"),
        ("a.ply", {"my u": np.zeros(50)}, "PLY allows no blanks in names of fields: 'my u'"),
        ("a.xyz", {"u": np.zeros(50)}, r"XYZ holds no fields \(u\)"),
        ("a.stl", None, "unknown suffix '.stl'; written are"),
    ],
)
def test_bad_writes(tmp_path, name, fields, message):
    with pytest.raises(ValueError, match=message):
        write(tmp_path / name, ellipsoid(50), fields)
    assert not (tmp_path / name).exists()


@pytest.mark.parametrize(("name", "n"), [("stanford-bunny.obj", 34_834), ("armadillo.obj", 43_243)])
def test_real_files_as_they_are(name, n):
    with warnings.catch_warnings(record=True) as record:
        warnings.simplefilter("always")
        cloud = read(real(name))
    text = " ".join(str(w.message) for w in record)
    assert cloud.n == n
    flat = np.asarray(quietly(real(name), smooth=False).normals)
    agree = np.sum(np.asarray(cloud.normals) * flat, axis=1)
    assert np.median(agree) > 0.995 and agree.min() > 0.8
    if "bunny" in name:
        assert "1113 vertices belong to no triangle" in text and cloud.boundary.sum() == 223
    assert Path(name).stem in text


# --- what a file leaves open ---------------------------------------------------------------


def curve(n=30):
    angle = 2 * np.pi * np.arange(n) / n
    return np.stack([np.cos(angle), np.sin(angle)], axis=1)


def write_columns(path, *columns, header=""):
    np.savetxt(path, np.column_stack(columns), header=header)
    return path


def test_a_value_in_the_fourth_column_is_not_taken_for_a_normal(tmp_path):
    x = np.asarray(ellipsoid(300).points)
    path = write_columns(tmp_path / "a.xyz", x, x[:, 2])
    with pytest.raises(ValueError, match=r"4 columns.*columns='x y z value' or columns='x y nx"):
        read(path)
    cloud = read(path, columns="x y z height", degree=2)
    assert cloud.dim == 3 and (np.asarray(cloud.points) == x).all()
    assert (read_fields(path, columns="x y z height")["height"] == x[:, 2]).all()
    named = write_columns(tmp_path / "b.xyz", x, x[:, 2], header="x y z height")
    assert read(named, degree=2).dim == 3 and set(read_fields(named)) == {"height"}
    unit = write_columns(tmp_path / "c.xyz", curve(), curve())
    with pytest.raises(ValueError, match="4 columns, which may be anything"):
        read(unit)  # as `x y 0 1` would be
    flat = read(unit, columns="x y nx ny")
    assert flat.dim == 2 and np.allclose(flat.normals, curve())
    long = write_columns(tmp_path / "d.xyz", curve(), 3 * curve())
    assert np.allclose(read(long, columns="x y nx ny").normals, curve())


@pytest.mark.parametrize("colours", ["shades", "red"])
def test_colours_are_not_taken_for_normals(tmp_path, colours):
    cloud = ellipsoid(300)
    red = np.tile([1.0, 0.0, 0.0], (300, 1))  # of length one, as normals are
    shades = np.random.default_rng(0).integers(0, 256, (300, 3))
    colour = red if colours == "red" else shades
    path = write_columns(tmp_path / "a.xyz", cloud.points, colour)
    with pytest.raises(
        ValueError, match=r"6 columns, .*columns='x y z nx ny nz' or columns='x y z r g b'"
    ):
        read(path)
    back = read(path, columns="x y z r g b", degree=2)
    assert np.abs(np.asarray(back.normals) - cloud.normals).max() < 0.05
    found = read_fields(path, columns="x y z r g b")
    assert (np.stack([found[c] for c in "rgb"], axis=1) == colour).all()


MARK = "\ufeff"


@pytest.mark.parametrize("suffix", ["obj", "off", "xyz", "ply", "stl", "vtk", "vtu"])
@pytest.mark.filterwarnings("ignore")
def test_a_mark_of_utf8_at_the_start_is_passed_over(tmp_path, suffix):
    ball, path = ball_mesh(60), tmp_path / f"a.{suffix}"
    if suffix == "obj":
        write_obj(path, ball.vertices, ball.triangles.tolist())
    elif suffix == "xyz":
        write(path, ellipsoid(60))
    else:
        cells = [("triangle", ball.triangles.astype(np.int32))]
        options = {"binary": False} if suffix in ("ply", "stl") else {}
        kind = "off" if suffix == "off" else None
        meshio.write(path, meshio.Mesh(ball.vertices, cells), kind, **options)
    plain = np.asarray(read(path).points)
    path.write_bytes(MARK.encode() + path.read_bytes())
    assert (np.asarray(read(path).points) == plain).all()


ODD = ["a<&\"b'>", "  two  blanks ", "Größe α²", "x", "&amp;", "]]>", "nx"]


def test_odd_names_of_fields_come_back(tmp_path):
    cloud = ellipsoid(20)
    fields = {name: np.arange(20.0) + i for i, name in enumerate(ODD)}
    write(tmp_path / "a.vtu", cloud, fields)
    found = read_fields(tmp_path / "a.vtu")
    assert found.keys() == fields.keys()
    assert all((found[name] == fields[name]).all() for name in fields)
    for suffix in ("ply", "vtk"):
        plain = {name: fields[name] for name in ("a<&\"b'>", "&amp;", "]]>")}
        write(tmp_path / f"a.{suffix}", cloud, plain)
        found = read_fields(tmp_path / f"a.{suffix}")
        assert all((found[name] == plain[name]).all() for name in plain)
        with pytest.raises(ValueError, match="holds no field of the name 'Größe'"):
            write(tmp_path / f"b.{suffix}", cloud, {"Größe": np.arange(20.0)})


def test_unsigned_bytes_of_a_binary_ply(tmp_path):
    rows = np.zeros(4, [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("red", "u1")])
    rows["x"], rows["red"] = np.arange(4), [0, 127, 128, 255]
    header = "ply\nformat binary_little_endian 1.0\nelement vertex 4\n" + "".join(
        f"property {kind} {name}\n"
        for kind, name in (("float", "x"), ("float", "y"), ("float", "z"), ("uchar", "red"))
    )
    path = tmp_path / "a.ply"
    path.write_bytes(header.encode() + b"end_header\n" + rows.tobytes())
    assert read_fields(path)["red"].tolist() == [0, 127, 128, 255]


@pytest.mark.parametrize("suffix", ["vtu", "vtk", "ply"])
def test_what_a_format_does_not_hold_is_refused(tmp_path, suffix):
    path, cloud = tmp_path / f"a.{suffix}", ellipsoid(20)
    bad = [({"": np.zeros(20)}, ValueError), ({3: np.zeros(20)}, TypeError)]
    bad += [(np.zeros(20), TypeError), ([("u", np.zeros(20))], TypeError)]
    if suffix == "vtk":
        bad += [({"u": np.zeros((20, 2))}, ValueError)]
    if suffix == "ply":
        bad += [({"u": np.zeros((20, 2)), "u_1": np.zeros(20)}, ValueError)]
        bad += [({"u": np.arange(20) + 2**31}, ValueError)]
    for fields, error in bad:
        with pytest.raises(error):
            write(path, cloud, fields)
        assert not path.exists()


def test_a_way_on_for_edges_of_many_triangles(tmp_path):
    ball = ball_mesh(300)
    a, b = ball.triangles[0, :2]
    fin = np.concatenate([ball.triangles, [[a, b, 300]]])
    vertices = np.concatenate([ball.vertices, [1.5 * ball.vertices[a]]])
    path = write_obj(tmp_path / "fin.obj", vertices, fin.tolist())
    with pytest.raises(ValueError, match=r"largest_part=True of clean_mesh and read .*faces=False"):
        read(path)
    with pytest.warns(UserWarning, match="1 triangles dropped, so that no edge has more than two"):
        cloud = read(path, largest_part=True)
    assert cloud.n == 300 and cloud.boundary is None
    points = read(write_obj(tmp_path / "b.obj", ball.vertices, fin[:-1].tolist()), faces=False)
    assert points.n == 300 and points.boundary is None


# --- any file ------------------------------------------------------------------------------

FEW = settings(max_examples=25, derandomize=True, deadline=None, database=None)
KINDS = ["float64", "float32", "int64", "int32", "uint8", "bool"]


@st.composite
def clouds_and_fields(draw):
    dim, n = draw(st.sampled_from([2, 3])), draw(st.integers(1, 40))
    rng = np.random.default_rng(draw(st.integers(0, 99)))
    points = draw(st.sampled_from([1e-9, 1.0, 1e6])) * rng.normal(size=(n, dim))
    normals = rng.normal(size=(n, dim))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    mask = rng.random(n) < 0.5 if draw(st.booleans()) else None
    cloud = PointCloud(points, normals, boundary=mask)
    names = st.text(min_size=1, max_size=8).filter(lambda s: s not in ("normals", "spacing"))
    fields = {}
    for name in draw(st.lists(names, max_size=3, unique=True)):
        shape = draw(st.sampled_from([(), (3,), (4,), (dim, dim)]))
        fields[name] = (100 * rng.random((n, *shape))).astype(draw(st.sampled_from(KINDS)))
    return cloud, fields


@FEW
@given(clouds_and_fields(), st.sampled_from([".vtu", ".vtk", ".ply"]))
def test_what_is_written_is_read_or_refused(given, suffix):
    """Every cloud with any fields of any names comes back as it was, or is not written."""
    cloud, fields = given
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"a{suffix}"
        try:
            write(path, cloud, fields)
        except ValueError as error:
            assert fields and ("name" in str(error) or "blanks" in str(error)), error
            return
        back, found = quietly(path), read_fields(path)
    assert (back.points == cloud.points).all()
    assert np.allclose(back.normals, cloud.normals, atol=1e-15)
    assert (back.boundary is None) == (cloud.boundary is None)
    assert back.boundary is None or (back.boundary == cloud.boundary).all()
    for name, value in fields.items():
        lack = 3 - cloud.dim if value.shape[1:] in ((2,), (2, 2)) else 0
        value = np.pad(value, [(0, 0)] + [(0, lack)] * (value.ndim - 1))
        if suffix == ".ply" and value.ndim > 1:
            flat = value.reshape(cloud.n, -1)
            same = [np.array_equal(found[f"{name}_{i}"], c) for i, c in enumerate(flat.T)]
            assert all(same)
        else:
            assert np.array_equal(found[name], value)


class Files(dict):
    def __repr__(self):  # of a failing example
        return "files"


@pytest.fixture(scope="module")
def whole_files(tmp_path_factory):
    """Bytes of a small file of every kind."""
    folder, ball = tmp_path_factory.mktemp("whole"), ball_mesh(40)
    files = Files()
    for kind in ("obj", "off", "ply", "stl", "vtk", "vtu"):
        path = folder / f"mesh.{kind}"
        if kind == "obj":
            write_obj(path, ball.vertices, ball.triangles.tolist())
        else:
            cells = [("triangle", ball.triangles.astype(np.int32))]
            options = {"binary": True} if kind == "stl" else {}
            meshio.write(path, meshio.Mesh(ball.vertices, cells), **options)
        files[path.name] = path.read_bytes()
    for kind in ("xyz", "ply", "vtk", "vtu"):
        path, cloud = folder / f"cloud.{kind}", ellipsoid(40)
        write(path, cloud, None if kind == "xyz" else {"u": cloud.points, "v": jnp.arange(40)})
        files[path.name] = path.read_bytes()
    return files


def test_a_series_lists_a_file_for_each_time(tmp_path):
    path, clouds = tmp_path / "run.pvd", [ellipsoid(50), ellipsoid(60, (2.0, 1.0, 1.0))]
    field = [cloud.points[:, 0] for cloud in clouds]
    write(path, clouds, {"x": field}, times=jnp.array([0.0, 0.25]))
    listed = ElementTree.parse(path).getroot().iter("DataSet")
    found = {float(entry.get("timestep")): tmp_path / entry.get("file") for entry in listed}
    assert list(found) == [0.0, 0.25]
    for file, cloud, values in zip(found.values(), clouds, field):
        np.testing.assert_array_equal(read(file).points, cloud.points)
        np.testing.assert_array_equal(read_fields(file)["x"], values)
    # A surface that stays, time first; written over the other.
    write(path, clouds[0], {"x": np.stack([field[0], 2 * field[0], 3 * field[0]])}, times=[1, 2, 3])
    files = [entry.get("file") for entry in ElementTree.parse(path).getroot().iter("DataSet")]
    assert len(files) == 3
    np.testing.assert_array_equal(read_fields(tmp_path / files[2])["x"], 3 * field[0])


@settings(FEW, max_examples=200)
@given(st.data())
@pytest.mark.filterwarnings("ignore")
def test_damaged_files_are_errors_or_files(whole_files, data):
    """Any byte changed, or any part lost: a ValueError, or what the file then says."""
    name = data.draw(st.sampled_from(sorted(whole_files)))
    content = bytearray(whole_files[name])
    for _ in range(data.draw(st.integers(0, 3))):
        # Half of them in the header, where numbers and names are.
        end = data.draw(st.sampled_from([min(400, len(content)), len(content)]))
        content[data.draw(st.integers(0, end - 1))] = data.draw(st.integers(0, 255))
    if data.draw(st.booleans()):
        content = content[: data.draw(st.integers(0, len(content)))]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / name
        path.write_bytes(bytes(content))
        for reader in (lambda: read(path, smooth=False, degree=1), lambda: read_fields(path)):
            try:
                found = reader()
            except ValueError as error:
                assert str(error).startswith(str(path))
            else:
                if isinstance(found, PointCloud):
                    assert np.isfinite(found.points).all()


def test_single_precision_without_x64(tmp_path):
    """JAX as it comes: files, meshes, sorting, jitter and pictures in float32."""
    with jax.enable_x64(False):
        cloud = ellipsoid(80)
        write(tmp_path / "a.vtu", cloud, {"u": cloud.points[:, 0]})
        back, found = read(tmp_path / "a.vtu"), read_fields(tmp_path / "a.vtu")
        assert back.points.dtype == found["u"].dtype == np.float32
        assert (back.points == cloud.points).all() and (found["u"] == cloud.points[:, 0]).all()
        sampled = js.sample_mesh(ball_mesh(300), n=100)
        assert sampled.normals.dtype == jnp.float32
        assert np.abs(np.linalg.norm(sampled.points, axis=1) - 1).max() < 1e-3
        tidy, order = js.sort_cloud(cloud)
        assert (tidy.points == cloud.points[order]).all() and tidy.points.dtype == jnp.float32
        ball = js.sphere(80)
        moved = js.jitter(ball, sphere_projection(), spacing=0.3)
        assert moved.points.dtype == jnp.float32
        assert np.abs(np.linalg.norm(moved.points, axis=1) - 1).max() < 1e-6
        kept = js.poisson_disk(ball.points, 0.5)
        assert 10 < len(kept) < 80
        figure = js.plot_fields(ball, {"u": ball.points[:, 0], "shape": None}, pixels=40)
        assert len(figure.axes) == 3


def test_a_mesh_says_what_it_is():
    assert (
        repr(sheet(3))
        == "TriangleMesh(9 vertices, 8 triangles, 1 borders, genus 0, edges of 0.552)"
    )
