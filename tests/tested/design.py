"""Shapes as unknowns."""

_TAYLOR, _ENERGY = "test_taylor.py::", "test_energies.py::"
_FUN, _SHAPE = "test_functionals.py::", "test_design.py::"
_CURVES = _FUN + "test_curves_compiled_mapped_and_in_single_precision"
_MOVED = {"points, normals": _FUN + "test_derivatives_in_the_geometry"}
_HOST = "(host only: concrete arrays)"

_OPT = "test_optimize.py::"
_REP, _SOB = "test_repulsion.py::", "test_sobolev.py::"

TESTED = {
    "optimize_shape": {
        "value": _OPT + "test_least_area_at_fixed_volume_is_a_ball_and_compiles_no_step, "
        "test_optimize.py::test_neighbours_are_those_of_the_surface_that_is_reached, "
        "test_optimize.py::test_inequalities_hold_and_press",
        "gradient": "(it takes derivatives)",
        "jit": _HOST,
        "vmap": _HOST,
        "float32": _OPT + "test_single_precision",
        "bad input": "malformed",
    },
    "ShapeOptimization": {
        "value": _OPT + "test_least_area_at_fixed_volume_is_a_ball_and_compiles_no_step",
        "gradient": "(made by optimize_shape)",
        "jit": _HOST,
        "vmap": _HOST,
        "float32": _OPT + "test_single_precision",
        "bad input": "(made by optimize_shape)",
    },
    "OptimizationError": {
        "value": _OPT + "test_steps_that_fold_are_halved_and_the_last_good_shape_is_kept",
        "gradient": "(raised, not made)",
        "jit": "(raised, not made)",
        "vmap": "(raised, not made)",
        "float32": "(raised, not made)",
        "bad input": "(raised, not made)",
    },
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
    "volume": {
        "value": _FUN + "test_values_and_shape_derivatives_on_the_torus",
        "gradient": _MOVED,
        "jit": _CURVES,
        "vmap": _CURVES,
        "float32": _CURVES,
        "bad input": "malformed",
    },
    "willmore_energy": {
        "value": _FUN + "test_the_willmore_energy_on_the_torus",
        "gradient": _MOVED,
        "jit": _CURVES,
        "vmap": _CURVES,
        "float32": _CURVES,
        "bad input": "malformed",
    },
    "moments": {
        "value": _FUN + "test_values_and_shape_derivatives_on_the_torus",
        "gradient": _MOVED,
        "jit": _CURVES,
        "vmap": _CURVES,
        "float32": _CURVES,
        "bad input": "malformed",
    },
    "eigenvalues": {
        "value": _ENERGY + "test_values_and_shape_derivatives_on_the_torus, "
        "test_energies.py::test_ritz_values_of_a_group_that_k_cuts_off",
        "gradient": {"points, normals": _ENERGY + "test_derivatives_in_the_geometry"},
        "jit": _ENERGY + "test_eigenvalues_mapped_and_in_single_precision",
        "vmap": _ENERGY + "test_eigenvalues_mapped_and_in_single_precision",
        "float32": _ENERGY + "test_eigenvalues_mapped_and_in_single_precision",
        "bad input": "malformed",
    },
    "compliance": {
        "value": _ENERGY + "test_values_and_shape_derivatives_on_the_torus, "
        "test_functionals.py::test_compliance_of_the_ball",
        "gradient": {**_MOVED, "f": _FUN + "test_compliance_of_the_ball"},
        "jit": _CURVES,
        "vmap": _CURVES,
        "float32": _CURVES,
        "bad input": "malformed",
    },
    "chamfer_distance": {
        "value": _FUN + "test_distances",
        "gradient": {**_MOVED, "targets": _FUN + "test_distances"},
        "jit": _CURVES,
        "vmap": _CURVES,
        "float32": _CURVES,
        "bad input": "malformed",
    },
    **{
        name: {
            "value": _REP + value,
            "gradient": {"points, normals": _REP + "test_derivatives"},
            "jit": _REP + "test_compiled_mapped_and_in_single_precision",
            "vmap": _REP + "test_compiled_mapped_and_in_single_precision",
            "float32": _REP + "test_compiled_mapped_and_in_single_precision",
            "bad input": "malformed",
        }
        for name, value in (
            ("tangent_point_energy", "test_energy_of_a_torus_is_of_second_order"),
            ("medial_radius", "test_medial_radii_in_closed_form"),
        )
    },
    "LivePlot": {
        "value": "test_live.py::test_it_shows_the_surface_and_the_way_there_every_so_many_steps",
        "gradient": "(a picture)",
        "jit": "(a picture)",
        "vmap": "(a picture)",
        "float32": "(a picture)",
        "bad input": "malformed",
    },
    "sobolev_gradient": {
        "value": _SOB + "test_harmonics_fall_by_their_eigenvalues, "
        "test_sobolev.py::test_it_is_the_gradient_in_the_sobolev_inner_product, "
        "test_sobolev.py::test_points_are_held",
        "gradient": "(it transforms derivatives)",
        "jit": _SOB + "test_bumps_are_smoothed_in_free_form_and_nothing_is_compiled_between_steps",
        "vmap": _SOB + "test_single_precision_and_fields_with_components",
        "float32": _SOB + "test_single_precision_and_fields_with_components",
        "bad input": "malformed",
    },
    "signed_distance": {
        "value": _FUN + "test_signed_distances",
        "gradient": {
            "y": _FUN + "test_signed_distances",
            "points, normals": _FUN + "test_derivatives_of_signed_distances",
        },
        "jit": _FUN + "test_derivatives_of_signed_distances",
        "vmap": _FUN + "test_derivatives_of_signed_distances",
        "float32": _FUN + "test_derivatives_of_signed_distances",
        "bad input": "malformed",
    },
    "LevelSetShape": {
        "value": _SHAPE + "test_points_and_normals_are_those_of_the_shape",
        "gradient": {"theta": _SHAPE + "test_derivatives_are_differences_of_shapes_made_anew"},
        "jit": _SHAPE + "test_compiled_once_mapped_and_on_the_same_lists",
        "vmap": _SHAPE + "test_compiled_once_mapped_and_on_the_same_lists",
        "float32": _SHAPE + "test_single_precision",
        "bad input": "malformed",
    },
    "MappedShape": {
        "value": _SHAPE + "test_points_and_normals_are_those_of_the_shape, "
        "test_optimize.py::test_stars_and_maps_are_spread_evenly_again",
        "gradient": {"theta": _SHAPE + "test_derivatives_are_differences_of_shapes_made_anew"},
        "jit": _SHAPE + "test_compiled_once_mapped_and_on_the_same_lists",
        "vmap": _SHAPE + "test_compiled_once_mapped_and_on_the_same_lists",
        "float32": _SHAPE + "test_single_precision",
        "bad input": "malformed",
    },
    "NormalShape": {
        "value": _SHAPE + "test_derivatives_are_differences_of_shapes_made_anew",
        "gradient": {"theta": _SHAPE + "test_derivatives_are_differences_of_shapes_made_anew"},
        "jit": _SHAPE + "test_compiled_once_mapped_and_on_the_same_lists",
        "vmap": _SHAPE + "test_compiled_once_mapped_and_on_the_same_lists",
        "float32": _SHAPE + "test_single_precision",
        "bad input": "malformed",
    },
    "star_shape": {
        "value": _SHAPE + "test_derivatives_are_differences_of_shapes_made_anew, "
        "test_optimize.py::test_points_are_spread_on_the_way_and_no_step_compiles",
        "gradient": {"theta": _SHAPE + "test_derivatives_are_differences_of_shapes_made_anew"},
        "jit": _SHAPE + "test_compiled_once_mapped_and_on_the_same_lists",
        "vmap": _SHAPE + "test_compiled_once_mapped_and_on_the_same_lists",
        "float32": _SHAPE + "test_single_precision",
        "bad input": "malformed",
    },
    "rigid_motion": {
        "value": _SHAPE + "test_rotations_are_smooth_at_none",
        "gradient": {"theta, x": _SHAPE + "test_rotations_are_smooth_at_none"},
        "jit": _SHAPE + "test_rotations_are_smooth_at_none",
        "vmap": _SHAPE + "test_rotations_are_smooth_at_none",
        "float32": _SHAPE + "test_single_precision",
        "bad input": "malformed",
    },
    "spherical_harmonics": {
        "value": _SHAPE + "test_harmonics_are_orthonormal_and_harmonic",
        "gradient": {"directions": _SHAPE + "test_harmonics_are_orthonormal_and_harmonic"},
        "jit": _SHAPE + "test_compiled_once_mapped_and_on_the_same_lists",
        "vmap": _SHAPE + "test_compiled_once_mapped_and_on_the_same_lists",
        "float32": _SHAPE + "test_single_precision",
        "bad input": "malformed",
    },
}
