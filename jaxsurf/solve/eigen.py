r"""Eigenmodes of an operator, computed on the host, with exact derivatives."""

from __future__ import annotations

import functools
import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..arguments import count_on, instance, precision_of, real, switched_off, whole
from ..boundary import Closure, check_border
from ..failures import is_concrete, is_marking
from ..stencils.algebra import AbstractOperator, check_scalar
from . import invariant
from .invariant import Subspace


class Modes(eqx.Module):
    r"""Lowest modes of minus an operator, $-A f = \lambda f$.

    Args:
        values: real parts of the eigenvalues, ascending, `(k,)`.
        functions: one mode per column, of mean square one over the free points, `(n, k)`.
        imaginary: imaginary parts of the eigenvalues, in size, `(k,)`; zero but for errors of
            the discretisation, and a warning that it is coarse where they are not.
        residuals: $\|A f_i + \sum_j f_j b_{ji}\| / \|f_i\|$ with j in the group of i, `(k,)`, in
            units of the values.
        groups: number of the group of equal values that each mode belongs to, `(k,)`.

    Example:
        >>> modes = js.eigenmodes(js.laplace_beltrami(js.sphere(300)), 4)
        >>> modes.values.shape, modes.functions.shape
        ((4,), (300, 4))
    """

    values: Float[Array, " k"]
    functions: Float[Array, "n k"]
    imaginary: Float[Array, " k"]
    residuals: Float[Array, " k"]
    groups: Int[Array, " k"]

    def __repr__(self):
        n, k = self.functions.shape
        return f"Modes({k} modes of {n} points, {self._described()})"

    def _described(self) -> str:
        if not is_concrete(self.values, self.residuals):
            return "traced"
        values = ", ".join(f"{v:.4g}" for v in np.asarray(self.values)[:6])
        more = ", ..." if len(self.values) > 6 else ""
        return f"values {values}{more}, residuals up to {float(np.max(self.residuals)):.1e}"


def eigenmodes(
    operator: AbstractOperator,
    k: int,
    *,
    closure: Closure | None = None,
    degenerate: float = 1e-3,
) -> Modes:
    r"""The lowest k modes of minus an operator, as a rule the Laplace–Beltrami operator.

    Shift and invert on the host: Arnoldi's method for $(-A - \sigma)^{-1}$ with a small
    $\sigma < 0$, by sparse LU up to 20,000 points and by multigrid beyond.

    The matrix of a collocation method is not symmetric, and equal eigenvalues of the surface
    come out as a cluster. Values that differ by less than the share `degenerate` form a group.
    The functions of a group are an orthonormal basis of the space that it spans (for a
    single mode: the function and its sign), fixed by that space alone and smooth in it.

    Args:
        operator: takes and gives scalar fields; its eigenvalues have real parts ≤ 0 but for a
            few close to zero.
        k: number of modes, the constants of a closed surface counted. A group cut off by k
            has neither a symmetric function nor a whole basis: see `groups`.
        closure: from `eliminate`; their homogeneous part defines the modes. Closed surfaces,
            and borders that the operator itself provides for, need none.
        degenerate: relative distance of neighbouring values within a group.

    Returns:
        Values, functions, and how good they are.

    Accuracy: that of the operator: with n = 10,000 and order 4 the first 24 non-zero values
    within 1e-5 on the unit sphere (`tests/test_eigen.py`); those of `js.eigenvalues` are mostly
    more accurate from degree 3 on (not on a sphere, see there). In float32 values are within 1e-3
    on 500 points (`tests/test_eigen.py`), their gradients in the points within 1 %
    (`tests/test_forms.py`).
    Differentiable: once, forward and reverse, in the weights of the operator (so in points and
    normals) and of the conditions. Values: exactly, unless two of a group coincide to
    round-off, of which then only symmetric functions (sums over the group) have derivatives.
    Functions: for single modes, and for the bases of groups as long as they stay groups.
    Raises:
        TypeError: what is no operator or closure; a k that is no whole number.
        ValueError: an operator with components; k < 1 or too many modes for the points; a
            border without conditions, which gives modes that grow; an operator whose
            eigenvalues are positive; a group that goes on beyond
            the modes computed.
        RuntimeError: the iteration has not converged.

    Example:
        >>> modes = js.eigenmodes(js.laplace_beltrami(js.sphere(2_000)), 4)
        >>> bool(jnp.allclose(modes.values, jnp.array([0.0, 2.0, 2.0, 2.0]), atol=0.01))
        True
    """
    check_scalar(operator)
    if closure is not None:
        instance(closure, Closure, "closure", "js.eliminate(cloud, conditions) makes one")
    check_border(operator, closure)
    k, degenerate = _asked(operator, k, degenerate)
    system = _System.of(operator, closure)
    values, functions, *others = _modes(system, k, degenerate, k)
    if closure is not None:
        functions = closure.homogeneous(functions)
    return Modes(values, switched_off(operator.active, functions), *others)


def lowest_space(operator: AbstractOperator, k: int, degenerate: float) -> Float[Array, "n K"]:
    """Functions of the lowest k modes of minus an operator, and of those in the groups of these.

    A basis as `eigenmodes` has it, with its derivatives; columns beyond the last group are zero.
    """
    k, degenerate = _asked(operator, k, degenerate)
    _, functions, _, _, groups = _modes(_System.of(operator, None), k, degenerate, None)
    return jnp.where(groups <= groups[k - 1], functions, 0)


def _asked(operator: AbstractOperator, k: int, degenerate: float) -> tuple[int, float]:
    k, degenerate = whole(k, "k"), float(real(degenerate, "degenerate", least=0, below=1))
    n = operator.n
    if is_concrete(operator.active):
        n = int(count_on(operator.active, n))
    if not 1 <= k <= n // 2:
        raise ValueError(f"k = {k} modes, between 1 and n / 2 = {n // 2} can be computed")
    return k, degenerate


class _System(eqx.Module):
    """M = -P A E on fields that vanish at bound points."""

    operator: AbstractOperator
    free: Bool[Array, " n"]

    @staticmethod
    def of(operator: AbstractOperator, closure: Closure | None) -> _System:
        if closure is None:
            on = operator.active
            return _System(operator, jnp.ones(operator.n, bool) if on is None else on)
        free = switched_off(operator.active, _free(closure))
        return _System(closure.reduce(operator), free)

    def __call__(self, fields: Float[Array, "n c"]) -> Float[Array, "n c"]:
        return -self.operator(fields)

    def to_scipy(self):
        """The matrix of the free points, and which they are."""
        free = np.flatnonzero(np.asarray(self.free))
        return -self.operator.to_scipy().astype(float)[free][:, free], free


@eqx.filter_jit
def _free(closure: Closure) -> Bool[Array, " n"]:
    return ~closure.bound


# --- the rule -------------------------------------------------------------------------------


@eqx.filter_custom_jvp
def _modes(system: _System, k: int, degenerate: float, count: int | None):
    """The first `count` of the modes computed, or all, of which k are in complete groups."""
    return _results(system, _subspace(system, k, degenerate, left=False), count)


@_modes.def_jvp
def _modes_jvp(primals, tangents):
    system, k, degenerate, count = primals
    space = _subspace(system, k, degenerate, left=True)
    values, functions, *others = _results(system, space, count)
    if not jax.tree.leaves(tangents[0]):
        return (values, functions, *others), (None,) * 5

    dots = (dot[..., :count] for dot in _tangents(system, tangents[0], space, k))
    return (values, functions, *others), (*dots, None, None, None)


def _tangents(system: _System, system_dot: _System, space: Subspace, k: int):
    """Of values and functions; zero for the functions of groups that nobody asked for."""
    # The tangent of M V, with V held.
    change = eqx.filter_jvp(lambda m: m(space.right), (system,), (system_dot,))[1]
    same = space.groups[:, None] == space.groups
    # Within a group: that of an eigenvalue is y^H dM x, with its left and right vectors.
    inner = jnp.where(same, space.left.T @ change, 0)
    values_dot = jnp.einsum("ia,ab,bi->i", space.unmix, inner, space.mix).real
    # Out of the group: M dV - dV B = -(1 - V W^T) dM V turns its space.
    wanted = space.groups <= space.groups[k - 1]
    turn = _sylvester(system, space, jnp.where(wanted, space.right @ inner - change, 0))
    basis = lambda span: _basis(span, same, _reference(system, k))
    functions_dot = jax.jvp(basis, (space.right,), (turn,))[1]
    functions_dot = functions_dot * jnp.sqrt(jnp.sum(system.free).astype(functions_dot.dtype))
    return values_dot.astype(space.values.dtype), functions_dot


def _subspace(system: _System, k: int, degenerate: float, *, left: bool) -> Subspace:
    reference = _reference(system, k)
    n, count = reference.shape

    def compute(system, reference):
        matrix, free = system.to_scipy()
        mean = matrix.diagonal().mean()
        if mean < 0:
            raise ValueError(
                f"the eigenvalues of the operator have the mean {-mean:.3g}, expected one below 0, "
                "as of a Laplacian: modes are those of minus it. Give -operator, if it is not a "
                "Laplacian with growing modes (js.spectral_estimate)"
            )
        space = invariant.subspace(matrix, reference[free].astype(float), k, degenerate, left=left)
        return _spread(space, free, n, reference.dtype)

    real, whole = reference.dtype, jnp.result_type(int)
    shapes = Subspace(
        values=(real, count),
        imaginary=(real, count),
        groups=(whole, count),
        right=(real, n, count),
        left=(real, n, count),
        block=(real, count, count),
        mix=(jnp.result_type(real, complex), count, count),
        unmix=(jnp.result_type(real, complex), count, count),
        scale=(real,),
    )
    shapes = Subspace(*(jax.ShapeDtypeStruct(size, kind) for kind, *size in shapes))
    return _on_host(compute, shapes, system, reference)


def _reference(system: _System, k: int) -> Float[Array, "n K"]:
    """Noise around one that fixes the basis of every group (modes of one sign are positive).

    For the modes asked for and some more: those end the last group, and with them out of the
    way derivatives converge fast.
    """
    n = system.operator.n
    noise = _noise(n, min(k + 8 + 2 * math.isqrt(k), n), precision_of(system))
    on = system.operator.active
    # As without those that are switched off.
    return noise if on is None else noise[jnp.maximum(jnp.cumsum(on) - 1, 0)]


@functools.partial(jax.jit, static_argnums=(0, 1, 2))
def _noise(n: int, count: int, dtype) -> Float[Array, "n K"]:
    column = lambda j: jax.random.normal(jax.random.key(j), (n,), dtype)
    return 1 + jax.vmap(column)(jnp.arange(count)).T


@eqx.filter_jit
def _results(system: _System, space: Subspace, count: int | None):
    functions = space.right[:, :count]
    residual = system(functions) - space.right @ space.block[:, :count]
    residuals = jnp.linalg.norm(residual, axis=0) / jnp.linalg.norm(functions, axis=0)
    return space.values[:count], functions, space.imaginary[:count], residuals, space.groups[:count]


def _basis(span, same, reference):
    """`invariant.orthonormal` for all groups at once, in JAX."""

    def inner(a, b):
        return jnp.where(same, a.T @ b, 0)

    # The rows and columns that belong to no complete group are zero: one on their diagonal.
    fill = jnp.diag(jnp.sum(span**2, axis=0) == 0).astype(span.dtype)
    projected = span @ jnp.linalg.solve(inner(span, span) + fill, inner(span, reference))
    factor = jnp.linalg.cholesky(inner(projected, projected) + fill)
    return jax.scipy.linalg.solve_triangular(factor, projected.T, lower=True).T


def _sylvester(system: _System, space: Subspace, rhs: Float[Array, "n K"]) -> Float[Array, "n K"]:
    r"""X with $M X - X B + s V (W^T X)_{\text{group}} = R$; the last term chooses a basis."""
    same = space.groups[:, None] == space.groups

    def matvec(x):
        inner = jnp.where(same, space.left.T @ x, 0)
        return system(x) - x @ space.block + space.scale * (space.right @ inner)

    def solve(b, space, transposed):
        def compute(system, space, b):
            matrix, free = system.to_scipy()
            matrix = matrix.T.tocsr() if transposed else matrix
            space = space._replace(right=space.right[free], left=space.left[free])
            return _spread(invariant.sylvester(matrix, space, b[free]), free, *like)

        like = b.shape[0], b.dtype
        return _on_host(compute, jax.ShapeDtypeStruct(b.shape, b.dtype), system, space, b)

    other = space._replace(
        right=space.left,
        left=space.right,
        block=space.block.T,
        mix=space.unmix.T,
        unmix=space.mix.T,
    )
    return jax.lax.custom_linear_solve(
        matvec,
        rhs,
        lambda _, b: solve(b, space, False),
        lambda _, b: solve(b, other, True),
    )


# --- to the host and back -------------------------------------------------------------------


def _on_host(function, shapes, *arguments):
    """Call a function of NumPy arrays: at once if their values are known, else when they are.

    Where bad results are to be marked (`marking`) all is NaN instead of an error.
    """
    arrays, static = eqx.partition(arguments, eqx.is_array)
    marked = is_marking() and not is_concrete(arrays)

    def call(arrays):
        arrays = jax.tree.map(np.asarray, arrays)
        try:
            if marked and not all(np.isfinite(a).all() for a in jax.tree.leaves(arrays)):
                raise ValueError("arrays are not finite")
            return function(*eqx.combine(arrays, static))
        except (ValueError, RuntimeError):
            if not marked:
                raise
            return jax.tree.map(_nothing, shapes)

    if is_concrete(arrays):
        found = call(arrays)
        return jax.tree.map(lambda a, shape: jnp.asarray(a, shape.dtype), found, shapes)

    @jax.custom_jvp
    def called(arrays):
        return jax.pure_callback(call, shapes, arrays, vmap_method="sequential")

    called.defjvp(_refuse_derivatives)
    return called(arrays)


def _refuse_derivatives(primals, tangents):
    raise TypeError(
        "eigenmodes and eigenvalues are differentiated once only: take differences of their first "
        "derivatives for second ones"
    )


def _nothing(shape: jax.ShapeDtypeStruct) -> np.ndarray:
    """NaN, or where there is none for numbers of that kind, 0."""
    inexact = jnp.issubdtype(shape.dtype, jnp.inexact)
    return np.full(shape.shape, np.nan if inexact else 0, shape.dtype)


def _spread(tree, free, n: int, dtype):
    """Rows of free points put in their places among all n, numbers in the precision asked for."""

    def one(a):
        kind = jnp.result_type(dtype, complex) if np.iscomplexobj(a) else dtype
        kind = jnp.result_type(int) if a.dtype.kind == "i" else kind
        return a.astype(kind)

    def place(a):
        out = np.zeros((n, *a.shape[1:]), a.dtype)
        out[free] = a
        return out

    if isinstance(tree, Subspace):
        tree = tree._replace(right=place(tree.right), left=place(tree.left))
        return jax.tree.map(one, tree)
    return one(place(tree))
