"""Problems in time."""

from . import Entry

_INTEGRATE, _PDE = "test_time_integrate.py", "test_time_pde.py"
_EXPLICIT, _IMPLICIT = "test_time_explicit.py", "test_time_implicit.py"
_JIT = f"{_INTEGRATE}::test_works_under_jit_and_vmap_as_outside"
_SINGLE = f"{_PDE}::test_single_precision"
_OWN = f"{_PDE}::test_a_problem_and_a_preconditioner_of_ones_own"
_PARTS = f"{_PDE}::test_derivatives_of_waves_and_phases"
_STEPS = f"{_IMPLICIT}::test_derivatives"
_FORMS = "test_time_forms.py"
_RATES = f"{_FORMS}::test_rates_are_differentiable_in_every_array"
_MAPPED = f"{_FORMS}::test_mapped"
_MAPPED_SINGLE = f"{_FORMS}::test_mapped_in_single_precision"
_INVERSES = f"{_FORMS}::test_inverses_of_steps_under_transformations"
_STEADY = f"{_FORMS}::test_steady_states_mapped_and_differentiated"
_DAMPING = f"{_FORMS}::test_hyperviscosity_under_transformations"
_UPWIND = f"{_FORMS}::test_upwinding_mapped_and_in_single_precision"
_RAISED, _KIND = "(raised, not called)", "(the kind of problem counts, no array is read)"
_HOST = "(host only: concrete arrays)"

TESTED: dict[str, dict[str, Entry]] = {
    "integrate": {
        "value": f"{_PDE}::test_two_species_with_their_own_diffusivities_and_a_reaction",
        "gradient": {
            "state": _STEPS,
            "operator": _STEPS,
            "coefficient": _STEPS,
            "args": _STEPS,
            "few copies": f"{_INTEGRATE}::"
            "test_the_gradient_is_the_same_with_few_copies_of_the_state",
        },
        "jit": _JIT,
        "vmap": _JIT,
        "float32": _SINGLE,
        "bad input": "malformed",
    },
    "steady_state": {
        "value": f"{_INTEGRATE}::test_steady_state_ends_the_run",
        "gradient": {"args": _STEADY},
        "jit": _STEADY,
        "vmap": _STEADY,
        "float32": f"{_FORMS}::test_steady_state_in_single_precision",
        "bad input": "malformed",
    },
    "IntegrationError": {
        "value": f"{_INTEGRATE}::test_explosion_keeps_the_last_good_state",
        "gradient": _RAISED,
        "jit": f"{_INTEGRATE}::test_failure_under_jit_is_an_error_of_the_run_time",
        "vmap": _RAISED,
        "float32": _RAISED,
        "bad input": _RAISED,
    },
    "Checkpoint": {
        "value": f"{_INTEGRATE}::test_a_run_that_was_killed_goes_on_bit_by_bit",
        "gradient": _HOST,
        "jit": _HOST,
        "vmap": _HOST,
        "float32": "(kept in the precision of the state, bit by bit)",
        "bad input": f"malformed, {_INTEGRATE}::test_damaged_files_are_refused",
    },
    "RKC2": {
        "value": f"{_EXPLICIT}::test_second_order_for_a_nonlinear_problem_in_time",
        "gradient": f"{_EXPLICIT}::test_derivatives",
        "jit": f"{_EXPLICIT}::test_nothing_is_traced_again_when_the_number_of_stages_changes",
        "vmap": f"{_EXPLICIT}::test_states_of_several_parts_and_batches",
        "float32": f"{_EXPLICIT}::test_single_precision_stays_single",
        "bad input": "malformed",
    },
    "AdamsBashforth2": {
        "value": f"{_EXPLICIT}::test_second_order_from_the_step_before",
        "gradient": f"{_EXPLICIT}::test_derivatives_of_steps_from_the_step_before",
        "jit": f"{_EXPLICIT}::test_derivatives_of_steps_from_the_step_before",
        "vmap": f"{_EXPLICIT}::test_derivatives_of_steps_from_the_step_before",
        "float32": f"{_EXPLICIT}::test_derivatives_of_steps_from_the_step_before",
        "bad input": "malformed",
    },
    "IMEX": {
        "value": f"{_IMPLICIT}::test_order_of_steps_that_are_not_stiff",
        "gradient": _STEPS,
        "jit": _STEPS,
        "vmap": _MAPPED_SINGLE,
        "float32": f"{_SINGLE}, {_MAPPED_SINGLE}",
        "bad input": "malformed",
    },
    "SDIRK": {
        "value": f"{_IMPLICIT}::test_order_of_steps_that_are_not_stiff",
        "gradient": _STEPS,
        "jit": _STEPS,
        "vmap": _MAPPED,
        "float32": f"{_SINGLE}, {_MAPPED_SINGLE}",
        "bad input": "malformed",
    },
    "AbstractEvolution": {
        "value": _OWN,
        "gradient": {"state, operator, coefficient": _RATES},
        "jit": _MAPPED,
        "vmap": _MAPPED,
        "float32": _MAPPED_SINGLE,
        "bad input": "malformed",
    },
    "AdvectionDiffusionReaction": {
        "value": f"{_PDE}::test_advection_diffusion_decays_and_turns",
        "gradient": {
            "state": _STEPS,
            "operator": _STEPS,
            "diffusivity, velocity": f"{_PDE}::test_rates_are_differentiable_in_every_array",
        },
        "jit": _JIT,
        "vmap": _JIT,
        "float32": _SINGLE,
        "bad input": "malformed",
    },
    "BiharmonicDiffusion": {
        "value": f"{_PDE}::test_biharmonic_decay",
        "gradient": {"state, operator, stiffness": _RATES},
        "jit": _RATES,
        "vmap": _MAPPED_SINGLE,
        "float32": _MAPPED_SINGLE,
        "bad input": "malformed",
    },
    "CahnHilliard": {
        "value": f"{_PDE}::test_cahn_hilliard_separates_keeps_its_mass_and_loses_energy",
        "gradient": {"state, operator, width, mobility": _PARTS},
        "jit": _PARTS,
        "vmap": _MAPPED_SINGLE,
        "float32": _MAPPED_SINGLE,
        "bad input": "malformed",
    },
    "WaveEquation": {
        "value": f"{_PDE}::test_standing_wave",
        "gradient": {"state, operator, speed, damping": _PARTS},
        "jit": _PARTS,
        "vmap": _MAPPED_SINGLE,
        "float32": _MAPPED_SINGLE,
        "bad input": "malformed",
    },
    "step_preconditioner": {
        "value": "test_shifted.py::test_steps_and_gradients_are_the_same_with_it, "
        "test_renewal.py::test_implicit_steps_on_another_surface",
        "gradient": "test_shifted.py::test_steps_and_gradients_are_the_same_with_it",
        "jit": _INVERSES,
        "vmap": _INVERSES,
        "float32": f"{_INVERSES}, {_MAPPED_SINGLE}",
        "bad input": "malformed",
    },
    "choose_solver": {
        "value": f"{_INTEGRATE}::test_the_choice_is_told",
        "gradient": _KIND,
        "jit": _KIND,
        "vmap": _KIND,
        "float32": _KIND,
        "bad input": "malformed",
    },
    "hyperviscosity": {
        "value": f"{_PDE}::test_hyperviscosity_is_of_high_order",
        "gradient": {"operator, speed, spectral_radius, field": _DAMPING},
        "jit": _DAMPING,
        "vmap": _DAMPING,
        "float32": _DAMPING,
        "bad input": "malformed",
    },
    "upwind_viscosity": {
        "value": f"{_PDE}::test_damping_moves_all_eigenvalues_of_advection_to_the_left",
        "gradient": {
            "velocity": f"{_PDE}::test_upwinding_is_differentiable",
            "cloud": f"{_PDE}::test_upwinding_is_differentiable",
        },
        "jit": f"{_PDE}::test_upwinding_takes_the_neighbours_given_also_under_jit",
        "vmap": _UPWIND,
        "float32": _UPWIND,
        "bad input": "malformed",
    },
}
