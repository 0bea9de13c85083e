"""Layer B, batch: one job sent as one message, run and recorded by the controller, fetched in CRC-checked blocks.

Fits 9600 and 19200 baud: 4000 samples of 10 bytes are 40 kB, about half a minute at 19200. The data of a BSC block may
hold no control codes, so binary travels as base64 text; every block carries its own place and CRC, and a broken
transfer goes on with the first sample that is missing.
"""

from __future__ import annotations

import base64
import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from frictid_drivers.motoman.controller_errors import BadReply, LinkError, ManipulatorOperating
from frictid_drivers.motoman.host_control import HostControl
from frictid_drivers.motoman.stream_frames import crc16
from frictid_hil.errors import HardwareError, Interrupted, SafetyAbort

TABLE_POINTS: Final = 21
SAMPLES_PER_BLOCK: Final = 18
_SAMPLE_BYTES: Final = 10
_BLOCKS_PER_REQUEST: Final = 32
_BLOCK_HEAD: Final = struct.Struct("<HIB")
_FETCH_ATTEMPTS: Final = 5
_POLL_S: Final = 0.5

_FINISHED, _STOPPED = 3, 4
_STOP_REASONS: Final = {
    1: ("it heard nothing from the host for too long", "check the cable, then start again"),
    2: ("somebody pressed hold", "release it, then start again"),
    3: ("an alarm", "clear its cause, reset on the pendant, then start again"),
    4: ("a limit of position or step", "compare the limits of both sides with `check`"),
    5: ("torque above its limit", "look for a collision, a wrong travel, or a heavier load than planned"),
    6: ("the host asked it to", ""),
    7: ("servo power was lost", "look at the pendant, then start again"),
}


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


class BatchClient:
    """Talks to the batch application.

    Args:
        host: link and stock commands.
        now_s: clock of the port.
    """

    def __init__(self, host: HostControl, now_s: Callable[[], float]) -> None:
        self._host = host
        self._now_s = now_s

    def hello(self) -> BatchHello:
        """FHELLO.

        Raises:
            ControllerError: 1010 where there is no such application.
        """
        reply = self._host.ask("FHELLO 1")
        try:
            version, tick_us, axes, most_ticks, source, averaging, points, name = reply.split(",", 7)
            if int(version) != 1:
                raise BadReply(f"the batch application speaks version {version}, we speak 1", where="FHELLO")
            return BatchHello(
                tick_us=int(tick_us),
                axes=int(axes),
                most_ticks=int(most_ticks),
                torque_measured=int(source) == 1,
                averaging_ms=None if int(averaging) < 0 else int(averaging),
                table_points=int(points),
                name=name,
            )
        except ValueError:
            raise self._host.bad_reply(f"{reply!r} instead of a greeting", "FHELLO") from None

    def send(self, order: JobOrder) -> None:
        """FJOB. ``ControllerError`` where the controller refuses it."""
        self._host.order(order.text())

    def start(self, number: int) -> None:
        """FRUN; the arm moves."""
        try:
            self._host.order(f"FRUN 1,{number}")
        except ManipulatorOperating:
            # Asked twice because an acknowledgement was lost: the first one was heard.
            if self.state(number).state != 2:
                raise

    def state(self, number: int) -> JobState:
        """FSTAT."""
        reply = self._host.ask(f"FSTAT 1,{number}")
        try:
            state = JobState(*map(int, reply.split(",")))
        except (ValueError, TypeError):
            raise self._host.bad_reply(f"{reply!r} instead of a job's state", "FSTAT") from None
        if state.number != number:
            raise BadReply(f"state of job {state.number} instead of {number}", where="FSTAT")
        return state

    def stop(self, number: int, *, within_s: float | None = None) -> None:
        """FSTOP: decelerate."""
        self._host.order(f"FSTOP 1,{number}", within_s=within_s)

    def watch(
        self,
        number: int,
        duration_s: float,
        stop: Callable[[], bool],
        progress: Callable[[float], None],
        look: Callable[[], None] = lambda: None,
    ) -> JobState:
        """Wait for the end of a running job; asking is also what keeps its watchdog quiet.

        Args:
            number: of the job.
            duration_s: planned.
            stop: asked often; True ends the job.
            progress: told the share that is done.
            look: called once per question; a ``SafetyAbort`` of it ends the job and is raised once the joint stands.

        Returns:
            The state of the finished job.

        Raises:
            Interrupted: ``stop`` asked for it.
            SafetyAbort: the controller stopped it.
            HardwareError: it does not come to an end.
        """
        patience_s = duration_s * 1.2 + 10.0
        until_s = self._now_s() + patience_s
        stopping = False
        wrong: SafetyAbort | None = None
        while True:
            state = self.state(number)
            progress(state.done_ticks / max(1, state.total_ticks))
            if state.state not in (_FINISHED, _STOPPED) and not stopping:
                try:
                    look()
                except SafetyAbort as seen:
                    wrong, stopping = seen, True
                    self.stop(number)
                    continue
            if state.state == _FINISHED:
                return state
            if state.state == _STOPPED:
                if wrong is not None:
                    raise wrong
                if stopping:
                    raise Interrupted("stopped on request; the joint was brought to rest")
                why, next_step = _STOP_REASONS.get(state.reason, (f"reason {state.reason}", ""))
                alarm = f", alarm {state.alarm}" if state.alarm else ""
                raise SafetyAbort(
                    f"the controller stopped the job at tick {state.done_ticks} of {state.total_ticks}: {why}{alarm}",
                    where=f"job {number}",
                    next_step=next_step,
                )
            if self._now_s() > until_s:
                self.stop(number)
                raise HardwareError(
                    f"not over after {patience_s:.0f} s, planned {duration_s:.0f} s", where=f"job {number}"
                )
            poll_until_s = self._now_s() + _POLL_S
            while self._now_s() < poll_until_s:
                if stop() and not stopping:
                    stopping = True
                    self.stop(number)
                    break
                self._host.listen(min(0.05, poll_until_s - self._now_s()))

    def fetch(
        self,
        number: int,
        state: JobState,
        samples: int,
        progress: Callable[[float], None],
        rows: dict[int, tuple[int, int, int]] | None = None,
    ) -> Record:
        """FREAD until every sample is here; goes on after a broken transfer.

        Args:
            number: of the job.
            state: of the job, which is over.
            samples: how many to fetch.
            progress: told the share that is here.
            rows: filled as they come, by number; what is in it after an error may be kept (``record``).

        Raises:
            LinkError: a part cannot be transferred in several attempts.
            BadReply: what arrives instead is not this job's record.
        """
        rows = {} if rows is None else rows
        failures = 0
        while len(rows) < samples:
            before, first = len(rows), _first_missing(rows, samples)
            collector = _BlockCollector(number, state.velocity_shift, state.torque_shift, rows)
            failure: HardwareError = BadReply("no intact block in the reply", where=f"FREAD from sample {first} on")
            try:
                self._host.ask(f"FREAD 1,{number},{first},{_BLOCKS_PER_REQUEST * SAMPLES_PER_BLOCK}", collector.take)
                collector.finish()
            except (LinkError, BadReply) as error:
                failure = error
            failures = 0 if len(rows) > before else failures + 1
            if failures >= _FETCH_ATTEMPTS:
                raise failure
            progress(len(rows) / samples)
        return record(rows, state.dropped_pulses)

    def download(self, table: FrictionTable) -> None:
        """FTABLE, read back and compared.

        Raises:
            BadReply: what comes back is not what was sent.
        """
        coded = table.encoded()
        self._host.order(f"FTABLE 1,{coded}")
        if self._host.ask(f"FTREAD 1,{table.axis}") != coded:
            raise BadReply("the friction table reads back differently", where=f"axis {table.axis}")

    def compensate(self, axis_mask: int) -> None:
        """FCOMP: apply the tables of these axes from now on; 0 ends it."""
        self._host.order(f"FCOMP 1,{axis_mask}")


def record(rows: dict[int, tuple[int, int, int]], dropped_pulses: int) -> Record:
    """The samples from the first on, up to the first that is missing."""
    count = next(k for k in range(len(rows) + 1) if k not in rows)
    table = np.array([rows[k] for k in range(count)], dtype=np.int64).reshape(count, 3)
    return Record(table[:, 0], table[:, 1], table[:, 2], dropped_pulses)


class _BlockCollector:
    """Cuts the text of a reply into base64 blocks as it comes, and keeps the rows of every intact one."""

    def __init__(
        self, number: int, velocity_shift: int, torque_shift: int, rows: dict[int, tuple[int, int, int]]
    ) -> None:
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


def _first_missing(rows: dict[int, tuple[int, int, int]], samples: int) -> int:
    return next(k for k in range(samples) if k not in rows)
