"""Every public example runs."""

import doctest
import importlib
import pkgutil

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxsurf as js

MODULES = sorted(
    m.name for m in pkgutil.walk_packages(js.__path__, "jaxsurf.") if "__main__" not in m.name
)


@pytest.mark.parametrize("name", MODULES)
def test_examples(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    names = dict(js=js, jax=jax, jnp=jnp, np=np)
    result = doctest.testmod(importlib.import_module(name), extraglobs=names)
    assert result.failed == 0
