import math
from typing import Any

import numpy as np
import pytest

from frictid_hil.errors import PlanRefused
from frictid_hil.friction.trajectory import Procedure
from frictid_hil.plan.limits import refuse_beyond_limits
from frictid_hil.plan.plan import (
    Corners,
    Cycles,
    Expected,
    Hold,
    Move,
    Plan,
    Sine,
    coupling_bound_nm,
    joint_plan,
)
from frictid_hil.plan.setup import JointSetup, RobotSetup

DEG = math.pi / 180


def a_joint(name: str = "1", **changes: float) -> JointSetup:
    values: dict[str, float] = {
        "gear_ratio": 224,
        "max_velocity_rad_s": 135 * DEG,
        "max_torque_nm": 213.1,
        "rated_torque_nm": 100,
        "position_min_rad": -1.0,
        "position_max_rad": 1.5,
        "start_position_rad": 0.0,
        "locked_position_rad": 0.0,
    }
    values.update(changes)
    return JointSetup(name=name, address=2, direction=1, **values)  # type: ignore[arg-type]


def a_plan(procedure: Procedure, joint: JointSetup, expected: Expected | None = None) -> tuple[Plan, RobotSetup]:
    setup = RobotSetup("arm", "virtual:x", 1000.0, (joint,))
    return Plan("arm", 1000.0, (joint_plan(joint, [Cycles(0.0, procedure)], {}, expected),)), setup


def test_peaks_of_the_procedure_are_found_by_sampling() -> None:
    procedure = Procedure(20 * DEG, 115 * DEG)
    expected = Expected(2.0, 30.0, 25.0)
    plan, setup = a_plan(procedure, a_joint(), expected)
    (joint,) = plan.joints
    assert joint.peak_velocity_rad_s == pytest.approx(115 * DEG, rel=1e-3)
    assert joint.travel_rad == pytest.approx((0.0, 20 * DEG), abs=1e-4)
    assert joint.predicted_torque_nm == pytest.approx(2.0 * 2 * (115 * DEG) ** 2 / (20 * DEG) + 55, rel=0.01)
    refuse_beyond_limits(plan, setup, {"1": expected})


def test_too_short_a_travel_is_refused_for_its_torque() -> None:
    expected = Expected(2.0, 30.0, 25.0)
    plan, setup = a_plan(Procedure(5 * DEG, 115 * DEG), a_joint(), expected)
    with pytest.raises(PlanRefused, match=r"joint 1: predicted torque 2\d\d\.\d N m above the limit 213\.1 N m"):
        refuse_beyond_limits(plan, setup, {"1": expected})


@pytest.mark.parametrize(
    ("changes", "reason"),
    [({"position_max_rad": 0.3}, "leaves its limits"), ({"max_velocity_rad_s": 1.0}, "planned speed")],
)
def test_travel_and_speed_beyond_a_limit_are_refused(changes: dict[str, Any], reason: str) -> None:
    plan, setup = a_plan(Procedure(20 * DEG, 115 * DEG), a_joint(**changes))
    with pytest.raises(PlanRefused, match=reason):
        refuse_beyond_limits(plan, setup, {})


@pytest.mark.parametrize(
    "motion",
    [
        Hold(0.2, 0.5),
        Move.within(0.1, 0.9, 0.5),
        Cycles(0.3, Procedure(20 * DEG, 115 * DEG)),
        Sine(0.3, 0.2, 0.4, repeats=3),
        Corners("triangle", (0.0, 1.0, 2.0), (0.0, 0.1, 0.0)),
    ],
)
def test_motions_never_jump(motion: Hold | Move | Cycles | Sine | Corners) -> None:
    times = np.arange(0.0, motion.duration_s, 1e-3)
    positions = motion.position_rad(times)
    assert np.all(np.isfinite(positions))
    assert np.abs(np.diff(positions)).max(initial=0.0) <= 2.1e-3


def test_a_move_keeps_its_peak_speed() -> None:
    move = Move.within(0.0, 1.0, 0.35)
    speed = np.diff(move.position_rad(np.arange(0, move.duration_s, 1e-3))) / 1e-3
    assert speed.max() == pytest.approx(0.35, rel=1e-3)


def test_other_joints_accelerations_count_where_all_move_together() -> None:
    procedure = Procedure(20 * DEG, 115 * DEG)
    motions = {"1": [Cycles(0.0, procedure)], "2": [Cycles(0.1, procedure)]}
    expected = {"1": Expected(2.0, 30.0, 25.0, link_inertia_kg_m2=1.6), "2": Expected(0.5, 5.0, 5.0)}
    acceleration_rad_s2 = 2 * procedure.velocity_rad_s**2 / procedure.amplitude_rad
    bound_nm = coupling_bound_nm("1", motions, expected)
    assert bound_nm == pytest.approx(math.sqrt(1.6 * 0.5) * acceleration_rad_s2, rel=0.01)
    assert coupling_bound_nm("1", {"1": motions["1"]}, expected) == 0.0
    alone = joint_plan(a_joint(), motions["1"], {}, expected["1"])
    combined = joint_plan(a_joint(), motions["1"], {}, expected["1"], coupling_nm=bound_nm)
    assert combined.predicted_torque_nm == pytest.approx(alone.predicted_torque_nm + bound_nm)


def test_the_combined_motion_is_refused_for_its_torque() -> None:
    joint = a_joint(max_torque_nm=110.0)
    entry = joint_plan(
        joint, [Cycles(0.0, Procedure(20 * DEG, 115 * DEG))], {}, Expected(2.0, 30.0, 25.0), coupling_nm=20.0
    )
    plan = Plan("arm", 250.0, (entry,), together=True)
    with pytest.raises(PlanRefused, match="the most that the other joints can add"):
        refuse_beyond_limits(plan, RobotSetup("arm", "virtual:x", 250.0, (joint,)), {})


def test_joints_that_move_together_take_the_time_of_one() -> None:
    entries = tuple(joint_plan(a_joint(name), [Hold(0.0, 2.0)], {}, None) for name in ("0", "1"))
    assert Plan("arm", 250.0, entries).duration_s == 4.0
    together = Plan("arm", 250.0, entries, together=True)
    assert together.duration_s == 2.0
    assert together.stretches == (entries,)
