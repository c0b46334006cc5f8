"""Programs for the prompt: compiled quickly where that takes longer than running, or only once."""

from __future__ import annotations

import contextvars
import functools
import gc
import os
import threading
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.ad_checkpoint import checkpoint_name
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir

from .arguments import is_array
from .failures import is_concrete
from .machine import PIECE, QUICK, QUICKEST, machine

if TYPE_CHECKING:
    AnyArray = Any  # the kind that goes in comes out
else:
    AnyArray = jax.Array | np.ndarray | np.generic

# What is computed within is computed at once, also while something else is traced. (JAX's
# `ensure_compile_time_eval` would take apart the programs called in it as well, and compile what
# depends on constants alone operation by operation.)
at_once = jax.core.eval_context
# The environment variable is for programs that would be compiled for longer than they run.
_told = os.environ.get("JAXSURF_QUICKLY", "")
quickly = contextvars.ContextVar("quickly", default=_told not in ("", "0"))


def is_quick() -> bool:
    """Whether what is being traced is to be compiled quickly: code may then choose its form."""
    return quickly.get()


# Objects made, fewer those given back, as long as full collections wait after what was traced; and
# a threshold that nobody else asks for.
_AFTERWARDS, _NEVER = 350_000, 1_000_003
_postponing, _left, _threshold, _lock = 0, _AFTERWARDS, gc.get_threshold()[2], threading.RLock()


def without_full_collections(f: Callable) -> Callable:
    """In calls of it, in any thread, full collections of garbage wait; the young are as ever.

    What is traced is no garbage and there is much of it: going through all objects of the process
    again and again takes a good part of the time of tracing. They wait for a while after a call
    that is traced, too, as it is transposed then; but that once only between two of them.
    """

    @functools.wraps(f)
    def call(*args):
        global _postponing, _threshold
        traced = not is_concrete(args)
        with _lock:
            youngest, young, full = gc.get_threshold()
            if full != _NEVER:
                _threshold = full
                gc.set_threshold(youngest, young, _NEVER)
            _postponing += 1
        try:
            return f(*args)
        finally:
            with _lock:
                _postponing -= 1
                if not (traced and _left > 0):
                    _collect_again()

    return call


def _collect_again():
    """The threshold of full collections as it was, unless there are calls or others set another."""
    youngest, young, full = gc.get_threshold()
    if full == _NEVER and not _postponing:
        gc.set_threshold(youngest, young, _threshold)


def _after_collection(phase, info):
    """Counts what is made after traced calls; a full collection begins the count anew."""
    global _left
    # Whoever holds the lock may be who collects: it is not waited for.
    if phase == "start" or not _lock.acquire(blocking=False):
        return
    if info["generation"] == 2:
        _left = _AFTERWARDS
    elif not _postponing and gc.get_threshold()[2] == _NEVER:
        _left -= max(gc.get_threshold()[0], 1)
        if _left <= 0:
            _collect_again()
    _lock.release()


gc.callbacks.append(_after_collection)


def sized_jit(f: Callable) -> Callable:
    """`eqx.filter_jit`, optimised less where the arrays are small and nothing is traced.

    Derivatives, other programs that this is part of, and other devices than CPUs always get all
    optimisations; so does a jaxlib that does not know the options.
    """

    thorough, quick, _ = _programs(f)
    return _by_size(f, thorough, quick)


def sized_filter_jit(f: Callable) -> Callable:
    """As `sized_jit`, but in the form that runs faster: for what is much code and runs for long.

    (Without what optimises last it runs as fast, within a tenth, and errors are those of Equinox.)
    """
    thorough = eqx.filter_jit(f)
    less = lambda: eqx.filter_jit(f, compiler_options=_known_options())  # type: ignore[call-overload]
    quick = functools.cache(less)
    return _by_size(f, thorough, lambda *args: quick()(*args))


def _by_size(f: Callable, thorough: Callable, quick: Callable) -> Callable:
    """The second of two programs of a function where the arrays are small."""

    @functools.wraps(f)
    @without_full_collections
    def call(*args):
        if _takes_longer_to_compile(jax.tree.leaves(args)):
            try:
                return quick(*args)
            except ValueError:  # within another program, if only with constants
                pass
        return thorough(*args)

    return call


class Programs(NamedTuple):
    """A function compiled with all optimisations and with fewer, and what the first computes."""

    thorough: Callable
    quick: Callable
    jaxpr: Callable


def _programs(f: Callable) -> Programs:
    """Programs of a function; what is no array is static."""

    def program(arrays, others, structure):
        leaves = [other if array is None else array for array, other in zip(arrays, others)]
        return f(*jax.tree.unflatten(structure, leaves))

    def quick_program(*args):
        token = quickly.set(True)
        try:
            return program(*args)
        finally:
            quickly.reset(token)

    def apart(args):
        leaves, structure = jax.tree.flatten(args)
        arrays = [a if is_array(a) else None for a in leaves]
        return arrays, tuple(None if is_array(a) else a for a in leaves), structure

    def called(compiled):
        return lambda *args: compiled(*apart(args))

    program.__name__ = quick_program.__name__ = f.__name__
    compiled = functools.cache(
        lambda: jax.jit(quick_program, static_argnums=(1, 2), compiler_options=_known_options())
    )
    quick = called(lambda *args: compiled()(*args))
    thorough = jax.jit(program, static_argnums=(1, 2))
    traced = lambda *args: thorough.trace(*apart(args)).jaxpr.jaxpr
    return Programs(called(thorough), quick, traced)


class Pieces:
    """`sized_jit` for a function of blocks, `f(blocks, count, ...)`, that treats one after another.

    Where the arrays are small it is called on pieces of so many blocks, filled up, and told how
    many count: any number of points shares one program. Else `count` is None: all.
    """

    def __init__(self, f: Callable):
        functools.update_wrapper(self, f)
        self.programs = _programs(f)

    @without_full_collections
    def __call__(self, blocks, *args):
        leaves = jax.tree.leaves((blocks, args))
        if len(leaves[0]) and _takes_longer_to_compile(leaves):
            try:
                return _by_pieces(self.programs.quick, jax.tree.map(np.asarray, blocks), args)
            except ValueError:  # within another program, if only with constants
                pass
        return self.programs.thorough(blocks, None, *args)

    def jaxpr(self, blocks, *args):
        """What it computes for large arrays."""
        return self.programs.jaxpr(blocks, None, *args)


def _by_pieces(program: Callable, blocks, args: tuple):
    leaves, structure = jax.tree.flatten(blocks)
    parts = []
    for first in range(0, len(leaves[0]), PIECE):
        rows = [a[first : first + PIECE] for a in leaves]
        piece, count = jax.tree.unflatten(structure, map(_filled_up, rows)), len(rows[0])
        found, shape = jax.tree.flatten(program(piece, np.array(count, np.int32), *args))
        parts.append([np.asarray(a)[:count] for a in found])
    return jax.tree.unflatten(shape, map(np.concatenate, zip(*parts)))


def _filled_up(blocks: np.ndarray) -> np.ndarray:
    if len(blocks) == PIECE:
        return blocks
    room = np.zeros((PIECE, *blocks.shape[1:]), blocks.dtype)
    room[: len(blocks)] = blocks
    return room


def on_device(a: AnyArray) -> jax.Array:
    """An array as one of JAX, by a copy: `jnp.asarray` compiles one for every new shape."""
    with at_once():
        return jax.device_put(a)


def host_jit(f: Callable) -> Callable:
    """`sized_jit` for a function that does little: small arrays are left to NumPy, uncompiled.

    It is written for both kinds of arrays, see `namespace`. What it returns is on the device, or,
    for another of these, NumPy's.
    """
    compiled = sized_jit(f)

    @functools.wraps(f)
    def call(*args):
        if _on_host.get():
            return f(*args)
        if not _takes_longer_to_compile(jax.tree.leaves(args)):
            return compiled(*args)
        token = _on_host.set(True)
        try:
            with np.errstate(all="ignore"):  # as compiled code
                found = f(*jax.tree.map(lambda a: np.asarray(a) if is_array(a) else a, args))
        finally:
            _on_host.reset(token)
        return jax.tree.map(jax.device_put, found)

    return call


_on_host = contextvars.ContextVar("on_host", default=False)


def block_by_block(function: Callable, dtype, *, rows: int = 4_096) -> Callable:
    """A compiled function of points called on blocks of one shape, so that it compiles once.

    Args:
        function: of `rows` points or numbers; returns arrays with as many rows.
        dtype: of what it is given.
        rows: in a block.

    Example:
        >>> block_by_block(lambda x: 2 * x, float, rows=3)(np.arange(5)).tolist()
        [0.0, 2.0, 4.0, 6.0, 8.0]
    """

    def call(points):
        points = np.asarray(points, dtype)
        blocks = []
        for first in range(0, max(len(points), 1), rows):
            block = points[first : first + rows]
            padding = [(0, rows - len(block))] + [(0, 0)] * (points.ndim - 1)
            result = function(jnp.asarray(np.pad(block, padding)))
            blocks.append(jax.tree.map(np.asarray, result))
        return jax.tree.map(lambda *parts: np.concatenate(parts)[: len(points)], *blocks)

    return call


# The name of what reverse mode stores, block by block: short, and long to compute.
KEPT = "kept"


def kept(a: AnyArray) -> AnyArray:
    """An array that has this name; the others are found again from what a block is given."""
    return checkpoint_name(a, KEPT) if isinstance(a, jax.Array) else a


def stored(a: jax.Array, never) -> jax.Array:
    """The same array, which is stored then, and so is its cotangent.

    The compiler finds cheap values again for every use of them. It looks through barriers on a CPU,
    but takes nothing out of a branch.

    Args:
        never: False, which the compiler cannot know.
    """
    return _stored.bind(a, never)


# A primitive, as derivatives keep this form then, and nothing of the branch that is never taken.
_stored = Primitive("stored")
_stored.def_impl(lambda a, never: a)
_stored.def_abstract_eval(lambda a, never: a)
ad.primitive_jvps[_stored] = lambda primals, tangents: (
    stored(*primals),
    tangents[0] if type(tangents[0]) is ad.Zero else stored(tangents[0], primals[1]),
)
ad.primitive_transposes[_stored] = lambda cotangent, a, never: (
    cotangent if type(cotangent) is ad.Zero else stored(cotangent, never),
    None,
)


def _stored_of_each(arrays, axes):
    (a, never), (axis, several) = arrays, axes
    return stored(a, never if several is None else jnp.any(never)), axis


batching.primitive_batchers[_stored] = _stored_of_each
for _platform, _way in {
    None: lambda a, never: jax.lax.optimization_barrier(a),
    "cpu": lambda a, never: jax.lax.cond(never, jax.lax.optimization_barrier, lambda a: a, a),
}.items():
    mlir.register_lowering(_stored, mlir.lower_fun(_way, multiple_results=False), _platform)


def first(a: jax.Array) -> jax.Array:
    """The first entry, whatever axes there are: what `stored` may be told to be never."""
    return a[(0,) * a.ndim]


def in_batches(f: Callable, xs, size: int):
    """`f` of each entry along the first axis, of so many at once at most, all batches of one size.

    `jax.lax.map` would compile what is left over after whole batches a second time.
    """
    n = len(jax.tree.leaves(xs)[0])
    batches = max(-(-n // size), 1)
    even = -(-n // batches)
    missing = batches * even - n
    if missing:
        last = lambda a: jnp.broadcast_to(a[-1:], (missing, *a.shape[1:]))
        xs = jax.tree.map(lambda a: jnp.concatenate([a, last(a)]), xs)
    return jax.tree.map(lambda a: a[:n], jax.lax.map(f, xs, batch_size=even))


def power_of_two(count: int) -> int:
    """The next one: what sizes are rounded up to, so that few programs are compiled."""
    return 1 << (count - 1).bit_length()


def namespace(a):
    """NumPy for its arrays, else `jax.numpy`."""
    return np if isinstance(a, np.ndarray) else jnp


def _takes_longer_to_compile(leaves: list) -> bool:
    """Whether a program of these arguments is taken to be compiled for longer than it runs."""
    small = sum(a.size for a in leaves if is_array(a)) < machine().quick
    return small and is_concrete(*leaves) and bool(_known_options())


@functools.cache
def _known_options() -> dict:
    """Those to compile quickly with that this jaxlib knows."""
    wanted = QUICKEST if _told == "2" else QUICK
    return {name: value for name, value in wanted.items() if _is_known({name: value})}


def _is_known(options: dict) -> bool:
    try:
        with at_once():
            jax.jit(lambda: 0, compiler_options=options)()
    except (ValueError, RuntimeError):
        return False
    return True
