"""The whole controller in whatever time it is given: bytes in, bytes out, and when it next wants to be looked at.

The serial line takes its time: a byte of 8 data bits costs 10 or 11 bits at the line's speed, in both directions. The
interpolation clock ticks while something moves or streams; in between, simulated time passes in larger portions.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Mapping, Sequence

from frictid_drivers.motoman.emulator.axis import Axis
from frictid_drivers.motoman.emulator.faults import Fault, FaultPlan
from frictid_drivers.motoman.emulator.jobs import BatchApplication
from frictid_drivers.motoman.emulator.panel import DONE, Panel, Refused, Reply, Settings, require
from frictid_drivers.motoman.emulator.station import Station
from frictid_drivers.motoman.emulator.streaming import StreamApplication

_LONGEST_REST_S = 0.1

Line = tuple[int, str]  # speed and parity


class Emulator:
    """The controller, its arm unpowered; ``on_guided`` is told when a person takes an axis by hand, and lets go."""

    def __init__(
        self,
        axes: Sequence[Axis],
        settings: Settings,
        faults: FaultPlan | None = None,
        *,
        on_guided: Callable[[int, bool], None] = lambda axis, guided: None,
    ) -> None:
        self.settings = settings
        self.faults = faults or FaultPlan()
        self.panel = Panel(axes, settings, self._stop_motion)
        self.axes = self.panel.axes
        self.batch = BatchApplication(self.panel, on_guided)
        self.station = Station(settings, self, self._message)
        self.stream: StreamApplication | None = None
        self._on_stream_line = False
        self.line: Line = (settings.baud, settings.parity)
        self._gone_until_s = -math.inf
        self.now_s = 0.0
        self._incoming: deque[tuple[float, bytes]] = deque()
        self._outgoing: deque[tuple[float, bytes, Line]] = deque()
        self._in_free_s = self._out_free_s = 0.0
        self._replies: deque[tuple[float, Reply]] = deque()
        self._next_line: tuple[Line, int] | None = None
        self._next_tick_s = 0.0
        self._settling_ticks = 0
        self._physics_s = 0.0
        self._mute_until_s = 0.0
        self._hold_back_s = 0.0

    @property
    def gone(self) -> bool:
        """The port has disappeared; the controller behind it has not."""
        return self.now_s < self._gone_until_s

    @property
    def gone_for_good(self) -> bool:
        """The port will not come back."""
        return math.isinf(self._gone_until_s) and self.gone

    def _lose_port(self, for_s: float) -> None:
        """For good where no time is told; a port that comes back finds a line on which nothing is under way."""
        self._gone_until_s = self.now_s + for_s if for_s else math.inf
        self._incoming.clear()
        self._outgoing.clear()

    def hear(self, chunk: bytes) -> None:
        """The host puts bytes on the wire now; they arrive when the line has carried them."""
        if self.gone:
            return
        begin_s = max(self.now_s, self._in_free_s)
        self._in_free_s = begin_s + len(chunk) * self._byte_s
        self._incoming.append((self._in_free_s, chunk))

    def take(self, line: Line | None = None) -> bytes:
        """Bytes that have reached the host by now; a host that listens at another speed hears none of them."""
        taken = bytearray()
        while self._outgoing and self._outgoing[0][0] <= self.now_s:
            _, chunk, spoken_at = self._outgoing.popleft()
            if line is None or line == spoken_at:
                taken += chunk
        return bytes(taken)

    def next_event_s(self) -> float:
        """When something happens next, at the latest a moment from now."""
        times = [self.now_s + _LONGEST_REST_S]
        times += [queue[0][0] for queue in (self._incoming, self._replies) if queue]
        if self._outgoing and self._outgoing[0][0] > self.now_s:
            times.append(self._outgoing[0][0])
        if self.station.deadline_s is not None:
            times.append(self.station.deadline_s)
        if self._ticking:
            times.append(self._next_tick_s)
        return max(self.now_s, min(times))

    @property
    def starving(self) -> bool:
        """Nothing is under way on the wire, and the coming tick finds hardly a target in the queue."""
        return bool(self.stream and self.stream.running_dry and self.next_event_s() >= self._next_tick_s)

    def advance(self, to_s: float) -> None:
        """Let everything happen that happens until then."""
        while (event_s := self.next_event_s()) <= to_s:
            self.now_s = event_s
            self._happen()
        self.now_s = max(self.now_s, to_s)

    def _happen(self) -> None:
        if self._incoming and self._incoming[0][0] <= self.now_s:
            self._hear_now(self._incoming.popleft()[1])
        self.station.tick(self.now_s)
        if self._replies and self._replies[0][0] <= self.now_s:
            self.station.post(*self._replies.popleft()[1], self.now_s)
        if self._ticking:
            if self._next_tick_s <= self.now_s:
                self._tick()
        else:
            self._rest()

    def _hear_now(self, chunk: bytes) -> None:
        if not self._on_stream_line:
            self.station.hear(chunk, self.now_s)
            return
        struck = self.faults.occasion("frame heard")
        if "deaf" in struck:
            return
        assert self.stream is not None
        self.stream.hear(_flipped(chunk, 0x10) if "noise" in struck else chunk)

    @property
    def _moving(self) -> bool:
        return self.batch.moving or (self.stream is not None and self.stream.moving)

    @property
    def _ticking(self) -> bool:
        compensating = self.batch.compensated != 0 and self.panel.servo_on
        return self._on_stream_line or self._moving or self._settling_ticks > 0 or compensating

    def _tick(self) -> None:
        tick_s = self.settings.tick_s
        late_s, dropped = 0.0, 0
        if self._moving:
            self._settling_ticks = self.settings.averaging_ticks + 1
            late_s, dropped = self._strike_motion()
        elif self._settling_ticks:
            self._settling_ticks -= 1
        self._hold_back_s = late_s
        self.batch.tick(dropped)
        if self.stream is not None and (self._on_stream_line or self.stream.moving):
            self.stream.tick(dropped)
        self._hold_back_s = 0.0
        self.batch.compensate()
        for axis in self.axes:
            axis.run(tick_s)
        self._next_tick_s += tick_s
        self._physics_s = self._next_tick_s

    def _rest(self) -> None:
        """Nothing moves: physics in one portion up to now, and the next tick from here."""
        self._next_tick_s = self.now_s
        passed_s = self.now_s - self._physics_s
        if passed_s < 0.001:
            return
        self._physics_s = self.now_s
        if self.panel.servo_on or passed_s < 1.0:
            for axis in self.axes:
                axis.rest(passed_s)

    def _strike_motion(self) -> tuple[float, int]:
        """Faults of this tick: seconds of lateness, dropped pulses; the others strike at once."""
        struck = self.faults.occasion("tick")
        if "alarm" in struck:
            self.panel.raise_alarm(round(struck["alarm"].value) or 4107)
        if "hold" in struck:
            self.panel.press_hold("pendant")
        if "unplug" in struck:
            self._lose_port(struck["unplug"].value)
        late_s = struck["late"].value or 0.05 if "late" in struck else 0.0
        dropped = round(struck["drop"].value) or 50 if "drop" in struck else 0
        return late_s, dropped

    def _stop_motion(self, reason: str) -> None:
        self.batch.stop(reason)
        if self.stream is not None:
            self.stream.halt(reason)

    def _message(self, header: str, text: str) -> None:
        """A whole message of the host: think about it, then reply."""
        self.batch.heard_host()
        try:
            reply = self._obey(header, text)
        except Refused as refused:
            reply = "90,000", f"{refused.args[0]:04d}"
        self._replies.append((self.now_s + self.settings.thinking_s, reply))

    def _obey(self, header: str, text: str) -> Reply:
        command, _, rest = text.partition(" ")
        operands = [operand.strip() for operand in rest.split(",")] if rest else []
        require(header == "01,000", 1010)
        if self.panel.knows(command):
            return self.panel.obey(command, operands)
        if self.settings.batch and self.batch.knows(command):
            return self.batch.obey(text)
        require(command == "FSTREAM" and self.settings.stream_bauds, 1010)
        require(len(operands) == 4, 1011)
        try:
            version, baud, tick_us, mask = map(int, operands)
        except ValueError:
            raise Refused(5170) from None
        require(version == 1 and baud in self.settings.stream_bauds and tick_us == self.settings.tick_us, 1012)
        require(0 < mask < 1 << len(self.axes), 1012)
        require(not self.batch.moving, 2010)
        self._next_line = ((baud, "N"), mask)
        return DONE

    def _switch_to_stream(self, line: Line, mask: int) -> None:
        """The line changes with the EOT that ends the granting reply."""
        self.line = line
        self._on_stream_line = True
        self._in_free_s = self._out_free_s
        compensated = self.batch.compensated != 0
        self.stream = StreamApplication(
            self.panel, mask, self.say, self._switch_to_host_control, compensated=compensated
        )
        self._next_tick_s = self._physics_s = self.now_s + self.settings.tick_s

    def _switch_to_host_control(self) -> None:
        self.line = (self.settings.baud, self.settings.parity)
        self._on_stream_line = False
        self.panel.operating = self.stream is not None and self.stream.moving
        self.station.reset(self.now_s)

    def say(self, kind: str, chunk: bytes) -> None:
        """Put an utterance on the wire, after the faults that strike it."""
        frame = kind in ("feedback", "nack", "hello", "stop")
        if frame and not self._on_stream_line:
            return
        struck = self.faults.occasion("frame" if frame else "utterance")
        if kind in ("ack", "block"):
            struck |= self.faults.occasion(kind)
        if "close" in struck:
            self._lose_port(struck["close"].value)
        if self.gone:
            return
        if "silence" in struck:
            self._mute_until_s = self.now_s + (struck["silence"].value or 4.0)
        if struck.keys() & {"lost_ack", "lost_block", "lost_frame"} or self.now_s < self._mute_until_s:
            return
        begin_s = max(self.now_s, self._out_free_s) + self._hold_back_s
        self._out_free_s = begin_s + len(chunk) * self._byte_s
        chunk = _damaged(chunk, struck)
        if "split" in struck:
            for k in range(len(chunk)):
                self._outgoing.append((begin_s + (k + 1) * self._byte_s, chunk[k : k + 1], self.line))
            return
        arrival_s = self._out_free_s
        if "merge" in struck:
            together_s = struck["merge"].value or 0.02
            arrival_s = math.ceil(arrival_s / together_s) * together_s
        self._outgoing.append((arrival_s, chunk, self.line))

    def delivered(self, arrived: bool) -> None:
        """See ``station.Voice``: a granted stream begins once the host has the grant."""
        granted, self._next_line = self._next_line, None
        if arrived and granted is not None:
            self._switch_to_stream(*granted)

    def hears_enq(self) -> str:
        """See ``station.Voice``."""
        fault = self.faults.occasion("enq heard").get("enq")
        return "" if fault is None else "insist" if fault.value else "bid"

    def doubts_block(self) -> bool:
        """See ``station.Voice``."""
        return "nak" in self.faults.occasion("block heard")

    @property
    def _byte_s(self) -> float:
        baud, parity = self.line
        return (10 if parity == "N" else 11) / baud


def _damaged(chunk: bytes, struck: Mapping[str, Fault]) -> bytes:
    """The utterance as the faults leave it."""
    if "wrong_ack" in struck:
        chunk = _flipped(chunk, 1, -1)
    if struck.keys() & {"bad_bcc", "bad_crc"}:
        chunk = _flipped(chunk, 0x40, -1)
    return _flipped(chunk, 0x04) if "garble" in struck else chunk


def _flipped(chunk: bytes, bits: int, at: int | None = None) -> bytes:
    """With some bits of one byte flipped, usually that in the middle."""
    flipped = bytearray(chunk)
    flipped[len(chunk) // 2 if at is None else at] ^= bits
    return bytes(flipped)
