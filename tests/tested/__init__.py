"""What every public name is tested for: one module for each part of the package, joined here.

`python -m tests.tested` prints the table.
"""

from __future__ import annotations

import importlib
import pkgutil

# A test as "file.py::function"; "malformed" for the corpus; where a column makes no sense for the
# name, why, in brackets, as in "(host only: concrete arrays)". No cell is empty.
Entry = str | dict[str, str]
COLUMNS = ("value", "gradient", "jit", "vmap", "float32", "bad input")


def tables() -> dict[str, dict[str, dict[str, Entry]]]:
    """The table of each part, by its name."""
    parts = pkgutil.iter_modules(__path__)
    return {
        part.name: importlib.import_module(f"{__name__}.{part.name}").TESTED
        for part in parts
        if not part.name.startswith("_")
    }


def tests_of(entry: Entry) -> list[str]:
    """The tests that an entry names."""
    if isinstance(entry, dict):
        return [test for part in entry.values() for test in tests_of(part)]
    return [test.strip() for test in entry.split(",") if "::" in test and test[0] != "("]


def markdown() -> str:
    """All tables as one."""

    def cell(entry: Entry) -> str:
        if isinstance(entry, dict):
            return ", ".join(f"{name}: {cell(test)}" for name, test in entry.items())
        return entry.replace(".py::", " ")

    lines = ["| name | " + " | ".join(COLUMNS) + " |", "| --- " * (1 + len(COLUMNS)) + "|"]
    for table in tables().values():
        for name, row in sorted(table.items()):
            cells = [cell(row[column]) for column in COLUMNS]
            lines.append(f"| {name} | " + " | ".join(cells) + " |")
    return "\n".join(lines)
