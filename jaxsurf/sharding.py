r"""Rows dealt out to devices, and the halos that these exchange before they gather.

Every device owns a run of points of the cloud. Its rows read other points too, the halo; before a
gather (`stencils.gathers.take`) these are sent by their owners, and nothing else is:

    shards = deal(surface.neighbors, 8)
    mesh, own = Mesh(jax.devices(), (shards.axis,)), PartitionSpec(shards.axis)
    columns = PartitionSpec(None, shards.axis)
    product = jax.shard_map(Shards.product, mesh=mesh, in_specs=(own, columns, own), out_specs=own,
                            check_vma=False)
    product(shards, weights[:, shards.rows], u[shards.rows])[:n]

(`check_vma=False`, because the sums over slots begin with zeros that belong to no device.)
Not public yet.
"""

from __future__ import annotations

from collections.abc import Iterator

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from .arguments import instance, whole
from .build import stencil_weights
from .cloud import PointCloud
from .failures import needs_values
from .neighbors import Neighbors, Rows
from .stencils.gathers import product, take
from .stencils.method import AbstractMethod
from .stencils.targets import AbstractTarget

Pair = tuple[int, int]  # who sends, who receives


class Shards(eqx.Module):
    r"""The rows of each device, with what it sends; all arrays are split along their first axis.

    Of n points on p devices each has $m = \lceil n/p \rceil$; the last run is filled up with copies
    of the last point, which see what that one sees and so keep its values.

    Args:
        rows: the points whose rows these are, `(p m,)`: `values[rows]` deals values out, and of
            results the first n are those of the cloud.
        neighbors: lists of the rows, `(p m, k)`. They count the values that a device has after
            `exchange`: its own m, behind them those received.
        send: rows of its own that a device sends, in rounds, `(p s,)` each: as many from
            every device in a round.
        pairs: who sends to whom in each round: everyone to one at most, and receives from one.
        axis: name of the mesh's axis.
    """

    rows: Int[Array, " r"]
    neighbors: Rows
    send: tuple[Int[Array, " s"], ...]
    pairs: tuple[tuple[Pair, ...], ...] = eqx.field(static=True)
    axis: str = eqx.field(static=True)

    def exchange(self, values: Float[Array, "m *c"]) -> Float[Array, "h *c"]:
        """Values of a device's points, and behind them those of its halo; under `shard_map`."""
        received = [
            jax.lax.ppermute(take(values, rows), self.axis, pairs)
            for rows, pairs in zip(self.send, self.pairs)
        ]
        return jnp.concatenate([values, *received])

    def weights(
        self,
        points: Float[Array, "m d"],
        normals: Float[Array, "m d"],
        method: AbstractMethod,
        target: AbstractTarget,
    ) -> Float[Array, "k *c m"] | tuple[Float[Array, "k *_ m"], ...]:
        """Weights as of `stencil_weights`, of a device's points; under `shard_map`."""
        around = self.exchange(jnp.concatenate([points, normals], axis=1))
        cloud = PointCloud(*jnp.split(around, 2, axis=1))
        own = np.arange(len(points), dtype=np.int32)
        return stencil_weights(cloud, self.neighbors, method, target, own)[0]

    def product(
        self, weights: Float[Array, "k *w m"], u: Float[Array, "m *c"], contracted: int = 0
    ) -> Float[Array, "m *b"]:
        """A device's rows of the product with a field, see `gathers.product`; under `shard_map`."""
        return product(weights, self.neighbors.indices.T, self.exchange(u), contracted)


def deal(neighbors: Neighbors, devices: int, axis: str = "points") -> Shards:
    """Equal runs of rows for each device, and the plan by which these exchange their halos.

    Args:
        neighbors: lists of the k nearest of points sorted along a curve (`sort_cloud`), so that
            runs are patches with short borders; concrete.
        devices: how many.
        axis: name of the axis of the mesh on which they stand.

    Raises:
        TypeError: no lists, a number of devices that is not whole.
        ValueError: fewer than one device or more than points; lists that are traced, or made with
            a radius, which is not dealt out yet.
    """
    instance(neighbors, Neighbors, "neighbors", "see find_neighbors")
    needs_values("neighbors", neighbors, instead="who reads whom is planned on the host")
    if neighbors.radius is not None:
        raise ValueError("neighbors were found within a radius, expected the k nearest")
    n, k = neighbors.n, neighbors.k
    devices = whole(devices, "devices", least=1, most=n)
    size = -(-n // devices)
    rows = np.minimum(np.arange(devices * size, dtype=np.int32), n - 1)
    read = np.asarray(neighbors.indices)[rows].reshape(devices, -1)
    wanted = _halos(read, size)
    local, end = read % size, size  # of foreign points yet to be found
    plan, send = list(_rounds(wanted)), []
    for pairs in plan:
        width = max(len(wanted[pair]) for pair in pairs)
        sent = np.zeros((devices, width), np.int32)
        for owner, reader in pairs:
            points, theirs = wanted[owner, reader], read[reader] // size == owner
            sent[owner, : len(points)] = points % size
            local[reader, theirs] = end + np.searchsorted(points, read[reader, theirs])
        send.append(jnp.asarray(sent.reshape(-1)))
        end += width
    lists = Rows(jnp.asarray(local.reshape(-1, k)), neighbors.mask[rows])
    return Shards(jnp.asarray(rows), lists, tuple(send), tuple(plan), axis)


def _halos(read: np.ndarray, size: int) -> dict[Pair, np.ndarray]:
    """The points, in ascending order, of an owner that a reader reads."""
    halos = {}
    for reader, points in enumerate(map(np.unique, read)):
        for owner in np.unique(points // size).tolist():
            if owner != reader:
                halos[owner, reader] = points[points // size == owner]
    return halos


def _rounds(wanted: dict[Pair, np.ndarray]) -> Iterator[tuple[Pair, ...]]:
    """Pairs that can exchange at the same time, largest first: all of a round send as much."""
    left = sorted(wanted, key=lambda pair: -len(wanted[pair]))
    while left:
        now: dict[int, int] = {}
        for owner, reader in left:
            if owner not in now and reader not in now.values():
                now[owner] = reader
        yield tuple(now.items())
        left = [(owner, reader) for owner, reader in left if now.get(owner) != reader]
