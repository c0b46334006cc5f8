"""Derivatives held against what they claim: Taylor remainders of second order."""

from __future__ import annotations

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from ..arguments import finite, floating, on_host, same_values
from ..failures import needs_values, not_positive, raise_at

# How many steps there are by default, and what multiple of the rounding of f and x is round-off.
_STEPS, _ROUNDING = 7, 8


class TaylorRemainders(eqx.Module):
    r"""Remainders $|f(x + \varepsilon v) - f(x) - \varepsilon f'(x) v|$: see `taylor_remainders`.

    Args:
        steps: $\varepsilon$, `(m,)`.
        remainders: one for each step, `(m,)`, in the units of f.
        derivative: $f'(x) v$, as reverse mode has it.
        rounding: remainders below are round-off, and not part of the slope.

    Example:
        >>> found = js.TaylorRemainders(np.array([0.1, 0.01]), np.array([1e-2, 1e-4]), 1.0, 0.0)
        >>> round(found.slope, 12)
        2.0
    """

    steps: Float[np.ndarray, " m"]
    remainders: Float[np.ndarray, " m"]
    derivative: float
    rounding: float

    @property
    def slope(self) -> float:
        """Of log(remainder) over log(step); infinite if less than two are above round-off."""
        above = self.remainders > self.rounding
        if above.sum() < 2:
            return float("inf")
        return float(np.polyfit(np.log(self.steps[above]), np.log(self.remainders[above]), 1)[0])

    def __repr__(self):
        pairs = ", ".join(f"{r:.1e} at {s:.1e}" for s, r in zip(self.steps, self.remainders))
        return (
            f"TaylorRemainders(slope {self.slope:.2f}, derivative {self.derivative:.6g}, "
            f"remainders {pairs}, round-off {self.rounding:.0e})"
        )


def taylor_remainders(
    f: Callable[[PyTree], Float[Array, ""]],
    x: PyTree[Float[Array, "..."]],
    direction: PyTree[Float[Array, "..."]],
    *,
    steps: Float[Array, " m"] | None = None,
) -> TaylorRemainders:
    r"""What the first derivative of a function leaves: falls as $\varepsilon^2$ if it is right.

    $|f(x + \varepsilon v) - f(x) - \varepsilon f'(x) v| = O(\varepsilon^2)$ for a smooth f; with a
    wrong derivative it is $O(\varepsilon)$. The derivative is that of reverse mode.

    Args:
        f: scalar-valued function of one argument; `jax.jit(f)` is evaluated faster. For several
            values take one each, or their product with a fixed vector.
        x: where; any pytree of floating-point arrays.
        direction: v, of the structure and shapes of x; as long as x may well change by.
        steps: $\varepsilon$; if None seven from $\epsilon^{1/8}$ to $\epsilon^{1/4}$ with
            $\epsilon$ the unit of round-off of x: 1e-2 to 1e-4 in double, 0.1 to 0.02 in single
            precision.

    Returns:
        Steps, remainders, their slope and the derivative. The slope is 2 if the derivative is
        right, 1 if it is not, more than 2 where the second derivative vanishes, infinite if f is
        linear and the derivative right. A solver's tolerance shows as a floor: give larger steps.

    Raises:
        TypeError: leaves that are not of a floating-point type; f that is not real and scalar.
        ValueError: direction unlike x, or zero; values, derivatives or steps that are not finite,
            steps that are not positive or fewer than two; traced arrays.

    Example:
        >>> x = {"a": jnp.array([1.0, 2.0]), "b": jnp.array(0.5)}
        >>> found = js.taylor_remainders(lambda x: jnp.sum(jnp.sin(x["a"])) * x["b"], x, x)
        >>> round(found.slope, 1)
        2.0
    """
    if not callable(f):
        raise TypeError(f"f is a {type(f).__name__}, expected a function")
    needs_values("x and direction", x, direction)
    x, direction = floating(x, "x"), floating(direction, "direction")
    shapes = [jax.tree.map(jnp.shape, tree) for tree in (x, direction)]
    if shapes[0] != shapes[1]:
        raise ValueError(f"direction has shapes {shapes[1]}, x has {shapes[0]}")
    epsilon = max(float(jnp.finfo(leaf.dtype).eps) for leaf in jax.tree.leaves(x))
    if steps is None:
        steps = jnp.geomspace(epsilon ** (1 / 8), epsilon ** (1 / 4), _STEPS)
    at = on_host(steps, "steps", ("m",))
    raise_at(not_positive(at), "step {i} is {v}, expected a positive number", at)
    if len(np.unique(at)) < 2:
        raise ValueError(f"{len(np.unique(at))} different steps, at least 2 are needed")
    shifted = lambda step: jax.tree.map(
        lambda a, v: a + jnp.asarray(step, a.dtype) * v, x, direction
    )
    if same_values(x, shifted(at.max())):
        raise ValueError("direction is zero, or so short that x is the same after all steps")

    kind = jax.eval_shape(f, x)
    if getattr(kind, "shape", None) != () or not jnp.issubdtype(kind.dtype, jnp.floating):
        raise TypeError(f"f returns {kind}, expected one real number")
    value, gradient = jax.value_and_grad(f)(x)
    finite(value, "f(x)")
    double = lambda tree: [np.asarray(leaf, float) for leaf in jax.tree.leaves(tree)]
    size = lambda a, b: sum(np.sum(np.abs(p * q)) for p, q in zip(double(a), double(b)))
    derivative = float(sum(np.sum(p * q) for p, q in zip(double(gradient), double(direction))))
    finite(jnp.asarray(derivative), "derivative of f at x")
    values = np.array([float(f(shifted(step))) for step in at])
    raise_at(~np.isfinite(values), "f(x + step direction) is {v} at step {at}", values, at=at)
    remainders = np.abs(values - float(value) - at * derivative)
    rounding = _ROUNDING * epsilon * (abs(float(value)) + size(gradient, x))
    return TaylorRemainders(at, remainders, derivative, float(rounding))
