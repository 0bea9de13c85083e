"""The simulated drives in a process of their own, on the wall clock.

``python -m frictid_drivers.virtual.rack_process``: its owner writes one JSON line with the robot to its standard input
and reads one line back (``ready``, or what is wrong); from then on the drives are on the bus ``frictid:CHANNEL``. The
process ends when the owner says ``end``. When the owner disappears instead - SIGKILL of the host loop - the drives live
on until their own watchdogs have brought every joint to rest, so that what drives do without their host happens here as
it does in a robot.

The drives' time follows SYNC where there is one, as in drives that lock their control loops to it: a SYNC is taken to
be exactly on its grid, so that the jitter of two processes' scheduling does not become motion.
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
from frictid_drivers.virtual.faulty_rack import FaultyRack
from frictid_drivers.virtual.rack import Rack
from frictid_drivers.virtual.rack_launcher import DISMISSAL, READY, decode_setup
from frictid_drivers.virtual.socket_bus import ERROR, EXTENDED, REMOTE, Hub
from frictid_hil.errors import FrictidError

SYNC_ID = 0x80
SYNC_GAP_TENTHS = 500
"""2010h:01 on the wall clock: 50 periods. An ordinary operating system loses the processor for tens of milliseconds now
and then; the host's heartbeat, not SYNC, is what stops the drives here."""

_LONGEST_WAIT_S = 0.005
_SHORTEST_WAIT_S = 0.0002
_FAREWELL_NS = 10_000_000_000
_STANDSTILL_NS = 1_000_000_000
_FIFO_PRIORITY = 50
_GRID_GAP = 10
_EARLY_SHARE, _LATE_SHARE = 0.2, 0.002


class SyncGrid:
    """Run time of the drives on the wall clock, locked to SYNC.

    A SYNC belongs to a point of the grid when it was sent from a fifth of a period before it to four fifths after, and
    counts as sent exactly there. Processes are late now and then but never early, so the grid follows early SYNCs fast
    and late ones slowly. Between SYNCs run time stands on the last point whose SYNC cannot come any more. After ten
    periods without SYNC the next one starts a new grid.

    Attributes:
        period_ns: of SYNC; 0 without one, and run time is the wall clock's.
    """

    def __init__(self, period_ns: int = 0) -> None:
        self.period_ns = period_ns
        self._offset_ns = 0.0  # grid time minus wall time
        self._last_ns: int | None = None

    def time_ns(self, wall_ns: int) -> int:
        """Run time at a moment of the wall clock."""
        raw_ns = wall_ns + round(self._offset_ns)
        if not self.period_ns or self._last_ns is None:
            return raw_ns
        periods = self._periods(raw_ns, self._last_ns) - 1
        return raw_ns if periods > _GRID_GAP else self._last_ns + max(0, periods) * self.period_ns

    def sync_ns(self, wall_ns: int) -> int:
        """Run time of a SYNC that was sent at a moment of the wall clock."""
        raw_ns = wall_ns + round(self._offset_ns)
        if self.period_ns and self._last_ns is not None:
            periods = self._periods(raw_ns, self._last_ns)
            if periods <= _GRID_GAP:
                grid_ns = self._last_ns + max(0, periods) * self.period_ns
                early_ns = grid_ns - raw_ns
                self._offset_ns += early_ns * (_EARLY_SHARE if early_ns > 0 else _LATE_SHARE)
                self._last_ns = grid_ns
                return grid_ns
        self._last_ns = raw_ns
        return raw_ns

    def _periods(self, raw_ns: int, last_ns: int) -> int:
        """Points of the grid since the last SYNC, the one that a SYNC sent now would belong to included."""
        return (raw_ns - last_ns + self.period_ns // 5) // self.period_ns


class Wire(Protocol):
    """What the drives need of the bus between processes: a ``Hub``."""

    heard: Callable[[int, bytes, int], None]

    @property
    def members(self) -> int:
        """How many are connected."""
        ...

    def send(self, can_id: int, data: bytes) -> None:
        """To all members."""
        ...

    def wait(self, longest_s: float) -> None:
        """For something to serve."""
        ...

    def serve(self) -> None:
        """All that has arrived."""
        ...


class RackProcess:
    """The drives, their bus and their clock."""

    def __init__(self, rack: Rack, hub: Wire, faults: Sequence[Fault] = (), *, now_ns: int | None = None) -> None:
        self._rack = rack
        self._drives = FaultyRack(rack, faults) if faults else rack
        self._hub = hub
        self._origin_ns = (time.monotonic_ns() if now_ns is None else now_ns) - rack.now_ns
        self._grid = SyncGrid()
        self._drives.transmit = hub.send
        hub.heard = self._heard

    def _heard(self, can_id: int, data: bytes, stamp_ns: int) -> None:
        if can_id & (EXTENDED | ERROR):
            return
        wall_ns = stamp_ns - self._origin_ns
        if can_id == SYNC_ID:
            self._grid.period_ns = next((servo.sync_period_ns for servo in self._rack.servos.values()), 0)
            self._drives.advance(self._grid.sync_ns(wall_ns))
        else:
            self._drives.advance(self._grid.time_ns(wall_ns))
        self._drives.process(can_id & 0x7FF, data, remote=bool(can_id & REMOTE))

    def serve_until(self, now_ns: int) -> int:
        """Deal with what was sent until a moment of the monotonic clock, then let run time reach it; returns it."""
        wall_ns = now_ns - self._origin_ns
        self._hub.serve()
        self._drives.advance(self._grid.time_ns(wall_ns))
        return wall_ns

    def run(self, owner: Owner) -> None:
        """Serve until the owner says so, or is gone and the robot stands still."""
        self._drives.power_on()
        farewell = _Farewell()
        while True:
            wait_s = (self._drives.next_event_ns - self._drives.now_ns) * 1e-9
            self._hub.wait(min(_LONGEST_WAIT_S, max(_SHORTEST_WAIT_S, wait_s)))
            # First the time, then the frames: none that was sent before it is left when run time reaches it.
            wall_ns = self.serve_until(time.monotonic_ns())
            owner.listen()
            if owner.dismissed or (
                owner.gone and farewell.over(wall_ns, resting=self._rack.at_rest and not self._hub.members)
            ):
                return


class _Farewell:
    """How long drives without an owner live on: a second of standstill unobserved, at most ten altogether."""

    def __init__(self) -> None:
        self._since_ns: int | None = None
        self._resting_since_ns: int | None = None

    def over(self, now_ns: int, *, resting: bool) -> bool:
        """It is time to end."""
        self._since_ns = now_ns if self._since_ns is None else self._since_ns
        if not resting:
            self._resting_since_ns = None
        elif self._resting_since_ns is None:
            self._resting_since_ns = now_ns
        rested = self._resting_since_ns is not None and now_ns - self._resting_since_ns > _STANDSTILL_NS
        return rested or now_ns - self._since_ns > _FAREWELL_NS


class Owner:
    """The process that started this one, at the other end of our standard input.

    Attributes:
        dismissed: it said that the drives are no longer needed.
        gone: it ended without saying so.
    """

    def __init__(self, descriptor: int) -> None:
        self._descriptor = descriptor
        self._pid = os.getppid()
        self.dismissed = False
        self.gone = False

    def listen(self) -> None:
        """Look whether there is word of it."""
        if self.gone:
            return
        readable, _, _ = select.select([self._descriptor], [], [], 0)
        if readable:
            word = os.read(self._descriptor, 64)
            self.dismissed = DISMISSAL.encode() in word
            self.gone = not word
        # A child of the owner may have inherited the pipe and hold it open.
        self.gone = self.gone or os.getppid() != self._pid


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
    with contextlib.suppress(OSError):
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(_FIFO_PRIORITY))
    gc.collect()
    gc.freeze()
    process = RackProcess(rack, hub, faults)
    print(READY, flush=True)
    try:
        process.run(owner)
    finally:
        with contextlib.suppress(OSError):
            hub.close()
    return 0


if __name__ == "__main__":
    sys.exit(main())
