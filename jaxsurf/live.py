"""Optimisations seen while they run: a callback that keeps one picture up to date."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
from jaxtyping import Array, Float

from jaxsurf.arguments import instance, whole
from jaxsurf.design.outcome import ShapeOptimization
from jaxsurf.discretization import Discretization
from jaxsurf.plot import plot_cloud, pyplot_module

# Rows of the history that the right half shows.
_CURVES = ("objective", "gradient", "violation")


class LivePlot:
    """A picture of the surface and of the way there, drawn anew as `optimize_shape` goes on.

    In a notebook it is one output that changes in place; elsewhere a window, where matplotlib has
    one.

    Args:
        field: what the surface is coloured by, a function of it, `lambda surface:
            surface.mean_curvature`; None shows the shape alone.
        every: steps from one picture to the next.
        label, limits, view, pixels: as in `plot_cloud`.

    Raises:
        TypeError: a field that is no function; a number of steps that is none; what is drawn is no
            `ShapeOptimization`.
        ValueError: fewer than one step.
        ImportError: matplotlib is absent.

    Example:
        >>> surface = js.discretize(js.sphere(200), method=js.GFDM(degree=2))
        >>> live = js.LivePlot(lambda surface: surface.cloud.points[:, 2], every=5, pixels=60)
        >>> found = js.optimize_shape(
        ...     lambda surface: (jnp.mean(surface.cloud.points**2) - 0.5) ** 2,
        ...     js.MappedShape(lambda x, a: a * x, surface), 1.0,
        ...     optimizer=optax.lbfgs(), callback=live,
        ... )
        >>> len(live.figure.axes)  # surface, colours, history
        3
    """

    def __init__(
        self,
        field: Callable[[Discretization], Float[Array, " n"]] | None = None,
        *,
        every: int = 1,
        label: str | None = None,
        limits: tuple[float, float] | None = None,
        view: tuple[float, float, float] = (1.0, -1.7, 0.9),
        pixels: int = 400,
    ):
        if field is not None and not callable(field):
            raise TypeError(f"field is a {type(field).__name__}, expected a function of a surface")
        self.field, self.every = field, whole(every, "every", least=1)
        self.options: dict[str, Any] = dict(
            label=label, view=view, pixels=whole(pixels, "pixels", least=1)
        )
        self.figure = pyplot_module().figure(figsize=(9, 3.8), layout="constrained")
        self._shown: Any = None

    def __call__(self, found: ShapeOptimization) -> None:
        """Draw what there is, if it is time to: the callback of `optimize_shape`."""
        instance(found, ShapeOptimization, "found", "js.optimize_shape gives it to its callback")
        steps = len(found.history["seconds"]) - 1
        if steps % self.every and found.stopped == "under way":
            return
        with warnings.catch_warnings():
            # What bends within one stencil was told of the first surface.
            warnings.simplefilter("ignore")
            self._draw(found, steps)
        self._show()

    def _draw(self, found: ShapeOptimization, steps: int) -> None:
        self.figure.clear()
        left, right = self.figure.subplots(1, 2, width_ratios=(1.1, 1))
        surface = found.surface
        values = None if self.field is None else self.field(surface)
        title = f"step {steps}: {float(found.objective):.5g}"
        plot_cloud(surface.cloud, values, ax=left, title=title, **self.options)
        for name in _CURVES:
            row = np.abs(found.history[name])
            if np.any(row > 0):
                right.semilogy(np.where(row > 0, row, np.nan), label=name)
        right.set_xlabel("step")
        right.legend(frameon=False, fontsize="small")

    def _show(self) -> None:
        if _in_notebook():
            from IPython.display import display

            if self._shown is None:
                self._shown = display(self.figure, display_id=True)
                pyplot_module().close(self.figure)  # or the cell shows it once more at its end
            else:
                self._shown.update(self.figure)
        elif getattr(self.figure.canvas, "manager", None) is not None:
            self.figure.canvas.draw_idle()
            self.figure.canvas.flush_events()


def _in_notebook() -> bool:
    try:
        from IPython import get_ipython
    except ImportError:
        return False
    return getattr(get_ipython(), "kernel", None) is not None
