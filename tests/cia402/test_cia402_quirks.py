"""What is known of drive families: shipped, beside the robot file, and by EDS; and how units are read."""

from __future__ import annotations

import math
import struct
from dataclasses import replace

import pytest
import yaml
from cia402_bench import Bench, bench
from cia402_wire import ScriptedDrive

from frictid_drivers.cia402.quirks import Catalogue, quirks_of_eds
from frictid_drivers.virtual.eds import EDS_FILE
from frictid_hil.errors import HardwareError, InputFileError
from frictid_hil.plan.mode import Mode
from frictid_hil.protocol.driver import Severity


def said(b):
    return "\n".join(f"{one.severity.value}: {one.message}" for one in b.driver.check(None))


def errors(b):
    return [one for one in b.driver.check(None) if one.severity is Severity.ERROR]


def test_shipped_quirks_apply_by_vendor():
    assert Catalogue().of(0x26C, 1, 1).interpolation_exponent == -3
    assert Catalogue().of(0x123, 1, 1).names == ()


def test_a_file_beside_the_robot_file_adds_to_them_and_the_closest_entry_wins(tmp_path):
    (tmp_path / "quirks.yaml").write_text(
        "schema: frictid.quirks/1\ndrives:\n"
        "- {name: mine, vendor: 0x123, product: 0x456, transmission_types: [1, 255], velocity_unit: rpm}\n"
        "- {name: all of them, vendor: 0x123, velocity_unit: position, read_only: ['60C2:02']}\n"
    )
    found = Catalogue(tmp_path).of(0x123, 0x456, 9)
    assert found.names == ("all of them", "mine") and found.velocity_unit == "rpm"
    assert found.read_only == {(0x60C2, 2)} and not found.sends_on(10) and found.sends_on(1)
    b = bench(1)
    b = Bench(ScriptedDrive(1), setup=replace(b.setup, folder=tmp_path)).open()
    assert "known of this drive: all of them, mine" in said(b)
    b.driver.configure(500.0, [])
    assert b.drives[0].values[0x1800, 2] == 1


@pytest.mark.parametrize(
    "text",
    ["", "[1", "schema: frictid.quirks/1\ndrives: 3", "schema: frictid.quirks/1\ndrives: [{vendor: x}]",
     "schema: frictid.quirks/1\ndrives: [{vendor: 1, colour: red}]",
     "schema: frictid.quirks/1\ndrives: [{vendor: 1, read_only: [6041]}]",
     "schema: frictid.quirks/1\ndrives: [{vendor: 1, limits: {'60C2:01': [1]}}]",
     "schema: frictid.quirks/1\ndrives: [{vendor: 1, velocity_unit: fast}]"],
)  # fmt: skip
def test_a_wrong_file_is_told(tmp_path, text):
    (tmp_path / "quirks.yaml").write_text(text)
    with pytest.raises(InputFileError, match=r"quirks\.yaml"):
        Catalogue(tmp_path)


def known_to_be(folder, drive, **facts):
    """A bench that knows this of the drive."""
    told = {"schema": "frictid.quirks/1", "drives": [{"name": "mine", "vendor": 0x123, **facts}]}
    (folder / "quirks.yaml").write_text(yaml.safe_dump(told))
    return Bench(drive, setup=replace(bench(1).setup, folder=folder)).open()


def test_a_torque_that_is_not_per_mille_of_the_rated_one(tmp_path):
    b = known_to_be(tmp_path, ScriptedDrive(1), torque_unit_mnm=5.0)
    assert b.driver.identify()["0"].torque_resolution_nm == pytest.approx(5e-3 * b.setup.joints[0].gear_ratio)


@pytest.mark.parametrize("known", [True, False])
def test_a_drive_that_shows_its_mode_only_under_power(tmp_path, known):
    class Shy(ScriptedDrive):
        def sync(self, data):
            powered = self.values[0x6041, 0] == 0x0237
            self.values[0x6061, 0] = self.values[0x6060, 0] if powered else 0
            return super().sync(data)

    drive = Shy(1)
    drive.shows_mode = False
    b = known_to_be(tmp_path, drive, mode_when_enabled=known).start()
    if known:
        assert b.power().cycle(20)[0].mode is Mode.POSITION
    else:
        with pytest.raises(AssertionError):
            b.power()


def test_a_drive_that_takes_its_time_to_answer(tmp_path):
    b = known_to_be(tmp_path, ScriptedDrive(1), sdo_timeout_s=2.0)
    assert b.driver._reached().drives["0"]._sdo.RESPONSE_TIMEOUT == 2.0


def test_an_eds_tells_access_limits_types_and_mapping():
    found = quirks_of_eds(EDS_FILE, 1)
    assert (0x6041, 0) in found.read_only and (0x6041, 0) not in found.not_mappable
    assert (0x6072, 0) not in found.not_mappable and (0x6066, 0) in found.not_mappable
    assert found.limits[0x60C2, 2] == (-6, 0) and str(found.types[0x60B2, 0]) == "i16"


def test_what_is_known_to_be_refused_is_foreseen():
    drive = ScriptedDrive(1, refuses={(0x60C2, 2): 0x06010002})
    drive.values[0x1018, 1] = 0x1097
    b = Bench(drive).open()
    assert not errors(b)
    drive.values[0x60C2, 2] = -2
    b = Bench(drive).open()
    (error,) = errors(b)
    assert "interpolates over 10 ms" in error.message
    with pytest.raises(HardwareError, match=r"interpolates over 10 ms"):
        b.driver.configure(1000.0, ["0"])


@pytest.mark.parametrize("index", [0x6040, 0x6041, 0x6064, 0x606C, 0x6077, 0x1017])
def test_what_is_missing_is_foreseen(index):
    b = Bench(ScriptedDrive(1, without={index})).open()
    if index == 0x6041:
        with pytest.raises(HardwareError, match="no statusword"):
            b.driver.check(None)
    else:
        assert any(f"{index:04X}:00" in error.message for error in errors(b))
    with pytest.raises(HardwareError, match=f"{index:04X}:00"):
        b.driver.configure(1000.0, ["0"])


@pytest.mark.parametrize("code", [0x06010000, 0x08000000, 0x06010001, 0x06020000])
def test_an_optional_object_is_absent_however_the_drive_says_so(code):
    class Curt(ScriptedDrive):
        def sdo(self, request):
            if request[1:3] == bytes.fromhex("6560"):
                return self.abort(0x6065, 0, code)
            return super().sdo(request)

    b = Bench(Curt(1)).open()
    assert "the drive has no 6065:00" in said(b)
    b.driver.configure(1000.0, ["0"])


TENTH_OF_A_DEGREE, INCREMENTS = 0xFF410000, 0x00B50000


@pytest.mark.parametrize(
    ("values", "per_turn"),
    [
        ({(0x60A8, 0): TENTH_OF_A_DEGREE}, 3600),
        ({(0x60A8, 0): TENTH_OF_A_DEGREE, (0x6091, 1): 1}, 3600 * 50),
        ({(0x60A8, 0): INCREMENTS}, 4096 * 50),
        ({(0x6092, 1): 1, (0x6092, 2): 1}, 4096 * 50),
        ({(0x6092, 1): 360_000, (0x6092, 2): 1}, 360_000),
    ],
)
def test_position_units(values, per_turn):
    from cia402_wire import OBJECTS

    extra = {key: ("<I", 0) for key in values if key not in OBJECTS}
    OBJECTS.update(extra)
    try:
        drive = ScriptedDrive(1)
        drive.values.update(values)
        for key in extra:
            if key not in values:
                drive.values.pop(key)
        b = Bench(drive)
        identity = b.open().driver.identify()["0"]
        assert identity.position_resolution_rad == pytest.approx(2 * math.pi / per_turn)
        coarse = 360 / per_turn > 0.02
        assert any("absurdly coarse" in error.message for error in errors(b)) is coarse
    finally:
        for key in extra:
            del OBJECTS[key]


def test_a_home_offset_is_told():
    from cia402_wire import OBJECTS

    OBJECTS[0x607C, 0] = ("<i", 0)
    try:
        drive = ScriptedDrive(1)
        drive.values[0x607C, 0] = 4096 * 50 // 4
        assert "warning: positions are shifted by a home offset of 90 deg (607C)" in said(Bench(drive).open())
    finally:
        del OBJECTS[0x607C, 0]


@pytest.mark.parametrize(("polarity", "severity"), [(0x80, "error"), (0x40, "error"), (0xC0, "warning")])
def test_polarity(polarity, severity):
    from cia402_wire import OBJECTS

    OBJECTS[0x607E, 0] = ("<B", 0)
    try:
        drive = ScriptedDrive(1)
        drive.values[0x607E, 0] = polarity
        assert f"{severity}: position and velocity" in said(Bench(drive).open())
    finally:
        del OBJECTS[0x607E, 0]


def test_torque_mode_needs_a_watch_and_something_that_follows_from_it():
    b = Bench(ScriptedDrive(1, without={0x6007})).open()
    assert not b.driver.capabilities().drive_watchdog
    assert "no abort connection option (6007)" in said(b)


class OtherLength(ScriptedDrive):
    """6066 of 32 bits and 6065 of 16, and strict about it."""

    def sdo(self, request):
        if request[1:4] == bytes.fromhex("666000") and request[0] == 0x40:
            return bytes.fromhex("43666000") + struct.pack("<I", self.values[0x6066, 0])
        if request[1:4] == bytes.fromhex("666000") and request[0] != 0x23:
            return self.abort(0x6066, 0, 0x06070013)
        if request[1:4] == bytes.fromhex("656000") and request[0] == 0x40:
            return bytes.fromhex("4B656000") + struct.pack("<HH", self.values[0x6065, 0] & 0xFFFF, 0)
        if request[1:4] == bytes.fromhex("656000") and request[0] != 0x2B:
            return self.abort(0x6065, 0, 0x06070012)
        return super().sdo(request)


def test_an_object_of_another_length_is_written_as_the_drive_has_it():
    drive = OtherLength(1)
    drive.values[0x6065, 0] = 40_000
    b = Bench(drive).open()
    before = said(b)
    assert not errors(b)
    b.driver.configure(1000.0, ["0"])
    assert drive.values[0x6066, 0] == 20
    assert all(remark.message in before for remark in b.driver.remarks())
