"""A frame map out of a drive's EDS or DCF file: for logs of drives that we never configured.

The mapping is that of the file's parameter values, or its defaults; figures that an EDS cannot know (gear ratio,
direction, rated torque where 6076 has no default) come from the robot file.
"""

from __future__ import annotations

from pathlib import Path

from canopen.objectdictionary import ODVariable

from frictid_drivers.cia402 import objects as od
from frictid_drivers.cia402.facts import read_facts
from frictid_drivers.cia402.frame_map import Frame, FrameMap, joint_frames
from frictid_drivers.cia402.objects import Entry, IntegerType, Object
from frictid_drivers.cia402.quirks import Catalogue, dictionary_of, integer_type
from frictid_drivers.cia402.scale import raise_on_error, scale_of
from frictid_drivers.cia402.settings import read_settings
from frictid_hil.errors import InputFileError
from frictid_hil.plan.setup import JointSetup, RobotSetup

_NOT_VALID = 1 << 31
_PDOS = range(1, 9)


class _File:
    """An object dictionary on disk, asked like a drive."""

    def __init__(self, path: Path, joint: JointSetup) -> None:
        self._dictionary = dictionary_of(path, joint.address)

    def variable(self, index: int, sub: int) -> ODVariable | None:
        found = self._dictionary.get_variable(index, sub)
        return found if isinstance(found, ODVariable) else None

    def find(self, item: Object) -> int | None:
        variable = self.variable(item.index, item.sub)
        if variable is None:
            return None
        value = variable.value if variable.value is not None else variable.default
        return value if isinstance(value, int) else None

    def find_text(self, index: int) -> str:
        variable = self.variable(index, 0)
        value = None if variable is None else variable.value or variable.default
        return value if isinstance(value, str) else ""


def frame_map_from_eds(path: Path, setup: RobotSetup) -> FrameMap:
    """The frames of a robot whose drives all have the mapping of one EDS or DCF file.

    ``InputFileError`` where it cannot be read or maps no position, ``HardwareError`` where the robot file contradicts.
    """
    _, options = read_settings(setup)
    joints = []
    for joint in setup.joints:
        file = _File(path, joint)
        if file.variable(od.POSITION_ACTUAL.index, 0) is None:
            raise InputFileError("describes no drive: it has no 6064", where=str(path))
        facts = read_facts(file, Catalogue(setup.folder).of)
        scale, findings = scale_of(facts, joint, facts.velocity_unit)
        raise_on_error(findings)
        mine = options[joint.name]
        told = (mine.external_torque_object, mine.temperature_object)
        meanings = {(entry.index, entry.sub): entry for entry in told if entry is not None}
        reports = _frames(file, True, meanings)
        if not any("position" in frame.meanings for frame in reports):
            raise InputFileError(
                "no valid TPDO of this file carries 6064",
                where=str(path),
                cause="the drive was mapped at run time",
                next_step="write a mapping file by hand, or export a DCF from the vendor's tool",
            )
        joints.append(joint_frames(joint, scale, mine, reports, _frames(file, False, meanings)))
    return FrameMap(tuple(joints))


def _frames(file: _File, transmit: bool, meanings: dict[tuple[int, int], Entry]) -> tuple[Frame, ...]:
    frames = []
    for number in _PDOS:
        cob_id = file.find(od.pdo(transmit, number, od.PDO_COB_ID))
        count = file.find(od.pdo_entry(transmit, number, 0)) or 0
        if cob_id is None or cob_id & _NOT_VALID or not count:
            continue
        words = [file.find(od.pdo_entry(transmit, number, sub)) or 0 for sub in range(1, count + 1)]
        entries = tuple(_entry(file, word, meanings) for word in words if word & 0xFF)
        if entries:
            frames.append(Frame(cob_id & 0x7FF, entries))
    return tuple(frames)


def _entry(file: _File, word: int, meanings: dict[tuple[int, int], Entry]) -> Entry:
    index, sub, bits = word >> 16, word >> 8 & 0xFF, min(word & 0xFF, 64)
    known = meanings.get((index, sub))
    if known is not None:
        return known
    variable = file.variable(index, sub)
    kind = None if variable is None else integer_type(variable)
    return Entry.of(Object(index, sub, IntegerType(kind is not None and kind.signed, bits), ""))
