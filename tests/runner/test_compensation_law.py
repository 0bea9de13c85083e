"""A law in force: bounds on torque and its rate, fading, runaway; and the probe's verdicts."""

from __future__ import annotations

import math
import pickle
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from frictid_hil.config.robot import load_robot
from frictid_hil.errors import ProfileMismatch, SafetyAbort
from frictid_hil.friction.compensation import CompensationSettings
from frictid_hil.friction.curve import FrictionCurve
from frictid_hil.plan.control import Bounds, Compensated, ControlLaw, Gravity, PositionGains, Probe, RippleTorque, Swing
from frictid_hil.plan.mode import Mode
from frictid_hil.plan.plan import Corners, Hold, Sine, joint_plan
from frictid_hil.protocol.driver import Feedback, JointState, SetPoint
from frictid_hil.runner.compensation import FadeOut, LawInForce, LawSource
from frictid_hil.runner.cycle import Stream
from frictid_hil.runner.probe import ProbeWatch
from frictid_hil.runner.runaway import RunawayWatch

CURVE = FrictionCurve((0.2, 2.0), (5.5, 7.5))
FRICTION = CompensationSettings.of(CURVE, "mop", stiffness_nm_per_rad=8000.0, ratio=0.9)
DT = 1e-3


def law(**changes: object) -> ControlLaw:
    values: dict[str, object] = {
        "mode": "mop",
        "gravity": Gravity(10.0, 2.0, 0.5),
        "gains": None,
        "friction": FRICTION,
        "ripple": None,
        "follows_reference": False,
        "torque_limit_nm": 30.0,
        "slew_nm_per_s": 2000.0,
    }
    return ControlLaw(**(values | changes))  # type: ignore[arg-type]


def moving(position: float, velocity: float, t_ns: int = 0) -> Feedback:
    return Feedback(t_ns=t_ns, position_rad=position, velocity_rad_s=velocity, state=JointState.ENABLED, valid=True)


def test_a_standing_joint_is_given_its_gravity_alone() -> None:
    in_force = LawInForce(law(slew_nm_per_s=1e9), DT, 0.0)
    for _ in range(3):
        torque = in_force.update(moving(0.3, 0.0), (0.3, 0.0))
    assert torque == pytest.approx(10.0 * math.cos(0.3) + 2.0 * math.sin(0.3) + 0.5)


def test_less_friction_is_given_where_gravity_may_be_wrong() -> None:
    """R falls by what gravity may be wrong, as a share of F_0."""
    f_0 = FRICTION.coulomb_nm
    gravity = Gravity(10.0, 2.0, 0.5, centre_rad=0.4, spread_rad=0.15, unsure_nm=0.5 * f_0)
    uncertain, known = law(gravity=gravity), law(gravity=Gravity(10.0, 2.0, 0.5))
    assert uncertain.friction_share(0.4) == uncertain.friction_share(0.5) == known.friction_share(3.0) == 1.0
    for away in (0.6, -0.6):
        fallen = 0.9 - 0.5 * (math.cos(0.15) - math.cos(away))
        assert 0.9 * uncertain.friction_share(0.4 + away) == pytest.approx(fallen)
    assert law(gravity=Gravity(unsure_nm=3 * f_0)).friction_share(math.pi) == 0.0
    torques = []
    for one in (known, uncertain):
        in_force = LawInForce(replace(one, slew_nm_per_s=1e9), DT, 0.0)
        for k in range(200):
            torques.append(in_force.update(moving(1.0 + k * DT, 1.0), (0.0, 0.0)))
    friction = torques[199] - gravity.torque_nm(1.199)
    assert torques[399] - gravity.torque_nm(1.199) == pytest.approx(uncertain.friction_share(1.199) * friction)
    assert uncertain.friction_share(1.199) < 0.85


def test_torque_is_clamped_and_changes_no_faster_than_it_may() -> None:
    gains = PositionGains(1e4, 0.0)
    in_force = LawInForce(law(gains=gains), DT, 0.0)
    torques = [in_force.update(moving(0.0, 0.0), (1.0, 0.0)) for _ in range(40)]
    assert np.max(np.diff([0.0, *torques])) == pytest.approx(2.0)
    assert torques[-1] == 30.0


@settings(max_examples=50)
@given(st.lists(st.tuples(st.floats(-3.0, 3.0), st.floats(-6.0, 6.0)), min_size=1, max_size=60))
def test_whatever_a_drive_reports_torque_stays_in_its_bounds(reports: list[tuple[float, float]]) -> None:
    ripple = RippleTorque(0.1, (0.0, 1.0, 0.0, -1.0))
    in_force = LawInForce(law(gains=PositionGains(1e4, 50.0), ripple=ripple), DT, 5.0)
    last = 5.0
    for k, (position, velocity) in enumerate(reports):
        torque = in_force.update(moving(position, velocity, k * 1_000_000), (0.0, 0.0))
        assert abs(torque) <= 30.0
        assert abs(torque - last) <= 2.0 + 1e-9
        last = torque


def test_a_drive_without_velocity_is_helped_out_through_late_and_missed_cycles() -> None:
    free = law(gravity=Gravity(), slew_nm_per_s=1e9)
    with_velocity, without = LawInForce(free, DT, 0.0), LawInForce(free, DT, 0.0)
    ticks = [0, 1, 2, 3, 5, 6, 7, 17, 18, 18.4, 19, 20]
    for tick in ticks:
        at, t_ns = 0.01 + tick * 0.5 * DT, 1_000_000 + round(tick * 1e6)
        expected = with_velocity.update(moving(at, 0.5, t_ns), (0.0, 0.0))
        found = without.update(moving(at, math.nan, t_ns), (0.0, 0.0))
        if tick:
            assert found == pytest.approx(expected)
    # No report this cycle: neither position nor time went on.
    assert without.update(moving(at, math.nan, t_ns), (0.0, 0.0)) == pytest.approx(expected)


def test_no_travel_is_lost_where_cycles_were_missed() -> None:
    curve = FrictionCurve((0.2, 2.0), (5.5, 7.5))
    soft = CompensationSettings.of(curve, "mo", stiffness_nm_per_rad=10.0, ratio=0.9)
    every, some = (LawInForce(law(gravity=Gravity(), friction=soft, slew_nm_per_s=1e9), DT, 0.0) for _ in range(2))
    for k in range(101):
        expected = every.update(moving(k * 1e-3, 1.0, k * 1_000_000), (0.0, 0.0))
        if k % 7 == 0 or k == 100:
            found = some.update(moving(k * 1e-3, 1.0, k * 1_000_000), (0.0, 0.0))
    assert found == pytest.approx(expected) == pytest.approx(0.9 * 10.0 * 0.1)


def test_ripple_repeats_and_is_linear_between_its_steps() -> None:
    ripple = RippleTorque(0.1, (0.0, 1.0, 0.0, -1.0))
    assert ripple.torque_at_nm(0.025) == pytest.approx(1.0)
    assert ripple.torque_at_nm(0.0125) == pytest.approx(0.5)
    assert ripple.torque_at_nm(-0.0125) == pytest.approx(-0.5)
    assert ripple.torque_at_nm(7.3125) == pytest.approx(ripple.torque_at_nm(0.0125))


@pytest.mark.parametrize("mode", [Mode.TORQUE, Mode.POSITION, Mode.VELOCITY])
def test_each_drive_mode_is_told_in_its_own_way(mode: Mode) -> None:
    motion = Compensated(
        "track", Corners("triangle", (0.0, 1.0), (0.0, 0.5)), law(slew_nm_per_s=1e9), Bounds(-1, 1, 1, 1), mode
    )
    source = LawSource(LawInForce(motion.law, DT, 0.0), motion, DT)
    set_point = SetPoint()
    assert source.update(moving(0.0, 0.0), set_point)
    gravity = 10.5
    if mode is Mode.TORQUE:
        assert set_point.torque_nm == pytest.approx(gravity) and set_point.torque_offset_nm == 0.0
    else:
        assert set_point.torque_offset_nm == pytest.approx(gravity) and set_point.torque_nm == 0.0
    if mode is Mode.VELOCITY:
        assert set_point.velocity_rad_s == pytest.approx(0.5)
    assert source.update(moving(0.1, 0.0), set_point)
    assert set_point.position_rad == pytest.approx(0.5e-3)  # the reference, not where the joint is


def test_a_path_ends_and_an_endless_one_does_not() -> None:
    still = moving(0.0, 0.0)
    for duration, expected in ((0.01, 10), (math.inf, 500)):
        motion = Compensated("hand", Swing(0.0, 0.3, 0.5, duration), law(), Bounds(-1, 1, 1, 1))
        source = LawSource(LawInForce(motion.law, DT, 0.0), motion, DT)
        assert sum(source.update(still, SetPoint()) for _ in range(500)) == expected


def test_compensation_fades_and_gravity_stays() -> None:
    motion = Compensated("hand", Hold(0.0, 1.0), law(slew_nm_per_s=1e9), Bounds(-1, 1, 1, 1))
    source = LawSource(LawInForce(motion.law, DT, 0.0), motion, DT)
    set_point = SetPoint()
    for k in range(50):
        source.update(moving(k * DT, 1.0), set_point)
    in_force = set_point.torque_nm
    fade = FadeOut(source, 20)
    torques = []
    while fade.update(moving(0.05, 1.0), set_point):
        torques.append(set_point.torque_nm)
    gravity = 10.0 * math.cos(0.05) + 2.0 * math.sin(0.05) + 0.5
    assert in_force > gravity + 5.0
    assert torques[-1] == pytest.approx(gravity)
    assert np.all(np.diff(torques) < 0)


def test_a_law_crosses_process_borders() -> None:
    motion = Compensated("hand", Swing(0.0, 0.3, 0.5, math.inf), law(), Bounds(-1, 1, 1, 1))
    assert pickle.loads(pickle.dumps(motion)) == motion


def test_a_triangle_under_a_law_predicts_no_torque_from_its_corners() -> None:
    joint = load_robot("hp3j.yaml").to_setup().joint("3")
    path = Corners("triangle", (0.0, 0.1, 0.3, 0.4), (0.0, 0.05, -0.05, 0.0))
    motion = Compensated("track", path, law(), Bounds(-1, 1, 1, 1))
    plan = joint_plan(joint, [motion], {}, None)
    assert plan.travel_rad == pytest.approx((-0.05, 0.05))
    assert plan.peak_velocity_rad_s == pytest.approx(0.5)


# -- runaway --------------------------------------------------------------------------------------------------------


def verdicts(velocity: np.ndarray, external: np.ndarray | float, growth_s: float = 0.75) -> list[str]:
    watch = RunawayWatch(DT, growth_s)
    externals = np.broadcast_to(np.asarray(external, dtype=float), velocity.shape)
    return [watch.verdict(float(v), float(e)) for v, e in zip(velocity, externals, strict=True)]


def test_a_person_who_swings_a_joint_is_no_runaway() -> None:
    time_s = np.arange(0.0, 6.0, DT)
    velocity = 1.1 * np.cos(2 * np.pi * 0.5 * time_s)
    hand = 0.5 * np.sign(velocity) - 3.0 * np.sin(2 * np.pi * 0.5 * time_s)
    assert not any(verdicts(velocity, hand))
    assert not any(verdicts(velocity, math.nan))


def test_speed_that_grows_with_nobody_pushing_is_seen_within_6_deg_per_s() -> None:
    velocity = np.arange(0.0, 1.0, DT) * 2.0
    for external in (0.0, -1.0):
        found = verdicts(velocity, external)
        first = next(k for k, verdict in enumerate(found) if verdict)
        assert "nobody pushing" in found[first]
        assert math.degrees(velocity[first]) < 7.0


def test_without_a_sensor_growth_that_outlasts_a_push_is_a_runaway() -> None:
    velocity = np.arange(0.0, 2.0, DT) * 0.4
    found = verdicts(velocity, math.nan)
    first = next(k for k, verdict in enumerate(found) if verdict)
    assert 0.75 < first * DT < 1.0


# -- probe ----------------------------------------------------------------------------------------------------------


def probed(
    *, friction: float = 1.0, gravity: float = 1.0, temperature: float = 25.0, curve: FrictionCurve = CURVE
) -> None:
    sine = Sine(-0.3, 0.6, 0.35)
    probe = Probe(sine, curve, Gravity(10.0, 2.0, 0.5), 0.3, temperature_c=25.0, temperature_tolerance_c=20.0)
    time_s = np.arange(0.0, sine.duration_s, DT)
    positions = sine.position_rad(time_s)
    velocities = np.gradient(positions, DT)
    watch = ProbeWatch(Stream(positions.tolist(), 0.001), probe, "3")
    for q, v in zip(positions, velocities, strict=True):
        torque = gravity * probe.gravity.torque_nm(float(q)) + friction * float(CURVE.torque(np.array(v)))
        report = moving(float(q), float(v))
        report.torque_nm, report.temperature_c = torque, temperature
        watch.update(report, SetPoint())
    watch.judge()


def test_the_joint_that_was_identified_passes() -> None:
    probed()
    probed(friction=1.2)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"friction": 0.5}, "friction"),
        ({"friction": 2.0}, "friction"),
        ({"friction": -1.0}, "friction"),
        ({"gravity": -1.0}, "holding torque"),
        ({"gravity": 1.5}, "holding torque"),
        ({"temperature": 60.0}, "60.0 degC"),
    ],
)
def test_another_joint_does_not_and_both_values_are_named(change: dict[str, Any], words: str) -> None:
    with pytest.raises(ProfileMismatch, match=words) as refusal:
        probed(**change)
    assert "profile" in str(refusal.value) and "joint 3" in str(refusal.value)


def test_a_joint_that_does_not_move_is_no_answer() -> None:
    watch = ProbeWatch(Stream([0.0], 0.001), Probe(Sine(0, 0.1, 0.1), CURVE, Gravity(), 0.3), "3")
    with pytest.raises(SafetyAbort, match="both ways"):
        watch.judge()
