"""Rows of an experiment: our number beside the reference, and whether the bound is kept."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import jax
import numpy as np

import jaxsurf as js

Method = js.DCPSE | js.GFDM | js.RBFFD


@dataclass(frozen=True)
class Row:
    """One measured number.

    Args:
        quantity: what it is, with its unit where it has one; a lower bound says "at least".
        ours: the number measured.
        setting: what it depends on: method, number of points, ...
        reference: the published number; None where there is only a picture.
        source: where reference and bound come from.
        bound: what `ours` must not exceed; None for a number that is only told.
        at_least: the bound is one from below.
    """

    quantity: str
    ours: float
    setting: dict[str, Any] = field(default_factory=dict)
    reference: float | None = None
    source: str = ""
    bound: float | None = None
    at_least: bool = False

    def __post_init__(self):
        if self.at_least and "at least" not in self.quantity:
            raise ValueError(f"quantity {self.quantity!r} must say that its bound is from below")

    @property
    def holds(self) -> bool | None:
        """Whether the bound is kept; None without one. A number that is not finite keeps none."""
        if self.bound is None:
            return None
        if not math.isfinite(self.ours):
            return False
        return bool(self.ours >= self.bound if self.at_least else self.ours <= self.bound)

    def as_json(self) -> dict[str, Any]:
        return {
            "quantity": self.quantity,
            "setting": self.setting,
            "ours": self.ours if math.isfinite(self.ours) else None,
            "reference": self.reference,
            "source": self.source,
            "bound": self.bound,
            "holds": self.holds,
        }


def slope(spacings, errors) -> float:
    """Observed order: least-squares slope of log(error) over log(spacing)."""
    return float(np.polyfit(np.log(np.asarray(spacings)), np.log(np.asarray(errors)), 1)[0])


def relative_l2(found, exact) -> float:
    """Norm of the error over the norm of the exact values."""
    found, exact = np.asarray(found), np.asarray(exact)
    return float(np.linalg.norm(found - exact) / np.linalg.norm(exact))


def method_name(method: Method) -> str:
    """As it is written in code: `DCPSE(order=4)`."""
    if isinstance(method, js.DCPSE):
        return f"DCPSE(order={method.order})"
    return f"{type(method).__name__}(degree={method.degree})"


def write_json(path: Path, name: str, rows: list[Row], seconds: float) -> None:
    content = {
        "experiment": name,
        "seconds": round(seconds, 1),
        "versions": {"jax": jax.__version__, "jaxsurf": js.__version__},
        "rows": [row.as_json() for row in rows],
    }
    path.write_text(json.dumps(content, indent=1, allow_nan=False) + "\n", encoding="utf-8")


def table(rows: list[Row]) -> str:
    """The rows as text: ours, reference, bound, and whether it holds."""
    lines = []
    for row in rows:
        setting = ", ".join(f"{key} = {value}" for key, value in row.setting.items())
        verdict = {True: "holds", False: "FAILS", None: ""}[row.holds]
        relation = ">=" if row.at_least else "<="
        bound = "" if row.bound is None else f"{relation} {row.bound:.3g}"
        reference = "" if row.reference is None else f"{row.reference:.3g}"
        lines.append((row.quantity, setting, f"{row.ours:.3g}", reference, bound, verdict))
    head = ("quantity", "setting", "ours", "reference", "bound", "")
    widths = [max(len(line[i]) for line in [head, *lines]) for i in range(len(head))]
    aligned = [
        "  ".join(cell.ljust(width) for cell, width in zip(line, widths)).rstrip()
        for line in [head, *lines]
    ]
    return "\n".join(aligned)
