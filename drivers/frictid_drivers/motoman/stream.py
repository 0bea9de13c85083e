"""Layer C, streaming: one session of targets with due ticks, slaved to the controller's interpolation clock.

The controller reports every tick; the host answers each report in turn with the targets that are due ``lead_ticks``
later. A late host therefore shows up as a shorter queue on the controller, not as a late motion and not as a gap in the
recording, until the queue is nearly empty: then the host skips to the newest report. With nothing left in the queue the
controller goes straight on for one tick, slows down, and at the third missed tick stops and latches.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Mapping, Sequence

from frictid_drivers.motoman.controller_errors import BadReply, LinkError
from frictid_drivers.motoman.host_control import HostControl, decode_status
from frictid_drivers.motoman.stream_frames import (
    Flag,
    Frame,
    FrameReader,
    Nack,
    Refusal,
    Stopped,
    TickReport,
    Welcome,
    encode_hello,
    encode_set_point,
    encode_stop,
)
from frictid_hil.errors import FrictidError, HardwareError, SafetyAbort

_HELLO_EVERY_S = 0.1
_HELLO_FOR_S = 1.0
_GOODBYE_S = 0.2
_STOP_REPEATS = 3
_SHORTEST_WAIT_TICKS = 2  # a target must reach the controller this many ticks before it is due

_RECOVERABLE = frozenset({Refusal.CRC, Refusal.GAP, Refusal.LATE})
_REFUSED: Mapping[int, tuple[str, str]] = {
    Refusal.VERSION: ("it speaks another version of the protocol", "update the controller application"),
    Refusal.SESSION: ("it knows of no such session", "start again"),
    Refusal.LIMIT: ("a target exceeds its limits of position or step", "compare the limits of both sides with `check`"),
    Refusal.NOT_ARMED: ("it is latched, held, or its servo power is off", "look at the pendant, then start again"),
    Refusal.ALARM: ("an alarm is pending", "clear its cause, reset on the pendant, then start again"),
}


class StreamSession:
    """One session, from HELLO to STOP, on a port that ``host`` has left and that is at the stream's speed."""

    def __init__(self, host: HostControl, *, lead_ticks: int, silence_s: float) -> None:
        self._host = host
        self._port = host.port
        self.lead_ticks = lead_ticks  # between the newest report and the tick that a target is due at
        self._silence_s = silence_s  # without any report for so long, the controller counts as lost
        self._reader = FrameReader()
        self._seq = 0
        self._session = 0
        self._last_due = 0
        self._error: FrictidError | None = None
        self._refused_at_tick = -1
        self._goodbye = False
        self.welcome: Welcome | None = None  # what the controller answered to HELLO
        self.report: TickReport | None = None  # the one that is to be answered now
        self._newest: TickReport | None = None
        self._reports: deque[TickReport] = deque()
        self._arrived_s = 0.0
        self._nacks: Counter[str] = Counter()
        self.halted = False  # we asked it to stop; a latched controller is no surprise

    def overdue_ns(self) -> int:
        """How long ago the report came that is to be answered now; 0 while others wait behind it."""
        return 0 if self._reports else round((self._port.now_s() - self._arrived_s) * 1e9)

    def begin(self, session: int, axis_mask: int) -> None:
        """Say HELLO until the controller answers; ``LinkError`` without an answer, ``HardwareError`` for an odd one."""
        self._session = session
        until_s = self._port.now_s() + _HELLO_FOR_S
        while self._port.now_s() < until_s:
            # All repetitions carry one sequence number: the first to arrive opens the session.
            self._write(encode_hello(self._seq, session, axis_mask))
            again_s = self._port.now_s() + _HELLO_EVERY_S
            while self._port.now_s() < again_s:
                self._collect(again_s - self._port.now_s())
                if self._error is not None:
                    raise self._error
                if self.welcome is not None and self.welcome.session == session:
                    self._check_welcome(self.welcome, axis_mask)
                    return
        raise LinkError(
            f"no HELLO within {_HELLO_FOR_S:g} s after streaming was granted",
            where="FSTREAM",
            cause="the port does not follow to the stream's speed",
            next_step="check `options.stream_baud` against what adapter and gateway can do",
        )

    def _check_welcome(self, welcome: Welcome, axis_mask: int) -> None:
        if welcome.axis_mask != axis_mask:
            raise BadReply(f"asked for axes {axis_mask:#x}, granted {welcome.axis_mask:#x}", where="HELLO")
        if welcome.queue_limit < self.lead_ticks:
            raise HardwareError(
                f"the controller queues {welcome.queue_limit} ticks, the robot file wants {self.lead_ticks}",
                where="HELLO",
                next_step="lower `options.lead_ticks`",
            )

    def wait_for_tick(self, tick: int) -> TickReport:
        """The first report of this tick, or of a later one where too many wait; ``HardwareError`` where none comes."""
        while True:
            self._collect(0.0)
            self._go_on_to(tick)
            if self.report is not None and self.report.tick >= tick:
                return self.report
            quiet_until_s = self._arrived_s + self._silence_s
            if self._port.now_s() >= quiet_until_s:
                raise HardwareError(
                    f"no feedback for {self._silence_s * 1e3:.0f} ms",
                    where="streaming",
                    cause="the cable, the gateway, or a controller that stopped",
                    next_step="its watchdog stops the arm without us; check the cable, then start again",
                )
            self._collect(quiet_until_s - self._port.now_s())

    def send(self, pulses: Sequence[int], torque: Sequence[int] = ()) -> int:
        """Targets of all axes of the session, due ``lead_ticks`` after the report that they answer; the due tick."""
        assert self.report is not None and self.welcome is not None
        self._seq = (self._seq + 1) & 0xFFFF
        self._last_due = max(self._last_due + 1, self.report.tick + self.lead_ticks)
        self._write(encode_set_point(self._seq, self._session, self.welcome.axis_mask, self._last_due, pulses, torque))
        return self._last_due

    def keep_alive(self) -> None:
        """Say HELLO again: while no targets go out, this is how the controller knows that we are here."""
        assert self.welcome is not None
        self._write(encode_hello(self._seq, self._session, self.welcome.axis_mask))

    def raise_if_stopped(self) -> None:
        """``SafetyAbort`` for what the controller has against going on; nothing where we asked it to stop ourselves."""
        report = self._newest
        if self.halted or report is None:
            return
        if report.alarm:
            raise SafetyAbort(
                f"alarm {report.alarm}",
                where="controller",
                next_step="read it on the pendant, clear its cause, then start again",
            )
        if Flag.STRAYED in report.flags:
            raise SafetyAbort(
                "an axis outside this session has moved",
                where="controller",
                cause="a locked joint is being dragged, or its brake does not hold",
            )
        if Flag.LATCHED in report.flags:
            raise self._latched(report)
        # A refusal may overtake the report that explains it better.
        if self._error is not None and report.tick > self._refused_at_tick + 1:
            raise self._error

    def _latched(self, report: TickReport) -> SafetyAbort:
        holds = set(decode_status(self._host.profile, report.data_1, report.data_2).holds) - {"command hold"}
        refused = ", ".join(f"{count} for {reason}" for reason, count in self._nacks.items()) or "none"
        lost = f"refused by it: {refused}; damaged on the way here: {self._reader.damaged}"
        cause = f"its watchdog missed set-points ({lost})"
        next_step = "check the cable; free this machine's processor, or raise `options.lead_ticks`"
        if holds:
            cause = f"somebody pressed hold ({', '.join(sorted(holds))})"
            next_step = "release it at the controller, then start again"
        what = "the controller stopped the arm and latched"
        return SafetyAbort(what, where="controller", cause=cause, next_step=next_step)

    def halt(self, *, leave: bool = False) -> None:
        """STOP, several times over; waits for nothing but, with ``leave`` to host control, a moment for the goodbye."""
        self.halted = True
        for _ in range(_STOP_REPEATS):
            self._seq = (self._seq + 1) & 0xFFFF
            self._write(encode_stop(self._seq, self._session, leave=leave))
            until_s = self._port.now_s() + _GOODBYE_S / _STOP_REPEATS
            while leave and not self._goodbye and self._port.now_s() < until_s:
                self._collect(until_s - self._port.now_s())
            if leave and self._goodbye:
                return

    def _collect(self, timeout_s: float) -> None:
        data = self._port.read(max(0.0, timeout_s))
        if not data:
            return
        self._host.sink(data, False)
        for frame in self._reader.take(data):
            self._take(frame)

    def _take(self, frame: Frame) -> None:
        match frame:
            case TickReport():
                if frame.session == self._session and (self._newest is None or frame.tick > self._newest.tick):
                    self._newest = frame
                    self._reports.append(frame)
                    self._arrived_s = self._port.now_s()
            case Nack():
                self._nacks[frame.reason] += 1
                if frame.code not in _RECOVERABLE and self._error is None:
                    self._error = _refused(frame)
                    self._refused_at_tick = self._newest.tick if self._newest is not None else -1
            case Welcome():
                self.welcome = frame
                self._arrived_s = self._port.now_s()
            case Stopped():
                self._goodbye = self._goodbye or frame.leaving

    def _go_on_to(self, tick: int) -> None:
        """Make the report of this tick the current one, if it has come."""
        reports = self._reports
        while reports and (self.report is None or self.report.tick < tick):
            self.report = reports.popleft()
        report, newest = self.report, self._newest
        if report and newest and newest.tick - report.tick > self.lead_ticks - _SHORTEST_WAIT_TICKS:
            self.report = newest
            reports.clear()

    def _write(self, data: bytes) -> None:
        self._host.sink(data, True)
        self._port.write(data)


def _refused(nack: Nack) -> FrictidError:
    what, next_step = _REFUSED.get(nack.code, (nack.reason, ""))
    axis = "" if nack.axis == 0xFF else f", axis {nack.axis}"
    return SafetyAbort(
        f"the controller refused a frame: {what} (due tick {nack.due_tick}, now {nack.now_tick}{axis})",
        where="streaming",
        next_step=next_step,
    )
