import warnings
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import ConvexHull, cKDTree

from jaxsurf.io import read
from jaxsurf.shapes.cleaning import clean_mesh
from jaxsurf.shapes.closest import ClosestPoint
from jaxsurf.shapes.meshes import TriangleMesh
from jaxsurf.shapes.resampling import sample_mesh
from jaxsurf.shapes.smooth import fit_surface
from jaxsurf.shapes.spacing import measure_quality

DATA = Path(__file__).parents[1] / ".." / "shared" / "data"


def real(name):
    path = DATA / name
    if not path.exists():
        pytest.skip(f"{name} is not in ../shared/data")
    return path


def fibonacci(n):
    i = np.arange(n) + 0.5
    z, angle = 1 - 2 * i / n, np.pi * (1 + 5**0.5) * i
    r = np.sqrt(1 - z**2)
    return np.stack([r * np.cos(angle), r * np.sin(angle), z], axis=1)


def ball_mesh(n, axes=(1, 1, 1), uneven=0.2):
    """Ellipsoid with vertices on it, moved about so that the mesh is as uneven as real ones."""
    x = fibonacci(n)
    x += uneven * np.sqrt(4 * np.pi / n) * np.random.default_rng(0).normal(size=x.shape)
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    triangles = ConvexHull(x).simplices.astype(int)
    a, b, c = x[triangles].swapaxes(0, 1)
    inward = np.sum(np.cross(b - a, c - a) * a, axis=1) < 0
    triangles[inward] = triangles[inward, ::-1]
    return TriangleMesh(x * np.array(axes), triangles)


def grid_mesh(u, v, place, *, wrap_u=False, wrap_v=False):
    """Mesh of a (u, v) grid put in space by `place`."""
    i, j = np.meshgrid(np.arange(u - (not wrap_u)), np.arange(v - (not wrap_v)), indexing="ij")
    a, b = i * v + j, (i + 1) % u * v + j
    c, d = (i + 1) % u * v + (j + 1) % v, i * v + (j + 1) % v
    triangles = np.concatenate([np.stack(t, -1).reshape(-1, 3) for t in ((a, b, c), (a, c, d))])
    s, t = np.meshgrid(np.arange(u), np.arange(v), indexing="ij")
    return np.stack(place(s.ravel(), t.ravel()), axis=1).astype(float), triangles


def torus_grid(u, v):
    def place(s, t):
        s, t = 2 * np.pi * s / u, 2 * np.pi * t / v
        r = 1 + 0.4 * np.cos(t)
        return r * np.cos(s), r * np.sin(s), 0.4 * np.sin(t)

    return grid_mesh(u, v, place, wrap_u=True, wrap_v=True)


def sheet(n):
    return TriangleMesh(*grid_mesh(n, n, lambda s, t: (s / (n - 1), t / (n - 1), 0 * s)))


def mobius(n=40, width=5):
    vertices, triangles = grid_mesh(
        n,
        width,
        lambda s, t: (
            np.cos(2 * np.pi * s / n) * (1 + 0.1 * (t - 2) * np.cos(np.pi * s / n)),
            np.sin(2 * np.pi * s / n) * (1 + 0.1 * (t - 2) * np.cos(np.pi * s / n)),
            0.1 * (t - 2) * np.sin(np.pi * s / n),
        ),
    )
    a, b = (n - 1) * width + np.arange(width), np.arange(width)[::-1]
    seam = np.concatenate([np.c_[a[:-1], b[:-1], b[1:]], np.c_[a[:-1], b[1:], a[1:]]])
    return vertices, np.concatenate([triangles, seam])


def cube_mesh():
    corner = np.indices((2, 2, 2)).reshape(3, 8).T.astype(float)
    triangles = ConvexHull(corner).simplices.astype(int)
    a, b, c = corner[triangles].swapaxes(0, 1) - 0.5
    inward = np.sum(np.cross(b - a, c - a) * a, axis=1) < 0
    triangles[inward] = triangles[inward, ::-1]
    return TriangleMesh(corner, triangles)


# --- what a mesh knows about itself --------------------------------------------------------


def test_sphere_and_torus_in_numbers():
    ball = ball_mesh(4_000)
    assert ball.closed and ball.genus == 0 and ball.euler_characteristic == 2
    assert abs(ball.area / (4 * np.pi) - 1) < 2e-3
    assert abs(ball.volume / (4 / 3 * np.pi) - 1) < 3e-3
    assert np.abs(ball.vertex_normals - ball.vertices).max() < 0.05
    torus = TriangleMesh(*torus_grid(80, 40))
    assert torus.closed and torus.genus == 1 and torus.euler_characteristic == 0
    assert abs(torus.area / (4 * np.pi**2 * 0.4) - 1) < 5e-3
    assert torus.volume > 0


def test_borders_of_an_open_sheet():
    square = sheet(11)
    assert not square.closed and square.genus == 0
    assert len(square.border_edges) == 40 and square.border_vertices.sum() == 40
    (loop,) = square.border_loops
    corners = square.vertices[loop]
    length = np.linalg.norm(corners - np.roll(corners, -1, axis=0), axis=1)
    assert np.isclose(length.sum(), 4)
    assert np.allclose(square.vertex_normals, [0, 0, 1])
    with pytest.raises(ValueError, match="40 border edges"):
        _ = square.volume


def test_pieces_are_counted():
    ball = ball_mesh(200)
    two = TriangleMesh(
        np.concatenate([ball.vertices, ball.vertices + 3]),
        np.concatenate([ball.triangles, ball.triangles + 200]),
    )
    assert len(np.unique(two.components)) == 2 and two.genus == 0


# --- errors and repairs --------------------------------------------------------------------

CORNERS = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0], [0, 0, 1]])


@pytest.mark.parametrize(
    ("triangles", "message"),
    [
        ([[0, 1, 7]], r"triangle 0 names the vertices \[0 1 7\] \(from 0\), but there are 5"),
        ([[0, 1, -1]], "triangle 0 names the vertices"),
        ([[0, 1, 2], [1, 1, 3]], "triangle 1 names a vertex twice"),
        (
            [[0, 1, 2], [1, 0, 3], [0, 1, 4]],
            "edge from vertex 0 to 1 is shared by 3 triangles, expected at most 2",
        ),
        ([[0, 1, 2], [1, 2, 3]], "triangles 0 and 1 have opposite orientation"),
        ([[0, 1]], r"triangles have shape \(1, 2\), expected \(m, 3\)"),
    ],
)
def test_bad_triangles(triangles, message):
    with pytest.raises(ValueError, match=message):
        TriangleMesh(CORNERS, np.array(triangles))


def test_bad_vertices():
    with pytest.raises(ValueError, match="vertex 2 is not finite"):
        TriangleMesh(np.where(np.eye(5, 3) * [0, 0, 1] > 0, np.nan, CORNERS), [[0, 1, 3]])
    with pytest.raises(ValueError, match=r"vertices have shape \(5, 2\), expected \(n, 3\)"):
        TriangleMesh(CORNERS[:, :2], [[0, 1, 3]])


def test_turned_triangles_are_turned_back_and_stated():
    vertices, triangles = torus_grid(20, 10)
    turned = triangles.copy()
    turned[[3, 77, 250]] = turned[[3, 77, 250], ::-1]
    with pytest.warns(UserWarning, match="ring: 3 triangles turned round"):
        mesh, _ = clean_mesh(vertices, turned, name="ring")
    assert mesh.volume > 0
    assert np.isclose(mesh.volume, TriangleMesh(vertices, triangles).volume)


def test_mobius_band_is_refused():
    with pytest.raises(ValueError, match=r"band: the surface has only one side .*triangle 0"):
        clean_mesh(*mobius(), name="band")


def test_nothing_is_lost_silently():
    vertices, triangles = torus_grid(20, 10)
    # A seam: the first ring of vertices exists twice; one stray vertex; one collapsed triangle.
    seam = triangles.copy()
    half = (triangles < 10).any(axis=1) & (triangles >= 190).any(axis=1)
    seam[half] = np.where(triangles[half] < 10, triangles[half] + 200, triangles[half])
    doubled = np.concatenate([vertices, vertices[:10], [[9.0, 9, 9]]])
    seam = np.concatenate([seam, [[5, 5, 6]]])
    with pytest.warns(UserWarning) as record:
        mesh, kept = clean_mesh(doubled, seam)
    text = " ".join(str(w.message) for w in record)
    assert "10 vertices at exactly the position of another merged" in text
    assert "1 triangles without area" in text
    assert "1 vertices belong to no triangle, dropped (first: [210])" in text
    assert mesh.closed and mesh.genus == 1
    assert (kept == np.arange(200)).all()


# --- closest points and fits ---------------------------------------------------------------


def test_fits_around_a_pole():
    """Of a globe of meridians: many of the nearest vertices are on one ring."""
    rows, columns = 30, 60
    v, u = np.pi * np.arange(1, rows) / rows, 2 * np.pi * np.arange(columns) / columns
    v, u = (a.ravel() for a in np.meshgrid(v, u, indexing="ij"))
    x = np.stack([np.sin(v) * np.cos(u), np.sin(v) * np.sin(u), np.cos(v)], axis=1)
    x = np.concatenate([x, [[0, 0, 1], [0, 0, -1]]])
    t = ConvexHull(x).simplices
    inward = np.linalg.det(x[t]) < 0
    mesh = TriangleMesh(x, np.where(inward[:, None], t[:, ::-1], t))
    middles, each = mesh.vertices[mesh.triangles].mean(axis=1), np.arange(len(t))
    start = mesh.normals_at(each, np.full((len(each), 3), 1 / 3))
    points, normals, used = fit_surface(middles, start, mesh, 4)
    assert (used == 4).all()
    assert np.abs(np.linalg.norm(points, axis=1) - 1).max() < 1e-5
    assert np.abs(normals - points).max() < 1e-3


@pytest.mark.parametrize("grid", [(28, 28), (40, 40), (30, 60), (40, 20), (100, 20)])
def test_fits_of_meshes_that_are_long_in_one_direction(grid):
    """The nearest vertices lie on few columns there: normals were up to 34 degrees off."""
    mesh = TriangleMesh(*torus_grid(*grid))
    center = mesh.vertices * [1, 1, 0]
    center /= np.linalg.norm(center, axis=1, keepdims=True)
    angle = lambda n: np.arccos(np.clip(np.sum(n * (mesh.vertices - center) / 0.4, axis=1), -1, 1))
    _, normals, used = fit_surface(mesh.vertices, mesh.vertex_normals, mesh, 4)
    assert (used == 4).all()
    assert angle(normals).max() < 1.3 * angle(mesh.vertex_normals).max()
    off = lambda x: np.abs(np.hypot(np.hypot(x[:, 0], x[:, 1]) - 1, x[:, 2]) - 0.4)
    middles, each = mesh.vertices[mesh.triangles].mean(axis=1), np.arange(len(mesh.triangles))
    there = mesh.normals_at(each, np.full((len(each), 3), 1 / 3))
    points, _, used = fit_surface(middles, there, mesh, 4)
    assert (used == 4).all()
    assert off(points).max() < 0.1 * off(middles).max()


def test_closest_point_against_all_triangles():
    rng = np.random.default_rng(1)
    ball = ball_mesh(300)
    # One fan of very long triangles makes the search by centres hard.
    long = TriangleMesh(
        np.concatenate([ball.vertices, [[0, 0, 5.0], [0.1, 0, 5], [0, 0.1, 40]]]),
        np.concatenate([ball.triangles, [[300, 301, 302]]]),
    )
    x = rng.normal(size=(200, 3)) * [1, 1, 8]
    place, triangle, bary = ClosestPoint(long.vertices, long.triangles)(x)
    # Every triangle sampled finely: no sample may be nearer.
    u, v = rng.random((2, 4_000))
    u, v = np.where(u + v > 1, 1 - u, u), np.where(u + v > 1, 1 - v, v)
    weights = np.stack([1 - u - v, u, v], axis=1)
    samples = np.einsum("sk,mkd->msd", weights, long.vertices[long.triangles]).reshape(-1, 3)
    found = np.linalg.norm(place - x, axis=1)
    assert (found <= cKDTree(samples).query(x)[0] + 1e-12).all()
    assert (found >= cKDTree(samples).query(x)[0] - 0.5).all()
    corners = long.vertices[long.triangles[triangle]]
    assert np.allclose(np.einsum("qk,qkd->qd", bary, corners), place)
    assert bary.min() >= 0 and np.allclose(bary.sum(axis=1), 1)


def ellipsoid_distance(x, axes):
    """Distance to the ellipsoid, to first order: |f| / |grad f|."""
    a = np.array(axes)
    f = np.sum((x / a) ** 2, axis=1) - 1
    return np.abs(f) / np.linalg.norm(2 * x / a**2, axis=1)


@pytest.mark.parametrize("axes", [(1, 1, 1), (1, 0.8, 0.6)])
def test_distance_to_the_smooth_surface(axes):
    flat, smooth, normal = [], [], []
    for n in (1_000, 4_000, 16_000):
        mesh = ball_mesh(n, axes)
        x = fibonacci(1_500) * axes
        place, triangle, bary = ClosestPoint(mesh.vertices, mesh.triangles)(x)
        fitted, normals, used = fit_surface(place, mesh.normals_at(triangle, bary), mesh, 4)
        exact = fitted / np.array(axes) ** 2
        exact /= np.linalg.norm(exact, axis=1, keepdims=True)
        flat.append(ellipsoid_distance(place, axes).max())
        smooth.append(ellipsoid_distance(fitted, axes).max())
        normal.append(np.linalg.norm(normals - exact, axis=1).max())
        assert used.min() == 4
    # Twice as fine each time.
    slopes = np.log2(
        np.array([flat, smooth, normal])[:, :-1] / np.array([flat, smooth, normal])[:, 1:]
    )
    assert flat[-1] < 1e-3 and 1.5 < slopes[0].mean() < 2.5
    assert smooth[-1] < 6e-8 and slopes[1].mean() > 4
    assert normal[-1] < 1e-5 and slopes[2].mean() > 3.8


# --- resampling ----------------------------------------------------------------------------


def test_sphere_is_resampled_evenly():
    mesh = ball_mesh(3_000)
    cloud = sample_mesh(mesh, n=1_000)
    x = np.asarray(cloud.points)
    assert cloud.n == 1_000 and cloud.boundary is None
    assert np.abs(np.linalg.norm(x, axis=1) - 1).max() < 1e-6
    assert np.abs(np.asarray(cloud.normals) - x).max() < 1e-5
    quality = measure_quality(x, measure=4 * np.pi, probes=fibonacci(20_000))
    assert quality.smallest > 0.7 and quality.hole < 0.9


def test_spacing_gives_as_many_points_as_fit():
    cloud = sample_mesh(ball_mesh(3_000), spacing=0.1, smooth=False)
    assert abs(cloud.n - 4 * np.pi / 0.01) < 10
    again = sample_mesh(ball_mesh(3_000), spacing=0.1, smooth=False)
    assert (np.asarray(cloud.points) == np.asarray(again.points)).all()
    other = sample_mesh(ball_mesh(3_000), spacing=0.1, smooth=False, seed=1)
    assert (np.asarray(cloud.points) != np.asarray(other.points)).any()


def test_border_points_lie_on_the_border():
    cloud = sample_mesh(sheet(21), n=900, smooth=False)
    x, edge = np.asarray(cloud.points), np.asarray(cloud.boundary)
    gap = np.minimum(x[:, :2], 1 - x[:, :2]).min(axis=1)
    assert edge.sum() == 120
    assert np.abs(gap[edge]).max() < 1e-12 and gap[~edge].min() > 0.2 / 30
    quality = measure_quality(
        x, measure=1.0, probes=np.random.default_rng(0).random((9_000, 3)) * [1, 1, 0]
    )
    assert quality.smallest > 0.5 and quality.hole < 0.95


def test_holes_too_small_to_see_are_stated():
    mesh = ball_mesh(3_000)
    pierced = TriangleMesh(mesh.vertices, mesh.triangles[1:])
    with pytest.warns(UserWarning, match="1 of 1 holes are shorter round than 4 spacings"):
        cloud = sample_mesh(pierced, n=500)
    assert cloud.boundary is not None and not np.asarray(cloud.boundary).any()


def test_more_points_than_vertices():
    cloud = sample_mesh(ball_mesh(500), n=3_000)
    x = np.asarray(cloud.points)
    assert np.abs(np.linalg.norm(x, axis=1) - 1).max() < 1e-4
    assert measure_quality(x, measure=4 * np.pi).smallest > 0.6


def test_sharp_edges_stay_with_smooth_off():
    cube = cube_mesh()
    cloud = sample_mesh(cube, n=600, smooth=False)
    x = np.asarray(cloud.points)
    assert np.abs(np.minimum(np.abs(x), np.abs(x - 1)).min(axis=1)).max() < 1e-12
    # Normals of its faces: carried from corner to corner they were 38 degrees off in the middle.
    assert np.abs(np.abs(cloud.normals).max(axis=1) - 1).max() < 1e-12
    face = np.argmax(np.abs(cloud.normals), axis=1)
    np.testing.assert_allclose(x[np.arange(600), face], cloud.normals.max(axis=1), atol=1e-12)
    with pytest.raises(ValueError, match="8 vertices, a smooth fit of degree 4 needs at least 17"):
        sample_mesh(cube, n=600)


def test_a_triangle_without_area_has_the_normals_around():
    """As where a corner of one face lies on the edge of another: there they were NaN."""
    cube = cube_mesh()
    x = np.concatenate([cube.vertices, [[0.5, 0.0, 0.0]]])
    edge = [np.flatnonzero((x == corner).all(axis=1))[0] for corner in ([0, 0, 0], [1, 0, 0])]
    triangles = cube.triangles
    side = next(i for i, t in enumerate(triangles) if set(edge) <= set(t))
    t = triangles[side]
    start = next(k for k in range(3) if {t[k], t[(k + 1) % 3]} == set(edge))
    a, b, c = np.roll(t, -start)
    split = [[a, 8, c], [8, b, c], [a, b, 8]]
    mesh = TriangleMesh(x, np.concatenate([np.delete(triangles, side, axis=0), split]))
    assert mesh.closed and np.isfinite(mesh.corner_normals).all()
    cloud = sample_mesh(mesh, n=1_000, smooth=False)
    # All but those on that edge, which may be of the triangle without area.
    off = np.abs(np.asarray(cloud.points)[:, 1:]).max(axis=1) > 1e-9
    assert np.abs(np.abs(cloud.normals).max(axis=1) - 1)[off].max() < 1e-12


def test_bad_requests():
    mesh = ball_mesh(200)
    with pytest.raises(ValueError, match="give one of n and spacing, not n = None and spacing = N"):
        sample_mesh(mesh)
    with pytest.raises(ValueError, match=r"not n = 100 and spacing = 0\.1"):
        sample_mesh(mesh, n=100, spacing=0.1)
    with pytest.raises(ValueError, match=r"spacing = -0.1, expected above 0"):
        sample_mesh(mesh, spacing=-0.1)
    with pytest.raises(ValueError, match=r"n = 3 points .* expected at least 10"):
        sample_mesh(mesh, n=3)


@pytest.mark.parametrize(("name", "n"), [("stanford-bunny.obj", 2_960), ("armadillo.obj", 13_828)])
def test_real_surface(name, n):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        path = real(name)
        whole = read(path, smooth=False)
        cloud = read(path, n=n)
    assert cloud.n == n
    x, normals = np.asarray(cloud.points), np.asarray(cloud.normals)
    vertices = np.asarray(whole.points)
    area = {"stanford-bunny.obj": 0.05713, "armadillo.obj": 1.6572}[name]
    quality = measure_quality(x, measure=area, normals=normals, probes=vertices)
    assert quality.smallest > 0.35 and quality.hole < 0.9
    assert 0.9 < quality.mean < 1.0
    # On the surface, facing the way the vertices nearby do, on both sides of ears and fingers.
    gap, near = cKDTree(vertices).query(x)
    agree = np.sum(normals * np.asarray(whole.normals)[near], axis=1)
    assert gap.max() < quality.spacing
    assert np.median(agree) > 0.99 and (agree > 0.5).mean() > 0.998 and agree.min() > -0.2
    if name == "stanford-bunny.obj":
        assert 60 < np.asarray(cloud.boundary).sum() < 90
        assert np.asarray(whole.boundary).sum() == 223
    else:
        assert cloud.boundary is None and whole.boundary is None
