"""Points dealt out to devices: the same results, and only halos between them."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import jaxsurf as js
from jaxsurf.sharding import deal

ROOT = Path(__file__).resolve().parents[1]
DEVICES, N = 8, 1_999  # of `sharded`
COORDINATES = 3 + 3  # of a point and its normal


@pytest.fixture(scope="module")
def found(environment):
    """What `python -m tests.sharded` prints."""
    flags = f"{environment.get('XLA_FLAGS', '')} --xla_force_host_platform_device_count={DEVICES}"
    environment = environment | {"XLA_FLAGS": flags, "JAX_PLATFORMS": "cpu"}
    call = [sys.executable, "-m", "tests.sharded"]
    done = subprocess.run(call, cwd=ROOT, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])


def test_same_as_on_one_device(found):
    assert found["devices"] == DEVICES
    assert found["weights"] < 1e-12
    assert found["product"] < 1e-14
    assert found["change"] > 0.5  # there was something to compute
    assert found["steps"] < 1e-12
    assert found["gradient"] < 1e-12


def test_only_halos_are_sent(found):
    """Counted in the compiled programs; the steps are a loop, and what it sends is sent in each."""
    own, halo, sent = found["own"], found["halo"], found["sent"]
    assert own == 250 and halo < N // 4
    assert sent["product"] == {"collective-permute": halo}
    assert sent["steps"] == {"collective-permute": halo}
    assert sent["build"] == {"collective-permute": COORDINATES * halo}
    assert sent["whole"] == {"all-gather": DEVICES * own}  # this would be seen


def exchanged(shards, devices, values):
    """What every device has after an exchange, `(devices, m + halo)`, on the host."""
    own = values[np.asarray(shards.rows)].reshape(devices, -1)
    parts = [own]
    for rows, pairs in zip(shards.send, shards.pairs):
        rows = np.asarray(rows).reshape(devices, -1)
        part = np.full(rows.shape, np.nan)
        for owner, reader in pairs:
            part[reader] = own[owner][rows[owner]]
        parts.append(part)
    return np.concatenate(parts, axis=1)


@pytest.mark.parametrize("n, devices", [(300, 1), (300, 3), (301, 8), (61, 60)])
def test_rows_read_what_they_read_on_one_device(n, devices):
    """Also in runs that are filled up with copies, of which with 60 devices there are many."""
    cloud, _ = js.sort_cloud(js.sphere(n))
    neighbors = js.find_neighbors(cloud, k=12)
    shards = deal(neighbors, devices)
    values = np.random.default_rng(0).normal(size=n)
    around = exchanged(shards, devices, values)
    local = np.asarray(shards.neighbors.indices).reshape(devices, -1)
    rows = np.asarray(shards.rows)
    assert np.array_equal(rows[:n], np.arange(n))
    wanted = values[np.asarray(neighbors.indices)[rows]]
    assert np.array_equal(np.take_along_axis(around, local, 1).ravel(), wanted.ravel())
    for pairs in shards.pairs:
        owners, readers = zip(*pairs)
        assert len(set(owners)) == len(owners) and len(set(readers)) == len(readers)


def test_halos_grow_like_borders():
    """Four times as many points: patches have twice as long borders."""

    def halo(n):
        cloud, _ = js.sort_cloud(js.sphere(n))
        shards = deal(js.find_neighbors(cloud, k=36), DEVICES)
        return sum(map(len, shards.send)) / DEVICES

    assert 1.6 < halo(16_000) / halo(4_000) < 2.4


def test_what_cannot_be_dealt_out():
    cloud = js.sphere(100)
    neighbors = js.find_neighbors(cloud, k=12)
    with pytest.raises(TypeError, match="neighbors is a PointCloud"):
        deal(cloud, 2)
    with pytest.raises(ValueError, match="within a radius"):
        deal(js.find_neighbors(cloud, radius=0.6), 2)
    with pytest.raises(ValueError, match="devices"):
        deal(neighbors, 101)
    with pytest.raises(ValueError, match="devices"):
        deal(neighbors, 0)
