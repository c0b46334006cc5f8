"""Command line: `python -m experiments list`, `python -m experiments run E2 E6 --quick`."""

from __future__ import annotations

import argparse
import gc
import importlib
import os
import sys
import time
from pathlib import Path

import jax

from .report import table, write_json

# Module and title. A module is imported when it runs: some need packages that others do not.
EXPERIMENTS = {
    "E1": (
        "e01_circle_laplacian",
        "Laplace-Beltrami of sin + cos on the unit circle, order 2 (paper 001, Fig. 2c)",
    ),
    "E2": (
        "e02_sphere_laplacian",
        "Laplace-Beltrami of Y40 on the unit sphere, orders 2 and 4 (paper 001, Fig. 3c)",
    ),
    "E3": (
        "e03_closest_point",
        "cost and accuracy beside the closest-point method (paper 001, Fig. 3b, 3c)",
    ),
    "E4": (
        "e04_poisson_circle",
        "Poisson on the unit circle, pinned at (1, 0), order 2 (paper 001, Fig. 2d)",
    ),
    "E5": (
        "e05_poisson_sphere",
        "Poisson on the unit sphere, given on a great circle, orders 2 and 4 (paper 001, Fig. 3d)",
    ),
    "E6": (
        "e06_ellipsoid_curvature",
        "Mean and Gauss curvature of the ellipsoid (1, 0.8, 0.75), order 2 (paper 001, Fig. 4a-c)",
    ),
    "E7": (
        "e07_bunny_curvature",
        "Mean curvature of the Stanford bunny, full and on 2,960 points (paper 001, Fig. 4d)",
    ),
    "E8": (
        "e08_bump",
        "Diffusion over a bump against fine surface finite elements (paper 001, Figs. 5, 6)",
    ),
    "E9": ("e09_rotation", "A quarter of a sphere turns once, three moves (paper 002, Fig. 5)"),
    "E10": (
        "e10_hemisphere",
        "A hemisphere is stretched and pressed, with points added (paper 002, Figs. 6 to 8)",
    ),
    "E11": ("e11_contact", "Two spheres meet, kept apart or made one (paper 002, Figs. 9, 10)"),
    "E12": (
        "e12_added_points",
        "Points added on sphere and torus, three placings (paper 002, Section 3.7.4)",
    ),
    "E13": (
        "e13_expanding_sphere",
        "Heat with a source on the expanding sphere, errors of space (paper 002, Table 2)",
    ),
    "E14": (
        "e14_steps",
        "Heat with a source on the expanding sphere, errors of time (paper 002, Table 3)",
    ),
    "E15": (
        "e15_half_pipe",
        "Diffusion on a half pipe that it inflates and a twist deforms (paper 002, Fig. 13)",
    ),
    "E16": (
        "e16_dumbbell",
        "A dumbbell by mean curvature flow pinches off (paper 002, Fig. 14)",
    ),
    "E17": (
        "e17_torus",
        "A torus by averaged mean curvature flow closes its hole (paper 002, Fig. 15)",
    ),
    "E18": (
        "e18_expanding_wave",
        "Waves with a source on the expanding sphere, errors of space (paper 002, Table 4)",
    ),
    "E19": (
        "e19_armadillo",
        "Waves on the Armadillo, which collapses and comes apart (paper 002, Fig. 16)",
    ),
    "accuracy": (
        "accuracy",
        "Study: error of the Laplacian on the unit sphere, with defaults, beside other codes",
    ),
    "cahn-hilliard": (
        "cahn_hilliard",
        "Cahn-Hilliard on a torus: mass, energy, growth of a mode against linear theory",
    ),
    "choice": (
        "choice",
        "Study: which method suits one who does not choose: error, stability, time on ten surfaces",
    ),
    "conductivity": (
        "conductivity",
        "Inverse: a conductivity field on the bunny from 200 noisy sensors",
    ),
    "control": (
        "control",
        "Shapes: a flow that takes the sphere to a bean, by derivatives through its motion",
    ),
    "curvature-orders": (
        "curvature_orders",
        "Mean curvature flow of ellipsoids: orders in time and space of positions, normals and H",
    ),
    "eigenmodes": (
        "eigenmodes",
        "Study: eigenvalues on sphere, ellipsoid and torus against spectral references",
    ),
    "extremal-eigenvalue": (
        "extremal_eigenvalues",
        "Shapes: from a long star to the sphere, by its first three eigenvalues (Hersch 1970)",
    ),
    "geodesics": (
        "geodesics",
        "Distances by the heat method: the sphere against great circles, bands on the bunny",
    ),
    "neck": (
        "neck",
        "Mean curvature flow of a smooth dumbbell: the radius of its neck until it pinches off",
    ),
    "neural-bunny": (
        "neural_bunny",
        "Shapes: a neural level set of the bunny's scan, with the scan's first eigenvalues",
    ),
    "noise": (
        "noise",
        "Study: noise of 1 to 10 % of the spacing: normals, curvature, Laplacians, solutions",
    ),
    "poisson": (
        "poisson",
        "Study: Poisson on ellipsoid, torus and a surface of genus 2; scans; orders and steps",
    ),
    "hear-the-shape": (
        "hear_the_shape",
        "Shapes: the axes of an ellipsoid from its first 12 eigenvalues",
    ),
    "hot-spot": (
        "hot_spot",
        "Shapes: the closed surface on which a hot spot cools fastest, at fixed area",
    ),
    "isoperimetric": (
        "isoperimetric",
        "Shapes: from a bumpy star to the sphere, by least area at fixed volume",
    ),
    "integrals": ("integrals", "Study: area, volume and integrals of curvature, by order"),
    "shape-derivatives": (
        "shape_derivatives",
        "Shapes: derivatives of functionals of ellipsoids and tori against spectral references",
    ),
    "sphere-flow": (
        "sphere_flow",
        "Mean curvature flow of the sphere until r = 0.3, against sqrt(1 - 2t)",
    ),
    "scans": (
        "scans",
        "Scans as they come: parts, holes, wide edges, bare points: the demo on all, heat kept",
    ),
    "slopes": ("slopes", "Study: observed orders of the Laplacian on sphere, ellipsoid and torus"),
    "stability": (
        "stability",
        "Study: spectra of the default Laplacians, also on random points and the bunny",
    ),
    "symmetric": (
        "symmetric",
        "Symmetric semi-definite Laplacians: three ways compared; heat and waves on scans",
    ),
    "transport": (
        "transport",
        "Transport: solid-body rotation on the sphere, order after one turn, growth in 100",
    ),
    "turing": (
        "turing",
        "Turing patterns: growth rates on the sphere against theory, a pattern on the bunny",
    ),
    "vesicles": (
        "vesicles",
        "Shapes: red blood cells, least bending energy at fixed area and reduced volume",
    ),
    "waves": (
        "waves",
        "Waves: a standing wave on the sphere against the exact one, a drop on the Armadillo",
    ),
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
        for name, (_, title) in EXPERIMENTS.items():
            print(f"{name:18s} {title}")
        return 0
    known = {name.lower(): name for name in EXPERIMENTS}
    unknown = [name for name in options.names if name.lower() not in known]
    if unknown:
        parser.error(f"no experiment is called {', '.join(unknown)}; see `list`")
    options.out.mkdir(parents=True, exist_ok=True)
    return max(_run(known[name.lower()], options.quick, options.out) for name in options.names)


def _run(name: str, quick: bool, out: Path) -> int:
    module, title = EXPERIMENTS[name]
    print(f"{name}: {title}", flush=True)
    start = time.perf_counter()
    try:
        experiment = importlib.import_module(f"experiments.{module}")
        if quick:  # surfaces in pictures are as fine as that
            pyplot = importlib.import_module("matplotlib.pyplot")
            pyplot.rcParams["figure.dpi"] = 40
        # What is imported stays: full collections, of which tracing makes many, pass it by.
        gc.freeze()
        rows = experiment.run(quick, out)
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
    os.environ["MPLBACKEND"] = "Agg"
    sys.exit(main())
