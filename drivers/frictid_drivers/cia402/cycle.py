"""The exchange: late frames, commands, SYNC, reports, watchdogs - once per cycle, on one thread, without canopen.

::

    drain what came late -> RPDOs -> SYNC -> receive until all awaited reports are here or the window ends -> checks

On the wall clock, what comes after the awaited reports is of the next cycle: heartbeats, and reports that are due only
now and then.

Commands and reports are CAN FD frames where the layout says so; SYNC and heartbeats never are. A drive that answers in
the other kind of frame ends the run: the bus load was computed for this one, and its set-points are not heard.

A cycle never sends more than the layout's bus load allows for: every active joint's command, and at most one more
frame, to whichever other joint or command changed.

A stop goes out as a PDO. Where it is not seen to be followed - the drive missed its PDO, is not operational, reports
nothing, or hears another master - it goes out again by SDO, and then after the drive's PDOs were ended by NMT; without
waiting for any answer.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Sequence

import can

from frictid_drivers.cia402.axis import Axis
from frictid_drivers.cia402.codec import HEARTBEAT_BASE, Command, Decoder
from frictid_drivers.cia402.frame_map import FrameMap
from frictid_drivers.cia402.layout import Layout
from frictid_drivers.cia402.settings import BusSettings
from frictid_drivers.cia402.state import DISABLE_VOLTAGE, QUICK_STOP, DriveState, Target
from frictid_hil.errors import FrictidError, HardwareError, SafetyAbort
from frictid_hil.plan.mode import Mode
from frictid_hil.protocol.can_bus import BUS_ERRORS, another_master
from frictid_hil.protocol.can_frames import BUS_OFF, CONTROLLER_STATES, Heard, frames_of
from frictid_hil.protocol.driver import FD_FRAME, Clock, Feedback, FrameSink, SetPoint, by_the_batch

SYNC_COB_ID = 0x80
_OPERATIONAL = b"\x05"
_WIRE_FAILURES = 3
_INSIST_NS = 90_000_000  # by SDO after so long, by NMT after twice, disabled voltage after three times of it
_BRAKE_NS = 400_000_000
_UNHEARD_NS = 50_000_000
_NO_POWER = (DriveState.SWITCH_ON_DISABLED, DriveState.NOT_READY, DriveState.READY, DriveState.FAULT)
_NMT_PRE_OPERATIONAL = 0x80
_FIRST_HEARTBEAT_NS = 500_000_000  # a drive's first heartbeat may take this long, whatever its period


class _Outgoing:
    """One command frame, sent when due; remembers what the drive has been told."""

    def __init__(self, axis: Axis, command: Command, *, fd: bool) -> None:
        self.axis = axis
        self.primary = command is axis.primary
        self.can_id = command.cob_id | FD_FRAME if fd else command.cob_id
        # The command's own buffer: packing the command is all it takes to update it.
        self.data = command.data
        self.told = self.told_before = b""
        self.told_cycle = 0


class Cycle:
    """Cyclic traffic of all joints."""

    def __init__(
        self,
        bus: can.BusABC,  # nobody else reads it while cycling
        clock: Clock,
        sink: FrameSink | None,  # told of every frame
        frame_map: FrameMap,
        layout: Layout,
        axes: Sequence[Axis],
        decoder: Decoder,  # whose feedback the axes hold
        settings: BusSettings,
        *,
        other: Callable[[int, bytearray, float], None],  # given frames that are none of ours
    ) -> None:
        self._frames = frames_of(bus)
        self._clock = clock
        self._log = by_the_batch(sink)
        self._axes = list(axes)
        self._decoder = decoder
        self._other = other
        self._window_ns = frame_map.window_ns
        self._host_heartbeat_ns = round(settings.host_heartbeat_s * 1e9)
        self._drive_timeout_ns = round(settings.drive_timeout_s * 1e9)
        self._active = [axis.joint in layout.active for axis in axes]
        self._fd = layout.fd
        self._primary = [_Outgoing(axis, axis.primary, fd=layout.fd) for axis in axes]
        self._secondary = [_Outgoing(axis, axis.secondary, fd=layout.fd) for axis in axes]
        resend_cycles = [layout.resend_cycles.get(axis.joint, 0) for axis in axes]
        self._joints = list(zip(axes, self._primary, self._secondary, self._active, resend_cycles, strict=True))
        self._wheres = [f"joint {joint.name} (node {joint.node})" for joint in frame_map.joints]
        self._sync = bytes(1 if layout.sync_overflow else 0)
        self._overflow = layout.sync_overflow
        self._counter = 0
        self._heartbeat = (HEARTBEAT_BASE + settings.host_node, _OPERATIONAL)
        self._heartbeat_due_ns = 0
        self._nodes = [joint.node for joint in frame_map.joints]
        self._reporter = {frame.cob_id: at for at, joint in enumerate(frame_map.joints) for frame in joint.reports}
        self._other_kind: int | None = None
        self._commands = {
            one.can_id & ~FD_FRAME: (at, one) for own in (self._primary, self._secondary) for at, one in enumerate(own)
        }
        self._stranger: tuple[int, int] | None = None  # (joint, identifier) of a command that we did not send
        self._window_end_ns = -1
        self._late: list[Heard] = []
        self._turn = 0
        self._failures = 0
        self._alarmed = False
        self._insisted = [0] * len(self._axes)
        self._bad_since_ns: list[int | None] = [None] * len(self._axes)
        self._bad_ns = [0] * len(self._axes)

    def exchange(self, set_points: Sequence[SetPoint]) -> list[Feedback]:
        """One cycle.

        Raises:
            SafetyAbort: a drive was reset, its heartbeat is missing, or a set-point is not a number. A quick stop has
                been sent by then. Raised once; later exchanges go on, so that the stop can be watched.
            HardwareError: frames cannot be sent, a fault stays after its reset, or a drive reports in frames of the
                other kind (classical instead of CAN FD).
        """
        decoder, clock = self._decoder, self._clock
        begun = False
        try:
            self._take_late()
            due = self._due(set_points)
            if self._overflow:
                self._counter = self._counter % self._overflow + 1
                self._sync = bytes((self._counter,))
            frames = [(outgoing.can_id, bytes(outgoing.data)) for outgoing in due]
            frames.append((SYNC_COB_ID, self._sync))
            now_ns = clock.now_ns()
            decoder.begin(now_ns)
            begun = True
            self._window_end_ns = now_ns + self._window_ns
            try:
                self._frames.send(frames)
            finally:
                self._log(now_ns, frames, True)  # the drives answer meanwhile
            for outgoing, (_, data) in zip(due, frames, strict=False):
                outgoing.told_before, outgoing.told = outgoing.told, data
                outgoing.told_cycle = decoder.cycle
                if outgoing.primary:
                    outgoing.axis.sent()
            self._receive()
            if now_ns >= self._heartbeat_due_ns:
                # After the reports, so that no SYNC ever waits behind it.
                self._heartbeat_due_ns = now_ns + self._host_heartbeat_ns
                self._log(clock.now_ns(), [self._heartbeat], True)
                self._frames.send([self._heartbeat])
            self._failures = 0
        except FrictidError:
            raise
        except BUS_ERRORS as error:
            self._wire_failed(error)
            if not begun:
                # A row in which nobody was asked: every report is a cycle older.
                decoder.begin(clock.now_ns())
        feedback = decoder.finish()
        now_ns = clock.now_ns()
        for at, axis in enumerate(self._axes):
            if axis.target is not Target.ENABLED:
                self._insist(at, axis, now_ns)
        self._check(now_ns)
        return feedback

    def quick_stop(self) -> None:
        """Send the stop to all joints, active ones first, from any thread; never raises and waits for nothing."""
        self._commands = {}  # what an adapter echoes of the stop is not what was told
        frames: list[Command] = []
        for active in (True, False):
            for axis, is_active in zip(self._axes, self._active, strict=True):
                if is_active is active:
                    primary, secondary = axis.emergency()
                    frames += [primary] if axis.mode is Mode.POSITION else [secondary, primary]
        for _ in range(2):  # they take effect with the SYNC that follows; a second round covers a lost one
            for frame in frames:
                self._send_whatever_happens(frame.cob_id, frame.data, fd=self._fd)
            self._send_whatever_happens(SYNC_COB_ID, self._sync)

    def cut_power(self) -> None:
        """Controlword 00 to all joints: the last resort where a joint would not come to rest; never raises."""
        self._commands = {}
        for at, axis in enumerate(self._axes):
            axis.primary.set("controlword", DISABLE_VOLTAGE)
            axis.primary.set("torque_offset", 0)
            self._send_whatever_happens(axis.primary.cob_id, axis.primary.pack(), fd=self._fd)
            self._send_controlword(at, DISABLE_VOLTAGE)
        self._send_whatever_happens(SYNC_COB_ID, self._sync)

    def _insist(self, at: int, axis: Axis, now_ns: int) -> None:
        """A stop or a disabled power stage that is not seen: by SDO, then without PDOs, then without voltage."""
        report = axis.feedback
        unheard = report.age_cycles > 0 and now_ns - report.t_ns > _UNHEARD_NS
        stopping = axis.target is Target.STOPPED
        followed = axis.state in _NO_POWER or (axis.state is not DriveState.ENABLED and (stopping or not axis.standing))
        if unheard or not followed:
            self._bad_ns[at] = now_ns
            if self._bad_since_ns[at] is None:
                self._bad_since_ns[at] = now_ns
        elif now_ns - self._bad_ns[at] > _INSIST_NS:
            # Not sooner: with another master on the bus it obeys now and then.
            self._bad_since_ns[at] = None
            self._insisted[at] = 0
        since_ns = self._bad_since_ns[at]
        # A power stage that is switched off in good order closes its brake first, which takes a while.
        patience_ns = _INSIST_NS if stopping or unheard else _BRAKE_NS
        if since_ns is None or report.t_ns == 0 or self._insisted[at] == 3:
            return
        if now_ns - since_ns < (self._insisted[at] + 1) * patience_ns:
            return
        self._insisted[at] += 1
        if self._insisted[at] == 2:
            self._send_whatever_happens(0, bytes([_NMT_PRE_OPERATIONAL, self._nodes[at]]))
        standing = axis.standing and not unheard and not stopping
        self._send_controlword(at, DISABLE_VOLTAGE if standing or self._insisted[at] == 3 else QUICK_STOP)

    def _send_controlword(self, at: int, controlword: int) -> None:
        """6040 by SDO; nobody waits for the answer."""
        request = bytes([0x2B, 0x40, 0x60, 0x00, controlword, 0x00, 0x00, 0x00])
        self._send_whatever_happens(0x600 + self._nodes[at], request)

    def _due(self, set_points: Sequence[SetPoint]) -> list[_Outgoing]:
        """What is sent in this cycle: every moving joint's frame, and one more that has changed."""
        decoder = self._decoder
        due = []
        changed = False
        for at, (axis, primary, secondary, active, resend) in enumerate(self._joints):
            try:
                if not axis.goes_on(set_points[at]) and not axis.steady:
                    actual_units = decoder.position_units(at)
                    if actual_units is None:
                        continue
                    axis.command(set_points[at], actual_units, healthy=decoder.heartbeat_ns(at) is not None)
            except SafetyAbort:
                self.quick_stop()
                raise
            if resend:
                # A drive that supervises its RPDOs hears them again before it misses them.
                for outgoing in (primary, secondary):
                    if decoder.cycle - outgoing.told_cycle >= resend:
                        outgoing.told = b""
            if active:
                regular, other = (primary, secondary) if axis.mode is Mode.POSITION else (secondary, primary)
                due.append(regular)
                changed = changed or other.data != other.told
            else:
                changed = changed or primary.data != primary.told or secondary.data != secondary.told
        if changed:
            due += self._one_more(due)
        return due

    def _one_more(self, due: Sequence[_Outgoing]) -> list[_Outgoing]:
        """The next that differs from what its drive was told, each joint in its turn."""
        count = len(self._axes)
        for step in range(count):
            at = (self._turn + step) % count
            for outgoing in (self._secondary[at], self._primary[at]):
                fresh = outgoing.data != outgoing.told and outgoing not in due
                if fresh and self._decoder.position_units(at) is not None:
                    self._turn = at + 1
                    return [outgoing]
        return []

    def _send_whatever_happens(self, cob_id: int, data: bytes | bytearray, *, fd: bool = False) -> None:
        can_id = cob_id | FD_FRAME if fd else cob_id
        # Nothing may keep the next joint from being stopped, whatever this interface raises.
        with contextlib.suppress(Exception):
            self._frames.send_alone(can_id, bytes(data))
            self._log(self._clock.now_ns(), [(can_id, bytes(data))], True)

    def _wire_failed(self, error: Exception) -> None:
        """One frame that could not be sent is a missed cycle; several in a row are a broken bus."""
        self._failures += 1
        if self._failures >= _WIRE_FAILURES:
            self._failures = 0
            raise self._broken_bus(f"{_WIRE_FAILURES} cycles in a row failed on the bus: {error}") from error

    def _broken_bus(self, what: str) -> HardwareError:
        cause = CONTROLLER_STATES.get(
            self._frames.controller, "bus-off, an unplugged adapter, or nobody left on the bus to acknowledge"
        )
        return HardwareError(
            what,
            where="bus",
            cause=cause + ("; a device that knows classical CAN only destroys every CAN FD frame" if self._fd else ""),
            next_step="check wiring and termination; the drives stop by their own watchdogs. A bus that is off "
            "stays off unless its link was brought up with `restart-ms`",
        )

    def _receive(self) -> None:
        receive, now_ns, decoder = self._frames.receive, self._clock.now_ns, self._decoder
        end_ns = self._window_end_ns
        if self._clock.lock_step:
            # The answers were there before ``send`` returned: what is not there will not come.
            while (heard := receive(0.0)) is not None:
                self._take(heard, now_ns())
            return
        while decoder.missing > 0:
            timeout_s = (end_ns - now_ns()) * 1e-9
            if timeout_s < 0.0 or (heard := receive(timeout_s)) is None:
                return
            self._take(heard, now_ns())

    def _take(self, heard: Sequence[Heard], t_ns: int, *, waited: bool = False) -> None:
        """Log and decode. What comes after the window waits until the next row begins, as in a replay of the log.

        The decoder knows identifiers without the kind of frame; a report in the other kind is noted.
        """
        if not waited:
            self._log(t_ns, heard, False)
            if t_ns > self._window_end_ns:
                self._late += heard
                return
        if self._fd:
            for can_id, _ in heard:
                if not can_id & FD_FRAME:
                    self._note_other_kind(can_id)
            heard = [(can_id & ~FD_FRAME, data) for can_id, data in heard]
        for can_id, data in self._decoder.take(t_ns, heard):
            cob_id = can_id & ~FD_FRAME
            if cob_id != can_id:
                self._note_other_kind(cob_id)
            if (command := self._commands.get(cob_id)) is not None:
                self._note_command(*command, data)
            elif cob_id == can_id or not self._decoder.feed(t_ns, cob_id, data):
                self._other(cob_id, bytearray(data), time.time())

    def _take_late(self) -> None:
        """What came after the last row was closed: fed before the next one begins."""
        receive, t_ns = self._frames.receive, max(self._clock.now_ns(), self._window_end_ns + 1)
        while (heard := receive(0.0)) is not None:
            self._take(heard, t_ns)
        if self._late:
            late, self._late = self._late, []
            self._take(late, t_ns, waited=True)

    def _note_command(self, at: int, own: _Outgoing, data: bytes | bytearray) -> None:
        """A command that we did not send, unless it is an echo of our own, as some adapters give it."""
        if data not in (own.told, own.told_before) and self._stranger is None:
            self._stranger = at, own.can_id & ~FD_FRAME

    def _note_other_kind(self, cob_id: int) -> None:
        if self._other_kind is None:
            self._other_kind = self._reporter.get(cob_id)

    def _check(self, now_ns: int) -> None:
        decoder = self._decoder
        if self._frames.controller == BUS_OFF and not self._alarmed:
            self._end(self._broken_bus("the bus is off (bus-off)"))
        if self._other_kind is not None:
            at, self._other_kind = self._other_kind, None
            self._end(self._other_frames(at))
        if self._stranger is not None:
            at, cob_id = self._stranger
            self._end(another_master(self._wheres[at], cob_id))
        alive = decoder.all_alive(now_ns - self._drive_timeout_ns)
        for at, axis in enumerate(self._axes):
            if not alive:
                self._check_heartbeat(at, now_ns)
            if axis.alarm is not None:
                alarm, axis.alarm = axis.alarm, None
                raise alarm

    def _check_heartbeat(self, at: int, now_ns: int) -> None:
        if self._decoder.restarted(at):
            self._alarm(at, "booted up in the middle of the run: the drive was reset")
        seen_ns = self._decoder.heartbeat_ns(at)
        if seen_ns is None:
            latest_ns = max(self._drive_timeout_ns, _FIRST_HEARTBEAT_NS)
            if now_ns > latest_ns:
                self._alarm(at, f"no heartbeat within {latest_ns * 1e-9:g} s of the start")
        elif now_ns - seen_ns > self._drive_timeout_ns:
            self._alarm(at, f"no heartbeat for {(now_ns - seen_ns) * 1e-9:.3f} s")

    def _other_frames(self, at: int) -> HardwareError:
        found, wanted = ("classical", "`fd: true`") if self._fd else ("CAN FD", "no `fd: true`")
        return HardwareError(
            f"the drive reports in {found} frames, the robot file's options say {wanted}",
            where=self._wheres[at],
            cause=f"CAN FD is {'not ' if self._fd else ''}switched on in this drive",
            next_step="switch it with the vendor's tool, name the object that does as `fd_object` in the joint's "
            "options, or change `fd`",
        )

    def _alarm(self, at: int, what: str) -> None:
        lost = "a drive that lost its supply or its bus, or a broken cable"
        cause = CONTROLLER_STATES.get(self._frames.controller, lost)
        next_step = "run `frictid-hil check`, and look at the drive's supply and wiring"
        self._end(SafetyAbort(what, where=self._wheres[at], cause=cause, next_step=next_step))

    def _end(self, error: FrictidError) -> None:
        """Quick stop, and tell why; once."""
        if not self._alarmed:
            self._alarmed = True
            self.quick_stop()
            raise error
