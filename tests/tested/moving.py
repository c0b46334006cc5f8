"""Surfaces that move."""

from . import Entry

_M = "test_moving.py::"
_HEAT = _M + "test_solvers_keep_their_order_though_the_geometry_moves"
_SLOPES, _MAPPED = (
    _M + "test_derivatives_through_the_motion",
    _M + "test_mapped_and_in_single_precision",
)
_OUTRUN = _M + "test_a_compiled_motion_that_outruns_its_neighbours_is_an_error"
_SHRUNK = _M + "test_a_sphere_shrinks_by_its_curvature"

_A = "test_adaptation.py::"
_FILLED = (
    f"{_A}test_holes_are_filled_and_crowds_thinned, {_A}test_gaps_of_curves_are_filled, "
    f"{_A}test_spacing_may_follow_the_curvature_and_integrals_stay, "
    f"{_A}test_borders_stay_and_their_gaps_are_filled"
)
_F = "test_flows.py::"
_C = "test_contact.py::"
_S = "test_redistribution.py::"
_SLID = _S + "test_derivatives_and_single_precision"
_MET = (
    f"{_C}test_what_faces_what, {_C}test_a_cut_leaves_closed_surfaces, "
    f"{_C}test_plane_curves_pinch_too, {_C}test_a_waist_that_is_squeezed_pinches_off, "
    f"{_C}test_parts_vanish_and_a_run_ends_with_the_last, {_C}test_sheets_are_kept_apart"
)
_CHOSEN = "(which points there are is decided on the host)"

_ADAPTED: dict[str, Entry] = {
    "value": f"{_FILLED}, {_A}test_points_are_added_while_a_sphere_grows",
    "gradient": _CHOSEN,
    "jit": _CHOSEN,
    "vmap": _CHOSEN,
    "float32": _A + "test_in_single_precision",
    "bad input": f"malformed, {_A}test_an_error_says_how_many_points_are_needed",
}

TESTED: dict[str, dict[str, Entry]] = {
    "Adaptation": _ADAPTED,
    "adapt_points": _ADAPTED,
    "Contact": {
        "value": _MET,
        "gradient": _CHOSEN,
        "jit": _CHOSEN,
        "vmap": _CHOSEN,
        "float32": _C + "test_in_single_precision",
        "bad input": "malformed",
    },
    "Adapted": {
        "value": _FILLED,
        "gradient": _CHOSEN,
        "jit": _CHOSEN,
        "vmap": _CHOSEN,
        "float32": _A + "test_in_single_precision",
        "bad input": "(returned, not made)",
    },
    "evolve": {
        "value": f"{_HEAT}, {_M}test_a_rigid_motion_and_what_is_saved, "
        f"{_M}test_neighbours_are_found_anew_where_a_surface_is_sheared, "
        f"{_M}test_waves_are_diluted_in_their_velocity",
        "gradient": {"points": _SLOPES, "fields": _SLOPES, "args": _SLOPES},
        "jit": _SLOPES,
        "vmap": _MAPPED,
        "float32": _MAPPED,
        "bad input": f"malformed, {_OUTRUN}",
    },
    "Evolution": {
        "value": f"{_M}test_a_rigid_motion_and_what_is_saved, "
        f"{_M}test_an_ellipsoid_that_keeps_its_volume_loses_area",
        "gradient": {"points": _SLOPES},
        "jit": _SLOPES,
        "vmap": _MAPPED,
        "float32": _MAPPED,
        "bad input": "(returned, not made)",
    },
    "Motion": {
        "value": _HEAT,
        "gradient": {"args": _SLOPES},
        "jit": _SLOPES,
        "vmap": _MAPPED,
        "float32": _MAPPED,
        "bad input": "malformed",
    },
    "MeanCurvatureFlow": {
        "value": f"{_SHRUNK}, {_M}test_an_ellipsoid_that_keeps_its_volume_loses_area, "
        f"{_F}test_curvature_smoothed",
        "gradient": "(made of operators, whose derivatives are tested)",
        "jit": "(made of operators, as the velocities of Motion are)",
        "vmap": "(made of operators, as the velocities of Motion are)",
        "float32": "(made of operators, as the velocities of Motion are)",
        "bad input": "malformed",
    },
    "SurfaceDiffusionFlow": {
        "value": f"{_F}test_bumps_decay_as_the_linear_theory_says, {_F}test_velocities_on_tori, "
        f"{_F}test_energies_fall_on_the_way_to_a_sphere, {_F}test_curves",
        "gradient": {"points": f"{_F}test_derivatives_through_a_flow"},
        "jit": f"{_F}test_derivatives_through_a_flow",
        "vmap": "(made of operators, as the velocities of Motion are)",
        "float32": "(made of operators, as the velocities of Motion are)",
        "bad input": "malformed",
    },
    "WillmoreFlow": {
        "value": f"{_F}test_bumps_decay_as_the_linear_theory_says, {_F}test_velocities_on_tori, "
        f"{_F}test_energies_fall_on_the_way_to_a_sphere, {_F}test_curves",
        "gradient": "(made of operators, whose derivatives are tested)",
        "jit": f"{_F}test_derivatives_through_a_flow",
        "vmap": "(made of operators, as the velocities of Motion are)",
        "float32": f"{_F}test_in_single_precision",
        "bad input": "malformed",
    },
    "Redistribution": {
        "value": f"{_S}test_density_diffuses_and_all_else_stays, "
        f"{_S}test_heat_is_as_on_points_at_rest, {_S}test_curves_and_spacings_that_vary, "
        f"{_S}test_a_flow_with_it_has_the_same_surface_even_points_and_fewer_steps",
        "gradient": {"diffusivity": _SLID, "points": _SLID, "fields": _SLID},
        "jit": _SLID,
        "vmap": _SLID,
        "float32": _SLID,
        "bad input": "malformed",
    },
}  # fmt: skip
