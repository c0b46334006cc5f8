"""Shapes in closed form, level sets, sampling, sorting."""

import functools
import math

import jax
import jax.numpy as jnp
import numpy as np

import jaxsurf as js
from jaxsurf.shapes.analytic import sphere_projection

from . import Case

NAN, INF = float("nan"), float("inf")
BOX = ((-1.2,) * 3, (1.2,) * 3)
POINTS = np.random.default_rng(0).normal(size=(30, 3))


def ball(x):
    return x @ x - 1


@functools.cache
def sphere() -> js.PointCloud:
    return js.sphere(60)


def made(function, label, words, *args, right=None, **options):
    return Case(
        function, label, lambda: getattr(js, function)(*args, **options), words, right=right
    )


COUNTS = [
    made(function, label, words, n, *rest)
    for function, least, rest in (
        ("circle", 3, ()),
        ("sphere", 4, ()),
        ("ellipsoid", 4, ((1.0, 2.0, 3.0),)),
        ("torus", 12, (3.0, 1.0)),
    )
    for label, words, n in (
        ("n = 100.5", ("n is 100.5", "whole number"), 100.5),
        ("n = 100.0", ("n is 100.0", "whole number"), 100.0),
        ("n = '100'", ("n is '100'", "whole number"), "100"),
        ("n = None", ("n is None", "whole number"), None),
        ("n = True", ("n is True", "whole number"), True),
        ("n = -5", ("n = -5", str(least)), -5),
        ("no points", ("n = 0", str(least)), 0),
        ("one point", ("n = 1", str(least)), 1),
        ("more points than can be numbered", ("n = ", "2147483647"), 10**12),
        ("n an array", ("n is an array", "whole number"), np.array([100, 200])),
    )
]

LENGTHS = [
    made(function, label, (name, *words), *args, **{name: value})
    for function, name, args in (("circle", "radius", (20,)), ("sphere", "radius", (20,)))
    for label, words, value in (
        ("radius 0", ("0", "above 0"), 0),
        ("radius -1", ("-1", "above 0"), -1),
        ("radius that is not a number", ("nan", "above 0"), NAN),
        ("infinite radius", ("inf", "above 0"), INF),
        ("complex radius", ("complex",), 1 + 1j),
        ("radius as text", ("'1'", "real number"), "1"),
        ("radius None", ("None", "real number"), None),
        ("two radii", ("array", "real number"), np.ones(2)),
        ("radius 1e200", ("1e+200", "at most"), 1e200),
    )
] + [
    made("sphere", "radius 1e-50", (), 20, radius=1e-50, right=lambda c: c.n == 20),
    made("circle", "radius an integer", (), 20, radius=2, right=lambda c: c.n == 20),
    made("sphere", "keyword unknown to it", ("r",), 20, r=1.0),
    made("ellipsoid", "two axes", ("axes", "(3,)", "(2,)"), 50, (1.0, 2.0)),
    made("ellipsoid", "one axis", ("axes", "(3,)", "()"), 50, 2.0),
    made("ellipsoid", "an axis of 0", ("axis 1 is 0", "positive"), 50, (1.0, 0.0, 1.0)),
    made("ellipsoid", "an axis that is no number", ("axis 2 is nan",), 50, (1.0, 1.0, NAN)),
    made("ellipsoid", "complex axes", ("axes", "complex"), 50, (1.0, 1.0, 1j)),
    made("ellipsoid", "axes as text", ("axes", "real numbers"), 50, "abc"),
    made("ellipsoid", "axes of 1e200", ("axes", "1e+200", "at most"), 50, (1e200, 1, 1)),
    made("ellipsoid", "half a step", ("steps is 2.5", "whole"), 50, (1, 1, 1), steps=2.5),
    made("torus", "a tube wider than the ring", ("r = 3", "R = 1"), 100, 1.0, 3.0),
    made("torus", "R as text", ("R", "'3'", "real number"), 100, "3", 1.0),
    made("torus", "r = 0", ("r = 0", "above 0"), 100, 3.0, 0.0),
    made("torus", "R that is no number", ("R = nan",), 100, NAN, 1.0),
    made("torus", "R of 1e200", ("R", "1e+200", "at most"), 100, 1e200, 1.0),
    Case(
        "sphere",
        "a traced radius",
        lambda: jax.jit(lambda r: js.sphere(20, radius=r).points)(1.0),
        ("radius", "concrete"),
    ),
]

PROFILE = lambda s: (1 + 0 * s, s)
SWEPT = [
    made("surface_of_revolution", label, words, profile, n, interval=interval)
    for label, words, profile, n, interval in (
        ("n = 99.5", ("n is 99.5",), PROFILE, 99.5, (0.0, 1.0)),
        ("profile a number", ("profile", "3", "function"), 3, 100, (0.0, 1.0)),
        ("profile in NumPy", ("profile", "jax.numpy"), lambda s: (np.cos(s), s), 100, (0.0, 1.0)),
        ("profile by math", ("profile", "jax.numpy"), lambda s: (math.cos(s), s), 100, (0.0, 1.0)),
        ("one number", ("profile", "two numbers"), lambda s: s, 100, (0.0, 1.0)),
        ("three numbers", ("profile", "two numbers"), lambda s: (s, s, s), 100, (0.0, 1.0)),
        ("vectors", ("profile", "two"), lambda s: (s * jnp.ones(2), s), 100, (0.0, 1.0)),
        ("an empty interval", ("interval", "empty"), PROFILE, 100, (1.0, 1.0)),
        ("an interval of three", ("interval", "two"), PROFILE, 100, (0.0, 1.0, 2.0)),
        ("an interval as text", ("interval", "real numbers"), PROFILE, 100, "01"),
        ("an endless interval", ("interval", "finite"), PROFILE, 100, (0.0, INF)),
        ("a profile that stands still", ("profile", "stationary"), lambda s: (1 + 0 * s, 0 * s),
         100, (0.0, 1.0)),
        ("a profile across the axis", ("profile", "axis"), lambda s: (s - 0.5, s), 100, (0.0, 1.0)),
    )
]  # fmt: skip

HEIGHT = lambda x, y: x * y
GRAPHS = [
    made("graph", label, words, f, n, bounds=bounds)
    for label, words, f, n, bounds in (
        ("n = 100.5", ("n is 100.5",), HEIGHT, 100.5, ((-1, -1), (1, 1))),
        ("three counts", ("n = (3, 4, 5)", "2"), HEIGHT, (3, 4, 5), ((-1, -1), (1, 1))),
        ("half a row", ("n is 4.5",), HEIGHT, (3, 4.5), ((-1, -1), (1, 1))),
        ("no rows", ("0 points in each of 0 rows",), HEIGHT, (5, 0), ((-1, -1), (1, 1))),
        ("f in NumPy", ("f", "jax.numpy"), lambda x, y: np.sin(x), 50, ((-1, -1), (1, 1))),
        ("f of one number", ("2 were given",), lambda x: x, 50, ((-1, -1), (1, 1))),
        ("f a list", ("f", "function"), [1.0], 50, ((-1, -1), (1, 1))),
        ("f a vector", ("f", "one number"), lambda x, y: jnp.stack([x, y]), 50, ((-1, -1), (1, 1))),
        ("bounds in space", ("bounds", "(2, 3)"), HEIGHT, 50, ((0, 0, 0), (1, 1, 1))),
        ("bounds turned round", ("upper corner", "lower"), HEIGHT, 50, ((1, 1), (0, 0))),
        ("bounds that are no numbers", ("upper corner",), HEIGHT, 50, ((0, 0), (NAN, 1))),
        ("a slope that is infinite", ("f", "not finite"), lambda x, y: jnp.sqrt(x), 50,
         ((0, 0), (1, 1))),
    )
]  # fmt: skip


def level(label, words, phi=ball, *, right=None, **options):
    return made("level_set", label, words, phi, right=right, **{"bounds": BOX, **options})


LEVELS = [
    level("n = 100.5", ("n is 100.5", "whole number"), n=100.5),
    level("n as text", ("n is '100'",), n="100"),
    level("n = 3", ("n = 3", "at least 4"), n=3),
    level("neither n nor spacing", ("exactly one of n and spacing",)),
    level("both n and spacing", ("exactly one of n and spacing",), n=100, spacing=0.1),
    level("spacing -1", ("spacing = -1", "above 0"), spacing=-1.0),
    level("spacing as text", ("spacing", "'0.1'"), spacing="0.1"),
    level("spacing too small", ("spacing = 1e-09", "2147483647"), spacing=1e-9, resolution=8),
    level("phi in NumPy", ("phi", "jax.numpy"), lambda x: np.sqrt(x[0]) + np.linalg.norm(x), n=50),
    level("phi by math", ("phi", "jax.numpy"), lambda x: math.sin(x[0]), n=50),
    level("phi with a condition", ("phi", "jax.numpy"), lambda x: x[0] if x[0] > 0 else -x[0], n=9),
    level("phi a vector", ("phi", "scalar", "(3,)"), lambda x: x, n=50),
    level("phi a pair", ("phi", "scalar", "tuple"), lambda x: (x[0], x[1]), n=50),
    level("phi a truth value", ("phi", "bool"), lambda x: x[0] > 0, n=50),
    level("phi complex", ("phi", "complex"), lambda x: x[0] + 1j, n=50),
    level("phi an array", ("phi", "function"), np.ones((4, 4)), n=50),
    level("phi not a number", ("phi", "not a number"), lambda x: x @ x * NAN, n=50),
    level("phi not a number at the surface", ("phi", "not a number at", "next to"),
          lambda x: jnp.where(jnp.abs(x[0]) < 0.3, jnp.nan, x @ x - 1), n=50, resolution=12),
    level("one corner", ("bounds", "(3,)", "(2, 3)"), n=50, bounds=(1.0, 1.0, 1.0)),
    level("bounds in four dimensions", ("bounds", "(2, 4)"), n=50, bounds=((0,) * 4, (1,) * 4)),
    level("bounds that are not finite", ("upper corner",), n=50, bounds=((0, 0), (INF, 1))),
    level("bounds as text", ("bounds", "real numbers"), n=50, bounds="box"),
    level("bounds of size 1e200", ("bounds", "at most"), n=50, bounds=((0, 0), (1e200, 1))),
    level("resolution 2", ("resolution = 2", "at least 4"), n=50, resolution=2),
    level("resolution 10.5", ("resolution is 10.5",), n=50, resolution=10.5),
    level("half a step", ("steps is 0.5",), n=50, steps=0.5),
    level("seed -1", ("seed = -1",), n=50, seed=-1),
    made("double_torus", "thickness 0", ("thickness = 0", "0.3", "0.55"), 0.0),
    made("double_torus", "thickness 1", ("thickness = 1", "0.3", "0.55"), 1.0),
    made("double_torus", "thickness that is no number", ("thickness = nan",), NAN),
    made("double_torus", "thickness as text", ("thickness", "'0.4'"), "0.4"),
    made("double_torus", "two of them", ("thickness", "array"), jnp.array([0.3, 0.4])),
    made("double_torus", "thickness complex", ("thickness", "complex"), 0.4 + 0j),
    made("double_torus", "thickness of single precision", (), np.float32(0.4),
         right=lambda made: made[0](jnp.ones(3)).dtype == float),
]  # fmt: skip

SEEN = [
    made(function, label, words, phi, points)
    for function in ("level_set_normals", "level_set_curvature", "project_to_level_set")
    for label, words, phi, points in (
        ("points of four numbers", ("points", "(30, 4)", "(n, 3)"), ball, np.ones((30, 4))),
        ("one point", ("points", "(3,)", "(n, 3)"), ball, np.ones(3)),
        ("complex points", ("points", "complex"), ball, POINTS + 1j),
        ("points as text", ("points", "real numbers"), ball, "points"),
        ("points None", ("points", "None"), ball, None),
        ("a point that is not finite", ("points", "point 0"), ball, POINTS * NAN),
        ("phi in NumPy", ("phi", "jax.numpy"), lambda x: np.sin(x[0]), POINTS),
        ("phi a vector", ("phi", "scalar", "(3,)"), lambda x: x, POINTS),
        ("phi a number", ("phi", "3", "function"), 3, POINTS),
        ("a vanishing gradient", ("point 0",), lambda x: 0 * x[0] + 1, POINTS),
    )
] + [
    made("project_to_level_set", label, words, ball, POINTS, **options)
    for label, words, options in (
        ("tolerance 0", ("tolerance = 0", "above 0"), {"tolerance": 0.0}),
        ("tolerance as text", ("tolerance", "'low'"), {"tolerance": "low"}),
        ("half a step", ("max_steps is 2.5",), {"max_steps": 2.5}),
        ("no step", ("max_steps = 0", "at least 1"), {"max_steps": 0}),
        ("too few steps", ("point", "did not converge", "1 steps"), {"max_steps": 1}),
    )
]

H = 0.5
SAMPLES = [
    made("sort_cloud", "an array", ("cloud", "(30, 3)", "PointCloud"), POINTS),
    made("sort_cloud", "None", ("cloud", "None", "PointCloud"), None),
    made("sort_cloud", "a list", ("cloud", "list", "PointCloud"), [[0.0, 1.0]]),
    made("sort_cloud", "text", ("cloud", "'cloud'"), "cloud"),
    made("sort_cloud", "a function", ("cloud", "function"), ball),
    Case(
        "sort_cloud",
        "a traced cloud",
        lambda: jax.jit(lambda c: js.sort_cloud(c)[0])(sphere()),
        ("concrete",),
    ),
    made("poisson_disk", "radius 0", ("radius = 0", "above 0"), POINTS, 0.0),
    made("poisson_disk", "radius as text", ("radius", "'wide'"), POINTS, "wide"),
    made("poisson_disk", "radius that is no number", ("radius = nan",), POINTS, NAN),
    made("poisson_disk", "candidates in a row", ("candidates", "(30,)"), POINTS[:, 0], 0.1),
    made("poisson_disk", "complex candidates", ("candidates", "complex"), POINTS + 1j, 0.1),
    made("poisson_disk", "a candidate not finite", ("candidates", "point 0"), POINTS * NAN, 0.1),
    made("poisson_disk", "candidates of 1e200", ("candidates", "at most"), POINTS * 1e200, 0.1),
    made("poisson_disk", "too few normals", ("normals", "(2, 3)"), POINTS, 1.0, normals=POINTS[:2]),
    made("poisson_disk", "seed 1.5", ("seed is 1.5",), POINTS, 0.1, seed=1.5),
    made("poisson_disk", "one candidate", (), POINTS[:1], 0.1, right=lambda kept: len(kept) == 1),
    made("poisson_disk", "none", (), POINTS[:0], 0.1, right=lambda kept: len(kept) == 0),
] + [
    Case("jitter", label, lambda change=change: js.jitter(**{**VALID(), **change}), words)
    for label, words, change in (
        ("an array", ("cloud", "(30, 3)", "PointCloud"), {"cloud": POINTS}),
        ("spacing 0", ("spacing = 0", "above 0"), {"spacing": 0.0}),
        ("spacing as text", ("spacing", "'h'"), {"spacing": "h"}),
        ("fraction -1", ("fraction = -1", "at least 0"), {"fraction": -1.0}),
        ("seed 1.5", ("seed is 1.5",), {"seed": 1.5}),
        ("no projection", ("project", "None", "function"), {"project": None}),
        ("points only", ("project", "a pair"), {"project": lambda x: x}),
        ("too few points back", ("project returns", "(59, 3)", "(60, 3)"),
         {"project": lambda x: (x[1:], x[1:])}),
        ("a point that is lost", ("projection failed", "point 0"),
         {"project": lambda x: (x * NAN, x)}),
    )
]  # fmt: skip


def VALID():
    return {"cloud": sphere(), "project": sphere_projection(), "spacing": H}


CASES = [*COUNTS, *LENGTHS, *SWEPT, *GRAPHS, *LEVELS, *SEEN, *SAMPLES]
