"""The table of what every public name is tested for is whole, and its tests exist."""

import ast
import inspect
import re
from pathlib import Path

import pytest

import jaxsurf as js

from . import tested

TABLES = tested.tables()
ROWS = {name: row for table in TABLES.values() for name, row in table.items()}
PUBLIC = sorted(
    name for name, value in vars(js).items() if callable(value) and "Abstract" not in name
)
# Every part has its table.
WHOLE = True


def functions_of(file: Path) -> set[str]:
    nodes = ast.walk(ast.parse(file.read_text()))
    return {n.name for n in nodes if isinstance(n, ast.FunctionDef | ast.ClassDef)}


FILES = {file.name: functions_of(file) for file in Path(__file__).parent.glob("test_*.py")}


@pytest.mark.parametrize("part", TABLES)
def test_rows_are_public_names_of_one_part(part):
    for name in TABLES[part]:
        assert hasattr(js, name), f"{name} is not exported"
        others = [other for other, table in TABLES.items() if name in table and other != part]
        assert not others, f"{name} stands in the tables of {part} and {others}"


@pytest.mark.parametrize("name", ROWS)
def test_every_column_says_something(name):
    unknown = set(ROWS[name]) - set(tested.COLUMNS)
    assert not unknown, f"no such columns: {unknown}"
    absent = [column for column in tested.COLUMNS if column not in ROWS[name]]
    assert not absent, f"{name} says nothing of {absent}"
    empty = [column for column, entry in ROWS[name].items() if not entry]
    assert not empty, f"{name} has nothing for {empty}"
    assert tested.tests_of(ROWS[name]["value"]), f"no test of the value of {name}"


@pytest.mark.parametrize("name", ROWS)
def test_tests_exist(name):
    for column, entry in ROWS[name].items():
        named = tested.tests_of(entry)
        words = [entry] if isinstance(entry, str) else list(entry.values())
        assert named or all(w == "malformed" or w[0] == "(" for w in words), f"{column}: {entry}"
        for test in named:
            file, function = re.sub(r"\[.*", "", test).split("::")
            assert function in FILES.get(file, ()), f"{name}, {column}: there is no {test}"


@pytest.mark.parametrize("name", ROWS)
def test_arguments_that_claim_a_derivative_have_a_test(name):
    """Those are what stands in the docstring's line `Differentiable:` of its parameters."""
    value = getattr(js, name)
    claim = re.search(r"Differentiable:(.*?)(\n\s*[A-Z]\w+:|\Z)", value.__doc__ or "", re.S)
    if claim is None or inspect.isclass(value):
        return
    entry = ROWS[name]["gradient"]
    assert isinstance(entry, dict), f"{name} claims derivatives, its table has {entry}"


def test_every_public_name_has_a_row():
    absent = [name for name in PUBLIC if name not in ROWS]
    assert not (WHOLE and absent), f"not in any table: {absent}"


def test_the_table_can_be_printed():
    lines = tested.markdown().splitlines()
    assert len(lines) == 2 + len(ROWS)
    assert {line.count("|") for line in lines} == {2 + len(tested.COLUMNS)}
