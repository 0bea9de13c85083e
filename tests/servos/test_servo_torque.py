"""Torque of servos at the wire: goal currents under a bus watchdog, and goals that move where there are none."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest
from servo_bench import Bench, setup_of

from frictid_drivers.servos.logs import decoder
from frictid_drivers.servos.packets import WIRES
from frictid_hil.errors import HardwareError
from frictid_hil.plan.control import Bounds, Compensated, ControlLaw, Gravity
from frictid_hil.plan.mode import Mode
from frictid_hil.plan.plan import Hold, JointPlan, Plan
from frictid_hil.protocol.driver import JointState, Severity

MODE, P_GAIN, WATCHDOG, GOAL_CURRENT, CURRENT_LIMIT, TORQUE, PROFILE = 11, 84, 98, 102, 38, 64, 112
JOINT = "shoulder_pan"


def register(bench: Bench, address: int, size: int = 2) -> int:
    memory = bench.servo(0).memory
    return int.from_bytes(memory[address : address + size], "little", signed=address == GOAL_CURRENT)


def in_torque_mode(bench: Bench) -> Bench:
    bench.begin()
    bench.enabled()
    bench.driver.enable(JOINT, Mode.TORQUE)
    (report, _) = bench.cycles(1)
    assert (report.state, report.mode) == (JointState.ENABLED, Mode.TORQUE)
    return bench


# -- goal currents -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("direction", [1, -1])
def test_a_torque_is_a_current_both_ways(direction: int) -> None:
    bench = in_torque_mode(Bench(setup_of("XL330-M288", direction=direction)))
    for torque_nm in (0.1, -0.1):
        bench.set_points[0].torque_nm = torque_nm
        (report, other) = bench.cycles(4)
        assert register(bench, GOAL_CURRENT) == direction * round(torque_nm / 0.35 / 0.001)
        assert report.torque_nm == pytest.approx(torque_nm, abs=0.03)
        assert math.isnan(report.position_command_rad) and other.mode is Mode.POSITION


def test_torque_mode_begins_with_the_torque_of_the_position_loop() -> None:
    bench = Bench(setup_of("XL330-M288"))
    bench.begin()
    bench.enabled()
    bench.set_points[0].position_rad = 0.01
    (held, _) = bench.cycles(40)
    assert held.torque_nm > 0.1
    bench.driver.enable(JOINT, Mode.TORQUE)
    assert register(bench, GOAL_CURRENT) == round(held.torque_nm / 0.35 / 0.001)
    assert bench.servo(0).on


def test_gains_and_mode_are_as_they_were_afterwards() -> None:
    bench = Bench(setup_of("XL330-M288"))
    bench.servo(0).write(P_GAIN, (300).to_bytes(2, "little"))
    in_torque_mode(bench)
    assert register(bench, P_GAIN) == 400, "the servo itself resets its gains"
    bench.driver.enable(JOINT, Mode.POSITION)
    assert (register(bench, MODE, 1), register(bench, P_GAIN), bench.servo(0).on) == (3, 300, True)
    bench.driver.enable(JOINT, Mode.TORQUE)
    bench.driver.close()
    assert (register(bench, MODE, 1), register(bench, P_GAIN), bench.servo(0).on) == (3, 300, False)


def test_a_profile_slows_the_way_to_where_a_joint_shall_hold_and_no_further_one() -> None:
    bench = Bench(setup_of("XL330-M288"))
    bench.servo(0).write(PROFILE, (500).to_bytes(4, "little"))
    in_torque_mode(bench)
    bench.driver.enable(JOINT, Mode.POSITION)
    (report, _) = bench.cycles(1)
    half_of_its_speed = 0.5 * bench.setup.joints[0].max_velocity_rad_s / (0.229 * 2 * math.pi / 60)
    assert register(bench, PROFILE, 4) == math.floor(half_of_its_speed)
    bench.set_points[0].position_rad = report.position_rad + 0.01
    bench.cycles(1)
    assert register(bench, PROFILE, 4) == 500
    bench.driver.enable(JOINT, Mode.TORQUE)
    bench.cycles(2)
    bench.driver.quick_stop()
    assert register(bench, PROFILE, 4) == math.floor(half_of_its_speed)
    bench.driver.close()
    assert register(bench, PROFILE, 4) == 500


def test_no_goal_is_beyond_the_servos_own_current_limit() -> None:
    bench = Bench(setup_of("XL330-M288"))
    bench.servo(0).write(CURRENT_LIMIT, (50).to_bytes(2, "little"))
    in_torque_mode(bench)
    bench.set_points[0].torque_nm = -1.0
    bench.cycles(2)
    assert register(bench, GOAL_CURRENT) == -50


def test_a_dead_host_leaves_no_current() -> None:
    bench = in_torque_mode(Bench(setup_of("XL330-M288")))
    bench.set_points[0].torque_nm = 0.3
    bench.cycles(2)
    bench.clock.wait_until(bench.clock.now_ns() + 300_000_000)
    assert not bench.servo(0).on and register(bench, WATCHDOG, 1) == 255


def test_a_watchdog_that_does_not_keep_what_is_written_allows_no_torque() -> None:
    def old_firmware(data: bytes, to_host: bool) -> bytes:
        writes = not to_host and data[7] == 0x83 and data[8:10] == b"\x62\0"
        return b"" if writes else data

    bench = Bench(setup_of("XL330-M288"))
    bench.chain.fault = old_firmware
    bench.begin()
    bench.enabled()
    assert bench.driver.capabilities().modes == {Mode.POSITION}
    with pytest.raises(HardwareError, match="TORQUE refused") as caught:
        bench.driver.enable(JOINT, Mode.TORQUE)
    assert "watchdog" in caught.value.cause and register(bench, MODE, 1) == 3
    allowed = Bench(setup_of("XL330-M288", bus={"allow_torque_without_watchdog": True}))
    allowed.chain.fault = old_firmware
    in_torque_mode(allowed)


def test_a_servo_that_keeps_its_mode_is_told() -> None:
    bench = Bench(setup_of("XL330-M288"))
    bench.begin()
    bench.enabled()
    bench.chain.fault = lambda data, to_host: (
        b"" if not to_host and data[8:10] == b"\x0b\0" and data[7] == 0x83 else data
    )
    with pytest.raises(HardwareError, match="does not take operating mode 0"):
        bench.driver.enable(JOINT, Mode.TORQUE)
    assert not bench.servo(0).on


@pytest.mark.parametrize("lost", [None, *range(8)])
def test_a_quick_stop_takes_the_current_away_whichever_packet_is_lost(lost: int | None) -> None:
    bench = in_torque_mode(Bench(setup_of("XL330-M288")))
    bench.set_points[0].torque_nm = 0.5
    bench.cycles(6)
    sent = iter(range(100))
    bench.chain.fault = lambda data, to_host: b"" if not to_host and next(sent) == lost else data
    here_rad = bench.servo(0).plant.position_rad
    bench.driver.quick_stop()
    bench.chain.fault = None
    bench.cycles(40)
    servo = bench.servo(0)
    assert abs(servo.plant.true_velocity_rad_s) < 0.1 and abs(servo.plant.position_rad - here_rad) < 0.3
    assert register(bench, GOAL_CURRENT) == 0 or register(bench, MODE, 1) == 3 or not servo.on
    assert lost is not None or (servo.on and register(bench, MODE, 1) == 3)
    bench.driver.close()
    assert not servo.on


def test_a_servo_left_in_current_mode_is_told_and_put_back() -> None:
    bench = Bench(setup_of("XL330-M288"))
    bench.servo(0).write(MODE, b"\0")
    bench.driver.open()
    (told,) = [f for f in bench.driver.check(None) if "operating mode" in f.message]
    assert told.severity is Severity.WARNING and "cut off" in told.message
    bench.driver.configure(200.0, [])
    assert register(bench, MODE, 1) == 3


def test_a_log_of_torque_mode_decodes_to_what_was_live() -> None:
    bench = Bench(setup_of("XL330-M288"))
    bench.begin()
    bench.enabled()
    live = [[str(report) for report in bench.cycles(1)] for _ in range(3)]
    bench.driver.enable(JOINT, Mode.TORQUE)
    bench.set_points[0].torque_nm = 0.1
    live += [[str(report) for report in bench.cycles(1)] for _ in range(10)]
    bench.driver.enable(JOINT, Mode.POSITION)
    live += [[str(report) for report in bench.cycles(1)] for _ in range(3)]
    rows = decoder(bench.driver.frame_map_values()).rows(bench.frames)
    assert [[str(report) for report in row.feedback] for row in rows][-16:] == live


# -- the simulated servo's own rules -----------------------------------------------------------------------------------


def error_of(bench: Bench, address: int, data: bytes) -> int:
    """What the servo answers to an acknowledged write on the line."""
    wire = WIRES["dynamixel"]
    bench.chain.write(wire.write(1, address, data))
    (answer,) = wire.parse(bytearray(bench.chain.read(0.0)), answers=True)
    return answer.error


def test_the_simulated_servo_refuses_as_the_manual_says() -> None:
    bench = Bench(setup_of("XL330-M288"))
    assert error_of(bench, GOAL_CURRENT, (1751).to_bytes(2, "little")) == 6
    assert error_of(bench, P_GAIN, (123).to_bytes(2, "little")) == 0
    assert error_of(bench, MODE, b"\0") == 0
    assert (register(bench, P_GAIN), register(bench, GOAL_CURRENT)) == (400, 1750)
    assert error_of(bench, GOAL_CURRENT, bytes(2)) == 0
    assert error_of(bench, TORQUE, b"\1") == 0
    assert error_of(bench, MODE, b"\3") == 7, "EEPROM is closed under torque"
    assert error_of(bench, WATCHDOG, b"\1") == 0
    bench.clock.wait_until(50_000_000)
    assert error_of(bench, GOAL_CURRENT, b"\5\0") == 4 and register(bench, WATCHDOG, 1) == 255
    assert error_of(bench, WATCHDOG, b"\0") == 0 and error_of(bench, GOAL_CURRENT, b"\5\0") == 0


# -- goals that move ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("model", ["STS3215", "SCS15", "XL430-W250", "XL330-M288"])
def test_an_added_torque_moves_the_goal_by_its_distance_on_the_spring(model: str) -> None:
    bench = Bench(setup_of(model, stiffness=20.0))
    bench.begin()
    bench.enabled()
    bench.set_points[0].position_rad, bench.set_points[0].torque_offset_nm = 0.2, -0.3
    (report, other) = bench.cycles(1)
    step_rad = 2 * math.pi / 4096
    assert report.position_command_rad == pytest.approx(0.2 - 0.3 / 20.0, abs=3 * step_rad)
    assert abs(other.position_command_rad) < 0.01


def test_a_moved_goal_keeps_to_the_limits_of_torque_and_position() -> None:
    bench = Bench(setup_of("STS3215", stiffness=2.0))
    bench.begin()
    bench.driver.set_limits(JOINT, torque_nm=0.4, position_min_rad=-1.0, position_max_rad=0.3)
    bench.enabled()
    for position_rad, offset_nm, goal_rad in ((0.0, 1.5, 0.2), (0.25, 1.5, 0.3), (-0.9, -1.5, -1.0)):
        bench.set_points[0].position_rad, bench.set_points[0].torque_offset_nm = position_rad, offset_nm
        (report, _) = bench.cycles(1)
        assert report.position_command_rad == pytest.approx(goal_rad, abs=0.002)


def compensated() -> Plan:
    law = ControlLaw("mop", Gravity(), None, None, None, False, 1.0, 1.0)
    bounds = Bounds(-1.0, 1.0, 1.0, 1.0)
    motion = Compensated("track mop", Hold(0.0, 1.0), law, bounds, Mode.POSITION)
    return Plan("so101", 200.0, (JointPlan(JOINT, (motion,), {}),))


@pytest.mark.parametrize(
    ("stiffness", "spoilt", "told"),
    [
        (0.0, lambda servo: None, "stiffness of its position loop is not known"),
        (20.0, lambda servo: servo.write(23, b"\7"), "I gain 7"),
        (20.0, lambda servo: None, ""),
    ],
)
def test_what_a_moved_goal_needs_is_checked_before_motion(
    stiffness: float, spoilt: Callable[[object], object], told: str
) -> None:
    bench = Bench(setup_of("STS3215", stiffness=stiffness))
    spoilt(bench.servo(0))
    bench.driver.open()
    errors = [f.message for f in bench.driver.check(compensated()) if f.severity is Severity.ERROR]
    assert len(errors) == (1 if told else 0) and all(told in message for message in errors)
    assert not [f for f in bench.driver.check(None) if f.severity is Severity.ERROR]


def test_the_gain_of_the_loop_is_part_of_the_identity_unless_it_has_an_integral_part() -> None:
    bench = Bench(setup_of("STS3215"))
    bench.servo(1).write(23, b"\7")
    bench.driver.open()
    first, second = bench.driver.identify().values()
    assert first.settings["position_p_gain"] == 32 and "position_p_gain" not in second.settings
