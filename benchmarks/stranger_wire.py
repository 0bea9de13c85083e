"""A wire between two processes on which nobody is ever late: each frame of the host is answered before the next one.

The frames travel as UDP multicast over the loopback interface. When the node has done all that a frame makes it do, it
sends a frame that no CANopen device hears (29 bits), and only then the host's ``send`` returns. That is what a
lock-step clock promises to the driver: a loaded machine makes a run take longer, and changes no figure of it.
"""

from __future__ import annotations

from typing import Any

import can

from frictid_drivers.cia402 import Cia402Driver
from frictid_hil.plan.setup import RobotSetup
from frictid_hil.protocol.can_bus import open_bus
from frictid_hil.protocol.driver import DriverKind

DONE = can.Message(arbitration_id=0x1FFF_FFFF, is_extended_id=True)
_PATIENCE_S = 20.0


class AnsweredBus(can.BusABC):
    """The host's end.

    Args:
        bus: to the other process.
    """

    def __init__(self, bus: can.BusABC) -> None:
        self._bus = bus
        self._waiting: list[can.Message] = []
        self._own: set[int] = set()
        self.channel_info = f"answered {bus.channel_info}"
        super().__init__(channel="")

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Send, and keep what the node answers."""
        self._own.add(msg.arbitration_id)
        self._bus.send(msg, timeout)
        while (answer := self._bus.recv(_PATIENCE_S)) is not None:
            if answer.is_extended_id:
                return
            if answer.arbitration_id not in self._own:  # a multicast group hears itself
                self._waiting.append(answer)
        raise can.CanOperationError(f"the node has not dealt with {msg.arbitration_id:#x} within {_PATIENCE_S:g} s")

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        return (self._waiting.pop(0) if self._waiting else None), False

    def shutdown(self) -> None:
        """Leave the group."""
        super().shutdown()
        self._bus.shutdown()


class RunTime:
    """Run time that goes on only where somebody waits for it; see ``frictid_hil.protocol.driver.Clock``."""

    lock_step = True

    def __init__(self) -> None:
        self._now_ns = 0

    def restart(self) -> None:
        """Make now the zero of run time."""
        self._now_ns = 0

    def now_ns(self) -> int:
        """Run time now."""
        return self._now_ns

    def wait_until(self, deadline_ns: int) -> None:
        """Let run time go on."""
        self._now_ns = max(self._now_ns, deadline_ns)


class StrangerDriver(Cia402Driver):
    """The driver that real drives get, on that wire."""

    kind = DriverKind(simulated=True, addressed_by="node", addresses=(1, 127))

    def __init__(self, setup: RobotSetup, **more: Any) -> None:
        super().__init__(
            setup, bus_factory=lambda: AnsweredBus(open_bus(setup.bus, setup.options)), clock=RunTime(), **more
        )
