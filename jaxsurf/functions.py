r"""Functions as the programs that they run, told apart by what they compute.

To `jax.jit` every new lambda is another function, and each makes it compile again, even where the
code is the same; and what a function closes over is a constant of the program. Here a function is
traced to its program: the arrays it closes over and the real numbers in it become arguments, and
two programs are equal when they do the same to their arguments.
"""

from __future__ import annotations

import hashlib
import re
import weakref
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import ClosedJaxpr, Jaxpr, Literal, Var
from jaxtyping import Array, PyTree

# Derivatives that are compared of functions with rules of their own, one after another.
_DERIVATIVES = 2


class Traced(eqx.Module):
    """A function as a program and the arrays that it closes over: made by `canonical`.

    Args:
        constants: the arrays.
        program: what is done to them and the arguments.
    """

    constants: list[Any]
    program: Program = eqx.field(static=True)

    def __call__(self, *args):
        return self.program.run(self.constants, args)

    @property
    def reads_first(self) -> bool:
        """False if no operation reads the first argument, a number."""
        return self.program.reads_first


def canonical(f: Callable, *examples: Any) -> Traced:
    """The function as a program, for arguments of the shapes and types of the examples.

    Arrays that f closes over (traced ones too) or that are leaves of it (an `eqx.Module` or one of
    its methods) become leaves of the result, and carry derivatives and batches as before.

    Args:
        f: can be traced by JAX; returns arrays.
        examples: one for each argument. Arrays and numbers become arguments of the program; all
            else (text, True and False) is a part of it.
    """
    leaves, static = eqx.partition((f, numbers_as_arrays(examples)), eqx.is_array)
    flat, structure = jax.tree.flatten(leaves)
    results = []

    def run(*flat):
        f, args = eqx.combine(jax.tree.unflatten(structure, flat), static)
        out, result = jax.tree.flatten(f(*args))
        results.append(result)
        return out

    closed = jax.make_jaxpr(run)(*flat)
    jaxpr, numbers = _without_numbers(_what_counts(closed.jaxpr))
    own = len(jax.tree.leaves(leaves[0]))
    kept = _read(jaxpr)
    inputs = [*jaxpr.constvars, *jaxpr.invars]
    constants = [*closed.consts, *numbers, *flat[:own]]
    used = [i for i in range(len(constants)) if inputs[i] in kept]
    order = tuple(used), tuple(range(len(constants), len(inputs)))
    program = Program(jaxpr, order, _structure(leaves[1], static[1]), results[0])
    return Traced([jnp.asarray(constants[i]) for i in used], program)


def numbers_as_arrays(tree: PyTree) -> PyTree:
    """The same with its numbers as arrays, which do not make anything compile again.

    They stay weakly typed: they do not change the precision of what they are combined with.
    """

    def array(leaf):
        number = isinstance(leaf, int | float | np.number) and not isinstance(leaf, bool)
        return jnp.asarray(leaf) if number or isinstance(leaf, np.ndarray) else leaf

    return jax.tree.map(array, tree)


def constant(tree: PyTree) -> PyTree:
    """The same values, constants to differentiation."""
    return jax.tree.map(lambda x: jax.lax.stop_gradient(x) if eqx.is_array(x) else x, tree)


class Program:
    """A jaxpr and the structure of its arguments and results, equal to others that do the same.

    Args:
        jaxpr: the program.
        order: which of its inputs, constants first, are the constants kept and the arguments.
        taken, given: structures of arguments and results.
    """

    def __init__(self, jaxpr: Jaxpr, order, taken, given):
        self._jaxpr, self._order, self._taken, self._given = jaxpr, order, taken, given
        self._key = (_new_key(jaxpr, _rules(_DERIVATIVES)), order, taken, given)
        self._hash = hash(self._key)

    @property
    def reads_first(self) -> bool:
        inputs = (*self._jaxpr.constvars, *self._jaxpr.invars)
        return inputs[self._order[1][0]] in _read(self._jaxpr)

    def run(self, constants, args):
        leaves, static = eqx.partition(numbers_as_arrays(args), eqx.is_array)
        if (taken := _structure(leaves, static)) != self._taken:
            raise ValueError(f"arguments {taken}, the program was made for {self._taken}")
        # What is not read may be anything.
        inputs: list[Any] = [None] * (len(self._jaxpr.constvars) + len(self._jaxpr.invars))
        for i, value in zip(sum(self._order, ()), [*constants, *jax.tree.leaves(leaves)]):
            inputs[i] = value
        count = len(self._jaxpr.constvars)
        out = jax.core.eval_jaxpr(self._jaxpr, inputs[:count], *inputs[count:])
        # A result that is a constant comes as the number that the program holds.
        return jax.tree.unflatten(self._given, map(jnp.asarray, out))

    def __hash__(self):
        return self._hash

    def __eq__(self, other):
        return self is other or (
            isinstance(other, Program) and self._hash == other._hash and self._key == other._key
        )

    def __repr__(self):
        """Tells programs apart, in another process too."""
        text = re.sub(r"0x[0-9a-f]+", "", repr(self._key))
        return f"Program({hashlib.sha256(text.encode()).hexdigest()})"


def _what_counts(jaxpr: Jaxpr) -> Jaxpr:
    """The program without operations that nothing needs.

    Looks at what is beneath a tracer (`failures.without_derivatives`) are such: calls with a
    derivative rule, which is another function each time.
    """
    needed, kept = {v for v in jaxpr.outvars if not isinstance(v, Literal)}, []
    for equation in reversed(jaxpr.eqns):
        if equation.effects or needed.intersection(equation.outvars):
            kept.append(equation)
            needed.update(v for v in equation.invars if not isinstance(v, Literal))
    return jaxpr.replace(eqns=kept[::-1])


def _without_numbers(jaxpr: Jaxpr) -> tuple[Jaxpr, list[Array]]:
    """The program with the real numbers in its operations as further constants."""
    numbers: list[Array] = []
    names = []

    def replaced(v):
        dtype = getattr(v.aval, "dtype", None)
        if not (isinstance(v, Literal) and dtype and jnp.issubdtype(dtype, jnp.floating)):
            return v
        numbers.append(jnp.asarray(v.val, dtype))
        names.append(Var(v.aval))
        return names[-1]

    equations = [e.replace(invars=[replaced(v) for v in e.invars]) for e in jaxpr.eqns]
    return jaxpr.replace(eqns=equations, constvars=[*jaxpr.constvars, *names]), numbers


def _structure(leaves: PyTree, static: PyTree) -> tuple:
    """Of arguments, with what in them is no array."""
    shapes = [jnp.shape(leaf) for leaf in jax.tree.leaves(leaves)]
    return jax.tree.structure(leaves), tuple(shapes), _frozen(jax.tree.leaves(static))


def _read(jaxpr: Jaxpr) -> set:
    """All variables that an equation reads or that are returned."""
    read = [*jaxpr.outvars, *(v for equation in jaxpr.eqns for v in equation.invars)]
    return {v for v in read if not isinstance(v, Literal)}


def _key(jaxpr: Jaxpr) -> tuple:
    """What a program does, whatever its variables are called."""
    # Programs of functions under `jit` are kept by JAX and come again.
    if jaxpr not in _KEYS:
        _KEYS[jaxpr] = _new_key(jaxpr, lambda equation: equation.params)
    return _KEYS[jaxpr]


_KEYS: weakref.WeakKeyDictionary[Jaxpr, tuple] = weakref.WeakKeyDictionary()


def _new_key(jaxpr: Jaxpr, parameters: Callable[[Any], dict]) -> tuple:
    names: dict = {}

    def atom(v):
        if isinstance(v, Literal):
            return (v.aval, _frozen(np.asarray(v.val)))
        return names.setdefault(v, len(names))

    inputs = tuple((atom(v), v.aval) for v in (*jaxpr.constvars, *jaxpr.invars))
    equations = tuple(
        (
            equation.primitive.name,
            tuple(atom(v) for v in equation.invars),
            tuple((atom(v), v.aval) for v in equation.outvars),
            _frozen(parameters(equation)),
        )
        for equation in jaxpr.eqns
    )
    return len(jaxpr.constvars), inputs, equations, tuple(atom(v) for v in jaxpr.outvars)


def _rules(derivatives: int) -> Callable[[Any], dict]:
    """Parameters of operations; rules of derivatives as programs, of so many one after another.

    JAX wraps rules anew at every call: even those of `jax.nn.relu` were never the same.
    """

    def parameters(equation) -> dict:
        params, rule = equation.params, equation.params.get("jvp_jaxpr_fun")
        if not hasattr(rule, "call_wrapped"):
            return params
        if not derivatives:
            return {name: value for name, value in params.items() if value is not rule}
        try:
            zeros = [False] * (len(equation.invars) - params["num_consts"])
            jaxpr, consts, zeros_out = rule.call_wrapped(*zeros)
        except Exception:  # A rule that fails is told of where it is used: values do without.
            return params
        key = _new_key(jaxpr, _rules(derivatives - 1))
        return params | {"jvp_jaxpr_fun": (key, consts, zeros_out)}

    return parameters


class _Same:
    """Something that is equal to itself only."""

    def __init__(self, value):
        self.value = value

    def __hash__(self):
        return id(self.value)

    def __eq__(self, other):
        return isinstance(other, _Same) and self.value is other.value

    def __repr__(self):
        return repr(self.value)


def _frozen(value: Any) -> Any:
    """A parameter of an operation as something that can be compared."""
    if isinstance(value, ClosedJaxpr):
        return (_key(value.jaxpr), tuple(_frozen(c) for c in value.consts))
    if isinstance(value, Jaxpr):
        return _key(value)
    if isinstance(value, tuple | list):
        return (type(value).__name__, *map(_frozen, value))
    if isinstance(value, dict):
        return tuple((name, _frozen(value[name])) for name in sorted(value, key=str))
    if isinstance(value, jax.core.Tracer):
        return _Same(value)
    if isinstance(value, np.ndarray | jax.Array):
        value = np.asarray(value)
        return (str(value.dtype), value.shape, value.tobytes())
    if isinstance(value, float):
        return value.hex()
    try:
        hash(value)
    except TypeError:
        return _Same(value)
    return (type(value), value)
