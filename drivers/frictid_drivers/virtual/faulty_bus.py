"""Any python-can bus with a bad cable: frames dropped, late, twice, out of order or with a bit inverted, both ways."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Any

import can

from frictid_drivers.virtual.faults import Fault, FrameFaults, Late


class FaultyBus(can.BusABC):
    """A bus in front of a bus.

    Args:
        bus: the good one; shut down together with this.
        faults: frame faults, ``at_s`` from now on.
        now_ns: run time; the monotonic clock unless told.
    """

    def __init__(self, bus: can.BusABC, faults: Sequence[Fault], now_ns: Callable[[], int] = time.monotonic_ns) -> None:
        self._bus = bus
        self._clock = now_ns
        self._start_ns = now_ns()
        self._outgoing, self._incoming = FrameFaults(faults), FrameFaults(faults)
        self._late_out, self._late_in = Late(), Late()
        self._received: list[can.Message] = []
        self.channel_info = f"{bus.channel_info}, with a bad cable"
        super().__init__(channel="faulty")

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Send what the cable makes of the frame."""
        self._late_out.run(self._now_ns())
        for due_ns, _, data in self._outgoing.through(self._now_ns(), msg.arbitration_id, bytes(msg.data)):
            frame = _with_data(msg, data)
            if due_ns <= self._now_ns():
                self._bus.send(frame, timeout)
            else:
                self._late_out.put(due_ns, _later(self._bus.send, frame))

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        deadline_s = None if timeout is None else time.monotonic() + timeout
        while True:
            self._late_out.run(self._now_ns())
            self._late_in.run(self._now_ns())
            if self._received:
                return self._received.pop(0), False
            left_s = 0.01 if deadline_s is None else min(0.01, max(0.0, deadline_s - time.monotonic()))
            msg = self._bus.recv(left_s)
            if msg is None:
                if deadline_s is not None and time.monotonic() >= deadline_s:
                    return None, False
                continue
            for due_ns, _, data in self._incoming.through(self._now_ns(), msg.arbitration_id, bytes(msg.data)):
                frame = _with_data(msg, data)
                if due_ns <= self._now_ns():
                    self._received.append(frame)
                else:
                    self._late_in.put(due_ns, _later(self._received.append, frame))

    def shutdown(self) -> None:
        """Both buses."""
        super().shutdown()
        self._bus.shutdown()

    def _now_ns(self) -> int:
        return self._clock() - self._start_ns


def _with_data(msg: can.Message, data: bytes) -> can.Message:
    if data == msg.data:
        return msg
    return can.Message(
        timestamp=msg.timestamp,
        arbitration_id=msg.arbitration_id,
        is_extended_id=msg.is_extended_id,
        data=data,
        channel=msg.channel,
        is_fd=msg.is_fd,
        bitrate_switch=msg.bitrate_switch,
    )


def _later(action: Callable[[can.Message], Any], frame: can.Message) -> Callable[[], None]:
    return lambda: action(frame)
