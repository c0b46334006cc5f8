r"""Waves with a source on the expanding sphere (paper 002, Section 4.2.4, Table 4).

The relative l2 error at t = 1 of sin(sqrt(6) t) x y, a solution of eq. 42 with the forcing that
follows from it. Integrated so accurately that the errors are those of space.
"""

from __future__ import annotations

import math
from pathlib import Path

import jax.numpy as jnp
import numpy as np
from tqdm import tqdm

import jaxsurf as js

from .expanding import GROWTH, SIZES, product, radius
from .report import Row, method_name, relative_l2, slope

_PAPER = {0.4: 7.88e-3, 0.2: 1.96e-3, 0.1: 4.90e-4, 0.05: 1.23e-4}
_RATE = math.sqrt(6)


def wave(surface: js.Discretization) -> js.WaveEquation:
    """Its forcing makes up for what sin(sqrt(6) t) x y leaves of eq. 42."""
    shape = product(surface.cloud.points)

    def forcing(t, u, args):
        r, sine, cosine = radius(t), jnp.sin(_RATE * t), jnp.cos(_RATE * t)
        return ((7.5 / r**2 - _RATE**2) * sine + 3 * _RATE / r * cosine) * shape

    return js.WaveEquation(surface.laplacian, forcing=forcing)


def error(n: int, method: js.DCPSE | js.GFDM) -> float:
    surface = js.discretize(js.sphere(n), method=method)
    shape = product(surface.cloud.points)
    run = js.evolve(
        GROWTH, surface, t1=1.0, fields=(jnp.zeros(n), _RATE * shape), problem=wave,
        rtol=1e-7, atol=1e-9,
    )  # fmt: skip
    exact = math.sin(_RATE) * product(run.clouds[-1].points)
    return relative_l2(run.fields[-1][0], exact)


def run(quick: bool, out: Path) -> list[Row]:
    spacings = [0.4] if quick else list(_PAPER)
    methods = [js.GFDM(degree=2)] if quick else [js.GFDM(degree=2), js.GFDM(degree=4)]
    source = "paper 002, Table 4"
    rows: list[Row] = []
    for method in methods:
        errors = []
        for h in tqdm(spacings, desc=f"E18, {method_name(method)}"):
            errors.append(error(SIZES[h], method))
            setting = {"method": method_name(method), "h": h, "n": SIZES[h]}
            rows.append(
                Row("relative l2 error at t = 1", errors[-1], setting, _PAPER[h], source, _PAPER[h])
            )
        if quick:
            continue
        setting = {"method": method_name(method), "h": f"{spacings[0]} to {spacings[-1]}"}
        sizes = np.array([SIZES[h] for h in spacings])
        seen = slope(sizes**-0.5, errors)
        rows.append(
            Row("order of that error, at least", seen, setting, 2.0, source, 2.0, at_least=True)
        )
    return rows
