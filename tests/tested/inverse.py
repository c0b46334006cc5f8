"""Unknowns from noisy data."""

_INV = "test_inverse.py::"
_HOST = "(host only: concrete arrays)"
_MAPS = _INV + "test_maps_of_priors_are_inverse_to_each_other"
_LINEAR = _INV + "test_a_linear_model_has_the_posterior_of_linear_algebra"
_SINGLE = _INV + "test_single_precision"


def _made(by: str, value: str) -> dict[str, str]:
    return {
        "value": value,
        "gradient": f"(made by {by})",
        "jit": _HOST,
        "vmap": _HOST,
        "float32": _SINGLE,
        "bad input": f"(made by {by})",
    }


def _prior(value: str) -> dict[str, str]:
    return {
        "value": value,
        "gradient": _MAPS,
        "jit": _MAPS,
        "vmap": _MAPS,
        "float32": _INV + "test_priors_in_single_precision",
        "bad input": "malformed",
    }


TESTED = {
    "solve_inverse": {
        "value": _LINEAR + ", " + _INV + "test_a_rate_and_its_deviation, "
        "test_inverse.py::test_an_initial_state_from_later_readings, "
        "test_inverse.py::test_a_conductivity_is_found_where_it_is_heated",
        "gradient": "(it takes derivatives)",
        "jit": _HOST,
        "vmap": _HOST,
        "float32": _SINGLE,
        "bad input": "malformed",
    },
    "Inversion": _made("solve_inverse", _INV + "test_a_rate_and_its_deviation"),
    "Posterior": _made("Inversion.posterior", _LINEAR),
    "AbstractPrior": _prior(_MAPS) | {"bad input": "malformed"},
    "GaussianPrior": _prior(_MAPS),
    "MaternPrior": _prior(_INV + "test_fields_have_the_variance_of_their_series, " + _LINEAR),
}
