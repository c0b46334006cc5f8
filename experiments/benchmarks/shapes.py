"""Objectives of shapes: one value, one gradient, both compiled, and differences beside them."""

from __future__ import annotations

import importlib
import time
import warnings

import jax
import jax.numpy as jnp
import numpy as np

from ..__main__ import EXPERIMENTS
from .timing import first_and_median, peak_gib, side_by_side

# Number of points that each is measured with, and in the quick form; None for a bar of its own.
SIZES = {
    "isoperimetric": (2_000, 600),
    "hear-the-shape": (3_000, 800),
    "hot-spot": (2_000, 600),
    "control": (1_000, 300),
    "neural-bunny": (4_000, 4_000),
    "conductivity": (4_000, 1_000),
    "vesicles": (1_500, 600),
    "extremal-eigenvalue": (2_000, 600),
}
_STEP = 1e-4
# Seconds of measuring, nearly.
_LONG = 10


def plan(quick: bool) -> list[tuple[str, list]]:
    todo = [("shapes.measured", [name, sizes[quick]]) for name, sizes in SIZES.items()]
    large = 10_000 if quick else 100_000
    return [*todo, ("shapes.measured", ["isoperimetric", large]), ("shapes.whole", [large])]


def whole(n: int) -> dict:
    """The isoperimetric search from its first call to its end, in a process of its own."""
    warnings.simplefilter("ignore")
    from .. import isoperimetric

    start = time.perf_counter()
    _, found, way = isoperimetric.minimised(n)
    seconds = time.perf_counter() - start
    area, volume = isoperimetric.exact(way[-1])
    return {
        "seconds": seconds,
        "steps": len(way) - 1,
        "peak GiB": peak_gib(),
        "area over the least, less 1": area / (36 * np.pi * volume**2) ** (1 / 3) - 1,
        "converged": found.converged,
    }


def measured(name: str, n: int) -> dict:
    """Seconds, memory and agreement of one objective, in a process of its own."""
    warnings.simplefilter("ignore")
    module = importlib.import_module(f"experiments.{EXPERIMENTS[name][0]}")
    f, theta = module.problem(n)
    rng = np.random.default_rng(0)
    found = {"unknowns": sum(np.size(leaf) for leaf in jax.tree.leaves(theta))}
    programs = {}
    for key, function in (("value", f), ("gradient", jax.value_and_grad(f))):
        start = time.perf_counter()
        programs[key] = program = jax.jit(function).lower(theta).compile()
        found[f"{key} compiled s"] = time.perf_counter() - start
        found[f"{key} temporary GiB"] = program.memory_analysis().temp_size_in_bytes / 2**30
    value, gradient = ((lambda program=program: program(theta)) for program in programs.values())
    # Short ones more often: five of them did not tell 2.7 from 4.8.
    rounds = int(np.clip(_LONG / first_and_median(gradient, 1)[1], 5, 50))
    found["gradient s"], found["value s"], found["ratio"] = side_by_side(gradient, value, rounds)
    _, gradient = programs["gradient"](theta)
    # Along the gradient and something else, so that the derivative is not near zero by chance.
    size = lambda tree: float(
        np.sqrt(sum(np.sum(np.square(leaf)) for leaf in jax.tree.leaves(tree)))
    )
    steep, large = size(gradient), max(size(theta), 1e-3)
    noise = jax.tree.map(lambda g: jnp.asarray(rng.normal(size=np.shape(g))), gradient)
    both = lambda g, v: large * (g / steep + 0.3 * v / size(noise))
    direction = jax.tree.map(both, gradient, noise)
    along = sum(float(jnp.vdot(a, b)) for a, b in zip(*map(jax.tree.leaves, (gradient, direction))))

    def difference(h):
        at = lambda s: programs["value"](jax.tree.map(lambda t, v: t + s * v, theta, direction))
        return float(at(h) - at(-h)) / (2 * h)

    wanted = (4 * difference(_STEP / 2) - difference(_STEP)) / 3
    return found | {"off": abs(along / wanted - 1), "peak GiB": peak_gib()}


def table(results: list[dict]) -> str:
    """The Markdown table that the README quotes."""
    lines = [
        "| objective | n | unknowns | value s | gradient s | / value | value, gradient compiled s "
        "| peak GiB | off differences | these would take s |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    for r in results:
        if r["case"] == "shapes.whole":
            continue
        (name, n), v = r["arguments"], r["result"]
        lines.append(
            f"| `{name}` | {n:,} | {v['unknowns']:,} | {v['value s']:.3g} | {v['gradient s']:.3g} "
            f"| {v['ratio']:.1f} "
            f"| {v['value compiled s']:.1f}, {v['gradient compiled s']:.1f} "
            f"| {v['peak GiB']:.2f} | {v['off']:.0e} "
            f"| {2 * v['unknowns'] * v['value s']:.3g} |"
        )
    end = next(r for r in results if r["case"] == "shapes.whole")
    (n,), v = end["arguments"], end["result"]
    lines += [
        "",
        f"The whole of `isoperimetric` with n = {n:,}, compilation included: {v['seconds']:.0f} s, "
        f"{v['steps']} steps, {v['peak GiB']:.1f} GiB, area {v['area over the least, less 1']:.0e} "
        "above the least.",
    ]
    return "\n".join(lines)
