_ONLY = "(host only: concrete arrays)"

TESTED = {
    "spectral_estimate": {
        "value": "test_spectrum.py::test_stable_operators, "
        "test_spectrum.py::test_a_growing_mode_is_found",
        "gradient": _ONLY,
        "jit": "(host only: concrete arrays; refused under jit: malformed)",
        "vmap": _ONLY,
        "float32": "test_spectrum.py::test_single_precision",
        "bad input": "malformed",
    },
    "Spectrum": {
        "value": "test_spectrum.py::test_few_points",
        "gradient": None,
        "jit": None,
        "vmap": None,
        "float32": "test_spectrum.py::test_single_precision",
        "bad input": None,
    },
}
