"""Classes of users' own that do not do what their abstract class promises."""

# A row a case.
# ruff: noqa: E501

import functools

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import optax

import jaxsurf as js

from ..helpers import ring
from . import Case
from .design import surface

N = 12


@functools.cache
def parts():
    return ring(N)


def u0():
    return jnp.cos(parts()[0])


class Operator(js.AbstractOperator):
    how: object = eqx.field(static=True)
    n = N
    in_shape = ()
    out_shape = ()

    def __call__(self, u):
        return self.how(u)


class Preconditioner(js.AbstractPreconditioner):
    how: object = eqx.field(static=True)
    n = N

    def __call__(self, r):
        return self.how(r)


class Problem(js.AbstractEvolution):
    closure: None
    first: object = eqx.field(static=True)
    second: object = eqx.field(static=True)

    def linear(self, t, u):
        return self.first(u)

    def rest(self, t, u, args):
        return self.second(u)


class Method(js.AbstractMethod):
    """That of GFDM, with something else."""

    change: object = eqx.field(static=True, default=lambda found: found)
    counts: tuple = eqx.field(static=True, default=(7, 3, 64))
    degree: object = eqx.field(static=True, default=2)

    def neighbor_count(self, dim):
        return self.counts[0]

    def basis_size(self, dim, target):
        return self.counts[1]

    @property
    def batch_size(self):
        return self.counts[2]

    @property
    def polynomial_degree(self):
        return self.degree

    def weights(self, neighborhood, target):
        return self.change(js.GFDM(degree=2).weights(neighborhood, target))


class Sharing(Method):
    shares_moments = True


def only_the_first(found):
    first = found[0][0] if isinstance(found[0], tuple) else found[0]
    return first, found[1]


class Motion(js.AbstractMotion):
    how: object = eqx.field(static=True)

    def velocity(self, t, surface, fields, args):
        return self.how(surface.cloud.points)


class Shape(js.AbstractShape):
    surface: js.Discretization
    how: object = eqx.field(static=True)
    again: object = eqx.field(static=True, default=lambda shape: shape)

    def __call__(self, theta):
        return self.how(self.surface.moved(theta * self.surface.cloud.points))

    def rebuilt(self, theta, search=None):
        return self.again(self)


def shaped(
    how=lambda surface: surface, f=lambda surface: jnp.mean(surface.cloud.points**2), **options
):
    shape = Shape(surface(), how, **options)
    return js.optimize_shape(f, shape, 1.0, optimizer=optax.sgd(0.1), steps=1)


def moved(how):
    return js.evolve(Motion(how), js.sphere(80), t1=0.1, method=js.GFDM(degree=2))


def solved(how):
    operator = 1 - parts()[1]
    return js.solve(operator, u0(), preconditioner=Preconditioner(False, how))


def integrated(first=lambda u: parts()[1](u), second=jnp.zeros_like):
    return js.integrate(Problem(None, first, second), u0(), t1=0.1)


def built(**settings):
    return js.laplace_beltrami(js.circle(N), method=Method(**settings))


WRONG = {
    "one entry less": (lambda u: u[:-1], (f"({N - 1},)", f"({N},)")),
    "a column": (lambda u: u[:, None], (f"({N}, 1)", f"({N},)")),
    "a number": (lambda u: 1.0, (f"({N},)",)),
    "None": (lambda u: None, ("None",)),
}
SHAPES = {label: row for label, row in WRONG.items() if label not in ("a number", "None")}
CASES = [
    *(
        Case("AbstractOperator", f"gives {label}", lambda how=how: Operator(how) @ u0(), ("Operator", *words, f"({N},)"))
        for label, (how, words) in WRONG.items()
    ),
    *(
        Case("AbstractOperator", f"gives {label} in a sum", lambda how=how: (Operator(how) - 1)(u0()), ("Operator", *words))
        for label, (how, words) in WRONG.items()
    ),
    *(
        Case("AbstractShape", f"gives {label}", lambda how=how: shaped(how), ("the surface of Shape", "Discretization", word))
        for label, how, word in (("None", lambda s: None, "None"), ("a cloud", lambda s: s.cloud, "PointCloud"), ("two", lambda s: (s, s), "tuple"))
    ),
    Case("AbstractShape", "gives a cloud to be mapped", lambda: js.MappedShape(lambda x, a: a * x, Shape(surface(), lambda s: s.cloud))((1.0, 1.0)), ("the surface of Shape", "Discretization")),
    Case("AbstractShape", "in NumPy", lambda: shaped(lambda s: s.moved(np.asarray(s.cloud.points))), ("Shape needs values", "jax.numpy")),
    Case("AbstractShape", "no shape again", lambda: shaped(again=lambda shape: None), ("Shape.rebuilt", "None")),
    Case("optimize_shape", "an objective of two numbers", lambda: shaped(f=lambda s: (s.areas.sum(), 1.0)), ("objective is a tuple", "jnp.stack")),
    Case("optimize_shape", "an objective that counts", lambda: shaped(f=lambda s: jnp.sum(s.cloud.points > 0)), ("objective is of type int", "slope")),
    Case("AbstractOperator", "no matrix to solve by", lambda: js.solve(Operator(lambda u: u), u0()), ("matrix", "Operator", "to_scipy")),
    Case("AbstractOperator", "no matrix for modes", lambda: js.eigenmodes(Operator(lambda u: u), 2), ("matrix", "Operator", "to_scipy")),
    Case("AbstractOperator", "no diagonal", lambda: js.jacobi(Operator(lambda u: u)), ("diagonal", "Operator")),
    *(
        Case("AbstractPreconditioner", f"gives {label}", lambda how=how: solved(how), ("Preconditioner", *words))
        for label, (how, words) in WRONG.items()
    ),
    *(
        Case("AbstractEvolution", f"linear gives {label}", lambda how=how: integrated(first=how), ("linear of Problem", *words))
        for label, (how, words) in SHAPES.items()
    ),
    *(
        Case("AbstractEvolution", f"rest gives {label}", lambda how=how: integrated(second=how), ("rest of Problem", *words))
        for label, (how, words) in SHAPES.items()
    ),
    Case("AbstractEvolution", "rest gives None", lambda: integrated(second=lambda u: None), ("rest of Problem", "None")),
    Case("AbstractEvolution", "linear gives a number", lambda: integrated(first=lambda u: 0.0), ("linear of Problem", "()", f"({N},)")),
    Case("AbstractEvolution", "linear gives two", lambda: integrated(first=lambda u: (u, u)), ("linear of Problem", "(*, *)")),
    Case("AbstractMotion", "a number per point", lambda: moved(lambda x: x[:, 0]), ("velocity of Motion", "(80,)", "(80, 3)")),
    Case("AbstractMotion", "no velocity", lambda: moved(lambda x: None), ("velocity of Motion", "None")),
    Case("AbstractMotion", "complex velocity", lambda: moved(lambda x: 1j * x), ("velocity of Motion", "complex")),
    Case("AbstractMotion", "text", lambda: moved(lambda x: "fast"), ("velocity of Motion",)),
    Case("AbstractMethod", "weights of too few slots", lambda: built(change=lambda found: (found[0][..., 1:, :], found[1])), ("weights of Method", "(6, 64)", "7, 64")),
    Case("AbstractMethod", "weights without diagnostics", lambda: built(change=lambda found: found[0]), ("weights of Method", "Diagnostics")),
    Case("AbstractMethod", "one operator of two", lambda: js.discretize(js.circle(N), method=Sharing(only_the_first)).laplacian, ("weights of Sharing", "2 arrays", "target.assemble")),
    Case("AbstractMethod", "no neighbours", lambda: built(counts=(0, 3, 64)), ("neighbor_count", "0", "1")),
    Case("AbstractMethod", "half a polynomial", lambda: built(counts=(7, 2.5, 64)), ("basis_size", "2.5")),
    *(
        Case("AbstractMethod", f"polynomials of degree {degree}", lambda degree=degree: js.discretize(js.circle(N), method=Method(degree=degree)), ("polynomial_degree of Method", *words))
        for degree, words in ((0, ("0", "at least 1")), (2.5, ("2.5", "whole number")), ("two", ("'two'", "whole number")))
    ),
    Case("AbstractMethod", "empty blocks", lambda: built(counts=(7, 3, 0)), ("batch_size", "0", "1")),
]  # fmt: skip
