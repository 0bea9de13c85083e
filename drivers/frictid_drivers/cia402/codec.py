"""Frames to joint-side figures: one decoder for the live cycle and for logs, so that a replay is bit-identical.

A row is one SYNC and the reports that answer it. The decoder is told when a row begins and ends and is fed what
arrives between; a joint's figures are taken over only when all its cyclic reports of one SYNC are there, so that no
row ever mixes the position of one SYNC with the velocity of another. Status, error and emergency are taken at once.

Nothing here allocates objects of its own per frame, blocks, or raises on what a wire may bring.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Sequence
from dataclasses import dataclass, field, fields

from frictid_drivers.cia402.frame_map import Frame, FrameMap, JointFrames
from frictid_drivers.cia402.objects import ERROR, FIGURES, INPUTS, INTERPOLATED, MODE_SHOWN, STATUS, IntegerType
from frictid_drivers.cia402.state import JOINT_STATES
from frictid_hil.plan.mode import Mode
from frictid_hil.protocol.driver import Feedback, JointState

EMCY_BASE, HEARTBEAT_BASE = 0x080, 0x700
MALFORMED_EMERGENCY = 0x1000  # error code shown for an EMCY frame too short to hold one: "generic error" of CiA 301

_ATTRIBUTES = {meaning: key.removesuffix("_per_unit") for meaning, key in FIGURES.items()}
_MODES = {mode.value: mode for mode in Mode} | {INTERPOLATED: Mode.POSITION}
_NEVER = -math.inf
_LIMIT_ACTIVE = 0x0800  # statusword bit 11: a set-point or the torque is cut by a limit of the drive


def packing(types: Sequence[IntegerType]) -> struct.Struct | BitPacking:
    """Integers into the bytes of a PDO and back, least significant bit first; whole widths compile to ``struct``."""
    codes = [kind.code for kind in types]
    return BitPacking(types) if None in codes else struct.Struct("<" + "".join(filter(None, codes)))


class BitPacking:
    """The general case: entries of 1 to 64 bits at any bit; ``size`` bytes."""

    def __init__(self, types: Sequence[IntegerType]) -> None:
        self._types = tuple(types)
        self.size = (sum(kind.bits for kind in self._types) + 7) // 8

    def pack_into(self, buffer: bytearray, offset: int, /, *values: int) -> None:
        """Write all values; ``struct.error`` when one does not fit its type."""
        word = shift = 0
        for kind, value in zip(self._types, values, strict=True):
            if not kind.low <= value <= kind.high:
                raise struct.error(f"{value} does not fit {kind}")
            word |= (value & ((1 << kind.bits) - 1)) << shift
            shift += kind.bits
        buffer[offset : offset + self.size] = word.to_bytes(self.size, "little")

    def unpack_from(self, buffer: bytes | bytearray, /) -> tuple[int, ...]:
        """Read all values from the first ``size`` bytes; ``struct.error`` when there are fewer."""
        if len(buffer) < self.size:
            raise struct.error(f"{len(buffer)} bytes for a PDO of {self.size}")
        word = int.from_bytes(buffer[: self.size], "little")
        values = []
        for kind in self._types:
            value = word & ((1 << kind.bits) - 1)
            word >>= kind.bits
            values.append(value - (1 << kind.bits) if value > kind.high else value)
        return tuple(values)


class _Report:
    """One PDO of one joint as last received."""

    def __init__(self, frame: Frame, joint: JointFrames) -> None:
        codec = packing(frame.types)
        self.size = codec.size
        self.unpack = codec.unpack_from
        self.joint: _Joint
        self.awaited = False
        self.slow = not {STATUS, "position", "velocity", "torque"} & set(frame.meanings)
        self.cycle = -1
        self.t_ns = 0
        self.values: tuple[int, ...] = (0,) * len(frame.entries)
        self.status_at, self.mode_at, self.error_at, self.inputs_at = (
            frame.meanings.index(meaning) if meaning in frame.meanings else -1
            for meaning in (STATUS, MODE_SHOWN, ERROR, INPUTS)
        )
        told = (self.status_at, self.mode_at, self.error_at, self.inputs_at)
        self.figures_only = not self.slow and max(told) < 0
        self.figures = tuple(
            (at, _ATTRIBUTES[meaning], float(getattr(joint, FIGURES[meaning])))
            for at, meaning in enumerate(frame.meanings)
            if meaning in FIGURES
        )


@dataclass(slots=True, eq=False)
class _Joint:
    """What is known of one joint."""

    feedback: Feedback = field(default_factory=Feedback)
    cyclic: tuple[_Report, ...] = ()
    inputs: _Report | None = None
    position_at: tuple[_Report, int] | None = None
    taken_cycle: int = -1
    heartbeat_ns: int | None = None
    restarted: bool = False
    told: int = 0
    emergency: int = 0
    untold: int = 0

    def take(self) -> None:
        """All cyclic reports of one SYNC are there: they are the joint's figures now."""
        feedback, first = self.feedback, self.cyclic[0]
        self.taken_cycle = first.cycle
        feedback.t_ns = first.t_ns
        feedback.valid = True
        for report in self.cyclic:
            values = report.values
            for at, attribute, factor in report.figures:
                setattr(feedback, attribute, values[at] * factor)

    def judge(self) -> None:
        """What is wrong now: an emergency not taken back, or 603F in fault (else it is history, at some vendors)."""
        feedback = self.feedback
        feedback.error_code = self.emergency or (self.told if feedback.state is JointState.FAULT else 0)


class Decoder:
    """Reports of all joints, row by row; of the joints ``awaited`` all cyclic reports are expected in every row."""

    def __init__(self, frame_map: FrameMap, awaited: Sequence[str] = ()) -> None:
        self._reports: dict[int, _Report] = {}
        self._joints: list[_Joint] = []
        self._emergencies: dict[int, _Joint] = {}
        self._heartbeats: dict[int, _Joint] = {}
        for frames in frame_map.joints:
            joint = _Joint()
            self._joints.append(joint)
            self._emergencies[EMCY_BASE + frames.node] = joint
            self._heartbeats[HEARTBEAT_BASE + frames.node] = joint
            for frame in frames.reports:
                report = self._reports[frame.cob_id] = _Report(frame, frames)
                report.joint = joint
                if "position" in frame.meanings:
                    joint.position_at = (report, frame.meanings.index("position"))
                if report.inputs_at >= 0:
                    joint.inputs = report
                if not report.slow:
                    joint.cyclic = (*joint.cyclic, report)
                    report.awaited = frames.name in awaited
        self._awaited = sum(report.awaited for report in self._reports.values())
        # Number of the present row, from 1, and awaited reports that have not come in it.
        self.cycle = self._t_ns = self.missing = 0
        self._oldest_heartbeat_ns: float = _NEVER
        self.feedback = [joint.feedback for joint in self._joints]  # always the same objects

    def restart(self) -> None:
        """Forget every report, as at the start of cycling; the feedback objects stay the same."""
        self.cycle = self._t_ns = self.missing = 0
        self._oldest_heartbeat_ns = _NEVER
        for report in self._reports.values():
            report.cycle = -1
        blank = Feedback()
        for joint in self._joints:
            joint.taken_cycle = -1
            joint.heartbeat_ns = None
            joint.restarted = False
            joint.told = joint.emergency = joint.untold = 0
            for one in fields(Feedback):
                setattr(joint.feedback, one.name, getattr(blank, one.name))

    def begin(self, t_ns: int) -> None:
        """A row begins: SYNC at ``t_ns``."""
        self.cycle += 1
        self._t_ns = t_ns
        self.missing = self._awaited

    def feed(self, t_ns: int, cob_id: int, data: bytes | bytearray) -> bool:
        """Take one frame; False when it is none of ours. A report shorter than its mapping marks its joint invalid."""
        return not self.take(t_ns, ((cob_id, data),))

    def take(self, t_ns: int, frames: Sequence[tuple[int, bytes | bytearray]]) -> list[tuple[int, bytes | bytearray]]:
        """Take frames as ``feed`` does, in order; those that are none of ours come back."""
        others: list[tuple[int, bytes | bytearray]] = []
        reports, cycle = self._reports, self.cycle
        for frame in frames:
            cob_id, data = frame
            report = reports.get(cob_id)
            if report is None:
                if not self._service(t_ns, cob_id, data):
                    others.append(frame)
            elif len(data) < report.size:
                report.joint.feedback.valid = False
            else:
                report.values = report.unpack(data)
                if report.cycle != cycle:
                    report.cycle = cycle
                    report.t_ns = self._t_ns
                    if report.awaited:
                        self.missing -= 1
                if not report.figures_only:
                    self._tell(report)
        return others

    def _tell(self, report: _Report) -> None:
        """What a report says beside its figures is so at once."""
        joint, values = report.joint, report.values
        feedback = joint.feedback
        if report.status_at >= 0:
            status = feedback.status_raw = values[report.status_at]
            feedback.state = JOINT_STATES[status & 0x6F]
            feedback.limited = status & _LIMIT_ACTIVE != 0
        if report.error_at >= 0:
            joint.told = values[report.error_at]
            if not joint.told:
                joint.emergency = 0
        if joint.told or joint.emergency or feedback.error_code:
            joint.judge()
        if report.inputs_at >= 0:
            feedback.digital_inputs = values[report.inputs_at]
        if report.mode_at >= 0:
            feedback.mode = _MODES.get(values[report.mode_at], Mode.NONE)
        if report.slow:
            for at, attribute, factor in report.figures:
                setattr(feedback, attribute, values[at] * factor)

    def has(self, cob_id: int) -> bool:
        """This report has already come in the present row."""
        report = self._reports.get(cob_id)
        return report is not None and report.cycle == self.cycle

    def finish(self) -> list[Feedback]:
        """The row ends: take over what is complete, count the age of the rest."""
        cycle = self.cycle
        for joint in self._joints:
            feedback = joint.feedback
            cyclic = joint.cyclic
            newest = cyclic[0].cycle if cyclic else -1
            if newest > joint.taken_cycle:
                for report in cyclic:
                    if report.cycle != newest:
                        break
                else:
                    joint.take()
            feedback.age_cycles = cycle - joint.taken_cycle
            if joint.untold:
                # An emergency is shown in its row, whatever 603F or the next emergency said right after it.
                feedback.error_code, joint.untold = joint.untold, 0
            elif feedback.error_code:
                joint.judge()
            if joint.inputs is not None:
                feedback.digital_inputs_age_cycles = cycle - joint.inputs.cycle
        return self.feedback

    def position_units(self, joint: int) -> int | None:
        """The joint's last reported position in the drive's own units; None before its first report."""
        where = self._joints[joint].position_at
        if where is None or where[0].cycle < 0:
            return None
        return where[0].values[where[1]]

    def heartbeat_ns(self, joint: int) -> int | None:
        """When the joint's last heartbeat came; None before the first."""
        return self._joints[joint].heartbeat_ns

    def all_alive(self, since_ns: int) -> bool:
        """Every joint's heartbeat has come since then, and none was reset."""
        return since_ns <= self._oldest_heartbeat_ns

    def restarted(self, joint: int) -> bool:
        """A boot-up frame came: the drive was reset."""
        return self._joints[joint].restarted

    def _service(self, t_ns: int, cob_id: int, data: bytes | bytearray) -> bool:
        joint = self._heartbeats.get(cob_id)
        if joint is not None:
            joint.heartbeat_ns = t_ns
            if data and data[0] & 0x7F == 0:
                joint.restarted = True
                joint.feedback.state = JointState.UNKNOWN
            alive = [_NEVER if one.restarted or one.heartbeat_ns is None else one.heartbeat_ns for one in self._joints]
            self._oldest_heartbeat_ns = min(alive)
            return True
        joint = self._emergencies.get(cob_id)
        if joint is None:
            return False
        code = int.from_bytes(data[:2], "little") if len(data) >= 2 else MALFORMED_EMERGENCY
        # Codes 00xx say that the error is gone.
        joint.emergency = code if code & 0xFF00 else 0
        joint.untold = joint.emergency or joint.untold
        joint.judge()
        return True


class Command:
    """One PDO that the host sends: named integers in, cut to the bounds of their type, the same bytes buffer out."""

    def __init__(self, frame: Frame) -> None:
        codec = packing(frame.types)
        self.cob_id = frame.cob_id
        self.data = bytearray(codec.size)
        self._pack = codec.pack_into
        self._at = {meaning: at for at, meaning in enumerate(frame.meanings) if meaning}
        self._bounds = [(kind.low, kind.high) for kind in frame.types]
        self._values = [0] * len(frame.entries)

    def __contains__(self, meaning: str) -> bool:
        return meaning in self._at

    def set(self, meaning: str, value: int) -> int:
        """Set one entry; as it goes out, which is 0 where the frame does not carry it."""
        at = self._at.get(meaning)
        if at is None:
            return 0
        low, high = self._bounds[at]
        self._values[at] = value = low if value < low else high if value > high else value
        return value

    def pack(self) -> bytearray:
        """All entries into the frame's own buffer."""
        self._pack(self.data, 0, *self._values)
        return self.data


class CommandDecoder:
    """Set-points out of the host's own frames, for replay: the last commanded of each joint, NaN before the first."""

    def __init__(self, frame_map: FrameMap) -> None:
        self._count = len(frame_map.joints)
        self.restart()
        self._frames = {
            frame.cob_id: (at, joint, frame.meanings, packing(frame.types).unpack_from)
            for at, joint in enumerate(frame_map.joints)
            for frame in joint.commands
        }

    def restart(self) -> None:
        """Forget every set-point, as at the start of cycling."""
        self.position_rad, self.velocity_rad_s, self.torque_nm, self.torque_offset_nm = (
            [math.nan] * self._count for _ in range(4)
        )

    def feed(self, cob_id: int, data: bytes | bytearray) -> bool:
        """Take one frame; False when it is no command of ours."""
        known = self._frames.get(cob_id)
        if known is None:
            return False
        at, joint, meanings, unpack = known
        try:
            values = unpack(data)
        except struct.error:
            return True
        for meaning, value in zip(meanings, values, strict=True):
            match meaning:
                case "target_position":
                    self.position_rad[at] = value * joint.position_rad_per_unit
                case "target_velocity":
                    self.velocity_rad_s[at] = value * joint.velocity_rad_s_per_unit
                case "target_torque":
                    self.torque_nm[at] = value * joint.torque_nm_per_unit
                case "torque_offset":
                    self.torque_offset_nm[at] = value * joint.torque_nm_per_unit
        return True
