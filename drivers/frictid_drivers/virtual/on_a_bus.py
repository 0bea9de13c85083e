"""The simulated drives on a bus of their own choice: ``frictid-hil emulate cia402 --bus socketcan:vcan0``.

Any interface of python-can will do, and any host that speaks CANopen: our own on a virtual CAN of the kernel, or a
program that somebody else wrote. The drives stop by their own watchdogs when that host disappears.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable

import can

from frictid_drivers.virtual.faults import faults_of, missing_objects
from frictid_drivers.virtual.rack import Rack
from frictid_drivers.virtual.rack_process import SYNC_GAP_TENTHS, RackProcess, be_punctual
from frictid_drivers.virtual.socket_bus import REMOTE
from frictid_hil.plan.setup import RobotSetup
from frictid_hil.protocol.can_bus import open_bus
from frictid_hil.protocol.can_frames import identifier_of, message_of

_PAUSE_S = 0.01  # after a bus that is down; it may come back


class BusWire:
    """A python-can bus as the wire of the drives."""

    members = 1  # somebody may always be there

    def __init__(self, bus: can.BusABC) -> None:
        self._bus = bus
        self._next: can.Message | None = None
        # Called for every frame of others but error frames.
        self.heard: Callable[[int, bytes, int], None] = lambda can_id, data, stamp_ns: None

    def send(self, can_id: int, data: bytes) -> None:
        """A frame of the drives; lost where the bus is down or full, as on a wire."""
        with contextlib.suppress(can.CanError, OSError):
            self._bus.send(message_of(can_id, data))

    def wait(self, longest_s: float) -> None:
        """Return when there is a frame, or after so long."""
        if self._next is None:
            self._next = self._received(longest_s)

    def serve(self) -> None:
        """Deal with everything that has arrived."""
        message, self._next = self._next or self._received(0.0), None
        while message is not None:
            if not message.is_error_frame:
                can_id = identifier_of(message) | REMOTE * message.is_remote_frame
                self.heard(can_id, bytes(message.data), time.monotonic_ns())
            message = self._received(0.0)

    def _received(self, longest_s: float) -> can.Message | None:
        try:
            return self._bus.recv(longest_s)
        except (can.CanError, OSError):
            time.sleep(_PAUSE_S)
            return None


def serve(setup: RobotSetup, *, announce: Callable[[str], None], stop: Callable[[], bool] = lambda: False) -> None:
    """Run until ``stop``, asked many times a second, says so; ``announce`` is told the bus once the drives are on it.

    The robot's ``bus`` and ``options`` say where these drives are, and what goes wrong. ``InvalidFields`` where joints
    or faults are wrong, ``HardwareError`` where the bus cannot be opened.
    """
    faults, rack = faults_of(setup), Rack()
    rack.install(setup, missing=missing_objects(faults), sync_gap_tenths=SYNC_GAP_TENTHS)
    rack.warm_up()
    be_punctual()
    options = {key: value for key, value in setup.options.items() if key != "faults"}
    with open_bus(setup.bus, options) as bus:
        process = RackProcess(rack, BusWire(bus), faults)
        announce(setup.bus)
        process.run(lambda now_ns, resting: stop())
