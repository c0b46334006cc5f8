"""Every public name has an example, and every example runs."""

import builtins
import doctest
import importlib
import inspect
import pkgutil
import re
import symtable

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

import jaxsurf as js

from . import tested

pytestmark = pytest.mark.slow

MODULES = sorted(
    m.name for m in pkgutil.walk_packages(js.__path__, "jaxsurf.") if "__main__" not in m.name
)


@pytest.mark.core
def test_every_public_name_has_an_example():
    public = {
        name: value
        for name, value in vars(js).items()
        if not name.startswith("_") and not inspect.ismodule(value)
    }
    assert len(public) > 80
    without = [name for name, value in public.items() if ">>> " not in (value.__doc__ or "")]
    assert not without


@pytest.mark.core
def test_examples_can_be_copied():
    """They name nothing but what a script has that begins as they do."""
    known = {*vars(builtins), "js", "jax", "jnp", "np", "optax"}
    unknown = {}
    for name, value in vars(js).items():
        if not name.startswith("_") and not inspect.ismodule(value):
            examples = doctest.DocTestParser().get_examples(inspect.getdoc(value))
            code = "".join(example.source for example in examples)
            if missing := global_names(symtable.symtable(code, name, "exec")) - known:
                unknown[name] = missing
    assert not unknown


def global_names(table: symtable.SymbolTable) -> set[str]:
    """Names that a program reads and does not make."""
    made = {symbol.get_name() for symbol in table.get_symbols() if symbol.is_local()}
    read = {symbol.get_name() for symbol in table.get_symbols() if symbol.is_global()}
    return read.union(*map(global_names, table.get_children())) - made


# What has no error of its own: choices, conditions, files, pictures, exact points.
_EXACT = {
    *("choose_neighbors", "allocate_search", "choose_solver", "identity", "sort_cloud"),
    *("dirichlet", "neumann", "robin", "free", "find_border", "detect_boundary"),
    *("read", "read_fields", "write", "plot_cloud", "plot_fields", "plot_series"),
    *("animate", "clean_mesh", "sample_mesh"),
    *("circle", "sphere", "ellipsoid", "graph", "surface_of_revolution", "poisson_disk"),
    *("double_torus", "jacobi", "AbstractEvolution"),
}


@pytest.mark.core
def test_accuracy_in_single_precision_is_stated():
    """Of every function with a test of it, and of solvers and problems in time."""
    kinds = (js.AbstractEvolution, dfx.AbstractSolver)
    rows = {name: row for table in tested.tables().values() for name, row in table.items()}
    public = {
        name: getattr(js, name) for name, row in rows.items() if tested.tests_of(row["float32"])
    }
    asked = {
        name: value.__doc__
        for name, value in public.items()
        if inspect.isfunction(value) or (inspect.isclass(value) and issubclass(value, kinds))
    }
    unsaid = {
        name for name, text in asked.items() if not re.search(r"float32|single\s+precision", text)
    }
    assert len(asked) > 60 and unsaid <= _EXACT, unsaid - _EXACT


@pytest.mark.parametrize("name", MODULES)
def test_examples(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    names = dict(js=js, jax=jax, jnp=jnp, np=np, optax=optax)
    result = doctest.testmod(importlib.import_module(name), extraglobs=names)
    assert result.failed == 0
