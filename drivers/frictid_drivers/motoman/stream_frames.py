"""Frames of the streaming extension: layout, CRC, and a reader that finds its way back after garbage.

``A5 5A | version << 4 + type | length | seq u16 | payload | CRC u16``, little-endian; the CRC is CRC-16/CCITT-FALSE
over everything from the version to the end of the payload.
"""

from __future__ import annotations

import binascii
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum, IntFlag
from typing import Final, NamedTuple

VERSION: Final = 1
_SYNC: Final = b"\xa5\x5a"
_HEAD: Final = struct.Struct("<2sBBH")
_CRC_BYTES: Final = 2


class FrameType(IntEnum):
    """Low nibble of the third byte."""

    SET_POINT = 1
    FEEDBACK = 2
    NACK = 3
    HELLO = 4
    STOP = 5


class Refusal(IntEnum):
    """Why a frame was refused."""

    CRC = 1
    VERSION = 2
    SESSION = 3
    LATE = 4
    GAP = 5
    LIMIT = 6
    NOT_ARMED = 7
    ALARM = 8


class Flag(IntFlag):
    """What a feedback says beside its figures."""

    ARMED = 1
    LATCHED = 2
    PULSES_DROPPED = 4
    EXTRAPOLATED = 8
    STRAYED = 16
    COMPENSATED = 32


class AxisFeedback(NamedTuple):
    """One axis in one tick: encoder position, 0.1 pulse/s, torque in the unit that HELLO named."""

    pulses: int
    speed_tenths: int
    torque: int


class TickReport(NamedTuple):
    """FEEDBACK."""

    tick: int
    echo_seq: int
    data_1: int
    data_2: int
    alarm: int
    queue: int
    flags: Flag
    session: int
    axis_mask: int
    axes: tuple[AxisFeedback, ...]


class Nack(NamedTuple):
    """NACK."""

    refused_seq: int
    code: int
    session: int
    due_tick: int
    axis: int
    now_tick: int

    @property
    def reason(self) -> str:
        """In words."""
        if self.code in set(Refusal):
            return Refusal(self.code).name.lower().replace("_", " ")
        return f"code {self.code}"


class AxisLimits(NamedTuple):
    """The controller's own bounds of one axis, in pulses and pulses per tick."""

    lowest: int
    highest: int
    step: int


@dataclass(frozen=True, slots=True)
class Welcome:
    """HELLO as the controller answers it."""

    version: int  # chosen
    session: int  # now open
    axis_mask: int  # axes in every frame of this session
    feed_forward: bool  # torque may ride on set-points
    torque_measured: bool  # feedback torque is measured, not commanded
    compensated: bool  # a downloaded friction table is being applied
    tick_us: int  # interpolation clock
    watchdog_ticks: int  # ticks without a target before it stops the arm
    queue_limit: int  # how many ticks ahead a target may be due
    averaging_ms: int | None  # moving average on the command, None where the controller does not know
    torque_unit: int  # 0: uN m at the motor shaft; 1: 0.01 % of rated torque
    tick: int  # now
    limits: tuple[AxisLimits, ...]  # per axis in the mask


class Stopped(NamedTuple):
    """STOP, echoed."""

    session: int
    leaving: bool


Frame = TickReport | Nack | Welcome | Stopped

_FEEDBACK_HEAD: Final = struct.Struct("<IHBBHBBBB2x")
_AXIS: Final = struct.Struct("<iii")
_NACK: Final = struct.Struct("<HBBHBxH")
_WELCOME_HEAD: Final = struct.Struct("<BBBBHBBHHI")
_HEAD_OF_LIST: Final = 16
_UNKNOWN_AVERAGING: Final = 0xFFFF


def crc16(data: bytes) -> int:
    """CRC-16/CCITT-FALSE; 0x29B1 for ``123456789``."""
    return binascii.crc_hqx(data, 0xFFFF)


def encode_frame(kind: FrameType, seq: int, payload: bytes) -> bytes:
    """A whole frame."""
    head = _HEAD.pack(_SYNC, VERSION << 4 | kind, len(payload), seq & 0xFFFF)
    return head + payload + crc16(head[2:] + payload).to_bytes(_CRC_BYTES, "little")


def encode_set_point(
    seq: int, session: int, axis_mask: int, due_tick: int, pulses: Sequence[int], torque: Sequence[int] = ()
) -> bytes:
    """SETPOINT: absolute pulses, and optionally torque in 0.01 % of rated, per axis of the mask."""
    payload = struct.pack(f"<BBH{len(pulses)}i", session, axis_mask, due_tick & 0xFFFF, *pulses)
    if torque:
        payload += struct.pack(f"<{len(torque)}h", *torque)
    return encode_frame(FrameType.SET_POINT, seq, payload)


def encode_hello(seq: int, session: int, axis_mask: int) -> bytes:
    """HELLO: the versions we speak, the axes we want, the session we open."""
    return encode_frame(FrameType.HELLO, seq, bytes([VERSION, VERSION, axis_mask, session]))


def encode_stop(seq: int, session: int, *, leave: bool) -> bytes:
    """STOP: decelerate and latch; ``leave`` also gives the line back to host control."""
    return encode_frame(FrameType.STOP, seq, bytes([session, int(leave), 0, 0]))


def set_point_bytes(axes: int, *, torque: bool = False) -> int:
    """Length of a SETPOINT frame."""
    return _HEAD.size + 4 + (6 if torque else 4) * axes + _CRC_BYTES


def feedback_bytes(axes: int) -> int:
    """Length of a FEEDBACK frame."""
    return _HEAD.size + _HEAD_OF_LIST + _AXIS.size * axes + _CRC_BYTES


class FrameReader:
    """Finds frames in bytes that come in any portions; behind a wrong CRC the search goes on one byte further."""

    def __init__(self) -> None:
        self._buffer = bytearray()
        self.damaged = 0  # frames that were dropped

    def take(self, data: bytes) -> list[Frame]:
        """The frames that these bytes complete, in order."""
        buffer = self._buffer
        buffer += data
        frames: list[Frame] = []
        while True:
            start = buffer.find(_SYNC)
            if start < 0:
                # The last byte may be the first half of a frame's start.
                del buffer[: max(0, len(buffer) - 1)]
                return frames
            del buffer[:start]
            if len(buffer) < _HEAD.size:
                return frames
            kind, length = buffer[2] & 0x0F, buffer[3]
            if not _plausible(kind, length):
                del buffer[0]
                continue
            size = _HEAD.size + length + _CRC_BYTES
            if len(buffer) < size:
                return frames
            raw = bytes(buffer[:size])
            frame = None
            if crc16(raw[2:-_CRC_BYTES]) == int.from_bytes(raw[-_CRC_BYTES:], "little"):
                frame = _decode(raw[2] >> 4, kind, raw[_HEAD.size : -_CRC_BYTES])
            if frame is None:
                self.damaged += 1
                del buffer[0]
                continue
            del buffer[:size]
            frames.append(frame)


def _plausible(kind: int, length: int) -> bool:
    if kind in (FrameType.FEEDBACK, FrameType.HELLO):
        return length >= _HEAD_OF_LIST and (length - _HEAD_OF_LIST) % _AXIS.size == 0
    return (kind == FrameType.NACK and length == _NACK.size) or (kind == FrameType.STOP and length == 4)


def _decode(version: int, kind: int, payload: bytes) -> Frame | None:
    if version != VERSION:
        return None
    if kind == FrameType.FEEDBACK:
        tick, echo, data_1, data_2, alarm, queue, flags, session, mask = _FEEDBACK_HEAD.unpack_from(payload)
        axes = tuple(map(AxisFeedback._make, _AXIS.iter_unpack(payload[_HEAD_OF_LIST:])))
        if mask.bit_count() != len(axes):
            return None
        return TickReport(tick, echo, data_1, data_2, alarm, queue, Flag(flags), session, mask, axes)
    if kind == FrameType.NACK:
        return Nack(*_NACK.unpack(payload))
    if kind == FrameType.STOP:
        return Stopped(payload[0], payload[1] == 1)
    version, session, mask, flags, tick_us, watchdog, queue, averaging, unit, tick = _WELCOME_HEAD.unpack_from(payload)
    limits = tuple(map(AxisLimits._make, _AXIS.iter_unpack(payload[_HEAD_OF_LIST:])))
    if mask.bit_count() != len(limits):
        return None
    known_ms = None if averaging == _UNKNOWN_AVERAGING else averaging
    feeds, measures, compensates = (bool(flags & bit) for bit in (1, 2, 4))
    return Welcome(
        version, session, mask, feeds, measures, compensates, tick_us, watchdog, queue, known_ms, unit, tick, limits
    )
