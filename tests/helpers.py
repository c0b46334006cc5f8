"""What several test files share: clouds, fields with known derivatives, central differences."""

import contextlib

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxsurf as js
from jaxsurf.moving import parts

METHODS = [
    js.DCPSE(order=2),
    js.DCPSE(order=4),
    js.GFDM(degree=2),
    js.GFDM(degree=4),
    js.RBFFD(degree=4),
]
# One of each kind, for what does not hang on the order.
KINDS = [js.DCPSE(order=2), js.GFDM(degree=4), js.RBFFD(degree=4)]


_COUNTS: list[list[str]] = []


def _note_compilation(event, _, **about):
    if event == "/jax/core/compile/backend_compile_duration":
        for names in _COUNTS:
            names.append(str(about.get("fun_name", "?")))


jax.monitoring.register_event_duration_secs_listener(_note_compilation)


@contextlib.contextmanager
def count_compilations():
    """Names of the programs compiled within the block, one entry each: `len(names)` counts them.

    Example:
        >>> with count_compilations() as names:
        ...     laplacian(u)
        >>> assert not names, names
    """
    names: list[str] = []
    _COUNTS.append(names)
    try:
        yield names
    finally:
        _COUNTS.remove(names)


def operations(jaxpr):
    """All of a program, those of the programs in it included."""
    for equation in jaxpr.eqns:
        yield equation
        for part in jax.tree.leaves(equation.params):
            part = getattr(part, "jaxpr", part)
            if hasattr(part, "eqns"):
                yield from operations(part)


def made_in(jaxpr):
    """Shapes and types of all arrays that a program makes."""
    for equation in operations(jaxpr):
        arrays = (v.aval for v in equation.outvars if hasattr(v.aval, "shape"))
        yield from ((a.shape, a.dtype) for a in arrays)


def label(method) -> str:
    number = method.order if isinstance(method, js.DCPSE) else method.degree
    return f"{type(method).__name__}{number}"


def exponential(points, rate=(1.0, 2.0, 1.5)):
    """u = exp(a·x) on the unit sphere with its surface gradient and Laplacian."""
    a = jnp.array(rate)
    s = points @ a
    u = jnp.exp(s)
    gradient = u[:, None] * (a - s[:, None] * points)
    return u, gradient, u * (a @ a - s**2 - 2 * s)


def relative_error(value, exact) -> float:
    return float(jnp.linalg.norm(value - exact) / jnp.linalg.norm(exact))


def central_difference(f, x, direction, step=1e-5):
    """Derivative of f along a direction, by two central differences extrapolated."""

    def difference(h):
        return np.asarray(f(x + h * direction) - f(x - h * direction), float) / (2 * h)

    return (4 * difference(step / 2) - difference(step)) / 3


def check_derivative(f, x, **options):
    """As `check_derivatives` in one argument."""
    check_derivatives(f, x, **options)


def check_derivatives(f, *xs, seed=0, step=1e-5, rtol=1e-6, compiled=True):
    """Forward and reverse derivative in each argument against central differences.

    Two programs are compiled, however many arguments there are and however many values f has: each
    value is checked on its own, and the forward program also gives those at the shifted arguments.
    Or none if not `compiled`: then those that f is made of, which other tests share.
    """
    rng = np.random.default_rng(seed)
    program = jax.jit if compiled else lambda g: g
    push = program(lambda xs, dots: jax.jvp(f, xs, dots))
    pull = program(lambda xs, dots: jax.vjp(f, *xs)[1](dots))
    directions = [jnp.asarray(rng.normal(size=jnp.shape(x))) for x in xs]
    directions = [direction / jnp.linalg.norm(direction) for direction in directions]
    pulled = None
    for i, (x, own) in enumerate(zip(xs, directions)):
        dots = tuple(d if j == i else jnp.zeros_like(d) for j, d in enumerate(directions))
        value, forward = push(xs, dots)
        if pulled is None:
            units = np.eye(value.size).reshape(value.size, *value.shape)
            pulled = [pull(xs, jnp.asarray(unit, value.dtype)) for unit in units]
        reverse = np.reshape([float(jnp.vdot(by[i], own)) for by in pulled], value.shape)
        alone = lambda y, i=i, dots=dots: push((*xs[:i], y, *xs[i + 1 :]), dots)[0]
        expected = central_difference(alone, x, own, step)
        np.testing.assert_allclose(reverse, forward, rtol=1e-9)
        np.testing.assert_allclose(forward, expected, rtol=rtol)


def check_remainders(functionals, surface_of):
    """Of functions of a surface, by name, on an ellipsoid whose axes change: second order alone."""
    axes, direction = jnp.array([1.0, 0.9, 0.8]), jnp.array([0.3, -0.2, 0.4])
    steps = jnp.array([1e-3, 5e-4, 2.5e-4])
    for name, f in functionals.items():
        compiled = jax.jit(lambda axes, f=f: f(surface_of(axes)))
        found = js.taylor_remainders(compiled, axes, direction, steps=steps)
        assert abs(found.slope - 2) < 0.02, (name, found)


def jittered_sphere(n, seed=0, fraction=0.25) -> js.PointCloud:
    """Fibonacci points, each moved within a ball of a fraction of the spacing."""
    points = np.asarray(js.sphere(n).points)
    rng = np.random.default_rng(seed)
    step = rng.normal(size=points.shape)
    step /= np.linalg.norm(step, axis=1, keepdims=True)
    step *= fraction * np.sqrt(4 * np.pi / n) * rng.uniform(size=(n, 1)) ** (1 / 3)
    points = points + step
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    return js.PointCloud(points, points)


def random_sphere(n, seed=0) -> js.PointCloud:
    points = np.random.default_rng(seed).normal(size=(n, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    return js.PointCloud(points, points)


def ring(n=24):
    """Angles, Laplacian and gradient by central differences on a circle, exact eigenvalues."""
    angles = np.arange(n) * 2 * np.pi / n
    h, own = angles[1], np.arange(n)
    near = jnp.asarray(np.stack([own, (own - 1) % n, (own + 1) % n]), jnp.int32)
    laplacian = js.Stencil(near, jnp.tile(jnp.array([[-2.0], [1.0], [1.0]]) / h**2, (1, n)))
    tangents = np.stack([-np.sin(angles), np.cos(angles)])
    slopes = np.array([0.0, -1.0, 1.0])[:, None, None] / (2 * h) * tangents
    return jnp.asarray(angles), laplacian, js.Stencil(near, jnp.asarray(slopes), (2,))


def killed(run, monkeypatch, writes=1):
    """What a run comes to that was killed after so many writes of its file, and went on there."""

    class Killed(Exception):
        pass

    def write_and_die(*content):
        written(*content)
        done.append(True)
        if len(done) == writes:
            raise Killed

    written, done = parts.written, []
    monkeypatch.setattr(parts, "written", write_and_die)
    with pytest.raises(Killed):
        run("killed")
    monkeypatch.undo()
    return run("killed")
