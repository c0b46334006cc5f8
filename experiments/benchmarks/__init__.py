"""Timings: ours beside a baseline in the same run, after compilation, medians.

`python -m experiments.benchmarks` runs everything and writes `benchmarks.json` and
`benchmarks.md`; `--readme` also puts the table into the README.
"""
