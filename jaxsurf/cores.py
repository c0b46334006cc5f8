"""Programs side by side: a loop over blocks runs on one core, so that each core is given parts.

Only programs that call no library: jaxlib's LAPACK waits in a thread of a pool for other threads
of that pool, and two programs may take them all from each other, for ever.
"""

from __future__ import annotations

import contextvars
import os
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor

import jax
import jax.numpy as jnp
import numpy as np

from .machine import PART, machine

# What runs outside of what XLA compiles.
_OUTSIDE = {*dir(jax.lax.linalg), "geqrf", "ffi_call", "pure_callback", "io_callback"}


def count_cores() -> int:
    """That programs may be divided among; 1 on accelerators."""
    if not machine().divides:
        return 1
    # Those that this process may use, where the system tells.
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def divided(count: int, size: int, numbers: int) -> list[np.ndarray]:
    """Places of rows, divided among the cores: equally many in each part, in whole blocks.

    Each core is given several parts where there are many rows: what is read for a part is soon let
    go, and its memory is used again.

    The last of them may be repeated.

    Args:
        numbers: given to a program for each row; few are left in one piece.
    """
    cores = min(count_cores(), count * numbers // (2 * machine().quick or 1))
    parts = cores * max(count * numbers // (PART * max(cores, 1)), 1)
    each = -(-count // (max(parts, 1) * size)) * size
    starts = range(0, count, each) if cores > 1 else [0]
    return [np.minimum(np.arange(i, i + each), count - 1) for i in starts]


def side_by_side(f: Callable, parts: list) -> list:
    """f of each, in threads."""
    wide = jnp.result_type(float) == jnp.float64  # each thread has settings of its own

    def call(part, context):
        with jax.enable_x64(wide):
            return context.run(lambda: jax.block_until_ready(f(part)))

    contexts = [contextvars.copy_context() for _ in parts]
    with ThreadPoolExecutor(min(len(parts), count_cores())) as threads:
        return list(threads.map(call, parts, contexts))


def calls_library(program: jax.core.Jaxpr) -> bool:
    """Whether a program does not run in what XLA compiles alone."""
    return any(
        equation.primitive.name in _OUTSIDE or any(map(calls_library, _within(equation.params)))
        for equation in program.eqns
    )


def _within(params: dict) -> Iterator[jax.core.Jaxpr]:
    """Programs among what belongs to an operation."""
    for leaf in jax.tree.leaves(params):
        leaf = getattr(leaf, "jaxpr", leaf)
        if hasattr(leaf, "eqns"):
            yield leaf
