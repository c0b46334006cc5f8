"""Surfaces that can be calculated with."""

# One case a line reads as a table.
# ruff: noqa: E501

import functools

import jax.numpy as jnp
import numpy as np

import jaxsurf as js

from . import Case

N, METHOD = 80, js.GFDM(degree=2)


@functools.cache
def surface() -> js.Discretization:
    cloud = js.sphere(N)
    return js.discretize(cloud, js.find_neighbors(cloud, k=36), method=METHOD)


def x():
    return surface().cloud.points


CALLS = [
    ("discretize", "points without normals", lambda: js.discretize(x()), ("cloud", "PointCloud")),
    ("discretize", "method as text", lambda: js.discretize(js.sphere(N), method="gfdm"), ("method", "gfdm")),
    ("discretize", "bare indices", lambda: js.discretize(js.sphere(N), surface().neighbors.indices, method=METHOD), ("neighbors", "Neighbors")),
    ("discretize", "neighbours of others", lambda: js.discretize(js.sphere(70), surface().neighbors, method=METHOD), ("neighbors", "80", "70")),
    ("Discretization", "neighbours of others", lambda: js.Discretization(js.sphere(70), surface().neighbors, METHOD), ("neighbors", "80", "70")),
    ("Discretization", "a field of others", lambda: surface().integrate(jnp.ones(70)), ("field", "(70,)", "80")),
    ("Discretization", "a number to integrate", lambda: surface().mean(1.0), ("field", "()", "80")),
    ("Discretization", "a complex field", lambda: surface().integrate(jnp.ones(N) * 1j), ("field", "complex")),
    ("Discretization", "fields of two shapes", lambda: surface().inner(jnp.ones(N), x()), ("(80,)", "(80, 3)")),
    ("Discretization", "one point in place of several", lambda: surface().interpolate(jnp.ones(N), x()[0]), ("points", "(3,)")),
    ("Discretization", "a point that is not finite", lambda: surface().interpolate(jnp.ones(N), x().at[3].set(jnp.nan)), ("points", "3")),
    ("Discretization", "a point far away", lambda: surface().interpolate(jnp.ones(N), x().at[3].set(9.0)), ("points", "3", "away")),
    ("Discretization", "moved to fewer points", lambda: surface().moved(x()[:70]), ("points", "(70, 3)", "(80, 3)")),
    ("Discretization", "moved to nowhere", lambda: surface().moved(x().at[5].set(np.inf)), ("points", "5")),
    ("Discretization", "moved with long normals", lambda: surface().moved(x(), 2 * x()), ("normal 0", "2")),
    ("Discretization", "a search that is a number", lambda: surface().moved(x(), search=36), ("search", "36", "NeighborSearch")),
    ("Discretization", "a margin below one", lambda: surface().search(margin=0.5), ("margin", "0.5", "1")),
    ("NeighborSearch", "a method as text", lambda: js.NeighborSearch("gfdm", 36, (), 36, ()), ("method", "gfdm")),
    ("NeighborSearch", "fewer slots than neighbours", lambda: js.NeighborSearch(METHOD, 36, (), 20, ()), ("slots", "20", "36")),
    ("NeighborSearch", "one tier", lambda: js.NeighborSearch(METHOD, 36, (), 36, ((36, 1, 64),)), ("tiers", "1", "3")),
    ("Discretization", "moved onto a plane", lambda: surface().moved(x() * jnp.array([1.0, 1.0, 0.0])), ("point", "normal")),
]  # fmt: skip

CASES = [Case(*case) for case in CALLS]
