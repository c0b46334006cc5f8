"""The operators of a surface that come of one factorisation of each moment matrix."""

from __future__ import annotations

from typing import Any, NamedTuple

from .build import build_all, build_with, weighed_neighbors
from .cloud import PointCloud
from .neighbors import Neighbors
from .quadrature import Cells, Cut, cells_in_rows
from .stencils.method import AbstractMethod
from .stencils.stencil import Stencil
from .stencils.targets import Gradient, Joint, Laplacian


class Built(NamedTuple):
    """The Laplacian, and what comes with it for nothing.

    Args:
        gradient: from the same factorisation of the moment matrices; None if these are not shared.
        cells: those of integrals, if they were cut in the same program.
    """

    laplacian: Stencil
    gradient: Stencil | None = None
    cells: Cells | None = None


def _target(method: AbstractMethod) -> Laplacian | Joint:
    return Joint((Laplacian(), Gradient())) if method.shares_moments else Laplacian()


def weighed(cloud: PointCloud, method: AbstractMethod) -> tuple[Neighbors, Any]:
    """`choose_neighbors`, and the weights that were found by the way: those of `built`."""
    return weighed_neighbors(cloud, method, target=_target(method))


def built(
    cloud, neighbors, method, cut: Cut | None = None, throw: bool = True, weights: Any = None
) -> Built:
    """As `laplace_beltrami`, and what a method that shares its moments gives with it.

    Args:
        cut: cells are cut too, of a traced cloud.
        throw: as there.
        weights: see `weighed`.
    """
    target = _target(method)
    if cut is None or not method.shares_moments:
        stencils = build_all(cloud, neighbors, method, target, throw, weights)
        return Built(stencils[0], stencils[1] if method.shares_moments else None)
    (laplacian, gradient), cells = build_with(cloud, neighbors, method, target, cut)
    return Built(laplacian, gradient, cells_in_rows(cells, cloud.n))
