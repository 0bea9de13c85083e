"""Frame maps out of EDS files: values of the file, meanings of CiA 402, figures of the robot file."""

from __future__ import annotations

import struct

import pytest
from cia402_wire import OBJECTS, robot

from frictid_drivers.cia402.eds import frame_map_from_eds
from frictid_drivers.cia402.logs import LogDecoder
from frictid_hil.errors import HardwareError, InputFileError

TYPES = {"<B": 5, "<H": 6, "<I": 7, "<b": 2, "<h": 3, "<i": 4, "s": 9}
MAPPED = {
    (0x1800, 1): "$NODEID+0x180",
    (0x1801, 1): "$NODEID+0x280",
    (0x1400, 1): "$NODEID+0x200",
    (0x1A00, 0): 2,
    (0x1A00, 1): 0x60410010,
    (0x1A00, 2): 0x60640020,
    (0x1A01, 0): 3,
    (0x1A01, 1): 0x606C0020,
    (0x1A01, 2): 0x60770010,
    (0x1A01, 3): 0x20010010,
    (0x1600, 0): 2,
    (0x1600, 1): 0x60400010,
    (0x1600, 2): 0x607A0020,
}


def eds(path, **changes):
    """Write an EDS of the scripted drive's objects with the mapping above."""
    values = {key: (form, value) for key, (form, value) in OBJECTS.items()}
    values[0x2001, 0] = ("<h", 0)
    for key, value in (MAPPED | changes.get("values", {})).items():
        values[key] = (values[key][0], value)
    indices = sorted({index for index, _ in values})
    groups = {
        "MandatoryObjects": [index for index in indices if index in (0x1000, 0x1001, 0x1018)],
        "ManufacturerObjects": [index for index in indices if 0x2000 <= index < 0x6000],
        "OptionalObjects": [
            index for index in indices if not 0x2000 <= index < 0x6000 and index not in (0x1000, 0x1001, 0x1018)
        ],
    }
    lines = ["[FileInfo]", "FileName=drive.eds", "[DeviceInfo]", "VendorName=scripted"]
    for name, members in groups.items():
        lines += [f"[{name}]", f"SupportedObjects={len(members)}"]
        lines += [f"{at}=0x{index:04X}" for at, index in enumerate(members, start=1)]
    for index in indices:
        subs = sorted(sub for i, sub in values if i == index)
        if subs == [0]:
            form, value = values[index, 0]
            lines += [f"[{index:04X}]", f"ParameterName=Object {index:04X}", "ObjectType=0x7"]
            lines += [f"DataType=0x{TYPES[form]:04X}", "AccessType=rw", f"DefaultValue={shown(value)}", "PDOMapping=1"]
            continue
        lines += [f"[{index:04X}]", f"ParameterName=Object {index:04X}", "ObjectType=0x9", f"SubNumber={len(subs) + 1}"]
        if 0 not in subs:
            lines += [f"[{index:04X}sub0]", "ParameterName=count", "ObjectType=0x7", "DataType=0x0005"]
            lines += ["AccessType=ro", f"DefaultValue={max(subs)}", "PDOMapping=0"]
        for sub in subs:
            form, value = values[index, sub]
            lines += [f"[{index:04X}sub{sub:X}]", f"ParameterName=Sub {index:04X} {sub}", "ObjectType=0x7"]
            lines += [f"DataType=0x{TYPES[form]:04X}", "AccessType=rw", f"DefaultValue={shown(value)}", "PDOMapping=1"]
    path.write_text("\n".join(lines) + "\n")
    return path


def shown(value):
    return value.decode() if isinstance(value, bytes) else value


def test_frames_of_an_eds(tmp_path):
    frame_map = frame_map_from_eds(eds(tmp_path / "drive.eds"), robot(3, 7))
    first, second = frame_map.joints
    assert [frame.cob_id for frame in first.reports + first.commands] == [0x183, 0x283, 0x203]
    assert [frame.cob_id for frame in second.reports] == [0x187, 0x287]
    assert first.reports[1].meanings == ("velocity", "torque", "") and str(first.reports[1].entries[2].type) == "i16"
    assert first.torque_nm_per_unit == pytest.approx(0.05)
    log = [
        (0, 0x80, b""),
        (1, 0x183, struct.pack("<Hi", 0x0237, 1000)),
        (2, 0x283, struct.pack("<ihh", 5, -20, 9)),
    ]
    (row,) = LogDecoder(frame_map).rows(log)
    assert row.feedback[0].position_rad == 1000 * first.position_rad_per_unit
    assert row.feedback[0].torque_nm == pytest.approx(-1.0)


def test_an_eds_without_mapping_says_what_to_do(tmp_path):
    path = eds(tmp_path / "bare.eds", values={(0x1A00, 0): 0, (0x1A01, 0): 0})
    with pytest.raises(InputFileError, match="carries 6064") as caught:
        frame_map_from_eds(path, robot(3))
    assert "by hand" in caught.value.next_step


def test_an_eds_of_another_drive_is_refused(tmp_path):
    with pytest.raises(HardwareError, match="rated torque"):
        frame_map_from_eds(eds(tmp_path / "drive.eds", values={(0x6076, 0): 5000}), robot(3))


def test_an_eds_as_windows_writes_it_and_without_a_default_of_1000(tmp_path):
    path = eds(tmp_path / "drive.eds")
    text = path.read_text().replace(f"DefaultValue={OBJECTS[0x1000, 0][1]}\n", "", 1).replace("scripted", "Müller GmbH")
    path.write_bytes(text.encode("cp1252"))
    assert frame_map_from_eds(path, robot(3)).joints[0].reports


@pytest.mark.parametrize("content", [b"", b"\x00\xff\xfe garbage", b"[1000\n", b"[6064]\nDataType=what\n"])
def test_garbage_is_an_input_error(tmp_path, content):
    path = tmp_path / "garbage.eds"
    path.write_bytes(content)
    with pytest.raises((InputFileError, HardwareError)) as caught:
        frame_map_from_eds(path, robot(3))
    assert "garbage.eds" in str(caught.value)


def test_no_file(tmp_path):
    with pytest.raises(InputFileError, match="cannot be read"):
        frame_map_from_eds(tmp_path / "none.eds", robot(3))
