r"""A hemisphere is stretched to twice its height and pressed flat (paper 002, Section 3.7.2).

$v = (2\pi\cos(2\pi t)\sin(\pi x/2), 0, 0)$ on the half x >= 0 of the unit sphere, whose border then
rests; the paper does not say which half. On the way of a point
$\tan(\pi x/4)\,e^{-\frac\pi2\sin 2\pi t}$ stays what it was, so that what is on the surface at any
time is known: points are taken back to where they came from, and their mean distance from the unit
sphere there is the location error (eq. 13 at multiples of 0.5, where they are back by themselves).

First of steps of given length, nothing added: the paper's move (eqs. 2 and 3), whose first step is
Euler's, and Tsit5. The paper has order 1 for its own and blames that step, whose error, however, is
of second order and made once: it has order 2. Of order 1 is eq. 3 from the first step on, with the
velocity zero that is there before anything has been stored, so that is shown as well. Then with
points added and merged, which are off the surface by what the local polynomials are.
"""

from __future__ import annotations

import functools
from pathlib import Path

import diffrax as dfx
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import jaxsurf as js

from .report import Row, method_name, slope

_SOURCE = "paper 002, Section 3.7.2"


def _speed(t, x):
    return 2 * jnp.pi * jnp.cos(2 * jnp.pi * t) * jnp.sin(jnp.pi * x / 2)


def _stretching(t, surface, fields, args):
    x = surface.cloud.points[:, 0]
    return jnp.stack([_speed(t, x), 0 * x, 0 * x], axis=1)


def hemisphere(n: int) -> js.PointCloud:
    """The half x >= 0, with its border marked."""
    bowl = js.surface_of_revolution(
        lambda s: (jnp.cos(s), jnp.sin(s)), n, interval=(0.0, np.pi / 2)
    )
    lying = lambda v: jnp.roll(v, 1, axis=1)
    return js.PointCloud(lying(bowl.points), lying(bowl.normals), boundary=bowl.boundary)


def location_error(points, t: float) -> float:
    """Mean distance from the unit sphere of points at time t, taken back to t = 0."""
    x, y, z = np.asarray(points).T
    start = np.tan(np.pi * x / 4) * np.exp(-np.pi / 2 * np.sin(2 * np.pi * t))
    radius = np.sqrt((4 / np.pi * np.arctan(start)) ** 2 + y**2 + z**2)
    return float(np.abs(radius - 1).mean())


def papers_move(points, t1: float, steps: int, falls_back: bool = True):
    """By eq. 3 with steps of one length, the first by eq. 2 if it is to fall back."""
    dt = t1 / steps

    def step(state, t):
        x, before = state
        now = _speed(t, x)
        before = jnp.where((t > 0) | (not falls_back), before, now)
        return (x + dt * now + dt * (now - before) / 2, now), None

    x = points[:, 0]
    (x, _), _ = jax.lax.scan(step, (x, 0 * x), dt * jnp.arange(steps))
    return points.at[:, 0].set(x)


def tsit5(points, t1: float, steps: int):
    term = dfx.ODETerm(lambda t, x, args: _speed(t, x))
    solution = dfx.diffeqsolve(term, dfx.Tsit5(), 0.0, t1, t1 / steps, points[:, 0])
    assert solution.ys is not None
    return points.at[:, 0].set(solution.ys[-1])


def orders(n: int) -> list[Row]:
    """Without added points, at both times."""
    points, rows = hemisphere(n).points, []
    lengths = (0.01, 0.005, 0.0025, 0.00125)
    from_rest = functools.partial(papers_move, falls_back=False)
    moves = (
        ("eq. 3, first step by eq. 2", papers_move, lengths, 1.0, 1.8),
        ("eq. 3, from the velocity zero", from_rest, lengths, 1.0, 0.9),
        ("Tsit5", tsit5, (0.05, 0.025, 0.0125), None, 2.0),
    )
    for name, move, lengths, published, bound in moves:
        for t in (0.5, 1.0):
            errors = []
            for dt in lengths:
                errors.append(location_error(move(points, t, round(t / dt)), t))
                setting = {"move": name, "n": n, "t": t, "step": dt}
                rows.append(Row("location error", errors[-1], setting))
            setting = {"move": name, "n": n, "t": t}
            order = slope(lengths, errors)
            rows.append(
                Row("order, at least", order, setting, published, _SOURCE, bound, at_least=True)
            )
    return rows


def adapted(n: int, method: js.GFDM, times) -> js.Evolution:
    """By Tsit5, with the spacing kept as it was at the start."""
    cloud, spacing = hemisphere(n), float(np.sqrt(2 * np.pi / n))
    # Holes are filled, and pairs merged, before neighbourhoods are much longer than wide.
    adapt = js.Adaptation(spacing, hole=0.75, closest=0.5, capacity=4 * n)
    return js.evolve(
        js.Motion(_stretching),
        cloud,
        t1=times[-1],
        saveat=times[:-1],
        method=method,
        solver=dfx.Tsit5(),
        dt0=0.005,
        adapt=adapt,
    )


def numbers_of_points(path: Path, n: int, solution: js.Evolution) -> None:
    events = solution.events
    number = n + np.cumsum(events["added"] - events["merged"])
    figure, ax = plt.subplots(figsize=(5.2, 3.4), layout="constrained")
    times = np.concatenate([[0.0], events["t"], solution.ts[-1:]])
    ax.step(times, np.concatenate([[n], number, number[-1:]]), where="post")
    ax.set_xlabel("t")
    ax.set_ylabel("number of points")
    figure.savefig(path, dpi=150)
    plt.close(figure)


def run(quick: bool, out: Path) -> list[Row]:
    rows = orders(400 if quick else 4_000)
    n, times = (
        (400, [0.0, 0.09, 0.24]) if quick else (4_000, [0.0, 0.09, 0.24, 0.5, 0.55, 0.75, 1.0])
    )
    method = js.GFDM(degree=2)
    solution = adapted(n, method, times)
    for t, cloud in zip(solution.ts[1:], solution.clouds[1:]):
        setting = {"method": method_name(method), "n": n, "t": float(t)}
        # A spacing to the power of degree + 1, of which added points are off by a part.
        bound = (2 * np.pi / n) ** 1.5
        error = location_error(cloud.points, float(t))
        rows.append(Row("location error, with added points", error, setting, None, "h³", bound))
        rows.append(Row("number of points", cloud.n, setting))
    numbers_of_points(out / "e10_points.png", n, solution)
    js.plot_series(solution.clouds, times=solution.ts, path=out / "e10.png", view=(0.4, -1.7, 0.7))
    return rows
