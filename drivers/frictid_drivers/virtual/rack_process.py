"""The simulated drives in a process of their own, on the wall clock.

``python -m frictid_drivers.virtual.rack_process``: its owner writes one JSON line with the robot to its standard input
and reads one line back (``ready``, or what is wrong); from then on the drives are on the bus ``frictid:CHANNEL``. The
process ends when the owner says ``end``. When the owner disappears instead - SIGKILL of the host loop - the drives live
on until their own watchdogs have brought every joint to rest, so that what drives do without their host happens here as
it does in a robot.

Run time here is paced by SYNC, see ``SyncTime``: the scheduling jitter of two processes does not become motion.
"""

from __future__ import annotations

import contextlib
import gc
import os
import select
import signal
import sys
import time
from collections.abc import Callable, Sequence
from typing import Protocol

from frictid_drivers.virtual import channel
from frictid_drivers.virtual.faults import Fault, faults_of, missing_objects
from frictid_drivers.virtual.faulty_rack import FaultyRack, leave_in_fault
from frictid_drivers.virtual.rack import Rack
from frictid_drivers.virtual.rack_launcher import DISMISSAL, READY, decode_setup
from frictid_drivers.virtual.socket_bus import EXTENDED, REMOTE, Hub
from frictid_hil.errors import FrictidError
from frictid_hil.protocol.driver import FD_FRAME

SYNC_ID = 0x80
PATIENCE_NS = 50_000_000  # how long run time waits for a SYNC before the wall clock goes on without it

SYNC_GAP_TENTHS = 500
"""2010h:01 on the wall clock: 50 periods. The host's heartbeat, not SYNC, is what stops the drives here."""

_LONGEST_WAIT_S = 0.005
_SHORTEST_WAIT_S = 0.0002
_FAREWELL_NS = 10_000_000_000
_STANDSTILL_NS = 1_000_000_000
_FIFO_PRIORITY = 50


class SyncTime:
    """Run time of the drives on the wall clock, paced by SYNC.

    Every SYNC is one period of run time, whenever exactly it comes; without SYNC run time waits for ``PATIENCE_NS``,
    then follows the wall clock again. So a machine that keeps a process from running for some milliseconds, as every
    ordinary one does, gives the simulated joint the motion of lock-step instead of a jerk; the host counts its late and
    missed cycles all the same. Run time never runs ahead of the wall clock by more than two periods.
    """

    def __init__(self, period_ns: int = 0) -> None:
        self.period_ns = period_ns  # of SYNC; 0 without one, and run time is the wall clock's
        self._ceiling_ns = 0  # run time minus wall time at the last start of a series of SYNCs
        self._last: tuple[int, int] | None = None  # wall time and run time of the last SYNC

    def time_ns(self, wall_ns: int) -> int:
        """Run time at a moment of the wall clock."""
        if self._last is None:
            return wall_ns
        last_wall_ns, last_ns = self._last
        return last_ns + max(0, wall_ns - last_wall_ns - PATIENCE_NS)

    def sync_ns(self, wall_ns: int) -> int:
        """Run time of a SYNC that was sent at a moment of the wall clock."""
        now_ns = self.time_ns(wall_ns)
        if self._last is None or not self.period_ns or wall_ns - self._last[0] > PATIENCE_NS:
            self._ceiling_ns = now_ns - wall_ns + 2 * self.period_ns
        else:
            now_ns = max(now_ns, min(now_ns + self.period_ns, wall_ns + self._ceiling_ns))
        if self.period_ns:
            self._last = (wall_ns, now_ns)
        return now_ns


class Wire(Protocol):
    """What the drives need of the bus between processes: a ``Hub``, or a ``BusWire``."""

    heard: Callable[[int, bytes, int], None]

    @property
    def members(self) -> int:
        """How many are connected."""

    def send(self, can_id: int, data: bytes) -> None:
        """To all members."""

    def wait(self, longest_s: float) -> None:
        """For something to serve."""

    def serve(self) -> None:
        """All that has arrived."""


class RackProcess:
    """The drives, their bus and their clock."""

    def __init__(self, rack: Rack, hub: Wire, faults: Sequence[Fault] = (), *, now_ns: int | None = None) -> None:
        self._rack = rack
        self._faults = faults
        self._drives = FaultyRack(rack, faults) if faults else rack
        self._hub = hub
        self._origin_ns = (time.monotonic_ns() if now_ns is None else now_ns) - rack.now_ns
        self._time = SyncTime()
        self._drives.transmit = hub.send
        hub.heard = self._heard

    def _heard(self, can_id: int, data: bytes, stamp_ns: int) -> None:
        if can_id & EXTENDED:
            return
        wall_ns = stamp_ns - self._origin_ns
        if can_id == SYNC_ID:
            self._time.period_ns = next((servo.sync_period_ns for servo in self._rack.servos.values()), 0)
            self._drives.advance(self._time.sync_ns(wall_ns))
        else:
            self._drives.advance(self._time.time_ns(wall_ns))
        self._drives.process(can_id & (0x7FF | FD_FRAME), data, remote=bool(can_id & REMOTE))

    def serve_until(self, now_ns: int) -> int:
        """Deal with what was sent until a moment of the monotonic clock, then let run time reach it; returns it."""
        wall_ns = now_ns - self._origin_ns
        self._hub.serve()
        self._drives.advance(self._time.time_ns(wall_ns))
        return wall_ns

    def run(self, over: Callable[[int, bool], bool]) -> None:
        """Serve until it is ``over``: asked with the wall clock in ns, and whether the robot rests unobserved."""
        self._drives.power_on()
        leave_in_fault(self._rack, self._faults)
        while True:
            wait_s = (self._drives.next_event_ns - self._drives.now_ns) * 1e-9
            self._hub.wait(min(_LONGEST_WAIT_S, max(_SHORTEST_WAIT_S, wait_s)))
            # First the time, then the frames: none that was sent before it is left when run time reaches it.
            wall_ns = self.serve_until(time.monotonic_ns())
            if over(wall_ns, self._rack.at_rest and not self._hub.members):
                return


class Owner:
    """The process that started this one, at the other end of our standard input."""

    def __init__(self, descriptor: int) -> None:
        self._descriptor = descriptor
        self._pid = os.getppid()
        self._gone_ns: int | None = None
        self._resting_ns: int | None = None

    def over(self, now_ns: int, resting: bool) -> bool:
        """It needs the drives no longer; without it they live on for a second of standstill unobserved, at most ten."""
        if self._gone_ns is None:
            if select.select([self._descriptor], [], [], 0)[0]:
                word = os.read(self._descriptor, 64)
                if DISMISSAL.encode() in word:
                    return True
                self._gone_ns = None if word else now_ns
            # A child of the owner may have inherited the pipe and hold it open.
            if os.getppid() != self._pid:
                self._gone_ns = now_ns
            if self._gone_ns is None:
                return False
        if not resting:
            self._resting_ns = None
        elif self._resting_ns is None:
            self._resting_ns = now_ns
        rested = self._resting_ns is not None and now_ns - self._resting_ns > _STANDSTILL_NS
        return rested or now_ns - self._gone_ns > _FAREWELL_NS


def be_punctual() -> None:
    """Real-time scheduling where it is permitted, and no collection of what is there by now."""
    with contextlib.suppress(OSError):
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(_FIFO_PRIORITY))
    gc.collect()
    gc.freeze()


def main() -> int:
    """Entry of the process."""
    # Ctrl-C is for the owner, who then dismisses us.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    owner = Owner(sys.stdin.fileno())
    setup = decode_setup(sys.stdin.readline())
    rack = Rack()
    try:
        faults = faults_of(setup)
        rack.install(setup, missing=missing_objects(faults), sync_gap_tenths=SYNC_GAP_TENTHS)
        hub = Hub(channel.socket_path(channel.channel_name(setup.bus)))
    except (FrictidError, OSError) as error:
        print(f"failed: {error}", flush=True)
        return 1
    rack.warm_up()
    be_punctual()
    process = RackProcess(rack, hub, faults)
    print(READY, flush=True)
    try:
        process.run(owner.over)
    finally:
        with contextlib.suppress(OSError):
            hub.close()
    return 0


if __name__ == "__main__":
    sys.exit(main())
