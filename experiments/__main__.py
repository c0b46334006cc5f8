"""Command line: `python -m experiments list`, `python -m experiments run E2 E6 --quick`."""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path
from types import ModuleType

import jax
import matplotlib

from . import (
    accuracy,
    cahn_hilliard,
    e01_circle_laplacian,
    e02_sphere_laplacian,
    e03_closest_point,
    e04_poisson_circle,
    e05_poisson_sphere,
    e06_ellipsoid_curvature,
    e07_bunny_curvature,
    e08_bump,
    eigenmodes,
    geodesics,
    poisson,
    slopes,
    stability,
    transport,
    turing,
    waves,
)
from .report import table, write_json

EXPERIMENTS: dict[str, ModuleType] = {
    "E1": e01_circle_laplacian,
    "E2": e02_sphere_laplacian,
    "E3": e03_closest_point,
    "E4": e04_poisson_circle,
    "E5": e05_poisson_sphere,
    "E6": e06_ellipsoid_curvature,
    "E7": e07_bunny_curvature,
    "E8": e08_bump,
    "accuracy": accuracy,
    "cahn-hilliard": cahn_hilliard,
    "eigenmodes": eigenmodes,
    "geodesics": geodesics,
    "poisson": poisson,
    "slopes": slopes,
    "stability": stability,
    "transport": transport,
    "turing": turing,
    "waves": waves,
}


def main(arguments: list[str] | None = None) -> int:
    """Exit status 0 if every bound of the experiments that ran is kept, else 1."""
    parser = argparse.ArgumentParser(prog="python -m experiments", description=__doc__)
    commands = parser.add_subparsers(dest="command", required=True)
    commands.add_parser("list", help="name every experiment")
    run = commands.add_parser("run", help="run experiments and write their numbers and pictures")
    run.add_argument("names", nargs="+", metavar="NAME", help="from `list`, in either case")
    run.add_argument("--quick", action="store_true", help="a version of about a minute")
    run.add_argument("--out", type=Path, default=Path("out"), metavar="DIR",
                     help="folder for JSON and pictures (default: out)")  # fmt: skip
    options = parser.parse_args(arguments)

    if options.command == "list":
        for name, module in EXPERIMENTS.items():
            print(f"{name:13s} {module.TITLE}")
        return 0
    known = {name.lower(): name for name in EXPERIMENTS}
    unknown = [name for name in options.names if name.lower() not in known]
    if unknown:
        parser.error(f"no experiment is called {', '.join(unknown)}; see `list`")
    options.out.mkdir(parents=True, exist_ok=True)
    return max(_run(known[name.lower()], options.quick, options.out) for name in options.names)


def _run(name: str, quick: bool, out: Path) -> int:
    module = EXPERIMENTS[name]
    print(f"{name}: {module.TITLE}", flush=True)
    start = time.perf_counter()
    try:
        rows = module.run(quick, out)
    except FileNotFoundError as error:
        print(f"{name} skipped: {error}", flush=True)
        return 0
    seconds = time.perf_counter() - start
    path = out / f"{name}.json"
    write_json(path, name, rows, seconds)
    failed = sum(row.holds is False for row in rows)
    bounds = sum(row.holds is not None for row in rows)
    print(table(rows))
    print(f"{bounds - failed} of {bounds} bounds hold; {seconds:.0f} s; {path}\n", flush=True)
    return 1 if failed else 0


if __name__ == "__main__":
    # The papers' accuracy needs double precision; the library leaves that choice to its users.
    jax.config.update("jax_enable_x64", True)
    matplotlib.use("Agg")
    sys.exit(main())
