"""A run in parts, each of which begins with what is on disk after the one before."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ..arguments import is_array
from ..discretization import Discretization
from ..time.checkpoint import Checkpoint, read_back, written


class Place(NamedTuple):
    """What a run goes on from, or what is saved of it.

    Args:
        surface: to go on, where its neighbours were found.
        state: points and fields.
    """

    surface: Discretization
    state: tuple


class Progress(NamedTuple):
    """What is on disk.

    Args:
        part: number of parts done.
        place: at the end of the last.
        saved: at the times asked for; those not reached hold anything.
        counts: steps accepted and refused, and how often neighbours were found anew.
        changes: of the points: times, and what `Evolution.history` tells of them.
    """

    part: Any
    place: Place
    saved: list[Place]
    counts: Any
    changes: Any


class File(NamedTuple):
    """A run on disk: its arrays, after each part."""

    checkpoint: Checkpoint
    key: str

    def read(self, now: Progress, same_sizes: bool) -> tuple[Progress, str]:
        """What is there, and that it is; else what is given."""
        path = Path(self.checkpoint.path)
        if not path.exists():
            return now, ""
        arrays, others = eqx.partition(now, is_array)
        arrays = read_back(path, self.key, arrays, same_sizes=same_sizes)
        return eqx.combine(jax.tree.map(jnp.asarray, arrays), others), "read from disk"

    def write(self, now: Progress) -> None:
        written(Path(self.checkpoint.path), self.key, eqx.filter(now, is_array))


def ends_of(start, end, every: float) -> np.ndarray:
    """Of the parts; a remainder that is nothing but round-off is none of its own."""
    count = max(1, int(np.ceil(float(end - start) / every * (1 - 1e-12))))
    return np.append(start + every * np.arange(1, count), end).astype(end.dtype)
