"""Steady problems, eigenmodes, distances and preconditioners."""

import functools

import jax.numpy as jnp
import numpy as np

import jaxsurf as js

from . import Case


@functools.cache
def problem():
    """A sphere, with a Laplacian that is not the surface's: sums of differences on lists."""
    cloud = js.sphere(60)
    lists = js.find_neighbors(cloud, 7)
    weights = jnp.ones((7, 60)).at[0].set(-6.0)
    return cloud, js.Stencil(lists.indices.T, weights), lists


def laplacian():
    return problem()[1]


def z():
    return problem()[0].points[:, 2]


def renewable():
    return js.multigrid(laplacian(), renewable=True)


def pinned():
    return js.eliminate(problem()[0], js.dirichlet([0], 0.0))


def marked():
    """The same with a border about which nothing is said."""
    plain = laplacian()
    return js.Stencil(plain.indices, plain.weights, border=jnp.arange(60) < 3)


def solve(operator=None, rhs=None, **options):
    return js.solve(
        laplacian() if operator is None else operator, z() if rhs is None else rhs, **options
    )


def newton(operator=None, reaction=lambda u, a: u, u0=None, **options):
    u0 = z() if u0 is None else u0
    return js.solve_nonlinear(
        laplacian() if operator is None else operator, reaction, u0, **options
    )


def modes(operator=None, k=3, **options):
    return js.eigenmodes(laplacian() if operator is None else operator, k, **options)


def distance(cloud=None, sources=(0,), **options):
    cloud = problem()[0] if cloud is None else cloud
    sources = np.array(sources) if isinstance(sources, tuple) else sources
    return js.geodesic_distance(cloud, sources, **{"neighbors": problem()[2], **options})


def operators(function, call):
    """What is given in place of an operator."""
    kinds = {
        "a bare array": lambda: np.eye(60),
        "a SciPy matrix": lambda: laplacian().to_scipy(),
        "text": lambda: "laplacian",
        "a function": lambda: jnp.sin,
        "a cloud": lambda: problem()[0],
    }
    return [
        Case(function, f"{label} as operator", lambda given=given: call(given()), ("operator",))
        for label, given in kinds.items()
    ] + [
        Case(
            function,
            "an operator with components",
            lambda: call(js.Stencil(laplacian().indices, jnp.ones((7, 3, 60)), out_shape=(3,))),
            ("(3,)", "scalar"),
        )
    ]


def limits(function, call):
    """Tolerances and numbers of steps."""
    given = {
        "rtol": (1.0, 2, 0.0, -1e-8, np.nan, np.inf),
        "atol": (-1.0, np.nan, np.inf),
        "max_steps": (0, -3),
    }
    return [
        Case(function, f"{name} = {value}", lambda n=name, v=value: call(**{n: v}), (name, "="))
        for name, values in given.items()
        for value in values
    ] + [
        Case(function, f"{name} = {v!r}", lambda n=name, v=v: call(**{n: v}), (name, repr(v)))
        for name, v in (("rtol", "1e-8"), ("atol", None), ("max_steps", 2.5), ("max_steps", True))
    ]


def conserved(operator=None, total=1.0, **options):
    return js.conservative_weights(laplacian() if operator is None else operator, total, **options)


CASES = [
    *operators("conservative_weights", conserved),
    Case("conservative_weights", "no area", lambda: conserved(total=0.0), ("total", "0")),
    Case("conservative_weights", "an area that is no number", lambda: conserved(total=np.nan),
         ("total", "nan")),
    Case("conservative_weights", "areas in place of their sum", lambda: conserved(total=z()),
         ("total", "60")),
    Case("conservative_weights", "a composition", lambda: conserved(laplacian() @ laplacian()),
         ("operator", "outer")),
    Case("conservative_weights", "a function as preconditioner",
         lambda: conserved(preconditioner=jnp.sin), ("preconditioner", "js.multigrid")),
    Case("conservative_weights", "heat that is lost", lambda: conserved(laplacian() - 1),
         ("operator", "constants")),
    Case("conservative_weights", "a border about which nothing is said",
         lambda: conserved(marked()), ("border",)),
    *operators("solve", solve),
    *operators("solve_nonlinear", newton),
    *operators("eigenmodes", modes),
    *limits("solve", solve),
    *limits("solve_nonlinear", newton),
    Case("solve", "a Condition", lambda: solve(closure=js.dirichlet([0], 0.0)),
         ("closure", "Closure", "js.eliminate")),
    Case("solve", "conditions of other points", lambda: js.solve(
        laplacian(), z(), closure=js.eliminate(js.sphere(61), js.dirichlet([0], 0.0))),
        ("61", "60")),
    Case("solve", "a class as preconditioner",
         lambda: solve(preconditioner=js.JacobiPreconditioner), ("preconditioner",)),
    Case("solve", "text as solver", lambda: solve(solver="bicgstab"), ("solver", "bicgstab")),
    Case("solve", "complex right-hand side", lambda: solve(rhs=1j * z()),
         ("right-hand side", "complex")),
    Case("solve", "text as right-hand side", lambda: solve(rhs="f"), ("right-hand side", "'f'")),
    Case("solve", "ragged right-hand side", lambda: solve(rhs=[[1.0], [1.0, 2.0]]),
         ("right-hand side",)),
    Case("solve", "a number as right-hand side", lambda: solve(rhs=1.0), ("()", "(60,)")),
    Case("solve", "too short", lambda: solve(rhs=jnp.ones(59)), ("(59,)", "(60,)")),
    Case("solve", "no column", lambda: solve(rhs=jnp.ones((60, 0))), ("(60, 0)",)),
    Case("solve", "NaN at a point", lambda: solve(rhs=z().at[7].set(jnp.nan)), ("point 7",)),
    Case("solve", "infinity at a point", lambda: solve(rhs=z().at[9].set(jnp.inf)), ("point 9",)),
    Case("solve", "a border without conditions", lambda: solve(marked()),
         ("point 0", "js.eliminate", "js.free")),
    Case("solve", "a right-hand side of one sign", lambda: solve(rhs=jnp.ones(60)),
         ("right-hand side", "incompatible", "mean is 1", "project=True")),
    Case("solve_nonlinear", "a Condition", lambda: newton(closure=js.dirichlet([0], 0.0)),
         ("closure", "Closure")),
    Case("solve_nonlinear", "no function", lambda: newton(reaction=3.0), ("reaction", "float")),
    Case("solve_nonlinear", "a reaction of another shape",
         lambda: newton(reaction=lambda u, a: u[:3]), ("reaction", "(3,)", "(60,)")),
    Case("solve_nonlinear", "complex start", lambda: newton(u0=1j * z()), ("u0", "complex")),
    Case("solve_nonlinear", "short start", lambda: newton(u0=jnp.ones(3)), ("u0", "(3,)", "60")),
    Case("solve_nonlinear", "NaN in the start", lambda: newton(u0=z().at[4].set(jnp.nan)),
         ("u0", "point 4")),
    Case("solve_nonlinear", "infinite right-hand side", lambda: newton(rhs=jnp.inf),
         ("right-hand side",)),
    Case("solve_nonlinear", "a border without conditions", lambda: newton(marked()),
         ("point 0", "js.free")),
    Case("eigenmodes", "half a mode", lambda: modes(k=2.5), ("k is 2.5",)),
    Case("eigenmodes", "text for k", lambda: modes(k="3"), ("k", "'3'")),
    Case("eigenmodes", "no modes", lambda: modes(k=0), ("k = 0", "1")),
    Case("eigenmodes", "too many modes", lambda: modes(k=31), ("k = 31", "30")),
    Case("eigenmodes", "a Condition", lambda: modes(closure=js.dirichlet([0], 0.0)),
         ("closure", "Closure")),
    Case("eigenmodes", "negative distance", lambda: modes(degenerate=-1), ("degenerate", "-1")),
    Case("eigenmodes", "NaN as distance", lambda: modes(degenerate=np.nan), ("degenerate", "nan")),
    Case("eigenmodes", "a border without conditions", lambda: modes(marked()),
         ("point 0", "js.free")),
    Case("geodesic_distance", "bare points", lambda: distance(z()), ("cloud", "PointCloud")),
    Case("geodesic_distance", "text as method", lambda: distance(method="gfdm"),
         ("method", "gfdm")),
    Case("geodesic_distance", "lists as neighbours", lambda: distance(neighbors=[[0, 1]]),
         ("neighbors", "Neighbors")),
    Case("geodesic_distance", "no sources", lambda: distance(sources=np.zeros(0, int)),
         ("no sources",)),
    Case("geodesic_distance", "a source out of range", lambda: distance(sources=(60,)),
         ("source 60", "59")),
    Case("geodesic_distance", "a negative source", lambda: distance(sources=(-1,)), ("source -1",)),
    Case("geodesic_distance", "a mask of another length",
         lambda: distance(sources=np.ones(5, bool)), ("(5,)", "(60,)")),
    Case("geodesic_distance", "real sources", lambda: distance(sources=np.array([1.5])),
         ("sources", "float64", "indices")),
    Case("geodesic_distance", "no smoothing", lambda: distance(smoothing=0.0), ("smoothing", "0")),
    Case("geodesic_distance", "NaN smoothing", lambda: distance(smoothing=np.nan),
         ("smoothing", "nan")),
    Case("geodesic_distance", "rtol = 1", lambda: distance(rtol=1.0), ("rtol = 1", "below 1")),
    Case("geodesic_distance", "rtol = -1", lambda: distance(rtol=-1.0), ("rtol = -1", "above 0")),
    *[
        Case("BiCGStab", f"{name} = {value!r}", lambda n=name, v=value: js.BiCGStab(**{n: v}),
             (name,))
        for name, values in {
            "rtol": (1.0, -1.0, np.nan, "small", None),
            "atol": (-1.0, np.inf, 1j),
            "max_steps": (0, 2.5),
        }.items()
        for value in values
    ],
    *operators("multigrid", js.multigrid),
    *operators("jacobi", js.jacobi),
    Case("multigrid", "a Condition", lambda: js.multigrid(
        laplacian(), closure=js.dirichlet([0], 0.0)), ("closure", "Closure")),
    Case("jacobi", "a Condition", lambda: js.jacobi(
        laplacian(), closure=js.dirichlet([0], 0.0)), ("closure", "Closure")),
    Case("jacobi", "a composition", lambda: js.jacobi(laplacian() @ laplacian()),
         ("Composition",)),
    Case("multigrid", "NaN weights", lambda: js.multigrid(js.Stencil(
        laplacian().indices, laplacian().weights.at[2, 17].set(jnp.nan))), ("point 17",)),
    *[
        Case("multigrid", f"renewed for {label}", call, words)
        for label, call, words in (
            ("what has no plan", lambda: js.multigrid(laplacian()).renewed(laplacian()),
             ("renewable=True",)),
            ("no operator", lambda: renewable().renewed(jnp.eye(60)), ("operator", "array")),
            ("fewer points", lambda: renewable().renewed(js.identity(40)), ("40", "60")),
            ("a Condition", lambda: renewable().renewed(
                laplacian(), closure=js.dirichlet([0], 0.0)), ("closure", "Closure")),
        )
    ],
    Case("multigrid", "a zero row", lambda: js.multigrid(js.Stencil(
        laplacian().indices, laplacian().weights.at[:, 5].set(0.0))), ("row 5",)),
    Case("eigenmodes", "an operator of the other sign", lambda: js.eigenmodes(-laplacian(), 3),
         ("eigenvalues", "below 0", "-operator")),
    Case("solve_nonlinear", "a reaction in NumPy, as an array", lambda: newton(
        reaction=lambda u, a: np.sin(np.asarray(u))), ("reaction", "jax.numpy")),
]  # fmt: skip
