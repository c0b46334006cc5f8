r"""Control of a moving surface: an incompressible flow that takes the sphere to a bean.

Points go with $v(t, x) = \sum_k c_k(t)\,b_k(x)$, where b is a basis of the cubic fields without
divergence and c is linear in time; what is unknown are the coefficients c at both ends. The motion
is `js.evolve`, which carries the work $\int |v|^2 dt$ along the path of each point as a field, and
all is differentiated. No such flow has to reach the target: it is bent along an arc of a circle.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from pathlib import Path

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import optax
import scipy.linalg
from jaxtyping import Array, Float

import jaxsurf as js

from .pictures import descent
from .report import Row

_METHOD, _STEPS = js.GFDM(degree=2), 8
# Half axes across and along of a spheroid as large as the unit sphere, and the radius of the arc.
_ACROSS, _ALONG, _ARC = 0.8, 0.8**-2, 1.5
# Of the work, beside squared distances.
_WEIGHT = 1e-4


def target(x: Float[Array, " 3"]) -> Float[Array, ""]:
    """Level-set function of the bean: a spheroid, its axis an arc. It is as large as the sphere."""
    across = jnp.sqrt((x[0] + _ARC) ** 2 + x[2] ** 2) - _ARC
    along = _ARC * jnp.arctan2(x[2], x[0] + _ARC)
    return (across / _ACROSS) ** 2 + (x[1] / _ACROSS) ** 2 + (along / _ALONG) ** 2 - 1


def distances(x: Float[Array, "n 3"]) -> Float[Array, " n"]:
    r"""From the target, to first order: $\phi / |\nabla\phi|$."""
    phi, slopes = jax.vmap(jax.value_and_grad(target))(x)
    return phi / jnp.linalg.norm(slopes, axis=1)


_POWERS = np.array([p for p in itertools.product(range(4), repeat=3) if sum(p) <= 3])


def monomials(x: Float[Array, "*n 3"]) -> Float[Array, "*n m"]:
    powers = jnp.stack([jnp.ones_like(x), x, x**2, x**3])
    x, y, z = (powers[_POWERS[:, i], ..., i] for i in range(3))
    return jnp.moveaxis(x * y * z, 0, -1)


def solenoidal() -> np.ndarray:
    """A basis of the cubic fields without divergence: coefficients of monomials, `(k, m, 3)`."""
    m = len(_POWERS)
    at = np.random.default_rng(0).normal(size=(2 * m, 3))
    slopes = np.asarray(jax.vmap(jax.jacfwd(monomials))(jnp.asarray(at)))
    return scipy.linalg.null_space(slopes.reshape(2 * m, -1)).T.reshape(-1, m, 3)


_BASIS = solenoidal()


def velocity(t, x: Float[Array, "n 3"], theta: Float[Array, "2 k"]) -> Float[Array, "n 3"]:
    now = (1 - t) * theta[0] + t * theta[1]
    return monomials(x) @ jnp.tensordot(now, _BASIS, axes=1)


class Work(js.AbstractEvolution):
    """What moves a point: its rate is that of the point, whatever becomes of the area."""

    closure: None
    points: Float[Array, "n 3"]

    def linear(self, t, u):
        return jnp.zeros_like(u)

    def rest(self, t, u, args):
        return jnp.sum(velocity(t, self.points, args) ** 2, axis=1)

    def dilution(self, u, divergence):
        return jnp.zeros_like(u)


def flow(surface: js.Discretization, theta, steps: int) -> tuple[js.Discretization, Array]:
    """The surface at the end of the flow, and the work until then."""
    end = js.evolve(
        js.Motion(lambda t, surface, fields, args: velocity(t, surface.cloud.points, args)),
        surface,
        t1=1.0,
        fields=jnp.zeros(surface.n),
        problem=lambda surface: Work(None, surface.cloud.points),
        solver=dfx.Tsit5(),
        dt0=1 / steps,
        args=theta,
    )
    return end.surfaces[-1], end.fields[-1]


class Carried(js.Discretization):
    """A surface that was moved, and what that took at each point."""

    work: Float[Array, " n"] | None = None


class Flow(js.AbstractShape):
    """The surface at the end of the flow, with the neighbours that it was given at its start."""

    surface: js.Discretization

    @eqx.filter_jit
    def __call__(self, theta):
        s, work = flow(self.surface, theta, _STEPS)
        return Carried(s.cloud, s.neighbors, s.method, s.border, s.found_at, s.found, work)


def cost(surface: Carried):
    return jnp.mean(distances(surface.cloud.points) ** 2) + _WEIGHT * jnp.mean(surface.work)


def problem(n: int) -> tuple[Callable, Float[Array, "2 k"]]:
    shape = Flow(js.discretize(js.sphere(n), method=_METHOD))
    theta = 0.05 * np.random.default_rng(0).normal(size=(2, len(_BASIS)))
    return lambda theta: cost(shape(theta)), jnp.asarray(theta)


def _picture(path: Path, start, end, work, history) -> None:
    figure, axes = plt.subplots(1, 3, figsize=(11.5, 3.8), layout="constrained")
    view = (0.5, -2.0, 0.4)
    js.plot_cloud(start.cloud, work, ax=axes[0], title="start", label="work on the way", view=view)
    js.plot_cloud(end.cloud, distances(end.cloud.points), ax=axes[1], title="end", view=view,
                  label="distance from the target")  # fmt: skip
    descent(axes[2], history, {"objective": "objective", "gradient": "gradient"})
    figure.savefig(path, dpi=130)
    plt.close(figure)


def run(quick: bool, out: Path) -> list[Row]:
    n, steps = (400, 12) if quick else (2_000, 150)
    start = js.discretize(js.sphere(n), method=_METHOD)
    theta = jnp.zeros((2, len(_BASIS)))
    found = js.optimize_shape(cost, Flow(start), theta, optimizer=optax.lbfgs(), steps=steps)
    print(found)
    end = found.surface
    f, at = problem(n)
    direction = jnp.asarray(np.random.default_rng(1).normal(size=at.shape))
    taylor = js.taylor_remainders(jax.jit(f), at, direction)
    print(taylor)

    rms = lambda x: float(jnp.sqrt(jnp.mean(x**2)))
    seconds = found.history["seconds"]
    about = {"n": n, "parameters": theta.size, "steps in time": _STEPS}
    rows = [
        Row("distance from the target at the start, rms, in radii of the sphere",
            rms(distances(start.cloud.points)), about),
        Row("distance from the target at the end, rms", rms(distances(end.cloud.points)), about,
            0.0, "project", 1e-2),
        Row("work, mean of the points", float(jnp.mean(end.work)), about),
        Row("slope of the remainders of Taylor, less 2, modulus", abs(taylor.slope - 2), about, 0.0,
            "project", 0.05),
        Row("steps", len(seconds) - 1, about),
        Row("s to the first step, compilation included", float(seconds[1]), about),
        Row("s for a step after that", float(np.median(np.diff(seconds)[1:])), about),
    ]  # fmt: skip
    work = end.work
    if not quick:
        # Other points by shorter steps: they find their neighbours anew on the way.
        start = js.discretize(js.sphere(4 * n), method=js.GFDM(degree=4))
        end, work = flow(start, found.theta, 2 * _STEPS)
        far, again = distances(end.cloud.points), about | {"n": 4 * n, "steps in time": 2 * _STEPS}
        rows += [
            Row("distance of other points from the target, rms", rms(far), again, 0.0, "project",
                1e-2),
            Row("largest distance of other points", float(jnp.abs(far).max()), again),
            Row("volume at the end over that of the sphere, less 1, modulus",
                abs(float(js.volume(end)) / (4 * np.pi / 3) - 1), again, 0.0, "project", 1e-3),
        ]  # fmt: skip
    _picture(out / "control.png", start, end, work, found.history)
    return rows
