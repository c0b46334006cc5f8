_ONLY = "(host only: concrete arrays)"
_RESULT = "(made by spectral_estimate)"

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
        "gradient": _RESULT,
        "jit": _RESULT,
        "vmap": _RESULT,
        "float32": "test_spectrum.py::test_single_precision",
        "bad input": _RESULT,
    },
}
