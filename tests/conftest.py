"""All tests run in float64, with annotations checked, and share one compilation cache.

Of the cache environment variables tell, so that the commands that tests start have it too. Float64
is not among them: those commands must ask for it themselves.

Most of the time of a test is compilation, of programs that run for milliseconds. So they are
not optimised, here and in most experiments that tests start, and little in the notebooks, and
stencils take the form that compiles faster. Some files test the form that users' own programs
have; what runs on several devices is optimised fully.
"""

import gc
import importlib.metadata
import importlib.util
import os
from pathlib import Path

CACHE = Path(__file__).resolve().parents[1] / ".cache" / "jax"
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(CACHE))
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.1")
os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")  # what is loaded from it was tuned: no news
os.environ.setdefault("MPLBACKEND", "Agg")
# Workers share the cores: threads of LAPACK that wait for each other there take most of the time.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
# Workers inherit what is set below by the process that starts them.
os.environ.setdefault("XLA_FLAGS_AS_GIVEN", os.environ.get("XLA_FLAGS", ""))
_as_users = os.environ | {"XLA_FLAGS": os.environ["XLA_FLAGS_AS_GIVEN"], "JAXSURF_QUICKLY": ""}


def _optimised(level: int) -> dict[str, str]:
    """The environment of programs that are optimised little, 1, or not at all, 0."""
    flags = [f"--xla_backend_optimization_level={level}"]
    # In one piece: other processes share the cores. A flag that is unknown ends them all.
    flags.append("--xla_cpu_parallel_codegen_split_count=1")
    if importlib.metadata.version("jaxlib").startswith("0.10."):
        flags.append("--xla_cpu_use_fusion_emitters=false")
    flags.append(_as_users["XLA_FLAGS"])
    return _as_users | {"XLA_FLAGS": " ".join(flags), "JAXSURF_QUICKLY": str(2 - level)}


# Full collections of garbage take a third of the time in which large programs are traced.
gc.set_threshold(100_000, 20, 1_000)
os.environ.update(_optimised(0))

import jax
import pytest
from jaxtyping import install_import_hook

jax.config.update("jax_enable_x64", True)
if importlib.util.find_spec("beartype"):
    from . import annotations  # noqa: F401, named below

    install_import_hook("jaxsurf", "tests.annotations.check")

from jaxsurf import arguments, compiling, failures, machine

# Called so often that checks of them would take longer than those of all others.
for _often in (arguments.is_array, failures.is_concrete, machine.machine):
    _often.__no_type_check__ = True


@pytest.fixture(scope="session")
def environment() -> dict[str, str]:
    """For commands that are compiled as users do."""
    return _as_users


@pytest.fixture(scope="session")
def quick_environment() -> dict[str, str]:
    """For commands that would be compiled for longer than they run."""
    return _optimised(0)


@pytest.fixture(scope="session")
def middle_environment() -> dict[str, str]:
    """For commands that are compiled for about as long as they run."""
    return _optimised(1)


# Files that test stencils in the form that runs faster, as users compile it in programs of theirs.
THOROUGH = (
    "accuracy",
    "cores",
    "gradients",
    "moments",
    "operators",
    "sharding",
    "stability",
)


@pytest.fixture(autouse=True, scope="module")
def _in_the_form_that_compiles_faster(request):
    """Programs that take seconds to compile are run once or twice by a test."""
    thorough = request.module.__name__.removeprefix("tests.test_") in THOROUGH
    token = compiling.quickly.set(not thorough)
    yield
    compiling.quickly.reset(token)


@pytest.fixture(autouse=True, scope="module")
def _forget_compiled_programs():
    """Each file drops its compiled programs, which would add up to gigabytes per worker."""
    yield
    jax.clear_caches()
    gc.collect()


# Files that take longest, which come first: no process is to be left with one of them at the end.
LONGEST = ("experiments_run", "notebooks", "malformed", "gradients", "docstrings", "discretization")


def pytest_collection_modifyitems(items):
    place = {f"test_{name}.py": i for i, name in enumerate(LONGEST)}
    items.sort(key=lambda item: place.get(item.path.name, len(LONGEST)))
