"""The driver against simulated actuators at the wire."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from mit_bench import FAMILIES, Bench, robot

from frictid_drivers.mit.logs import decoder
from frictid_drivers.mit.simulated import VirtualMitDriver
from frictid_hil.config.robot import load_robot
from frictid_hil.errors import FrictidError, HardwareError, InvalidFields, PlanRefused, SafetyAbort
from frictid_hil.plan.mode import Mode
from frictid_hil.protocol.driver import FD_FRAME, JointState, Severity

WATCHED = ("damiao", "robstride", "cybergear")


@pytest.fixture(params=sorted(FAMILIES))
def family(request: pytest.FixtureRequest) -> str:
    return str(request.param)


def bench(folder: Path, family: str, joints: int = 1, **options: object) -> Bench:
    return Bench(robot(folder, family, joints=joints).to_setup(), **options)


def moved(b: Bench, to_rad: float, cycles: int = 500) -> None:
    start = b.set_points[0].position_rad
    for k in range(cycles):
        phase = (k + 1) / cycles
        b.set_points[0].position_rad = start + (to_rad - start) * (phase - math.sin(2 * math.pi * phase) / 2 / math.pi)
        speed = (1 - math.cos(2 * math.pi * phase)) * (to_rad - start) / cycles * 500
        b.set_points[0].velocity_rad_s = speed if k + 1 < cycles else 0.0
        b.cycles(1)


def test_a_joint_follows_its_set_point(tmp_path: Path, family: str) -> None:
    b = bench(tmp_path, family)
    b.begin()
    b.enabled(Mode.POSITION)
    moved(b, 0.6)
    (report,) = b.cycles(100)
    assert report.position_rad == pytest.approx(0.6, abs=0.02) and report.mode is Mode.POSITION
    assert report.position_rad == pytest.approx(b.rack.actuators["0"].plant.position_rad, abs=1e-3)
    b.driver.stop_cycling()
    assert not b.rack.actuators["0"].on
    b.driver.close()


def test_every_motor_that_moves_has_its_spring_computed_here(tmp_path: Path) -> None:
    """Its own would show less torque at the end of a cycle than the mean: negative viscous friction."""
    b = bench(tmp_path, "damiao", joints=3)
    b.begin()
    b.enabled(Mode.POSITION)
    for _ in range(20):
        for set_point in b.set_points:
            set_point.position_rad += 0.002
            set_point.velocity_rad_s = 1.0
        b.cycles(1)
    assert [motor.asked[2] < 2.0 for motor in b.rack.actuators.values()] == [True, True, True]


def test_a_motor_on_its_head_moves_the_joint_the_same_way(tmp_path: Path, family: str) -> None:
    setup = robot(tmp_path, family).to_setup()
    b = Bench(replace(setup, joints=(replace(setup.joints[0], direction=-1),)))
    b.begin()
    b.enabled(Mode.POSITION)
    moved(b, 0.4)
    assert b.cycles(50)[0].position_rad == pytest.approx(0.4, abs=0.02)
    assert b.rack.actuators["0"].position == pytest.approx(-0.4, abs=0.02)


def test_what_is_not_known_of_a_family_is_said(tmp_path: Path, family: str) -> None:
    b = bench(tmp_path, family)
    b.driver.open()
    findings = b.driver.check(None)
    warnings = [f.message for f in findings if f.severity is Severity.WARNING]
    droop = math.degrees(b.driver.capabilities().droop_rad["0"])
    assert any(f"leaves up to {droop:.4g} deg" in f.message for f in findings)
    assert any("no watchdog" in text for text in warnings) is (family not in WATCHED)
    capabilities = b.driver.capabilities()
    assert capabilities.drive_watchdog is (family in WATCHED) and (Mode.TORQUE in capabilities.modes) is (
        family in WATCHED
    )
    if family not in WATCHED:
        b.driver.configure(500.0, ["0"])
        with pytest.raises(HardwareError, match="TORQUE refused"):
            b.driver.enable("0", Mode.TORQUE)


@pytest.mark.parametrize("family", WATCHED)
def test_the_watchdog_is_set_and_lets_go_without_the_host(tmp_path: Path, family: str) -> None:
    b = bench(tmp_path, family, watchdog_ms=60)
    b.begin()
    b.enabled(Mode.TORQUE)
    b.set_points[0].torque_nm = 0.5
    b.cycles(50)
    assert b.rack.actuators["0"].on
    b.clock.wait_until(b.clock.now_ns() + 80_000_000)
    assert not b.rack.actuators["0"].on
    (report,) = b.cycles(3)
    assert report.state is not JointState.ENABLED
    b.driver.close()
    assert b.rack.actuators["0"].timeout_ns == 0  # as it was


@pytest.mark.parametrize(
    ("family", "most_hz"),
    [("damiao", 493), ("robstride", 416), ("cybergear", 416), ("robstride-mit", 493), ("cubemars", 493)],
)
def test_six_motors_at_one_kilohertz_are_refused_with_the_rate_that_fits(
    tmp_path: Path, family: str, most_hz: int
) -> None:
    b = bench(tmp_path, family, joints=6)
    b.driver.open()
    with pytest.raises(PlanRefused, match=f"at most {most_hz} Hz"):
        b.driver.configure(1000.0, ["0"])
    findings = b.driver.check(None)  # 500 Hz in the robot file
    assert findings[0].severity is Severity.ERROR and f"at most {most_hz} Hz" in findings[0].next_step
    b.driver.configure(float(most_hz), ["0"])
    assert b.driver.capabilities().max_cycle_hz == most_hz


FD: dict[str, Any] = {"fd": True, "data_bitrate": 5_000_000}


def test_seven_motors_with_can_fd_go_at_one_kilohertz(tmp_path: Path) -> None:
    """57 us a frame: 1178 Hz for six and 1010 Hz for seven within 80 % of the bus, by hand."""
    for joints, most_hz in ((6, 1177), (7, 1009)):
        b = bench(tmp_path, "damiao", joints=joints, **FD)
        b.driver.open()
        assert b.driver.capabilities().max_cycle_hz == most_hz
        with pytest.raises(PlanRefused, match=f"at most {most_hz} Hz"):
            b.driver.configure(1500.0, ["0"])
    assert "1000 kbit/s (CAN FD, data at 5000 kbit/s)" in b.driver.check(None)[0].message
    b.driver.configure(1000.0, ["0"])


def test_with_can_fd_every_frame_is_one_and_the_log_says_so(tmp_path: Path) -> None:
    b = bench(tmp_path, "damiao", **FD)
    b.begin()
    b.enabled(Mode.POSITION)
    moved(b, 0.3)
    (report,) = b.cycles(50)
    assert report.position_rad == pytest.approx(0.3, abs=0.02)
    assert b.frames and all(can_id & FD_FRAME for _, can_id, _ in b.frames)
    *_, last = decoder(b.driver.frame_map_values()).rows(b.frames)
    assert last.feedback[0].position_rad == report.position_rad


@pytest.mark.parametrize("fd", [True, False])
def test_can_fd_on_one_side_alone_is_told(tmp_path: Path, fd: bool) -> None:
    b = bench(tmp_path, "damiao", **(FD if fd else {}))
    b.rack._wires[0][1]._words[35] = 4 if fd else 9
    told = "in classical frames, the robot file has CAN FD" if fd else "in CAN FD frames, the robot file has classical"
    with pytest.raises(HardwareError, match=told):
        b.driver.open()
    b = bench(tmp_path, "damiao", **(FD if fd else {}))
    b.bus.fault = lambda frame, to_host: [] if to_host else [frame]  # an adapter that hears the one kind only
    with pytest.raises(HardwareError, match="does not answer") as caught:
        b.driver.open()
    assert "CAN FD on one side alone" in caught.value.cause


def test_another_data_rate_than_the_motors_is_an_error(tmp_path: Path) -> None:
    b = bench(tmp_path, "damiao", fd=True, data_bitrate=2_000_000)
    b.rack._wires[0][1]._words[35] = 9
    b.driver.open()
    assert any(
        finding.severity is Severity.ERROR and "says 5 Mbit/s, the robot file 2 Mbit/s" in finding.message
        for finding in b.driver.check(None)
    )


@pytest.mark.parametrize(
    ("family", "options", "words"),
    [
        ("robstride", FD, "speaks classical CAN"),
        ("damiao", {"fd": True, "data_bitrate": 8_000_000}, "expected one of 2000000"),
        ("damiao", {"data_bitrate": 5_000_000}, "without `fd: true`"),
        ("damiao", {"fd": "yes"}, "true or false"),
    ],
)
def test_can_fd_that_cannot_be_is_refused_by_name(
    tmp_path: Path, family: str, options: dict[str, Any], words: str
) -> None:
    with pytest.raises(InvalidFields, match=words):
        bench(tmp_path, family, **options)


def test_a_serial_adapter_is_counted_in_letters(tmp_path: Path) -> None:
    setup = replace(robot(tmp_path, "damiao").to_setup(), bus="slcan:/dev/ttyACM0", options={"tty_baudrate": 115200})
    b = Bench(setup)
    b.driver.open()
    assert b.driver.capabilities().max_cycle_hz == 523


def test_ranges_are_read_from_a_motor_that_tells_them(tmp_path: Path) -> None:
    b = bench(tmp_path, "damiao")
    b.rack._wires[0][1]._floats[23] = 28.0
    actuator = b.rack.actuators["0"]
    actuator.ranges = replace(actuator.ranges, torque_nm=28.0)
    b.driver.open()
    assert any("its own figures are used" in f.message for f in b.driver.check(None))
    assert b.driver.identify()["0"].torque_resolution_nm == pytest.approx(2 * 28 / 4095)


def test_a_wrong_model_is_seen_where_the_motor_tells_its_position_exactly(tmp_path: Path) -> None:
    setup = robot(tmp_path, "robstride").to_setup()
    joint = replace(setup.joints[0], locked_position_rad=1.5)
    b = Bench(replace(setup, joints=(joint,)))
    b.rack.actuators["0"].ranges = replace(b.rack.actuators["0"].ranges, position_rad=12.5)
    b.driver.open()
    assert any(f.severity is Severity.ERROR and "own parameter says" in f.message for f in b.driver.check(None))


def test_a_bare_motor_that_does_not_answer_is_named(tmp_path: Path) -> None:
    b = bench(tmp_path, "damiao", joints=2)
    b.bus.fault = lambda frame, to_host: [] if frame[1][:1] == b"\x02" or frame[0] in (2, 0x12) else [frame]
    with pytest.raises(HardwareError, match=r"joint 1 \(id 2\): does not answer"):
        b.driver.open()


@pytest.mark.parametrize(
    "options",
    [
        {"model": "DM-4310"},
        {"model": "RS00", "protocol": "damiao"},
        {"model": "AK80-9", "kp": 501},
        {"model": "AK80-9", "reply_id": 1},
        {"model": "RS00", "speed": 3},
    ],
)
def test_impossible_options_are_refused_by_name(tmp_path: Path, options: dict[str, object]) -> None:
    setup = robot(tmp_path, "damiao").to_setup()
    joint = replace(setup.joints[0], options=options)
    with pytest.raises(InvalidFields, match=r"joints\.0\.options\."):
        VirtualMitDriver(replace(setup, joints=(joint,)))


def test_a_log_decodes_to_what_was_live(tmp_path: Path, family: str) -> None:
    b = bench(tmp_path, family, joints=2)
    b.begin()
    first = len(b.frames)
    b.enabled(Mode.POSITION)
    live = []
    for _ in range(60):
        b.set_points[0].position_rad += 0.002
        live.append([(r.t_ns, r.position_rad, r.torque_nm, r.position_command_rad, r.state) for r in b.cycles(1)])
    rows = [
        [(r.t_ns, r.position_rad, r.torque_nm, r.position_command_rad, r.state) for r in row.feedback]
        for row in decoder(b.driver.frame_map_values()).rows(b.frames[first:])
    ]
    assert str(rows[-60:]) == str(live)


# -- a wire that is broken ---------------------------------------------------------------------------------------------


def test_silence_makes_reports_old_and_an_unplugged_motor_stops_by_itself(tmp_path: Path) -> None:
    b = bench(tmp_path, "damiao", joints=2)
    b.begin()
    b.enabled(Mode.POSITION)
    b.bus.fault = lambda frame, to_host: [] if frame[0] in (1, 0x11) else [frame]
    silent, other = b.cycles(100)
    assert silent.age_cycles == 100 and other.age_cycles == 0
    assert not b.rack.actuators["0"].on and b.rack.actuators["1"].on


def test_a_lost_frame_costs_one_cycle_and_a_damaged_one_changes_nothing(tmp_path: Path, family: str) -> None:
    b = bench(tmp_path, family)
    b.begin()
    b.enabled(Mode.POSITION)
    b.bus.fault = lambda frame, to_host: [] if to_host else [frame]
    assert b.cycles(1)[0].age_cycles == 1
    b.bus.fault = lambda frame, to_host: [(frame[0], frame[1][:3])] if to_host else [frame]
    (report,) = b.cycles(1)
    assert report.age_cycles == 2 and report.position_rad == pytest.approx(0.0, abs=0.01)
    b.bus.fault = None
    assert b.cycles(1)[0].age_cycles == 0


def test_a_dead_bus_is_told_and_closing_does_not_hang(tmp_path: Path) -> None:
    b = bench(tmp_path, "cubemars")
    b.begin()
    b.enabled(Mode.POSITION)

    def dead(frame: object, to_host: bool) -> list[object]:
        raise OSError("No such device")

    b.bus.fault = dead
    with pytest.raises(HardwareError, match="could not be sent"):
        b.cycles(5)
    b.driver.quick_stop()
    b.driver.close()


def test_a_motor_in_fault_is_cleared_once_and_then_told(tmp_path: Path) -> None:
    b = bench(tmp_path, "damiao")
    b.begin()
    b.rack.actuators["0"].fault = 0xB
    b.driver.enable("0", Mode.POSITION)
    assert b.cycles(4)[0].state is JointState.ENABLED
    b.rack.actuators["0"].fault = 0xB
    b.rack.actuators["0"].switch(False)
    (report,) = b.cycles(4)
    assert (report.state, report.error_code) == (JointState.FAULT, 0xB)
    b.driver.close()


def test_a_quick_stop_brakes_and_keeps_power_until_it_is_taken(tmp_path: Path, family: str) -> None:
    b = bench(tmp_path, family)
    b.begin()
    b.enabled(Mode.POSITION)
    for _ in range(100):
        b.set_points[0].position_rad += 0.004
        b.set_points[0].velocity_rad_s = 2.0
        b.cycles(1)
    assert abs(b.rack.actuators["0"].velocity) > 1.0
    b.driver.quick_stop()
    b.cycles(100)
    assert abs(b.rack.actuators["0"].velocity) < 0.01 and b.rack.actuators["0"].on
    b.driver.disable("0")
    b.cycles(2)
    assert not b.rack.actuators["0"].on


def test_a_set_point_that_is_no_number_stops_every_joint(tmp_path: Path, family: str) -> None:
    b = bench(tmp_path, family, joints=2)
    b.begin()
    b.enabled(Mode.POSITION)
    b.set_points[1].position_rad = math.nan
    with pytest.raises(SafetyAbort, match="joint 1: the set-point is no number"):
        b.cycles(1)
    b.set_points[1].position_rad = 0.0
    before = [actuator.position for actuator in b.rack.actuators.values()]
    b.cycles(50)
    assert [actuator.position for actuator in b.rack.actuators.values()] == pytest.approx(before, abs=0.01)


def test_errors_before_their_time_are_ours(tmp_path: Path) -> None:
    b = bench(tmp_path, "damiao")
    for call in (
        lambda: b.driver.identify(),
        lambda: b.driver.enable("0", Mode.POSITION),
        lambda: b.driver.exchange([]),
    ):
        with pytest.raises(FrictidError):
            call()
    b.driver.quick_stop()
    b.driver.close()


def test_the_seven_joint_arm_answers_and_fits_its_bus() -> None:
    driver = VirtualMitDriver(load_robot("openarm.yaml").to_setup())
    driver.open()
    try:
        findings = driver.check(None)
        assert [one for one in findings if one.severity is Severity.ERROR] == [] and len(findings) == 15
    finally:
        driver.close()
