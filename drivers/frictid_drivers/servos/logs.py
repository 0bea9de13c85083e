"""Packets to figures, live and in replay (``protocol.frames``).

A packet is one row of the bus log, under an identifier that no CAN device uses. A cycle is a sync write of goals, and
half a cycle later the sync read that begins the row: a servo holds its goal until the next one comes, so its current
swings around its mean from write to write, and passes it in the middle.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any

from frictid_drivers.servos.models import Model, Registers
from frictid_drivers.servos.packets import SYNC_READ, SYNC_WRITE, WIRES, Packet
from frictid_drivers.servos.settings import JointSettings
from frictid_hil.errors import FieldProblem, InvalidFields
from frictid_hil.plan.mode import Mode
from frictid_hil.plan.setup import RobotSetup
from frictid_hil.protocol.driver import Feedback, JointState
from frictid_hil.protocol.rows import Command, Report, RowDecoder, RowLog, Service

schema = "frictid.servo-packets/1"
SENT_ID, RECEIVED_ID = 0x8000_0000 | 0x1FFF_FF10, 0x8000_0000 | 0x1FFF_FF11  # identifiers of packets in a bus log

_SPEED_CYCLES, _SPEED_S = 8, 0.04


def speed_cycles(period_s: float) -> int:
    """Over how many cycles position is differenced: eight, but no longer than 40 ms.

    Reported speeds are not used: a Feetech's unit depends on its firmware, and both makers sample a speed that swings
    from goal to goal.
    """
    return min(_SPEED_CYCLES, max(1, round(_SPEED_S / period_s)))


@dataclass(slots=True)
class Figures:
    """What packets told of one joint."""

    settings: JointSettings
    track: deque[tuple[int, float]]  # cycle and position of the last readings
    feedback: Feedback = field(default_factory=Feedback)
    counts: int | None = None  # position as read; None before
    goal_rad: float = math.nan  # in force; NaN for none
    powered: bool = False
    takes_currents: bool = False  # it was put into current mode


class Reader:
    """Packets of one line to figures of its joints."""

    def __init__(self, joints: Sequence[JointSettings], period_s: float) -> None:
        self._period_s = period_s
        self._wire = WIRES[joints[0].model.wire]
        self._registers = joints[0].model.registers
        self._at = {joint.id: at for at, joint in enumerate(joints)}
        self._cycle = 0
        rows = speed_cycles(period_s) + 1
        self.joints = [Figures(joint, deque(maxlen=rows)) for joint in joints]

    def rows(self) -> RowDecoder:
        """A decoder of the log's rows."""
        return RowDecoder([joint.feedback for joint in self.joints], self._decode)

    def _decode(self, can_id: int, data: bytes) -> Command | Report | Service | None:
        if can_id not in (SENT_ID, RECEIVED_ID):
            return None
        for packet in self._wire.parse(bytearray(data), answers=can_id == RECEIVED_ID):
            return self._told(packet) if can_id == SENT_ID else self._answered(packet)
        return None

    def _told(self, packet: Packet) -> Command | Service:
        registers, size = self._registers, self._wire.word
        address = int.from_bytes(packet.data[:size], "little")
        if packet.instruction == SYNC_READ and address == registers.block:
            self._cycle += 1
            others = tuple((at, joint.goal_rad) for at, joint in enumerate(self.joints) if at)
            return Command(0, self.joints[0].goal_rad, others)
        if packet.instruction == SYNC_WRITE and address in (registers.goal, registers.torque, registers.mode):
            each = int.from_bytes(packet.data[size : 2 * size], "little") + 1
            told = packet.data[2 * size :]
            for k in range(0, len(told) - each + 1, each):
                self._take(told[k], address, told[k + 1 : k + each])
        return Service("packet")

    def _take(self, servo: int, address: int, data: bytes) -> None:
        at = self._at.get(servo)
        if at is None:
            return
        joint, settings = self.joints[at], self.joints[at].settings
        registers = settings.model.registers
        if address == registers.goal:
            joint.goal_rad = settings.position_rad(number(data, settings.model, 15))
            return
        if address == registers.mode:
            joint.takes_currents = bool(registers.goal_current) and data[0] == registers.current_mode
        else:
            joint.powered = data[0] == 1
        if joint.takes_currents or not joint.powered:
            joint.goal_rad = math.nan

    def _answered(self, packet: Packet) -> Report | Service:
        at, registers = self._at.get(packet.id), self._registers
        if at is None or len(packet.data) != registers.block_bytes:
            return Service("answer")
        joint, settings, report, block = (
            self.joints[at],
            self.joints[at].settings,
            self.joints[at].feedback,
            packet.data,
        )

        def field_of(offset: int, size: int, sign_bit: int) -> int:
            return number(block[offset : offset + size], settings.model, sign_bit)

        joint.counts = field_of(*registers.position, 15)
        report.position_rad = settings.position_rad(joint.counts)
        track = joint.track
        track.append((self._cycle, report.position_rad))
        cycles = track[-1][0] - track[0][0]
        report.velocity_rad_s = (track[-1][1] - track[0][1]) / (cycles * self._period_s) if cycles else 0.0
        report.torque_nm = settings.direction * settings.torque_nm_per_unit * _effort(settings.model, field_of)
        if registers.temperature >= 0:
            report.temperature_c = float(block[registers.temperature])
        # A Dynamixel's error is its alert bit; the others only tell that an instruction was wrong.
        report.error_code = packet.error & (0xFF if self._wire.name == "feetech" else 0x80)
        report.status_raw = packet.error
        report.state = (
            JointState.FAULT if report.error_code else JointState.ENABLED if joint.powered else JointState.DISABLED
        )
        mode = Mode.TORQUE if joint.takes_currents else Mode.POSITION
        report.mode = mode if report.state is JointState.ENABLED else Mode.NONE
        return Report(at)


def _effort(model: Model, field_of: Callable[[int, int, int], int]) -> int:
    """Signed steps of current, or of load where there is no current.

    A Feetech's current has no documented sign; its load has.
    """
    registers = model.registers
    if not model.current_a:
        return field_of(registers.load, 2, 10)
    current = field_of(registers.current, 2, 15)
    return current if registers.load < 0 else abs(current) * (-1 if field_of(registers.load, 2, 10) < 0 else 1)


def number(data: bytes, model: Model, sign_bit: int) -> int:
    """A register's number; sign-magnitude or two's complement as the model has it."""
    value = int.from_bytes(data, "big" if model.big_endian else "little", signed=not model.sign_magnitude)
    if model.sign_magnitude and value >> sign_bit & 1:
        return -(value & (1 << sign_bit) - 1)
    return value


def to_bytes(value: int, size: int, model: Model) -> bytes:
    """The reverse, with the sign in bit 15."""
    if model.sign_magnitude:
        value = abs(value) | (0x8000 if value < 0 else 0)
    return value.to_bytes(size, "big" if model.big_endian else "little", signed=not model.sign_magnitude)


def frame_map_values(setup: RobotSetup, joints: Sequence[JointSettings], period_s: float) -> dict[str, Any]:
    """What a replay must know."""
    return {
        "schema": schema,
        "period_s": period_s,
        "joints": {joint.name: asdict(mine) for joint, mine in zip(setup.joints, joints, strict=True)},
    }


def decoder(frame_map: Mapping[str, Any]) -> RowLog:
    """A decoder for logs with this frame map.

    Raises:
        InvalidFields: the map is not what ``frame_map_values`` writes.
    """
    try:
        joints = []
        for values in frame_map["joints"].values():
            model = dict(values["model"])
            registers: Any = {
                name: tuple(v) if isinstance(v, list) else v for name, v in model.pop("registers").items()
            }
            joint = JointSettings(**{**values, "model": Model(**model, registers=Registers(**registers))})
            joints.append(replace(joint, id=int(joint.id)))
        return RowLog(Reader(joints, float(frame_map["period_s"])).rows())
    except (KeyError, TypeError, ValueError, AttributeError, IndexError) as error:
        raise InvalidFields([FieldProblem(("joints",), f"not a frame map of serial servos: {error!r}")]) from None
