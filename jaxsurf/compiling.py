"""Programs that are compiled for the prompt: where compiling takes longer than running."""

from __future__ import annotations

import contextvars
import functools
from collections.abc import Callable

import jax
import numpy as np

from .arguments import is_concrete

# Down to half the time to compile, and up to twice that to run (`is_quick`: simpler forms).
_QUICK = {"xla_backend_optimization_level": 1, "xla_cpu_use_fusion_emitters": False}
# Numbers given to a program, in all its arrays, below which it is small.
_SMALL = 2_000_000
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
        is_array = [isinstance(a, jax.Array | np.ndarray) for a in leaves]
        arrays = [a if array else None for a, array in zip(leaves, is_array)]
        others = tuple(None if array else a for a, array in zip(leaves, is_array))
        small = sum(a.size for a in arrays if a is not None) < _SMALL
        if small and is_concrete(*leaves) and _is_known():
            try:
                return quick(arrays, others, structure)
            except ValueError:  # within another program, if only with constants
                pass
        return thorough(arrays, others, structure)

    return call


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
