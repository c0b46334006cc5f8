"""Heat equation on the sphere: ours, SciPy's BDF and Crank–Nicolson, side by side; memory of a
gradient through many steps."""

from __future__ import annotations

import time

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.integrate
import scipy.sparse
import scipy.sparse.linalg
from scipy.special import eval_legendre

import jaxsurf as js

from .timing import first_and_median, peak_gib

START, SPAN = 0.05, 0.1

Solvers = {
    "RKC2": js.RKC2(),
    "IMEX(order=3)": js.IMEX(order=3),
    "SDIRK(order=3)": js.SDIRK(order=3),
    "Tsit5": dfx.Tsit5(),
}


def kernel(cosine, t: float) -> np.ndarray:
    """Heat kernel of the unit sphere, a function of the angle to the source."""
    terms = (
        (2 * k + 1) / (4 * np.pi) * np.exp(-k * (k + 1) * t) * eval_legendre(k, cosine)
        for k in range(60)
    )
    return sum(terms, np.zeros_like(cosine))


def _problem(n: int):
    """Laplacian, the heat kernel at the start and at the end."""
    cloud = js.sphere(n)
    neighbors = js.find_neighbors(cloud, k=20, throw=False)
    laplacian = js.laplace_beltrami(cloud, neighbors, method=js.GFDM(degree=2), throw=False)
    cosine = np.asarray(cloud.points @ jnp.array([0.48, 0.6, 0.64]))
    return laplacian, kernel(cosine, START), kernel(cosine, START + SPAN)


def _target(n: int) -> float:
    """Relative error against the exact solution that every method has to reach.

    1e-4 at n = 1e5; at fewer points the error in space is larger, as 1/n.
    """
    return 1e-4 * max(1.0, 1e5 / n)


def _error(u, exact) -> float:
    return float(np.linalg.norm(np.asarray(u) - exact) / np.linalg.norm(exact))


def ours(n: int) -> dict:
    """`js.integrate` with its own choice of solver: the first tolerance that is accurate enough."""
    laplacian, u0, exact = _problem(n)
    problem = js.AdvectionDiffusionReaction(laplacian)

    def solve(rtol):
        return js.integrate(problem, jnp.asarray(u0), t1=SPAN, rtol=rtol, atol=rtol / 10)

    for rtol in (1e-4, 3e-5, 1e-5, 3e-6, 1e-6, 3e-7):
        solution = solve(rtol)
        if _error(solution.ys[-1], exact) <= _target(n):
            break
    _, seconds = first_and_median(lambda: solve(rtol).ys, 5)
    return {"s": seconds, "error": _error(solution.ys[-1], exact),
            "tolerance": rtol, "steps": int(solution.stats["num_accepted_steps"]),
            "solver": solution.stats["solver"], "peak GiB": peak_gib()}  # fmt: skip


def bdf(n: int) -> dict:
    """SciPy's BDF with the sparse Jacobian, which it factorises with SuperLU."""
    laplacian, u0, exact = _problem(n)
    matrix = laplacian.to_scipy().tocsc()
    for rtol in (1e-3, 1e-4, 1e-5):
        start = time.perf_counter()
        solution = scipy.integrate.solve_ivp(
            lambda t, u: matrix @ u, (0, SPAN), u0, method="BDF", jac=matrix, rtol=rtol,
            atol=rtol / 10,
        )  # fmt: skip
        seconds = time.perf_counter() - start
        if _error(solution.y[:, -1], exact) <= _target(n):
            break
    return {"s": seconds, "error": _error(solution.y[:, -1], exact), "tolerance": rtol,
            "steps": solution.t.size - 1, "factorisations": solution.nlu,
            "peak GiB": peak_gib()}  # fmt: skip


def crank_nicolson(n: int) -> dict:
    """Equal steps, one factorisation with SuperLU: the fewest steps that are accurate enough."""
    laplacian, u0, exact = _problem(n)
    matrix = laplacian.to_scipy().tocsc()
    identity = scipy.sparse.identity(n, format="csc")
    start_factors = time.perf_counter()
    for steps in (16, 32, 64, 128):
        start = time.perf_counter()
        half = 0.5 * SPAN / steps
        factors = scipy.sparse.linalg.splu(identity - half * matrix)
        u = u0
        for _ in range(steps):
            u = factors.solve(u + half * (matrix @ u))
        seconds = time.perf_counter() - start
        if _error(u, exact) <= _target(n):
            break
    return {"s": seconds, "error": _error(u, exact), "steps": steps, "peak GiB": peak_gib(),
            "s with search": time.perf_counter() - start_factors}  # fmt: skip


def reverse(n: int, steps: int, solver: str) -> dict:
    """Gradient of a scalar of the final state with respect to the initial one and the weights."""
    laplacian, u0, _ = _problem(n)
    dt = (1 if solver == "Tsit5" else 10) / js.spectral_estimate(laplacian).radius

    def scalar(u, factor):
        problem = js.AdvectionDiffusionReaction(
            laplacian, diffusivity=factor, reaction=lambda t, u, args: u - u**3
        )
        end = js.integrate(problem, u, t1=steps * dt, dt0=dt, solver=Solvers[solver]).ys[-1]
        return jnp.sum(end**2)

    u, factor = jnp.asarray(u0), jnp.asarray(1.0)
    before = peak_gib()
    forward = jax.jit(scalar)
    _, plain = first_and_median(lambda: forward(u, factor), 1)
    gradient = jax.jit(jax.grad(scalar, argnums=(0, 1)))
    first, seconds = first_and_median(lambda: gradient(u, factor), 1)
    return {"s": seconds, "compile s": first - seconds, "forward s": plain,
            "/ forward": seconds / plain, "peak GiB": peak_gib(), "GiB before": before}  # fmt: skip


def plan(quick: bool) -> list[tuple[str, list]]:
    n = 10_000 if quick else 100_000
    todo: list[tuple[str, list]] = [
        (f"heat.{name}", [n]) for name in ("ours", "bdf", "crank_nicolson")
    ]
    steps = 100 if quick else 1_000
    return todo + [
        ("heat.reverse", [10_000, steps, name]) for name in ("RKC2", "Tsit5", "IMEX(order=3)")
    ]
