"""Poisson's equation: ours beside SciPy's BiCGStab with pyamg's smoothed aggregation.

`python -m experiments.benchmarks.solve` prints one JSON line; `--n` sets the size.
"""

from __future__ import annotations

import argparse
import json

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pyamg
import scipy.sparse.linalg

import jaxsurf as js

from .timing import first_and_median, peak_gib, side_by_side

_RTOL = 1e-8


def _problem(n: int):
    cloud = js.sphere(n)
    neighbors = js.find_neighbors(cloud, k=20, throw=False)
    method = js.GFDM(degree=2)
    laplacian = js.laplace_beltrami(cloud, neighbors, method=method, throw=False)
    f = jnp.exp(cloud.points @ jnp.array([1.0, 2.0, 1.5]))
    return laplacian, f - jnp.mean(f)


@jax.jit
def _ours(operator, f, preconditioner):
    return js.solve(operator, f, preconditioner=preconditioner, rtol=_RTOL)


def poisson(n: int) -> dict:
    """Set-up and solve after compilation, memory, and the gradient."""
    laplacian, f = _problem(n)
    before = peak_gib()
    _, setup = first_and_median(lambda: js.multigrid(laplacian), 5)
    preconditioner = js.multigrid(laplacian)
    first, seconds = first_and_median(lambda: _ours(laplacian, f, preconditioner).value, 5)
    found = _ours(laplacian, f, preconditioner)
    return {
        "set-up s": setup, "solve s": seconds, "compile s": first - seconds,
        "steps": int(found.stats["num_steps"]),
        "relative residual": float(found.stats["relative_residual"]),
        "peak GiB": peak_gib(), "GiB before": before,
    }  # fmt: skip


def poisson_beside_scipy(n: int) -> dict:
    """Set-up and solve in turn with the baseline, which is given its matrix for nothing.

    The baseline solves the singular system with a right-hand side in its range, which takes it
    fewer steps than one with a pinned point.
    """
    laplacian, f = _problem(n)
    matrix = (-laplacian.to_scipy()).tocsr()
    found = _ours(laplacian, f, js.multigrid(laplacian))
    b = float(found.stats["incompatible"]) - np.asarray(f)
    steps = 0

    def ours():
        return _ours(laplacian, f, js.multigrid(laplacian)).value

    def baseline():
        nonlocal steps
        steps = 0

        def count(_):
            nonlocal steps
            steps += 1

        hierarchy = pyamg.smoothed_aggregation_solver(matrix).aspreconditioner()
        x, failed = scipy.sparse.linalg.bicgstab(matrix, b, rtol=_RTOL, M=hierarchy, callback=count)
        assert not failed
        return x

    mine, theirs, ratio = side_by_side(ours, baseline, 5)
    x = baseline()
    return {
        "ours s": mine, "SciPy and pyamg s": theirs, "ratio": ratio,
        "our steps": int(found.stats["num_steps"]), "their steps": steps,
        "our residual": float(found.stats["relative_residual"]),
        "their residual": float(np.linalg.norm(b - matrix @ x) / np.linalg.norm(b)),
        "difference": float(np.abs(x - x.mean() - np.asarray(found.value)).max()),
    }  # fmt: skip


def poisson_gradient(n: int) -> dict:
    """A scalar of the solution, and its value with gradient in weights and right-hand side."""
    laplacian, f = _problem(n)
    preconditioner = js.multigrid(laplacian)

    def total(weights, f, operator, preconditioner):
        moved = eqx.tree_at(lambda o: o.weights, operator, weights)
        return jnp.sum(_ours(moved, f, preconditioner).value ** 2)

    arguments = (laplacian.weights, f, laplacian, preconditioner)
    value, gradient = jax.jit(total), jax.jit(jax.value_and_grad(total, argnums=(0, 1)))
    both, alone, ratio = side_by_side(lambda: gradient(*arguments), lambda: value(*arguments), 7)
    return {"gradient s": both, "solve s": alone, "gradient / solve": ratio}


def renewal(n: int) -> dict:
    """A hierarchy's numbers computed again, beside its set-up and a build of the Laplacian."""
    surface = js.discretize(js.sphere(n), method=js.GFDM(degree=2))
    laplacian = surface.laplacian
    cycle = js.multigrid(laplacian, renewable=True)
    renew = lambda: cycle.renewed(laplacian).coarsest
    first, seconds = first_and_median(renew, 5)
    lists = {"neighbors": surface.neighbors, "method": surface.method}
    build = lambda: js.laplace_beltrami(surface.cloud, **lists).weights
    setup = lambda: js.multigrid(laplacian, renewable=True).coarsest
    return {
        "renewal s": seconds, "compile s": first - seconds,
        "renewal / build": side_by_side(renew, build, 7)[2],
        "renewal / set-up": side_by_side(renew, setup, 7)[2],
        "renewable / plain set-up": side_by_side(
            setup, lambda: js.multigrid(laplacian).coarsest, 7
        )[2],
    }  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    cases = [poisson, poisson_beside_scipy, poisson_gradient, renewal]
    parser.add_argument("--n", type=int, default=100_000)
    parser.add_argument("--case", choices=[case.__name__ for case in cases])
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    chosen = [c for c in cases if options.case in (None, c.__name__)]
    print(json.dumps({case.__name__: case(options.n) for case in chosen}))


if __name__ == "__main__":
    main()
