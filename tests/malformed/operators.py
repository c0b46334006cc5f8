"""Neighbours, stencils, operators and curvature."""

# One case a line reads as a table.
# ruff: noqa: E501

import functools
import io
import tempfile
import zipfile
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import scipy.sparse

import jaxsurf as js

from . import Case

N, K, METHOD = 80, 20, js.GFDM(degree=2)


@functools.cache
def cloud() -> js.PointCloud:
    return js.sphere(N)


@functools.cache
def lists() -> js.Neighbors:
    return js.find_neighbors(cloud(), k=K)


@functools.cache
def ring() -> js.Stencil:
    """A stencil made by hand: the second difference on a closed chain of points."""
    i = np.arange(N)
    indices = np.stack([i, (i + 1) % N, (i - 1) % N]).astype(np.int32)
    return js.Stencil(jnp.asarray(indices), jnp.asarray([[-2.0] * N, [1.0] * N, [1.0] * N]))


def changed(values, place, new):
    values = np.array(values)
    values[place] = new
    return jnp.asarray(values)


def weights(**change):
    return change.get("weights", ring().weights)


def stencil(**change):
    parts = {"indices": ring().indices, "weights": ring().weights} | change
    return js.Stencil(**parts)


def neighbors(**change):
    parts = {"indices": lists().indices, "mask": lists().mask} | change
    return js.Neighbors(**parts)


@functools.cache
def file_bytes() -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a.npz"
        ring().save(path)
        return path.read_bytes()


def twice(weights) -> js.Stencil:
    """A stencil by hand whose own points stand in two slots, in NumPy."""
    indices = np.asarray(ring().indices)
    return js.Stencil(np.concatenate([indices, indices[:1]]), weights)


def load(data: bytes):
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a.npz"
        path.write_bytes(data)
        return js.Stencil.load(path)


def archive(**change) -> bytes:
    """A file as `save` writes it, with some arrays replaced (None: left out)."""
    parts = {
        "indices": np.asarray(ring().indices), "weights": np.asarray(ring().weights),
        "out_shape": np.array((), int), "in_shape": np.array((), int),
    }  # fmt: skip
    parts |= change
    file = io.BytesIO()
    np.savez(file, **{name: value for name, value in parts.items() if value is not None})
    return file.getvalue()


def flipped(place: float) -> bytes:
    data = bytearray(file_bytes())
    data[int(place * len(data))] ^= 0xFF
    return bytes(data)


def npy_in_zip() -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        archive.writestr("indices.npy", b"nothing of the kind")
    return file.getvalue()


def tensors(entry):
    return jnp.asarray(np.tile(np.asarray(entry, float), (N, 1, 1)))


EYE = np.eye(3)

NEIGHBORS = [
    ("an index beyond the points", lambda: neighbors(indices=changed(lists().indices, (3, 4), N)), ("indices of point 3", f"point {N}", f"there are {N}")),
    ("an index below zero", lambda: neighbors(indices=changed(lists().indices, (5, 1), -1)), ("indices of point 5", "point -1", f"{N}")),
    ("indices that are floating-point", lambda: neighbors(indices=lists().indices.astype(float)), ("indices", "float64", "integers")),
    ("indices in a list", lambda: neighbors(indices=[[0, 1], [1, 0]]), ("indices", "list", "array (n, k)")),
    ("indices None", lambda: neighbors(indices=None), ("indices", "NoneType")),
    ("indices of one axis", lambda: neighbors(indices=jnp.arange(N)), ("indices", f"({N},)", "(n, k)")),
    ("no slots", lambda: js.Neighbors(jnp.zeros((N, 0), int), jnp.zeros((N, 0), bool)), ("indices", f"({N}, 0)", "at least 1")),
    ("no points", lambda: js.Neighbors(jnp.zeros((0, 3), int), jnp.zeros((0, 3), bool)), ("indices", "(0, 3)", "at least 1")),
    ("a mask of another shape", lambda: neighbors(mask=lists().mask[:, 1:]), ("mask", f"({N}, {K - 1})", f"({N}, {K})")),
    ("a mask of integers", lambda: neighbors(mask=lists().mask.astype(int)), ("mask", "int64", "bool")),
    ("a mask all False", lambda: neighbors(mask=jnp.zeros((N, K), bool)), ("mask", "False", str(N * K))),
    ("a row without its own point", lambda: neighbors(mask=lists().mask.at[7, 0].set(False)), ("mask of row 7", "itself", str(K - 1))),
    ("slot 0 is another point", lambda: neighbors(indices=changed(lists().indices, (9, 0), 2)), ("slot 0 of row 9", "point 2", "expected 9")),
    ("a negative radius", lambda: neighbors(radius=jnp.asarray(-0.5)), ("radius", "-0.5", "positive")),
    ("a radius NaN at one point", lambda: neighbors(radius=changed(np.ones(N), 4, np.nan)), ("radius of point 4", "nan", "positive")),
    ("radii of too few points", lambda: neighbors(radius=jnp.ones(7)), ("radius", "(7,)", f"({N},)")),
]  # fmt: skip

FIND = [
    ("k = 2.5", lambda: js.find_neighbors(cloud(), k=2.5), ("k is 2.5", "whole number")),
    ("k in words", lambda: js.find_neighbors(cloud(), k="8"), ("k is '8'", "whole number")),
    ("k = True", lambda: js.find_neighbors(cloud(), k=True), ("k is True", "whole number")),
    ("k = 1", lambda: js.find_neighbors(cloud(), k=1), ("k = 1", "at least 2")),
    ("k = 0", lambda: js.find_neighbors(cloud(), k=0), ("k = 0", "at least 2")),
    ("k above n", lambda: js.find_neighbors(cloud(), k=N + 1), (str(N), f"k = {N + 1}")),
    ("neither k nor radius", lambda: js.find_neighbors(cloud()), ("exactly one of k and radius",)),
    ("radius NaN", lambda: js.find_neighbors(cloud(), radius=np.nan), ("radius", "nan", "finite")),
    ("radius infinite", lambda: js.find_neighbors(cloud(), radius=np.inf), ("radius", "inf", "finite")),
    ("radius negative", lambda: js.find_neighbors(cloud(), radius=-1.0), ("radius", "-1", "positive")),
    ("radius in words", lambda: js.find_neighbors(cloud(), radius="1"), ("radius", "'1'", "real numbers")),
    ("radius complex", lambda: js.find_neighbors(cloud(), radius=1j), ("radius", "complex", "real")),
    ("radii of too few points", lambda: js.find_neighbors(cloud(), radius=np.ones(3)), ("radius", "(3,)", f"({N},)")),
    ("capacity 2.5", lambda: js.find_neighbors(cloud(), radius=0.5, capacity=2.5), ("capacity is 2.5", "whole")),
    ("min_cosine 2", lambda: js.find_neighbors(cloud(), k=K, min_cosine=2), ("min_cosine = 2", "at most 1")),
    ("min_cosine NaN", lambda: js.find_neighbors(cloud(), k=K, min_cosine=np.nan), ("min_cosine = nan", "at least -1")),
    ("min_cosine None", lambda: js.find_neighbors(cloud(), k=K, min_cosine=None), ("min_cosine", "None", "real")),
    ("a string", lambda: js.find_neighbors("cloud", k=K), ("cloud", "'cloud'", "real numbers")),
    ("None", lambda: js.find_neighbors(None, k=K), ("cloud", "None")),
    ("a SciPy matrix", lambda: js.find_neighbors(scipy.sparse.eye_array(5), k=3), ("cloud", "(5, 5)", "real numbers")),
    ("points of four dimensions", lambda: js.find_neighbors(np.ones((9, 4)), k=3), ("points", "(9, 4)", "(n, 3)")),
    ("a scalar", lambda: js.find_neighbors(3.0, k=3), ("points", "()", "(n, 3)")),
    ("one point", lambda: js.find_neighbors(np.ones((1, 3)), k=2), ("too few points: 1", "at least 2")),
]  # fmt: skip

STENCIL = [
    ("an index beyond the points", lambda: stencil(indices=ring().indices.at[1, 6].set(N)), ("indices of point 6", f"point {N}", f"there are {N}")),
    ("an index below zero", lambda: stencil(indices=ring().indices.at[2, 6].set(-3)), ("indices of point 6", "point -3")),
    ("floating-point indices", lambda: stencil(indices=ring().indices.astype(float)), ("indices", "float64", "integers")),
    ("integer weights", lambda: stencil(weights=ring().weights.astype(int)), ("weights", "int64", "floating-point")),
    ("complex weights", lambda: stencil(weights=ring().weights + 0j), ("weights", "complex128", "floating-point")),
    ("NaN weights", lambda: stencil(weights=ring().weights.at[1, 8].set(jnp.nan)), ("weights of point 8", "not finite")),
    ("infinite weights", lambda: stencil(weights=ring().weights.at[0, 2].set(jnp.inf)), ("weights of point 2", "not finite")),
    ("weights of another shape", lambda: stencil(weights=ring().weights[:2]), ("weights", f"(2, {N})", f"(3, {N})")),
    ("components that do not fit", lambda: stencil(out_shape=(3,)), ("weights", f"(3, {N})", f"(3, 3, {N})")),
    ("no points", lambda: js.Stencil(jnp.zeros((3, 0), int), jnp.zeros((3, 0))), ("indices", "(3, 0)", "at least 1")),
    ("a border of indices", lambda: stencil(border=jnp.arange(N)), ("border", "int64", "mask")),
    ("a border of another length", lambda: stencil(border=jnp.zeros(4, bool)), ("border", "(4,)", f"({N},)")),
    ("a field of another length", lambda: ring()(jnp.ones(7)), ("field", "(7,)", str(N))),
    ("a scalar field of no points", lambda: ring()(3.0), ("field", "()", str(N))),
    ("a complex field", lambda: ring()(jnp.ones(N) + 1j), ("field", "complex128", "real")),
    ("a field in words", lambda: ring()("u"), ("field", "'u'", "real")),
    ("a field None", lambda: ring()(None), ("field", "None")),
    ("a ragged field", lambda: ring()([[1.0], [2.0, 3.0]]), ("field", "no array")),
    ("a field of objects", lambda: ring()(scipy.sparse.eye_array(N)), ("field", "(80, 80)", "real numbers")),
    ("a factor of another length", lambda: jnp.ones(5) * ring(), ("factor", "(5,)", f"({N},)")),
    ("a complex factor", lambda: 1j * ring(), ("factor", "complex", "real")),
    ("a term of another length", lambda: ring() + jnp.ones(5), ("term", "(5,)", f"({N},)")),
    ("a term in words", lambda: ring() + "1", ("term", "'1'", "real")),
    ("composed with a number", lambda: ring() @ 3, ("field", "()", f"({N}, ...)")),
    ("composed with another size", lambda: ring() @ js.Stencil(jnp.zeros((1, 4), int), jnp.ones((1, 4))), ("(4, ())", f"({N}, ())")),
    ("load: a truncated file", lambda: load(file_bytes()[:-100]), ("a.npz", "does not hold a stencil")),
    ("load: half a file", lambda: load(file_bytes()[: len(file_bytes()) // 2]), ("a.npz", "does not hold a stencil")),
    ("load: a byte flipped early", lambda: load(flipped(0.05)), ("a.npz", "does not hold a stencil")),
    ("load: a byte flipped in the weights", lambda: load(flipped(0.7)), ("a.npz", "does not hold a stencil")),
    ("load: an entry that is no array", lambda: load(npy_in_zip()), ("a.npz", "does not hold a stencil")),
    ("load: without weights", lambda: load(archive(weights=None)), ("a.npz", "weights")),
    ("load: an array too many", lambda: load(archive(extra=np.ones(3))), ("a.npz", "does not hold", "extra")),
    ("load: an index beyond the points", lambda: load(archive(indices=np.full((3, N), N))), ("a.npz", f"point {N}", f"there are {N}")),
    ("load: integer weights", lambda: load(archive(weights=np.ones((3, N), int))), ("a.npz", "weights", "int64")),
    ("load: shapes that do not fit", lambda: load(archive(out_shape=np.array([3]))), ("a.npz", "weights", f"(3, 3, {N})")),
]  # fmt: skip

FINE = [
    ("Stencil", "a field as a list", lambda: ring()([1.0] * N), lambda v: bool((v == 0).all())),
    ("Stencil", "a field of integers", lambda: ring()(jnp.arange(N) % 2), lambda v: v.dtype == jnp.float64 and float(v[0]) == 2),
    ("Stencil", "a field in single precision", lambda: ring()(jnp.ones(N, jnp.float32)), lambda v: v.dtype == jnp.float64),
    ("Stencil", "a field of booleans", lambda: ring()(jnp.ones(N, bool)), lambda v: bool((v == 0).all())),
    ("find_neighbors", "k as a NumPy integer", lambda: js.find_neighbors(cloud(), k=np.int64(5)), lambda v: v.k == 5),
    ("find_neighbors", "points as a list", lambda: js.find_neighbors([[0.0, 0], [1, 0], [0, 1]], k=2), lambda v: v.n == 3),
]  # fmt: skip

BUILDERS = {
    "laplace_beltrami": js.laplace_beltrami,
    "surface_gradient": js.surface_gradient,
    "surface_divergence": js.surface_divergence,
    "biharmonic": js.biharmonic,
    "diffusion": lambda c, neighbors=None, **args: js.diffusion(c, jnp.ones(N), neighbors=neighbors, **args),
    "directional_derivative": lambda c, neighbors=None, **args: js.directional_derivative(c, jnp.ones(3), neighbors=neighbors, **args),
    "shape_tensor": js.shape_tensor,
    "mean_curvature": js.mean_curvature,
    "gauss_curvature": js.gauss_curvature,
    "principal_curvatures": js.principal_curvatures,
    "mean_curvature_vector": js.mean_curvature_vector,
}  # fmt: skip


def of_each(name, make) -> list[Case]:
    """What every function of a cloud, neighbours and a method refuses in the same words."""
    calls = [
        ("a bare array", lambda: make(cloud().points, lists(), method=METHOD), ("cloud", f"({N}, 3)", "PointCloud")),
        ("None in place of a cloud", lambda: make(None, lists(), method=METHOD), ("cloud", "None", "PointCloud")),
        ("a string in place of a cloud", lambda: make("sphere", lists(), method=METHOD), ("cloud", "'sphere'", "PointCloud")),
        ("an array of indices as neighbours", lambda: make(cloud(), lists().indices, method=METHOD), ("neighbors", f"({N}, {K})", "Neighbors")),
        ("a number of neighbours", lambda: make(cloud(), 20, method=METHOD), ("neighbors", "20", "Neighbors")),
        ("neighbours of another cloud", lambda: make(cloud(), js.Neighbors(jnp.array([[0, 1], [1, 0]]), jnp.ones((2, 2), bool)), method=METHOD), ("2 points", str(N))),
        ("a method by name", lambda: make(cloud(), lists(), method="GFDM"), ("method", "'GFDM'", "Method")),
        ("a method's class", lambda: make(cloud(), lists(), method=js.GFDM), ("method", "Method")),
        ("too few neighbours", lambda: make(cloud(), lists(), method=js.GFDM(degree=6)), (f"k = {K}", "GFDM(degree=6)", "28")),
    ]  # fmt: skip
    return [Case(name, label, call, words) for label, call, words in calls]


def diffusion(d):
    return js.diffusion(cloud(), d, neighbors=lists(), method=METHOD)


def along(a):
    return js.directional_derivative(cloud(), a, neighbors=lists(), method=METHOD)


COEFFICIENTS = [
    ("laplace_beltrami", "degree 1", lambda: js.laplace_beltrami(cloud(), lists(), method=js.GFDM(1)), ("degree = 1", "at least 2")),
    ("diffusion", "negative at one point", lambda: diffusion(changed(np.ones(N), 5, -0.25)), ("diffusivity of point 5", "-0.25", "at least 0")),
    ("diffusion", "NaN at one point", lambda: diffusion(changed(np.ones(N), 5, np.nan)), ("diffusivity", "point 5", "nan")),
    ("diffusion", "a number", lambda: diffusion(2.0), ("diffusivity", "()", f"({N},)")),
    ("diffusion", "of another length", lambda: diffusion(jnp.ones(7)), ("diffusivity", "(7,)", f"({N},)")),
    ("diffusion", "a tensor of two dimensions", lambda: diffusion(jnp.ones((N, 2, 2))), ("diffusivity", f"({N}, 2, 2)", f"({N}, 3, 3)")),
    ("diffusion", "an asymmetric tensor", lambda: diffusion(tensors(EYE + 0.5 * np.eye(3, k=1))), ("diffusivity of point 0", "not symmetric", "0.5")),
    ("diffusion", "an indefinite tensor", lambda: diffusion(tensors(np.diag([1.0, 1, -2]))), ("diffusivity of point 0", "eigenvalue -2", "at least 0")),
    ("diffusion", "a tensor with infinity", lambda: diffusion(tensors(EYE).at[3].set(jnp.inf)), ("diffusivity", "point 3", "inf")),
    ("diffusion", "complex", lambda: diffusion(jnp.ones(N) + 1j), ("diffusivity", "complex128", "real")),
    ("diffusion", "in words", lambda: diffusion("1"), ("diffusivity", "'1'", "real")),
    ("diffusion", "a function", lambda: diffusion(lambda x: x), ("diffusivity", "function", "real")),
    ("directional_derivative", "NaN at one point", lambda: along(changed(np.ones((N, 3)), (4, 1), np.nan)), ("direction", "point 4", "nan")),
    ("directional_derivative", "of the wrong shape", lambda: along(jnp.ones((N, 2))), ("direction", f"({N}, 2)", f"({N}, 3)")),
    ("directional_derivative", "complex", lambda: along(1j * jnp.ones(3)), ("direction", "complex128", "real")),
    ("directional_derivative", "None", lambda: along(None), ("direction", "None", "real")),
    ("gauss_curvature", "a curve", lambda: js.gauss_curvature(js.circle(20)), ("3 dimensions", "2")),
    ("principal_curvatures", "a curve", lambda: js.principal_curvatures(js.circle(20)), ("3 dimensions", "2")),
    ("partial_derivative", "alpha a number", lambda: js.partial_derivative(jnp.ones((9, 2)), 1), ("alpha", "1", "2 whole numbers")),
    ("partial_derivative", "alpha of floats", lambda: js.partial_derivative(jnp.ones((9, 2)), (1.0, 0.5)), ("alpha", "1.0", "whole")),
    ("partial_derivative", "alpha negative", lambda: js.partial_derivative(jnp.ones((9, 2)), (1, -1)), ("alpha", "(1, -1)", "2 dimensions")),
    ("partial_derivative", "alpha zero", lambda: js.partial_derivative(jnp.ones((9, 2)), (0, 0)), ("alpha", "(0, 0)")),
    ("partial_derivative", "a cloud", lambda: js.partial_derivative(cloud(), (1, 0, 0)), ("points", "PointCloud", "real")),
    ("partial_derivative", "points on an axis", lambda: js.partial_derivative(jnp.ones(9), (1,)), ("points", "(9,)", "(n, 3)")),
    ("partial_derivative", "a method for surfaces", lambda: js.partial_derivative(jnp.ones((9, 2)), (1, 0), method=js.DCPSE()), ("method", "FlatDCPSE")),
    ("partial_derivative", "complex points", lambda: js.partial_derivative(1j * jnp.ones((9, 2)), (1, 0)), ("points", "complex128", "real")),
    ("partial_derivative", "one point", lambda: js.partial_derivative(jnp.ones((1, 2)), (1, 0)), ("1", "at least 2")),
    ("choose_neighbors", "a bare array", lambda: js.choose_neighbors(cloud().points), ("cloud", f"({N}, 3)", "PointCloud")),
    ("choose_neighbors", "a method by name", lambda: js.choose_neighbors(cloud(), method="GFDM"), ("method", "'GFDM'")),
    ("choose_neighbors", "None", lambda: js.choose_neighbors(None), ("cloud", "None")),
    ("choose_neighbors", "bound as indices", lambda: js.choose_neighbors(cloud(), bound=[1, 2]), ("bound", "int64", "mask")),
    ("choose_neighbors", "bound of another length", lambda: js.choose_neighbors(cloud(), bound=np.ones(3, bool)), ("bound", "(3,)", f"({N},)")),
    ("choose_neighbors", "one point", lambda: js.choose_neighbors(js.PointCloud(EYE[:1], EYE[:1])), ("1", "at least 2")),
    ("tube_ratio", "a bare array", lambda: js.tube_ratio(cloud().points, lists()), ("cloud", f"({N}, 3)", "PointCloud")),
    ("tube_ratio", "a number of neighbours", lambda: js.tube_ratio(cloud(), 8), ("neighbors", "8", "Neighbors")),
    ("tube_ratio", "None", lambda: js.tube_ratio(cloud(), None), ("neighbors", "None", "Neighbors")),
    ("tube_ratio", "an array of indices", lambda: js.tube_ratio(cloud(), lists().indices), ("neighbors", f"({N}, {K})")),
    ("tube_ratio", "neighbours of another cloud", lambda: js.tube_ratio(js.circle(20), lists()), (str(N), "20")),
    ("tube_ratio", "arguments exchanged", lambda: js.tube_ratio(lists(), cloud()), ("cloud", "PointCloud")),
    ("DCPSE", "order 2.5", lambda: js.DCPSE(order=2.5), ("order is 2.5", "whole")),
    ("DCPSE", "order None", lambda: js.DCPSE(order=None), ("order is None", "whole")),
    ("DCPSE", "order 0", lambda: js.DCPSE(order=0), ("order = 0", "at least 1")),
    ("DCPSE", "layers 1.5", lambda: js.DCPSE(layers=1.5), ("layers is 1.5", "whole")),
    ("DCPSE", "support NaN", lambda: js.DCPSE(support=np.nan), ("support = nan", "above 0")),
    ("DCPSE", "width infinite", lambda: js.DCPSE(width=np.inf), ("width = inf", "above 0")),
    ("DCPSE", "layer spacing in words", lambda: js.DCPSE(layer_spacing="1"), ("layer_spacing", "'1'", "real")),
    ("GFDM", "degree 2.5", lambda: js.GFDM(degree=2.5), ("degree is 2.5", "whole")),
    ("GFDM", "degree in words", lambda: js.GFDM("2"), ("degree is '2'", "whole")),
    ("GFDM", "degree -1", lambda: js.GFDM(-1), ("degree = -1", "at least 1")),
    ("GFDM", "width 0", lambda: js.GFDM(width=0.0), ("width = 0", "above 0")),
    ("GFDM", "width complex", lambda: js.GFDM(width=1j), ("width", "complex", "real")),
    ("GFDM", "support a list", lambda: js.GFDM(support=[1.0]), ("support", "real number")),
    ("RBFFD", "degree 2.5", lambda: js.RBFFD(degree=2.5), ("degree is 2.5", "whole")),
    ("RBFFD", "degree None", lambda: js.RBFFD(degree=None), ("degree is None", "whole")),
    ("RBFFD", "degree 0", lambda: js.RBFFD(0), ("degree = 0", "at least 1")),
    ("RBFFD", "exponent even", lambda: js.RBFFD(exponent=4), ("exponent = 4", "odd")),
    ("RBFFD", "exponent 1", lambda: js.RBFFD(exponent=1), ("exponent = 1", "at least 3")),
    ("RBFFD", "exponent 3.5", lambda: js.RBFFD(exponent=3.5), ("exponent is 3.5", "whole")),
    ("RBFFD", "exponent 0", lambda: js.RBFFD(exponent=0), ("exponent = 0", "at least 3")),
    ("RBFFD", "a power without its polynomials", lambda: js.RBFFD(2, exponent=7), ("exponent = 7", "at most 5")),
    ("RBFFD", "a Laplacian of degree 1", lambda: js.laplace_beltrami(cloud(), lists(), method=js.RBFFD(1)), ("degree = 1", "at least 2")),
    ("FlatDCPSE", "order 1.5", lambda: js.FlatDCPSE(order=1.5), ("order is 1.5", "whole")),
    ("FlatDCPSE", "order True", lambda: js.FlatDCPSE(order=True), ("order is True", "whole")),
    ("FlatDCPSE", "support negative", lambda: js.FlatDCPSE(support=-1.0), ("support = -1", "above 0")),
    ("FlatDCPSE", "width NaN", lambda: js.FlatDCPSE(width=np.nan), ("width = nan", "above 0")),
    ("FlatDCPSE", "order -2", lambda: js.FlatDCPSE(order=-2), ("order = -2", "at least 1")),
    ("FlatDCPSE", "order in words", lambda: js.FlatDCPSE(order="2"), ("order is '2'", "whole")),
]  # fmt: skip

X = np.stack([np.arange(10.0), np.zeros(10)], axis=1)
ROOM = js.SearchCapacity(5, 8)


def search(points=X, **change):
    return js.search_neighbors(points, **({"radius": 2.5, "capacity": ROOM} | change))


SEARCH = [
    ("allocate_search", "a negative radius", lambda: js.allocate_search(X, -1.0), ("radius = -1", "above 0")),
    ("allocate_search", "a radius NaN", lambda: js.allocate_search(X, np.nan), ("radius = nan", "above 0")),
    ("allocate_search", "a radius in words", lambda: js.allocate_search(X, "1"), ("radius", "'1'", "real")),
    ("allocate_search", "one axis", lambda: js.allocate_search(X[:, 0], 1.0), ("points", "(10,)", "(n, 3)")),
    ("allocate_search", "a NaN point", lambda: js.allocate_search(changed(X, (4, 0), np.nan), 1.0), ("points", "point 4", "nan")),
    ("allocate_search", "a margin below 1", lambda: js.allocate_search(X, 1.0, margin=0.5), ("margin = 0.5", "at least 1")),
    ("allocate_search", "no points", lambda: js.allocate_search(np.ones((0, 3)), 1.0), ("points", "(0, 3)", "at least 1")),
    ("allocate_search", "active as indices", lambda: js.allocate_search(X, 1.0, active=[0, 1]), ("active", "int64", "mask")),
    ("search_neighbors", "a cloud", lambda: search(cloud()), ("points", "PointCloud", "real")),
    ("SearchCapacity", "no slots", lambda: search(capacity=js.SearchCapacity(0, 8)), ("capacity.k = 0", "at least 1")),
    ("SearchCapacity", "slots that are no whole number", lambda: search(capacity=js.SearchCapacity(2.5, 8)), ("capacity.k is 2.5", "whole")),
    ("SearchCapacity", "negative candidates", lambda: search(capacity=js.SearchCapacity(5, -1)), ("capacity.candidates = -1", "at least 1")),
    ("SearchCapacity", "candidates None", lambda: search(capacity=js.SearchCapacity(5, None)), ("capacity.candidates is None", "whole")),
    ("search_neighbors", "a capacity that is a number", lambda: search(capacity=8), ("capacity", "8", "SearchCapacity")),
    ("search_neighbors", "k = 2.5", lambda: search(k=2.5), ("k is 2.5", "whole")),
    ("search_neighbors", "k = 1", lambda: search(k=1), ("k = 1", "2 to 8")),
    ("search_neighbors", "a radius of zero", lambda: search(radius=0.0), ("radius = 0", "above 0")),
    ("search_neighbors", "radii of each point", lambda: search(radius=np.ones(10)), ("radius", "(10,)", "real number")),
    ("search_neighbors", "normals of another shape", lambda: search(normals=X[1:]), ("normals", "(9, 2)", "(10, 2)")),
    ("search_neighbors", "complex points", lambda: search(X + 1j), ("points", "complex128", "real")),
    ("search_neighbors", "min_cosine 2", lambda: search(min_cosine=2.0), ("min_cosine = 2", "at most 1")),
]  # fmt: skip

CASES = [
    *[Case("Neighbors", *case) for case in NEIGHBORS],
    *[Case("find_neighbors", *case) for case in FIND],
    *[Case("Stencil", *case) for case in STENCIL],
    Case("Stencil", "saved under a number", lambda: ring().save(3), ("path is 3", "str")),
    Case("Stencil", "loaded from nothing", lambda: js.Stencil.load(None), ("path is None", "str")),
    Case(
        "Stencil",
        "its own points twice, in NumPy",
        lambda: (twice(np.array([[-2.0] * N, [1.0] * N, [1.0] * N, [0.5] * N])) + 1)(np.ones(N)),
        right=lambda found: np.allclose(found, 1.5),
    ),
    *[Case(name, label, call, right=right) for name, label, call, right in FINE],
    *[case for name, make in BUILDERS.items() for case in of_each(name, make)],
    *[Case(*case) for case in COEFFICIENTS + SEARCH],
]
