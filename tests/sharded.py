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

# A result, or several in parentheses, and the operation between devices.
COLLECTIVE = re.compile(
    r"= (\([^()]*\)|\S+) "
    r"(all-\w+(?:-\w+)*|ragged-[\w-]+|collective-[\w-]+|reduce-scatter[\w-]*|send|recv)\("
)
SHAPE = re.compile(r"\w+\[([\d,]*)\]")


def sent(compiled) -> dict[str, int]:
    """Numbers that a device receives, by operation, each time its program comes to one."""
    total: dict[str, int] = {}
    for results, name in COLLECTIVE.findall(compiled.as_text()):
        for shape in SHAPE.findall(results):
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

    on_all = functools.partial(jax.shard_map, mesh=mesh, check_vma=False)
    compiled = lambda f, *arguments: jax.jit(f).lower(*arguments).compile()

    def weights_of(shards, points, normals):
        return shards.weights(points, normals, METHOD, Laplacian())

    def steps(shards, weights, u, dt):
        return heat(functools.partial(shards.product, weights), u, dt)

    def whole(u):
        return jax.lax.all_gather(u, shards.axis)

    geometry = shards, cloud.points[rows], cloud.normals[rows]
    weights_on_all = on_all(weights_of, in_specs=(own, own, own), out_specs=columns)
    build = compiled(weights_on_all, *geometry)
    built = build(*geometry)

    field = shards, weights[:, rows], u[rows]
    product_on_all = on_all(Shards.product, in_specs=(own, columns, own), out_specs=own)
    product = compiled(product_on_all, *field)
    applied = product(*field)

    dt = jnp.asarray(1 / size)
    start = shards, built, u[rows], dt
    steps_on_all = on_all(steps, in_specs=(own, columns, own, everywhere), out_specs=own)
    run = compiled(steps_on_all, *start)
    end = run(*start)
    expected = jax.jit(heat)(surface.laplacian, u, dt)

    square = lambda u: jnp.sum(steps_on_all(shards, built, u[rows], dt)[:N] ** 2)
    expected_square = lambda u: jnp.sum(heat(surface.laplacian, u, dt) ** 2)
    slope, expected_slope = (jax.jit(jax.grad(f))(u) for f in (square, expected_square))

    programs = {"build": build, "product": product, "steps": run}
    programs["whole"] = compiled(on_all(whole, in_specs=own, out_specs=own), u[rows])
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
                "sent": {name: sent(program) for name, program in programs.items()},
            }
        )
    )


if __name__ == "__main__":
    main()
