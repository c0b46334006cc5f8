"""Point clouds."""

import functools

import numpy as np

import jaxsurf as js

from . import Case


@functools.cache
def sphere() -> js.PointCloud:
    return js.sphere(300)


CASES = [
    Case(
        "PointCloud",
        "points in four dimensions",
        lambda: js.PointCloud(np.ones((5, 4)), np.ones((5, 4))),
        ("points", "(5, 4)", "(n, 3)"),
    ),
]
