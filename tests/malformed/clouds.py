"""Point clouds."""

# One case a line reads as a table.
# ruff: noqa: E501

import functools

import jax.numpy as jnp
import numpy as np

import jaxsurf as js

from . import Case

N = 50


@functools.cache
def sphere() -> js.PointCloud:
    return js.sphere(N)


def changed(values, place, new, dtype=None):
    values = np.array(values, dtype)
    values[place] = new
    return values


def cloud(points=None, normals=None, **more):
    x = sphere().normals
    return js.PointCloud(x if points is None else points, x if normals is None else normals, **more)


def single():
    """Normals in single precision, one of them 3 % too long."""
    normals = np.asarray(sphere().normals, np.float32)
    return cloud(normals, changed(normals, 7, 1.03 * normals[7]))


POINTS = [
    ("points in four dimensions", lambda: js.PointCloud(np.ones((5, 4)), np.ones((5, 4))), ("points", "(5, 4)", "(n, 3)")),
    ("points on one axis", lambda: cloud(np.ones(5)), ("points", "(5,)", "(n, 3)")),
    ("a number", lambda: cloud(3.0), ("points", "()", "(n, 3)")),
    ("None", lambda: js.PointCloud(None, None), ("points", "None", "real numbers")),
    ("text", lambda: cloud("sphere"), ("points", "'sphere'", "real numbers")),
    ("ragged lists", lambda: cloud([[0.0, 1.0], [1.0]]), ("points", "no array of numbers")),
    ("a dictionary", lambda: cloud({"x": 1}), ("points", "dict", "real numbers")),
    ("complex points", lambda: cloud(sphere().points + 1j), ("points", "complex128", "real numbers")),
    ("complex normals", lambda: cloud(normals=sphere().normals * (1 + 0j)), ("normals", "complex128", "real numbers")),
    ("no points", lambda: js.PointCloud(np.ones((0, 3)), np.ones((0, 3))), ("0 points", "at least 1")),
    ("a point NaN", lambda: cloud(changed(sphere().points, (3, 1), np.nan)), ("point 3", "nan", "not finite")),
    ("a point at infinity", lambda: cloud(changed(sphere().points, (4, 0), -np.inf)), ("point 4", "inf", "not finite")),
    ("points of size 1e200", lambda: cloud(1e200 * sphere().points), ("point 0", "e+199", "1e+153", "units")),
    ("one point of size 1e200", lambda: cloud(changed(sphere().points, (6, 2), 1e200)), ("point 6", "1e+200", "1e+153")),
    ("points of size 1e-200", lambda: cloud(1e-200 * sphere().points), ("points lie within", "e-200", "e-150", "units")),
    ("single precision of size 1e12", lambda: cloud(1e20 * sphere().points.astype(jnp.float32)), ("point 0", "float32", "2e+18")),
    ("normals of another shape", lambda: cloud(normals=sphere().normals[1:]), ("normals", f"({N - 1}, 3)", f"({N}, 3)")),
    ("normals of zero length", lambda: cloud(normals=changed(sphere().normals, 5, 0)), ("normal 5", "length 0", "expected 1")),
    ("normals of length two", lambda: cloud(normals=2 * sphere().normals), ("normal 0", "length 2", "expected 1", "49 more")),
    ("a normal NaN", lambda: cloud(normals=changed(sphere().normals, (5, 0), np.nan)), ("normal 5", "nan", "expected 1")),
    ("single precision, 3 % off unit length", single, ("normal 7", "length 1.0", "expected 1")),
    ("a normal 1e-5 off unit length", lambda: cloud(normals=changed(sphere().normals, 2, (1 + 1e-5) * np.asarray(sphere().normals[2]))), ("normal 2", "1.00001", "expected 1")),
    ("normals in words", lambda: cloud(normals="outward"), ("normals", "'outward'", "real numbers")),
    ("border as indices", lambda: cloud(boundary=[0, 1]), ("boundary", "int64", "mask")),
    ("border as indices, as many as points", lambda: cloud(boundary=np.arange(N)), ("boundary", "int64", "one bool for each")),
    ("border as floating-point numbers", lambda: cloud(boundary=np.ones(N)), ("boundary", "float64", "mask")),
    ("border of another length", lambda: cloud(boundary=np.ones(5, bool)), ("boundary", "(5,)", f"({N},)")),
    ("active as indices", lambda: cloud(active=[0, 1, 2]), ("active", "int64", "mask")),
    ("active of another length", lambda: cloud(active=np.ones(4, bool)), ("active", "(4,)", f"({N},)")),
    ("spacing negative", lambda: cloud(spacing=changed(np.ones(N), 3, -1.0)), ("spacing of point 3", "-1", "positive")),
    ("spacing NaN", lambda: cloud(spacing=changed(np.ones(N), 3, np.nan)), ("spacing of point 3", "nan", "positive")),
    ("spacing a number", lambda: cloud(spacing=0.1), ("spacing", "()", f"({N},)")),
    ("spacing complex", lambda: cloud(spacing=1j * np.ones(N)), ("spacing", "complex128", "real numbers")),
]  # fmt: skip

FINE = [
    ("lists of integers", lambda: js.PointCloud([[1, 0], [0, 1]], [[1, 0], [0, 1]]), lambda c: c.points.dtype == jnp.float64),
    ("one point", lambda: js.PointCloud([[1.0, 0]], [[1.0, 0]]), lambda c: c.n == 1 and "1 points" in repr(c)),
    ("normals in double precision of points in single", lambda: cloud(sphere().points.astype(jnp.float32)), lambda c: c.normals.dtype == jnp.float32),
    ("normals that single precision made", lambda: cloud(sphere().points.astype(jnp.float32), sphere().normals.astype(jnp.float32)), lambda c: c.n == N),
    ("a NaN in a row that is off", lambda: cloud(changed(sphere().points, 3, np.nan), active=changed(np.ones(N, bool), 3, False)), lambda c: "1 switched off" in repr(c)),
]  # fmt: skip

CASES = [
    *[Case("PointCloud", *case) for case in POINTS],
    *[Case("PointCloud", label, call, right=right) for label, call, right in FINE],
]
