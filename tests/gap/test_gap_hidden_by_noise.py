"""What a coarse encoder hides along a motion, and the closed loop's own torque shows."""

from __future__ import annotations

from dataclasses import replace

import gap_sets
import numpy as np
import pytest

from frictid_hil.gap.borne_out import Loop
from frictid_hil.gap.channel import Term
from frictid_hil.gap.findings import Finding
from frictid_hil.gap.forward import Effects, Replay, settled_nm
from frictid_hil.gap.hidden import hidden
from frictid_hil.gap.verdict import DOUBTED, TIED

COARSE = replace(gap_sets.NOMINAL, encoder_resolution_rad=6e-4)
STEPS = {
    "friction_level_error": 0.3,
    "gravity_error": 0.3,
    "inertia_error": 1.0,
    "torque_bias": 1.0,
    "torque_constant_error": 0.2,
}
CANDIDATES = [Term(name, {}, (k,), np.zeros(1), np.array([step])) for k, (name, step) in enumerate(STEPS.items())]


def loop(replay: Replay) -> Loop:
    def gap_nm(effects: Effects) -> float:
        return settled_nm(replay(effects, validation=True))

    return Loop(gap_nm, gap_nm({}), 0.012)


def numbers_hold(found: list[Finding], effects: dict[str, dict[str, float]]) -> bool:
    told = {(f.effect, n): v for f in found for n, v in f.parameters.items()}
    return all(
        abs(told[e, n].value / value - 1.0) < 0.2 and (told[e, n].low or 0.0) < value < (told[e, n].high or 0.0)
        for e, values in effects.items()
        for n, value in values.items()
    )


@pytest.mark.slow
def test_a_cause_is_found_in_the_loops_torque_with_its_number() -> None:
    effects = {"friction_level_error": {"error_share": 0.08}}
    replay = Replay(gap_sets.make(effects, COARSE))
    found = hidden(CANDIDATES, replay, loop(replay), {})
    assert found is not None and [(f.effect, f.confidence) for f in found[0]] == [("friction_level_error", DOUBTED)]
    assert numbers_hold(found[0], effects)


@pytest.mark.slow
def test_of_two_causes_one_that_gravity_makes_as_well_is_told_with_it() -> None:
    effects = {"torque_bias": {"bias_nm": 0.4}, "friction_level_error": {"error_share": 0.1}}
    replay = Replay(gap_sets.make(effects, COARSE))
    found = hidden(CANDIDATES, replay, loop(replay), {})
    assert found is not None and numbers_hold(found[0], effects)
    told = {f.effect: f for f in found[0]}
    assert told["friction_level_error"].confidence == DOUBTED
    if len(told) > 2:
        assert told["torque_bias"].rivals == ("gravity_error",) and told["gravity_error"].rivals == ("torque_bias",)
        assert told["torque_bias"].confidence == told["gravity_error"].confidence == TIED


@pytest.mark.slow
def test_what_no_candidate_makes_is_left_alone() -> None:
    foreign = {"torque_ripple": {"amplitude_nm": 0.6, "cycles_per_motor_revolution": 2.0, "phase_rad": 0.7}}
    replay = Replay(gap_sets.make(foreign, COARSE))
    assert hidden(CANDIDATES, replay, loop(replay), {}) is None


def test_a_loop_that_is_within_noise_hides_nothing() -> None:
    replay = Replay(gap_sets.make(only=("sines_small", "sines_repeat")))
    assert hidden(CANDIDATES, replay, loop(replay), {}) is None
