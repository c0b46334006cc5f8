"""Surfaces that move."""

# One case a line reads as a table.
# ruff: noqa: E501

import functools

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np

import jaxsurf as js

from . import Case

N = 60


@functools.cache
def surface() -> js.Discretization:
    with jax.ensure_compile_time_eval():  # kept, whichever case asks for it first
        cloud = js.sphere(N)
        return js.discretize(cloud, js.find_neighbors(cloud, k=36), method=js.GFDM(degree=2))


def still(t, surface, fields, args):
    return 0 * surface.cloud.points


def evolve(motion=None, cloud=None, **options):
    motion = js.Motion(still) if motion is None else motion
    return js.evolve(motion, surface() if cloud is None else cloud, **({"t1": 1.0} | options))


def bordered() -> js.PointCloud:
    cloud = js.graph(lambda x, y: x * y, (10, 10))
    edge = np.abs(np.asarray(cloud.points[:, :2])).max(axis=1) > 1 - 1e-9
    return js.PointCloud(cloud.points, cloud.normals, boundary=edge)


def heat(surface):
    return js.AdvectionDiffusionReaction(surface.laplacian)


CALLS = [
    ("evolve", "a bare function", lambda: evolve(still), ("motion", "function", "js.Motion")),
    ("evolve", "bare points", lambda: evolve(cloud=surface().cloud.points), ("cloud", "PointCloud")),
    ("evolve", "a method for a surface that has one", lambda: evolve(method=js.GFDM(degree=4)), ("method", "GFDM(degree=4)")),
    ("evolve", "fields of others", lambda: evolve(fields=jnp.ones(70)), ("fields", "(70,)", "60")),
    ("evolve", "a field that is not finite", lambda: evolve(fields=jnp.ones(N).at[7].set(np.nan)), ("fields", "7")),
    ("evolve", "a complex field", lambda: evolve(fields=1j * jnp.ones(N)), ("fields", "complex")),
    ("evolve", "a field of another type", lambda: evolve(fields=jnp.ones(N, jnp.float16)), ("fields", "float16", "points")),
    ("evolve", "a problem in place of a function", lambda: evolve(fields=jnp.ones(N), problem=heat(surface())), ("problem", "function", "surface")),
    ("evolve", "a function of no problem", lambda: evolve(fields=jnp.ones(N), problem=lambda s: s.laplacian), ("problem", "Stencil")),
    ("evolve", "no absolute tolerance", lambda: evolve(atol=0.0), ("atol = 0", "above 0")),
    ("evolve", "no step of Euler's", lambda: evolve(solver=dfx.Euler()), ("Euler", "dt0")),
    ("evolve", "an end before the start", lambda: evolve(t1=-1.0), ("t1", "-1", "0")),
    ("evolve", "an end that is text", lambda: evolve(t1="1"), ("t1", "'1'")),
    ("evolve", "saves out of order", lambda: evolve(saveat=[0.5, 0.2]), ("saveat", "0.5")),
    ("evolve", "saves after the end", lambda: evolve(saveat=[0.5, 2.0]), ("saveat", "2", "1")),
    ("evolve", "a save that is text", lambda: evolve(saveat=["0.5"]), ("saveat", "'0.5'")),
    ("evolve", "a solver as text", lambda: evolve(solver="heun"), ("solver", "heun")),
    ("evolve", "a path for a checkpoint", lambda: evolve(checkpoint="run.npz"), ("checkpoint", "run.npz", "js.Checkpoint")),
    ("evolve", "a checkpoint in compiled code", lambda: jax.jit(lambda a: evolve(args=a, checkpoint=js.Checkpoint("run.npz", every=1.0)).ts)(1.0), ("checkpoint", "host")),
    ("evolve", "a spacing in place of an adaptation", lambda: evolve(adapt=0.1), ("adapt", "0.1", "js.Adaptation")),
    ("evolve", "points adapted in compiled code", lambda: jax.jit(lambda a: evolve(args=a, adapt=js.Adaptation(0.3)).ts)(1.0), ("adapt", "host")),
    ("evolve", "a spacing that is negative somewhere", lambda: evolve(adapt=js.Adaptation(lambda t, s, f, a: s.cloud.points[:, 2])), ("spacing", "point", "positive")),
    ("Adaptation", "no spacing", lambda: js.Adaptation(0.0), ("spacing", "0")),
    ("Adaptation", "a spacing as text", lambda: js.Adaptation("0.1"), ("spacing", "0.1")),
    ("Adaptation", "points put in and merged again", lambda: js.Adaptation(0.1, closest=0.8), ("closest", "0.8", "0.675")),
    ("Adaptation", "a time that is nothing", lambda: js.Adaptation(0.1, every=0.0), ("every", "0")),
    ("Adaptation", "room for half a point", lambda: js.Adaptation(0.1, capacity=100.5), ("capacity", "100.5")),
    ("adapt_points", "a cloud", lambda: js.adapt_points(surface().cloud, js.Adaptation(0.3)), ("surface", "PointCloud", "js.discretize")),
    ("adapt_points", "a number", lambda: js.adapt_points(surface(), 0.3), ("adapt", "0.3", "js.Adaptation")),
    ("adapt_points", "fields of others", lambda: js.adapt_points(surface(), js.Adaptation(0.3), jnp.ones(70)), ("fields", "(70,)", "60")),
    ("adapt_points", "a spacing for others", lambda: js.adapt_points(surface(), js.Adaptation(lambda t, s, f, a: jnp.ones(70))), ("spacing", "(70,)", "60")),
    ("evolve", "a distance in place of a contact", lambda: evolve(contact=0.1), ("contact", "0.1", "js.Contact")),
    ("evolve", "sheets cut without points to fill in", lambda: evolve(contact=js.Contact(0.1)), ("contact", "delete", "adapt")),
    ("evolve", "contact in compiled code", lambda: jax.jit(lambda a: evolve(args=a, contact=js.Contact(0.1, "non-penetration")).ts)(1.0), ("contact", "host")),
    ("Contact", "no distance", lambda: js.Contact(0.0), ("distance", "0")),
    ("Contact", "a distance as text", lambda: js.Contact("0.1"), ("distance", "0.1")),
    ("Contact", "a kind that there is not", lambda: js.Contact(0.1, kind="weld"), ("kind", "weld", "delete", "non-penetration", "merge")),
    ("evolve", "a tolerance of one", lambda: evolve(rtol=1.0), ("rtol", "1")),
    ("Motion", "an array", lambda: js.Motion(np.ones((N, 3))), ("velocity", "ndarray", "function")),
    ("Motion", "nothing", lambda: js.Motion(None), ("velocity", "None", "function")),
    ("Motion", "velocities of one component", lambda: evolve(js.Motion(lambda t, s, f, a: s.cloud.points[:, 0])), ("velocity", "(60,)", "(60, 3)")),
    ("Motion", "a velocity that is a list", lambda: evolve(js.Motion(lambda t, s, f, a: [1.0, 0.0, 0.0])), ("velocity", "(60, 3)")),
    ("MeanCurvatureFlow", "text", lambda: js.MeanCurvatureFlow(keep_volume="yes"), ("keep_volume", "yes")),
    ("MeanCurvatureFlow", "a number", lambda: js.MeanCurvatureFlow(keep_volume=1.0), ("keep_volume", "1.0")),
    ("MeanCurvatureFlow", "a cloud", lambda: js.MeanCurvatureFlow(surface().cloud), ("keep_volume", "PointCloud")),
    ("MeanCurvatureFlow", "smoothed over nothing", lambda: js.MeanCurvatureFlow(smoothing=0.0), ("smoothing", "0", "above 0")),
    ("MeanCurvatureFlow", "smoothing as text", lambda: js.MeanCurvatureFlow(smoothing="wide"), ("smoothing", "wide")),
    ("SurfaceDiffusionFlow", "times text", lambda: "2" * js.SurfaceDiffusionFlow(), ("factor", "'2'")),
    ("SurfaceDiffusionFlow", "backwards", lambda: -1 * js.SurfaceDiffusionFlow(), ("factor", "-1", "above 0")),
    ("SurfaceDiffusionFlow", "on a surface with a border", lambda: js.evolve(js.SurfaceDiffusionFlow(), bordered(), t1=0.01), ("border",)),
    ("WillmoreFlow", "times an array", lambda: js.WillmoreFlow() * np.ones(3), ("factor", "real number")),
    ("WillmoreFlow", "times infinity", lambda: np.inf * js.WillmoreFlow(), ("factor", "inf")),
    ("WillmoreFlow", "a sum backwards", lambda: -0.5 * (js.WillmoreFlow() + js.Motion(lambda t, s, f, a: s.cloud.points)), ("factor", "-0.5")),
    ("Redistribution", "backwards", lambda: js.Redistribution(-1.0), ("diffusivity", "-1", "above 0")),
    ("Redistribution", "a rate as text", lambda: js.Redistribution("fast"), ("diffusivity", "fast")),
    ("Redistribution", "a spacing that is a number", lambda: js.Redistribution(1.0, 0.1), ("spacing", "float", "function")),
    ("Redistribution", "on a surface with a border", lambda: js.evolve(js.Redistribution(1.0), bordered(), t1=0.01), ("border",)),
    ("Redistribution", "a spacing for others", lambda: evolve(js.Redistribution(1.0, lambda t, s, f, a: jnp.ones(70))), ("spacing", "(70,)", "60")),
    ("Redistribution", "a spacing below nothing", lambda: evolve(js.Redistribution(1.0, lambda t, s, f, a: -s.cloud.points[:, 0] ** 2)), ("spacing", "point", "above 0")),
    ("Redistribution", "a spacing without value", lambda: evolve(js.MeanCurvatureFlow() + js.Redistribution(1.0, lambda t, s, f, a: jnp.nan)), ("spacing", "point 0", "nan", "above 0")),
    ("evolve", "a motion plus a number", lambda: evolve(js.WillmoreFlow() + 0.1), ("WillmoreFlow", "float")),
    ("evolve", "a save alone", lambda: evolve(saveat=0.5), ("saveat is a float", "sequence of times")),
    ("evolve", "saves of diffrax", lambda: evolve(saveat=dfx.SaveAt(ts=[0.5])), ("saveat is a SaveAt", "sequence of times")),
    ("evolve", "a problem without fields", lambda: evolve(problem=heat), ("problem", "0 arrays", "at least 1")),
    ("evolve", "a problem of others", lambda: evolve(fields=jnp.ones(N), problem=lambda s: heat(js.discretize(js.sphere(70), method=js.GFDM(degree=2)))), ("problem", "70", "60")),
    ("evolve", "a wave of one field", lambda: evolve(fields=jnp.ones(N), problem=lambda s: js.WaveEquation(s.laplacian)), ("fields", "2 arrays")),
    ("evolve", "two species as a pair", lambda: evolve(fields=(jnp.ones(N), jnp.ones(N)), problem=heat), ("fields is a tuple of 2", "AdvectionDiffusionReaction", "(n, c)", "columns")),
    ("evolve", "a wave of two shapes", lambda: evolve(fields=(jnp.ones(N), jnp.ones((N, 2))), problem=lambda s: js.WaveEquation(s.laplacian)), ("fields", "(60,)", "(60, 2)", "one shape")),
    ("evolve", "a traced cloud", lambda: jax.jit(lambda x: evolve(cloud=js.PointCloud(x, x)).ts)(surface().cloud.points), ("cloud", "traced", "js.discretize(cloud, neighbors)")),
    ("evolve", "an adjoint as text", lambda: evolve(adjoint="forward"), ("adjoint", "forward", "ForwardMode")),
    ("evolve", "a velocity in NumPy", lambda: evolve(js.Motion(lambda t, s, f, a: np.sin(np.asarray(s.cloud.points)))), ("velocity", "jax.numpy")),
    ("adapt_points", "a spacing as large as the surface", lambda: js.adapt_points(surface(), js.Adaptation(3.0)), ("spacing", "are left", "too large", "polynomial")),
    ("Adaptation", "one for true", lambda: js.Adaptation(0.1, conserve=1), ("conserve is 1", "True or False")),
    ("MeanCurvatureFlow", "text for true", lambda: js.MeanCurvatureFlow("no"), ("keep_volume is 'no'", "True or False")),
]  # fmt: skip

CASES = [Case(*case) for case in CALLS]
