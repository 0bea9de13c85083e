"""Objects of CiA 301 and CiA 402 that this driver touches, by index: the names in vendors' EDS files differ."""

from __future__ import annotations

import re
import struct
from dataclasses import dataclass

_BITS = re.compile(r"^([iu])([1-9]|[1-5][0-9]|6[0-4])$", re.ASCII)
_PACKED = {"u8": "B", "i8": "b", "u16": "H", "i16": "h", "u32": "I", "i32": "i", "u64": "Q", "i64": "q"}


@dataclass(frozen=True, slots=True)
class IntegerType:
    """A CANopen integer: ``u16``, ``i32``, also the odd widths that PDOs may carry (``u1``, ``i24``)."""

    signed: bool
    bits: int

    @staticmethod
    def parse(text: str) -> IntegerType:
        """``"i16"`` to a type; ``ValueError`` where it is not ``i`` or ``u`` with 1 to 64 bits."""
        match = _BITS.match(text)
        if match is None:
            raise ValueError(f"{text!r} is not an integer type; expected i or u with 1..64 bits, e.g. i32, u16")
        return IntegerType(match.group(1) == "i", int(match.group(2)))

    def __str__(self) -> str:
        return f"{'i' if self.signed else 'u'}{self.bits}"

    @property
    def low(self) -> int:
        """Smallest value."""
        return -(1 << (self.bits - 1)) if self.signed else 0

    @property
    def high(self) -> int:
        """Largest value."""
        return (1 << (self.bits - self.signed)) - 1

    @property
    def code(self) -> str | None:
        """Format character of ``struct``, None for odd widths."""
        return _PACKED.get(str(self))

    def pack(self, value: int) -> bytes:
        """Little-endian bytes; whole bytes only."""
        return value.to_bytes(self.bits // 8, "little", signed=self.signed)

    def unpack(self, data: bytes) -> int:
        """Value of little-endian bytes; what some drives send beyond it is cut off. ``struct.error`` for too few."""
        size = self.bits // 8
        if len(data) < size:
            raise struct.error(f"{len(data)} bytes for {self}")
        return int.from_bytes(data[:size], "little", signed=self.signed)


@dataclass(frozen=True, slots=True)
class Object:
    """One entry of an object dictionary."""

    index: int
    sub: int
    type: IntegerType
    name: str

    @property
    def address(self) -> str:
        """As written in manuals and in our errors: ``6041:00``."""
        return f"{self.index:04X}:{self.sub:02X}"

    @property
    def mapping(self) -> int:
        """The 32-bit entry of 1600/1A00: index, sub-index, bits."""
        return self.index << 16 | self.sub << 8 | self.type.bits

    def __str__(self) -> str:
        return f"{self.address} ({self.name})"

    def at(self, sub: int) -> Object:
        """The same object's other sub-index."""
        return Object(self.index, sub, self.type, self.name)


def _object(index: int, sub: int, kind: str, name: str) -> Object:
    return Object(index, sub, IntegerType.parse(kind), name)


# CiA 301: communication
DEVICE_TYPE = _object(0x1000, 0, "u32", "device type")
ERROR_REGISTER = _object(0x1001, 0, "u8", "error register")
ERROR_HISTORY = _object(0x1003, 1, "u32", "last error")
SYNC_COB_ID = _object(0x1005, 0, "u32", "SYNC COB-ID")
SYNC_PERIOD_US = _object(0x1006, 0, "u32", "SYNC period, us")
HEARTBEAT_CONSUMERS = _object(0x1016, 0, "u8", "number of heartbeat consumers")
HEARTBEAT_CONSUMER = _object(0x1016, 1, "u32", "heartbeat consumer")
HEARTBEAT_PRODUCER_MS = _object(0x1017, 0, "u16", "heartbeat producer, ms")
VENDOR = _object(0x1018, 1, "u32", "vendor id")
PRODUCT = _object(0x1018, 2, "u32", "product code")
REVISION = _object(0x1018, 3, "u32", "revision")
SERIAL = _object(0x1018, 4, "u32", "serial number")
SYNC_OVERFLOW = _object(0x1019, 0, "u8", "SYNC counter overflow")
DEVICE_NAME, HARDWARE_VERSION, SOFTWARE_VERSION = 0x1008, 0x1009, 0x100A  # texts, read as such

# CiA 402: the power drive
ABORT_CONNECTION = _object(0x6007, 0, "i16", "abort connection option code")
ERROR_CODE = _object(0x603F, 0, "u16", "error code")
CONTROLWORD = _object(0x6040, 0, "u16", "controlword")
STATUSWORD = _object(0x6041, 0, "u16", "statusword")
QUICK_STOP_OPTION = _object(0x605A, 0, "i16", "quick stop option code")
MODE = _object(0x6060, 0, "i8", "modes of operation")
MODE_DISPLAY = _object(0x6061, 0, "i8", "modes of operation display")
POSITION_ACTUAL = _object(0x6064, 0, "i32", "position actual value")
FOLLOWING_WINDOW = _object(0x6065, 0, "u32", "following error window")
FOLLOWING_TIMEOUT_MS = _object(0x6066, 0, "u16", "following error time out, ms")
VELOCITY_ACTUAL = _object(0x606C, 0, "i32", "velocity actual value")
TARGET_TORQUE = _object(0x6071, 0, "i16", "target torque")
MAX_TORQUE = _object(0x6072, 0, "u16", "max torque")
RATED_TORQUE_MNM = _object(0x6076, 0, "u32", "motor rated torque, mN m")
TORQUE_ACTUAL = _object(0x6077, 0, "i16", "torque actual value")
TARGET_POSITION = _object(0x607A, 0, "i32", "target position")
POSITION_LIMIT_MIN = _object(0x607D, 1, "i32", "software position limit, min")
POSITION_LIMIT_MAX = _object(0x607D, 2, "i32", "software position limit, max")
PROFILE_DECELERATION = _object(0x6084, 0, "u32", "profile deceleration")
QUICK_STOP_DECELERATION = _object(0x6085, 0, "u32", "quick stop deceleration")
HOME_OFFSET = _object(0x607C, 0, "i32", "home offset")
POLARITY = _object(0x607E, 0, "u8", "polarity")
MAX_PROFILE_VELOCITY = _object(0x607F, 0, "u32", "max profile velocity")
PROFILE_VELOCITY = _object(0x6081, 0, "u32", "profile velocity")
PROFILE_ACCELERATION = _object(0x6083, 0, "u32", "profile acceleration")
ENCODER_INCREMENTS = _object(0x608F, 1, "u32", "encoder increments")
ENCODER_REVOLUTIONS = _object(0x608F, 2, "u32", "motor revolutions")
GEAR_MOTOR = _object(0x6091, 1, "u32", "gear ratio, motor revolutions")
GEAR_SHAFT = _object(0x6091, 2, "u32", "gear ratio, shaft revolutions")
FEED = _object(0x6092, 1, "u32", "feed constant, feed")
FEED_SHAFT = _object(0x6092, 2, "u32", "feed constant, shaft revolutions")
POSITION_UNIT = _object(0x60A8, 0, "u32", "SI unit position")
VELOCITY_UNIT = _object(0x60A9, 0, "u32", "SI unit velocity")
ACCELERATION_UNIT = _object(0x60AA, 0, "u32", "SI unit acceleration")
TORQUE_OFFSET = _object(0x60B2, 0, "i16", "torque offset")
INTERPOLATED_TARGET = _object(0x60C1, 1, "i32", "interpolation data record")
INTERPOLATION_VALUE = _object(0x60C2, 1, "u8", "interpolation time period, value")
INTERPOLATION_INDEX = _object(0x60C2, 2, "i8", "interpolation time period, index")
MAX_ACCELERATION = _object(0x60C5, 0, "u32", "max acceleration")
MAX_DECELERATION = _object(0x60C6, 0, "u32", "max deceleration")
DIGITAL_INPUTS = _object(0x60FD, 0, "u32", "digital inputs")
TARGET_VELOCITY = _object(0x60FF, 0, "i32", "target velocity")
SUPPORTED_MODES = _object(0x6502, 0, "u32", "supported drive modes")

INTERPOLATED = 7
"""Interpolated position mode: takes the place of cyclic synchronous position (8) where a drive lacks that."""

MODE_BITS = {7: 1 << 6, 8: 1 << 7, 9: 1 << 8, 10: 1 << 9}  # bit of 6502 for each mode of 6060

MILLI_RPM = 0xFDB44700  # 60A9: 10^-3 revolutions per minute, fine enough for friction work

PDO_COB_ID, PDO_TYPE, RPDO_TIMEOUT, PDO_SYNC_START = 1, 2, 5, 6
_PDO = {
    PDO_COB_ID: ("u32", "PDO COB-ID"),
    PDO_TYPE: ("u8", "PDO transmission type"),
    RPDO_TIMEOUT: ("u16", "RPDO event timer, ms"),
    PDO_SYNC_START: ("u8", "PDO SYNC start value"),
}


def pdo(transmit: bool, number: int, sub: int) -> Object:
    """1400/1800 of the PDO ``number`` (from 1)."""
    return _object((0x1800 if transmit else 0x1400) + number - 1, sub, *_PDO[sub])


def pdo_entry(transmit: bool, number: int, sub: int) -> Object:
    """1600/1A00: how many entries at 0, entries from 1."""
    kind, name = ("u32", "mapped object") if sub else ("u8", "number of mapped objects")
    return _object((0x1A00 if transmit else 0x1600) + number - 1, sub, kind, name)


STATUS, MODE_SHOWN, ERROR, INPUTS = "status", "mode", "error", "digital_inputs"  # reported meanings beside figures
FIGURES = {
    "position": "position_rad_per_unit",
    "velocity": "velocity_rad_s_per_unit",
    "torque": "torque_nm_per_unit",
    "external_torque": "external_torque_nm_per_unit",
    "temperature": "temperature_c_per_unit",
}
"""Reported meanings that are multiplied by a factor, and the factor's key."""

_MEANINGS = {
    STATUSWORD.index: STATUS,
    MODE_DISPLAY.index: MODE_SHOWN,
    ERROR_CODE.index: ERROR,
    DIGITAL_INPUTS.index: INPUTS,
    POSITION_ACTUAL.index: "position",
    VELOCITY_ACTUAL.index: "velocity",
    TORQUE_ACTUAL.index: "torque",
    CONTROLWORD.index: "controlword",
    MODE.index: "target_mode",
    TARGET_POSITION.index: "target_position",
    INTERPOLATED_TARGET.index: "target_position",
    TARGET_VELOCITY.index: "target_velocity",
    TARGET_TORQUE.index: "target_torque",
    TORQUE_OFFSET.index: "torque_offset",
}
_KNOWN = {*_MEANINGS.values(), *FIGURES}
_ENTRY = re.compile(r"^([0-9A-Fa-f]{4}):([0-9A-Fa-f]{2}) ([iu][0-9]{1,2})(?: (\w+))?$", re.ASCII)


@dataclass(frozen=True, slots=True)
class Entry:
    """An object and what it means to us, as robot files, frame maps and PDOs name it; "" when it is skipped."""

    index: int
    sub: int
    type: IntegerType
    meaning: str = ""

    @staticmethod
    def of(item: Object) -> Entry:
        """The entry of a known object."""
        return Entry(item.index, item.sub, item.type, _MEANINGS.get(item.index, ""))

    @staticmethod
    def parse(text: str) -> Entry:
        """``"6064:00 i32"`` or ``"2401:00 i16 external_torque"``; ``ValueError`` for another form or meaning."""
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
