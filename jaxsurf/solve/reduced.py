"""The matrix of a problem with conditions, on the host, and whether it is singular."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse
import scipy.sparse.csgraph

from ..arguments import as_many, instance
from ..boundary import Closure, Restriction
from ..failures import is_concrete, needs_values, without_derivatives
from ..stencils.algebra import AbstractOperator, check_scalar
from ..stencils.stencil import Stencil

# Row sums up to this many times round-off are those of an operator that annihilates constants.
_ROUNDOFF = 32
# So many of a point's neighbours are strongly connected to it, and others by this much of that.
_NEAR, _FAR = 8, 1e-3


def check_kinds(operator, closure) -> None:
    """Refuse what is no operator on scalar fields, and what is no closure for it."""
    check_scalar(operator)
    if closure is not None:
        hint = "js.eliminate(cloud, conditions) makes one"
        instance(closure, Closure, "closure", hint)
        as_many("closure", closure.n, "the operator", operator.n)


def restriction_of(operator, closure) -> Restriction:
    """P: to the points that are switched on and not bound."""
    return Restriction(operator.n, closure, operator.active)


def free_operator(operator, closure) -> tuple[AbstractOperator, Restriction]:
    """P A E and P as operators."""
    restriction = restriction_of(operator, closure)
    if closure is not None:
        operator = operator @ closure.extension
    return operator if restriction.all_free else restriction @ operator, restriction


def stand_in(operator, closure) -> tuple[AbstractOperator, Closure | None]:
    """Concrete ones with the connections of a traced operator and closure, for aggregates.

    A point's nearest neighbours count alike, others hardly: of a Laplacian's weights that much is
    known without their values.

    Raises:
        ValueError: the connections are traced too.
    """
    whole = lambda x: isinstance(x, Stencil | Closure)
    return jax.tree.map(_stood_in, (operator, closure), is_leaf=whole)


def _stood_in(part):
    if is_concrete(part):
        return part
    if isinstance(part, Stencil):
        _known(part.indices, part.active)
        check_scalar(part)
        indices = np.asarray(part.indices)
        used = indices != np.arange(part.n)  # padding refers to the point itself
        weights = np.where(np.cumsum(used, axis=0) <= _NEAR, 1, _FAR) * used
        weights[0] -= weights.sum(axis=0)
        return Stencil(part.indices, jnp.asarray(weights), active=part.active)
    if isinstance(part, Closure):
        _known(part.rows, part.indices)
        even = np.full(part.weights.shape, 1 / max(len(part.weights), 1))
        return Closure(part.n, part.rows, part.indices, even)
    return np.ones(part.shape, part.dtype)


def _known(*connections) -> None:
    needs_values(
        "neighbours, mask and bound points",
        connections,
        instead="make the preconditioner outside jit and vmap, js.multigrid(..., renewable=True), "
        "and pass preconditioner=that.renewed(operator)",
    )


def free_matrix(operator, closure) -> scipy.sparse.csr_matrix:
    """P A E as a CSR matrix, zero in the rows of bound and of switched-off points.

    Raises:
        ValueError: traced or non-finite weights.
    """
    operator, closure = without_derivatives((operator, closure))
    if not is_concrete(operator, closure):
        raise ValueError(
            "multigrid is set up on concrete arrays: call js.multigrid or js.step_preconditioner "
            "outside jit and vmap, and pass its result as `preconditioner`; with renewable=True, "
            "renewed(...) serves traced operators"
        )
    matrix = operator.to_scipy()
    if not np.isfinite(matrix.data).all():
        i = np.searchsorted(matrix.indptr, np.argmin(np.isfinite(matrix.data)), "right") - 1
        raise ValueError(f"the operator has weights that are not finite, first at point {i}")
    if closure is not None:
        restriction, extension = (
            part.to_scipy() for part in (closure.restriction, closure.extension)
        )
        matrix = (restriction @ matrix @ extension).tocsr()
    if operator.active is not None:
        # In place: products change the order of the entries, and with it the aggregates.
        matrix.data *= np.repeat(np.asarray(operator.active), np.diff(matrix.indptr))
    if closure is not None or operator.active is not None:
        matrix.eliminate_zeros()
    return matrix


def reduced_matrix(operator, closure) -> scipy.sparse.csr_matrix:
    """P A E with the identity at points that are bound or switched off, as a CSR matrix.

    Raises:
        ValueError: traced or non-finite weights, or a zero row.
    """
    matrix = free_matrix(operator, closure)
    if closure is not None:
        bound = np.asarray(closure.bound).astype(matrix.dtype)
        matrix = (matrix + scipy.sparse.diags(bound)).tocsr()
    if operator.active is not None:
        off = np.flatnonzero(~np.asarray(operator.active))
        place = matrix.indptr[off]
        data, columns = np.insert(matrix.data, place, 1), np.insert(matrix.indices, place, off)
        pointers = matrix.indptr + np.searchsorted(off, np.arange(len(matrix.indptr)))
        matrix = scipy.sparse.csr_matrix((data, columns, pointers), shape=matrix.shape)
    empty = np.flatnonzero(np.diff(matrix.indptr) == 0)
    if empty.size:
        raise ValueError(
            f"row {empty[0]} of the operator is zero ({empty.size} such rows): nothing "
            "determines the value there"
        )
    return matrix


def annihilates_constants(matrix, free: np.ndarray) -> bool:
    """Whether the constants on the free points are in the null space, by the row sums.

    Raises:
        ValueError: they are on one of several disconnected parts.
    """
    # Entries of free rows are in free columns.
    sums = np.abs(np.add.reduceat(matrix.data, matrix.indptr[:-1]))
    sizes = np.add.reduceat(np.abs(matrix.data), matrix.indptr[:-1])
    loose = free & (sums <= _ROUNDOFF * np.finfo(matrix.dtype).eps * sizes)
    if not loose.any():
        return False
    count, part = scipy.sparse.csgraph.connected_components(matrix, directed=False)
    tied = np.zeros(count, bool)
    tied[part[free & ~loose]] = True
    tied[part[~free]] = True
    if tied.all():
        return False
    size = np.bincount(part[free], minlength=count)
    parts = np.count_nonzero(size)
    if parts == 1:
        return True
    i = int(np.flatnonzero(~tied)[0])
    raise ValueError(
        f"singular system: the points fall into {parts} parts that no stencil connects, and on "
        f"the one of {size[i]} points around point {int(np.argmax(part == i))} the solution is "
        "determined up to a constant only. Solve the parts one by one, or prescribe a value there"
    )
