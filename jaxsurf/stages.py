"""What a part of a job costs, and what it warns of."""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import jax
import jax.monitoring


@contextmanager
def noted(notes: list[str]) -> Iterator[None]:
    """Collect the package's warnings as notes for the report."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("ignore")
        warnings.simplefilter("always", UserWarning)
        yield
    notes += [str(warning.message) for warning in caught]


@contextmanager
def timed() -> Iterator[Callable[[], tuple[float, float]]]:
    """Seconds spent compiling, and on everything else."""
    spans: list[tuple[float, float]] = []
    begin = time.perf_counter()

    def listen(event: str, duration_secs: float, **_):
        if event.startswith("/jax/core/compile/"):
            now = time.perf_counter()
            spans.append((now - duration_secs, now))

    def spent():
        # Traces within traces are reported each: count the union.
        compiling, last = 0.0, begin
        for first, end in sorted(spans):
            compiling += max(end - max(first, last), 0)
            last = max(last, end)
        return compiling, finish - begin - compiling

    jax.monitoring.register_event_duration_secs_listener(listen)
    try:
        yield spent
    finally:
        jax.monitoring.unregister_event_duration_listener(listen)
        finish = time.perf_counter()
