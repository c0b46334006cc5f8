"""Pictures that several experiments draw."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes


def convergence(
    path: Path,
    spacings: Sequence[float],
    errors: Mapping[str, Sequence[float]],
    *,
    orders: Sequence[float],
    title: str,
    label: str = "error",
) -> None:
    """Errors over the spacing on logarithmic axes, with lines of given slopes beneath."""
    figure, ax = plt.subplots(figsize=(5.2, 4.2), layout="constrained")
    markers = "osD^vPX<>*"
    for marker, (name, values) in zip(markers * 5, errors.items()):
        ax.loglog(spacings, values, marker + "-", label=name, markersize=4.5, linewidth=1)
    ends = np.array([min(spacings), max(spacings)])
    # Guides start below curves spread evenly over those drawn, the highest for the lowest order.
    starts = sorted(values[int(np.argmax(spacings))] for values in errors.values())
    picks = np.linspace(len(starts) - 1, 0, len(orders)).round().astype(int)
    for order, pick in zip(sorted(orders), picks):
        guide = 0.5 * starts[pick] * (ends / ends[1]) ** order
        ax.loglog(ends, guide, "k:", linewidth=0.9)
        middle = np.sqrt(ends.prod()), np.sqrt(guide.prod())
        ax.annotate(f"order {order:g}", middle, (4, -4), textcoords="offset points",
                    fontsize=8, va="top")  # fmt: skip
    ax.set_xlabel("spacing h")
    ax.set_ylabel(label)
    ax.set_title(title, fontsize="medium")
    ax.legend(fontsize=8, frameon=False)
    figure.savefig(path, dpi=150)
    plt.close(figure)


def descent(ax: Axes, history: Mapping[str, np.ndarray], labels: Mapping[str, str]) -> None:
    """Columns of an optimisation's history over its steps, and where neighbours were found anew."""
    for name, label in labels.items():
        ax.semilogy(history[name], label=label)
    renewed = np.flatnonzero(history["renewed"])
    ax.plot(renewed, history["gradient"][renewed], "k|", label="neighbours found anew")
    ax.set_xlabel("step")
    ax.legend(fontsize=8, frameon=False)
