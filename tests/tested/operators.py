"""Clouds, neighbours, stencils, operators and curvature."""

_HOST = "(host only: concrete arrays; refused under jit: malformed)"
_INTEGERS = "(integers)"
_SIZES = "(static sizes: integers)"
_ABSTRACT = "(declared, not called)"
_REPORT = "(a report, constant for derivatives)"
_FORMS = "test_forms.py::"


def _operator(value: str, *arguments: str, **others: str) -> dict:
    """A row of a function of a cloud that all tests of forms run through."""
    gradient = "test_gradients.py::test_other_operators_and_curvature"
    return {
        "value": value,
        "gradient": dict.fromkeys(arguments, gradient) | others,
        "jit": _FORMS + "test_under_jit",
        "vmap": _FORMS + "test_mapped",
        "float32": _FORMS + "test_single_precision",
        "bad input": "malformed",
    }


_GEOMETRY = ("points", "normals")
_FIELD = {"field": "test_gradients.py::test_field_and_coefficients"}
_DIFFUSION = _FORMS + "test_gradients_of_diffusion_in_each_argument"
_POLYNOMIALS = _FORMS + "test_every_polynomial_of_the_basis_is_exact"
_HIGH = _FORMS + "test_every_polynomial_of_high_degree_is_exact_inside"
_ALGEBRA = {
    "value": "test_algebra.py::test_operators_are_added_and_multiplied_as_matrices",
    "gradient": {"field": "test_algebra.py::test_derivatives_in_factors_and_terms"},
    "jit": "test_algebra.py::test_operators_are_added_and_multiplied_as_matrices",
    "vmap": "test_algebra.py::test_derivatives_in_factors_and_terms",
    "float32": "test_algebra.py::test_numbers_leave_the_precision_of_a_field",
    "bad input": "malformed",
}

TESTED = {
    "PointCloud": {
        "value": _FORMS + "test_clouds_keep_what_they_are_given",
        "gradient": {"points": "test_gradients.py::test_operators_in_points_and_normals"},
        "jit": "test_operators.py::test_jit_and_vmap_equal_the_plain_call",
        "vmap": _FORMS + "test_mapped",
        "float32": _FORMS + "test_single_precision",
        "bad input": "malformed",
    },
    "Neighbors": {
        "value": "test_neighbors.py::test_nearest_against_brute_force",
        "gradient": _INTEGERS,
        "jit": "test_neighbors.py::test_search_under_jit_vmap_and_grad",
        "vmap": "test_neighbors.py::test_search_under_jit_vmap_and_grad",
        "float32": "test_neighbors.py::test_both_searches_agree_on_ties_and_thin_parts",
        "bad input": "malformed",
    },
    "find_neighbors": {
        "value": "test_neighbors.py::test_nearest_against_brute_force, "
        "test_neighbors.py::test_radius_against_brute_force, "
        "test_forms.py::test_lists_follow_the_points",
        "gradient": {"points": _INTEGERS},
        "jit": "test_neighbors.py::test_misuse_is_refused",
        "vmap": _HOST,
        "float32": "test_neighbors.py::test_both_searches_agree_on_ties_and_thin_parts",
        "bad input": "malformed",
    },
    "choose_neighbors": {
        "value": "test_stability.py::test_irregular_points_get_larger_neighborhoods, "
        "test_forms.py::test_where_no_neighbourhood_serves",
        "gradient": _INTEGERS,
        "jit": _HOST,
        "vmap": _HOST,
        "float32": "test_operators.py::test_single_precision",
        "bad input": "malformed",
    },
    "SearchCapacity": {
        "value": "test_neighbors.py::test_capacity_exceeded_gives_both_numbers",
        "gradient": _SIZES,
        "jit": _SIZES,
        "vmap": _SIZES,
        "float32": _SIZES,
        "bad input": "malformed",
    },
    "allocate_search": {
        "value": "test_neighbors.py::test_capacity_exceeded_gives_both_numbers",
        "gradient": _INTEGERS,
        "jit": "test_neighbors.py::test_misuse_is_refused",
        "vmap": _HOST,
        "float32": "test_neighbors.py::test_both_searches_agree_on_ties_and_thin_parts",
        "bad input": "malformed",
    },
    "search_neighbors": {
        "value": "test_neighbors.py::test_both_searches_give_the_same_sets_on_spheres",
        "gradient": {"points": "test_neighbors.py::test_search_under_jit_vmap_and_grad"},
        "jit": "test_neighbors.py::test_search_under_jit_vmap_and_grad",
        "vmap": "test_neighbors.py::test_search_under_jit_vmap_and_grad",
        "float32": "test_neighbors.py::test_both_searches_agree_on_ties_and_thin_parts",
        "bad input": "malformed",
    },
    "tube_ratio": {
        "value": "test_neighbors.py::test_tube_ratio_is_the_largest_curvature",
        "gradient": {"points": "test_neighbors.py::test_tube_ratio_is_the_largest_curvature"},
        "jit": "test_neighbors.py::test_tube_ratio_is_the_largest_curvature",
        "vmap": _FORMS + "test_mapped",
        "float32": _FORMS + "test_single_precision",
        "bad input": "malformed",
    },
    "laplace_beltrami": {
        **_operator("test_accuracy.py::test_convergence_on_the_sphere, " + _POLYNOMIALS),
        "gradient": {
            "points": "test_gradients.py::test_operators_in_points_and_normals",
            "normals": "test_gradients.py::test_normals_alone",
            "curves": _FORMS + "test_gradients_on_plane_curves",
            **_FIELD,
        },
    },
    "surface_gradient": _operator(
        "test_accuracy.py::test_convergence_on_the_sphere", *_GEOMETRY, **_FIELD
    ),
    "surface_divergence": {
        **_operator("test_accuracy.py::test_convergence_on_the_sphere"),
        "gradient": {
            "points": "test_gradients.py::test_operators_in_points_and_normals",
            "normals": "test_gradients.py::test_operators_in_points_and_normals",
            "field": _FORMS + "test_gradients_on_plane_curves",
        },
    },
    "biharmonic": _operator(
        "test_operators.py::test_biharmonic",
        *_GEOMETRY,
        field="test_operators.py::test_matrix_transpose_and_lineax_agree",
    ),
    "diffusion": _operator(
        "test_operators.py::test_inhomogeneous_diffusion, "
        "test_operators.py::test_anisotropic_diffusion_around_the_axis",
        points=_DIFFUSION,
        normals=_DIFFUSION,
        diffusivity=_DIFFUSION,
        field=_DIFFUSION,
    ),
    "directional_derivative": _operator(
        "test_operators.py::test_quadratics_on_a_plane_are_exact",
        *_GEOMETRY,
        direction="test_gradients.py::test_field_and_coefficients",
        field=_FORMS + "test_gradients_on_plane_curves",
    ),
    "partial_derivative": {
        "value": "test_flat.py::test_polynomials_are_exact, test_flat.py::test_convergence",
        "gradient": {
            "points": "test_flat.py::test_derivative_in_points",
            "field": "(as every stencil: test_gradients.py)",
        },
        "jit": "test_flat.py::test_derivative_in_points",
        "vmap": _FORMS + "test_partial_derivatives_in_other_forms",
        "float32": _FORMS + "test_partial_derivatives_in_other_forms",
        "bad input": "malformed",
    },
    "shape_tensor": _operator("test_curvature.py::test_torus", *_GEOMETRY),
    "mean_curvature": _operator(
        "test_curvature.py::test_torus, "
        "test_curvature.py::test_ellipsoid_converges_at_second_order",
        *_GEOMETRY,
        curves=_FORMS + "test_gradients_on_plane_curves",
    ),
    "gauss_curvature": _operator("test_curvature.py::test_torus", *_GEOMETRY),
    "principal_curvatures": _operator("test_curvature.py::test_torus", *_GEOMETRY),
    "mean_curvature_vector": _operator("test_curvature.py::test_torus", *_GEOMETRY),
    "Stencil": {
        "value": _FORMS + "test_stencils_are_matrices",
        "gradient": {
            "weights": "test_gradients.py::test_field_and_coefficients",
            "field": "test_gradients.py::test_field_and_coefficients",
        },
        "jit": "test_operators.py::test_jit_and_vmap_equal_the_plain_call",
        "vmap": _FORMS + "test_mapped",
        "float32": _FORMS + "test_single_precision",
        "bad input": "malformed",
    },
    "Composition": {
        "value": "test_operators.py::test_matrix_transpose_and_lineax_agree",
        "gradient": {"field": "test_gradients.py::test_other_operators_and_curvature"},
        "jit": _FORMS + "test_under_jit",
        "vmap": _FORMS + "test_mapped",
        "float32": _FORMS + "test_single_precision",
        "bad input": "malformed",
    },
    **dict.fromkeys(("Sum", "Diagonal", "identity"), _ALGEBRA),
    "DCPSE": {
        "value": "test_accuracy.py::test_convergence_on_the_sphere, "
        "test_forms.py::test_every_polynomial_of_the_surface_basis_is_exact, " + _HIGH,
        "gradient": {"points": "test_gradients.py::test_operators_in_points_and_normals"},
        "jit": "test_operators.py::test_jit_and_vmap_equal_the_plain_call",
        "vmap": "test_operators.py::test_jit_and_vmap_equal_the_plain_call",
        "float32": "test_operators.py::test_single_precision",
        "bad input": "malformed",
    },
    "GFDM": {
        "value": "test_accuracy.py::test_convergence_on_the_sphere, " + _POLYNOMIALS + ", " + _HIGH,
        "gradient": {"points": "test_gradients.py::test_operators_in_points_and_normals"},
        "jit": "test_operators.py::test_jit_and_vmap_equal_the_plain_call",
        "vmap": "test_operators.py::test_jit_and_vmap_equal_the_plain_call",
        "float32": "test_operators.py::test_single_precision",
        "bad input": "malformed",
    },
    "RBFFD": {
        "value": "test_accuracy.py::test_convergence_on_the_sphere, "
        + _POLYNOMIALS
        + ", test_stability.py::test_spectrum",
        "gradient": {"points": "test_gradients.py::test_operators_in_points_and_normals"},
        "jit": "test_operators.py::test_jit_and_vmap_equal_the_plain_call",
        "vmap": "test_operators.py::test_jit_and_vmap_equal_the_plain_call",
        "float32": "test_operators.py::test_single_precision",
        "bad input": "malformed",
    },
    "FlatDCPSE": {
        "value": "test_flat.py::test_polynomials_are_exact",
        "gradient": {"points": "test_flat.py::test_derivative_in_points"},
        "jit": "test_flat.py::test_derivative_in_points",
        "vmap": _FORMS + "test_partial_derivatives_in_other_forms",
        "float32": _FORMS + "test_partial_derivatives_in_other_forms",
        "bad input": "malformed",
    },
    "AbstractMethod": {
        "value": _FORMS + "test_a_users_own_method",
        "gradient": {"points": _FORMS + "test_a_users_own_method"},
        "jit": _FORMS + "test_a_users_own_method",
        "vmap": _FORMS + "test_a_users_own_method_in_other_forms",
        "float32": _FORMS + "test_a_users_own_method_in_other_forms",
        "bad input": _ABSTRACT,
    },
    "AbstractOperator": {
        "value": "test_operators.py::test_matrix_transpose_and_lineax_agree",
        "gradient": {"field": "test_gradients.py::test_other_operators_and_curvature"},
        "jit": _FORMS + "test_under_jit",
        "vmap": _FORMS + "test_mapped",
        "float32": _FORMS + "test_single_precision",
        "bad input": "malformed",
    },
    "Diagnostics": {
        "value": "test_bad_input.py::test_points_on_a_line",
        "gradient": _REPORT,
        "jit": "test_moments.py::test_points_of_a_block_do_not_mix",
        "vmap": _FORMS + "test_diagnostics_in_other_forms",
        "float32": _FORMS + "test_diagnostics_in_other_forms",
        "bad input": "(made by operators)",
    },
    "discretize": {
        "value": "test_discretization.py::test_operators_are_made_once, "
        "test_discretization.py::test_integrals_over_the_torus, "
        "test_discretization.py::test_interpolation, "
        "test_discretization.py::test_moved_surfaces_are_new_ones",
        "gradient": {
            "points": "test_discretization.py::test_derivatives_of_integrals",
            "normals": "test_discretization.py::test_derivatives_of_integrals",
            "field": "test_discretization.py::test_derivatives_of_interpolation",
        },
        "jit": "test_discretization.py::test_moves_in_compiled_code",
        "vmap": "test_discretization.py::test_moves_in_compiled_code",
        "float32": "test_discretization.py::test_single_precision",
        "bad input": "malformed",
    },
    "Discretization": {
        "value": "test_discretization.py::test_moved_surfaces_are_new_ones",
        "gradient": {"points": "test_discretization.py::test_moves_in_compiled_code"},
        "jit": "test_discretization.py::test_moves_in_compiled_code",
        "vmap": "test_discretization.py::test_moves_in_compiled_code",
        "float32": "test_discretization.py::test_single_precision",
        "bad input": "malformed",
    },
    "NeighborSearch": {
        "value": "test_renew.py::test_lists_sizes_and_operators_of_the_host, "
        "test_renew.py::test_sheets_are_told_apart_as_on_the_host, "
        "test_renew.py::test_a_moved_cloud_is_as_stable_as_a_new_one",
        "gradient": {"points": "test_renew.py::test_derivatives_with_lists_that_are_found"},
        "jit": "test_renew.py::test_lists_sizes_and_operators_of_the_host",
        "vmap": "test_renew.py::test_mapped",
        "float32": "test_renew.py::test_single_precision",
        "bad input": "malformed",
    },
}
