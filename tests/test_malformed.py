"""Malformed input to every public function is refused in words that help, or is dealt with."""

import importlib
import pkgutil
from collections import Counter

import jaxtyping
import pytest

import jaxsurf as js

from . import malformed

# What functions return or raise, and classes to be filled out by users.
MADE_FOR_USERS = (
    {"Diagnostics", "Modes", "IntegrationError", "JacobiPreconditioner", "VCycle"}
    | {
        "Spectrum",
        "Evolution",
        "Inversion",
        "Posterior",
        "Adapted",
        "TaylorRemainders",
        "ShapeOptimization",
        "OptimizationError",
    }
    | {name for name in vars(js) if name.startswith("Abstract")}
)

CASES = [
    case
    for module in pkgutil.iter_modules(malformed.__path__, "tests.malformed.")
    for case in importlib.import_module(module.name).CASES
]


@pytest.fixture(autouse=True, scope="module")
def _own_words():
    """Annotations are not checked here, as they are not for users: the words must be ours."""
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", False)


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.id)
def test_malformed(case):
    if case.right is not None:
        assert case.right(case.call())
        return
    with pytest.raises((ValueError, TypeError)) as caught:
        case.call()
    assert caught.type in (ValueError, TypeError), f"{caught.type.__name__} is not ours"
    missing = [word for word in case.words if word not in str(caught.value)]
    assert not missing, f"no {missing} in: {caught.value}"


def test_no_case_twice():
    names = [case.id for case in CASES]
    assert len(set(names)) == len(names)


PUBLIC = sorted(name for name, value in vars(js).items() if callable(value))
# Every part has its cases.
WHOLE = True


def test_cases_are_about_public_names():
    strange = {case.function for case in CASES if case.function.split(".")[0] not in PUBLIC}
    assert not strange, f"not exported: {strange}"


def test_no_public_name_is_left_out():
    """Three cases at least for each that takes arguments from users."""
    have = Counter(case.function.split(".")[0] for case in CASES)
    few = {name: have[name] for name in PUBLIC if have[name] < 3 and name not in MADE_FOR_USERS}
    assert not (WHOLE and few), f"fewer than three cases: {few}"
    assert not WHOLE or len(CASES) >= 300
