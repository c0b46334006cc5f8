"""Borders, boundary conditions, closures and ghosts."""

_B = "test_boundary.py::"
_ONLY = "(host only: concrete arrays)"
_F32 = _B + "test_single_precision"
_GRAD, _VMAP = _B + "test_derivatives_of_the_closure", _B + "test_closures_and_conormals_under_vmap"
_NU, _GHOSTS = _B + "test_derivatives_of_conormals", _B + "test_ghosts_under_transformations"
_FREE = _B + "test_points_that_are_declared_free_under_transformations"


def _row(value, gradient, jit, vmap, float32=_F32) -> dict:
    return {
        "value": ", ".join(_B + name for name in value.split()),
        "gradient": gradient,
        "jit": jit,
        "vmap": vmap,
        "float32": float32,
        "bad input": "malformed",
    }


def _condition(*arguments: str) -> dict:
    value = "test_bound_values_of_polynomials_are_exact"
    return _row(value, dict.fromkeys(arguments, _GRAD), _GRAD, _VMAP)


TESTED = {
    "dirichlet": _condition("value"),
    "neumann": _condition("value", "conormals"),
    "robin": _condition("value", "a", "b", "conormals"),
    "Condition": _condition("value", "a", "b", "conormals"),
    "free": _row("test_points_that_are_declared_free", {"field": _FREE}, _FREE, _FREE, _FREE),
    "eliminate": _row(
        "test_poisson_with_one_sided_stencils",
        dict.fromkeys(["points", "normals", "value", "a", "b", "conormals"], _GRAD),
        _GRAD,
        _VMAP,
    ),
    "without_flux": _row(
        "test_a_surface_without_flux_is_closed_as_by_a_condition",
        {"surface": _B + "test_a_surface_without_flux_is_closed_as_by_a_condition"},
        _B + "test_a_surface_without_flux_is_closed_as_by_a_condition",
        _B + "test_a_surface_without_flux_is_closed_as_by_a_condition",
    ),
    "Closure": _row(
        "test_the_parts_of_a_closure_agree",
        {"u": _GRAD},
        _B + "test_the_parts_of_a_closure_agree",
        _VMAP,
    ),
    "with_ghosts": _row(
        "test_even_and_odd_images_of_symmetric_fields test_poisson_with_ghosts",
        dict.fromkeys(["value", "a", "b"], _GHOSTS),
        _GHOSTS,
        _GHOSTS,
    ),
    "find_border": _row("test_conormals test_conormals_of_a_mesh", _ONLY, _ONLY, _ONLY),
    "detect_boundary": _row("test_borders_are_detected", _ONLY, _ONLY, _ONLY),
    "Border": _row("test_conormals", dict.fromkeys(["points", "normals"], _NU), _NU, _VMAP),
    "border_conormals": _row(
        "test_conormals test_conormals_of_a_mesh",
        dict.fromkeys(["points", "normals"], _NU),
        _NU,
        _VMAP,
    ),
}
