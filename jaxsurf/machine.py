"""What depends on the machine: how much is treated at once, on CPUs and on accelerators.

What a core of a CPU treats at once has to fit into its caches. An accelerator is busy with hundreds
of thousands of numbers only, and takes microseconds to begin with anything: loops are short there,
and on an H200 the stencils of 100,000 points, in blocks for a CPU, took 180 times as long.
"""

from __future__ import annotations

from typing import NamedTuple

import jax

# Points of a block on a CPU, see `block`.
CELLS = 100  # of integrals; no power of two, see `GFDM.batch_size`
READ = 128  # where fields are interpolated
FITTED = 256  # whose normals are fitted
SEARCHED = 200  # whose neighbours are searched; of 512 columns stand a page apart, twice as slow
AGAIN = 64  # whose neighbours are searched farther away, or on one sheet
COUNTED = 1024  # whose candidates are counted
SHEETS = 16  # with sheets to tell apart
PAIRS = 64  # that see all others, see `block_of_pairs`
# Points that a program looks at again, of which few shapes are to be compiled: normals that still
# move, stencils that are not stable.
MOVING, TRIED = 4096, 256
# Blocks that one call treats where arrays are small.
PIECE = 8
# Numbers, at least, that a core is given at once where arrays are large.
PART = 12_000_000
# Columns at once: right-hand sides, directions of a Jacobian, colours of a product of matrices.
SOLVED, PUSHED, COLORS = 64, 32, 16
# Of programs that are compiled quickly on a CPU; and, for whoever asks for it, without any
# optimisation: sooner still, but they run for longer.
QUICK = {"xla_backend_optimization_level": 1, "xla_cpu_use_fusion_emitters": False}
QUICKEST = QUICK | {"xla_backend_optimization_level": 0}


class Machine(NamedTuple):
    """What suits a kind of machine.

    Args:
        points: of a block, in units of what suits a CPU.
        least: points of a block, however few suit a CPU.
        pairs: the same of points that see all others.
        slots: of an operator, added up in one pass over the memory of the result.
        gathered: weights of a scalar operator below which everything is gathered at once, without
            a loop.
        unknowns: of small systems up to which straight-line code runs faster than a library.
        monomials: of products with a basis up to which these are straight-line code, whatever the
            form of the systems.
        columns: unknowns up to which these are factored in loops over columns.
        quick: numbers given to a program, in all its arrays, below which it is compiled quickly.
        divides: whether programs are divided among its cores.
        sorts: whether the compiler's own sorting is faster than a network of exchanges.
    """

    points: int
    least: int
    pairs: int
    slots: int
    gathered: int
    unknowns: int
    monomials: int
    columns: int
    quick: int
    divides: bool
    sorts: bool


CPU = Machine(
    points=1,
    least=1,
    pairs=1,
    slots=5,
    gathered=50_000,
    unknowns=15,
    monomials=60,
    columns=120,
    quick=1_750_000,
    divides=True,
    sorts=False,
)
ACCELERATOR = Machine(
    points=256,
    least=8192,
    pairs=16,
    slots=1_000,
    gathered=1 << 40,
    unknowns=15,
    monomials=0,
    columns=15,
    quick=0,
    divides=False,
    sorts=True,
)


def machine() -> Machine:
    """That of JAX's default backend."""
    return CPU if jax.default_backend() == "cpu" else ACCELERATOR


def block(points: int) -> int:
    """Points that are treated at once where so many of them fit into the caches of a CPU."""
    return max(points * machine().points, machine().least)


def block_of_pairs(points: int) -> int:
    """The same of points each of which sees all others."""
    return points * machine().pairs
