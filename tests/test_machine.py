"""What suits an accelerator gives what suits a CPU gives, whichever machine runs it."""

from __future__ import annotations

import gc
import subprocess
import sys

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


def test_full_collections_of_garbage_wait_and_come_back():
    before = gc.get_threshold()
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
    # Others' threads may come in between: the last one restores what the first one found.
    first, second = compiling.without_full_collections(), compiling.without_full_collections()
    first.__enter__(), second.__enter__(), first.__exit__(None, None, None)
    assert gc.get_threshold()[2] > before[2]
    second.__exit__(None, None, None)
    assert gc.get_threshold() == before
