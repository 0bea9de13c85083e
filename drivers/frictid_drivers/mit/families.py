"""What differs between families: identifiers, answers, states, parameters and watchdogs. One class each, no state.

=================  ======  =====================  ================================  ===============================
family             ids     state in each answer   watchdog                          what it can tell of itself
=================  ======  =====================  ================================  ===============================
damiao             11 bit  nibble of byte 0       register 9, in steps of 50 us     ranges, serial number, mode
robstride          29 bit  bits 16-23 of the id   parameter 7028h, 20000 = 1 s      position as a float, unit id
cybergear          29 bit  bits 16-23 of the id   parameter 200Ch, 20000 = 1 s      position as a float, unit id
robstride-mit      11 bit  none                   none before the firmware of 2026  nothing
cubemars           11 bit  error in byte 7        none documented                   nothing
=================  ======  =====================  ================================  ===============================
"""

from __future__ import annotations

import struct
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

from frictid_drivers.mit import frames
from frictid_drivers.mit.frames import FULL, Motion, Ranges
from frictid_hil.protocol.driver import EXTENDED, JointState

Frame = tuple[int, bytes]  # identifier with its flags, and data

WATCHDOG_PER_S = 20_000.0  # one second's worth of the parameter, in every family that has a watchdog
ON, OFF, CLEAR = b"\xff" * 7 + b"\xfc", b"\xff" * 7 + b"\xfd", b"\xff" * 7 + b"\xfb"


@dataclass(frozen=True, slots=True)
class Motor:
    """Where one actuator is and what its numbers mean."""

    id: int
    reply_id: int  # identifier (11 bit) or host id (29 bit) that its answers carry
    ranges: Ranges
    flags: int = 0  # of all its identifiers: ``FD_FRAME`` where it speaks CAN FD


@dataclass(frozen=True, slots=True)
class Answer:
    """One answer, in the motor's own direction; ``state`` None where the family's answers carry none."""

    position_rad: float
    velocity_rad_s: float
    torque_nm: float
    temperature_c: float
    state: JointState | None
    status_raw: int
    error_code: int


@dataclass(frozen=True, slots=True)
class Parameter:
    """One number in the motor's memory: its index, and the ``struct`` code of its four bytes, little endian."""

    index: int
    layout: str = "I"


def _packed(parameter: Parameter, value: float) -> bytes:
    return struct.pack("<f", value) if parameter.layout == "f" else int(value).to_bytes(4, "little")


def _unpacked(parameter: Parameter, data: bytes) -> float:
    return float(struct.unpack(f"<{parameter.layout}", data[: struct.calcsize(parameter.layout)])[0])


class Family(ABC):
    """One kind of actuator on the wire; what this class says is true of those with Mini Cheetah's frames."""

    name: ClassVar[str]  # as the robot file has it
    reply_id: ClassVar[int | None] = 0xFD  # usual ``Motor.reply_id``; None for the motor's id + 10h
    # The parameter that makes the motor let go without its host; None where there is none.
    watchdog: ClassVar[Parameter | None] = None
    settings: ClassVar[Mapping[str, tuple[Parameter, int]]] = {}  # what must be set before power, by name of what it is
    figures: ClassVar[Mapping[str, Parameter]] = {}  # what it can tell of itself, by name

    def command(self, motor: Motor, motion: Motion) -> Frame:
        """The frame of one cycle."""
        return motor.id | motor.flags, frames.pack_motion(motion, motor.ranges)

    def special(self, motor: Motor, what: bytes) -> Frame:
        """``ON``, ``OFF`` or ``CLEAR``."""
        return motor.id | motor.flags, what

    def poll(self, motor: Motor) -> Frame:
        """Ask for an answer before anything is to move: without effect where the family has such a frame, else OFF."""
        return self.special(motor, OFF)

    def commanded(self, motor: Motor, can_id: int, data: bytes) -> Motion | bytes | None:
        """What a frame tells this motor: a motion, one of the specials, or nothing."""
        if can_id != motor.id | motor.flags or len(data) != 8:
            return None
        return data if data in (ON, OFF, CLEAR) else frames.unpack_motion(data, motor.ranges)

    @abstractmethod
    def answered(self, motor: Motor, can_id: int, data: bytes) -> Answer | None:
        """What a frame says of this motor."""

    def parameter(self, motor: Motor, parameter: Parameter, value: float | None = None) -> Frame:
        """Ask for a parameter; with a value, set it until power is lost. A motor confirms by what it then tells."""
        raise NotImplementedError("this family has no parameters")

    def told(self, motor: Motor, parameter: Parameter, can_id: int, data: bytes) -> float | None:
        """The parameter's value, where a frame answers for it."""
        return None


_DAMIAO_PORT = 0x7FF


class Damiao(Family):
    """DM-J motors. Register answers share the identifier of the cyclic ones: they are read before and after only.

    CAN FD changes the frames' kind and nothing in them. Above 1 Mbit/s (register 35, ``RATES``) a motor answers in FD
    frames alone, and raises errors where nobody hears them (one source); below, it hears FD frames and answers in
    classical ones (openarm_teleop, issue 8).
    """

    RATES: ClassVar[tuple[int, ...]] = (
        125_000, 200_000, 250_000, 500_000, 1_000_000, 2_000_000, 2_500_000, 3_200_000, 4_000_000, 5_000_000,
    )  # fmt: skip
    """What the codes of register 35 say, bit/s; above 1 Mbit/s, of the data of FD frames."""

    name = "damiao"
    reply_id = None
    watchdog = Parameter(9)
    settings: ClassVar[Mapping[str, tuple[Parameter, int]]] = {"MIT mode": (Parameter(10), 1)}
    figures: ClassVar[Mapping[str, Parameter]] = {
        "position range": Parameter(21, "f"),
        "velocity range": Parameter(22, "f"),
        "torque range": Parameter(23, "f"),
        "serial": Parameter(15),
        "firmware": Parameter(14),
        "bit rate": Parameter(35),
    }

    def poll(self, motor: Motor) -> Frame:
        """As ``Family.poll``."""
        return self._service(motor, bytes([0xCC, 0, 0, 0, 0, 0]))

    def answered(self, motor: Motor, can_id: int, data: bytes) -> Answer | None:
        """Status in the high nibble of byte 0: 0 off, 1 on, 8 and more are faults."""
        if can_id != motor.reply_id | motor.flags or len(data) != 8 or data[0] & 0x0F != motor.id & 0x0F:
            return None
        status = data[0] >> 4
        state = JointState.FAULT if status >= 8 else JointState.ENABLED if status else JointState.DISABLED
        figures = frames.unpack_report(data[1:6], motor.ranges)
        return Answer(*figures, float(data[7]), state, status, status if status >= 8 else 0)

    def parameter(self, motor: Motor, parameter: Parameter, value: float | None = None) -> Frame:
        """As ``Family.parameter``."""
        if value is None:
            return self._service(motor, bytes([0x33, parameter.index, 0, 0, 0, 0]))
        return self._service(motor, bytes([0x55, parameter.index]) + _packed(parameter, value))

    def told(self, motor: Motor, parameter: Parameter, can_id: int, data: bytes) -> float | None:
        """As ``Family.told``."""
        ours = can_id == motor.reply_id | motor.flags and len(data) == 8 and data[:2] == motor.id.to_bytes(2, "little")
        if not ours or data[2] not in (0x33, 0x55) or data[3] != parameter.index:
            return None
        return _unpacked(parameter, data[4:])

    def _service(self, motor: Motor, said: bytes) -> Frame:
        return _DAMIAO_PORT | motor.flags, motor.id.to_bytes(2, "little") + said


class RobStride(Family):
    """RobStride's own protocol with 29-bit identifiers: type in bits 28-24, content in 23-8, target in 7-0."""

    name = "robstride"
    watchdog: ClassVar[Parameter | None] = Parameter(0x7028)
    settings: ClassVar[Mapping[str, tuple[Parameter, int]]] = {"motion control mode": (Parameter(0x7005, "B"), 0)}
    figures: ClassVar[Mapping[str, Parameter]] = {"position": Parameter(0x7019, "f")}

    def command(self, motor: Motor, motion: Motion) -> Frame:
        """As ``Family.command``."""
        *numbers, torque = frames.command_numbers(motion, motor.ranges, FULL)
        return _id(1, torque, motor.id), struct.pack(">4H", *numbers)

    def special(self, motor: Motor, what: bytes) -> Frame:
        """As ``Family.special``."""
        kind, data = (3, bytes(8)) if what == ON else (4, bytes([what == CLEAR, *bytes(7)]))
        return _id(kind, motor.reply_id, motor.id), data

    def commanded(self, motor: Motor, can_id: int, data: bytes) -> Motion | bytes | None:
        """As ``Family.commanded``."""
        kind, content, target = _parts(can_id)
        if target != motor.id or len(data) != 8:
            return None
        if kind == 1:
            p, v, kp, kd = struct.unpack(">4H", data)
            return frames.motion_of(p, v, kp, kd, content, motor.ranges, FULL)
        return {3: ON, 4: CLEAR if data[0] else OFF}.get(kind)

    def answered(self, motor: Motor, can_id: int, data: bytes) -> Answer | None:
        """Mode in bits 22-23 of the identifier (2 runs), faults in 16-21."""
        kind, content, target = _parts(can_id)
        if kind != 2 or target != motor.reply_id or content & 0xFF != motor.id or len(data) != 8:
            return None
        faults, mode = content >> 8 & 0x3F, content >> 14 & 3
        state = JointState.FAULT if faults else JointState.ENABLED if mode == 2 else JointState.DISABLED
        p, v, t, temperature = struct.unpack(">4H", data)
        figures = frames.report_of(p, v, t, motor.ranges, FULL)
        return Answer(*figures, temperature / 10.0, state, content >> 8, faults)

    def parameter(self, motor: Motor, parameter: Parameter, value: float | None = None) -> Frame:
        """As ``Family.parameter``; a written one is answered by a frame of type 2."""
        data = bytes(4) if value is None else _packed(parameter, value)
        return _id(17 if value is None else 18, motor.reply_id, motor.id), struct.pack("<HH", parameter.index, 0) + data

    def told(self, motor: Motor, parameter: Parameter, can_id: int, data: bytes) -> float | None:
        """As ``Family.told``."""
        kind, content, target = _parts(can_id)
        ours = kind == 17 and target == motor.reply_id and content & 0xFF == motor.id and len(data) == 8
        if not ours or content >> 8 or data[:2] != parameter.index.to_bytes(2, "little"):
            return None
        return _unpacked(parameter, data[4:])


class CyberGear(RobStride):
    """Xiaomi's motor speaks the same protocol; its watchdog has another index (one source)."""

    name = "cybergear"
    watchdog = Parameter(0x200C)


class RobStrideMit(Family):
    """RobStride in MIT mode: no state and no parameters in what every firmware answers."""

    name = "robstride-mit"

    def answered(self, motor: Motor, can_id: int, data: bytes) -> Answer | None:
        """As ``Family.answered``."""
        if can_id != motor.reply_id or len(data) != 8 or data[0] != motor.id:
            return None
        figures = frames.unpack_report(data[1:6], motor.ranges)
        return Answer(*figures, int.from_bytes(data[6:8], "big") / 10.0, None, 0, 0)


class CubeMars(Family):
    """AK motors with V2 firmware in MIT mode; answers of 6 bytes (old) or of 8 with temperature and error."""

    name = "cubemars"
    reply_id = 0

    def answered(self, motor: Motor, can_id: int, data: bytes) -> Answer | None:
        """As ``Family.answered``."""
        if can_id != motor.reply_id or len(data) not in (6, 8) or data[0] != motor.id:
            return None
        temperature = float(int.from_bytes(data[6:7], "big", signed=True)) if len(data) == 8 else float("nan")
        error = data[7] if len(data) == 8 else 0
        state = JointState.FAULT if error else None
        return Answer(*frames.unpack_report(data[1:6], motor.ranges), temperature, state, error, error)


FAMILIES: Mapping[str, Family] = {
    family.name: family for family in (Damiao(), RobStride(), CyberGear(), RobStrideMit(), CubeMars())
}


def _id(kind: int, content: int, target: int) -> int:
    return EXTENDED | kind << 24 | content << 8 | target


def _parts(can_id: int) -> tuple[int, int, int]:
    """Type, content and target; type -1 of a frame with an 11-bit identifier."""
    return (can_id >> 24 & 0x1F) if can_id & EXTENDED else -1, can_id >> 8 & 0xFFFF, can_id & 0xFF
