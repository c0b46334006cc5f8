"""What suits an accelerator gives what suits a CPU gives, whichever machine runs it."""

from __future__ import annotations

import gc
import subprocess
import sys
import threading

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxsurf as js
from jaxsurf import compiling, machine

CLOUD = js.torus(500, 1.0, 0.4)
# Several blocks, also of so few points.
SMALL = machine.ACCELERATOR._replace(points=2, least=1, pairs=2)


def _results():
    surface = js.discretize(CLOUD, method=js.GFDM(degree=2))
    x, search, u = surface.cloud.points, surface.search(), jnp.sin(surface.cloud.points[:, 0])
    lists = jax.jit(lambda x: surface.moved(x, search=search).neighbors)

    def energy(x):
        there = js.Discretization(surface.cloud, surface.neighbors, surface.method).moved(x)
        return jnp.mean(there.laplacian(u) ** 2)

    found = {
        "normals": js.estimate_normals(x),
        "weights": surface.laplacian.weights,
        "areas": surface.areas,
        "field": surface.interpolate(u, 1.001 * x[:50]),
        "radius": js.medial_radius(surface),
        "repulsion": js.tangent_point_energy(surface),
        "lists": lists(1.01 * x),
        "slope": jax.grad(energy)(1.01 * x),
    }
    # As users compile it.
    token = compiling.quickly.set(False)
    found["product"] = surface.laplacian(u), surface.gradient(u)
    compiling.quickly.reset(token)
    return found


@pytest.mark.filterwarnings("ignore:the surface bends")
def test_the_same_in_the_form_for_accelerators(monkeypatch):
    expected = _results()
    jax.clear_caches()
    monkeypatch.setattr(machine, "CPU", SMALL)
    found = _results()
    jax.clear_caches()
    for name, value in expected.items():
        for a, b in zip(jax.tree.leaves(found[name]), jax.tree.leaves(value), strict=True):
            scale = float(np.abs(b).max())
            np.testing.assert_allclose(a, b, rtol=0, atol=1e-9 * scale, err_msg=name)


def test_blocks_hold_more_where_there_is_an_accelerator(monkeypatch):
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    assert machine.machine() is machine.ACCELERATOR
    assert machine.block(100) == 100 * machine.ACCELERATOR.points
    assert machine.block_of_pairs(64) == 64 * machine.ACCELERATOR.pairs


@pytest.mark.parametrize("said, quick", [("1", True), ("0", False)])
def test_the_environment_may_ask_for_the_form_that_compiles_faster(said, quick, environment):
    call = [sys.executable, "-c", "from jaxsurf import compiling; print(compiling.is_quick())"]
    about = environment | {"JAXSURF_QUICKLY": said}
    done = subprocess.run(call, env=about, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == str(quick)


@pytest.mark.parametrize("compiled", [False, True])
def test_what_is_stored_is_the_same_and_has_every_derivative(compiled):
    f = lambda a, never: compiling.stored(a, never) ** 3
    f = jax.jit(f) if compiled else f
    a, never, each = jnp.arange(6.0).reshape(2, 3), jnp.array(False), jnp.zeros(2, bool)
    total = lambda a: f(a, never).sum()
    slope = lambda a: jax.grad(total)(a).sum()
    np.testing.assert_array_equal(f(a, never), a**3)
    for axes, b in (((0, None), never), ((0, 0), each), ((None, 0), each)):
        found = jax.vmap(f, axes)(a, b)
        np.testing.assert_array_equal(found, a**3 if axes[0] == 0 else [a**3, a**3])
    np.testing.assert_array_equal(jax.grad(total)(a), 3 * a**2)
    np.testing.assert_array_equal(jax.grad(slope)(a), 6 * a)
    np.testing.assert_array_equal(jax.jvp(jax.grad(total), (a,), (a,))[1], 6 * a * a)


def _thresholds():
    """Of collections, none of which wait any longer for what was traced before."""
    _wait_no_longer()
    gc.collect()
    return gc.get_threshold()


def _wait_no_longer() -> int:
    young = 0
    while gc.get_threshold()[2] == compiling._NEVER:
        gc.collect(0)
        young += 1
    return young


def test_full_collections_of_garbage_wait_and_come_back():
    before = _thresholds()
    seen = []

    @compiling.sized_jit
    def looks(x):
        seen.append(gc.get_threshold())
        return x

    @compiling.sized_jit
    def fails(x):
        raise RuntimeError

    looks(jnp.ones(3))
    assert [found[2] > before[2] for found in seen] == [True]
    assert seen[0][:2] == before[:2]
    with pytest.raises(RuntimeError):
        fails(jnp.ones(3))
    assert gc.get_threshold() == before


def test_full_collections_wait_for_what_is_transposed_and_come_back():
    before = _thresholds()
    double = compiling.sized_jit(lambda x: 2 * x)
    slope = jax.grad(lambda x: double(x).sum())
    slope(jnp.ones(3))
    assert gc.get_threshold() == (*before[:2], compiling._NEVER)
    assert _wait_no_longer() == -(-compiling._AFTERWARDS // before[0])
    assert gc.get_threshold() == before
    slope(jnp.ones(3))  # not again, until there was one
    assert gc.get_threshold() == before
    gc.collect()
    slope(jnp.ones(3))
    assert gc.get_threshold() != before
    double(jnp.ones(3))  # what is not traced ends it
    assert gc.get_threshold() == before


@pytest.mark.parametrize("given", [(500,), (500, 5), (500, 5, 5)])
def test_thresholds_set_in_between_stay(given):
    before = _thresholds()
    try:
        jax.jit(compiling.sized_jit(lambda x: 2 * x))(jnp.ones(3))
        gc.set_threshold(*given)
        _wait_no_longer()
        assert gc.get_threshold() == (*given, *before[len(given) :])
    finally:
        gc.set_threshold(*before)


def test_thresholds_come_back_after_what_cannot_be_called():
    before = _thresholds()
    with pytest.raises(ValueError, match="key"):
        compiling.sized_jit(lambda d: 1)({1: jnp.ones(2), "a": jnp.ones(2)})
    assert gc.get_threshold() == before


def test_full_collections_wait_for_the_last_of_several_threads():
    before, at, go_on = _thresholds(), threading.Event(), threading.Event()

    def waits(x):
        at.set()
        assert go_on.wait(60)
        return x

    first = threading.Thread(target=compiling.without_full_collections(waits), args=(1,))
    first.start()
    assert at.wait(60)
    compiling.without_full_collections(lambda: None)()
    assert gc.get_threshold()[2] > before[2]
    go_on.set()
    first.join()
    assert gc.get_threshold() == before
