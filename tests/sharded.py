"""Sharded and unsharded runs side by side: `python -m tests.sharded`, on 8 virtual devices.

Prints as JSON how far they differ, and what the compiled programs send between the devices. In a
process of its own, because the number of devices is fixed when JAX starts.
"""

import functools
import json
import math
import re

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, PartitionSpec

import jaxsurf as js
from jaxsurf.sharding import Shards, deal
from jaxsurf.stencils.targets import Laplacian

DEVICES = 8
N = 1_999  # the last device has one point less, and a copy
STEPS = 100
METHOD = js.GFDM(degree=2)

COLLECTIVE = re.compile(
    r"= \(?\w+\[([\d,]*)\]\S* "
    r"(all-\w+(?:-\w+)*|ragged-[\w-]+|collective-[\w-]+|reduce-scatter[\w-]*|send|recv)\("
)


def sent(compiled) -> dict[str, int]:
    """Numbers that a device receives, by operation, each time its program comes to one."""
    total: dict[str, int] = {}
    for shape, name in COLLECTIVE.findall(compiled.as_text()):
        count = math.prod(int(size) for size in shape.split(",") if size)
        total[name] = total.get(name, 0) + count
    return total


def heat(laplacian, u, dt):
    """Explicit Euler steps."""
    return jax.lax.scan(lambda u, _: (u + dt * laplacian(u), None), u, length=STEPS)[0]


def main():
    jax.config.update("jax_enable_x64", True)
    cloud, _ = js.sort_cloud(js.sphere(N))
    surface = js.discretize(cloud, method=METHOD)
    weights = surface.laplacian.weights
    u = jnp.asarray(np.random.default_rng(0).normal(size=N))
    size = float(jnp.abs(weights).sum(axis=0).max())  # in the largest norm

    shards = deal(surface.neighbors, DEVICES)
    rows = shards.rows
    mesh = Mesh(np.array(jax.devices()), (shards.axis,))
    own, columns, everywhere = (
        PartitionSpec(*names) for names in [(shards.axis,), (None, shards.axis), ()]
    )

    def sharded(f, in_specs, out_specs):
        return jax.jit(
            jax.shard_map(f, mesh=mesh, in_specs=in_specs, out_specs=out_specs, check_vma=False)
        )

    def weights_of(shards, points, normals):
        return shards.weights(points, normals, METHOD, Laplacian())

    def steps(shards, weights, u, dt):
        return heat(functools.partial(shards.product, weights), u, dt)

    def whole(u):
        return jax.lax.all_gather(u, shards.axis)

    build = sharded(weights_of, (own, own, own), columns)
    apply = sharded(Shards.product, (own, columns, own), own)
    run = sharded(steps, (own, columns, own, everywhere), own)

    geometry = shards, cloud.points[rows], cloud.normals[rows]
    field = shards, weights[:, rows], u[rows]
    built, applied = build(*geometry), apply(*field)
    dt = jnp.asarray(1 / size)
    start = shards, built, u[rows], dt
    end = run(*start)
    expected = jax.jit(heat)(surface.laplacian, u, dt)

    square = lambda u: jnp.sum(run(shards, built, u[rows], dt)[:N] ** 2)
    expected_square = lambda u: jnp.sum(heat(surface.laplacian, u, dt) ** 2)
    slope, expected_slope = (jax.jit(jax.grad(f))(u) for f in (square, expected_square))

    difference = lambda a, b, scale=1: float(jnp.abs(a - b).max() / scale)
    print(
        json.dumps(
            {
                "devices": len(end.sharding.device_set),
                "own": len(rows) // DEVICES,
                "halo": sum(map(len, shards.send)) // DEVICES,
                "rounds": len(shards.send),
                "weights": difference(built[:, :N], weights, jnp.abs(weights).max()),
                "product": difference(applied[:N], surface.laplacian(u), size),
                "steps": difference(end[:N], expected, jnp.abs(expected).max()),
                "change": difference(expected, u, jnp.abs(u).max()),
                "gradient": difference(slope, expected_slope, jnp.abs(expected_slope).max()),
                "sent": {
                    name: sent(program.lower(*given).compile())
                    for name, program, given in [
                        ("build", build, geometry), ("product", apply, field),
                        ("steps", run, start),
                        ("whole", sharded(whole, own, own), field[2:]),
                    ]
                },
            }
        )
    )  # fmt: skip


if __name__ == "__main__":
    main()
