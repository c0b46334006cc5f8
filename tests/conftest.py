import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxsurf as js

jax.config.update("jax_enable_x64", True)


@pytest.fixture(autouse=True)
def _names_for_doctests(doctest_namespace):
    doctest_namespace.update(js=js, jax=jax, jnp=jnp, np=np)
