"""Programs that are compiled for the prompt: where compiling takes longer than running."""

from __future__ import annotations

import contextvars
import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from .arguments import is_concrete

# Quicker to compile, slower to run; `is_quick` asks for simpler forms beside.
_QUICK = {"xla_backend_optimization_level": 1, "xla_cpu_use_fusion_emitters": False}
# Numbers given to a program, in all its arrays, below which it is small.
_SMALL = 1_750_000
_quickly = contextvars.ContextVar("quickly", default=False)


def is_quick() -> bool:
    """Whether what is being traced is to be compiled quickly: code may then choose its form."""
    return _quickly.get()


def sized_jit(f: Callable) -> Callable:
    """`eqx.filter_jit`, optimised less where the arrays are small and nothing is traced.

    Derivatives, other programs that this is part of, and other devices than CPUs always get all
    optimisations; so does a jaxlib that does not know the options.
    """

    def program(arrays, others, structure):
        leaves = [other if array is None else array for array, other in zip(arrays, others)]
        return f(*jax.tree.unflatten(structure, leaves))

    def quick_program(*args):
        token = _quickly.set(True)
        try:
            return program(*args)
        finally:
            _quickly.reset(token)

    program.__name__ = quick_program.__name__ = f.__name__
    thorough = jax.jit(program, static_argnums=(1, 2))
    quick = jax.jit(quick_program, static_argnums=(1, 2), compiler_options=_QUICK)

    @functools.wraps(f)
    def call(*args):
        leaves, structure = jax.tree.flatten(args)
        arrays = [a if _is_array(a) else None for a in leaves]
        others = tuple(None if _is_array(a) else a for a in leaves)
        if _takes_longer_to_compile(leaves):
            try:
                return quick(arrays, others, structure)
            except ValueError:  # within another program, if only with constants
                pass
        return thorough(arrays, others, structure)

    return call


def copying_jit(f: Callable) -> Callable:
    """`sized_jit` for a function that copies only: small arrays are left to NumPy, uncompiled.

    It is written for both kinds of arrays, see `namespace`. (What it returns is on the device.)
    """
    compiled = sized_jit(f)

    @functools.wraps(f)
    def call(*args):
        if _takes_longer_to_compile(jax.tree.leaves(args)):
            found = f(*jax.tree.map(lambda a: np.asarray(a) if _is_array(a) else a, args))
            return jax.tree.map(jax.device_put, found)
        return compiled(*args)

    return call


def namespace(a):
    """NumPy for its arrays, else `jax.numpy`."""
    return np if isinstance(a, np.ndarray) else jnp


def _is_array(a) -> bool:
    return isinstance(a, jax.Array | np.ndarray)


def _takes_longer_to_compile(leaves: list) -> bool:
    """Whether a program of these arguments is taken to be compiled for longer than it runs."""
    small = sum(a.size for a in leaves if _is_array(a)) < _SMALL
    return small and is_concrete(*leaves) and _is_known()


@functools.cache
def _is_known() -> bool:
    if jax.default_backend() != "cpu":
        return False
    try:
        with jax.ensure_compile_time_eval():
            jax.jit(lambda: 0, compiler_options=_QUICK)()
    except (ValueError, RuntimeError):
        return False
    return True
