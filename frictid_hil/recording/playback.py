"""A bus log as a python-can bus of its own: what was recorded comes again, at the recorded pace or at full speed.

Nothing answers on this bus: no drive is on it, and what is sent to it only reaches those who share the ``echo`` bus.
Everything that takes a python-can bus (a ``can.Notifier``, ``canopen``) can listen to a log this way.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from typing import Any

import can

from frictid_hil.protocol.driver import FD_FRAME
from frictid_hil.recording.bus_log import EXTENDED, Frames


class LogBus(can.BusABC):
    """The frames of a log, received at recorded speed (``paced``), or as fast as they are taken.

    Every frame is sent again on the ``echo`` bus, for others to see.
    """

    def __init__(self, frames: Frames, *, paced: bool = False, echo: can.BusABC | None = None) -> None:
        super().__init__(channel="log")
        self.channel_info = f"bus log of {len(frames)} frames"
        self._frames = logged(frames)
        self._paced = paced
        self._echo = echo
        self._first_ns: int | None = None
        self._began_ns = 0
        self._next = next(self._frames, None)

    def take(self, timeout_s: float | None = None) -> tuple[int, int, bytes] | None:
        """The next frame as ``(run time in ns, CAN id, data)``; None when it does not come in time, or none is left."""
        taken = self._next
        if taken is None:
            return None
        if self._paced and not self._wait_for(taken[0], timeout_s):
            return None
        if self._echo is not None:
            self._echo.send(_message(taken))
        self._next = next(self._frames, None)
        return taken

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Goes nowhere: no drive is on this bus."""

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        taken = self.take(timeout)
        return (None if taken is None else _message(taken)), True

    def _wait_for(self, t_ns: int, timeout_s: float | None) -> bool:
        if self._first_ns is None:
            self._first_ns, self._began_ns = t_ns, time.monotonic_ns()
        wait_s = (t_ns - self._first_ns - (time.monotonic_ns() - self._began_ns)) * 1e-9
        if timeout_s is not None and wait_s > timeout_s:
            time.sleep(max(0.0, timeout_s))
            return False
        if wait_s > 0:
            time.sleep(wait_s)
        return True


def logged(frames: Frames) -> Iterator[tuple[int, int, bytes]]:
    """Every frame as ``(run time in ns, CAN id, data)``, in the order of the log."""
    raw, width = frames.data.tobytes(), frames.data.shape[1]
    ends = zip(frames.t_ns.tolist(), frames.can_id.tolist(), frames.length.tolist(), strict=True)
    for number, (t_ns, can_id, length) in enumerate(ends):
        yield t_ns, can_id, raw[number * width : number * width + length]


def _message(frame: tuple[int, int, bytes]) -> Any:
    t_ns, can_id, data = frame
    return can.Message(
        timestamp=t_ns * 1e-9,
        arbitration_id=can_id & ~(EXTENDED | FD_FRAME),
        is_extended_id=bool(can_id & EXTENDED),
        is_fd=bool(can_id & FD_FRAME),
        bitrate_switch=bool(can_id & FD_FRAME),
        data=data,
    )
