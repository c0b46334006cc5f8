"""Level sets {phi = 0} of any JAX function: projection, exact normals and curvature.

Sampling chooses points once, on the host, and is not differentiated. Their position is: rebuild
it from the chosen points with `project_to_level_set` and `level_set_normals` under `jax.grad`,
and derivatives with respect to everything that `phi` depends on follow.
"""

from __future__ import annotations

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from jaxsurf.arguments import POINTS, as_float, differentiable, finite, real, whole
from jaxsurf.failures import check, not_finite, not_positive
from jaxsurf.functions import Traced, canonical

LevelSet = Callable[[Float[Array, " d"]], Float[Array, ""]]
Bounds = tuple[tuple[float, ...], tuple[float, ...]]


def project_to_level_set(
    phi: LevelSet,
    points: Float[Array, "n d"],
    *,
    tolerance: float | None = None,
    max_steps: int = 30,
    throw: bool = True,
) -> Float[Array, "n d"]:
    r"""Move points onto {phi = 0} along the straight line through each in the direction of ∇phi.

    $x = y + t\,g$ with $g = \nabla\phi(y)/|\nabla\phi(y)|$ and $\phi(y + t g) = 0$, solved by
    Newton's method in t.

    Args:
        phi: function of one point `(d,)`; may depend on traced parameters.
        points: near the level set, `(n, d)`: within the distance at which lines along the
            gradient still meet it.
        tolerance: a last Newton step longer than this is a failure, in the units of the points;
            None for eps^(2/3) times the largest coordinate.
        max_steps: of Newton's method.
        throw: raise where it fails; if False, and under `jit` and `grad`, such points are NaN.

    Returns:
        Points on the level set, `(n, d)`, to round-off.

    Accuracy: in float32 within 3e-6 of a torus of radii 3 and 1 (`tests/test_shapes.py`).
    Differentiable: forward and reverse and to any order, in `points` and in everything that
        `phi` depends on, by the implicit function theorem: the iteration is not unrolled. A point
        that starts on the surface moves by −∂phi ∇phi/|∇phi|² per unit of a parameter.
    Raises:
        ValueError: no convergence, or ∇phi = 0, named by point, on concrete arrays.

    Example:
        >>> def height(radius):
        ...     points = jnp.array([[0.6, 0.0, 0.8]])
        ...     return js.project_to_level_set(lambda x: x @ x - radius**2, points)[0, 2]
        >>> bool(jnp.isclose(jax.grad(height)(1.0), 0.8))
        True
    """
    points = _checked_points(points)
    whole(max_steps, "max_steps", least=1)
    if tolerance is None:
        eps = float(jnp.finfo(points.dtype).eps)
        limit = eps ** (2 / 3) * jnp.max(jnp.abs(lax.stop_gradient(points)), initial=eps)
    else:
        limit = jnp.asarray(real(tolerance, "tolerance", above=0), points.dtype)
    program = program_of(phi, points[0] if len(points) else jnp.zeros(points.shape[1:]))
    found, step = _projected(program, points, limit, jnp.asarray(max_steps))
    if throw:
        text = (
            "projection of point {i} did not converge: last step {v}, tolerance {limit:.2g}, "
            f"{max_steps} steps (too far from the level set, or the gradient vanishes)"
        )
        bad = lambda step, limit, found: ~(step <= limit)
        check(step, bad, text, limit, found, limit=limit)
    return found


@eqx.filter_jit
def _projected(phi: Traced, points, limit, max_steps):
    # The loop must not see tangents, also not those of parameters that phi has captured: reverse
    # mode cannot go through it.
    frozen = jax.tree.map(lax.stop_gradient, phi)

    def single(start):
        g = jax.grad(phi)(start)
        # A zero gradient gives NaN here, and the point is reported.
        g = g / jnp.linalg.norm(g)
        there, step = _newton_on_ray(frozen, start, g, limit, max_steps)
        t = lax.custom_root(
            lambda s: phi(start + s * g),
            there,
            lambda _, guess: guess,
            lambda slope, y: y / slope(jnp.ones_like(y)),
        )
        last = jnp.abs(step)
        return jnp.where(last <= limit, start + t * g, jnp.nan), last

    return jax.vmap(single)(points)


def level_set_normals(phi: LevelSet, points: Float[Array, "n d"]) -> Float[Array, "n d"]:
    r"""Unit normals $\nabla\phi/|\nabla\phi|$ at each point.

    Args:
        phi: function of one point `(d,)`.
        points: `(n, d)`.

    Returns:
        `(n, d)`, outward where phi grows outwards.

    Accuracy: in float32 within 1e-5 on a unit sphere (`tests/test_shapes.py`).
    Differentiable: forward and reverse, in the points and in what `phi` depends on.
    Raises:
        ValueError: the gradient vanishes or is not finite, named by point, on concrete arrays.

    Example:
        >>> js.level_set_normals(lambda x: x @ x - 1, jnp.array([[0.0, 2.0]])).tolist()
        [[0.0, 1.0]]
    """
    points = _checked_points(points)
    normals, length = _directions(program_of(phi, points), points)
    check(length, not_positive, "gradient of phi at point {i} has length {v}")
    return normals


def level_set_curvature(
    phi: LevelSet, points: Float[Array, "n d"]
) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
    r"""Exact mean and Gauss curvature of the level sets of phi through each point.

    With the shape operator $S = P\,\nabla^2\phi\,P/|\nabla\phi|$, $P = I - n n^T$:
    $H = \operatorname{tr} S/(d-1) = \nabla\cdot n/(d-1)$, which is +1 on the unit sphere with
    phi growing outwards, and $K = \tfrac12((\operatorname{tr} S)^2 - \operatorname{tr} S^2)$.
    For a curve in the plane H is its curvature and K is zero.

    Args:
        phi: function of one point `(d,)`, twice differentiable.
        points: `(n, d)`.

    Returns:
        Mean curvature in 1/length and Gauss curvature in 1/length², `(n,)` each.

    Accuracy: in float32 within 1e-4 on a unit sphere (`tests/test_shapes.py`).
    Differentiable: forward and reverse, in the points and in what `phi` depends on.
    Raises:
        ValueError: the gradient vanishes or is not finite, named by point, on concrete arrays.
        TypeError: phi is no function that JAX can trace.

    Example:
        >>> pole = jnp.array([[0.0, 0.0, 2.0]])
        >>> mean, gauss = js.level_set_curvature(lambda x: x @ x - 4, pole)
        >>> float(mean[0]), float(gauss[0])
        (0.5, 0.25)
    """

    points = _checked_points(points)
    mean, gauss = _curvatures(program_of(phi, points), points)
    bad = lambda mean, gauss: not_finite(mean) | not_finite(gauss)
    check(mean, bad, "curvature at point {i} is {v}: the gradient of phi vanishes", gauss)
    return mean, gauss


@eqx.filter_jit
def _curvatures(phi: Traced, points):
    def single(point):
        gradient, hessian = jax.grad(phi)(point), jax.hessian(phi)(point)
        length = jnp.linalg.norm(gradient)
        normal = gradient / length
        tangential = jnp.eye(point.size, dtype=point.dtype) - jnp.outer(normal, normal)
        shape = tangential @ hessian @ tangential / length
        trace = jnp.trace(shape)
        return trace / (point.size - 1), (trace**2 - jnp.sum(shape * shape.T)) / 2

    return jax.vmap(single)(points)


def _newton_on_ray(phi, start, direction, limit, max_steps):
    """Root t of phi(start + t direction), and the last step taken."""

    def body(state):
        t, _, count = state
        value, slope = jax.jvp(phi, (start + t * direction,), (direction,))
        # An exact zero with zero slope is still a failure: the position is not determined.
        step = -value / slope
        return t + step, step, count + 1

    def unfinished(state):
        _, step, count = state
        return (jnp.abs(step) > limit) & (count < max_steps)

    start, direction = lax.stop_gradient((start, direction))
    zero = jnp.zeros((), start.dtype)
    t, step, _ = lax.while_loop(unfinished, body, (zero, zero + jnp.inf, 0))
    return t, step


def program_of(phi: LevelSet, points) -> Traced:
    """The level-set function as a program, for points of this kind."""
    point = jax.ShapeDtypeStruct(points.shape[-1:], points.dtype)
    value = differentiable(phi, "phi", point)
    if not isinstance(value, jax.ShapeDtypeStruct) or value.shape != ():
        what = getattr(value, "shape", f"a {type(value).__name__}")
        raise ValueError(f"phi must return a scalar for one point, its values have shape {what}")
    if not jnp.issubdtype(value.dtype, jnp.floating):
        raise TypeError(f"phi returns {value.dtype}, expected a real number")
    return canonical(phi, jnp.zeros(point.shape, point.dtype))


def _checked_points(points) -> Float[Array, "n d"]:
    return finite(as_float(points, "points", *POINTS), "points")


@eqx.filter_jit
def _directions(phi: Traced, points):
    gradients = jax.vmap(jax.grad(phi))(points)
    length = jnp.linalg.norm(gradients, axis=1)
    return gradients / length[:, None], length
