"""Simulated servos that fail by a schedule, and what the driver makes of it."""

from __future__ import annotations

import contextlib
import json
import math
from dataclasses import replace
from typing import Any

import pytest
from servo_bench import Bench, setup_of

from frictid_drivers.servos.simulated import VirtualServoDriver
from frictid_drivers.virtual.faults import ENVIRONMENT
from frictid_hil.errors import FrictidError, HardwareError, InvalidFields, SafetyAbort
from frictid_hil.plan.mode import Mode
from frictid_hil.protocol.driver import Feedback, JointState, SetPoint

MODELS = ("XL330-M288", "STS3215")
FIRST, SECOND = "shoulder_pan", "shoulder_lift"


class Running:
    """A driver of two servos with faults, cycling at 200 Hz, both joints under power."""

    def __init__(self, model: str, *faults: dict[str, Any]) -> None:
        setup = replace(setup_of(model, bus={"faults": list(faults)}), realtime=False)
        self.driver = VirtualServoDriver(setup)
        self.driver.open()
        self.driver.configure(200.0, [FIRST, SECOND])
        self.driver.start_cycling()
        self.at_rad = 0.0
        for joint in (FIRST, SECOND):
            self.driver.enable(joint, Mode.POSITION)

    def cycles(self, count: int, *, step_rad: float = 0.0, torque_nm: float = 0.0) -> list[Feedback]:
        clock = self.driver.clock
        for _ in range(count):
            self.at_rad += step_rad
            begun_ns = clock.now_ns()
            reports = self.driver.exchange([SetPoint(position_rad=self.at_rad, torque_nm=torque_nm), SetPoint()])
            clock.wait_until(begun_ns + 5_000_000)
        return list(reports)

    def servo(self, joint: str) -> Any:
        return self.driver.chain.servos[joint]


@pytest.mark.parametrize("model", MODELS)
def test_answers_of_one_servo_are_lost_for_a_while(model: str) -> None:
    run = Running(model, {"kind": "drop", "frames": "report", "joint": FIRST, "at_s": 0.1, "count": 8})
    assert [report.age_cycles for report in run.cycles(20)] == [0, 0]
    assert [report.age_cycles for report in run.cycles(6)] == [6, 0]
    assert [report.age_cycles for report in run.cycles(10)] == [0, 0]


@pytest.mark.parametrize("model", MODELS)
def test_an_answer_with_another_servos_id_is_not_this_servos(model: str) -> None:
    run = Running(model, {"kind": "misaddress", "frames": "report", "joint": SECOND, "at_s": 0.1, "count": 5})
    run.cycles(20)
    assert [report.age_cycles for report in run.cycles(5)] == [0, 5]


@pytest.mark.parametrize("kind", ["corrupt", "truncate"])
@pytest.mark.parametrize("model", MODELS)
def test_damaged_answers_are_left_out(model: str, kind: str) -> None:
    run = Running(model, {"kind": kind, "frames": "report", "joint": SECOND, "at_s": 0.1, "level": 5, "count": 4})
    run.cycles(20)
    assert run.cycles(4)[1].age_cycles == 4
    assert run.cycles(2)[1].age_cycles == 0


def test_a_servo_that_hears_nothing_lets_go_by_its_watchdog() -> None:
    run = Running("XL330-M288", {"kind": "mute", "joint": SECOND, "at_s": 0.1})
    run.cycles(20)
    assert run.servo(SECOND).on
    run.cycles(80)
    assert run.servo(FIRST).on and not run.servo(SECOND).on


@pytest.mark.parametrize("model", MODELS)
def test_what_a_servo_reports_is_wrong_and_what_it_does_is_not(model: str) -> None:
    run = Running(model, {"kind": "jump", "quantity": "position", "joint": FIRST, "level": 0.6, "at_s": 0.1})
    assert run.cycles(19)[0].position_rad == pytest.approx(0.0, abs=0.02)
    assert run.cycles(2)[0].position_rad == pytest.approx(0.6, abs=0.02)
    assert run.servo(FIRST).plant.position_rad == pytest.approx(0.0, abs=0.02)


@pytest.mark.parametrize("model", MODELS)
def test_a_servo_that_reboots_has_no_torque_and_forgets_its_goal(model: str) -> None:
    run = Running(model, {"kind": "reset", "joint": FIRST, "at_s": 0.1})
    run.cycles(30)
    assert not run.servo(FIRST).on and run.servo(SECOND).on


@pytest.mark.parametrize("model", MODELS)
def test_an_error_byte_is_seen(model: str) -> None:
    run = Running(model, {"kind": "fault", "joint": FIRST, "at_s": 0.1})
    assert run.cycles(19)[0].state is JointState.ENABLED
    assert run.cycles(4)[0].state is JointState.FAULT


@pytest.mark.parametrize("way", ["send", "receive"])
@pytest.mark.parametrize("error", ["can", "os", "runtime", "value"])
def test_whatever_a_port_raises_is_a_lost_port(way: str, error: str) -> None:
    run = Running("STS3215", {"kind": f"{way}_error", "error": error, "at_s": 0.1})
    run.cycles(19)
    with pytest.raises(HardwareError, match=r"the port is gone: .*injected"):
        run.cycles(4)
    run.driver.quick_stop()
    run.driver.close()


@pytest.mark.parametrize("mode", [Mode.POSITION, Mode.TORQUE])
def test_a_stop_does_not_follow_a_reading_that_jumped(mode: Mode) -> None:
    """The joint was sent to where the jumped reading said, faster than it may ever go."""
    run = Running("XL330-M288", {"kind": "jump", "quantity": "position", "joint": FIRST, "level": 0.8, "at_s": 0.2})
    run.cycles(20, step_rad=0.004)
    run.driver.enable(FIRST, mode)
    run.cycles(20, step_rad=0.004)
    assert run.cycles(1)[0].position_rad > 0.7
    before_rad = run.servo(FIRST).plant.position_rad
    run.driver.quick_stop()
    run.cycles(40)
    assert abs(run.servo(FIRST).plant.position_rad - before_rad) < 0.1


def test_a_stop_of_a_joint_whose_reading_froze_takes_it_there_slowly() -> None:
    """Its position loop took it over from a current, far from where it was last read, and it snapped there."""
    run = Running("XL330-M288", {"kind": "freeze", "quantity": "position", "joint": FIRST, "at_s": 0.1})
    run.cycles(20)
    servo, most_rad_s = run.servo(FIRST), run.driver.setup.joint(FIRST).max_velocity_rad_s
    run.driver.enable(FIRST, Mode.TORQUE)
    run.cycles(45, torque_nm=0.5)
    assert abs(servo.plant.position_rad) > 0.25
    run.driver.quick_stop()
    fastest = [0.0]
    for _ in range(100):
        run.cycles(1)
        # It is driven back, and its own overshoot is what is left above half of that speed.
        if servo.plant.velocity_rad_s * servo.plant.position_rad < 0.0:
            fastest.append(abs(servo.plant.velocity_rad_s))
    assert abs(servo.plant.position_rad) < 0.02
    assert max(fastest) < 0.8 * most_rad_s


def test_a_stop_after_lost_goals_does_not_send_the_joint_to_a_far_one() -> None:
    """The stop told a goal that none of 60 lost ones had told before, and the joint went there at its full speed."""
    run = Running("STS3215", {"kind": "drop", "frames": "write", "at_s": 0.2, "count": 60})
    run.cycles(100, step_rad=0.006)
    servo = run.servo(FIRST)
    before_rad, behind_rad = servo.plant.position_rad, 100 * 0.006 - servo.plant.position_rad
    assert behind_rad > 0.3
    run.driver.quick_stop()
    run.cycles(60)
    assert servo.plant.position_rad - before_rad < 0.6 * behind_rad


@pytest.mark.parametrize("cycle_hz", [50.0, 100.0, 200.0, 400.0])
def test_a_velocity_is_no_older_than_20_ms_at_any_rate(cycle_hz: float) -> None:
    """At 100 Hz it was 40 ms old, and a healthy joint was stopped because position and velocity disagreed."""
    bench = Bench(setup_of("STS3215"))
    bench.begin(cycle_hz)
    first, *_ = bench.setup.joints
    delay_s = bench.driver.identify()[first.name].timing.velocity_delay_s
    assert 0.0 < delay_s <= 0.02


def test_faults_of_other_drives_are_refused() -> None:
    with pytest.raises(InvalidFields, match="kind"):
        Running("STS3215", {"kind": "emcy"})
    with pytest.raises(InvalidFields, match="frames"):
        Running("STS3215", {"kind": "drop", "frames": "sync"})


def test_faults_come_from_the_environment_too(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(ENVIRONMENT, json.dumps([{"kind": "send_error", "error": "os"}]))
    with pytest.raises(FrictidError):
        Running("STS3215")


def test_a_stall_lets_time_pass() -> None:
    run = Running("STS3215", {"kind": "stall", "delay_s": 0.3, "at_s": 0.1})
    run.cycles(22)
    assert run.driver.clock.now_ns() > 0.4e9 and math.isfinite(run.at_rad)


@pytest.mark.parametrize(
    "lost", [{"kind": "mute", "joint": FIRST, "at_s": 0.1}, {"kind": "drop", "frames": "write", "at_s": 0.1}]
)
@pytest.mark.parametrize("model", MODELS)
def test_a_servo_that_is_not_seen_to_be_off_is_named(model: str, lost: dict[str, Any]) -> None:
    """Its power is no part of what is read in a cycle: it was taken to be off as soon as it had been told."""
    run = Running(model, lost)
    run.cycles(25)
    run.driver.quick_stop()
    with pytest.raises(SafetyAbort, match="has no power any more"):
        run.driver.stop_cycling()
    named = run.driver.may_be_powered
    assert named == ((FIRST,) if lost["kind"] == "mute" else (FIRST, SECOND))
    run.driver.clock.wait_until(run.driver.clock.now_ns() + 500_000_000)
    watched = model == "XL330-M288"
    assert [run.servo(joint).on for joint in named] == [not watched] * len(named)


def stopped_under_torque(*faults: dict[str, Any]) -> tuple[Running, int]:
    """One joint driven by a current, then a stop as the runner makes it; returns the bench and when that was (ns)."""
    run = Running("XL330-M288", *faults)
    run.cycles(20)
    run.driver.enable(FIRST, Mode.TORQUE)
    run.cycles(20, torque_nm=0.3)
    stopped_ns = run.driver.clock.now_ns()
    run.driver.quick_stop()
    return run, stopped_ns


def test_a_servo_that_hears_no_stop_under_a_current_loses_its_power_by_its_watchdog() -> None:
    """Our questions reached it, and so it drove on for 1.1 s: each of them feeds its bus watchdog."""
    run, stopped_ns = stopped_under_torque({"kind": "drop", "frames": "write", "at_s": 0.19})
    servo, clock = run.servo(FIRST), run.driver.clock
    with pytest.raises(HardwareError, match="a stop is not followed") as told:
        run.cycles(40, torque_nm=0.3)
    assert "servo 1" in str(told.value) and servo.on
    asked_ns = clock.now_ns()
    run.driver.quick_stop()
    with pytest.raises(HardwareError, match="a stop is not followed"):
        run.cycles(1)
    run.driver.close()
    assert not servo.on and servo._heard_ns >= asked_ns + 200_000_000, "it was spoken to before its watchdog struck"
    assert run.driver.may_be_powered == (FIRST, SECOND)
    assert asked_ns - stopped_ns <= 110_000_000


def test_a_servo_that_may_be_under_a_current_is_stopped_like_one_that_is() -> None:
    """On the way to position mode its writes were lost; the host took it to be in position mode, and it drove on."""
    run = Running("XL330-M288", {"kind": "drop", "frames": "write", "at_s": 0.19})
    run.cycles(20)
    run.driver.enable(FIRST, Mode.TORQUE)
    run.cycles(20, torque_nm=0.3)
    servo = run.servo(FIRST)
    with pytest.raises(HardwareError, match="does not take operating mode 3"):
        run.driver.enable(FIRST, Mode.POSITION)
    begun_ns = run.driver.clock.now_ns()
    run.driver.quick_stop()
    with pytest.raises(HardwareError, match="a stop is not followed"):
        run.cycles(40)
    clock = run.driver.clock
    clock.wait_until(begun_ns + 320_000_000)
    stood_rad = servo.plant.position_rad
    clock.wait_until(begun_ns + 400_000_000)
    assert not servo.on and abs(servo.plant.position_rad - stood_rad) < 5e-3


def test_a_stop_whose_first_words_are_lost_is_told_again() -> None:
    run, _ = stopped_under_torque({"kind": "drop", "frames": "write", "at_s": 0.1995, "count": 30})
    run.cycles(60)
    servo = run.servo(FIRST)
    stood_rad = servo.plant.position_rad
    run.cycles(20)
    assert servo.on and servo.memory[servo.mine.model.registers.mode] == servo.mine.model.registers.position_mode
    assert abs(servo.plant.position_rad - stood_rad) < 1e-3
    run.driver.stop_cycling()
    assert run.driver.may_be_powered == ()


@pytest.mark.parametrize("count", [8, 100])
def test_lost_writes_do_not_keep_a_joint_under_power(count: int) -> None:
    """It answered all the time; after three words that were lost it was given up, and kept its power."""
    run = Running("STS3215", {"kind": "drop", "frames": "write", "at_s": 0.1, "count": count})
    run.cycles(25)
    run.driver.stop_cycling()
    assert run.driver.may_be_powered == () and not run.servo(FIRST).on and not run.servo(SECOND).on


@pytest.mark.parametrize(
    "fault",
    [
        {"kind": "mute", "joint": FIRST, "at_s": 0.1, "for_s": 1.8},
        {"kind": "send_error", "error": "os", "at_s": 0.1, "count": 30},
    ],
)
def test_a_servo_that_is_back_within_half_a_second_loses_its_power(fault: dict[str, Any]) -> None:
    """It did not answer, or the port refused, when it was to let go; it was told once and kept its power."""
    run = Running("STS3215", fault)
    run.cycles(19)
    with contextlib.suppress(HardwareError):
        run.cycles(4)
    run.driver.quick_stop()
    with contextlib.suppress(HardwareError):
        run.driver.stop_cycling()
    assert run.driver.may_be_powered == () and not run.servo(FIRST).on and not run.servo(SECOND).on


@pytest.mark.parametrize("model", MODELS)
def test_a_servo_that_no_word_reaches_comes_to_rest_at_its_last_goal(model: str) -> None:
    """From 2 rad/s, by its own loop, well within half a second."""
    run = Running(model, {"kind": "send_error", "error": "os", "at_s": 0.5})
    with contextlib.suppress(HardwareError):
        run.cycles(200, step_rad=0.01)
    run.driver.quick_stop()
    servo, clock, goal_rad = run.servo(FIRST), run.driver.clock, run.at_rad - 0.01
    assert abs(servo.plant.true_velocity_rad_s) > 1.5 and abs(goal_rad - servo.plant.position_rad) < 0.2
    places = []
    for _ in range(30):
        clock.wait_until(clock.now_ns() + 5_000_000)
        places.append(servo.plant.position_rad)
    assert servo.on and servo.plant.position_rad == pytest.approx(goal_rad, abs=0.03)
    assert max(places) < goal_rad + 0.03 and abs(places[-1] - places[-5]) < 4e-4
