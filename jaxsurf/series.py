"""A surface and fields on it at several times, as files and pictures are made of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np

from jaxsurf.arguments import instance, on_host
from jaxsurf.cloud import PointCloud
from jaxsurf.failures import raise_at


class Frame(NamedTuple):
    """One of the times.

    Args:
        time: None if none are given.
        cloud: the surface then.
        fields: those then, by name.
    """

    time: float | None
    cloud: PointCloud
    fields: dict[str, Any]


def frames_of(clouds: Any, fields: Mapping[str, Any], times: Any) -> list[Frame]:
    """What there is at each time.

    Args:
        clouds: one for all times, or a sequence of them.
        fields: of each a sequence of arrays, or an array with time first.
        times: `(m,)`, increasing; None for nothing but an order.

    Raises:
        TypeError: other kinds.
        ValueError: other numbers of clouds or fields than of times; times that do not increase.
    """
    fixed = isinstance(clouds, PointCloud)
    counts = {} if fixed else {"clouds": _count(clouds, "clouds", "js.PointCloud")}
    for name, values in fields.items():
        counts[f"field {name!r}"] = _count(values, f"field {name!r}", "arrays, one for each time")
    if times is not None:
        times = on_host(times, "times", ("m",))
        raise_at(~np.isfinite(times), "times are {v} at entry {i}", times)
        raise_at(np.diff(times) <= 0, "times do not increase after {v} (entry {i})", times[:-1])
        counts["times"] = len(times)
    if len(set(counts.values())) > 1:
        told = ", ".join(f"{count} of {name}" for name, count in counts.items())
        raise ValueError(f"expected as many of each, one for each time: {told}")
    count = next(iter(counts.values()), 1)
    if not count:
        raise ValueError("clouds, fields and times have 0 entries, at least 1 is needed")
    frames = []
    for i in range(count):
        cloud = clouds if fixed else clouds[i]
        instance(cloud, PointCloud, f"cloud {i}", "js.PointCloud(points, normals) makes one")
        values = {name: values[i] for name, values in fields.items()}
        frames.append(Frame(None if times is None else float(times[i]), cloud, values))
    return frames


def _count(values: Any, name: str, expected: str) -> int:
    kinds = Sequence | np.ndarray | jax.Array
    if isinstance(values, str) or not isinstance(values, kinds) or getattr(values, "ndim", 1) == 0:
        raise TypeError(f"{name}: a {type(values).__name__}, expected a sequence of {expected}")
    return len(values)
