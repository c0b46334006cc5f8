"""Malformed input to every public function is refused in words that help, or is dealt with."""

import importlib
import pkgutil

import pytest

from . import malformed

CASES = [
    case
    for module in pkgutil.iter_modules(malformed.__path__, "tests.malformed.")
    for case in importlib.import_module(module.name).CASES
]


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
