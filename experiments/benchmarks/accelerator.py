"""What users do with one surface, on JAX's default backend: run on a CPU and on a GPU, compare."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

import jaxsurf as js
from jaxsurf import machine
from jaxsurf.renew import usual_lists

from ..report import relative_l2
from . import motion as moving
from .cases import METHODS, laplacian, sphere
from .timing import first_and_median

_AXIS = np.array([1.0, 2.0, 1.5])


def _timed(call: Callable, repeats: int = 5) -> dict:
    first, seconds = first_and_median(call, repeats)
    return {"first s": first, "s": seconds}


def _field(points):
    """A field on the unit sphere and its Laplacian."""
    s = points @ _AXIS
    return jnp.exp(s), jnp.exp(s) * (_AXIS @ _AXIS - s**2 - 2 * s)


def stencils(name: str, n: int) -> dict:
    """Stencils of the Laplacian, its product with a field, and a gradient in points and normals."""
    method, k = METHODS[name]
    cloud, neighbors = sphere(n, k)
    u, exact = _field(cloud.points)
    of = lambda points, normals: laplacian(js.PointCloud(points, normals), neighbors, method)
    weights = jax.jit(lambda points, normals: of(points, normals).weights)
    energy = jax.jit(lambda points, normals: jnp.mean(of(points, normals)(u) ** 2))
    gradient = jax.jit(jax.grad(energy, argnums=(0, 1)))
    operator, apply = of(cloud.points, cloud.normals), jax.jit(lambda operator, u: operator(u))
    where = cloud.points, cloud.normals
    found = {
        "build": _timed(lambda: weights(*where)),
        "apply": _timed(lambda: apply(operator, u), 20),
        "gradient": _timed(lambda: gradient(*where)),
        "value": _timed(lambda: energy(*where)),
    }
    slope = gradient(*where)[0]
    step = 1e-5 * jnp.sin(cloud.points[:, ::-1] * 3)
    difference = (energy(where[0] + step, where[1]) - energy(where[0] - step, where[1])) / 2
    return found | {
        "error": relative_l2(operator(u), exact),
        "gradient's error": float(abs(jnp.vdot(slope, step) / difference - 1)),
    }


def in_blocks_for_a_cpu(name: str, n: int) -> dict:
    """The same as an accelerator would take it without sizes of its own."""
    machine.ACCELERATOR = machine.CPU._replace(quick=0)
    return stencils(name, n)


def moved(n: int) -> dict:
    """A surface elsewhere, neighbours found anew: its parts."""
    surface = js.discretize(js.sphere(n), method=js.GFDM(degree=2))
    x, search = 1.01 * surface.cloud.points, surface.search()

    def everything(x):
        there = surface.moved(x, search=search)
        return there.laplacian.weights, there.areas, there.code

    fresh = lambda x: js.PointCloud(x, surface.cloud.normals)
    calls = {
        "neighbours": lambda x: usual_lists(search, fresh(x), surface.neighbors)[:2],
        "moved": lambda x: surface.moved(x).laplacian.weights,
        "moved, neighbours anew, areas": everything,
    }
    return {name: _timed(lambda call=jax.jit(call): call(x)) for name, call in calls.items()} | {
        "area's error": abs(float(surface.areas.sum()) / (4 * np.pi) - 1)
    }


def solve(n: int) -> dict:
    """Poisson's equation with multigrid, and the heat equation."""
    surface = js.discretize(js.sphere(n), method=js.GFDM(degree=2))
    z = surface.cloud.points[:, 2]
    multigrid = js.multigrid(surface.laplacian)
    poisson = lambda: js.solve(surface.laplacian, -2 * z, preconditioner=multigrid).value
    problem = js.AdvectionDiffusionReaction(surface.laplacian)
    heat = lambda: js.integrate(problem, z, t1=0.1, rtol=1e-5, atol=1e-6).ys[-1]
    found = {"Poisson": _timed(poisson), "heat": _timed(heat)}
    return found | {
        "Poisson's error": relative_l2(poisson(), z),
        "heat's error": relative_l2(heat(), np.exp(-0.2) * z),
    }


def motion(n: int) -> dict:
    """Heat on the expanding sphere by `js.evolve` to t = 1."""
    found = moving.run(n)
    return {"evolve": {name: found[name] for name in ("first s", "s")}, "error": found["error"]}


def summary(results: list[dict]) -> str:
    """A table in Markdown."""
    where = f"{jax.devices()[0].device_kind}, jax {jax.__version__}, float64"
    lines, errors = [where, "", "| what | first call s | again ms |", "|---|---|---|"], []
    for r in results:
        name = (
            r["case"].partition(".")[2]
            + " "
            + ", ".join(f"{a:,}" if isinstance(a, int) else f"`{a}`" for a in r["arguments"])
        )
        for part, v in r["result"].items():
            if isinstance(v, dict):
                lines.append(f"| {name}: {part} | {v['first s']:.1f} | {1e3 * v['s']:.3g} |")
            else:
                errors.append(f"{name}: {part} {v:.1e}")
    return "\n".join([*lines, "", *errors])


def plan(quick: bool) -> list[tuple[str, list]]:
    n = 10_000 if quick else 100_000
    todo: list[tuple[str, list]] = [("accelerator.stencils", [name, n]) for name in METHODS]
    todo += [("accelerator.in_blocks_for_a_cpu", ["GFDM(degree=2)", n])]
    todo += [(f"accelerator.{name}", [n]) for name in ("moved", "solve")]
    return [*todo, ("accelerator.motion", [n // 3])]
