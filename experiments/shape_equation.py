r"""Axisymmetric vesicles: the shape equation, as a reference for surfaces of least bending energy.

The stationary points of $2\int H^2 dS + \Sigma A + P V$ whose profiles are mirrored at an equator,
of the area of the unit sphere and of a given reduced volume v, the volume over that of the unit
ball. By collocation from a spheroid, along its branch. At them $2\Sigma + P v = 0$, as
$\int H^2 dS$ knows no size, and energies $e = \int H^2 dS / 4\pi$ change by $de/dv = -P / 6$.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.integrate import solve_bvp
from scipy.optimize import brentq


class Profile(NamedTuple):
    """A solution.

    Args:
        v: its reduced volume.
        energy: 1 for the sphere.
        pressure, tension: P and Σ.
        r, z: half the profile, from the pole to the equator.
    """

    v: float
    energy: float
    pressure: float
    tension: float
    r: np.ndarray
    z: np.ndarray


def branch(v: float, axis: float) -> list[Profile]:
    """Those met on the way from a spheroid (1, 1, axis) to v, in steps of about 0.01; v last.

    Angle, its slope, the force of the constraint r' = cos(angle), radius, area and volume along
    the profile; pressure, tension and length are unknown.
    """
    x, y, length, start = _spheroid(axis)
    unknown, found = np.array([0.0, 0.0, length]), []
    for volume in np.linspace(start, v, max(2, round(abs(v - start) / 0.01)))[1:]:
        ends = lambda pole, equator, _, v=volume: _ends(pole, equator, v)
        now = solve_bvp(_rates, ends, x, y, p=unknown, tol=1e-6)
        if not now.success:
            raise RuntimeError(f"no solution of the shape equation at {volume}: {now.message}")
        x, y, unknown = now.x, now.y, now.p
        found.append(_profile(volume, now))
    return found


def equal_energy(low: float, high: float, one: float, other: float) -> float:
    """The reduced volume at which the branches of two spheroids have the same energy."""
    gap = lambda v: branch(v, one)[-1].energy - branch(v, other)[-1].energy
    return float(brentq(gap, low, high, xtol=1e-5))


def _profile(v: float, found) -> Profile:
    at = np.linspace(0, 1, 4_001)
    angle, slope, _, r = found.sol(at)[:4]
    pressure, tension, length = found.p
    curvature = 0.5 * (slope + _around(angle, slope, r))
    sine = np.sin(angle) * length * (at[1] - at[0])
    depth = np.concatenate([[0], np.cumsum(0.5 * (sine[1:] + sine[:-1]))])
    energy = float(np.trapezoid(r * curvature**2, at) * length)
    return Profile(float(v), energy, float(pressure), float(tension), r, depth[-1] - depth)


def _around(angle, slope, r):
    """The curvature around the axis; on the axis both are one."""
    off = r > 1e-7
    return np.where(off, np.sin(angle) / np.where(off, r, 1), slope)


def _rates(at, y, unknown):
    (angle, slope, force, r, *_), (pressure, tension, length) = y, unknown
    around, off = _around(angle, slope, r), r > 1e-7
    bent = (np.cos(angle) * (around - slope) + force * np.sin(angle)) / np.where(off, r, 1)
    return length * np.stack([
        slope,
        np.where(off, bent, 0) + pressure / 2 * r * np.cos(angle),
        0.5 * slope**2 - 0.5 * around**2 + pressure * r * np.sin(angle) + tension,
        np.cos(angle),
        2 * np.pi * r,
        np.pi * r**2 * np.sin(angle),
    ])  # fmt: skip


def _ends(pole, equator, v):
    angle, _, force, _, area, volume = equator
    return np.array([
        *pole[[0, 2, 3, 4, 5]],
        angle - np.pi / 2, force, area - 2 * np.pi, volume - v * 2 * np.pi / 3,
    ])  # fmt: skip


def _spheroid(axis: float):
    """A first guess: places, what is known there, length, reduced volume."""
    u = np.linspace(0, np.pi / 2, 4_001)
    r, z = np.sin(u), axis * np.cos(u)
    sums = lambda f: np.concatenate([[0], np.cumsum(f)])
    s = sums(np.hypot(np.diff(r), np.diff(z)))
    angle = np.arctan2(axis * np.sin(u), np.cos(u))
    area = sums(np.pi * (r[1:] + r[:-1]) * np.diff(s))
    volume = sums(-np.pi / 2 * (r[1:] ** 2 + r[:-1] ** 2) * np.diff(z))
    k = np.sqrt(2 * np.pi / area[-1])
    x = np.linspace(0, 1, 200)
    columns = (angle, np.gradient(angle, s) / k, 0 * s, k * r, k**2 * area, k**3 * volume)
    y = np.stack([np.interp(x * s[-1], s, column) for column in columns])
    return x, y, k * s[-1], volume[-1] * k**3 / (2 * np.pi / 3)
