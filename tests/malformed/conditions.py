"""Borders, boundary conditions, closures and ghosts."""

import functools

import jax.numpy as jnp
import numpy as np
import scipy.sparse

import jaxsurf as js

from . import Case

SIDE, N = 9, 81
NAN, INF = float("nan"), float("inf")


@functools.cache
def square(dtype=np.float64) -> js.PointCloud:
    """A grid on [0, 1]²."""
    x, y = np.meshgrid(np.linspace(0, 1, SIDE), np.linspace(0, 1, SIDE), indexing="ij")
    points = np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], axis=1).astype(dtype)
    edge = np.any((points[:, :2] == 0) | (points[:, :2] == 1), axis=1)
    return js.PointCloud(points, np.tile([0, 0, 1], (N, 1)).astype(dtype), boundary=edge)


@functools.cache
def border_points() -> np.ndarray:
    return np.flatnonzero(np.asarray(square().boundary))


@functools.cache
def marked(*names: int) -> js.PointCloud:
    """The same points, others marked."""
    cloud = square()
    return js.PointCloud(
        cloud.points, cloud.normals, boundary=np.isin(np.arange(N), np.array(names))
    )


@functools.cache
def closed() -> js.PointCloud:
    return js.PointCloud(square().points, square().normals)


@functools.cache
def small() -> js.PointCloud:
    """Two points, both on the border."""
    points = np.array([[0.0, 0, 0], [1, 0, 0]])
    return js.PointCloud(points, np.tile([0.0, 0, 1], (2, 1)), boundary=np.ones(2, bool))


@functools.cache
def border() -> js.Border:
    return js.find_border(square())


@functools.cache
def closure() -> js.Closure:
    return js.eliminate(square(), js.dirichlet(border_points(), 1.0))


@functools.cache
def neighbors(k=20) -> js.Neighbors:
    return js.find_neighbors(square(), k=k)


@functools.cache
def mesh() -> js.TriangleMesh:
    return js.TriangleMesh(np.eye(3), np.array([[0, 1, 2]]))


def conormals(**changes) -> np.ndarray:
    """Those of the left side but its corners (x = 0), some of them changed."""
    out = np.tile([-1.0, 0.0, 0.0], (SIDE - 2, 1))
    for i, v in changes.items():
        out[int(i[1:])] = v
    return out


LEFT = np.arange(1, SIDE - 1)  # points of the left side, without its corners
INNER = SIDE + 1

_not_a_condition = {
    "None": (None, "None"),
    "a number": (0.0, "0.0"),
    "text": ("dirichlet", "dirichlet"),
    "a mask": (np.zeros(N, bool), "bool"),
    "an empty list": ([], "at least 1"),
    "a list of numbers": ([0.0, 1.0], "conditions[0]"),
    "a condition and None": ([js.dirichlet([3]), None], "conditions[1]"),
}

# fmt: off
CASES = [
    *(
        Case(name, f"where is {label}", functools.partial(make, where), ("where", *words))
        for name, make in {
            "dirichlet": js.dirichlet,
            "neumann": js.neumann,
            "robin": lambda where: js.robin(where, a=1.0, b=1.0),
            "free": js.free,
        }.items()
        for label, where, *words in [
            ("a number", 5, "indices"),
            ("None", None, "None"),
            ("text", "left", "left"),
            ("floats", [1.0, 2.0], "float64"),
            ("two-dimensional", np.zeros((3, 2), int), "(3, 2)"),
            ("a point twice", [3, 4, 3], "point 3", "2 times"),
            ("a negative index", [4, -1], "-1"),
        ]
    ),
    *(
        Case(name, "no point", functools.partial(make, np.zeros(N, bool)), ("where", "at least 1"))
        for name, make in {"dirichlet": js.dirichlet, "neumann": js.neumann}.items()
    ),
    Case("free", "no point", lambda: js.free(np.zeros(N, bool)), right=lambda c: c.m == 0),
    *(
        Case("dirichlet", f"value {label}", functools.partial(js.dirichlet, [3, 7], v), words)
        for label, v, words in [
            ("of another length", np.zeros(3), ("value", "(3,)", "(2,)")),
            ("of another first axis", np.zeros((3, 2)), ("value", "(3, 2)", "(2, c, ...)")),
            ("is None", None, ("value", "None", "real numbers")),
            ("is text", "hot", ("value", "hot")),
            ("is complex", 1 + 2j, ("value", "complex", "real")),
            ("is NaN", NAN, ("value", "not finite", "nan")),
            ("NaN at a point", np.array([0.0, NAN]), ("value", "point 7", "nan")),
            ("infinite in a component", np.array([[0.0, 1], [INF, 1]]), ("value", "point 7")),
            ("ragged", [[1.0], [1.0, 2.0]], ("value", "no array")),
            ("is a function in NumPy", lambda t: np.sin(t), ("value", "jax.numpy")),
            ("branches on the time", lambda t: 1.0 if t > 1 else 0.0, ("value", "be traced")),
            ("is a function of nothing", lambda: 1.0, ("value", "function of time")),
            ("gives another length", lambda t: t * jnp.ones(5), ("value(t)", "(5,)", "(2,)")),
            ("gives complex numbers", lambda t: 1j * t, ("value(t)", "complex", "real")),
            ("gives None", lambda t: None, ("value",)),
        ]
    ),
    Case(
        "dirichlet", "integers", lambda: js.dirichlet([3, 7], [1, 2]),
        right=lambda c: jnp.issubdtype(c.value.dtype, jnp.floating),
    ),
    *(
        Case("robin", label, functools.partial(js.robin, [3, 7], **given), words)
        for label, given, words in [
            ("a of another length", dict(a=np.ones(3), b=1.0), ("a has shape", "(3,)", "(2,)")),
            ("b of another length", dict(a=1.0, b=np.ones((2, 1))), ("b has shape", "(2, 1)")),
            ("a is NaN", dict(a=NAN, b=1.0), ("a is not finite", "nan")),
            ("b infinite at a point", dict(a=1.0, b=np.array([1, INF])), ("b is", "point 7")),
            ("a is text", dict(a="1", b=1.0), ("a is", "'1'")),
            ("b is complex", dict(a=1.0, b=1j), ("b is", "complex")),
            ("b is a function", dict(a=1.0, b=lambda t: t), ("b is", "real numbers")),
        ]
    ),
    *(
        Case("neumann", f"conormals {label}", lambda v=v: js.neumann(LEFT, conormals=v), words)
        for label, v, words in [
            ("are one vector", np.array([-1.0, 0, 0]), ("conormals", "(3,)", "(7, 3)")),
            ("of another number", np.tile([1.0, 0, 0], (5, 1)), ("conormals", "(5, 3)", "(7, 3)")),
            ("in four dimensions", np.ones((7, 4)), ("conormals", "(7, 4)")),
            ("of length two", conormals(i2=[-2, 0, 0]), ("conormal at point 3", "2", "1")),
            ("zero", conormals(i6=[0, 0, 0]), ("conormal at point 7", "0", "1")),
            ("NaN", conormals(i0=[NAN, 0, 0]), ("conormals", "point 1", "nan")),
            ("are text", "outward", ("conormals", "outward")),
            ("huge", conormals(i1=[-1e200, 0, 0]), ("conormal at point 2", "inf")),
        ]
    ),
    *(
        Case("Condition", label, lambda given=given: js.Condition(*given[0], **given[1]), words)
        for label, given, words in [
            ("where is None", ((None, 0.0), dict(a=1.0, b=None)), ("where", "None")),
            ("value is None", (([1], None), dict(a=1.0, b=None)), ("value", "None")),
            ("a is a list of text", (([1], 0.0), dict(a=["x"], b=None)), ("a is", "text")),
            ("b has two axes", (([1], 0.0), dict(a=1.0, b=[[1.0]])), ("b has shape", "(1, 1)")),
            ("no point", (([], 0.0), dict(a=1.0, b=None)), ("where", "at least 1")),
            ("conormals are flat", (([1], 0.0), dict(a=0.0, b=1.0, conormals=[1.0, 0, 0])),
             ("conormals", "(3,)", "(1, 3)")),
        ]
    ),
    # --- without_flux
    *(
        Case("without_flux", label, lambda v=v: js.without_flux(v), ("surface", word, "discretize"))
        for label, v, word in [
            ("surface is None", None, "None"),
            ("surface is an array", np.ones((5, 3)), "(5, 3)"),
            ("surface is a cloud", square(), "PointCloud"),
        ]
    ),
    # --- eliminate
    *(
        Case("eliminate", f"conditions: {label}", lambda v=v: js.eliminate(square(), v),
             ("conditions", w))
        for label, (v, w) in _not_a_condition.items()
    ),
    *(
        Case("eliminate", label, call, words)
        for label, call, words in [
            ("cloud is None", lambda: js.eliminate(None, js.dirichlet([3])), ("cloud", "None")),
            ("cloud is an array", lambda: js.eliminate(np.ones((5, 3)), js.dirichlet([3])),
             ("cloud", "(5, 3)", "PointCloud")),
            ("a mask of 5 points", lambda: js.eliminate(square(), js.dirichlet(np.ones(5, bool))),
             ("condition 0", "5 points", "81")),
            ("a mask that is too long",
             lambda: js.eliminate(square(), js.neumann(np.ones(99, bool))),
             ("condition 0", "99", "81")),
            ("a point out of range", lambda: js.eliminate(square(), js.dirichlet([3, 81])),
             ("point 81", "there are 81")),
            ("all points bound", lambda: js.eliminate(square(), js.dirichlet(np.ones(N, bool))),
             ("all 81 points",)),
            ("two conditions at a point",
             lambda: js.eliminate(square(), [js.dirichlet([3, 4]), js.dirichlet([4], 1.0)]),
             ("point 4", "condition 0", "condition 1")),
            ("free and not free", lambda: js.eliminate(square(), [js.dirichlet([3]), js.free([3])]),
             ("point 3", "agree")),
            ("no conormal", lambda: js.eliminate(square(), js.neumann([INNER])),
             ("conormal", f"point {INNER}", "boundary")),
            ("no border", lambda: js.eliminate(closed(), js.neumann([3])), ("conormal", "point 3")),
            ("conormals that are normals",
             lambda: js.eliminate(
                 square(), js.neumann(LEFT, conormals=np.tile([0, 0, 1.0], (7, 1)))),
             ("conormal at point 1", "tangent", "0.05")),
            ("conormals inward",
             lambda: js.eliminate(square(), js.neumann(LEFT, conormals=conormals(i3=[1, 0, 0]))),
             ("conormal at point 4", "into", "outward")),
            ("conormals in the plane",
             lambda: js.eliminate(square(), js.neumann(LEFT, conormals=conormals()[:, :2])),
             ("conormals", "(7, 2)", "3")),
            ("neighbors is a number",
             lambda: js.eliminate(square(), js.neumann(border_points()), neighbors=20),
             ("neighbors", "20", "find_neighbors")),
            ("neighbors of another cloud",
             lambda: js.eliminate(small(), js.dirichlet([0]), neighbors=neighbors()), ("81", "2")),
            ("few neighbors",
             lambda: js.eliminate(square(), js.neumann(border_points()), neighbors=neighbors(6)),
             ("free neighbours", "at least 14")),
            ("method is text", lambda: js.eliminate(square(), js.dirichlet([3]), method="gfdm"),
             ("method", "gfdm")),
            ("method is a class", lambda: js.eliminate(square(), js.dirichlet([3]), method=js.GFDM),
             ("method", "GFDM")),
            ("border is a mask",
             lambda: js.eliminate(square(), js.neumann(LEFT), border=square().boundary),
             ("border", "(81,)", "find_border")),
            ("border of a larger cloud",
             lambda: js.eliminate(small(), js.dirichlet([0]), border=border()),
             ("border", "point 9", "2")),
            ("a and b zero", lambda: js.eliminate(square(), js.robin(LEFT, a=0.0, b=0.0)),
             ("does not determine", "point 1")),
        ]
    ),
    Case(
        "eliminate", "a cloud in float32 and values in float64",
        lambda: js.eliminate(square(np.float32), js.dirichlet(LEFT, np.ones(7))),
        right=lambda c: c(jnp.zeros(N, jnp.float32)).dtype == jnp.float32
        and c.offset().dtype == jnp.float32,
    ),
    Case(
        "eliminate", "huge points", lambda: js.eliminate(
            js.PointCloud(1e150 * square().points, square().normals, boundary=square().boundary),
            js.neumann(LEFT), neighbors=neighbors(), method=js.GFDM(degree=2),
        )(jnp.ones(N)),
        right=lambda u: bool(jnp.allclose(u, 1)),
    ),
    # --- what a closure takes
    *(
        Case("Closure", label, call, words)
        for label, call, words in [
            ("a field of another length", lambda: closure()(np.zeros(5)), ("field", "(5,)", "81")),
            ("a field that is a number", lambda: closure()(1.0), ("field", "()", "81")),
            ("a field that is None", lambda: closure()(None), ("field", "None")),
            ("a field that is text", lambda: closure().homogeneous("u"), ("field", "u")),
            ("a complex field", lambda: closure().restrict(1j * np.ones(N)), ("field", "complex")),
            ("a matrix as a field", lambda: closure()(scipy.sparse.eye(N).tocsr()), ("field",)),
            ("time is text", lambda: closure()(np.zeros(N), "0"), ("t is", "'0'")),
            ("time is NaN", lambda: closure()(np.zeros(N), NAN), ("t = nan", "finite")),
            ("several times", lambda: closure().offset(np.zeros(3)), ("t is", "(3,)")),
            ("extend: too many points", lambda: closure().extend(np.zeros(99)), ("(99,)", "81")),
            ("extend: a number", lambda: closure().extend(1.0), ("field", "()")),
            ("components for a field without",
             lambda: js.eliminate(square(), js.dirichlet([3], np.ones((1, 2))))(np.zeros(N)),
             ("components (2,)", "none")),
            ("other components",
             lambda: js.eliminate(square(), js.dirichlet([3], np.ones((1, 2))))(np.zeros((N, 3))),
             ("components (2,)", "(3,)")),
            ("weights of another shape",
             lambda: js.Closure(9, np.array([1]), np.zeros((2, 1), int), np.zeros((3, 1))),
             ("weights", "(3, 1)", "(2, 1)")),
            ("rows out of range",
             lambda: js.Closure(9, np.array([9]), np.zeros((1, 1), int), np.zeros((1, 1))),
             ("rows", "point 9", "there are 9")),
            ("a row twice",
             lambda: js.Closure(9, np.array([4, 4]), np.zeros((1, 2), int), np.zeros((1, 2))),
             ("rows", "point 4", "2 times", "once")),
            ("n is no number",
             lambda: js.Closure(2.5, np.array([1]), np.zeros((1, 1), int), np.zeros((1, 1))),
             ("n is 2.5", "whole number")),
        ]
    ),
    Case(
        "Closure", "a field of integers", lambda: closure()(np.zeros(N, int)),
        right=lambda u: float(u[3]) == 1.0,
    ),
    # --- borders
    *(
        Case(name, f"cloud: {label}", functools.partial(f, v), ("cloud", w))
        for name, f in {
            "find_border": js.find_border,
            "detect_boundary": js.detect_boundary,
            "border_conormals": js.border_conormals,
            "with_ghosts": lambda v: js.with_ghosts(v, js.neumann([3])),
        }.items()
        for label, v, w in [
            ("None", None, "None"),
            ("points alone", np.ones((5, 3)), "(5, 3)"),
            ("text", "bunny.obj", "bunny.obj"),
        ]
    ),
    *(
        Case(name, label, call, words)
        for name, label, call, words in [
            ("find_border", "nothing marked", lambda: js.find_border(closed()), ("boundary",)),
            ("find_border", "all False", lambda: js.find_border(marked(-1)), ("boundary",)),
            ("find_border", "one point marked", lambda: js.find_border(marked(40)),
             ("point 40", "at least 2")),
            ("find_border", "a mask as mesh", lambda: js.find_border(square(), square().boundary),
             ("mesh", "(81,)")),
            ("find_border", "text as mesh", lambda: js.find_border(square(), "a.obj"),
             ("mesh", "a.obj")),
            ("find_border", "another mesh", lambda: js.find_border(square(), mesh()), ("3", "81")),
            ("detect_boundary", "k = 2.5", lambda: js.detect_boundary(square(), k=2.5),
             ("k is 2.5",)),
            ("detect_boundary", "k = 2", lambda: js.detect_boundary(square(), k=2), ("k = 2", "3")),
            ("detect_boundary", "k = 82", lambda: js.detect_boundary(square(), k=82), ("82", "81")),
            ("detect_boundary", "two points", lambda: js.detect_boundary(small()), ("k = 16", "2")),
            ("detect_boundary", "gap = NaN", lambda: js.detect_boundary(square(), gap=NAN),
             ("gap",)),
            ("detect_boundary", "gap = 4", lambda: js.detect_boundary(square(), gap=4.0),
             ("gap = 4", "3.14")),
            ("detect_boundary", "gap = 0", lambda: js.detect_boundary(square(), gap=0),
             ("gap = 0",)),
            ("detect_boundary", "gap is text", lambda: js.detect_boundary(square(), gap="2"),
             ("gap",)),
            ("border_conormals", "a mask as border",
             lambda: js.border_conormals(square(), square().boundary), ("border", "(81,)")),
            ("border_conormals", "of a larger cloud",
             lambda: js.border_conormals(small(), border()), ("border", "point 9", "2")),
            ("border_conormals", "nothing marked", lambda: js.border_conormals(closed()),
             ("boundary",)),
            ("Border", "no point", lambda: js.Border(np.zeros(0, int), np.zeros((2, 0, 5), int),
             np.zeros((2, 0, 5), bool)), ("points", "(0,)", "at least 1")),
            ("Border", "rows of one side", lambda: js.Border(np.arange(3), np.zeros((3, 5), int),
             np.zeros((3, 5), bool)), ("rows", "(3, 5)", "(2, 3, r)")),
            ("Border", "mask of another shape",
             lambda: js.Border(np.arange(3), np.zeros((2, 3, 5), int), np.ones((2, 3, 4), bool)),
             ("mask", "(2, 3, 4)", "(2, 3, 5)")),
            ("Border", "points that are floats",
             lambda: js.Border(np.arange(3.0), np.zeros((2, 3, 5), int), np.ones((2, 3, 5), bool)),
             ("points", "float64", "indices")),
            ("Border", "negative points",
             lambda: js.Border(-np.arange(3), np.zeros((2, 3, 5), int), np.ones((2, 3, 5), bool)),
             ("points", "-1")),
            ("Border", "points is a number",
             lambda: js.Border(np.array(3), np.zeros((2, 3, 5), int), np.ones((2, 3, 5), bool)),
             ("points", "()")),
        ]
    ),
    *(
        Case("with_ghosts", label, call, words)
        for label, call, words in [
            *(
                (f"conditions: {label}", lambda v=v: js.with_ghosts(square(), v), ("conditions", w))
                for label, (v, w) in _not_a_condition.items()
            ),
            ("a mask of 5 points", lambda: js.with_ghosts(square(), js.neumann(np.ones(5, bool))),
             ("5 points", "81")),
            ("a derivative inside", lambda: js.with_ghosts(square(), js.neumann(
                [INNER], conormals=np.array([[1.0, 0, 0]]))), (f"point {INNER}", "border")),
            ("only inner points", lambda: js.with_ghosts(square(), js.dirichlet([INNER])),
             ("nothing to reflect",)),
            ("only free points", lambda: js.with_ghosts(square(), js.free(border_points())),
             ("nothing to reflect",)),
            ("no border", lambda: js.with_ghosts(closed(), js.neumann([3])), ("boundary",)),
            ("depth = -1", lambda: js.with_ghosts(square(), js.neumann(LEFT), depth=-1.0),
             ("depth = -1", "above 0")),
            ("depth = 0", lambda: js.with_ghosts(square(), js.neumann(LEFT), depth=0),
             ("depth = 0", "above 0")),
            ("depth is text", lambda: js.with_ghosts(square(), js.neumann(LEFT), depth="1"),
             ("depth", "'1'")),
            ("depth is NaN", lambda: js.with_ghosts(square(), js.neumann(LEFT), depth=NAN),
             ("depth = nan",)),
            ("method is a number", lambda: js.with_ghosts(square(), js.neumann(LEFT), method=2),
             ("method", "2")),
            ("border is a list", lambda: js.with_ghosts(square(), js.neumann(LEFT), border=[0, 1]),
             ("border", "find_border")),
            ("a and b zero", lambda: js.with_ghosts(square(), js.robin(LEFT, a=0.0, b=0.0)),
             ("does not determine", "image")),
        ]
    ),
    Case("robin", "no factor of the value", lambda: js.robin([1], a=None, b=1.0), ("a is None",)),
    Case("robin", "no factor of the slope", lambda: js.robin([1], a=1.0, b=None), ("b is None",)),
]
