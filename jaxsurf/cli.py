"""The command `jaxsurf`: arguments in, report out."""

from __future__ import annotations

import argparse
import gc
import itertools
import os
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import jax
import numpy as np
from tqdm import tqdm

import jaxsurf as js

from . import demo
from .stencils.usual import USUAL

_METHODS = {
    "dcpse2": js.DCPSE(order=2),
    "dcpse4": js.DCPSE(order=4),
    "gfdm2": js.GFDM(degree=2),
    "gfdm4": js.GFDM(degree=4),
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit code.

    0: all went well. 1: the demo ran, but the heat grew or the gradient is wrong. 2: bad
    arguments or a bad file, said in one line.
    """
    parser = _parser()
    options = parser.parse_args(arguments)
    # The command line is a program of its own: the library never touches the configuration.
    jax.config.update("jax_enable_x64", True)
    if arguments is None:
        # What is imported stays: full collections, of which tracing makes many, pass it by.
        gc.freeze()

    def sample():
        if options.surface is None:
            return demo.built_in_surface(10_000 if options.points is None else options.points)
        return demo.surface_from_file(
            options.surface,
            options.points,
            smooth=not options.flat,
            largest_part=options.largest_part,
            border=options.border,
        )

    of_files = {
        "--points all": options.points == "all",
        "--flat": options.flat,
        "--largest-part": options.largest_part,
        "--border": options.border,
    }
    for option, given in of_files.items():
        if given and options.surface is None:
            parser.error(f"{option} needs --surface")
    try:
        with _progress(len(demo.STAGES)) as tell:
            result = demo.run(
                sample,
                method=_METHODS[options.method],
                out=options.out,
                until=options.time,
                tell=tell,
            )
    except (ValueError, OSError, ImportError) as error:
        print(f"jaxsurf demo: error: {' '.join(str(error).split())}", file=sys.stderr)
        return 2
    print("\n".join(report(result)))
    return 0 if demo.healthy(result) else 1


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="jaxsurf", description=js.__doc__.splitlines()[0])
    parser.add_argument("--version", action="version", version=f"jaxsurf {js.__version__}")
    commands = parser.add_subparsers(required=True, metavar="command")
    one = commands.add_parser(
        "demo",
        help="curvature, heat and a gradient on a surface, with a report and pictures",
        description="Find neighbours, build the Laplace-Beltrami operator, compute curvature, "
        "let a hot spot diffuse, and differentiate the result with respect to the shape.",
    )
    one.add_argument(
        "--surface",
        metavar="FILE",
        help="triangle mesh or point cloud (OBJ, PLY, STL, OFF, XYZ, VTK, VTU); "
        "default: a double torus",
    )
    one.add_argument(
        "--points",
        type=_points,
        metavar="N",
        help="sample the surface evenly with N points (default: 10000), or 'all' for the "
        "vertices of the file as they are, which those without triangles always are",
    )
    one.add_argument(
        "--flat",
        action="store_true",
        help="keep to the triangles, in place of a smooth surface through the vertices "
        "(smooth=False of js.read)",
    )
    one.add_argument(
        "--largest-part",
        action="store_true",
        help="leave out triangles until no edge has more than two (largest_part=True of js.read)",
    )
    one.add_argument(
        "--border",
        action="store_true",
        help="hold the points that look like border points (js.detect_boundary); of point clouds, "
        "as meshes tell theirs",
    )
    one.add_argument(
        "--out",
        type=Path,
        default=Path("jaxsurf-demo"),
        metavar="DIR",
        help="folder for the picture and the ParaView file (default: %(default)s)",
    )
    one.add_argument(
        "--time",
        type=float,
        metavar="T",
        help="diffuse until this time (default: size squared / 100)",
    )
    one.add_argument(
        "--method",
        choices=_METHODS,
        default=next(name for name, method in _METHODS.items() if method == USUAL),
        help="surface DC-PSE of order 2 or 4, or GFDM of degree 2 or 4 (default: %(default)s)",
    )
    return parser


def _points(text: str) -> int | str:
    if text == "all":
        return text
    try:
        n = int(text.replace("_", "").replace(",", ""))
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is neither a number nor 'all'") from None
    if n < 1:
        raise argparse.ArgumentTypeError(f"{n} points, at least 1 is needed")
    return n


@contextmanager
def _progress(stages: int) -> Iterator:
    """A bar over the stages on a terminal, its clock going on meanwhile; elsewhere lines."""
    if not sys.stderr.isatty():
        yield _lines(stages)
        return
    form = "{desc:<12}{bar:30} {n_fmt}/{total_fmt}  {elapsed}"
    bar = tqdm(total=stages, bar_format=form, leave=False, disable=None)
    over = threading.Event()

    def tick():
        while not over.wait(0.5):
            bar.refresh()

    def tell(name: str):
        bar.update(begun.is_set())
        begun.set()
        bar.set_description_str(name)

    begun = threading.Event()
    clock = threading.Thread(target=tick, daemon=True)
    clock.start()
    try:
        yield tell
    finally:
        over.set()
        clock.join()
        bar.close()


def _lines(stages: int):
    begin, count = time.perf_counter(), itertools.count(1)

    def tell(name: str):
        elapsed = time.perf_counter() - begin
        print(f"{elapsed:6.1f} s  {next(count)}/{stages} {name}", file=sys.stderr, flush=True)

    return tell


def _named(method: js.AbstractMethod) -> str:
    number = "degree" if isinstance(method, js.GFDM) else "order"
    return f"{type(method).__name__}({number}={getattr(method, number)})"


# --- the report ----------------------------------------------------------------------------


def report(result: demo.Demo) -> list[str]:
    """The lines of the report."""
    cloud, operator = result.surface.cloud, result.laplacian
    d, n = operator.diagnostics, cloud.n
    assert d is not None  # freshly built operators have them
    count, tube = np.asarray(d.count), np.asarray(d.tube)
    spacing = float(np.sum(result.areas) / n) ** (1 / (cloud.dim - 1))
    heat, (name, value) = result.heat, result.surface.parameter
    border = 0 if cloud.boundary is None else int(np.sum(np.asarray(cloud.boundary)))
    rows = [
        ("surface", result.surface.title),
        ("points", f"{n:,}, {spacing:.3g} apart" + (f", {border} on borders" if border else "")),
        ("method", _named(result.method)),
        (
            "stencils",
            f"{count.min()} / {int(np.median(count))} / {count.max()} points"
            " (least / median / most)",
        ),
        (
            "condition",
            f"at most {np.max(d.condition):.3g}, moments met to {np.max(d.residual):.0e}",
        ),
        (
            "tube",
            f"folds within the stencil at {int(np.sum(tube > 1)):,} points"
            f" (support x curvature up to {tube.max():.2f})",
        ),
        (
            "spectrum",
            f"largest modulus {result.spectrum.radius:.4g}, "
            f"largest real part {result.spectrum.abscissa:.1e}",
        ),
    ]
    for kind, field in result.curvature.items():
        rows.append((f"{kind} curvature", f"{np.min(field):.4g} to {np.max(field):.4g}"))
    rows += [
        (
            "heat",
            f"until t = {heat.until:g} in {heat.steps} steps of RKC2; hottest "
            f"{result.peaks[0]:.3g} -> {result.peaks[-1]:.3g}",
        ),
        (
            "heat conserved",
            f"to {result.lost:.1e} (sum over Voronoi cells); "
            + (
                "borders held at their temperature"
                if border
                else f"without correction to {result.lost_uncorrected:.1e}"
            ),
        ),
        ("gradient", f"d u(probe, t = {heat.until:g}) / d ({name}) at {value:g}"),
        ("  jax.grad", f"{result.gradient:.10g}"),
        (
            "  difference",
            f"{result.difference:.10g}  (relative difference {result.disagreement:.1e})",
        ),
    ]
    rows += [("note", note) for note in result.notes]
    rows += [("written", str(path)) for path in result.files]
    lines = [
        f"jaxsurf {js.__version__}, jax {jax.__version__} on {jax.default_backend()}, "
        f"{cloud.points.dtype}",
        "",
    ]
    lines += [f"{label:<17}{text}" for label, text in rows]
    lines += ["", f"{'seconds':<17}{'compile':>8}{'run':>8}"]
    lines += [f"  {stage:<15}{c:8.1f}{r:8.1f}" for stage, (c, r) in result.seconds.items()]
    c, r = (sum(spent) for spent in zip(*result.seconds.values()))
    lines += [f"  {'total':<15}{c:8.1f}{r:8.1f}"]
    lines += ["", f"done in {c + r:.1f} s on {os.cpu_count()} cores"]
    if not result.stable:
        lines += [
            "",
            f"UNSTABLE: the largest |u| went {' -> '.join(f'{p:.3g}' for p in result.peaks)}",
        ]
    elif not demo.healthy(result):
        lines += ["", "WRONG: the gradient and the difference disagree"]
    return lines
