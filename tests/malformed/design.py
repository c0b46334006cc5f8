"""Shapes as unknowns, and derivatives held against differences."""

# One case a line reads as a table.
# ruff: noqa: E501

import functools

import jax
import jax.numpy as jnp
import numpy as np
import optax

import jaxsurf as js

from . import Case

X = jnp.array([1.0, 2.0, 3.0])


@functools.cache
def surface() -> js.Discretization:
    cloud = js.sphere(80)
    return js.discretize(cloud, js.find_neighbors(cloud, k=36), method=js.GFDM(degree=2))


@functools.cache
def cap() -> js.Discretization:
    cloud = js.surface_of_revolution(lambda s: (jnp.sin(s), -jnp.cos(s)), 120)
    return js.discretize(cloud, method=js.GFDM(degree=2))


def level_set():
    return js.LevelSetShape(lambda x, level: x @ x + level, surface())


def mapped(f):
    return lambda: js.MappedShape(f, surface())(1.0)


def taylor(f=lambda x: jnp.sum(jnp.sin(x)), x=X, direction=X, **options):
    return lambda: js.taylor_remainders(f, x, direction, **options)


def reach(surface):
    return jnp.mean(surface.cloud.points**2)


def larger(x, a):
    return a * x


def optimized(f=reach, theta=1.0, optimizer=optax.sgd(0.1), **options):
    shape = lambda: js.MappedShape(larger, surface())
    return lambda: js.optimize_shape(f, shape(), theta, optimizer=optimizer, **options)


BOX = ((-1.3,) * 3, (1.3,) * 3)


def boxed(level, bounds):
    shape = lambda: js.LevelSetShape(lambda x, a: x @ x - a, surface(), bounds)
    return lambda: js.optimize_shape(reach, shape(), level, optimizer=optax.sgd(0.1))


CALLS = [
    ("optimize_shape", "a number for the objective", optimized(f=1.0), ("objective is a float", "function")),
    ("optimize_shape", "a callback that returns a number", optimized(callback=lambda now: now.objective), ("callback returns", "True or False")),
    ("optimize_shape", "an objective with several values", optimized(f=lambda s: s.cloud.points[0]), ("objective", "(3,)", "one number")),
    ("optimize_shape", "an objective that is no number", optimized(f=lambda s: jnp.log(-reach(s))), ("objective is nan", "first theta")),
    ("optimize_shape", "a slope that is no number", optimized(f=lambda s: jnp.sqrt(0 * reach(s))), ("gradient", "not finite")),
    ("optimize_shape", "whole parameters", optimized(theta=1), ("theta has a leaf of type int", "floating")),
    ("optimize_shape", "parameters that flatten", optimized(theta=0.0), ("f flattens", "point 0")),
    ("optimize_shape", "a function for an optimiser", optimized(optimizer=reach), ("optimizer", "GradientTransformation", "optax.lbfgs()")),
    ("optimize_shape", "a constraint without a name", optimized(equalities=[reach]), ("equalities", "Mapping", "volume")),
    ("optimize_shape", "a number for a constraint", optimized(inequalities={"a": 1.0}), ("inequalities['a'] is a float", "function")),
    ("optimize_shape", "a constraint that is no number", optimized(equalities={"a": lambda s: reach(s) / 0}), ("constraint 'a' is inf", "first theta")),
    ("optimize_shape", "an objective that is true or false", optimized(f=lambda s: reach(s) > 1), ("objective is true or false", "number", "a - b")),
    ("optimize_shape", "a constraint that is true or false", optimized(equalities={"a": lambda s: reach(s) > 1}), ("constraint 'a' is true or false", "number", "a - b")),
    ("optimize_shape", "inequalities that are true or false", optimized(inequalities={"a": lambda s: s.areas > 1}), ("constraint 'a' is true or false", "number", "a - b")),
    ("optimize_shape", "a constraint that Python decides", optimized(equalities={"a": lambda s: True}), ("constraint 'a' is true or false",)),
    ("optimize_shape", "constraints of which some are no numbers", optimized(inequalities={"a": lambda s: jnp.where(jnp.arange(80) > 77, jnp.nan, s.areas)}), ("constraint 'a' is nan", "first theta", "entry 78", "1 more")),
    ("optimize_shape", "an inequality that is never met", optimized(inequalities={"a": lambda s: jnp.zeros((3, 2)).at[1, 0].set(jnp.inf)}), ("constraint 'a' is inf", "first theta", "entry 1, 0")),
    ("optimize_shape", "an equality that is never met", optimized(equalities={"a": lambda s: -jnp.inf + reach(s)}), ("constraint 'a' is -inf", "first theta")),
    ("optimize_shape", "a constraint without numbers", optimized(equalities={"a": lambda s: s.areas[:0]}), ("constraint 'a'", "(0,)", "no numbers")),
    ("optimize_shape", "a projection to no numbers", optimized(project=lambda t: t * jnp.nan), ("project makes", "nan", "finite")),
    ("optimize_shape", "one name twice", optimized(equalities={"a": reach}, inequalities={"a": reach}), ("'a'", "taken")),
    ("optimize_shape", "an objective of what is differentiated", lambda: jax.grad(lambda a: optimized(f=lambda s: a * reach(s))().objective)(1.0), ("functions, shape and optimizer close over", "traced")),
    ("optimize_shape", "a constraint of what is mapped", lambda: jax.vmap(lambda a: optimized(equalities={"a": lambda s: reach(s) - a})().objective)(X), ("functions, shape and optimizer close over", "traced")),
    ("optimize_shape", "a rate that is differentiated", lambda: jax.grad(lambda a: optimized(optimizer=optax.sgd(a))().objective)(0.1), ("functions, shape and optimizer close over", "traced")),
    ("optimize_shape", "no steps", optimized(steps=0), ("steps = 0", "at least 1")),
    ("optimize_shape", "a penalty below zero", optimized(penalty=-1.0), ("penalty = -1", "above 0")),
    ("optimize_shape", "a path for a checkpoint", optimized(checkpoint="run.npz"), ("checkpoint", "Checkpoint", "every=10")),
    ("optimize_shape", "a surface for a shape", lambda: js.optimize_shape(reach, surface(), 1.0, optimizer=optax.sgd(0.1)), ("shape", "Shape", "star_shape")),
    ("optimize_shape", "a number for a projection", optimized(project=2.0), ("project is a float", "function")),
    ("LivePlot", "a field of numbers", lambda: js.LivePlot(jnp.ones(80)), ("field", "function of a surface")),
    ("LivePlot", "half a step", lambda: js.LivePlot(every=0.5), ("every is 0.5", "whole number")),
    ("LivePlot", "no steps", lambda: js.LivePlot(every=0), ("every = 0", "at least 1")),
    ("LivePlot", "a surface to draw", lambda: js.LivePlot()(surface()), ("found", "ShapeOptimization")),
    ("tangent_point_energy", "an odd power", lambda: js.tangent_point_energy(surface(), power=5), ("power = 5", "even")),
    ("tangent_point_energy", "half a power", lambda: js.tangent_point_energy(surface(), power=4.5), ("power is 4.5", "whole number")),
    ("tangent_point_energy", "no power", lambda: js.tangent_point_energy(surface(), power=0), ("power = 0", "at least 2")),
    ("sobolev_gradient", "no length", lambda: js.sobolev_gradient(surface(), 0.0), ("length = 0", "above 0")),
    ("sobolev_gradient", "text for a length", lambda: js.sobolev_gradient(surface(), "far"), ("length", "'far'")),
    ("sobolev_gradient", "points held that there are not", lambda: js.sobolev_gradient(surface(), 0.5, held=[80]), ("held", "80")),
    ("sobolev_gradient", "a mask of others", lambda: js.sobolev_gradient(surface(), 0.5, held=np.ones(5, bool)), ("held", "5", "80")),
    ("sobolev_gradient", "text for points held", lambda: js.sobolev_gradient(surface(), 0.5, held="border"), ("held", "'border'")),
    ("sobolev_gradient", "all points held", lambda: js.sobolev_gradient(surface(), 0.5, held=np.ones(80, bool)), ("80 points", "no free point")),
    ("sobolev_gradient", "parameters of others", lambda: js.sobolev_gradient(surface(), 0.5).init({"a": X}), ("parameters['a']", "(3,)", "80 points")),
    ("sobolev_gradient", "a number", lambda: js.sobolev_gradient(surface(), 0.5).init(1.0), ("parameters", "()", "80 points")),
    ("sobolev_gradient", "a traced length", lambda: jax.jit(lambda a: js.sobolev_gradient(surface(), a).init(X).mass)(0.5), ("length", "traced")),
    ("taylor_remainders", "f a number", taylor(f=1.0), ("f is a float", "function")),
    ("taylor_remainders", "f with several values", taylor(f=jnp.sin), ("f returns", "(3,)", "one real number")),
    ("taylor_remainders", "f a complex value", taylor(f=lambda x: jnp.sum(1j * x)), ("f returns", "complex128", "one real number")),
    ("taylor_remainders", "a value that is not finite", taylor(f=lambda x: jnp.sum(x) / 0), ("f(x) is not finite", "inf")),
    ("taylor_remainders", "not finite beside x", taylor(f=lambda x: jnp.sqrt(1 - x[0])), ("derivative of f", "not finite")),
    ("taylor_remainders", "whole numbers", taylor(x=jnp.arange(3)), ("x has a leaf of type int64", "floating")),
    ("taylor_remainders", "text", taylor(x="abc"), ("x has a leaf", "str")),
    ("taylor_remainders", "nothing", taylor(x=()), ("x has no arrays",)),
    ("taylor_remainders", "a direction of another shape", taylor(direction=X[:2]), ("direction has shapes (2,)", "(3,)")),
    ("taylor_remainders", "a direction of another structure", taylor(direction=(X,)), ("direction has shapes ((3,),)", "(3,)")),
    ("taylor_remainders", "a direction that is not finite", taylor(direction=X * np.nan), ("direction is not finite",)),
    ("taylor_remainders", "a direction that is zero", taylor(direction=0 * X), ("direction is zero", "same")),
    ("taylor_remainders", "a direction of a tiny length", taylor(direction=1e-30 * X), ("direction", "so short", "same")),
    ("taylor_remainders", "a direction along one of three", taylor(direction=X.at[1:].set(0)), (), lambda found: abs(found.slope - 2) < 0.1),
    ("taylor_remainders", "a step of zero", taylor(steps=[0.1, 0.0]), ("step 1 is 0.0", "positive")),
    ("taylor_remainders", "one step", taylor(steps=[0.1]), ("1 different steps", "at least 2")),
    ("taylor_remainders", "traced", lambda: jax.jit(lambda x: taylor(x=x)().slope)(X), ("x and direction", "traced")),
    *((name, "a cloud", lambda name=name, more=more: getattr(js, name)(surface().cloud, *more), ("surface", "Discretization")) for name, more in (("volume", ()), ("willmore_energy", ()), ("moments", ()), ("eigenvalues", (4,)), ("compliance", (X,)), ("chamfer_distance", (X,)), ("star_shape", (2,)), ("NormalShape", ()), ("tangent_point_energy", ()), ("medial_radius", ()), ("sobolev_gradient", (0.5,)))),
    *((name, "text", lambda name=name, more=more: getattr(js, name)("ball", *more), ("surface is 'ball'", "Discretization")) for name, more in (("volume", ()), ("willmore_energy", ()), ("moments", ()), ("star_shape", (2,)), ("NormalShape", ()), ("medial_radius", ()))),
    ("moments", "nothing", lambda: js.moments(None), ("surface is None", "Discretization")),
    ("signed_distance", "a cloud", lambda: js.signed_distance(surface().cloud, X[None]), ("surface", "Discretization")),
    ("signed_distance", "a border", lambda: js.signed_distance(cap(), X[None]), ("border", "closed")),
    ("signed_distance", "one point", lambda: js.signed_distance(surface(), X), ("points", "(3,)")),
    ("signed_distance", "a point that is not finite", lambda: js.signed_distance(surface(), X[None] * jnp.nan), ("points", "point 0")),
    ("medial_radius", "nothing", lambda: js.medial_radius(None), ("surface is None", "Discretization")),
    ("willmore_energy", "points", lambda: js.willmore_energy(surface().cloud.points), ("surface", "Discretization")),
    ("volume", "a border", lambda: js.volume(cap()), ("border", "closed")),
    ("eigenvalues", "a border", lambda: js.eigenvalues(cap(), 4), ("border", "closed")),
    ("eigenvalues", "more than there are", lambda: js.eigenvalues(surface(), 41), ("k = 41", "n / 2 = 40")),
    ("eigenvalues", "a part of one", lambda: js.eigenvalues(surface(), 2.5), ("k", "2.5")),
    ("MappedShape", "a number for onto", lambda: js.MappedShape(lambda x, a: a * x, surface(), 1.0), ("onto is a float", "function")),
    ("MappedShape", "onto for a shape", lambda: js.MappedShape(lambda x, a: x, js.star_shape(surface(), 1), lambda x: (x, x)), ("onto", "base is a shape")),
    ("MappedShape", "onto with a border", lambda: js.MappedShape(lambda x, a: x, cap(), lambda x: (x, x)), ("onto", "boundary")),
    ("star_shape", "a number for even", lambda: js.star_shape(surface(), 2, even=2.0), ("even",)),
    ("compliance", "a border", lambda: js.compliance(cap(), jnp.ones(120)), ("border", "closed")),
    ("compliance", "a load of others", lambda: js.compliance(surface(), X), ("load", "(3,)", "(80,)")),
    ("compliance", "a screening below zero", lambda: js.compliance(surface(), jnp.ones(80), screening=-1.0), ("screening = -1", "at least 0")),
    ("compliance", "a screening that is traced", lambda: jax.grad(lambda s: js.compliance(surface(), jnp.ones(80), screening=s))(1.0), ("screening", "traced")),
    *((name, label, lambda name=name, points=points: getattr(js, name)(surface(), points), words) for name, word in (("chamfer_distance", "targets"),) for label, points, words in (
        ("points in the plane", jnp.ones((5, 2)), (word, "(5, 2)", "3")),
        ("no points", jnp.ones((0, 3)), (word, "(0, 3)", "at least 1")),
        ("a point that is not finite", jnp.ones((5, 3)).at[2].set(jnp.nan), (word, "point 2")),
    )),
    ("LevelSetShape", "a number for phi", lambda: js.LevelSetShape(1.0, surface()), ("phi is a float", "function")),
    ("LevelSetShape", "a cloud", lambda: js.LevelSetShape(lambda x, a: x @ x - a, surface().cloud), ("surface", "Discretization")),
    ("LevelSetShape", "an empty level set", lambda: level_set()(1.0), ("point 0", "did not converge")),
    *(("LevelSetShape", label, lambda bounds=bounds: js.LevelSetShape(lambda x, a: x @ x - a, surface(), bounds), words) for label, bounds, words in (
        ("bounds in the plane", ((-1.5, -1.5), (1.5, 1.5)), ("bounds of shape (2, 2)", "3 axes")),
        ("bounds the wrong way round", ((1.5,) * 3, (-1.5,) * 3), ("upper corner", "lower corner")),
        ("one number for bounds", 1.5, ("bounds", "()")),
    )),
    ("LevelSetShape", "bounds for a border", lambda: js.LevelSetShape(lambda x, a: x @ x - a, cap(), BOX), ("bounds", "without boundary")),
    ("optimize_shape", "a level set that leaves its bounds", boxed(2.0, BOX), ("the level set leaves the bounds",)),
    ("optimize_shape", "an empty level set in bounds", boxed(-1.0, BOX), ("phi has no zero within the bounds",)),
    ("LevelSetShape", "phi with several values", lambda: js.LevelSetShape(lambda x, a: a * x, surface())(1.0), ("phi must return a scalar", "(3,)")),
    ("MappedShape", "a matrix for f", lambda: js.MappedShape(jnp.eye(3), surface()), ("f is a", "function")),
    ("MappedShape", "a cloud", lambda: js.MappedShape(lambda x, a: a * x, surface().cloud), ("base", "Discretization or Shape")),
    ("MappedShape", "f returns a number", mapped(lambda x, a: a * x[0]), ("f returns ()", "(3,)")),
    ("MappedShape", "f with NumPy", mapped(lambda x, a: np.sin(x)), ("f cannot be traced", "jax.numpy")),
    ("MappedShape", "f flattens", mapped(lambda x, a: 0 * x), ("f flattens", "point 0")),
    ("NormalShape", "displacements of others", lambda: js.NormalShape(surface())(X), ("displacements", "(3,)", "(80,)")),
    ("NormalShape", "text for displacements", lambda: js.NormalShape(surface())("far"), ("displacements", "'far'")),
    ("star_shape", "half a degree", lambda: js.star_shape(surface(), 2.5), ("degree is 2.5", "whole number")),
    ("star_shape", "too few coefficients", lambda: js.star_shape(surface(), 2)(X), ("theta", "(3,)", "(9,)")),
    ("spherical_harmonics", "points in the plane", lambda: js.spherical_harmonics(jnp.ones((5, 2)), 2), ("directions", "(5, 2)", "3")),
    ("spherical_harmonics", "a degree below zero", lambda: js.spherical_harmonics(X, -1), ("degree = -1", "at least 0")),
    ("spherical_harmonics", "half a degree", lambda: js.spherical_harmonics(X, 1.5), ("degree is 1.5", "whole number")),
    ("rigid_motion", "an angle in space", lambda: js.rigid_motion(X, (0.3, X)), ("rotation", "()", "(3,)")),
    ("rigid_motion", "a shift in the plane", lambda: js.rigid_motion(X, (X, X[:2])), ("shift", "(2,)", "(3,)")),
    ("rigid_motion", "many points", lambda: js.rigid_motion(jnp.ones((5, 3)), (X, X)), ("x has shape (5, 3)", "(3,)")),
    ("optimize_shape", "a number for further arguments", optimized(args=2.0), ("args is 2.0", "tuple")),
    ("optimize_shape", "further arguments by name", optimized(args={"a": 2.0}), ("args is", "dict", "tuple")),
    ("optimize_shape", "an objective in NumPy", optimized(f=lambda s: float(reach(s))), ("objective", "jax.numpy")),
    ("optimize_shape", "a constraint in NumPy", optimized(equalities={"a": lambda s: np.sum(np.asarray(s.cloud.points))}), ("constraint 'a'", "jax.numpy")),
    ("optimize_shape", "a constraint whose name is a number", optimized(equalities={3: reach}), ("equalities", "3", "text")),
    ("optimize_shape", "text for renew", optimized(renew="no"), ("renew is 'no'", "True or False")),
    ("optimize_shape", "a projection to more parameters", optimized(project=lambda t: jnp.stack([t, t])), ("project returns", "(2,)", "()")),
    ("optimize_shape", "a projection to nothing", optimized(project=lambda t: None), ("project returns None", "()")),
    ("optimize_shape", "a projection with L-BFGS", optimized(project=lambda t: t, optimizer=optax.lbfgs()), ("project", "L-BFGS", "first order")),
    ("NormalShape", "a start that is not finite", lambda: js.NormalShape(surface(), jnp.full(80, jnp.nan)), ("start", "point 0", "nan")),
    ("MappedShape", "parameters of one of two", lambda: js.MappedShape(lambda x, a: a * x, js.NormalShape(surface()))(jnp.zeros(80)), ("theta", "(80,)", "pair")),
    ("MappedShape", "parameters of three", lambda: js.MappedShape(lambda x, a: a * x, js.NormalShape(surface()))((1.0, 2.0, 3.0)), ("theta has 3 parts", "2")),
    ("rigid_motion", "a number for both", lambda: js.rigid_motion(X, 1.0), ("theta is 1.0", "rotation", "shift")),
    ("rigid_motion", "a rotation alone", lambda: js.rigid_motion(X, (X,)), ("theta has 1 parts", "2")),
    ("spherical_harmonics", "a direction of length zero", lambda: js.spherical_harmonics(jnp.zeros((2, 3)), 2), ("direction 0", "length 1")),
    ("spherical_harmonics", "directions twice as long", lambda: js.spherical_harmonics(jnp.array([[1.0, 0, 0], [0, 2.0, 0]]), 2), ("direction 1", "length 1")),
    ("compliance", "a load that is not finite", lambda: js.compliance(surface(), jnp.full(80, jnp.nan)), ("load", "point 0", "nan")),
]  # fmt: skip

CASES = [Case(*case) for case in CALLS]
