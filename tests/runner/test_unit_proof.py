"""The small motion that proves units, against joints that do otherwise than they were asked."""

import math

import pytest

from frictid_hil.errors import SafetyAbort
from frictid_hil.plan.setup import JointSetup
from frictid_hil.protocol.driver import Feedback, SetPoint
from frictid_hil.runner.unit_proof import Travelled, UnitProof

PERIOD_S = 0.004
DEG = math.pi / 180


def proven(position=1.0, velocity=1.0, step_rad=1e-5, step_rad_s=0.0, droop_rad=0.0, stuck=False):
    """Play the proof on a joint that reports so many times the motion; the furthest set-point in deg."""
    joint = JointSetup(
        name="3", address=3, gear_ratio=50, max_velocity_rad_s=2, max_torque_nm=10, rated_torque_nm=10,
        position_min_rad=-1, position_max_rad=1, start_position_rad=0, locked_position_rad=0, direction=1,
    )  # fmt: skip
    proof = UnitProof(joint, 0.5, step_rad, droop_rad, PERIOD_S)
    set_point, report = SetPoint(position_rad=0.5), Feedback(position_rad=0.5, velocity_rad_s=0.0)
    furthest = 0.0
    while True:
        before = set_point.position_rad
        if not proof.update(report, set_point):
            return furthest
        furthest = max(furthest, abs(set_point.position_rad - 0.5) / DEG)
        assert set_point.position_rad <= 0.5, "it moves towards the middle of its range"
        speed = (set_point.position_rad - before) / PERIOD_S * velocity
        report.t_ns += round(PERIOD_S * 1e9)
        report.velocity_rad_s = round(speed / step_rad_s) * step_rad_s if step_rad_s else speed
        report.position_rad = (
            0.5 if stuck else 0.5 + round((set_point.position_rad - 0.5) * position / step_rad) * step_rad
        )


def test_an_honest_drive_moves_by_half_a_degree():
    assert proven() == pytest.approx(0.5, abs=1e-3)


def test_half_of_the_motion_is_within_what_a_soft_position_loop_declares():
    assert proven(position=0.5, velocity=0.5, droop_rad=0.3 * DEG)
    with pytest.raises(SafetyAbort, match="did not do what it was asked"):
        proven(position=0.5, velocity=0.5)
    with pytest.raises(SafetyAbort, match="asked: 0 deg instead of 0"):
        proven(stuck=True)


@pytest.mark.parametrize("factor", [2.0, 10.0, 1000.0])
def test_more_than_was_asked_is_stopped_early(factor):
    with pytest.raises(SafetyAbort, match=r"instead of|position says"):
        proven(position=factor, velocity=factor)


@pytest.mark.parametrize("factor", [0.0, 0.1, 0.5, 2.0, -1.0])
def test_a_velocity_in_other_units_is_told(factor):
    with pytest.raises(SafetyAbort, match="velocity by"):
        proven(velocity=factor)


def test_a_velocity_too_coarse_for_half_a_degree_is_judged_by_the_rehearsal():
    assert proven(step_rad_s=0.02)
    travelled = Travelled(0.004)
    for k in range(1000):
        rate = 2.0 * math.sin(math.pi * k / 1000)
        travelled.add(Feedback(t_ns=k * 4_000_000, position_rad=0.001 * k, velocity_rad_s=round(rate / 0.02) * 0.02), 1)
    with pytest.raises(SafetyAbort, match="position says"):
        travelled.judge("3")
