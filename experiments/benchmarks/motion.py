r"""A surface that moves: what a move and a step take in units of a build, memory of a gradient.

The steps are the paper's on the expanding sphere (E13 and E14, `e14_steps.first_order`): operators
built, Euler's move of the points, an implicit step of the field.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

import jaxsurf as js
from jaxsurf.motion import carried
from jaxsurf.moving.adaptation import changed
from jaxsurf.renew import usual_lists

from .. import e14_steps
from ..expanding import GROWTH, SIZES, decayed, heat, product
from ..report import relative_l2
from .timing import first_and_median, peak_gib

_STEPS = 20


def plan(quick: bool) -> list[tuple[str, list]]:
    sizes = [SIZES[0.1]] if quick else [SIZES[0.1], SIZES[0.05], 100_000, 300_000]
    n, steps = (1_000, 20) if quick else (10_000, 200)
    todo: list[tuple[str, list]] = [("motion.step", [n]) for n in sizes]
    todo += [("motion.moved", [degree, sizes[0] if quick else SIZES[0.05]]) for degree in (2, 4)]
    todo += [("motion.run", [sizes[0] if quick else SIZES[0.05]])]
    return [*todo, ("motion.gradient", [n, steps, False]), ("motion.gradient", [n, steps, True])]


def _length(n: int) -> float:
    """Of the paper's steps, 0.4 h²: 1,000 to t = 1 at h = 0.05."""
    return 1e-3 * SIZES[0.05] / n


def _sphere(n: int, degree: int = 2):
    """The unit sphere, and what makes it anew at other points with the same normals and lists."""
    surface = js.discretize(js.sphere(n), method=js.GFDM(degree=degree))

    def fresh(x):
        cloud = js.PointCloud(x, surface.cloud.normals)
        return js.Discretization(cloud, surface.neighbors, surface.method)

    return surface, fresh


def moved(degree: int, n: int) -> dict:
    """A moved surface in units of building its Laplacian: all of it, areas alone, and gradients.

    Gradients in the points, of areas outside `jit`, where they are several programs, and in it.
    With the neighbours kept, and found anew: these alone, with all decisions (which need the
    Laplacian) and the normals, and with the areas; and the gradient through all of it.
    """
    surface, fresh = _sphere(n, degree)
    x = 1.01 * surface.cloud.points
    volume = lambda x: jnp.vdot(fresh(x).areas, jnp.sin(x[:, 2]))

    everything_of = lambda there: (there.laplacian.weights, there.areas, there.code)

    def total(x):
        """Of all that a motion changes: operators, normals and areas."""
        there = surface.moved(x, search=search)
        weights, areas, _ = everything_of(there)
        return jnp.vdot(areas, jnp.sin(x[:, 2])) + jnp.mean(weights**2) + there.cloud.normals.std()

    search = surface.search()
    lists = surface.neighbors

    def renewed(x):
        there = surface.moved(x, search=search)
        return there.laplacian.weights, there.neighbors, there.code

    calls = {
        "Laplacian": jax.jit(lambda x: fresh(x).laplacian.weights),
        "neighbours": jax.jit(lambda x: usual_lists(search, fresh(x).cloud, lists)[:2]),
        "neighbours, normals, adaptation, Laplacian": jax.jit(renewed),
        "the same and areas": jax.jit(lambda x: everything_of(surface.moved(x, search=search))),
        "areas": lambda x: fresh(x).areas,
        "areas in jit": jax.jit(lambda x: fresh(x).areas),
        "gradient of areas": jax.grad(volume),
        "gradient of areas in jit": jax.jit(jax.grad(volume)),
        "moved": jax.jit(lambda x: everything_of(surface.moved(x))),
        "gradient of all, neighbours anew": jax.jit(jax.grad(total)),
    }
    found: dict = {}
    for label, call in calls.items():
        first, seconds = first_and_median(lambda call=call: call(x), 5)
        found |= {f"{label} s": seconds, f"{label}, first s": first}
        if label != "Laplacian":
            found[f"{label} / Laplacian"] = seconds / found["Laplacian s"]
    forward = found["the same and areas s"]
    found["reverse / forward"] = found["gradient of all, neighbours anew s"] / forward
    return found


def step(n: int) -> dict:
    """Seconds of a step and of its parts, and those in units of a build of the Laplacian."""
    surface, fresh = _sphere(n)
    x, u, search = surface.cloud.points, product(surface.cloud.points), surface.search()
    gradient, normals = surface.gradient, surface.cloud.normals
    spacing = jnp.full(n, np.sqrt(4 * np.pi / n))
    adapt = js.Adaptation(float(spacing[0]))

    def solved(weights, u):
        implicit = 1 - _length(n) * surface.laplacian.of_weights(weights)
        return js.solve(implicit, u, preconditioner=js.jacobi(implicit), mean_zero=False).value

    parts = {
        "build": jax.jit(lambda x: fresh(x).laplacian.weights),
        "neighbours": jax.jit(lambda x: usual_lists(search, fresh(x).cloud, surface.neighbors)[:2]),
        "normals": jax.jit(lambda x: carried(gradient, normals, x / 1.01, x)),
        "stencils": jax.jit(lambda x: [o.weights for o in fresh(x)._built[:2]]),
        "solve": lambda _: jax.jit(solved)(surface.laplacian.weights, u),
        # Which touches nothing here: what is looked at in vain.
        "adaptation": lambda _: changed(surface, u, adapt, spacing)[2:],
    }
    found = {}
    for name, part in parts.items():
        found[name] = first_and_median(lambda part=part: part(1.01 * x), 5)[1]
    whole = lambda: e14_steps.first_order(surface, _STEPS, _STEPS * _length(n))
    found["step"] = first_and_median(whole, 3)[1] / _STEPS
    return found | {f"{name} / build": s / found["build"] for name, s in found.items()}


def run(n: int) -> dict:
    """Table 2's row of h = 0.05 by `js.evolve`, in steps of fourth order, and what it took."""
    surface, _ = _sphere(n)
    start = product(surface.cloud.points)
    given = dict(fields=start, problem=heat, solver=js.IMEX(order=4), dt0=1 / 32)
    whole = lambda: js.evolve(GROWTH, surface, t1=1.0, **given)  # type: ignore[arg-type]
    ends = []
    first, again = first_and_median(lambda: ends.append(whole()), 1)
    error = relative_l2(ends[-1].fields[-1], decayed(ends[-1].clouds[-1].points, 1.0))
    return {"error": error, "first s": first, "s": again, "peak GiB": peak_gib()}


def gradient(n: int, steps: int, reverse: bool) -> dict:
    """Seconds and peak of a functional of the surface after so many steps, or of its gradient."""
    surface, _ = _sphere(n)

    def after(scale):
        velocity = lambda t, surface, fields, args: args[:, None] * surface.cloud.normals
        end = js.evolve(
            js.Motion(velocity), surface, t1=0.1, args=scale * product(surface.cloud.points),
            dt0=0.1 / steps,
        ).clouds[-1]  # fmt: skip
        return jnp.sum(end.points**4) / n

    function = jax.jit(jax.grad(after) if reverse else after)
    first, seconds = first_and_median(lambda: function(0.1), 1)
    return {"first s": first, "s": seconds, "peak GiB": peak_gib()}


def summary(results: list[dict]) -> str:
    """Tables in Markdown."""
    parts = ("neighbours", "normals", "stencils", "solve", "adaptation", "step")
    lines = ["| n | build s | " + " | ".join(f"{part} / build" for part in parts) + " |"]
    lines += ["|---" * (len(parts) + 2) + "|"]
    of = lambda case: [r for r in results if r["case"] == f"motion.{case}"]
    listed = lambda values: ", ".join(f"{k} {v:.3g}" for k, v in values.items())
    for r in of("step"):
        v = r["result"]
        cells = " | ".join(f"{v[f'{part} / build']:.2f}" for part in parts)
        lines.append(f"| {r['arguments'][0]:,} | {v['build']:.3f} | {cells} |")
    for r in of("moved"):
        degree, n = r["arguments"]
        ratios = {k: v for k, v in r["result"].items() if " / " in k}
        lines += ["", f"moved, GFDM(degree={degree}), n = {n:,}: {listed(ratios)}"]
    for r in of("run"):
        lines += ["", f"E13 at n = {r['arguments'][0]:,}: {listed(r['result'])}"]
    for r in of("gradient"):
        n, steps, reverse = r["arguments"]
        what = f"{'gradient' if reverse else 'value'} after {steps} steps, n = {n:,}"
        lines += ["", f"{what}: {listed(r['result'])}"]
    return "\n".join(lines)
