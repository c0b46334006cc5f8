r"""Solid-body rotation on the sphere: accuracy after a turn, growth and damping in many.

$\partial_t u + \nabla\cdot(v\,u) = 0$ with $v = \omega \times x$ carries a hill around an axis that
is not that of the points; after every turn it is where it was. Central stencils on scattered
points give some eigenvalues with positive real part, which `js.hyperviscosity` moves to the left
(Fornberg and Lehto 2011), at an error of the order $h^5$ for its third power.

Steps of one length: the longest for which the outermost eigenvalue stays within the stability
region of Tsitouras' method, so that the error in time is far below that in space.
"""

from __future__ import annotations

from pathlib import Path

import diffrax as dfx
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from tqdm import tqdm

import jaxsurf as js

from .report import Row, method_name, relative_l2, slope

_AXIS = np.array([0.36, 0.48, 0.8])
_CENTRE = np.array([0.8, -0.6, 0.0])
_TURN = 2 * np.pi
# Tsitouras' method is stable on a half disk of about this radius on the left (its region cuts the
# real axis at -3.5); some room is left.
_REACH = 2.0
_STRENGTH = 0.3


def hill(points) -> np.ndarray:
    return np.exp(-3 * np.sum((points - _CENTRE) ** 2, axis=1))


def rotation(cloud: js.PointCloud, method) -> tuple[js.AdvectionDiffusionReaction, int]:
    """The problem, and how many steps a turn takes."""
    neighbors = js.choose_neighbors(cloud, method=method)
    laplacian = js.laplace_beltrami(cloud, neighbors, method=method)
    outer = js.spectral_estimate(laplacian).radius
    problem = js.AdvectionDiffusionReaction(
        gradient=js.surface_gradient(cloud, neighbors, method=method),
        velocity=jnp.cross(jnp.asarray(_AXIS), cloud.points),
        stabilization=js.hyperviscosity(
            laplacian, 1.0, power=3, strength=_STRENGTH, spectral_radius=outer
        ),
        mass=jnp.ones(cloud.n) / cloud.n,  # the points are spread evenly
    )
    assert problem.advection is not None
    radius = js.spectral_estimate(problem.advection).radius + _STRENGTH * np.sqrt(outer)
    return problem, int(np.ceil(_TURN * radius / _REACH))


def turned(cloud: js.PointCloud, method, turns: int) -> np.ndarray:
    """States after 0, 1, ..., `turns` turns."""
    problem, steps = rotation(cloud, method)
    times = np.linspace(0, turns * _TURN, turns + 1)
    start = jnp.asarray(hill(np.asarray(cloud.points)))
    solution = js.integrate(
        problem, start, t1=times[-1], dt0=_TURN / steps, solver=dfx.Tsit5(),
        saveat=dfx.SaveAt(ts=times),
    )  # fmt: skip
    return np.asarray(solution.ys)


def run(quick: bool, out: Path) -> list[Row]:
    # One turn at every size, many at one of them.
    sizes, long, turns = (
        ([1_000, 2_000], 1_000, 5) if quick else ([1_500, 3_000, 6_000], 3_000, 100)
    )
    orders = {js.DCPSE(order=4): 4} if quick else {js.DCPSE(order=4): 4, js.DCPSE(order=2): 2}
    figure, axes = plt.subplots(1, 4, figsize=(17, 4), layout="constrained")
    rows: list[Row] = []
    spacings = np.sqrt(4 * np.pi / np.array(sizes))
    for method, order in orders.items():
        name = method_name(method)
        errors = []
        for n in tqdm(sizes, desc=f"transport, {name}"):
            cloud = js.sphere(n)
            many = order == 4 and n == long
            states = turned(cloud, method, turns if many else 1)
            errors.append(relative_l2(states[1], states[0]))
            setting = {"method": name, "n": n}
            rows.append(Row("relative l2 error after a turn", errors[-1], setting))
            if many:
                rows += _many_turns(cloud, states, setting | {"turns": turns})
                _draw(axes[1:], cloud, states)
        setting = {"method": name, "n": f"{sizes[0]} to {sizes[-1]}"}
        quantity = "order of the relative l2 error, at least"
        seen = slope(spacings, errors)
        rows.append(Row(quantity, seen, setting, None, "order of the method", order - 0.2, True))
        axes[0].loglog(spacings, errors, "o-", label=name, markersize=4, linewidth=1)
        guide = 0.5 * errors[0] * (spacings / spacings[0]) ** order
        axes[0].loglog(spacings, guide, "k:", linewidth=0.9)
        axes[0].annotate(f"order {order}", (spacings[1], guide[1]), fontsize=8, va="top")
    axes[0].set_xlabel("spacing h")
    axes[0].set_ylabel("relative l2 error after a turn")
    axes[0].set_xticks(spacings, [f"{h:.3f}" for h in spacings])
    axes[0].minorticks_off()
    axes[0].legend(frameon=False)
    figure.savefig(out / "transport.png", dpi=150)
    plt.close(figure)
    return rows


def _many_turns(cloud, states, setting) -> list[Row]:
    start, later = states[0], states[1:]
    norms = np.linalg.norm(later, axis=1) / np.linalg.norm(start)
    masses = states.mean(axis=1)
    # Hundreds of steps to the turn, each with its rounding.
    drift = float(np.abs(masses / masses[0] - 1).max())
    return [
        Row("largest norm after a turn over that at the start", float(norms.max()), setting, 1.0,
            "exact", 1.0),
        Row("change of the mass, relative", drift, setting, 0.0, "round-off", 1e-12),
        Row("largest value after a turn over that at the start",
            float(later.max() / start.max()), setting, 1.0, "exact", 1.0 + 1e-3),
        Row("smallest value", float(later.min()), setting, 0.0, "exact"),
        Row("norm after the last turn over that at the start", float(norms[-1]), setting, 1.0,
            "exact"),
        Row("relative l2 error after the last turn", relative_l2(later[-1], start), setting),
    ]  # fmt: skip


def _draw(axes, cloud, states) -> None:
    turns = len(states) - 1
    axes[0].plot(range(turns + 1), [relative_l2(state, states[0]) for state in states])
    axes[0].set_xlabel("turns")
    axes[0].set_ylabel("relative l2 error")
    axes[0].set_title(f"{cloud.n:,} points", fontsize="medium")
    view = tuple(0.9 * _CENTRE + 0.4 * _AXIS)
    for ax, state, title in zip(axes[1:], states[[0, -1]], ("start", f"after {turns} turns")):
        js.plot_cloud(cloud, state, ax=ax, title=title, view=view, cmap="viridis",
                      limits=(0.0, 1.0))  # fmt: skip
