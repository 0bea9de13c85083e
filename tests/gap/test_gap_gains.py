"""Errors of a controller's gains: in a cascade, where the demand is limited, and behind a coarse encoder."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import cast

import gap_sets
import numpy as np
import pytest

from frictid_hil.gap import diagnose as diagnosing
from frictid_hil.gap.borne_out import BorneOut
from frictid_hil.gap.diagnose import diagnose
from frictid_hil.gap.diagnosis import Diagnosis, Value
from frictid_hil.gap.experiment_set import GAINS, Controller
from frictid_hil.gap.findings import Finding
from frictid_hil.gap.forward import Simulation
from frictid_hil.gap.verdict import Verdict
from frictid_hil.simulation.effects import all_effects

PID = gap_sets.NOMINAL.controller
assert PID is not None
CASCADE = replace(PID, command_rate_weight=0.0, cascade=True)
LIMITED = replace(PID, torque_limit_nm=11.0)  # reached where the joint speeds up and where it breaks away
SHARES = {"kp_error_share": 0.2, "ki_error_share": -0.3, "kd_error_share": -0.15}


def told(controller: Controller, coarse_rad: float = 2e-6, **more: dict[str, float]) -> Diagnosis:
    """A joint whose gains are off, and what is said of it."""
    nominal = replace(gap_sets.NOMINAL, controller=controller, encoder_resolution_rad=coarse_rad)
    return diagnose(gap_sets.make({"controller_gain_error": SHARES, **more}, nominal))


@pytest.mark.slow
@pytest.mark.parametrize("controller", [PID, CASCADE, LIMITED], ids=["pid", "cascade", "limited"])
def test_each_gain_is_found_and_the_loop_closes(controller: Controller) -> None:
    found = told(controller)
    assert found.verdict == "explained" and [c.effect for c in found.causes] == ["controller_gain_error"]
    for name, share in SHARES.items():
        value = found.causes[0].parameters[name]
        assert value.value == pytest.approx(share, abs=0.03)
        assert value.low is not None and value.high is not None and value.low < share < value.high
    assert found.after.forward_torque_nm is not None and found.before.forward_torque_nm is not None
    assert found.after.forward_torque_nm < 0.2 * found.before.forward_torque_nm


@pytest.mark.slow
@pytest.mark.parametrize("late", ["electrical_lag", "torque_delay"])
def test_a_late_drive_is_late_with_what_wrong_gains_ask_for(late: str) -> None:
    """Neither is told by itself: the gains were 11 % off, and a lag of 58 noise floors was ``unknown``."""
    parameter = "time_constant_s" if late == "electrical_lag" else "delay_s"
    found = told(PID, 2e-6, **{late: {parameter: 0.006}})
    causes = {c.effect: c.parameters for c in found.causes if c.confidence > 0.8}
    assert found.verdict == "explained" and causes.keys() == {"controller_gain_error", late}
    assert causes[late][parameter].value == pytest.approx(0.006, abs=0.0004)
    for name, share in SHARES.items():
        assert causes["controller_gain_error"][name].value == pytest.approx(share, abs=0.01)


@pytest.mark.slow
def test_a_torque_that_is_clipped_is_no_error_of_the_gains() -> None:
    """Fitted without the clip, the gains were 20 % off, and its columns about them told nothing of the closed loop."""
    found = diagnose(gap_sets.make({"torque_saturation": {"limit_share": 0.3}}))
    assert [c.effect for c in found.causes] == ["torque_saturation"]
    assert found.causes[0].parameters["limit_share"].value == pytest.approx(0.3, abs=0.005)
    before, after = (f.forward_torque_nm for f in (found.before, found.after))
    assert before is not None and after is not None and after < 0.2 * before


def test_the_limit_is_reached() -> None:
    (log, *_) = gap_sets.make({}, replace(gap_sets.NOMINAL, controller=LIMITED), only=("sines_large",)).experiments
    assert log.torque_nm is not None and np.max(np.abs(log.torque_nm)) > 0.98 * LIMITED.torque_limit_nm


@pytest.mark.slow
def test_behind_a_coarse_encoder_the_joint_is_read_under_the_true_gains() -> None:
    found = told(PID, 6e-4, gravity_error={"error_share": 0.1})
    assert "encoder" in found.reasons and found.verdict == "explained"
    assert {"controller_gain_error", "gravity_error"} <= {c.effect for c in found.causes if c.confidence > 0.8}
    gravity = next(c for c in found.causes if c.effect == "gravity_error").parameters["error_share"]
    assert gravity.value == pytest.approx(0.1, abs=0.03)


def test_the_effects_shares_come_in_the_order_of_the_gains() -> None:
    form = all_effects()["controller_gain_error"].demand
    assert form is not None
    assert [name.split("_")[0] for name in GAINS] == [name.split("_")[0] for name in form.parameters]


def test_a_set_of_validation_logs_alone_is_answered_under_a_cascade() -> None:
    nominal = replace(gap_sets.NOMINAL, controller=CASCADE)
    made = gap_sets.make({}, nominal, only=("sines_repeat",))
    assert all(e.validation for e in made.experiments)
    assert diagnose(made).verdict == "none"


@pytest.mark.parametrize(("gain", "guessed", "first"), [(2.0, False, 1), (20.0, False, 0), (20.0, True, 1)])
def test_the_first_cause_makes_most_where_it_shows_most(gain: float, guessed: bool, first: int) -> None:
    """An error of the joint that makes 16 noise floors of the closed loop's torque, and a gain that makes one."""
    value = {"any": Value(1.0, 0.9, 1.1)}
    causes = (
        Finding("controller_gain_error", 1.0, 1.0, gain, 1.0, value, (), "actuation"),
        Finding("viscous_error", 1.0, 1.0, 1.5, 0.0, value, (), "plant"),
    )
    simulation = cast(Simulation, SimpleNamespace(noise_nm=0.1, made_nm=lambda each: [0.1, 1.6]))
    said = diagnosing._ranked(Verdict("explained", causes), simulation, [], guessed=guessed)
    assert said.named[0] is causes[first]


def test_what_brings_the_joint_no_nearer_counts_along_the_motion_alone() -> None:
    """A presliding hysteresis that changed much in closed loop stood before the torque limit that closed it."""
    value = {"any": Value(1.0, 0.9, 1.1)}
    causes = tuple(
        Finding(name, chance, chance, size, 0.0, value, (), "plant")
        for name, chance, size in (
            ("presliding_hysteresis", 0.9, 1.5),
            ("torque_saturation", 0.9, 1.0),
            ("stribeck", 0.4, 9.0),
        )
    )
    simulation = cast(Simulation, SimpleNamespace(noise_nm=0.1, made_nm=lambda each: [1.6, 0.9, 0.2]))
    said = Verdict("explained", causes)
    borne = BorneOut(said, None, frozenset({"presliding_hysteresis", "stribeck"}), frozenset({"stribeck"}))
    named = diagnosing._ranked(said, simulation, [], guessed=False).named
    assert [f.effect for f in named] == ["presliding_hysteresis", "stribeck", "torque_saturation"]
    named = diagnosing._ranked(said, simulation, [], guessed=False, borne=borne).named
    assert [f.effect for f in named] == ["torque_saturation", "presliding_hysteresis", "stribeck"]
