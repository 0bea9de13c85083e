"""Faults of simulated motors by schedule: from the robot file and the environment, on the wire and in the motors."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import can
import pytest
from mit_bench import robot

from frictid_drivers.mit.simulated import KINDS, VirtualMitDriver
from frictid_drivers.virtual.faults import ENVIRONMENT
from frictid_hil.errors import FrictidError, HardwareError, InvalidFields, SafetyAbort
from frictid_hil.plan.mode import Mode
from frictid_hil.protocol.driver import Feedback, JointState, SetPoint

FAMILIES = ("damiao", "robstride")


class Running:
    """A driver of two motors with faults, cycling at 500 Hz, both joints under power."""

    def __init__(self, folder: Path, family: str, *faults: dict[str, Any]) -> None:
        setup = robot(folder, family, {"options": {"faults": list(faults)}}, joints=2).to_setup()
        self.driver = VirtualMitDriver(setup)
        self.driver.open()
        self.driver.configure(500.0, ["0", "1"])
        self.driver.start_cycling()
        for joint in ("0", "1"):
            self.driver.enable(joint, Mode.POSITION)

    def cycles(self, count: int) -> list[Feedback]:
        for _ in range(count):
            self.driver.clock.wait_until(self.driver.clock.now_ns() + 2_000_000)
            reports = self.driver.exchange([SetPoint(), SetPoint()])
        return list(reports)


@pytest.mark.parametrize("family", FAMILIES)
def test_frames_of_one_joint_are_lost_for_a_while(tmp_path: Path, family: str) -> None:
    run = Running(tmp_path, family, {"kind": "drop", "frames": "report", "joint": "0", "at_s": 0.05, "count": 10})
    assert [report.age_cycles for report in run.cycles(20)] == [0, 0]
    assert [report.age_cycles for report in run.cycles(12)] == [8, 0]
    assert [report.age_cycles for report in run.cycles(5)] == [0, 0]


@pytest.mark.parametrize("family", FAMILIES)
def test_a_motor_that_hears_nothing_lets_go_by_its_watchdog(tmp_path: Path, family: str) -> None:
    run = Running(tmp_path, family, {"kind": "mute", "joint": "1", "at_s": 0.05})
    run.cycles(20)
    assert run.driver.rack.actuators["1"].on
    run.cycles(80)
    assert not run.driver.rack.actuators["1"].on and run.driver.rack.actuators["0"].on


@pytest.mark.parametrize("family", FAMILIES)
def test_what_a_motor_reports_is_wrong_and_what_it_does_is_not(tmp_path: Path, family: str) -> None:
    run = Running(tmp_path, family, {"kind": "jump", "quantity": "torque", "joint": "0", "level": 1.0, "at_s": 0.05})
    assert run.cycles(20)[0].torque_nm == pytest.approx(0.0, abs=0.2)
    reports = run.cycles(20)
    assert reports[0].torque_nm == pytest.approx(1.0, abs=0.2) and abs(reports[1].torque_nm) < 0.2
    assert run.driver.rack.actuators["0"].torque == pytest.approx(0.0, abs=0.2)


def test_late_reports_come_in_a_later_cycle(tmp_path: Path) -> None:
    late = {"kind": "delay", "frames": "report", "joint": "0", "delay_s": 0.005, "at_s": 0.05, "count": 1}
    run = Running(tmp_path, "damiao", late)
    run.cycles(25)
    assert [run.cycles(1)[0].age_cycles for _ in range(3)] == [0, 0, 0]
    kept = Running(tmp_path, "damiao", {**late, "count": 3})
    assert 2 <= max(kept.cycles(1)[0].age_cycles for _ in range(35)) <= 3


def test_power_lost_in_the_motor_is_seen(tmp_path: Path) -> None:
    run = Running(tmp_path, "damiao", {"kind": "fault", "joint": "0", "at_s": 0.05})
    assert run.cycles(20)[0].state is JointState.ENABLED
    assert run.cycles(20)[0].state is JointState.FAULT


def test_the_environment_adds_to_the_file_and_mistakes_are_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(ENVIRONMENT, json.dumps([{"kind": "emcy"}]))
    with pytest.raises(InvalidFields) as refused:
        Running(tmp_path, "damiao")
    assert refused.value.problems[0].path == ("options", "faults", 0, "kind")
    monkeypatch.setenv(ENVIRONMENT, json.dumps([{"kind": "drop", "frames": "tpdo1"}]))
    with pytest.raises(InvalidFields, match="command, report"):
        Running(tmp_path, "damiao")


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("at_s", [None, 0.05])
def test_every_kind_ends_in_a_report_or_in_one_of_our_errors(tmp_path: Path, kind: str, at_s: float | None) -> None:
    fields = {"frames": "report", "quantity": "torque", "delay_s": 0.003, "error": "runtime", "level": 1e6}
    when = {} if at_s is None else {"at_s": at_s}
    run = None
    try:
        run = Running(tmp_path, "robstride", {"kind": kind, **fields, **when})
        run.cycles(100)
    except FrictidError as error:
        assert error.what and (error.next_step or not isinstance(error, HardwareError))
    if run is not None:
        run.driver.close()
        run.driver.rack.advance(2_000_000_000)
        assert not any(motor.on for motor in run.driver.rack.actuators.values())


@pytest.mark.parametrize("family", FAMILIES)
def test_a_motor_that_is_not_seen_to_be_off_is_named(tmp_path: Path, family: str) -> None:
    run = Running(tmp_path, family, {"kind": "mute", "joint": "1", "at_s": 0.05})
    run.cycles(30)
    run.driver.quick_stop()
    with pytest.raises(SafetyAbort):
        run.driver.stop_cycling()
    assert run.driver.may_be_powered == ("1",)


def test_where_the_bus_is_gone_every_joint_may_have_power(tmp_path: Path) -> None:
    run = Running(tmp_path, "damiao", {"kind": "send_error", "error": "os", "at_s": 0.05})
    run.cycles(20)
    with pytest.raises(HardwareError):
        run.cycles(10)
    with pytest.raises(HardwareError):
        run.driver.stop_cycling()
    assert run.driver.may_be_powered == ("0", "1")


@pytest.mark.parametrize("family", FAMILIES)
def test_a_motor_that_somebody_else_switches_on_again_lets_go_by_its_watchdog(tmp_path: Path, family: str) -> None:
    """Its watchdog was put back to what it had been, and it kept its power for ever."""
    run = Running(tmp_path, family, {"kind": "foreign", "frames": "command", "joint": "1", "at_s": 0.0})
    with pytest.raises(SafetyAbort, match="joint 1: somebody else commands"):
        run.cycles(20)
    with pytest.raises(SafetyAbort, match="did not come to rest"):
        run.driver.stop_cycling()
    assert run.driver.may_be_powered == ("1",)
    run.driver.close()
    motors = run.driver.rack.actuators
    assert motors["1"].timeout_ns and not motors["0"].timeout_ns
    run.driver.rack.advance(motors["1"]._now_ns + 1_000_000_000)
    assert not motors["1"].on


@pytest.mark.parametrize("family", FAMILIES)
def test_an_old_set_point_that_somebody_else_repeats_stops_all_in_the_next_cycle(tmp_path: Path, family: str) -> None:
    """It had driven a joint beyond its limits before anybody noticed."""
    run = Running(tmp_path, family, {"kind": "foreign", "frames": "command", "joint": "0", "at_s": 0.11})
    start_rad = run.cycles(50)[0].position_rad
    run.driver.unlock("0")
    aborts, path_rad = [], []
    for cycle in range(1, 100):
        run.driver.clock.wait_until(run.driver.clock.now_ns() + 2_000_000)
        try:
            run.driver.exchange([SetPoint(position_rad=start_rad + 1e-3 * cycle, velocity_rad_s=0.5), SetPoint()])
        except SafetyAbort as error:
            aborts.append((cycle, str(error)))
        path_rad.append(run.driver.rack.actuators["0"].plant.measured_position_rad - start_rad)
    (cycle, told), *more = aborts
    assert not more and "joint 0: somebody else commands this drive" in told
    first_repeated = 6  # of 0.11 s; what is repeated is ours for two cycles, which nobody can tell from an echo
    assert first_repeated <= cycle <= first_repeated + 3
    assert min(path_rad) > -0.002 and max(path_rad) < 1e-3 * (cycle + 20)
    run.driver.stop_cycling()
    assert not any(motor.on for motor in run.driver.rack.actuators.values())


@pytest.mark.parametrize("family", FAMILIES)
def test_an_adapter_that_echoes_our_own_frames_is_no_second_master(
    tmp_path: Path, family: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    run, heard = Running(tmp_path, family), list[can.Message]()
    assert run.driver._line is not None
    bus = run.driver._line._bus
    send, recv = bus.send, bus.recv

    def echoed(message: can.Message, timeout: float | None = None) -> None:
        send(message)
        heard.append(message)

    monkeypatch.setattr(bus, "send", echoed)
    monkeypatch.setattr(bus, "recv", lambda timeout=None: heard.pop(0) if heard else recv(timeout))
    assert [report.age_cycles for report in run.cycles(50)] == [0, 0]
    run.driver.quick_stop()
    run.driver.stop_cycling()
    assert run.driver.may_be_powered == ()
