"""The bus and the clock of lock-step: no thread, no wall clock, every reply there before ``send`` returns."""

from __future__ import annotations

import queue
import threading
from typing import Any, cast

import can
from can.interfaces.virtual import VirtualBus

from frictid_drivers.virtual.faulty_rack import FaultyRack
from frictid_drivers.virtual.rack import Rack
from frictid_hil.protocol.can_frames import message_of
from frictid_hil.protocol.driver import FD_FRAME


class LockStepBus(VirtualBus):
    """The host's endpoint on python-can's virtual bus; other members of its channel hear everything, as on any bus."""

    def __init__(self, drives: Rack | FaultyRack, channel: str = "frictid", **arguments: Any) -> None:
        arguments.setdefault("protocol", can.CanProtocol.CAN_FD)
        super().__init__(channel=channel, preserve_timestamps=True, **arguments)
        self.channel_info = f"lock-step bus {channel}"
        # Same interface, a tenth of the cost; the old queue is this bus's entry in the channel's list.
        fast = cast("queue.Queue[can.Message]", queue.SimpleQueue())
        self.channel[self.channel.index(self.queue)] = fast
        self.queue = fast
        self.drives = drives
        self._lock = threading.RLock()
        drives.transmit = self._deliver

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Let every drive hear the frame; what they answer is received next."""
        self._check_if_open()
        with self._lock:
            if len(self.channel) > 1:
                super().send(msg, timeout)
            if not (msg.is_extended_id or msg.is_error_frame):
                # Bytes of its own: the caller may reuse the message.
                can_id = msg.arbitration_id | FD_FRAME if msg.is_fd else msg.arbitration_id
                self.drives.process(can_id, bytes(msg.data), remote=msg.is_remote_frame)

    def advance(self, to_ns: int) -> None:
        """Let run time go on."""
        with self._lock:
            self.drives.advance(to_ns)

    def recv(self, timeout: float | None = None) -> can.Message | None:
        """The next frame, or None once ``timeout`` seconds of wall clock have passed."""
        if self.filters:
            return super().recv(timeout)
        self._check_if_open()
        try:
            return self.queue.get(timeout is None or timeout > 0, timeout)
        except queue.Empty:
            return None

    def shutdown(self) -> None:
        """Leave the channel; drives talk to nobody from now on."""
        self.drives.transmit = lambda can_id, data: None
        super().shutdown()

    def _deliver(self, can_id: int, data: bytes) -> None:
        message = message_of(can_id, data)
        message.timestamp, message.channel = self.drives.now_ns * 1e-9, self.channel_id
        self.queue.put(message)
        for other in self.channel:
            if other is not self.queue:
                other.put(message)


class LockStepClock:
    """Run time of the drives on a lock-step bus, which passes only while somebody waits; see ``driver.Clock``."""

    lock_step = True

    def __init__(self, rack: Rack | FaultyRack) -> None:
        self._rack = rack
        self._origin_ns = rack.now_ns

    def restart(self) -> None:
        """Make now the zero of run time."""
        self._origin_ns = self._rack.now_ns

    def now_ns(self) -> int:
        """Run time now."""
        return self._rack.now_ns - self._origin_ns

    def wait_until(self, deadline_ns: int) -> None:
        """Let the drives run on to the deadline."""
        self._rack.advance(deadline_ns + self._origin_ns)
