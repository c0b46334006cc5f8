_HOST = "(host only: concrete arrays)"
_SHAPES, _SAMPLING = "test_shapes.py::", "test_sampling.py::"
_FRAMES, _IO, _PLOT, _MESHES = (
    "test_frames.py::",
    "test_io.py::",
    "test_plot.py::",
    "test_meshes.py::",
)
_SINGLE = _SHAPES + "test_level_sets_in_single_precision"
_FILES_SINGLE = _IO + "test_single_precision_without_x64"
_MAPPED = _SHAPES + "test_gradients_in_points_and_parameters"


def _host(value, float32=_FILES_SINGLE):
    return {
        "value": value,
        "gradient": _HOST,
        "jit": _HOST,
        "vmap": _HOST,
        "float32": float32,
        "bad input": "malformed",
    }


_EXACT = _SHAPES + "test_analytic_points_and_normals_are_exact"

TESTED = {
    "circle": _host(_SHAPES + "test_circle_is_equispaced_in_order", _SINGLE),
    "sphere": _host(_EXACT, _SINGLE),
    "ellipsoid": _host(_EXACT, _SINGLE),
    "torus": _host(_EXACT, _SINGLE),
    "graph": _host(_SHAPES + "test_graph_is_a_regular_grid_with_upward_normals", _SINGLE),
    "surface_of_revolution": _host(
        _SHAPES + "test_hemisphere_has_a_border_and_outward_normals", _SINGLE
    ),
    "level_set": _host(_SHAPES + "test_level_set_is_even", _SINGLE),
    "double_torus": {
        "value": _SHAPES + "test_double_torus_is_resolved_by_ten_thousand_points",
        "gradient": {
            "thickness": _SHAPES + "test_derivative_of_the_double_torus_with_its_curvature"
        },
        "jit": _SHAPES + "test_derivative_of_the_double_torus_with_its_curvature",
        "vmap": _SHAPES + "test_double_tori_of_several_thicknesses_at_once",
        "float32": _SINGLE,
        "bad input": "malformed",
    },
    "project_to_level_set": {
        "value": _SHAPES + "test_projection_moves_along_the_gradient_at_the_start",
        "gradient": {
            "points": _SHAPES + "test_derivatives_of_the_projection",
            "phi": _SHAPES + "test_derivatives_of_the_projection",
        },
        "jit": _SHAPES + "test_projection_reports_failure",
        "vmap": _SHAPES + "test_derivatives_of_the_projection",
        "float32": _SHAPES + "test_single_precision",
        "bad input": "malformed",
    },
    "level_set_normals": {
        "value": _EXACT,
        "gradient": {"points": _MAPPED, "phi": _MAPPED},
        "jit": _MAPPED,
        "vmap": _MAPPED,
        "float32": _SINGLE,
        "bad input": "malformed",
    },
    "level_set_curvature": {
        "value": _SHAPES + "test_curvature_is_exact",
        "gradient": {"points": _MAPPED, "phi": _MAPPED},
        "jit": _MAPPED,
        "vmap": _MAPPED,
        "float32": _SINGLE,
        "bad input": "malformed",
    },
    "TriangleMesh": _host(
        _MESHES + "test_sphere_and_torus_in_numbers",
        "(NumPy in double precision, whatever the precision of JAX)",
    ),
    "clean_mesh": _host(
        _MESHES + "test_nothing_is_lost_silently",
        "(NumPy in double precision, whatever the precision of JAX)",
    ),
    "sample_mesh": _host(_MESHES + "test_sphere_is_resampled_evenly"),
    "sort_cloud": _host(
        _SAMPLING + "test_sort_cloud_carries_fields_in_and_out_and_keeps_inactive_rows_last"
    ),
    "jitter": _host(_SAMPLING + "test_jitter_is_uniform_in_a_ball_and_back_on_the_surface"),
    "poisson_disk": _host(_SAMPLING + "test_poisson_disk_is_apart_and_maximal"),
    "read": _host(_IO + "test_every_mesh_format, " + _IO + "test_cloud_and_fields_come_back"),
    "read_fields": _host(_IO + "test_cloud_and_fields_come_back"),
    "write": _host(
        _IO
        + "test_what_is_written_is_read_or_refused, "
        + _IO
        + "test_a_series_lists_a_file_for_each_time"
    ),
    "plot_cloud": _host(_PLOT + "test_colours_follow_the_field_and_the_view"),
    "plot_fields": _host(_PLOT + "test_panels_are_written"),
    "plot_series": _host(_PLOT + "test_a_sheet_has_one_frame_and_one_set_of_colours"),
    "animate": _host(_PLOT + "test_a_film_has_a_picture_for_each_time"),
    "estimate_normals": _host(
        _FRAMES + "test_refit_order", _FRAMES + "test_single_precision_without_x64"
    ),
    "from_points": _host(_FRAMES + "test_borders", _FRAMES + "test_single_precision_without_x64"),
    "refit_normals": {
        "value": _FRAMES + "test_refit_order",
        "gradient": {
            "points": _FRAMES + "test_refit_derivative",
            "normals": _FRAMES + "test_refit_derivative_in_the_normals",
            "plane curves": _FRAMES + "test_gradients_on_plane_curves",
        },
        "jit": _FRAMES + "test_refit_under_jit_vmap_and_padding",
        "vmap": _FRAMES + "test_refit_under_jit_vmap_and_padding",
        "float32": _FRAMES + "test_single_precision_without_x64",
        "bad input": "malformed",
    },
    "tangent_frames": {
        "value": _FRAMES + "test_frames_are_rotations",
        "gradient": {"normals": _FRAMES + "test_gradient_of_frames"},
        "jit": _FRAMES + "test_frames_under_jit_vmap_and_grad",
        "vmap": _FRAMES + "test_frames_under_jit_vmap_and_grad",
        "float32": _FRAMES + "test_frames_are_rotations",
        "bad input": "malformed",
    },
}
