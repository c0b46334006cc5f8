"""`js.taylor_remainders` tells right derivatives from wrong ones."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxsurf as js


def off_by(share):
    """A sum of sines with a derivative that is off by this share."""
    f = jax.custom_jvp(lambda x: jnp.sum(jnp.sin(x)))
    f.defjvp(lambda x, v: (f(*x), (1 + share) * jnp.sum(jnp.cos(x[0]) * v[0])))
    return f


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_slopes_of_right_and_wrong_derivatives(dtype):
    """2 if right; 3 where the second derivative vanishes; near 1 for small steps if wrong."""
    x = {"a": jnp.array([0.3, 1.2, -0.7], dtype), "b": [jnp.array(0.5, dtype)]}
    v = {"a": jnp.array([0.5, -1.0, 0.4], dtype), "b": [jnp.array(-0.3, dtype)]}
    right = js.taylor_remainders(lambda x: jnp.sum(jnp.sin(x["a"])) * x["b"][0], x, v)
    assert abs(right.slope - 2) < 0.1, right
    exact = np.cos(np.asarray(x["a"], float)) @ np.asarray(v["a"], float) * 0.5
    exact += np.sin(np.asarray(x["a"], float)).sum() * float(v["b"][0])
    np.testing.assert_allclose(right.derivative, exact, rtol=4 * float(jnp.finfo(dtype).eps))
    expected = {jnp.float64: (1.1e-2, 1.2e-4), jnp.float32: (0.14, 1.8e-2)}[dtype]
    np.testing.assert_allclose(right.steps[[0, -1]], expected, rtol=0.1)
    odd = js.taylor_remainders(jnp.sin, jnp.array(0.0, dtype), jnp.array(1.0, dtype))
    assert odd.slope > 2.8, odd
    share, steps = {jnp.float64: (1e-2, None), jnp.float32: (0.5, jnp.array([0.1, 0.05, 0.02]))}[
        dtype
    ]
    wrong = js.taylor_remainders(off_by(share), x["a"], v["a"], steps=steps)
    assert abs(wrong.slope - 1) < 0.3, wrong


def test_linear_functions_leave_nothing():
    x = jnp.arange(1.0, 5.0)
    assert js.taylor_remainders(lambda x: 1e6 + x @ x[::-1] * 0 + jnp.sum(x), x, x).slope == np.inf


def test_what_it_shows():
    found = js.TaylorRemainders(
        np.array([0.1, 0.01, 0.001]), np.array([1e-3, 1e-5, 3e-9]), 2.5, 1e-8
    )
    assert abs(found.slope - 2) < 1e-12  # the last is round-off
    text = repr(found)
    for part in ("slope 2.00", "derivative 2.5", "1.0e-03 at 1.0e-01", "round-off 1e-08"):
        assert part in text, text
