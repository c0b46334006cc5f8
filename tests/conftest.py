"""All tests run in float64 and share one compilation cache, across workers and runs."""

from pathlib import Path

import jax

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_compilation_cache_dir", str(Path(__file__).parent.parent / ".cache" / "jax"))
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.5)

try:
    import matplotlib

    matplotlib.use("Agg")
except ImportError:
    pass
