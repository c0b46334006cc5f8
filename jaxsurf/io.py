"""Point clouds from files, and files for ParaView from point clouds and fields."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree
from xml.sax.saxutils import escape

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Shaped

from jaxsurf.arguments import in_range, instance, real, whole
from jaxsurf.cloud import PointCloud
from jaxsurf.failures import needs_values, not_finite, raise_at, warn
from jaxsurf.formats.by_suffix import contents_of
from jaxsurf.formats.contents import Contents
from jaxsurf.formats.held import check_name, columns_of, in_space
from jaxsurf.formats.normals import (
    compare_normals,
    fitted_normals,
    own_normals,
    turned_to,
    unit_normals,
)
from jaxsurf.formats.through_meshio import meshio
from jaxsurf.normals import estimate_normals
from jaxsurf.series import Frame, frames_of
from jaxsurf.shapes.cleaning import clean_mesh, merge_equal
from jaxsurf.shapes.resampling import sample_mesh

# What a cloud carries besides points and normals goes into files under these names.
_OWN = ("boundary", "active", "spacing")


def read(
    path: str | Path,
    *,
    n: int | None = None,
    spacing: float | None = None,
    smooth: bool = True,
    degree: int = 4,
    seed: int = 0,
    columns: str | None = None,
    faces: bool = True,
    normals: bool = True,
    largest_part: bool = False,
) -> PointCloud:
    """Point cloud from a triangle mesh or a list of points.

    OBJ, OFF and XYZ (columns `x y z`, or `x y` for curves in the plane; others must be named) need
    no other package; PLY, STL, VTK and VTU need `pip install 'jaxsurf[files]'`.

    Normals are those in the file, scaled to length one. A mesh without them, and new points on one,
    have normals to the side that the order of its corners tells, or normals in the file where these
    differ; their direction comes from local polynomial fits of the vertices (`smooth=True`) or from
    the triangles around (first-order accurate, as those in files mostly are). A list of points
    without normals gets those of `estimate_normals`.

    Stated in a warning, with how many: polygons cut into triangles that share their first
    corner, vertices at equal positions merged (always so in STL), vertices that no triangle
    uses and triangles without area left out, triangles turned round to agree with the others, or
    with normals in the file; and normals in the file that are no better than the triangles'.

    Args:
        path: file; its suffix tells the format.
        n: resample a mesh to this many points, see `sample_mesh`.
        spacing: resample a mesh to this distance between neighbours instead.
        smooth: the mesh stands for a smooth surface: fit polynomials. False keeps to the
            triangles, right for sharp edges.
        degree: of the polynomials; that of the operators to be used.
        seed: of resampling.
        columns: of an XYZ file, by name: x, y, z, nx, ny, nz, and any other name for a field
            (see `read_fields`); as in 'x y z r g b'. If None, those that a first comment names
            (`# x y z nx ny nz`, as `write` leaves it), or else two or three coordinates: more
            columns without names are an error, as unit vectors may be colours too.
        faces: False takes the vertices of a mesh as a list of points, whatever its faces.
        normals: False takes none from the file.
        largest_part: leave out faces until no edge has more than two, see `clean_mesh`.

    Returns:
        The vertices in the order of the file (`sort_cloud` sorts them), with `boundary` at the
        border of an open mesh; if resampled, new points in sorted order.

    Accuracy: normals of a smooth surface O(h^degree) (`tests/test_io.py::test_mesh_normals`).
    Raises:
        OSError: no such file.
        ValueError: the file is empty, truncated, of unknown kind or has no points; vertex
            numbers out of range, non-finite coordinates, zero normals, coinciding points of a
            cloud (named by index); edges of more than two triangles; a surface with one side
            only; too few points; columns that nothing names. The message begins with the path.
        TypeError: an argument of the wrong kind.
        ImportError: meshio is needed and absent.

    Example:
        >>> import pathlib, tempfile
        >>> folder = tempfile.TemporaryDirectory()
        >>> path = pathlib.Path(folder.name) / "sphere.xyz"
        >>> js.write(path, js.sphere(500))
        >>> js.read(path).points.shape
        (500, 3)
    """
    if n is not None:
        whole(n, "n", least=1)
    if spacing is not None:
        real(spacing, "spacing", above=0)
    whole(degree, "degree", least=1)
    whole(seed, "seed", least=0)
    flags = dict(smooth=smooth, faces=faces, normals=normals, largest_part=largest_part)
    for name, value in flags.items():
        instance(value, (bool, np.bool_), name)
    contents = contents_of(path, columns)
    if not normals:
        contents = replace(contents, normals=None)
    try:
        notes = list(contents.notes)
        triangles = _triangulate(contents, notes) if faces else np.empty((0, 3), np.int64)
        for note in notes:
            warn(f"{path}: {note}")
        if not len(triangles):
            return _from_points(contents, n, spacing, degree)
        mesh, kept = clean_mesh(
            contents.points, triangles, name=str(path), largest_part=largest_part
        )
        own = None if contents.normals is None else own_normals(contents, kept)
        if own is not None:
            mesh = turned_to(path, mesh, own)
        if n is not None or spacing is not None:
            return sample_mesh(mesh, n=n, spacing=spacing, smooth=smooth, degree=degree, seed=seed)
        if own is None:
            own = fitted_normals(path, mesh, degree) if smooth else mesh.vertex_normals
        else:
            own = unit_normals(own)
            if smooth:
                compare_normals(path, mesh, own, degree)
        boundary = None if mesh.closed else jnp.asarray(mesh.border_vertices)
        return PointCloud(jnp.asarray(mesh.vertices), jnp.asarray(own), boundary=boundary)
    except ValueError as error:
        text = str(error)
        named = text if text.startswith(str(path)) else f"{path}: {text}"
        raise ValueError(named) from None


def _triangulate(contents: Contents, notes: list[str]) -> np.ndarray:
    parts, cut = [np.empty((0, 3), np.int64)], 0
    for polygons in contents.faces:
        corners = polygons.shape[1]
        cut += len(polygons) if corners > 3 else 0
        first = np.repeat(polygons[:, :1], corners - 2, axis=1)
        fan = np.stack([first, polygons[:, 1:-1], polygons[:, 2:]], axis=-1)
        parts.append(fan.reshape(-1, 3))
    if cut:
        notes.append(f"{cut} polygons with more than three corners cut into triangles")
    return np.concatenate(parts)


def _from_points(contents: Contents, n, spacing, degree: int) -> PointCloud:
    if n is not None or spacing is not None:
        raise ValueError("a list of points without triangles cannot be resampled")
    points, normals = contents.points, contents.normals
    own = {k: _own(k, contents.fields[k]) for k in _OWN if k in contents.fields}
    on = np.asarray(own.get("active", np.ones(len(points), bool)))
    names = np.flatnonzero(on)
    raise_at(on & not_finite(points), "point {i} is not finite: {v}", points)
    in_range(points[on], "points")
    first, group = merge_equal(points[on])
    again = first[group] != np.arange(len(names))
    raise_at(again, "points {v} and {i} coincide", names[first[group]], points=names)
    if normals is not None:
        normals = unit_normals(normals, on)
        # Plane curves are kept in space by formats that know nothing else.
        if points.shape[1] == 3 and not points[on, 2].any() and not normals[on, 2].any():
            points, normals = points[:, :2], normals[:, :2]
    x = jnp.asarray(points)
    if normals is None:
        found = np.zeros_like(points)
        found[on] = estimate_normals(x[names], degree=degree)
        return PointCloud(x, jnp.asarray(found), **own)
    return PointCloud(x, jnp.asarray(normals), **own)


def _own(name: str, value: np.ndarray) -> Array:
    """What a cloud carries besides points and normals, as it is in a file."""
    if name == "spacing":
        return jnp.asarray(value, float)
    if not np.isin(value, (0, 1)).all():
        raise ValueError(f"field {name!r} is no mask: it holds other numbers than 0 and 1")
    return jnp.asarray(value, bool)


def read_fields(path: str | Path, *, columns: str | None = None) -> dict[str, np.ndarray]:
    """Values per point in a PLY, VTK, VTU or XYZ file, in the order of its points.

    Args:
        path: file.
        columns: of an XYZ file, as in `read`; those with other names than coordinates and
            normals are fields.

    Returns:
        Arrays `(n,)`, `(n, c)`, or `(n, 3, 3)` for nine components, by name. What `read` puts
        into the cloud itself (normals, boundary, activity, spacing) is left out.

    Raises:
        OSError, ValueError, TypeError, ImportError: as `read`.

    Example:
        >>> import pathlib, tempfile
        >>> folder = tempfile.TemporaryDirectory()
        >>> path, cloud = pathlib.Path(folder.name) / "sphere.vtu", js.sphere(500)
        >>> js.write(path, cloud, {"height": cloud.points[:, 2]})
        >>> js.read_fields(path)["height"].shape
        (500,)
    """
    fields = contents_of(path, columns).fields
    return {
        name: v.reshape(-1, 3, 3) if v.shape[1:] == (9,) else v
        for name, v in fields.items()
        if name not in _OWN
    }


def write(
    path: str | Path,
    cloud: PointCloud | Sequence[PointCloud],
    fields: Mapping[str, Shaped[Array | np.ndarray, "n ..."] | Sequence] | None = None,
    *,
    times: Float[Array | np.ndarray, " m"] | Sequence[float] | None = None,
) -> None:
    """File with the points, normals and fields, for ParaView and for `read`.

    VTU and VTK hold scalars `(n,)`, vectors `(n, c)` (VTK none with c = 2) and tensors
    `(n, d, d)`; PLY holds scalars, and vectors as one scalar per component (`name_0`, `name_1`,
    …); XYZ holds points and normals only, of the points that are switched on. Plane curves are put
    at z = 0, their vectors and tensors filled with zeros. Boundary, activity and spacing go along
    where the cloud has them, except to XYZ. (In ParaView, choose *Point Gaussian* to see the points
    as a surface.)

    With `times` it is a series: `run.pvd`, which ParaView opens as an animation, lists a VTU file
    for each time in the folder `run`. Of an evolution with one field:
    `js.write("run.pvd", run.clouds, {"u": run.fields}, times=run.ts)`.

    Args:
        path: .vtu, .vtk, .ply or .xyz, of a series .pvd; overwritten if it exists.
        cloud: n points; of a series one for all times or one for each.
        fields: arrays with one row per point, by name; of a series one for each time, or an array
            with time first.
        times: of a series, increasing.

    Raises:
        ValueError: unknown suffix; a field with another number of rows (both numbers given), of
            a shape or kind that the format does not hold, or with a name that is taken or that
            the format does not hold (VTU: any printable text; PLY and VTK: no blanks, ASCII);
            other numbers of clouds or fields than of times, or times that do not increase.
        TypeError: no cloud, no mapping of fields by name, or a name that is no text.
        OSError: the file cannot be written.
        ImportError: meshio is needed and absent.

    Example:
        >>> import pathlib, tempfile
        >>> folder = tempfile.TemporaryDirectory()
        >>> cloud = js.sphere(500)
        >>> js.write(pathlib.Path(folder.name) / "sphere.vtu", cloud, {"x": cloud.points[:, 0]})
        >>> clouds = [js.PointCloud(r * cloud.points, cloud.normals) for r in (1.0, 1.5)]
        >>> fields = {"x": [moved.points[:, 0] for moved in clouds]}
        >>> js.write(pathlib.Path(folder.name) / "run.pvd", clouds, fields, times=[0.0, 0.5])
    """
    path = Path(instance(path, (str, Path), "path"))
    given = instance({} if fields is None else fields, Mapping, "fields", "{name: values}")
    series = path.suffix.lower() == ".pvd"
    if series != (times is not None):
        raise ValueError(f"{path}: times = {times}; a series of times is a .pvd file, no other is")
    if series:
        _write_series(path, frames_of(cloud, given, times))
    else:
        _write_file(path, cloud, given)


def _write_file(path: Path, cloud: Any, given: Mapping) -> None:
    cloud = instance(cloud, PointCloud, "cloud", "js.PointCloud(points, normals) makes one")
    suffix = path.suffix.lower()
    if suffix not in (".vtu", ".vtk", ".ply", ".xyz"):
        raise ValueError(
            f"{path}: unknown suffix {path.suffix!r}; written are .vtu .vtk .ply .xyz .pvd"
        )
    instead = "write files outside jit and grad"
    needs_values("cloud and fields", cloud, dict(given), instead=instead)
    if not cloud.n:
        raise ValueError("cloud has 0 points, at least 1 is needed")
    points, normals = np.asarray(cloud.points), np.asarray(cloud.normals)
    if suffix == ".xyz":
        if given:
            raise ValueError(f"{path}: XYZ holds no fields ({', '.join(given)}); take .vtu")
        names = "x y nx ny" if cloud.dim == 2 else "x y z nx ny nz"
        rows = np.hstack([points, normals])[cloud.host_active]
        np.savetxt(path, rows, fmt="%.17g", header=names)
        return
    taken = ["normals", *_OWN]
    if suffix == ".ply":
        taken += ["x", "y", "z", "nx", "ny", "nz"]
    data = {"normals": in_space("normals", normals, cloud)}
    for name, value in given.items():
        check_name(name, taken, suffix)
        data[name] = in_space(name, value, cloud)
    for name in _OWN:
        if (value := getattr(cloud, name)) is not None:
            data[name] = in_space(name, value, cloud)
    place = np.pad(points, ((0, 0), (0, 3 - cloud.dim)))
    library = meshio()
    if suffix == ".ply":
        mesh = library.Mesh(place, [], point_data=columns_of(data))
        library.ply.write(path, mesh)
        return
    if suffix == ".vtu":
        # Names go into the file as they are: here is where XML is made of them.
        data = {escape(name, {'"': "&quot;"}): value for name, value in data.items()}
    else:
        for name, value in data.items():
            if value.ndim == 2 and value.shape[1] == 2:
                raise ValueError(f"field {name!r}: VTK holds no vectors of two numbers; take .vtu")
    mesh = library.Mesh(place, [("vertex", np.arange(cloud.n)[:, None])], point_data=data)
    (library.vtu if suffix == ".vtu" else library.vtk).write(path, mesh)


def _write_series(path: Path, frames: list[Frame]) -> None:
    folder = path.with_suffix("")
    folder.mkdir(exist_ok=True)
    root = ElementTree.Element("VTKFile", type="Collection", version="0.1")
    listed = ElementTree.SubElement(root, "Collection")
    for i, frame in enumerate(frames):
        file = folder / f"{folder.name}_{i:05d}.vtu"
        _write_file(file, frame.cloud, frame.fields)
        ElementTree.SubElement(
            listed,
            "DataSet",
            timestep=repr(frame.time),
            part="0",
            file=f"{folder.name}/{file.name}",
        )
    ElementTree.ElementTree(root).write(path, encoding="utf-8", xml_declaration=True)
