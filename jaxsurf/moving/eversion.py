r"""Surfaces that shrink to nothing, or are turned inside out by steps that went over that."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..discretization import Discretization
from ..failures import warn
from ..interpolation import distance_and_reach
from ..time.integrate import IntegrationError

# Of the volume over that of all cones from the middle, one on spheres: less, of thin bodies, is not
# told by weights as rough as these.
_SURE = 0.1
# Of the sum of the normals over that of their lengths, zero where a surface is closed.
_CLOSED = 0.1
# A surface that has shrunk to this share of its size when no step is short enough vanishes.
_VANISHED = 0.01


def tell_eversion(start: Discretization, t0, ts, surfaces: Sequence[Discretization]) -> None:
    """Warn at the first time at which normals point to the other side than at the start.

    What passes through a point, or through itself, is as smooth after as before: where no step
    ends on the moment between, nothing else shows it.
    """
    before = _inside(start)
    for t, surface in zip(ts, surfaces):
        if before * (now := _inside(surface)) < 0 and min(abs(before), abs(now)) > _SURE:
            warn(
                f"the surface is inside out at t = {float(t):g}: since t = {float(t0):g} it has "
                "gone through itself, and its normals point to the other side. End before that; "
                "or pass adapt= and contact=, which take away what has shrunk to a spacing"
            )
            return


def _inside(surface: Discretization) -> float:
    """About the volume inside, in units of the cones from the middle; 0 if it is not closed."""
    cloud, on = surface.cloud, surface.cloud.host_active
    x, n = (np.asarray(a, float)[on] for a in (cloud.points, cloud.normals))
    _, reach = distance_and_reach(cloud, surface.neighbors, cloud.points, np.arange(cloud.n))
    share = np.asarray(reach, float)[on] ** (cloud.dim - 1)
    x -= np.average(x, axis=0, weights=share)
    if np.linalg.norm(share @ n) > _CLOSED * share.sum():
        return 0.0
    return float(share @ np.sum(x * n, axis=1) / (share @ np.linalg.norm(x, axis=1)))


def told_extinction(start: Discretization, error: IntegrationError) -> IntegrationError:
    """The error of a run, which says so if the surface has shrunk to nothing."""
    share = _size(error.state[0], start) / _size(start.cloud.points, start)
    if not share < _VANISHED:
        return error
    text = (
        f"{error}. The surface has shrunk to {share:.1g} of its size: it vanishes at about that "
        "time. End before that, or pass adapt= and contact=, which take away what has shrunk to a "
        "spacing"
    )
    return IntegrationError(text, error.solution, error.time, error.state)


def _size(points, start: Discretization) -> float:
    """Root mean square of the distances from the middle."""
    x = np.asarray(points, float)[start.cloud.host_active]
    return float(np.sqrt(np.mean(np.sum((x - x.mean(axis=0)) ** 2, axis=1))))
