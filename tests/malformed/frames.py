"""Frames and normals."""

import functools

import jax
import jax.numpy as jnp
import numpy as np

import jaxsurf as js

from . import Case

NAN = float("nan")
POINTS = np.random.default_rng(0).normal(size=(60, 3))


@functools.cache
def sphere() -> js.PointCloud:
    return js.sphere(60)


@functools.cache
def neighbors() -> js.Neighbors:
    return js.find_neighbors(sphere(), 20)


def unit():
    return np.asarray(sphere().points)


def spoiled(i, value):
    x = unit().copy()
    x[i] = value
    return x


POINT_SETS = (
    ("four numbers each", ("points", "(60, 4)", "(n, 3)"), lambda: np.ones((60, 4))),
    ("one number each", ("points", "(60,)"), lambda: np.ones(60)),
    ("complex", ("points", "complex"), lambda: unit() + 1j),
    ("text", ("points", "real numbers"), lambda: "points"),
    ("None", ("points", "None"), lambda: None),
    ("ragged", ("points", "array of numbers"), lambda: [[1.0], [1.0, 2.0]]),
    ("a point that is not finite", ("point 7", "not finite"), lambda: spoiled(7, NAN)),
    ("two that coincide", ("points 7 and 9", "coincide"), lambda: spoiled(9, unit()[7])),
    ("size 1e200", ("points", "at most"), lambda: 1e200 * unit()),
    ("no points", ("0", "at least"), lambda: unit()[:0]),
    ("one point", ("1", "at least"), lambda: unit()[:1]),
    ("too few for the degree", ("too few points: 20", "45"), lambda: unit()[:20]),
    ("a cloud", ("points", "PointCloud"), sphere),
)
OPTIONS = (
    ("degree 2.5", ("degree is 2.5", "whole"), {"degree": 2.5}),
    ("degree 0", ("degree = 0", "at least 1"), {"degree": 0}),
    ("k = 20.5", ("k is 20.5", "whole"), {"k": 20.5}),
    ("k too small", ("k = 9", "at least 15"), {"k": 9}),
    ("k above n", ("60", "70"), {"k": 70}),
)
ESTIMATES = [
    Case(name, label, lambda name=name, make=make: getattr(js, name)(make()), words)
    for name in ("estimate_normals", "from_points")
    for label, words, make in POINT_SETS
] + [
    Case(name, label, lambda name=name, o=o: getattr(js, name)(unit(), **o), words)
    for name in ("estimate_normals", "from_points")
    for label, words, o in OPTIONS
] + [
    Case(
        "estimate_normals",
        "no iterations",
        lambda: js.estimate_normals(unit(), iterations=0),
        ("iterations = 0", "at least 1"),
    ),
    Case(
        "estimate_normals",
        "orient as text",
        lambda: js.estimate_normals(unit(), orient="no"),
        ("orient", "'no'", "bool"),
    ),
    Case(
        "estimate_normals",
        "traced points",
        lambda: jax.jit(js.estimate_normals)(unit()),
        ("points", "concrete", "refit_normals"),
    ),
    Case(
        "from_points",
        "a border of other length",
        lambda: js.from_points(unit(), boundary=np.zeros(59, bool)),
        ("boundary", "(59,)", "(60,)"),
    ),
    Case(
        "from_points",
        "a border by indices",
        lambda: js.from_points(unit(), boundary=[1, 2]),
        ("boundary", "mask"),
    ),
]  # fmt: skip


def refit(label, words, *, degree=2, points=unit, normals=unit, lists=neighbors, **options):
    def call():
        return js.refit_normals(points(), normals(), lists(), degree=degree, **options)

    return Case("refit_normals", label, call, words)


REFITS = [
    refit("points of four numbers", ("points", "(60, 4)"), points=lambda: np.ones((60, 4))),
    refit("complex points", ("points", "complex"), points=lambda: unit() + 1j),
    refit("too few normals", ("normals", "(59, 3)", "(60, 3)"), normals=lambda: unit()[1:]),
    refit("complex normals", ("normals", "complex"), normals=lambda: unit() + 1j),
    refit("normals as text", ("normals", "real numbers"), normals=lambda: "up"),
    refit("neighbours as an array", ("neighbors", "(60, 20)", "Neighbors"),
          lists=lambda: np.asarray(neighbors().indices)),
    refit("neighbours None", ("neighbors", "None", "Neighbors"), lists=lambda: None),
    refit("neighbours of others", ("neighbors", "60", "50"),
          points=lambda: unit()[:50], normals=lambda: unit()[:50]),
    refit("degree 2.5", ("degree is 2.5",), degree=2.5),
    refit("degree 0", ("degree = 0",), degree=0),
    refit("degree 6", ("k = 20", "at least 28"), degree=6),
    refit("no iterations", ("iterations = 0",), iterations=0),
    refit("half a block", ("batch_size is 2.5",), batch_size=2.5),
    refit("normals turned over", ("point", "over", "cosine"),
          normals=lambda: np.roll(unit(), 20, axis=0)),
]  # fmt: skip


def frames(label, words, normals):
    return Case("tangent_frames", label, lambda: js.tangent_frames(normals), words)


FRAMES = [
    frames("a scalar", ("normals", "()"), 1.0),
    frames("four numbers each", ("normals", "(5, 4)"), np.ones((5, 4))),
    frames("complex", ("normals", "complex"), np.eye(3) + 0j),
    frames("text", ("normals", "real numbers"), "up"),
    frames("None", ("normals", "None"), None),
    frames("length 2", ("normal 1", "length 2"), np.diag([1.0, 2.0, 1.0])),
    frames("length 0", ("normal 0", "length 0"), np.zeros((4, 3))),
    frames("not finite", ("normal 0", "nan"), np.full((4, 2), NAN)),
    Case(
        "tangent_frames",
        "single precision",
        lambda: js.tangent_frames(np.eye(3, dtype=np.float32)),
        right=lambda f: f.dtype == jnp.float32 and f.shape == (3, 3, 3),
    ),
]

CASES = [*ESTIMATES, *REFITS, *FRAMES]
