"""Every call whose time at the prompt is measured runs, here on few points."""

import jax
import numpy as np
import pytest

from experiments.benchmarks import prompt


@pytest.mark.slow
@pytest.mark.parametrize("name", prompt.CALLS)
def test_calls_that_are_timed_run(name, monkeypatch):
    monkeypatch.setattr(prompt, "N", 300)
    call, *given = prompt.before(name, 300)
    for made in given:
        result = jax.tree.leaves(call(made))
        numbers = [np.asarray(a) for a in result if isinstance(a, jax.Array | np.ndarray)]
        assert all(np.isfinite(a).all() for a in numbers if a.dtype.kind == "f")
