"""Steady problems, eigenmodes, distances."""

_RESULT = "(made by eigenmodes)"
_SOLVES = "test_solve_forms.py::"

TESTED = {
    "solve": {
        "value": "test_steady.py::test_poisson_on_the_closed_sphere_converges, "
        "test_steady.py::test_screened_anisotropic_and_helmholtz, "
        "test_steady.py::test_what_is_incompatible_is_an_error, "
        "test_steady.py::test_numbers_of_any_size, "
        "test_solve_forms.py::test_solve_with_images, "
        "test_solve_forms.py::test_a_preconditioner_of_ones_own",
        "gradient": {
            "weights": "test_steady.py::test_derivatives_in_weights_and_right_hand_side",
            "rhs": "test_steady.py::test_derivatives_in_weights_and_right_hand_side",
            "closure": "test_steady.py::test_derivatives_with_conditions_and_jacobi",
            "points": "test_steady.py::test_derivative_in_the_geometry",
        },
        "jit": "test_steady.py::test_no_retracing_for_other_values",
        "vmap": "test_steady.py::test_several_right_hand_sides_and_transformations, "
        "test_solve_forms.py::test_vmap_over_weights_and_right_hand_sides",
        "float32": "test_steady.py::test_single_precision",
        "bad input": "malformed",
    },
    "conservative_weights": {
        "value": "test_conserve.py::test_nothing_is_left_and_weights_are_positive, "
        "test_conserve.py::test_they_are_a_quadrature_of_the_order_of_the_operator, "
        "test_conserve.py::test_mass_is_conserved_to_round_off",
        "gradient": {"weights, total, points": "test_conserve.py::test_derivatives"},
        "jit": "test_conserve.py::test_under_jit_and_vmap",
        "vmap": "test_conserve.py::test_under_jit_and_vmap",
        "float32": "test_conserve.py::test_single_precision",
        "bad input": "malformed",
    },
    "solve_nonlinear": {
        "value": "test_newton.py::test_known_solution_in_few_steps",
        "gradient": {
            "weights, args, rhs": "test_newton.py::test_derivatives",
            "coupled reaction": "test_newton.py::test_a_reaction_that_couples_points",
        },
        "jit": "test_newton.py::test_derivatives",
        "vmap": _SOLVES + "test_vmap_of_reactions",
        "float32": _SOLVES + "test_single_precision",
        "bad input": "malformed",
    },
    "eigenmodes": {
        "value": "test_eigen.py::test_groups_of_the_sphere, "
        "test_solve_forms.py::test_modes_with_images",
        "gradient": {
            "weights": "test_eigen.py::test_derivatives_of_what_belongs_to_a_group",
            "closure": "test_eigen.py::test_derivative_in_the_conditions",
            "points": "test_eigen.py::test_derivatives_of_simple_modes",
            "normals": "test_solve_forms.py::test_gradient_of_values_in_normals",
        },
        "jit": "test_eigen.py::test_under_jit_and_vmap, "
        "test_solve_forms.py::test_modes_of_another_operator_compile_nothing",
        "vmap": "test_eigen.py::test_under_jit_and_vmap",
        "float32": "test_eigen.py::test_single_precision, "
        "test_solve_forms.py::test_single_precision",
        "bad input": "malformed",
    },
    "Modes": {
        "value": "test_eigen.py::test_groups_of_the_sphere",
        "gradient": _RESULT,
        "jit": _RESULT,
        "vmap": _RESULT,
        "float32": _RESULT,
        "bad input": _RESULT,
    },
    "geodesic_distance": {
        "value": "test_geodesic.py::test_sphere",
        "gradient": {
            "points": "test_geodesic.py::test_gradient_in_points_and_normals",
            "normals": "test_geodesic.py::test_gradient_in_points_and_normals",
        },
        "jit": "test_geodesic.py::test_gradient_in_points_and_normals",
        "vmap": "test_geodesic.py::test_vmap_over_geometries",
        "float32": "test_geodesic.py::test_single_precision",
        "bad input": "malformed",
    },
    "BiCGStab": {
        "value": "test_steady.py::test_poisson_on_the_closed_sphere_converges",
        "gradient": "(derivatives of solve are implicit)",
        "jit": "test_steady.py::test_no_retracing_for_other_values",
        "vmap": "test_steady.py::test_several_right_hand_sides_and_transformations, "
        "test_solve_forms.py::test_vmap_over_weights_and_right_hand_sides",
        "float32": "test_steady.py::test_single_precision",
        "bad input": "malformed",
    },
    "multigrid": {
        "value": "test_precondition.py::test_one_cycle_damps_every_error",
        "gradient": "(not differentiated: derivatives of solve are implicit)",
        "jit": "test_renewal.py::test_steps_are_those_of_a_hierarchy_made_anew",
        "vmap": "test_renewal.py::test_vmap_over_weights",
        "float32": "test_precondition.py::test_cycle_is_linear_and_its_transpose_exact",
        "bad input": "malformed",
    },
    "VCycle": {
        "value": "test_precondition.py::test_cycle_is_linear_and_its_transpose_exact, "
        "test_renewal.py::test_at_the_same_weights_the_numbers_are_those_of_the_host",
        "gradient": "(not differentiated: derivatives of solve are implicit)",
        "jit": "test_precondition.py::test_cycle_under_transformations",
        "vmap": "test_precondition.py::test_cycle_under_transformations",
        "float32": "test_precondition.py::test_cycle_is_linear_and_its_transpose_exact",
        "bad input": "malformed",
    },
    "jacobi": {
        "value": "test_precondition.py::test_jacobi_is_the_diagonal",
        "gradient": "(not differentiated: derivatives of solve are implicit)",
        "jit": "test_steady.py::test_derivatives_with_conditions_and_jacobi",
        "vmap": _SOLVES + "test_vmap_of_reactions",
        "float32": _SOLVES + "test_single_precision",
        "bad input": "malformed",
    },
    "JacobiPreconditioner": {
        "value": "test_precondition.py::test_jacobi_is_the_diagonal",
        "gradient": "(not differentiated: derivatives of solve are implicit)",
        "jit": "test_steady.py::test_derivatives_with_conditions_and_jacobi",
        "vmap": _SOLVES + "test_vmap_of_reactions",
        "float32": _SOLVES + "test_single_precision",
        "bad input": "malformed",
    },
}
