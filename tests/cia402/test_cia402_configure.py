"""Configuring the drives: everything written is read back, and what cannot be is refused."""

from __future__ import annotations

import math
import struct
from dataclasses import replace

import pytest
from cia402_bench import RAD, Bench, bench
from cia402_wire import OBJECTS, ScriptedDrive

from frictid_hil.errors import HardwareError, PlanRefused
from frictid_hil.plan.mode import Mode
from frictid_hil.protocol.driver import Severity


def test_everything_is_written_and_read_back():
    drive = ScriptedDrive(1)
    b = Bench(drive, options={"watchdog_ms": 120}).open()
    b.driver.configure(500.0, ["0"])
    b.driver.set_limits("0", torque_nm=40.0, position_min_rad=-1.0, position_max_rad=0.5)
    expected = {
        (0x1006, 0): 2000,
        (0x1016, 1): 127 << 16 | 120,
        (0x1017, 0): 100,
        (0x6007, 0): 3,
        (0x605A, 0): 6,
        (0x60A9, 0): 0xFDB44700,
        (0x60C2, 2): -3,
        (0x60C2, 1): 2,
        (0x6060, 0): 8,
        (0x6072, 0): 800,
        (0x607D, 1): round(-1.0 / RAD),
        (0x607D, 2): round(0.5 / RAD),
        (0x1A00, 0): 3,
        (0x1A00, 1): 0x60410010,
        (0x1A00, 2): 0x60640020,
        (0x1A00, 3): 0x60770010,
        (0x1800, 1): 0x40000181,
        (0x1800, 2): 1,
        (0x1600, 2): 0x607A0020,
        (0x1400, 1): 0x201,
    }
    assert {key: drive.values[key] for key in expected} == expected
    requests = [struct.unpack_from("<BHB", data) for can_id, data in b.bus.sent if can_id == 0x601]
    for at, (command, *address) in enumerate(requests):
        if command >> 5 == 1 and address != [0x607A, 0]:
            assert [command >> 5 == 2 and rest == address for command, *rest in requests[at + 1 : at + 2]] == [True]


def test_decelerations_keep_their_worth_when_the_velocity_unit_changes():
    drive = ScriptedDrive(1)
    Bench(drive).open().driver.configure(1000.0, ["0"])
    assert (drive.values[0x6084, 0], drive.values[0x6085, 0]) == (100_000, 200_000)


def test_a_fixed_coarse_velocity_unit_is_lived_with():
    drive = ScriptedDrive(1, refuses={(0x60A9, 0): 0x06010002})
    b = Bench(drive).open()
    b.driver.configure(1000.0, ["0"])
    unit = b.driver.frame_map().joints[0].velocity_rad_s_per_unit
    assert unit == pytest.approx(2 * math.pi / 60)
    assert drive.values[0x6085, 0] == 200


@pytest.mark.parametrize("direction", [1, -1])
def test_limits_follow_the_direction(direction):
    drive = ScriptedDrive(1)
    b = Bench(drive, direction=direction).open()
    b.driver.configure(1000.0, ["0"])
    b.driver.set_limits("0", torque_nm=60.0, position_min_rad=-1.0, position_max_rad=0.5)
    low, high = (-1.0, 0.5) if direction == 1 else (-0.5, 1.0)
    assert (drive.values[0x607D, 1], drive.values[0x607D, 2]) == (round(low / RAD), round(high / RAD))


@pytest.mark.parametrize("key", [(0x1017, 0), (0x1A00, 2), (0x1800, 2)])
def test_a_value_that_reads_back_otherwise_is_refused(key):
    drive = ScriptedDrive(4, reads_back={key: 5})
    b = Bench(drive).open()
    with pytest.raises(HardwareError) as caught:
        b.driver.configure(1000.0, ["0"])
    assert "node 4" in caught.value.where and f"{key[0]:04X}:{key[1]:02X}" in caught.value.where
    assert "wrote" in caught.value.what and "read back" in caught.value.what


@pytest.mark.parametrize("key", [(0x6072, 0), (0x607D, 1), (0x607D, 2)])
def test_a_limit_that_reads_back_otherwise_is_refused(key):
    b = Bench(ScriptedDrive(4, reads_back={key: 5})).open()
    b.driver.configure(1000.0, ["0"])
    with pytest.raises(HardwareError, match=r"wrote .*, read back") as caught:
        b.driver.set_limits("0", torque_nm=60.0, position_min_rad=-1.0, position_max_rad=0.5)
    assert f"{key[0]:04X}:{key[1]:02X}" in caught.value.where
    b.driver.close()


def test_a_refused_write_is_named():
    b = Bench(ScriptedDrive(1, refuses={(0x1017, 0): 0x06090030})).open()
    with pytest.raises(HardwareError, match=r"refuses heartbeat producer, ms = 100.*0609") as caught:
        b.driver.configure(1000.0, ["0"])
    assert "1017:00" in caught.value.where


@pytest.mark.parametrize(
    ("key", "words"),
    [
        ((0x6007, 0), "does not stop when the host is lost"),
        ((0x1016, 1), "does not watch over the host"),
        ((0x6065, 0), "only the host watches the following error"),
        ((0x1006, 0), "does not know the period of SYNC"),
    ],
)
@pytest.mark.parametrize("how", ["refuses", "reads_back"])
def test_what_is_nice_to_have_is_gone_without_and_told(key, words, how):
    drive = ScriptedDrive(1, **{how: {key: 0x06010002 if how == "refuses" else 77}})
    b = Bench(drive).open()
    b.driver.configure(500.0, ["0"])
    (remark,) = b.driver.remarks()
    assert words in remark.message and remark.subject == "joint 0"
    watched = key[0] not in (0x1016, 0x6007)
    assert b.driver.capabilities().drive_watchdog is watched
    assert (Mode.TORQUE in b.driver.capabilities().modes) is watched


def test_a_stop_that_would_do_as_well_is_no_remark():
    drive = ScriptedDrive(1, refuses={(0x605A, 0): 0x06090030, (0x6066, 0): 0x06090031})
    b = Bench(drive).open()
    b.driver.configure(500.0, ["0"])
    assert not b.driver.remarks() and drive.values[0x605A, 0] == 2 and drive.values[0x6066, 0] == 0


def test_what_was_changed_is_put_back():
    drive = ScriptedDrive(1)
    drive.values[0x1016, 1] = 127 << 16 | 200  # left over from a run that was cut off
    before = dict(drive.values)
    b = Bench(drive).open().start().power()
    b.driver.stop_cycling()
    b.driver.configure(500.0, [])
    b.driver.set_limits("0", torque_nm=20.0, position_min_rad=-1.0, position_max_rad=1.0)
    b.driver.close()
    changed = {f"{i:04X}:{s:02X}" for (i, s), value in drive.values.items() if value != before[i, s]}
    assert changed <= {"1016:01", "6060:00", "6061:00", "6064:00", "6040:00", "607A:00"}
    assert drive.values[0x1016, 1] == 0


def test_the_interpolation_time_is_written_in_ms_and_only_where_it_differs():
    drive = ScriptedDrive(1, refuses={(0x60C2, 1): 0x06010002, (0x60C2, 2): 0x06010002})
    b = Bench(drive).open()
    b.driver.configure(1000.0, ["0"])
    assert not b.driver.remarks()
    with pytest.raises(HardwareError, match=r"interpolates over 1 ms \(60C2\), the cycle is 2 ms") as caught:
        b.driver.configure(500.0, ["0"])
    assert "1000 Hz" in caught.value.next_step


def test_a_period_that_the_drive_cannot_interpolate_over_is_refused_and_foreseen():
    drive = ScriptedDrive(1)
    drive.values[0x1018, 1] = 0x26C  # takes whole milliseconds only
    b = Bench(drive, setup=replace(bench(1).setup, cycle_hz=400.0)).open()
    errors = [one.message for one in b.driver.check(None) if one.severity is Severity.ERROR]
    assert any("interpolates over 2 ms (60C2), the cycle is 2.5 ms" in one for one in errors)
    with pytest.raises(HardwareError, match="interpolates over 2 ms") as info:
        b.driver.configure(400.0, ["0"])
    assert "use 500 Hz" in info.value.next_step


@pytest.mark.parametrize("cycle_hz", [77, 125, 300, 333, 400, 700, 1000])
def test_every_rate_can_be_interpolated_over_where_all_powers_of_ten_are_taken(cycle_hz):
    b = bench(1).open()
    b.driver.configure(float(cycle_hz), ["0"])
    values = b.drives[0].values
    assert values[0x60C2, 1] * 10.0 ** values[0x60C2, 2] * cycle_hz == pytest.approx(1.0, abs=0.02)


def test_a_rate_without_whole_milliseconds_takes_a_finer_unit():
    drive = ScriptedDrive(1)
    Bench(drive).open().driver.configure(400.0, ["0"])
    assert (drive.values[0x60C2, 1], drive.values[0x60C2, 2]) == (25, -4)


def test_a_tighter_torque_limit_stays_unless_the_robot_file_says_otherwise():
    for options, per_mille in (({}, 100), ({"raise_torque_limit": True}, 1200)):
        drive = ScriptedDrive(1)
        drive.values[0x6072, 0] = 100
        b = Bench(drive, joint_options=options).open()
        b.driver.configure(1000.0, ["0"])
        b.driver.set_limits("0", torque_nm=60.0, position_min_rad=-1.0, position_max_rad=1.0)
        assert drive.values[0x6072, 0] == per_mille


def test_position_limits_are_never_widened_without_a_key_and_never_written_empty():
    drive = ScriptedDrive(1)
    drive.values[0x607D, 1], drive.values[0x607D, 2] = -1000, 1000
    b = Bench(drive).open()
    b.driver.configure(1000.0, ["0"])
    b.driver.set_limits("0", torque_nm=60.0, position_min_rad=-1.0, position_max_rad=500 * RAD)
    assert (drive.values[0x607D, 1], drive.values[0x607D, 2]) == (-1000, 500)
    with pytest.raises(HardwareError, match=r"are 0\.\.0 in the drive's units"):
        b.driver.set_limits("0", torque_nm=60.0, position_min_rad=-RAD / 9, position_max_rad=RAD / 9)


def test_an_object_that_cannot_be_mapped_is_left_out():
    class Strict(ScriptedDrive):
        def sdo(self, request):
            if request[0] >> 5 == 1 and request[4:] == bytes.fromhex("10003F60"):
                return self.abort(*struct.unpack_from("<HB", request, 1), 0x06040041)
            return super().sdo(request)

    b = Bench(Strict(1)).open().start().power()
    reports = b.driver.frame_map().joints[0].reports
    assert [str(entry) for entry in reports[-1].entries] == ["6061:00 i8"]


def test_a_drive_that_takes_few_transmission_types_reports_on_every_sync():
    class Strict(ScriptedDrive):
        def sdo(self, request):
            index, sub = struct.unpack_from("<HB", request, 1)
            if request[0] >> 5 == 1 and 0x1800 <= index < 0x1810 and sub == 2 and request[4] not in (1, 253, 255):
                return self.abort(index, sub, 0x06090030)
            return super().sdo(request)

    b = Bench(Strict(1), Strict(2)).open()
    b.driver.configure(500.0, ["0"])
    assert b.drives[1].values[0x1800, 2] == b.drives[1].values[0x1802, 2] == 1
    with pytest.raises(PlanRefused):
        b.driver.configure(1000.0, ["0"])


def test_interpolated_position_mode_takes_the_place_of_csp():
    drive = ScriptedDrive(1)
    drive.values[0x6502, 0] = 0x43
    for sub, form in ((0, "<B"), (1, "<i")):
        OBJECTS[0x60C1, sub] = (form, 1)
        drive.values[0x60C1, sub] = 0
    b = Bench(drive).open().start().power()
    b.cycle()
    assert drive.values[0x6060, 0] == 7 and drive.controlwords[-1] == 0x1F
    b.set_points[0].position_rad = 50 * RAD
    b.cycle(2)
    assert drive.values[0x60C1, 1] == 50 and b.feedback[0].mode is Mode.POSITION
    del OBJECTS[0x60C1, 0], OBJECTS[0x60C1, 1]


def test_a_drive_that_supervises_its_rpdos_hears_them_again():
    OBJECTS[0x1400, 5] = ("<H", 0)
    drive = ScriptedDrive(1)
    drive.values[0x1400, 5] = 60
    b = Bench(drive, ScriptedDrive(2)).open().start(active=["1"]).power()
    b.driver.lock("0")
    b.cycle(100)
    drive.commands.clear()
    b.cycle(200)
    assert 8 <= sum(number == 0 for number, _ in drive.commands) <= 12
    del OBJECTS[0x1400, 5]


def test_a_powered_drive_is_not_touched():
    drive = ScriptedDrive(1)
    drive.values[0x6041, 0] = 0x0237
    b = Bench(drive).open()
    assert any("already on" in finding.message for finding in b.driver.check(None))
    before = len(b.bus.sent)
    with pytest.raises(HardwareError, match="power stage is already on"):
        b.driver.configure(1000.0, ["0"])
    assert not [can_id for can_id, data in b.bus.sent[before:] if can_id < 0x600 or data[0] >> 5 == 1]


def test_a_drive_that_its_watchdog_stopped_is_switched_off_and_used():
    drive = ScriptedDrive(1)
    drive.values[0x6041, 0], drive.values[0x603F, 0] = 0x0217, 0x8130
    b = Bench(drive).open()
    findings = b.driver.check(None)
    assert any("an earlier run was cut off" in finding.message for finding in findings)
    assert not [finding for finding in findings if finding.severity is Severity.ERROR]
    b.driver.configure(1000.0, ["0"])
    assert drive.values[0x6041, 0] == 0x0250


def test_a_drive_that_stays_in_quick_stop_is_told():
    drive = ScriptedDrive(1, refuses={(0x6040, 0): 0x08000021})
    drive.values[0x6041, 0] = 0x0217
    with pytest.raises(HardwareError, match="controlword"):
        Bench(drive).open().driver.configure(1000.0, ["0"])


def test_a_layout_that_no_wire_can_carry_is_refused_with_the_rate_that_fits():
    b = bench(*range(1, 7)).open()
    with pytest.raises(PlanRefused, match=r"6 of 6 joints.*% on average") as caught:
        b.driver.configure(1000.0, [str(joint) for joint in range(6)])
    assert not [data for can_id, data in b.bus.sent if can_id < 0x600 or data[0] >> 5 == 1]
    rate = float(caught.value.next_step.split("at most ")[1].split(" Hz")[0])
    assert 250 <= rate < 340
    b.driver.configure(rate, [str(joint) for joint in range(6)])


def test_half_the_bitrate_refuses_1_khz():
    b = bench(*range(1, 7), options={"bitrate": 500_000}).open()
    with pytest.raises(PlanRefused):
        b.driver.configure(1000.0, ["0"])
    assert b.driver.capabilities().max_cycle_hz < 600


def test_the_second_joint_costs_only_what_differs():
    b = bench(*range(1, 7)).open()
    b.driver.configure(1000.0, ["0"])
    first = len(b.bus.sent)
    b.driver.configure(1000.0, ["1"])
    second = len(b.bus.sent) - first
    assert second < 0.25 * first
    assert b.drives[1].values[0x1800, 2] == 1 and b.drives[0].values[0x1800, 2] == 10


def test_a_drive_that_was_reset_is_configured_anew():
    b = bench(1).open()
    b.driver.configure(1000.0, ["0"])
    b.drives[0].values[0x1A00, 0] = 0
    b.drives[0].values[0x1800, 1] |= 1 << 31
    b.bus.put(0x701, b"\x00")
    b.driver.configure(1000.0, ["0"])
    assert b.drives[0].values[0x1A00, 0] == 3


def test_unused_pdos_are_switched_off():
    drive = ScriptedDrive(1)
    drive.values[0x1803, 1] = 0x481
    Bench(drive).open().driver.configure(1000.0, ["0"])
    assert drive.values[0x1803, 1] >> 31
