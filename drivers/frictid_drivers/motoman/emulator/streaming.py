"""The streaming application: absolute targets with due ticks in, positions, velocities and torques out, every tick.

Layout of every frame, all little-endian: A5 5A, version * 16 + type, length of the payload, u16 sequence number,
payload, u16 CRC over everything after A5 5A.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence

from frictid_drivers.motoman.emulator.axis import Axis
from frictid_drivers.motoman.emulator.jobs import STOPPING_TICKS, crc16
from frictid_drivers.motoman.emulator.panel import Panel

SET_POINT, FEEDBACK, NACK, HELLO, STOP = 1, 2, 3, 4, 5
NAMES = {FEEDBACK: "feedback", NACK: "nack", HELLO: "hello", STOP: "stop"}
BAD_CRC, BAD_VERSION, BAD_SESSION, LATE, GAP, LIMIT, NOT_ARMED, ALARM = 1, 2, 3, 4, 5, 6, 7, 8
ARMED, LATCHED, DROPPED, EXTRAPOLATED, STRAYED, COMPENSATED = 1, 2, 4, 8, 16, 32

VERSION = 1
QUEUE = 64
WATCHDOG_TICKS = 3
_STRAY_RAD = 0.004
_NEARLY_DRY = 2
_SILENT_TICKS = 500  # a line on which nobody speaks and nothing moves goes back to host control


class _Refused(Exception):
    """A frame is answered by NACK: code, axis, due tick."""


class StreamApplication:
    """One streaming session after another, until the host leaves."""

    def __init__(
        self,
        panel: Panel,  # the controller
        mask: int,  # axes granted by FSTREAM
        say: Callable[[str, bytes], None],  # puts a frame on the wire; told kind and bytes
        on_leave: Callable[[], None],  # the line goes back to host control
        *,
        compensated: bool = False,  # a friction table is being applied
    ) -> None:
        self._panel = panel
        self._axes = panel.axes
        self._granted = mask
        self._say = say
        self._on_leave = on_leave
        self._compensated = compensated
        self._heard = bytearray()
        self._sequence = 0
        self._session = 0
        self._old_session = 0
        self._mask = 0
        self._moved: list[Axis] = []  # axes of the session, in the order of its frames
        self._last_heard: int | None = None
        self._last_due = 0
        self._last_asked: list[int] = []
        self._queue: dict[int, tuple[list[int], list[int]]] = {}
        self._armed = False
        self._latched = False
        self._misses = 0
        self._speed: list[float] = []
        self._stopping = 0
        self._dropped = False
        self._extrapolated = False
        self._idle_ticks = 0
        self._home: list[int] = []
        self.tick_number = 0  # since streaming began

    @property
    def moving(self) -> bool:
        """Targets are being followed, or the arm is still being decelerated."""
        return self._armed and (not self._latched or self._stopping > 0)

    @property
    def running_dry(self) -> bool:
        """Targets are being followed, and hardly any time is left to the last of them."""
        return self._armed and not self._latched and self._last_due - self.tick_number <= _NEARLY_DRY

    def hear(self, chunk: bytes) -> None:
        """Bytes from the host."""
        self._heard += chunk
        while True:
            start = self._heard.find(b"\xa5\x5a")
            if start < 0:
                del self._heard[: max(0, len(self._heard) - 1)]
                return
            del self._heard[:start]
            if len(self._heard) < 6:
                return
            kind, length = self._heard[2] & 15, self._heard[3]
            if kind not in (SET_POINT, HELLO, STOP) or length > 40:
                del self._heard[0]
                continue
            if len(self._heard) < length + 8:
                return
            frame = bytes(self._heard[: length + 8])
            if crc16(frame[2:-2]) != frame[-2] | frame[-1] << 8:
                del self._heard[0]
                self._nack(frame[4] | frame[5] << 8, BAD_CRC)
                continue
            del self._heard[: length + 8]
            self._take(frame[2] >> 4, kind, frame[4] | frame[5] << 8, frame[6:-2])

    def _send(self, kind: int, payload: bytes) -> None:
        body = bytes([VERSION << 4 | kind, len(payload)]) + self._sequence.to_bytes(2, "little") + payload
        self._sequence = (self._sequence + 1) & 0xFFFF
        self._say(NAMES[kind], b"\xa5\x5a" + body + crc16(body).to_bytes(2, "little"))

    def _nack(self, sequence: int, code: int, axis: int = 0xFF, due: int = 0) -> None:
        now = self.tick_number & 0xFFFF
        self._send(NACK, struct.pack("<HBBHBxH", sequence, code, self._session, due, axis, now))

    def _take(self, version: int, kind: int, sequence: int, payload: bytes) -> None:
        self._idle_ticks = 0
        try:
            _require(version == VERSION, BAD_VERSION)
            {HELLO: self._open, STOP: self._stop, SET_POINT: self._set_point}[kind](sequence, payload)
        except _Refused as refused:
            self._nack(sequence, *refused.args)

    def _open(self, sequence: int, payload: bytes) -> None:
        _require(len(payload) == 4, BAD_CRC)
        oldest, newest, mask, session = payload
        _require(oldest <= VERSION <= newest, BAD_VERSION)
        _require(session and mask and not mask & ~self._granted, BAD_SESSION)
        if session != self._session:
            _require(session != self._old_session, BAD_SESSION)
            self._old_session, self._session = self._session, session
            self._mask = mask
            self._moved = [axis for number, axis in enumerate(self._axes) if mask >> number & 1]
            self._last_heard = sequence
            self._queue.clear()
            self._armed = self._latched = False
            self._misses = self._stopping = 0
            self._last_asked = [axis.issued for axis in self._moved]
            self._home = [axis.pulses for axis in self._axes]
        self._greet()

    def _greet(self) -> None:
        flags = 1 | 2 | self._compensated << 2
        settings = self._panel.settings
        payload = struct.pack(
            "<BBBBHBBHHI",
            *(VERSION, self._session, self._mask, flags, settings.tick_us, WATCHDOG_TICKS, QUEUE),
            *(settings.averaging_ms, 0, self.tick_number),
        )
        plates = [axis.plate for axis in self._moved]
        limits = [struct.pack("<iii", plate.lowest, plate.highest, plate.step) for plate in plates]
        self._send(HELLO, payload + b"".join(limits))

    def _stop(self, sequence: int, payload: bytes) -> None:
        _require(len(payload) == 4, BAD_SESSION)
        session, kind = payload[0], payload[1]
        _require(session == self._session or kind != 0, BAD_SESSION)
        if self._armed:
            self.halt("host")
        self._send(STOP, payload)
        if kind == 1:
            self._on_leave()

    def halt(self, reason: str) -> None:
        """Decelerate and latch; a lost servo power needs no deceleration."""
        if not self._armed or self._latched:
            return
        self._latched = True
        self._queue.clear()
        self._stopping = 0 if reason in ("alarm", "servo off") else STOPPING_TICKS
        if reason == "watchdog":
            self._panel.holds.add("command")

    def _set_point(self, sequence: int, payload: bytes) -> None:
        count = len(self._moved)
        _require(count and len(payload) in (4 + 4 * count, 4 + 6 * count), BAD_SESSION)
        session, mask, due = struct.unpack_from("<BBH", payload)
        targets = list(struct.unpack_from(f"<{count}i", payload, 4))
        torques = list(struct.unpack_from(f"<{count}h", payload, 4 + 4 * count)) if len(payload) > 4 + 4 * count else []
        _require(session == self._session and mask == self._mask, BAD_SESSION, due=due)
        assert self._last_heard is not None
        ahead = (sequence - self._last_heard) & 0xFFFF
        if ahead != 1:
            self._nack(sequence, GAP, due=due)
        if not 0 < ahead < 0x8000:
            return
        self._last_heard = sequence
        wide_due = self.tick_number + ((due - self.tick_number) & 0xFFFF)
        self._judge(targets, wide_due, due)
        if not self._armed:
            self._armed = self._panel.operating = True
            self._misses = 0
            self._speed = [0.0] * count
        self._last_due, self._last_asked = wide_due, targets
        self._queue[wide_due] = (targets, torques)

    def _judge(self, targets: Sequence[int], wide_due: int, due: int) -> None:
        """Refuse what must not be followed; ``wide_due`` is the due tick in full."""
        _require(not self._panel.alarm, ALARM, due=due)
        _require(not self._latched and self._panel.moving_forbidden() in (0, 2010), NOT_ARMED, due=due)
        _require(2 <= wide_due - self.tick_number <= QUEUE, LATE, due=due)
        _require(not self._armed or wide_due > self._last_due, LATE, due=due)
        ticks = wide_due - self._last_due if self._armed else 1
        for axis, target, before in zip(self._moved, targets, self._last_asked, strict=True):
            plate = axis.plate
            allowed = plate.lowest <= target <= plate.highest and abs(target - before) <= plate.step * ticks
            _require(allowed, LIMIT, self._axes.index(axis), due)

    def tick(self, dropped: int) -> None:
        """One tick: report what is, then issue what is due next."""
        self.tick_number += 1
        if self._session:
            self._report()
        self._idle_ticks += 1
        if self._idle_ticks > _SILENT_TICKS and not self.moving:
            self._on_leave()
            return
        self._dropped = self._extrapolated = False
        if not self._armed:
            return
        forbidden = self._panel.moving_forbidden()
        if forbidden not in (0, 2010) and not self._latched:
            self.halt("alarm" if forbidden in (2060, 2070) else "hold")
        if self._latched:
            self._decelerate()
            return
        due = self.tick_number + 1
        if due in self._queue:
            self._misses = 0
            targets, torques = self._queue.pop(due)
            self._go(targets, dropped)
            self._feed_forward(torques)
        elif self._queue:
            self._between(due, dropped)
        elif self._last_due < due:
            self._miss(due, dropped)

    def _go(self, targets: Sequence[float], dropped: int = 0) -> None:
        for place, axis in enumerate(self._moved):
            before = axis.issued
            if axis.ask(round(targets[place]), dropped):
                self._dropped = True
            self._speed[place] = axis.issued - before

    def _go_by(self, steps: Sequence[float], dropped: int = 0) -> None:
        self._go([axis.issued + step for axis, step in zip(self._moved, steps, strict=True)], dropped)

    def _between(self, due: int, dropped: int) -> None:
        """A tick that the host left out, between here and its next target: a straight line."""
        later = min(self._queue)
        targets = self._queue[later][0]
        share = 1.0 / (later - due + 1)
        steps = [(goal - axis.issued) * share for goal, axis in zip(targets, self._moved, strict=True)]
        self._go_by(steps, dropped)

    def _miss(self, due: int, dropped: int) -> None:
        """Nothing to do: one tick straight on, then slower, and at the third the watchdog latches."""
        self._misses += 1
        if self._misses >= WATCHDOG_TICKS:
            self.halt("watchdog")
            self._decelerate()
            return
        self._extrapolated = True
        if self._misses > 1:
            self._slow_down()
        self._go_by(self._speed, dropped)

    def _decelerate(self) -> None:
        if self._stopping > 0:
            self._slow_down()
            self._stopping -= 1
            speed = list(self._speed)
            self._go_by(speed)
            self._speed = speed
        if self._stopping == 0:
            self._panel.operating = False
        self._feed_forward([])

    def _slow_down(self) -> None:
        left = max(1, self._stopping or STOPPING_TICKS)
        self._speed = [speed * (left - 1) / left for speed in self._speed]

    def _feed_forward(self, torques: Sequence[int]) -> None:
        for axis, torque in zip(self._moved, torques or [0] * len(self._moved), strict=True):
            axis.feed_forward_nm = axis.plate.sign * torque * 1e-4 * axis.plate.rated_torque_nm

    def _report(self) -> None:
        first, second = self._panel.words()
        strayed = any(
            abs(axis.pulses - self._home[number]) > abs(_STRAY_RAD * axis.plate.pulses_per_rad)
            for number, axis in enumerate(self._axes)
            if not self._mask >> number & 1
        )
        flags = self._latched * LATCHED | self._dropped * DROPPED | self._extrapolated * EXTRAPOLATED
        flags |= (self._armed and not self._latched) * ARMED | strayed * STRAYED | self._compensated * COMPENSATED
        payload = struct.pack(
            "<IHBBHBBBBH",
            *(self.tick_number, self._last_heard or 0, first, second, self._panel.alarm, len(self._queue), flags),
            *(self._session, self._mask, 0),
        )
        axes = [struct.pack("<iii", axis.pulses, axis.speed_tenths, axis.torque_micro) for axis in self._moved]
        self._send(FEEDBACK, payload + b"".join(axes))


def _require(condition: object, code: int, axis: int = 0xFF, due: int = 0) -> None:
    if not condition:
        raise _Refused(code, axis, due)
