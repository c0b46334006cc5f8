"""Clocks and memory of one process."""

from __future__ import annotations

import resource
import statistics
import time
from collections.abc import Callable

import jax


def first_and_median(call: Callable, repeats: int = 7) -> tuple[float, float]:
    """Seconds of the first call (compilation included) and the median of the later ones."""
    start = time.perf_counter()
    jax.block_until_ready(call())
    first = time.perf_counter() - start
    seconds = []
    for _ in range(repeats):
        start = time.perf_counter()
        jax.block_until_ready(call())
        seconds.append(time.perf_counter() - start)
    return first, statistics.median(seconds)


def clock(call: Callable) -> float:
    """Seconds by the clock on the wall or of the processor, the fewer.

    A busy machine keeps a process waiting: its own time is then nearer to what it takes alone.
    """
    wall, own = time.perf_counter(), time.process_time()
    jax.block_until_ready(call())
    return min(time.perf_counter() - wall, time.process_time() - own)


def side_by_side(
    ours: Callable, theirs: Callable, repeats: int = 7, calls: int = 1
) -> tuple[float, float, float]:
    """Medians of two calls in turn, and the median of their ratios pair by pair.

    Each measurement is the mean of a number of calls in a row, as an integrator would make them.
    """
    jax.block_until_ready((ours(), theirs()))
    pairs = []
    for _ in range(repeats):
        pair = []
        for call in (ours, theirs):
            start = time.perf_counter()
            for _ in range(calls):
                jax.block_until_ready(call())
            pair.append((time.perf_counter() - start) / calls)
        pairs.append(pair)
    a, b = zip(*pairs)
    ratios = [x / y for x, y in pairs]
    return statistics.median(a), statistics.median(b), statistics.median(ratios)


def peak_gib() -> float:
    """Largest resident memory of this process so far, in GiB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
