"""An object and what it means to us, as robot files, frame maps and PDOs name it: ``2401:00 i16 external_torque``."""

from __future__ import annotations

import re
from dataclasses import dataclass

from frictid_drivers.cia402 import objects as od
from frictid_drivers.cia402.objects import IntegerType

STATUS, MODE, ERROR, INPUTS = "status", "mode", "error", "digital_inputs"
FIGURES = {
    "position": "position_rad_per_unit",
    "velocity": "velocity_rad_s_per_unit",
    "torque": "torque_nm_per_unit",
    "external_torque": "external_torque_nm_per_unit",
    "temperature": "temperature_c_per_unit",
}
"""Reported meanings that are multiplied by a factor, and the factor's key."""

_MEANINGS = {
    od.STATUSWORD.index: STATUS,
    od.MODE_DISPLAY.index: MODE,
    od.ERROR_CODE.index: ERROR,
    od.DIGITAL_INPUTS.index: INPUTS,
    od.POSITION_ACTUAL.index: "position",
    od.VELOCITY_ACTUAL.index: "velocity",
    od.TORQUE_ACTUAL.index: "torque",
    od.CONTROLWORD.index: "controlword",
    od.MODE.index: "target_mode",
    od.TARGET_POSITION.index: "target_position",
    od.INTERPOLATED_TARGET.index: "target_position",
    od.TARGET_VELOCITY.index: "target_velocity",
    od.TARGET_TORQUE.index: "target_torque",
    od.TORQUE_OFFSET.index: "torque_offset",
}
_KNOWN = {*_MEANINGS.values(), *FIGURES}
_ENTRY = re.compile(r"^([0-9A-Fa-f]{4}):([0-9A-Fa-f]{2}) ([iu][0-9]{1,2})(?: (\w+))?$", re.ASCII)


@dataclass(frozen=True, slots=True)
class Entry:
    """One object, and its meaning.

    Attributes:
        index: object.
        sub: sub-index.
        type: integer type.
        meaning: what it is to us, "" when it is skipped.
    """

    index: int
    sub: int
    type: IntegerType
    meaning: str = ""

    @staticmethod
    def of(item: od.Object, meaning: str = "") -> Entry:
        """The entry of a known object; its meaning by index unless given."""
        return Entry(item.index, item.sub, item.type, meaning or _MEANINGS.get(item.index, ""))

    @staticmethod
    def parse(text: str) -> Entry:
        """``"6064:00 i32"`` or ``"2401:00 i16 external_torque"``.

        Raises:
            ValueError: not of that form, or an unknown meaning.
        """
        match = _ENTRY.match(text)
        if match is None:
            raise ValueError(f"{text!r} is not of the form '6064:00 i32' or '2401:00 i16 external_torque'")
        index = int(match.group(1), 16)
        meaning = match.group(4) or _MEANINGS.get(index, "")
        if meaning and meaning not in _KNOWN:
            raise ValueError(f"{text!r}: unknown meaning {meaning!r}; known: {', '.join(sorted(_KNOWN))}")
        return Entry(index, int(match.group(2), 16), IntegerType.parse(match.group(3)), meaning)

    def __str__(self) -> str:
        meaning = f" {self.meaning}" if self.meaning and self.meaning != _MEANINGS.get(self.index) else ""
        return f"{self.index:04X}:{self.sub:02X} {self.type}{meaning}"
