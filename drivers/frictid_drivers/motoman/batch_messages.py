"""What host and batch application tell each other: greeting, job, its state, its recording, friction table.

The data of a BSC block may hold no control codes, so binary travels as base64 text; every block of a recording carries
its own place and CRC.
"""

from __future__ import annotations

import base64
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from frictid_drivers.motoman.stream_frames import crc16

TABLE_POINTS: Final = 21
_SAMPLE_BYTES: Final = 10
_BLOCK_HEAD: Final = struct.Struct("<HIB")

Rows = dict[int, tuple[int, int, int]]
"""Samples by number: pulses, 0.1 pulse/s, uN m."""


@dataclass(frozen=True, slots=True)
class BatchHello:
    """What the batch application says of itself.

    Attributes:
        tick_us: interpolation clock.
        axes: how many it has.
        most_ticks: longest job.
        torque_measured: feedback torque is measured, not commanded.
        averaging_ms: moving average on the command, None where it does not know.
        table_points: points of a friction table, 0 where it cannot compensate.
        name: of the application.
    """

    tick_us: int
    axes: int
    most_ticks: int
    torque_measured: bool
    averaging_ms: int | None
    table_points: int
    name: str


@dataclass(frozen=True, slots=True)
class JobOrder:
    """One job of one axis; positions in pulses.

    Attributes:
        number: 1..65535, to tell it from the job before.
        axis: index on the controller.
        start: where it begins; the axis must stand there.
        lowest: bound of the travel.
        highest: bound of the travel.
        step: most pulses per tick.
        torque_micro: torque limit at the motor shaft, uN m.
        watchdog_ticks: ticks without a word from the host after which it stops.
        segments: see ``motion_segments``.
    """

    number: int
    axis: int
    start: int
    lowest: int
    highest: int
    step: int
    torque_micro: int
    watchdog_ticks: int
    segments: Sequence[str]

    def text(self) -> str:
        """The FJOB command, with its CRC over everything up to and including the last comma."""
        figures = (self.number, self.axis, self.start, self.lowest, self.highest, self.step)
        body = ",".join([*map(str, (*figures, self.torque_micro, self.watchdog_ticks)), *self.segments])
        covered = f"FJOB 1,{body},"
        return f"{covered}{crc16(covered.encode('ascii')):04X}"


@dataclass(frozen=True, slots=True)
class JobState:
    """The reply to FSTAT."""

    number: int
    state: int
    done_ticks: int
    total_ticks: int
    alarm: int
    reason: int
    velocity_shift: int
    torque_shift: int
    dropped_pulses: int


@dataclass(frozen=True, slots=True)
class Record:
    """What a job recorded; arrays of shape (n,), one row per tick from the first.

    Attributes:
        pulses: encoder position.
        speed_tenths: 0.1 pulse/s.
        torque_micro: uN m at the motor shaft.
        dropped_pulses: how many pulses the speed limiter dropped on the way.
    """

    pulses: NDArray[np.int64]
    speed_tenths: NDArray[np.int64]
    torque_micro: NDArray[np.int64]
    dropped_pulses: int


@dataclass(frozen=True, slots=True)
class FrictionTable:
    """One axis's compensation: the curve at equal steps of speed from standstill, and how to apply it.

    Attributes:
        axis: index on the controller.
        ratio: R of (24c).
        step_tenths: 0.1 pulse/s between two points.
        stiffness_nano: K of (24a) at the motor shaft, nN m per pulse.
        turn_pulses: pulses per revolution of the joint.
        gravity_cos_micro: what holds the joint against gravity, uN m at the motor shaft; cosine part.
        gravity_sin_micro: sine part.
        points_micro: phi at 0, 1 .. 20 steps, uN m at the motor shaft; the first is F_0.
    """

    axis: int
    ratio: float
    step_tenths: int
    stiffness_nano: int
    turn_pulses: int
    gravity_cos_micro: int
    gravity_sin_micro: int
    points_micro: Sequence[int]

    def encoded(self) -> str:
        """Base64 with its CRC."""
        raw = struct.pack(
            "<BBHIIIii",
            *(self.axis, len(self.points_micro), round(self.ratio * 1e4), self.step_tenths, self.stiffness_nano),
            *(self.turn_pulses, self.gravity_cos_micro, self.gravity_sin_micro),
        )
        raw += struct.pack(f"<{len(self.points_micro)}i", *self.points_micro)
        return base64.b64encode(raw + crc16(raw).to_bytes(2, "little")).decode("ascii")


def record(rows: Rows, dropped_pulses: int) -> Record:
    """The samples from the first on, up to the first that is missing."""
    count = next(k for k in range(len(rows) + 1) if k not in rows)
    table = np.array([rows[k] for k in range(count)], dtype=np.int64).reshape(count, 3)
    return Record(table[:, 0], table[:, 1], table[:, 2], dropped_pulses)


class BlockCollector:
    """Cuts the text of a reply into base64 blocks as it comes, and keeps the rows of every intact one."""

    def __init__(self, number: int, velocity_shift: int, torque_shift: int, rows: Rows) -> None:
        self._number = number
        self._velocity_shift = velocity_shift
        self._torque_shift = torque_shift
        self._rows = rows
        self._text = ""

    def take(self, text: str, index: int) -> None:
        """The text of one BSC block."""
        self._text = text if index == 0 else self._text + text
        *whole, self._text = self._text.split(",")
        for coded in whole:
            self._keep(coded)

    def finish(self) -> None:
        """The reply is over: what is left is the last block."""
        self._keep(self._text)

    def _keep(self, coded: str) -> None:
        try:
            raw = base64.b64decode(coded, validate=True)
        except ValueError:
            return
        if len(raw) < _BLOCK_HEAD.size + 2 or crc16(raw[:-2]) != int.from_bytes(raw[-2:], "little"):
            return
        number, first, count = _BLOCK_HEAD.unpack_from(raw)
        if number != self._number or len(raw) != _BLOCK_HEAD.size + count * _SAMPLE_BYTES + 2:
            return
        for k in range(count):
            at = _BLOCK_HEAD.size + k * _SAMPLE_BYTES
            self._rows[first + k] = (
                int.from_bytes(raw[at : at + 4], "little", signed=True),
                int.from_bytes(raw[at + 4 : at + 7], "little", signed=True) << self._velocity_shift,
                int.from_bytes(raw[at + 7 : at + 10], "little", signed=True) << self._torque_shift,
            )
