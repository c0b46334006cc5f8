"""Functions as programs: equal if they compute the same, derivatives through what they enclose."""

import subprocess
import sys

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxsurf.failures import without_derivatives
from jaxsurf.functions import canonical, numbers_as_arrays

U = jnp.array([0.3, 0.5, 0.7])


def scaled(factor, power=2):
    return lambda t, u: factor * u**power + t


def test_equal_code_is_one_program_whatever_arrays_it_closes_over():
    one, other = (canonical(scaled(jnp.asarray(k)), 0.5, U) for k in (2.0, 3.0))
    assert one.program == other.program and hash(one.program) == hash(other.program)
    assert repr(one.program) == repr(other.program)
    np.testing.assert_allclose(other(0.5, U), 3 * U**2 + 0.5)
    compiled = eqx.filter_jit(lambda f, u: f(0.5, u))
    compiled(one, U)
    np.testing.assert_allclose(compiled(other, U), 3 * U**2 + 0.5)
    assert compiled._cached._cache_size() == 1


def test_what_nothing_needs_does_not_count():
    """Looks beneath tracers are calls of functions that are new each time."""

    def looked(t, u):
        without_derivatives(u)
        return u**2 + t

    one, other = (canonical(looked, 0.5, U) for _ in range(2))
    assert one.program == other.program
    assert one.program == canonical(lambda t, u: u**2 + t, 0.5, U).program


def ruled(slope):
    """A reaction with a derivative of its own, which closes over a number and an array."""
    factor = jnp.array([slope])

    @jax.custom_jvp
    def cubed(u):
        return u**3

    cubed.defjvp(lambda primals, tangents: (cubed(*primals), factor * tangents[0]))
    return lambda t, u: cubed(u) + jax.nn.relu(u) + t


def test_derivative_rules_are_told_apart_by_what_they_compute():
    """JAX wraps them anew at each call; the same values with another derivative are no equal."""
    one, again, other = (canonical(ruled(slope), 0.5, U).program for slope in (2.0, 2.0, 3.0))
    assert one == again and hash(one) == hash(again) and one != other
    broken = jax.custom_jvp(lambda u: u**3)
    broken.defjvp(lambda primals, tangents: primals[0])
    assert jnp.array_equal(canonical(lambda t, u: broken(u), 0.5, U)(0.5, U), U**3)


def test_other_code_numbers_and_hidden_constants_make_other_programs():
    """Also where the text of the program is the same: constants of inner programs are not in it."""
    first = canonical(scaled(2.0), 0.5, U)
    near = canonical(scaled(np.nextafter(2.0, 3)), 0.5, U)
    assert near.program == first.program and near.constants != first.constants
    for f in (scaled(2.0, 3), lambda t, u: u):
        assert canonical(f, 0.5, U).program != first.program
    weights = [jnp.array([1.0, 2.0, w]) for w in (3.0, 4.0)]
    one, other = (
        canonical(lambda t, u, w=w: jax.jit(lambda u: u * w)(u) + t, 0.5, U) for w in weights
    )
    for f, w in ((one, weights[0]), (other, weights[1])):
        np.testing.assert_allclose(eqx.filter_jit(lambda f, u: f(0.0, u))(f, U), U * w)
    different = [jax.tree.leaves(x.constants) for x in (one, other)]
    assert one.program != other.program or not np.array_equal(different[0][-1], different[1][-1])


def test_rules_of_derivatives_tell_programs_apart():
    def ruled(slope):
        @jax.custom_jvp
        def f(u):
            return u**2

        f.defjvp(lambda primals, tangents: (f(*primals), slope * tangents[0]))
        return canonical(lambda u: f(u), U)

    gradient = eqx.filter_jit(lambda f, u: jax.grad(lambda u: f(u).sum())(u))
    for slope in (2.0, 5.0):
        np.testing.assert_allclose(gradient(ruled(slope), U), slope * jnp.ones(3))


def test_derivatives_and_batches_go_through_what_is_closed_over():
    f = lambda k: canonical(scaled(k), 0.5, U)(0.5, U).sum()
    np.testing.assert_allclose(jax.grad(f)(2.0), float(jnp.sum(U**2)))
    np.testing.assert_allclose(jax.vmap(f)(jnp.array([1.0, 2.0]))[1], f(2.0))
    module = numbers_as_arrays(eqx.nn.Lambda(jax.tree_util.Partial(jnp.multiply, 3.0)))
    np.testing.assert_allclose(canonical(module, U)(U), 3 * U)


def test_numbers_become_weak_arrays_and_nothing_else_changes():
    found = numbers_as_arrays({"a": 0.5, "b": True, "c": "text", "d": np.ones(2, np.float32)})
    assert found["a"].weak_type and found["b"] is True and found["c"] == "text"
    assert found["d"].dtype == jnp.float32


def test_the_name_of_a_program_is_the_same_in_another_process():
    code = """
import jax, jax.numpy as jnp
from jaxsurf.functions import canonical
f = jax.jit(lambda u, w: jnp.sort(jnp.dot(u, w)) + jax.lax.cumsum(u))
print(canonical(lambda u: f(u, jnp.eye(3)), jnp.ones(3)).program)
"""
    path = ":".join(sys.path)
    environment = {"PYTHONHASHSEED": "1", "PYTHONPATH": path, "PATH": "", "HOME": "/tmp"}
    there = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, env=environment
    ).stdout
    with jax.enable_x64(False):
        f = jax.jit(lambda u, w: jnp.sort(jnp.dot(u, w)) + jax.lax.cumsum(u))
        here = canonical(lambda u: f(u, jnp.eye(3)), jnp.ones(3)).program
    assert there.strip() == repr(here)
