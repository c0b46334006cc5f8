"""All tests run in float64 and share one compilation cache, across workers and runs."""

from pathlib import Path

import jax
import pytest

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_compilation_cache_dir", str(Path(__file__).parent.parent / ".cache" / "jax"))
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.5)

try:
    import matplotlib

    matplotlib.use("Agg")
except ImportError:
    pass


@pytest.fixture(autouse=True, scope="module")
def _forget_compiled_programs():
    """Each file drops its compiled programs, which would add up to gigabytes per worker."""
    yield
    jax.clear_caches()
