"""The simulated drive's objects: index, name, type, access and default of everything it knows, as one table.

The table is the single source of the object dictionary and of the shipped EDS file. Facts are those of CiA 301 (1000h
to 1FFFh), CiA 402 (6000h and up) and, from 2000h on, our own.

Units, because they are where drives differ:

- position (6064h, 607Ah, 60B0h, 6065h, 607Dh): motor encoder increments; 6092h / (608Fh x 6091h) says so;
- velocity (606Ch, 60FFh, 60B1h): 60A9h, of the shaft **behind** the gear of 6091h;
- acceleration (6084h, 6085h): 60A9h units per second;
- torque (6077h, 6071h, 6072h, 60B2h): per mille of 6076h, which is motor-side mN m.

Of the offsets, 60B0h is added to 607Ah in CSP, 60B1h to 60FFh in CSV (the position loop forms its own velocity
feed-forward, 2021h:01), and 60B2h is added as torque in every mode.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import Any


class DataType(IntEnum):
    """CiA 301 data type codes."""

    I8 = 0x02
    I16 = 0x03
    I32 = 0x04
    U8 = 0x05
    U16 = 0x06
    U32 = 0x07
    STRING = 0x09


I8, I16, I32 = DataType.I8, DataType.I16, DataType.I32
U8, U16, U32, STRING = DataType.U8, DataType.U16, DataType.U32, DataType.STRING

SIZE_BYTES = {I8: 1, I16: 2, I32: 4, U8: 1, U16: 2, U32: 4}
SIGNED = frozenset({I8, I16, I32})
DUMMIES = {kind.value: kind for kind in SIZE_BYTES}
"""Data types that an RPDO may map to leave a gap (CiA 301, dummy mapping)."""

PDO_COUNT = 4
PDO_NOT_VALID = 1 << 31
PDO_NO_RTR = 1 << 30
MAX_MAPPED = 8
ERROR_HISTORY = 8

Value = int | str
Key = int  # an object's address: index << 8 | subindex


def key(index: int, subindex: int = 0) -> Key:
    """Index and subindex as one number."""
    return index << 8 | subindex


def key_text(address: Key) -> str:
    """As people write it: ``6091:01``."""
    return f"{address >> 8:04X}:{address & 0xFF:02X}"


@dataclass(frozen=True, slots=True)
class Entry:
    """One value of the object dictionary."""

    key: Key
    name: str
    kind: DataType
    access: str = "rw"  # ``ro``, ``rw``, ``wo`` or ``const``
    default: Value = 0
    node_relative: bool = False  # the node id is added to the default
    receive: bool = False  # may be mapped into an RPDO
    transmit: bool = False  # may be mapped into a TPDO
    low: int | None = None  # smallest value accepted, None for the type's own
    high: int | None = None  # largest value accepted, None for the type's own

    @property
    def limits(self) -> tuple[int, int]:
        """Smallest and largest value accepted of a number."""
        bits = 8 * SIZE_BYTES[self.kind]
        low, high = (-(1 << bits - 1), (1 << bits - 1) - 1) if self.kind in SIGNED else (0, (1 << bits) - 1)
        return (low if self.low is None else self.low, high if self.high is None else self.high)


@dataclass(frozen=True, slots=True)
class Record:
    """An object with its values, subindex 0 first; ``array``: all alike (CiA 301 object code 8), else a record (9)."""

    index: int
    name: str
    entries: tuple[Entry, ...]
    array: bool = False


@dataclass(frozen=True, slots=True)
class Manner:
    """What sets a family of drives apart from the standard servo, beyond its table of objects."""

    absent: frozenset[Key] = frozenset()  # objects that it does not have
    no_object: int = 0x06020000  # the abort code by which it says so
    transmission_types: tuple[int, ...] = ()  # those that its PDOs take; empty for all
    position_units_per_rad: float | None = None  # at the joint; None where 608Fh, 6091h and 6092h say it
    velocity_unit_rad_s: float | None = None  # at the joint; None where 60A9h says it
    mode_change_s: float = 0.0  # from 6060h to 6061h
    power_on_s: float = 0.0  # from "switched on" to "enabled"


STANDARD = Manner()


def _entry(
    address: Key,
    name: str,
    kind: DataType,
    access: str = "rw",
    default: Value = 0,
    flags: str = "",
    low: int | None = None,
    high: int | None = None,
) -> Entry:
    """Flags: R and T, may be mapped into an RPDO or TPDO; N, the node id is added."""
    return Entry(address, name, kind, access, default, "N" in flags, "R" in flags, "T" in flags, low, high)


def _variable(index: int, name: str, *rest: Any, **limits: Any) -> Record:
    return Record(index, name, (_entry(key(index), name, *rest, **limits),))


def _group(index: int, name: str, *rows: tuple[Any, ...], array: bool = False) -> Record:
    """Rows are what ``_entry`` takes after the address; the highest subindex is put first."""
    count = _entry(key(index), "Highest subindex", U8, "const", len(rows))
    return Record(index, name, (count, *(_entry(key(index, sub), *row) for sub, row in enumerate(rows, 1))), array)


def _pdo(number: int, *, transmit: bool) -> tuple[Record, Record]:
    """Communication and mapping parameter."""
    index, cob_id = (0x1800, PDO_NO_RTR | 0x180) if transmit else (0x1400, 0x200)
    index, cob_id, name = index + number, cob_id + 0x100 * number, f"{'T' if transmit else 'R'}PDO {number + 1}"
    communication = [
        _entry(key(index), "Highest subindex", U8, "const", 6 if transmit else 2),
        _entry(key(index, 1), "COB-ID", U32, "rw", PDO_NOT_VALID | cob_id, "N"),
        _entry(key(index, 2), "Transmission type", U8, "rw", 255),
    ]
    if transmit:
        communication += [
            _entry(key(index, 3), "Inhibit time", U16),
            _entry(key(index, 5), "Event timer", U16),
            _entry(key(index, 6), "SYNC start value", U8, high=240),
        ]
    mapping = [_entry(key(index + 0x200), "Number of mapped objects", U8, high=MAX_MAPPED)]
    mapping += [_entry(key(index + 0x200, sub), f"Mapped object {sub}", U32) for sub in range(1, MAX_MAPPED + 1)]
    return (
        Record(index, f"{name} communication parameter", tuple(communication)),
        Record(index + 0x200, f"{name} mapping parameter", tuple(mapping)),
    )


COMMUNICATION: tuple[Record, ...] = (
    _variable(0x1000, "Device type", U32, "const", 0x00020192),
    _variable(0x1001, "Error register", U8, "ro", 0, "T"),
    Record(
        0x1003,
        "Pre-defined error field",
        (
            _entry(key(0x1003), "Number of errors", U8),
            *(_entry(key(0x1003, n), f"Standard error field {n}", U32, "ro") for n in range(1, ERROR_HISTORY + 1)),
        ),
        array=True,
    ),
    _variable(0x1005, "COB-ID SYNC", U32, "rw", 0x80),
    _variable(0x1006, "Communication cycle period", U32, "rw", 0),
    _variable(0x1008, "Manufacturer device name", STRING, "const", "frictid virtual servo"),
    _variable(0x1009, "Manufacturer hardware version", STRING, "const", "simulated"),
    _variable(0x100A, "Manufacturer software version", STRING, "const", "1.0"),
    _group(0x1010, "Store parameters", ("Save all parameters", U32, "rw", 1), array=True),
    _group(0x1011, "Restore default parameters", ("Restore all default parameters", U32, "rw", 1), array=True),
    _variable(0x1014, "COB-ID EMCY", U32, "ro", 0x80, "N"),
    _group(
        0x1016,
        "Consumer heartbeat time",
        *[(f"Consumer heartbeat time {n}", U32, "rw", 0) for n in (1, 2)],
        array=True,
    ),
    _variable(0x1017, "Producer heartbeat time", U16, "rw", 0),
    _group(
        0x1018,
        "Identity object",
        ("Vendor-ID", U32, "const", 0),
        ("Product code", U32, "const", 0x46524943),
        ("Revision number", U32, "const", 0x00010000),
        ("Serial number", U32, "const", 1),
    ),
    _variable(0x1019, "Synchronous counter overflow value", U8, "rw", 0, high=240),
    _group(0x1029, "Error behaviour", ("Communication error", U8, "rw", 0, "", 0, 2), array=True),
    _group(
        0x1200,
        "SDO server parameter",
        ("COB-ID client to server", U32, "ro", 0x600, "N"),
        ("COB-ID server to client", U32, "ro", 0x580, "N"),
    ),
    *(record for number in range(PDO_COUNT) for record in _pdo(number, transmit=False)),
    *(record for number in range(PDO_COUNT) for record in _pdo(number, transmit=True)),
)

MANUFACTURER: tuple[Record, ...] = (
    _variable(0x2001, "Note", STRING, "rw", ""),
    _group(
        0x2010,
        "SYNC supervision",
        ("Longest gap in tenths of the communication cycle period", U16, "rw", 20, "", 11, 65535),
        ("Reaction: 0 none, 1 warning, 2 fault", U8, "rw", 2, "", 0, 2),
    ),
    _group(
        0x2020,
        "Friction compensation of the drive",
        ("Coulomb torque, per mille of 6076", U16, "rw", 0, "", 0, 1000),
        ("Viscous torque at the motor speed of 6080, per mille of 6076", U16, "rw", 0, "", 0, 1000),
    ),
    _group(
        0x2021,
        "Feed-forward of the drive",
        ("Velocity, percent of the position command's", U16, "const", 100),
        ("Inertia, 1e-6 kg m2 at the motor shaft", U32, "rw", 0),
    ),
    _group(
        0x2022,
        "Filters of the drive",
        ("Velocity low-pass time constant, us", U32, "ro", 0),
        ("Torque actual low-pass time constant, us", U32, "rw", 0, "", 0, 1_000_000),
    ),
    _variable(0x2023, "Frames of PDOs: 0 classical, 1 CAN FD with bit-rate switch", U8, "rw", 0, low=0, high=1),
    _variable(0x2030, "External torque, mN m behind the gear", I32, "ro", 0, "T"),
    _variable(0x2031, "Temperature, 0.1 degC", I16, "ro", 250, "T"),
    _group(
        0x2040,
        "Simulated hand",
        ("Grip: 0 released, 1 held", U8, "rw", 0, "", 0, 1),
        ("Centre, urad behind the gear", I32, "rw", 0),
        ("Amplitude, urad", U32, "rw", 0, "", 0, 6_283_185),
        ("Frequency, mHz", U32, "rw", 500, "", 0, 20_000),
    ),
    _variable(0x2041, "Simulated payload: 0 off, 1 mounted", U8, "rw", 0, low=0, high=1),
)

DRIVE: tuple[Record, ...] = (
    _variable(0x6007, "Abort connection option code", I16, "rw", 1, low=0, high=3),
    _variable(0x603F, "Error code", U16, "ro", 0, "T"),
    _variable(0x6040, "Controlword", U16, "rw", 0, "R"),
    _variable(0x6041, "Statusword", U16, "ro", 0, "T"),
    _variable(0x605A, "Quick stop option code", I16, "rw", 2, low=0, high=7),
    _variable(0x605B, "Shutdown option code", I16, "rw", 0, low=0, high=1),
    _variable(0x605C, "Disable operation option code", I16, "rw", 1, low=0, high=1),
    _variable(0x605D, "Halt option code", I16, "rw", 1, low=1, high=3),
    _variable(0x605E, "Fault reaction option code", I16, "rw", 2, low=0, high=3),
    _variable(0x6060, "Modes of operation", I8, "rw", 0, "R"),
    _variable(0x6061, "Modes of operation display", I8, "ro", 0, "T"),
    _variable(0x6062, "Position demand value", I32, "ro", 0, "T"),
    _variable(0x6064, "Position actual value", I32, "ro", 0, "T"),
    _variable(0x6065, "Following error window", U32, "rw", 100_000),
    _variable(0x6066, "Following error time out", U16, "rw", 10),
    _variable(0x606C, "Velocity actual value", I32, "ro", 0, "T"),
    _variable(0x6071, "Target torque", I16, "rw", 0, "R"),
    _variable(0x6072, "Max torque", U16, "rw", 3000, "R"),
    _variable(0x6074, "Torque demand", I16, "ro", 0, "T"),
    _variable(0x6075, "Motor rated current", U32, "rw", 1000),
    _variable(0x6076, "Motor rated torque", U32, "rw", 1000, low=1),
    _variable(0x6077, "Torque actual value", I16, "ro", 0, "T"),
    _variable(0x607A, "Target position", I32, "rw", 0, "R"),
    _group(
        0x607D,
        "Software position limit",
        ("Min position limit", I32, "rw", -(1 << 31)),
        ("Max position limit", I32, "rw", (1 << 31) - 1),
    ),
    _variable(0x6080, "Max motor speed, rpm of the motor", U32, "rw", 10_000, low=1),
    _variable(0x6084, "Profile deceleration", U32, "rw", 200_000, low=1),
    _variable(0x6085, "Quick stop deceleration", U32, "rw", 500_000, low=1),
    _group(
        0x608F,
        "Position encoder resolution",
        ("Encoder increments", U32, "rw", 131_072, "", 1),
        ("Motor revolutions", U32, "rw", 1, "", 1),
    ),
    _group(
        0x6091,
        "Gear ratio",
        ("Motor revolutions", U32, "rw", 1, "", 1),
        ("Shaft revolutions", U32, "rw", 1, "", 1),
    ),
    _group(
        0x6092,
        "Feed constant",
        ("Feed", U32, "rw", 131_072, "", 1),
        ("Shaft revolutions", U32, "rw", 1, "", 1),
    ),
    _variable(0x60A8, "SI unit position", U32, "const", 0x00B50000),
    _variable(0x60A9, "SI unit velocity", U32, "rw", 0x00B44700),
    _variable(0x60B0, "Position offset", I32, "rw", 0, "R"),
    _variable(0x60B1, "Velocity offset", I32, "rw", 0, "R"),
    _variable(0x60B2, "Torque offset", I16, "rw", 0, "R"),
    _group(0x60C1, "Interpolation data record", ("Set-point", I32, "rw", 0, "R")),
    _group(
        0x60C2,
        "Interpolation time period",
        ("Interpolation time period value", U8, "rw", 1, "", 1, 255),
        ("Interpolation time index", I8, "rw", -3, "", -6, 0),
    ),
    _variable(0x60F4, "Following error actual value", I32, "ro", 0, "T"),
    _variable(0x60FD, "Digital inputs", U32, "ro", 0, "T"),
    _group(
        0x60FE,
        "Digital outputs",
        ("Physical outputs", U32, "rw", 0, "R"),
        ("Bit mask", U32, "rw", 0),
    ),
    _variable(0x60FF, "Target velocity", I32, "rw", 0, "R"),
    _variable(0x6502, "Supported drive modes", U32, "const", 0x380),
    _variable(0x67FF, "Single device type", U32, "const", 0x00020192),
)

OBJECTS: tuple[Record, ...] = COMMUNICATION + MANUFACTURER + DRIVE  # every object of the drive, by rising index
