"""Every public name has an example, and every example runs."""

import doctest
import importlib
import inspect
import pkgutil

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxsurf as js

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


@pytest.mark.parametrize("name", MODULES)
def test_examples(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    names = dict(js=js, jax=jax, jnp=jnp, np=np)
    result = doctest.testmod(importlib.import_module(name), extraglobs=names)
    assert result.failed == 0
