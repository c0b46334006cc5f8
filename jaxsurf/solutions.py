"""What is returned by solves and integrations, which says in a line what came of it.

They are lineax's, optimistix's and diffrax's, with a `repr` of their own.
"""

from __future__ import annotations

from typing import Any

import diffrax as dfx
import jax
import lineax as lx
import numpy as np
import optimistix as optx

from .arguments import is_array
from .failures import is_concrete, unchecked


class LinearSolution(lx.Solution):
    """Of `js.solve`."""

    def __repr__(self):
        return f"{type(self).__name__}({_field(self.value)}{_outcome(self, lx.RESULTS)})"


class NonlinearSolution(optx.Solution):
    """Of `js.solve_nonlinear`."""

    def __repr__(self):
        return f"{type(self).__name__}({_field(self.value)}{_outcome(self, optx.RESULTS)})"


class TimeSolution(dfx.Solution):
    """Of `js.integrate`."""

    def __repr__(self):
        about = "nothing saved"
        if self.ts is not None:
            leaves = [leaf for leaf in jax.tree.leaves(self.ys) if is_array(leaf)]
            about = " and ".join(f"{leaf.dtype} {leaf.shape}" for leaf in leaves)
            if is_concrete(self.ts) and np.ndim(self.ts) == 1:
                times = np.asarray(self.ts)
                times = times[np.isfinite(times)]
                if len(times):
                    about += f" at t = {times[0]:g}"
                if len(times) > 1:
                    about += f" to {times[-1]:g} ({len(times)} times)"
        summary = self.stats.get("summary")
        about += f"; {summary}" if isinstance(summary, str) else ""
        return f"{type(self).__name__}({about}{_result(self.result, dfx.RESULTS)})"


_KINDS: dict[Any, type] = {
    lx.Solution: LinearSolution,
    optx.Solution: NonlinearSolution,
    dfx.Solution: TimeSolution,
}


def told(solution: Any) -> Any:
    """The same, with a `repr` that says what came of it."""
    return unchecked(_KINDS[type(solution)], **vars(solution))


def _field(value: Any) -> str:
    """What the solution is a field of."""
    if not is_array(value):
        return type(value).__name__
    n, *others = value.shape
    more = f", {others[0]} columns" if len(others) == 1 else f" {tuple(others)}" * bool(others)
    return f"{n:,} points{more}, {value.dtype}"


def _outcome(solution: Any, codes: Any) -> str:
    about, stats = "", solution.stats
    steps, residual = (stats.get(name) for name in ("num_steps", "relative_residual"))
    if is_concrete(steps, residual, solution.result) and steps is not None:
        low, high = np.min(steps), np.max(steps)
        about += f"; {low} steps" if low == high else f"; {low} to {high} steps"
        if residual is not None:
            about += f", relative residual {np.max(residual):.2g}"
    return about + _result(solution.result, codes)


def _result(result: Any, codes: Any) -> str:
    """Whether it came off, and if not why."""
    if not is_concrete(result):
        return ""
    good = np.asarray(result == codes.successful)
    if good.all():
        return "; successful"
    if good.ndim:
        return f"; {np.sum(~good)} of {good.size} failed"
    return f"; {codes[result].splitlines()[0]}"
