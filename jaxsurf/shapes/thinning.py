"""Points thinned to a Poisson-disk sample."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import cKDTree

from jaxsurf.arguments import POINTS, in_range, on_host, real, whole
from jaxsurf.compiling import AnyArray
from jaxsurf.failures import not_finite, raise_at
from jaxsurf.shapes.spacing import same_sheet

# A maximal Poisson-disk subset of about six random candidates a point, no two closer than this
# fraction of h, has about one point per h^(d-1).
DISK = 0.70


def poisson_disk(
    candidates: Float[AnyArray, "m d"],
    radius: float,
    *,
    normals: Float[AnyArray, "m d"] | None = None,
    seed: int = 0,
) -> Int[np.ndarray, " kept"]:
    """A random subset of the candidates, no two closer than `radius`, that cannot be enlarged.

    Args:
        candidates: points spread over the surface, `(m, d)`; several per disk.
        radius: smallest distance between two points kept, in the units of the points.
        normals: `(m, d)`; if given, points whose normals oppose each other may be closer.
        seed: of the random order in which candidates are tried.

    Returns:
        Sorted indices of the candidates that are kept.

    Raises:
        ValueError: the radius is not positive, candidates that are not finite (named by index),
            or shapes that do not belong together.
        TypeError: arrays or numbers of other kinds.

    Example:
        >>> points = np.random.default_rng(0).random((500, 2))
        >>> kept = points[js.poisson_disk(points, 0.1)]
        >>> gaps = np.linalg.norm(kept[:, None] - kept[None], axis=-1) + np.eye(len(kept))
        >>> bool(gaps.min() >= 0.1)
        True
    """
    candidates = checked_points(candidates, "candidates")
    real(radius, "radius", above=0)
    whole(seed, "seed", least=0)
    if normals is not None:
        normals = on_host(normals, "normals", candidates.shape)
    rank = np.random.default_rng(seed).permutation(len(candidates))
    pairs = cKDTree(candidates).query_pairs(radius, output_type="ndarray")
    if normals is not None:
        pairs = pairs[same_sheet(normals[pairs[:, 0]], normals[pairs[:, 1]])]
    earlier = rank[pairs[:, 0]] < rank[pairs[:, 1]]
    first, second = np.where(earlier, pairs.T, pairs.T[::-1])
    # All candidates that come before every rival still in the race are taken at once: the result
    # is that of trying them one by one in the order of their rank.
    kept = np.zeros(len(candidates), bool)
    racing = np.ones(len(candidates), bool)
    while racing.any():
        beaten = np.zeros(len(candidates), bool)
        beaten[second] = True
        winners = racing & ~beaten
        kept |= winners
        racing &= ~winners
        racing[second[winners[first]]] = False
        still = racing[first] & racing[second]
        first, second = first[still], second[still]
    return np.flatnonzero(kept)


def thin(
    candidates: np.ndarray, n: int, *, normals: np.ndarray | None = None, seed: int = 0
) -> np.ndarray:
    """Exactly n of the candidates, spread like a Poisson-disk sample.

    Args:
        candidates: points spread over the surface, `(m, d)`; five or more times n.
        n: how many to keep.
        normals: `(m, d)`; if given, sheets that face opposite ways are thinned independently.
        seed: of the random choice.

    Returns:
        Sorted indices, `(n,)`.

    Raises:
        ValueError: fewer candidates than n (both numbers given).

    Accuracy: smallest distance about 0.7 h (`tests/test_sampling.py::test_thin_is_a_disk_sample`).

    Example:
        >>> thin(np.random.default_rng(0).random((600, 2)), 100).shape
        (100,)
    """
    candidates = checked_points(candidates, "candidates")
    m, dim = candidates.shape
    if not 0 < whole(n, "n") <= m:
        raise ValueError(f"cannot choose n = {n} of {m} candidates")
    if n == m:
        return np.arange(m)
    radius = DISK * _candidate_spacing(candidates) * (m / n) ** (1 / (dim - 1))
    best = np.arange(m)
    for attempt in range(12):
        kept = poisson_disk(candidates, radius, normals=normals, seed=seed + attempt)
        if n <= len(kept) < len(best):
            best = kept
        if n <= len(best) <= max(1.05 * n, n + 2):
            break
        radius *= (len(kept) / (1.02 * n)) ** (1 / (dim - 1))
    return _drop_closest(candidates, best, n)


def checked_points(values, name: str) -> np.ndarray:
    points = on_host(values, name, *POINTS)
    raise_at(not_finite(points), f"{name}: point {{i}} is not finite: {{v}}", points)
    return in_range(points, name)


def _candidate_spacing(candidates: np.ndarray) -> float:
    """(measure / m)^(1 / (d - 1)) of m random candidates, guessed from a part of them."""
    dim, k = candidates.shape[1], min(16, len(candidates) - 1)
    some = candidates[:: max(1, len(candidates) // 2000)]
    radius = np.median(cKDTree(candidates).query(some, k=k + 1)[0][:, -1])
    ball = 2 * radius if dim == 2 else np.pi * radius**2
    extent = float(np.ptp(candidates, axis=0).max())
    return max(float((ball / k) ** (1 / (dim - 1))), 1e-9 * extent)


def _drop_closest(candidates: np.ndarray, kept: np.ndarray, n: int) -> np.ndarray:
    """Leave out one of each of the closest pairs, never two that share a neighbour, until n."""
    while len(kept) > n:
        distance, near = cKDTree(candidates[kept]).query(candidates[kept], k=2)
        held = np.zeros(len(kept), bool)
        dropped: list[int] = []
        for i in np.argsort(distance[:, 1], kind="stable"):
            if len(dropped) == len(kept) - n:
                break
            if not held[i]:
                dropped.append(i)
                held[near[i]] = True
        kept = np.delete(kept, dropped)
    return kept
