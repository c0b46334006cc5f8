r"""Mean curvature flow of surfaces of revolution by their profiles, as a reference.

The profile x(u) = (r, z) is a closed curve, of N points with spectral derivatives; one that meets
the axis is continued by its mirror image (r odd, z even), and is smooth there. With n outward

$\dot x = \tfrac12 x_{uu}/|x_u|^2 - \tfrac12 (n_r/r)\,n + \bar H\,n$,

where the first term is the curvature of the profile and a tangential motion that keeps points even,
and the last keeps the enclosed volume, if asked for. In time by BDF to 1e-10.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy.integrate import solve_ivp

import jaxsurf as js


class Profile(NamedTuple):
    """A profile over time.

    Args:
        end: when its narrowest place is as narrow as asked for.
        at: from a time to r and z, `(N,)` each.
    """

    end: float
    at: Callable[[float], tuple[np.ndarray, np.ndarray]]


def flow(
    r: np.ndarray,
    z: np.ndarray,
    *,
    until: float,
    narrow: float,
    at: int,
    keep_volume: bool = False,
) -> Profile:
    """From N points, evenly spaced in u, until r at one of them is as small as `narrow`."""
    count = len(r)
    # Outward: the area that r n_r has is positive.
    side = np.sign(np.sum(r * _derivative(z)))

    def rate(t, state):
        r, z = state.reshape(2, count)
        first = np.stack([_derivative(r), _derivative(z)])
        second = np.stack([_derivative(first[0]), _derivative(first[1])])
        length = np.hypot(*first)
        normal = side * np.stack([first[1], -first[0]]) / length
        around = normal[0] / r
        if not keep_volume:
            return (0.5 * second / length**2 - 0.5 * around * normal).ravel()
        curvature = 0.5 * (around - np.sum(second * normal, axis=0) / length**2)
        area = np.abs(r) * length
        mean = np.sum(curvature * area) / np.sum(area)
        return (0.5 * second / length**2 + (mean - 0.5 * around) * normal).ravel()

    def reached(t, state):
        return state[at] - narrow

    reached.terminal = True  # type: ignore[attr-defined]
    start = np.concatenate([r, z])
    given = dict(method="BDF", rtol=1e-10, atol=1e-12, dense_output=True, events=reached)
    found = solve_ivp(rate, (0.0, until), start, **given)
    return Profile(float(found.t[-1]), lambda t: tuple(found.sol(t).reshape(2, count)))


def closing(profile: Profile, at: int) -> float:
    """When r at a point vanishes: near that its square falls evenly, as that of a cylinder does."""
    narrow, before = (profile.at(t)[0][at] ** 2 for t in (profile.end, profile.end - 1e-3))
    return profile.end + 1e-3 * narrow / (before - narrow)


def _derivative(values: np.ndarray) -> np.ndarray:
    n = len(values)
    wave = np.fft.rfftfreq(n, 1 / n)
    wave[-1] = 0 if n % 2 == 0 else wave[-1]
    return np.fft.irfft(1j * wave * np.fft.rfft(values), n)


def angles(count: int, shift: float = 0.0) -> np.ndarray:
    return 2 * np.pi * (np.arange(count) + shift) / count


def narrowest(surface: js.Discretization, count: int = 8) -> float:
    """Distance from the axis at z = 0, by the local polynomials at the points next to there.

    What is read off is a little beside that plane, where the distance is off by the square of that.
    """
    x = np.asarray(surface.cloud.points)
    nearest = np.argsort(np.linalg.norm(x, axis=1))[:count]
    found = surface.interpolate(surface.cloud.points, x[nearest] * np.array([1.0, 1.0, 0.0]))
    return float(np.mean(np.hypot(*np.asarray(found)[:, :2].T)))


def nearest_on(profile: tuple[np.ndarray, np.ndarray], points) -> tuple[np.ndarray, ...]:
    """The nearest points of the surface of a profile, the outward normals and H there.

    Of a convex profile that meets the axis, with points off the axis; by Newton's method from the
    nearest of many points of the profile.
    """
    curve = np.fft.rfft(np.stack(profile), axis=1) / len(profile[0])
    curve[:, 1:] *= 2
    waves = np.arange(curve.shape[1])

    def at(u, order=0):
        return np.real((curve * (1j * waves) ** order) @ np.exp(1j * np.outer(waves, u)))

    x = np.asarray(points)
    radius = np.hypot(x[:, 0], x[:, 1])
    target = np.stack([radius, x[:, 2]])
    fine = angles(16 * len(profile[0]))
    places = at(fine)
    u = fine[np.argmin(np.sum((target[:, :, None] - places[:, None]) ** 2, axis=0), axis=1)]
    for _ in range(6):
        away, first, second = at(u) - target, at(u, 1), at(u, 2)
        u = u - np.sum(away * first, 0) / np.sum(first**2 + away * second, 0)
    (r, z), first, second = at(u), at(u, 1), at(u, 2)
    length = np.hypot(*first)
    normal = np.stack([first[1], -first[0]]) / length
    normal *= np.sign(np.sum(normal * (at(u) - places.mean(1, keepdims=True)), axis=0))
    curvature = 0.5 * (normal[0] / r - np.sum(second * normal, axis=0) / length**2)
    around = x[:, :2] / radius[:, None]
    in_space = lambda pair: np.concatenate([around * pair[0][:, None], pair[1][:, None]], axis=1)
    return in_space((r, z)), in_space(normal), curvature
