"""Problems in time."""

from . import Entry

_INTEGRATE, _PDE = "test_time_integrate.py", "test_time_pde.py"
_EXPLICIT, _IMPLICIT = "test_time_explicit.py", "test_time_implicit.py"
_JIT = f"{_INTEGRATE}::test_works_under_jit_and_vmap_as_outside"
_SINGLE = f"{_PDE}::test_single_precision"
_OWN = f"{_PDE}::test_a_problem_and_a_preconditioner_of_ones_own"
_PARTS = f"{_PDE}::test_derivatives_of_waves_and_phases"
_STEPS = f"{_IMPLICIT}::test_derivatives"

TESTED: dict[str, dict[str, Entry]] = {
    "integrate": {
        "value": f"{_PDE}::test_two_species_with_their_own_diffusivities_and_a_reaction",
        "gradient": {
            "state": _STEPS, "operator": _STEPS, "coefficient": _STEPS, "args": _STEPS,
            "few copies": f"{_INTEGRATE}::"
            "test_the_gradient_is_the_same_with_few_copies_of_the_state",
        },
        "jit": _JIT, "vmap": _JIT, "float32": _SINGLE, "bad input": "malformed",
    },
    "steady_state": {
        "value": f"{_INTEGRATE}::test_steady_state_ends_the_run", "gradient": None,
        "jit": "(is a part of `integrate`)", "vmap": None, "float32": None,
        "bad input": "malformed",
    },
    "IntegrationError": {
        "value": f"{_INTEGRATE}::test_explosion_keeps_the_last_good_state", "gradient": None,
        "jit": f"{_INTEGRATE}::test_failure_under_jit_is_an_error_of_the_run_time", "vmap": None,
        "float32": None, "bad input": "(raised, not called)",
    },
    "Checkpoint": {
        "value": f"{_INTEGRATE}::test_a_run_that_was_killed_goes_on_bit_by_bit", "gradient": None,
        "jit": "(host only: concrete arrays)", "vmap": None, "float32": None,
        "bad input": f"malformed, {_INTEGRATE}::test_damaged_files_are_refused",
    },
    "RKC2": {
        "value": f"{_EXPLICIT}::test_second_order_for_a_nonlinear_problem_in_time",
        "gradient": f"{_EXPLICIT}::test_derivatives",
        "jit": f"{_EXPLICIT}::test_nothing_is_traced_again_when_the_number_of_stages_changes",
        "vmap": f"{_EXPLICIT}::test_states_of_several_parts_and_batches",
        "float32": f"{_EXPLICIT}::test_single_precision_stays_single", "bad input": "malformed",
    },
    "IMEX": {
        "value": f"{_IMPLICIT}::test_order_of_steps_that_are_not_stiff", "gradient": _STEPS,
        "jit": _STEPS, "vmap": None, "float32": _SINGLE, "bad input": "malformed",
    },
    "SDIRK": {
        "value": f"{_IMPLICIT}::test_order_of_steps_that_are_not_stiff", "gradient": _STEPS,
        "jit": _STEPS, "vmap": None, "float32": _SINGLE, "bad input": "malformed",
    },
    "AbstractEvolution": {
        "value": _OWN, "gradient": None, "jit": None, "vmap": None, "float32": None,
        "bad input": "malformed",
    },
    "AdvectionDiffusionReaction": {
        "value": f"{_PDE}::test_advection_diffusion_decays_and_turns",
        "gradient": {
            "state": _STEPS, "operator": _STEPS,
            "diffusivity, velocity": f"{_PDE}::test_rates_are_differentiable_in_every_array",
        },
        "jit": _JIT, "vmap": _JIT, "float32": _SINGLE, "bad input": "malformed",
    },
    "BiharmonicDiffusion": {
        "value": f"{_PDE}::test_biharmonic_decay", "gradient": None, "jit": None, "vmap": None,
        "float32": None, "bad input": "malformed",
    },
    "CahnHilliard": {
        "value": f"{_PDE}::test_cahn_hilliard_separates_keeps_its_mass_and_loses_energy",
        "gradient": {"state, operator, width, mobility": _PARTS}, "jit": _PARTS, "vmap": None,
        "float32": None, "bad input": "malformed",
    },
    "WaveEquation": {
        "value": f"{_PDE}::test_standing_wave",
        "gradient": {"state, operator, speed, damping": _PARTS}, "jit": _PARTS, "vmap": None,
        "float32": None, "bad input": "malformed",
    },
    "step_preconditioner": {
        "value": "test_shifted.py::test_steps_and_gradients_are_the_same_with_it",
        "gradient": "test_shifted.py::test_steps_and_gradients_are_the_same_with_it",
        "jit": None, "vmap": None, "float32": None, "bad input": "malformed",
    },
    "choose_solver": {
        "value": f"{_INTEGRATE}::test_the_choice_is_told", "gradient": None, "jit": None,
        "vmap": None, "float32": None, "bad input": "malformed",
    },
    "hyperviscosity": {
        "value": f"{_PDE}::test_hyperviscosity_is_of_high_order", "gradient": None, "jit": None,
        "vmap": None, "float32": None, "bad input": "malformed",
    },
    "upwinding": {
        "value": f"{_PDE}::test_damping_moves_all_eigenvalues_of_advection_to_the_left",
        "gradient": {
            "velocity": f"{_PDE}::test_upwinding_is_differentiable",
            "cloud": f"{_PDE}::test_upwinding_is_differentiable",
        },
        "jit": f"{_PDE}::test_upwinding_takes_the_neighbours_given_also_under_jit",
        "vmap": None, "float32": None, "bad input": "malformed",
    },
}  # fmt: skip
