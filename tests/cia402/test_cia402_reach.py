"""Reaching the drives: what the robot file must say, what is asked, and what `check` finds; nothing is written."""

from __future__ import annotations

import math
import subprocess
import sys

import can
import pytest
from cia402_bench import RAD, Bench, bench
from cia402_wire import ScriptedDrive, robot

from frictid_drivers.cia402 import Cia402Driver
from frictid_drivers.cia402.known_settings import KNOWN_SETTINGS, Effect, timing_of
from frictid_drivers.cia402.network import Wire
from frictid_hil.errors import HardwareBusy, HardwareError, InvalidFields, UsageError
from frictid_hil.protocol import can_bus
from frictid_hil.protocol.can_bus import BusLock
from frictid_hil.protocol.driver import Driver, Severity


def test_is_a_driver():
    assert isinstance(bench(1).driver, Driver)


@pytest.mark.parametrize(
    ("options", "path"),
    [
        ({"options": {"sdo_timeout_s": "fast"}}, ("options", "sdo_timeout_s")),
        ({"options": {"bitrate": 8_000_000}}, ("options", "bitrate")),
        ({"options": {"quick_stop_option": 2}}, ("options", "quick_stop_option")),
        ({"joint_options": {"following_window_rad": 0}}, ("joints", "0", "options", "following_window_rad")),
        ({"joint_options": {"external_torque_object": "2030"}}, ("joints", "0", "options", "external_torque_object")),
        (
            {"joint_options": {"timing": {"torque_delay_s": 0.001, "torque_lag_s": 0.004}}},
            ("joints", "0", "options", "timing", "torque_lag_s"),
        ),
        (
            {"joint_options": {"external_torque_object": "2030:00 i32"}},
            ("joints", "0", "options", "external_torque_nm_per_unit"),
        ),
        ({"joint_options": {"timing": {"torque_delay": 1}}}, ("joints", "0", "options", "timing")),
        ({"joint_options": {"rated_torque_side": "gear"}}, ("joints", "0", "options", "rated_torque_side")),
        ({"joint_options": {"velocity_unit_rad_s": 0}}, ("joints", "0", "options", "velocity_unit_rad_s")),
        ({"joint_options": {"digital_inputs": "yes"}}, ("joints", "0", "options", "digital_inputs")),
        ({"options": {"allow_torque_without_watchdog": "false"}}, ("options", "allow_torque_without_watchdog")),
        ({"options": {"watchdog_s": 0.1}}, ("options", "watchdog_s")),
        ({"joint_options": {"torque_sourse": "current"}}, ("joints", "0", "options", "torque_sourse")),
    ],
)
def test_wrong_options_are_named(options, path):
    with pytest.raises(InvalidFields) as caught:
        bench(1, **options)
    assert path in [problem.path for problem in caught.value.problems]


def test_the_option_that_was_meant_is_told():
    with pytest.raises(InvalidFields, match="did you mean watchdog_ms"):
        bench(1, options={"watchdog": 100})


@pytest.mark.parametrize("nodes", [(1, 1), (0,), (128,), (127,)])
def test_wrong_node_ids_are_named(nodes):
    with pytest.raises(InvalidFields) as caught:
        bench(*nodes)
    assert caught.value.problems[-1].path[-1] == "node"


def test_open_and_check_write_nothing():
    b = bench(1, 2).open()
    b.driver.identify()
    findings = b.driver.check(None)
    downloads = [data for can_id, data in b.bus.sent if can_id > 0x600 and data[0] >> 5 == 1]
    others = [can_id for can_id, _ in b.bus.sent if not 0x600 < can_id < 0x680]
    assert downloads == [] and others == []
    assert not [finding for finding in findings if finding.severity is Severity.ERROR], findings


def test_a_transcript_of_the_first_question():
    b = bench(3).open()
    sent = [frame[1:] for frame in b.frames[:2]]
    assert sent == [
        (0x603, bytes.fromhex("40 0010 00 00000000"), True),
        (0x583, bytes.fromhex("43 0010 00 92010200"), False),
    ]
    assert {frame[0] for frame in b.frames} == {0}


def test_identity():
    identity = bench(1, joint_options={"timing": {"torque_delay_s": 0.002}}).open().driver.identify()["0"]
    assert (identity.serial, identity.firmware) == ("99", "7.1 revision 0x1")
    assert "Scripted drive 402" in identity.product
    assert identity.rated_torque_nm == pytest.approx(50.0) and identity.gear_ratio == 50
    assert identity.position_resolution_rad == pytest.approx(RAD)
    assert identity.torque_resolution_nm == pytest.approx(0.05)
    assert (identity.timing.torque_delay_s, identity.timing.source) == (0.002, "robot file")


def test_a_filter_on_the_torque_is_declared_as_lag_within_the_delay():
    (settings,) = KNOWN_SETTINGS.values()
    timing = timing_of({one: 4000 for one in settings if one.effect is Effect.TORQUE_FILTER_US}, 0.001)
    assert timing is not None
    assert (timing.torque_delay_s, timing.torque_lag_s) == (pytest.approx(0.0045), pytest.approx(0.004))
    told = {"torque_delay_s": 0.003, "torque_lag_s": 0.002}
    timing = bench(1, joint_options={"timing": told}).open().driver.identify()["0"].timing
    assert (timing.torque_delay_s, timing.torque_lag_s) == (0.003, 0.002)


def test_a_silent_drive_is_named():
    b = Bench(ScriptedDrive(1), ScriptedDrive(5, silent=True), options={"sdo_timeout_s": 0.02})
    with pytest.raises(HardwareError) as caught:
        b.open()
    error = caught.value
    assert "node 5" in error.where and "1000:00" in error.where and "0.02 s" in error.what and error.next_step
    assert b.bus.closed


@pytest.mark.parametrize("size", [0, 1, 3, 7])
def test_a_refusal_that_is_cut_short_is_named(size, monkeypatch):
    """canopen looked for its code behind the end of the frame, which ended in a traceback."""
    drive = ScriptedDrive(1)
    monkeypatch.setattr(drive, "sdo", lambda request: ScriptedDrive.abort(0x1000, 0, 0x06020000)[:size])
    with pytest.raises(HardwareError, match=f"an answer of {size} bytes instead of 8"):
        Bench(drive, options={"sdo_timeout_s": 0.02}).open()


def test_a_bus_that_is_not_there():
    with pytest.raises(HardwareError) as caught:
        Cia402Driver(robot(1).__class__("r", "socketcan:no_such_can", 1000.0, robot(1).joints)).open()
    assert "no_such_can" in caught.value.where
    assert "ip link set no_such_can up type can bitrate 1000000" in caught.value.next_step


def test_an_interface_that_does_not_exist():
    with pytest.raises(HardwareError, match="no working interface 'cansocket'") as caught:
        Cia402Driver(robot(1).__class__("r", "cansocket:can0", 1000.0, robot(1).joints)).open()
    assert "socketcan" in caught.value.next_step


def test_a_bus_without_a_channel():
    with pytest.raises(UsageError, match="interface:channel"):
        Cia402Driver(robot(1).__class__("r", "can0", 1000.0, robot(1).joints)).open()


def test_a_bus_held_by_somebody_else():
    setup = robot(1).__class__("r", "virtual:cia402-held", 1000.0, robot(1).joints)
    other = BusLock(setup.bus)
    other.acquire()
    try:
        with pytest.raises(HardwareBusy, match="another process"):
            Cia402Driver(setup).open()
    finally:
        other.release()


def test_nobody_answers_on_a_real_python_can_bus():
    setup = robot(1, options={"sdo_timeout_s": 0.05})
    setup = setup.__class__("r", "virtual:cia402-empty", 1000.0, setup.joints, setup.options)
    for _ in range(2):  # the first failure must have given the bus back
        with pytest.raises(HardwareError, match="no answer to SDO"):
            Cia402Driver(setup).open()


def test_check_finds_what_is_wrong():
    drive = ScriptedDrive(1, without={0x1016, 0x1019, 0x605A})
    drive.values[0x6041, 0], drive.values[0x603F, 0] = 0x0218, 0x7305
    drive.values[0x6502, 0] = 0x80
    drive.values[0x6072, 0] = 100
    drive.values[0x607D, 1], drive.values[0x607D, 2] = -1000, 1000
    drive.values[0x6085, 0] = 1
    said = "\n".join(
        f"{finding.severity.value}: {finding.message}" for finding in Bench(drive).open().driver.check(None)
    )
    for words in (
        "error: error 0x7305 (sensor",
        "warning: no cyclic synchronous torque mode",
        "warning: no heartbeat consumer (1016)",
        "warning: no SYNC counter (1019, 18xx:06) on joint 0",
        "warning: the drive has no 605A:00",
        "torque limit is 5 N m (6072), the robot file's 60 N m",
        "position limits are -1.758 deg..1.758 deg (607D)",
        "a quick stop from full speed would take",
    ):
        assert words in said, said


def test_bus_load_is_that_of_the_joint_that_has_most_to_say():
    b = Bench(ScriptedDrive(1, without={0x60B2}), ScriptedDrive(2)).open()
    fleet = b.driver._reached()
    least_hz = fleet.highest_rate_hz(["1"])
    assert least_hz < fleet.highest_rate_hz(["0"])
    assert b.driver.capabilities().max_cycle_hz == least_hz
    assert f"{least_hz:g} Hz" in b.driver.check(None)[0].message


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({(0x6091, 1): 100}, "gear ratio is 50 in the robot file and 100 in the drive (6091 = 100:1)"),
        ({(0x6076, 0): 2000}, "rated torque is 50 N m in the robot file and 100 N m in the drive (6076 = 2000 mN m"),
        ({(0x60A9, 0): 0x00410000}, "0x00410000"),
    ],
)
def test_a_drive_that_is_not_the_robot_files(values, words):
    drive = ScriptedDrive(1, refuses={(0x60A9, 0): 0x06090030})
    drive.values.update(values)
    b = Bench(drive).open()
    with pytest.raises(HardwareError) as caught:
        b.driver.configure(1000.0, ["0"])
    assert words in str(caught.value) and "joint 0" in str(caught.value)


def test_position_units_with_feed_or_without_gear():
    drive = ScriptedDrive(1)
    drive.values[0x6091, 1] = 1
    b = Bench(drive).open()
    assert b.driver.identify()["0"].position_resolution_rad == pytest.approx(RAD)
    assert any("does not know the gear" in finding.message for finding in b.driver.check(None))
    b = bench(1, joint_options={"position_units_per_revolution": 360_000}).open()
    assert b.driver.identify()["0"].position_resolution_rad == pytest.approx(2 * math.pi / 360_000)


def test_options_of_an_interface_are_passed_on(monkeypatch):
    seen = {}

    def opened(**settings):
        seen.update(settings)
        return real(interface="virtual", channel="passed-on")

    real = can.Bus
    monkeypatch.setattr(can, "Bus", opened)
    bus = can_bus.open_bus("socketcand:can0", {"host": "10.0.0.2", "port": 29536, "tcp_tune": True, "watchdog_ms": 100})
    bus.shutdown()
    assert seen["tcp_tune"] is True and seen["host"] == "10.0.0.2" and "watchdog_ms" not in seen


@pytest.mark.slow
def test_what_canopen_logs_stays_off_a_persons_screen():
    code = "import logging, frictid_drivers.cia402; logging.getLogger('canopen.sdo').error('transfer aborted')"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stderr == ""


@pytest.mark.timeout(60)
def test_a_transfer_that_ends_in_the_middle_of_a_frame_blocks_nothing():
    """The collector may close a stream of canopen at any moment, and the stream then sends."""
    told: list[int] = []

    def collected(_now_ns: int, frame_id: int, _data: bytes, _sent: bool) -> None:
        told.append(frame_id)
        if len(told) == 1:
            wire.send_message(0x602, b"\x80")

    with can.Bus(interface="virtual", channel="collected") as bus:
        wire = Wire(bus, collected, lambda: 0)
        wire.send_message(0x601, b"\x40")
    assert told == [0x601, 0x602]
