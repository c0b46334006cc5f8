"""Operators on fields in the interface of lineax."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import lineax as lx
import numpy as np


class Square(lx.AbstractLinearOperator):
    """A linear map of fields for lineax, of which nothing but products is known."""

    def out_structure(self):
        return self.in_structure()

    def as_matrix(self):
        raise NotImplementedError("an n x n array is what these operators avoid")


def matrix_free(kind):
    """Tell lineax that a class of `Square` operators has no properties to make use of."""
    lx.linearise.register(kind, lambda operator: operator)
    lx.conj.register(kind, lambda operator: operator)
    for has_property in (
        lx.is_symmetric,
        lx.is_diagonal,
        lx.is_tridiagonal,
        lx.is_lower_triangular,
        lx.is_upper_triangular,
        lx.is_positive_semidefinite,
        lx.is_negative_semidefinite,
        lx.has_unit_diagonal,
    ):
        has_property.register(kind, lambda operator: False)
    return kind


@matrix_free
class Action(Square):
    """An operator of the algebra on one field of numbers of one kind; transposed as there."""

    operator: Any
    dtype: np.dtype = eqx.field(static=True)

    def mv(self, vector):
        return self.operator(vector).astype(vector.dtype)

    def transpose(self):
        return Action(self.operator.transpose(), self.dtype)

    def in_structure(self):
        return jax.ShapeDtypeStruct((self.operator.n, *self.operator.in_shape), self.dtype)

    def out_structure(self):
        return jax.ShapeDtypeStruct((self.operator.n, *self.operator.out_shape), self.dtype)
