"""A wire without hardware: run time that passes when somebody waits, and a CAN bus with devices of your own on it."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterable
from typing import Any, Protocol

import can

from frictid_hil.protocol.can_frames import identifier_of, message_of
from frictid_hil.protocol.driver import Clock

Frame = tuple[int, bytes]  # identifier (bit 31: 29 bits, bit 29: CAN FD) and data


class Devices(Protocol):
    """What hangs on a wire."""

    def receive(self, can_id: int, data: bytes) -> Iterable[Frame]:
        """A frame of the host arrives; the frames that answer it."""

    def advance(self, to_ns: int) -> None:
        """Time goes on."""


class ManualClock:
    """Run time in lock-step: it passes only while somebody waits for it."""

    lock_step = True

    def __init__(self, advance: Callable[[int], None] = lambda _: None) -> None:
        self._advance = advance  # told how far time goes on, ns since this clock was made
        self._now_ns = self._origin_ns = 0

    def restart(self) -> None:
        """Make now the zero of run time."""
        self._origin_ns = self._now_ns

    def now_ns(self) -> int:
        """Run time now."""
        return self._now_ns - self._origin_ns

    def wait_until(self, deadline_ns: int) -> None:
        """Let time go on to the deadline."""
        if deadline_ns + self._origin_ns > self._now_ns:
            self._now_ns = deadline_ns + self._origin_ns
            self._advance(self._now_ns)


class FakeCanBus(can.BusABC):
    """The host's end of a wire with devices of yours; answers are there when ``send`` returns."""

    # In lock-step the clock lets the devices go on by itself; on the wall clock this bus does when it is touched.
    def __init__(self, devices: Devices, clock: Clock) -> None:
        self._devices = devices
        self._clock = clock
        self._started_ns = time.monotonic_ns()
        self._queue: deque[can.Message] = deque()
        # Passed every frame and whether it goes to the host; returns what becomes of it: [] for lost.
        self.fault: Callable[[Frame, bool], list[Frame]] | None = None
        self.channel_info = "fake bus"
        super().__init__(channel="fake")

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Let every device hear the frame."""
        self._go_on()
        for frame in self._through((identifier_of(msg), bytes(msg.data)), False):
            for answer in self._devices.receive(*frame):
                self._queue += [message_of(*answered) for answered in self._through(answer, True)]

    def recv(self, timeout: float | None = None) -> can.Message | None:
        """The next answer, or None once ``timeout`` seconds have passed."""
        self._go_on()
        if self._queue:
            return self._queue.popleft()
        if timeout and not self._clock.lock_step:
            time.sleep(timeout)
        return None

    def _go_on(self) -> None:
        if not self._clock.lock_step:
            self._devices.advance(time.monotonic_ns() - self._started_ns)

    def _through(self, frame: Frame, to_host: bool) -> list[Frame]:
        return [frame] if self.fault is None else self.fault(frame, to_host)

    def _recv_internal(self, timeout: float | None) -> tuple[Any, bool]:
        return self.recv(timeout), True
