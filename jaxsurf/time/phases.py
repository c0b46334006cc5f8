r"""Rates in two phases: what is frozen for a step, and what is done with it."""

from __future__ import annotations

from collections.abc import Callable

import diffrax as dfx
import equinox as eqx
import jax
from jaxtyping import Array, PyTree


class Linear(eqx.Module):
    """The stiff linear part of a problem whose coefficients depend on the state.

    Args:
        freeze: (t, y) -> the arrays that it needs.
        apply: (t, y, arrays) -> L y, linear in y.
        arrays: those of the step; None where they follow from every y anew.
    """

    freeze: Callable
    apply: Callable
    arrays: PyTree[Array] | None = None

    def __call__(self, t, y, args):
        arrays = self.freeze(t, y) if self.arrays is None else self.arrays
        return self.apply(t, y, arrays)

    def at(self, t, y) -> Linear:
        """With the arrays of this state."""
        return Linear(self.freeze, self.apply, self.freeze(t, y))


class Rest(eqx.Module):
    """What a linear part leaves of the whole right-hand side."""

    whole: Callable
    linear: Linear

    def __call__(self, t, y, args):
        return jax.tree.map(lambda f, k: f - k, self.whole(t, y, args), self.linear(t, y, args))


def has_phases(terms: PyTree) -> bool:
    """Whether what is frozen for a step changes from step to step."""
    return any(map(_is_linear, jax.tree.leaves(terms, is_leaf=_is_linear)))


def frozen(terms: dfx.MultiTerm, t, y: PyTree[Array]) -> dfx.MultiTerm:
    """The terms with the linear part of this state, and what it leaves."""
    rest, linear = terms.terms
    # diffrax runs backwards with times of the other sign.
    real = t * getattr(linear, "direction", 1)
    now = jax.tree.map(lambda x: x.at(real, y) if _is_linear(x) else x, linear, is_leaf=_is_linear)
    part = next(filter(_is_linear, jax.tree.leaves(now, is_leaf=_is_linear)))
    is_rest = lambda x: isinstance(x, Rest)
    left = lambda x: Rest(x.whole, part) if is_rest(x) else x
    return dfx.MultiTerm(jax.tree.map(left, rest, is_leaf=is_rest), now)


def frozen_at(terms: dfx.MultiTerm, t, y: PyTree[Array], rates: tuple) -> tuple:
    """The terms with a linear part that does not change in a step, and their rates at its start.

    Whatever the parts are, they add up to the same: so do their rates.
    """
    if not has_phases(terms.terms[1]):
        return terms, rates
    terms = frozen(terms, t, y)
    rate = terms.terms[1].vf(t, y, None)
    left = jax.tree.map(lambda a, b, k: a + b - k, *rates, rate)
    return terms, (left, rate)


def _is_linear(x) -> bool:
    return isinstance(x, Linear)
