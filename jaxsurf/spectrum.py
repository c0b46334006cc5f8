r"""What an operator does to time integration: its outermost and its rightmost eigenvalues."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from .arguments import whole
from .failures import needs_values, raise_at, warn
from .stencils.algebra import AbstractOperator, Composition, check_scalar

# Operators on fewer points are treated as matrices.
_DENSE = 150
# How many vectors are tried before the search is given up; then, too, up to so many points.
_PATIENCE = 250
_LARGE = 1_000
# Residuals, in units of the norm, that decide: of the outermost pair, of the rightmost one, and
# of those next to it, which have to be known to say that none of them is further to the right.
_OUTER, _RIGHT, _NEXT = 1e-2, 1e-9, 1e-3


class Spectrum(NamedTuple):
    r"""Outer eigenvalues of an operator.

    Args:
        radius: largest modulus.
        abscissa: largest real part.
        residual: $\|A x - \lambda x\| / \|x\|$ of the pair with that real part. There is an
            operator at this distance from A in the 2-norm of which λ is an exact eigenvalue.

    Example:
        >>> spectrum = js.spectral_estimate(js.laplace_beltrami(js.sphere(300)))
        >>> bool(spectrum.radius > 10), bool(spectrum.abscissa < 1)
        (True, True)
    """

    radius: float
    abscissa: float
    residual: float


def spectral_estimate(operator: AbstractOperator, *, steps: int = 40, degree: int = 24) -> Spectrum:
    r"""Largest modulus and largest real part of an operator's eigenvalues.

    Both by Rayleigh and Ritz: A is projected on a space with an orthonormal basis, which grows by
    the residual of the best pair and is cut back to its best half when it is full. In the search
    for the largest real part that residual first passes a Chebyshev polynomial of A (Zhou and
    Saad 2007), of the ellipse that shrinks the left part of the spectrum most beside its
    rightmost point: an interval for heat, a disc or an upright ellipse for waves. The search
    ends when residuals say that the pair is one. On few points all eigenvalues are computed.

    Args:
        operator: takes and gives scalar fields; concrete.
        steps: most dimensions of the space.
        degree: of the polynomial.

    Returns:
        The two numbers, in units of the operator, and how far the second is from an eigenvalue.
        An explicit step of length dt is stable if dt times the radius is within the solver's limit
        and the abscissa is not positive.

    Accuracy: the radius within a per cent, the abscissa within 1e-9 of the radius, each times the
    condition number of its eigenvalue, in both precisions and for any number of steps
    (`tests/test_spectrum.py`). Where the search was given up for the abscissa (many eigenvalues
    with almost the same real part, as of advection) a warning says so, and `residual` how far
    it came. In float32 weights change the abscissa by less than 1e-5 of it
    (`tests/test_spectrum.py`).
    Raises:
        TypeError: no operator.
        ValueError: an operator with components, a traced one, weights that are not finite.

    Example:
        >>> spectrum = js.spectral_estimate(js.laplace_beltrami(js.sphere(1_000)))
        >>> bool(spectrum.abscissa < 1e-9 * spectrum.radius)
        True
    """
    check_scalar(operator)
    steps, degree = whole(steps, "steps", least=8), whole(degree, "degree", least=1)
    needs_values("operator", operator, instead="spectra are estimated outside jit and grad")
    on = slice(None) if operator.active is None else np.flatnonzero(np.asarray(operator.active))
    apply, scale = _scaled(operator, on)
    n = len(np.arange(operator.n)[on])
    if scale == 0:
        return Spectrum(0.0, 0.0, 0.0)
    if n <= max(_DENSE, 2 * steps):
        return _dense(apply, n, scale)

    # The constants, of which a closed surface's operators know all, and noise.
    start = np.stack([np.ones(n), np.random.default_rng(0).normal(size=n)], axis=1)
    outer = _Search(apply, start, steps, key=abs)
    outer.run([_OUTER], lambda i: outer.residual(i))
    hull = outer.values
    search = _Search(apply, np.concatenate([start, outer.best(3)], axis=1), steps, key=np.real)

    def damped(i):
        found = search.best(i)
        deflated = lambda v: v - found @ (found.T @ v)
        filter_ = _ellipse(search.values[i:], hull, steps // 4, degree)
        if filter_ is None:
            return search.residual(i)
        x = search.vector(i)
        return _chebyshev(lambda v: deflated(apply(v)), deflated(x), *filter_)

    residual = search.run([_RIGHT] + 3 * [_NEXT], damped)
    value = search.values[0]
    radius = max(abs(hull[0]), abs(value))
    if residual > 10 * _RIGHT * radius:
        if n <= _LARGE:
            return _dense(apply, n, scale)
        warn(
            f"the abscissa {scale * value.real:.3g} of an operator of radius {scale * radius:.3g} "
            f"is known up to a residual of {scale * residual:.1e} only: many eigenvalues have "
            f"almost the same real part. More than steps = {steps} or a degree above {degree} "
            "may tell them apart"
        )
    return Spectrum(*(float(scale * a) for a in (radius, value.real, residual)))


def _dense(apply: Callable, n: int, scale: float) -> Spectrum:
    values, vectors = np.linalg.eig(apply(np.eye(n)))
    right = int(values.real.argmax())
    residual = np.linalg.norm(_of(apply, vectors[:, right]) - values[right] * vectors[:, right])
    return Spectrum(*(float(scale * a) for a in (abs(values).max(), values[right].real, residual)))


class _Search:
    """An orthonormal basis, what the operator makes of it, and the eigenpairs seen in it."""

    def __init__(self, apply: Callable, start: Float[np.ndarray, "n m"], steps: int, key):
        n = len(start)
        self.apply, self.key, self.noise = apply, key, np.random.default_rng(1)
        self.basis, self.image = np.zeros((n, steps), order="F"), np.zeros((n, steps), order="F")
        self.size, self.projected = 0, np.zeros((steps, steps))
        for column in start.T:
            self.add(column)

    def add(self, v: Float[np.ndarray, " n"]) -> None:
        """Take in a vector, or noise if there is nothing new in it."""
        m = self.size
        v = _orthonormal(v, self.basis[:, :m])
        while v is None:
            v = _orthonormal(self.noise.normal(size=len(self.basis)), self.basis[:, :m])
        self.basis[:, m], self.image[:, m] = v, self.apply(v)
        self.size = m + 1
        self.projected[: m + 1, m] = self.basis[:, : m + 1].T @ self.image[:, m]
        self.projected[m, :m] = v @ self.image[:, :m]

    def run(self, bounds: list[float], direction: Callable) -> float:
        """Add directions, of the first pair whose residual is not small; the first residual."""
        capacity = self.basis.shape[1]
        for patience in reversed(range(_PATIENCE)):
            values, vectors = np.linalg.eig(self.projected[: self.size, : self.size])
            order = np.argsort(-self.key(values), kind="stable")
            self.values, self.vectors = values[order], vectors[:, order]
            size = [
                np.linalg.norm(self.residual(i)) / abs(values).max() for i in range(len(bounds))
            ]
            unknown = [i for i, bound in enumerate(bounds) if size[i] > bound]
            if not unknown or not patience:
                break
            new = direction(unknown[0])
            if self.size + 2 > capacity:
                self.cut(capacity // 2)
            for part in (new.real, new.imag)[: 1 + np.iscomplexobj(new)]:
                self.add(part)
        return float(np.linalg.norm(self.residual(0)))

    def vector(self, i: int):
        """Eigenvector of pair i."""
        return _of(self.basis[:, : self.size].__matmul__, self.pair(i)[1])

    def residual(self, i: int):
        """What is left of A x - λ x."""
        (value, y), m = self.pair(i), self.size
        image = _of(self.image[:, :m].__matmul__, y)
        return image - _of(self.basis[:, :m].__matmul__, value * y)

    def pair(self, i: int):
        """Value and coefficients, real if the value is."""
        value, y = self.values[i], self.vectors[:, i]
        return (value.real, y.real) if value.imag == 0 else (value, y)

    def best(self, count: int) -> Float[np.ndarray, "n m"]:
        """A basis of what the first pairs span, complex ones whole."""
        return self.basis[:, : self.size] @ self.span(count)

    def span(self, count: int) -> Float[np.ndarray, "m r"]:
        """Its coefficients."""
        y = self.vectors[:, :count]
        parts, size, _ = np.linalg.svd(
            np.concatenate([y.real, y.imag], axis=1), full_matrices=False
        )
        return parts[:, size > 1e-12 * size.max(initial=0)]

    def cut(self, count: int) -> None:
        """Keep the best pairs."""
        q = self.span(count)
        m, self.size = self.size, q.shape[1]
        for a in (self.basis, self.image):
            a[:, : self.size] = a[:, :m] @ q
        self.projected[: self.size, : self.size] = q.T @ self.projected[:m, :m] @ q


def _orthonormal(v: Float[np.ndarray, " n"], basis: Float[np.ndarray, "n m"]):
    """The part of v that is orthogonal to a basis, of length one; None if it is round-off.

    One projection leaves round-off of the size of what it took away: it is repeated until it
    takes nothing away.
    """
    size = np.linalg.norm(v)
    if not 0 < size < np.inf:
        return None
    v = v / size
    for _ in range(5):
        before, v = np.linalg.norm(v), v - basis @ (basis.T @ v)
        after = np.linalg.norm(v)
        if after < 1e-13:
            return None
        v = v / after
        if after > 0.9 * before:
            return v
    return None


def _chebyshev(apply, v, center: float, focus: float, degree: int):
    """Chebyshev polynomial of the ellipses with a center and foci at a squared distance from it.

    The vectors are scaled as they come: their direction is what counts.
    """
    shifted = lambda v: _of(apply, v) - center * v
    last, now = v, shifted(v)
    for _ in range(degree - 1):
        last, now = now, 2 * shifted(now) - focus * last
        size = np.linalg.norm(now)
        if not size > 0:
            break
        last, now = last / size, now / size
    return now


def _of(apply: Callable, v):
    """The image of a vector that may be complex."""
    return apply(v.real) + 1j * apply(v.imag) if np.iscomplexobj(v) else apply(v)


def _ellipse(values, hull, wanted: int, degree: int) -> tuple[float, float, int] | None:
    """Center, squared focal distance and degree that bring out the rightmost value.

    Tried are ellipses of all shapes with centers between the others; what a polynomial does to a
    value is, to the power of its degree, `growth`.
    """
    first, wanted = values[0], min(wanted, len(values) - 1)
    others = np.concatenate([values[wanted:], hull])
    others = others[others.real <= values[wanted].real]
    if not others.size:
        return None
    left, right = others.real.min() - 0.02 * abs(hull[0]), others.real.max()
    center = np.linspace(left, right, 16)[1:-1, None]
    focus = np.concatenate([-np.geomspace(1, 1e-3, 6), [0.0], np.geomspace(1e-3, 1, 12)])
    focus = focus * np.maximum(abs(hull[0]) ** 2 * (focus < 0), (right - center) ** 2)

    def growth(z):
        z = z - center[..., None]
        root = np.sqrt(z**2 - focus[..., None] + 0j)
        return np.maximum(abs(z + root), abs(z - root))

    # The left end may be a little beyond what has been seen of it.
    ratio = growth(np.append(others, left)).max(axis=-1) / growth(first[None])[..., 0]
    best = np.unravel_index(ratio.argmin(), ratio.shape)
    if ratio[best] > 0.995:
        return None
    # Contrast beyond 1e8 is lost in round-off, and with it what grows a little less.
    enough = np.log(1e-8) / np.log(ratio[best])
    return float(center[best[0], 0]), float(focus[best]), int(np.clip(enough, 1, degree))


def _scaled(operator: AbstractOperator, on) -> tuple[Callable, float]:
    """Products with the operator divided by a bound of its norm, in double precision; the bound.

    Of the points that are on.
    """
    if isinstance(operator, Composition):
        (outer, one), (inner, other) = _scaled(operator.outer, on), _scaled(operator.inner, on)
        return lambda v: outer(inner(v)), one * other
    matrix = operator.to_scipy().tocsr().astype(float)
    if not isinstance(on, slice):
        matrix = matrix[on][:, on]
    matrix.sum_duplicates()
    names = np.arange(operator.n)[on]
    rows = np.repeat(names, np.diff(matrix.indptr))
    text = "operator has weights that are not finite at point {i}"
    raise_at(~np.isfinite(matrix.data), text, points=rows)
    largest = abs(matrix.data).max(initial=0)
    if largest == 0:
        return lambda v: 0 * v, 0.0
    matrix.data /= largest
    rows = abs(matrix).sum(axis=1).max()
    matrix.data /= rows
    return matrix.__matmul__, float(largest * rows)
