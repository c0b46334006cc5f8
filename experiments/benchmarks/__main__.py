"""Run every case in a process of its own, write the table."""

from __future__ import annotations

import argparse
import json
import os
import platform
import subprocess
import sys
import time
from pathlib import Path
from types import ModuleType

import jax
from tqdm import tqdm

from ..report import table as rows_table
from ..report import write_json
from . import accelerator, cases, heat, motion, prompt, shapes

# Measured on a 2-core machine of the same kind, one process each: build s and apply ms at 1e5.
PEERS = {
    "GFDM(degree=2)": ("Compadre GMLS, degree 2, k = 13", "2.5-4.5", "19"),
    "GFDM(degree=4)": ("Compadre GMLS, degree 4, k = 37", "15-22; 8.7 on two threads", "34"),
    "DCPSE(order=2)": ("OpenFPM Surface DC-PSE, order 2, k = 26", "14", "22"),
    "DCPSE(order=4)": ("OpenFPM Surface DC-PSE, order 4, k = 47", "107-125", "41"),
}
GROUPS: dict[str, ModuleType] = {
    "accelerator": accelerator,
    "heat": heat,
    "motion": motion,
    "prompt": prompt,
    "shapes": shapes,
}
README = Path(__file__).parents[2] / "README.md"
MARKS = ("<!-- benchmarks: begin -->", "<!-- benchmarks: end -->")


def plan(quick: bool) -> list[tuple[str, list]]:
    n = 20_000 if quick else 100_000
    million = 100_000 if quick else 1_000_000
    gradient_n = 2_000 if quick else 10_000
    todo: list[tuple[str, list]] = [("bandwidth", [])]
    todo += [("apply", [m, k]) for m in (n, million) for k in (20, 40)]
    todo += [("apply", [n, k]) for k in (26, 37, 47)]
    todo += [("build", [name, n]) for name in cases.METHODS]
    todo += [("build_beside_numpy", [2, 20, n]), ("build_beside_numpy", [4, 37, n])]
    todo += [("build_beside_plain_jax", [n])]
    todo += [("build", ["DCPSE(order=2)", m]) for m in (n // 10, million)]
    todo += [
        ("gradient", [name, gradient_n, reverse])
        for name in cases.METHODS
        for reverse in (False, True)
    ]
    return [*todo, ("retraces", [])]


def run_case(name: str, arguments: list) -> dict:
    command = [sys.executable, "-m", "experiments.benchmarks", "--case", name]
    # Compiled anew, whatever cache the environment has.
    environment = {k: v for k, v in os.environ.items() if k != "JAX_COMPILATION_CACHE_DIR"}
    done = subprocess.run(
        [*command, json.dumps(arguments)],
        capture_output=True, text=True, check=False, env=environment,
    )  # fmt: skip
    if done.returncode:
        raise RuntimeError(f"{name} {arguments} failed:\n{done.stderr[-2000:]}")
    return json.loads(done.stdout.splitlines()[-1])


def find(results: list[dict], case: str, *arguments) -> dict:
    return next(
        r["result"] for r in results if r["case"] == case and r["arguments"] == [*arguments]
    )


def table(results: list[dict], quick: bool) -> str:
    """The Markdown table that the README quotes."""
    n, gradient_n = (20_000, 2_000) if quick else (100_000, 10_000)
    lines = [
        f"Sphere, n = {n:,}, float64, {platform.machine()}, 2 cores, jax {jax.__version__}; "
        f"gradient at n = {gradient_n:,}, its memory the temporaries of the compiled program. "
        "Peers as measured on such a machine, one process.",
        "",
        "| method | k | build s | first call s | apply ms | peak GiB | gradient s | / forward "
        "| its memory / forward | its first call s | peer | its build s | its apply ms |",
        "|---|---|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for name, (_, k) in cases.METHODS.items():
        build = find(results, "build", name, n)
        apply = find(results, "apply", n, k)
        forward = find(results, "gradient", name, gradient_n, False)
        reverse = find(results, "gradient", name, gradient_n, True)
        lines.append(
            f"| `{name}` | {k} | {build['build s']:.2f} | {build['first call s']:.1f} "
            f"| {apply['ours ms']:.2f} | {build['peak GiB']:.2f} "
            f"| {reverse['s']:.3f} | {reverse['s'] / forward['s']:.1f} "
            f"| {reverse['temporary MiB'] / forward['temporary MiB']:.1f} "
            f"| {reverse['compile s']:.1f} | " + " | ".join(PEERS[name]) + " |"
        )
    lines += ["", "| applying | SciPy CSR ms | without zeros | ours ms | ours / SciPy "
              "| share of bandwidth |",
              "|---|---|---|---|---|---|"]  # fmt: skip
    for r in results:
        if r["case"] == "apply" and r["arguments"][1] in (20, 40):
            (m, k), v = r["arguments"], r["result"]
            lines.append(
                f"| n = {m:,}, k = {k} | {v['SciPy CSR ms']:.2f} "
                f"| {v['SciPy without zeros ms']:.2f} | {v['ours ms']:.2f} "
                f"| {v['ratio']:.2f} | {v['share of bandwidth']:.0%} |"
            )
    lines += ["", "| building GFDM | ours s | NumPy s | / ours | NumPy in blocks s | / ours |",
              "|---|---|---|---|---|---|"]  # fmt: skip
    for r in results:
        if r["case"] == "build_beside_numpy":
            (degree, k, _), v = r["arguments"], r["result"]
            lines.append(
                f"| degree {degree}, k = {k} | {v['ours s']:.2f} "
                f"| {v['NumPy s']:.2f} | {v['NumPy / ours']:.1f} "
                f"| {v['NumPy in blocks s']:.2f} | {v['NumPy in blocks / ours']:.1f} |"
            )
    plain = find(results, "build_beside_plain_jax", n)
    lines += ["", "| GFDM(degree=2), k = 20 | ours s | plain JAX s |", "|---|---|---|",
              f"| build | {plain['ours s']:.3f} | {plain['plain JAX s']:.3f} |",
              f"| gradient | {plain['gradient ours s']:.3f} "
              f"| {plain['gradient plain JAX s']:.3f} |"]  # fmt: skip
    beside = [r for r in results if r["case"] == "build_beside_compadre"]
    if beside:
        lines += ["", "| beside Compadre, in one run | its threads | ours s | its s | ours / its "
                  "| applying, ours / its | error | its error |",
                  "|---|---|---|---|---|---|---|---|"]  # fmt: skip
    for r in beside:
        for name, v in r["result"].items():
            lines.append(
                f"| `{name}`, k = {cases.METHODS[name][1]} | {r['arguments'][1]} "
                f"| {v['ours s']:.2f} | {v['Compadre s']:.1f} | {v['ours / Compadre']:.2f} "
                f"| {v['applying, ours / Compadre']:.2f} "
                f"| {v['error']:.1e} | {v['Compadre error']:.1e} |"
            )
    lines += ["", "| DCPSE(order=2), n | build s | peak GiB |", "|---|---|---|"]
    for r in results:
        if r["case"] == "build" and r["arguments"][0] == "DCPSE(order=2)":
            v = r["result"]
            lines.append(f"| {r['arguments'][1]:,} | {v['build s']:.2f} | {v['peak GiB']:.2f} |")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m experiments.benchmarks", description=__doc__)
    parser.add_argument("group", nargs="?", default="stencils", choices=["stencils", *GROUPS])
    parser.add_argument("--quick", action="store_true", help="smaller sizes")
    parser.add_argument("--compadre", action="store_true",
                        help="also beside pycompadre, in the same run (extra: peers)")  # fmt: skip
    parser.add_argument("--only", metavar="NAME", help="cases of one function or method")
    parser.add_argument("--out", type=Path, default=Path("out"), metavar="DIR")
    parser.add_argument("--readme", action="store_true", help="put the table into the README")
    parser.add_argument("--case", nargs=2, metavar=("NAME", "ARGUMENTS"), help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.case:
        jax.config.update("jax_enable_x64", True)
        name, arguments = options.case
        module, _, function = name.rpartition(".")
        case = getattr(GROUPS.get(module, cases), function)
        print(json.dumps(case(*json.loads(arguments))))
        return
    start, results = time.perf_counter(), []
    beside = [
        ("build_beside_compadre", [p, threads, 20_000 if options.quick else 100_000])
        for p in (2, 4)
        for threads in (1, 2)
    ]
    plans = {
        "stencils": lambda quick: plan(quick) + (beside if options.compadre else []),
    } | {group: module.plan for group, module in GROUPS.items()}
    todo = [
        (name, arguments)
        for name, arguments in plans[options.group](options.quick)
        if not options.only or options.only in arguments
    ]
    for name, arguments in tqdm(todo, desc="benchmarks", unit="case"):
        result = run_case(name, arguments)
        results.append({"case": name, "arguments": arguments, "result": result})
    options.out.mkdir(parents=True, exist_ok=True)
    (options.out / f"{options.group}.json").write_text(json.dumps(results, indent=1))
    if options.group == "prompt":
        rows = prompt.rows(results)
        write_json(options.out / "prompt.json", "prompt", rows, time.perf_counter() - start)
        print(rows_table(rows))
        sys.exit(any(row.holds is False for row in rows))
    if options.group in ("accelerator", "motion"):
        print(GROUPS[options.group].summary(results))
        return
    if options.group == "heat":
        print(json.dumps(results, indent=1))
        return
    shaped = options.group == "shapes"
    text = shapes.table(results) if shaped else table(results, options.quick)
    (options.out / f"{options.group}.md").write_text(text + "\n")
    print(text)
    if options.readme:
        begin, end = (mark.replace("benchmarks", "shapes") if shaped else mark for mark in MARKS)
        before, rest = README.read_text().split(begin)
        README.write_text(f"{before}{begin}\n{text}\n{end}{rest.split(end)[1]}")


if __name__ == "__main__":
    main()
