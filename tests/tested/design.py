"""Shapes as unknowns."""

_TAYLOR = "test_taylor.py::"
_HOST = "(host only: concrete arrays)"

TESTED = {
    "taylor_remainders": {
        "value": _TAYLOR + "test_slopes_of_right_and_wrong_derivatives, "
        "test_taylor.py::test_linear_functions_leave_nothing",
        "gradient": "(it is about derivatives)",
        "jit": _HOST,
        "vmap": _HOST,
        "float32": _TAYLOR + "test_slopes_of_right_and_wrong_derivatives",
        "bad input": "malformed",
    },
    "TaylorRemainders": {
        "value": _TAYLOR + "test_what_it_shows",
        "gradient": "(made by taylor_remainders)",
        "jit": _HOST,
        "vmap": _HOST,
        "float32": _TAYLOR + "test_slopes_of_right_and_wrong_derivatives",
        "bad input": "(made by taylor_remainders)",
    },
}
