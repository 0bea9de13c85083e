"""Layer A, host control: one command, one reply - status, joint pulses, servo power, hold, alarms.

What a stock controller of the ERC to DX generations offers on its serial port. There is **no torque** in it, and at
9600 to 19200 baud no more than 11 to 22 readings per second, so nothing can be identified through it alone.

From public documents, untested on hardware.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import dataclass, replace
from typing import Final

from frictid_drivers.motoman.bsc import BlockReceived, BscLink, BscTiming, Event, Failed, Message, Received, Sent
from frictid_drivers.motoman.controller_errors import BadReply, LinkError, controller_error
from frictid_drivers.motoman.port import BytePort, Sink, unheard
from frictid_hil.errors import FrictidError, HardwareError

_COMMAND: Final = "01,000"
_RESULT: Final = "90,000"
_DATA: Final = "90,001"

_FAREWELL_S: Final = 0.3  # how long the EOT of a reply may take before the port goes to another protocol without it

_USUAL_TIMING: Final = BscTiming()
_ON_WITHIN_S: Final = 5.0
_AT_REST_WITHIN_S: Final = 1.0
_STILL_PULSES: Final = 2
_URGENT_S: Final = 0.5

_LINK_CAUSE: Final = "wrong baud or parity, a broken cable, or a controller that is off"
_LOOK_AT_LINE: Final = "check the cable, and `options.baud` and `options.parity` against RS030-RS033"

Profile = tuple[tuple[str, ...], tuple[str, ...]]
"""What differs between controller generations: the meaning of bits 0.. of both figures of RSTATS; "" is unused."""

_MODES_1: Final = ("step", "1-cycle", "auto", "running", "safe speed", "teach", "play", "command remote")
_MODES_2: Final = ("", "pendant hold", "external hold", "command hold", "alarm", "error", "servo on")

PROFILES: Final[Mapping[str, Profile]] = {
    "erc": (_MODES_1[:5], ("panel hold", "teach box hold", *_MODES_2[2:])),
    **dict.fromkeys(("xrc", "nx", "dx"), (_MODES_1, _MODES_2)),
}


@dataclass(frozen=True, slots=True)
class Status:
    """The reply to RSTATS."""

    data_1: int
    data_2: int
    conditions: frozenset[str]  # names of the bits that are set
    reports_mode: bool  # this generation reports teach, play and command remote at all

    @property
    def holds(self) -> list[str]:
        """Which holds are on."""
        return sorted(name for name in self.conditions if name.endswith("hold"))

    @property
    def servo_on(self) -> bool:
        """Servo power is on."""
        return "servo on" in self.conditions

    @property
    def faulty(self) -> bool:
        """An alarm or an error is pending."""
        return bool(self.conditions & {"alarm", "error"})


def decode_status(profile: Profile, data_1: int, data_2: int) -> Status:
    """Name the bits of both figures of RSTATS (or of a streamed status)."""
    names = {
        name
        for figure, bits in zip((data_1, data_2), profile, strict=True)
        for bit, name in enumerate(bits)
        if name and figure >> bit & 1
    }
    return Status(data_1, data_2, frozenset(names), "command remote" in profile[0])


class HostControl:
    """Commands and replies over one link; the controller may think about each for ``reply_s`` before it replies."""

    def __init__(
        self,
        port: BytePort,
        profile: Profile,
        timing: BscTiming = _USUAL_TIMING,
        *,
        reply_s: float = 10.0,
        sink: Sink = unheard,
    ) -> None:
        self.port = port
        self.profile = profile
        self._timing = timing
        self._reply_s = reply_s
        self.sink = sink
        self._link = BscLink(self._timing)
        self._owed = 0
        """Replies that may still come. They carry no name: a late one must not be taken for that of another command."""

    def status(self, *, within_s: float | None = None) -> Status:
        """RSTATS."""
        return decode_status(self.profile, *self._figures("RSTATS", 2, within_s))

    def pulses(self, *, within_s: float | None = None) -> list[int]:
        """RPOSJ: the joints' positions in pulses; axes that the robot lacks read 0."""
        return self._figures("RPOSJ", 12, within_s)

    @property
    def patience_s(self) -> float:
        """How long one exchange may take at the very most, by the link's own timers."""
        timing = self._timing
        return self._reply_s + 2 * (timing.response_retries + 1) * timing.sequence_s + timing.text_end_s

    @contextmanager
    def impatient(self, longest_s: float) -> Iterator[None]:
        """Inside, no timer of ours runs for longer than this; the controller keeps its own."""
        timing = self._timing
        sequence_s, text_end_s = min(timing.sequence_s, longest_s), min(timing.text_end_s, longest_s)
        self._link.retime(replace(timing, sequence_s=sequence_s, text_end_s=text_end_s))
        try:
            yield
        finally:
            self._link.retime(timing)

    def order(self, text: str, *, within_s: float | None = None) -> None:
        """A command that is answered by ``0000``; raises as ``ask`` does."""
        reply = self._exchange(text, within_s=within_s)
        if reply.header != _RESULT:
            raise self.bad_reply(f"{reply.header} {reply.text!r} instead of a result", text)

    def ask(
        self, text: str, on_text: Callable[[str, int], None] | None = None, *, within_s: float | None = None
    ) -> str:
        """A command that is answered by data, within the link's own time or ``within_s``.

        ``on_text`` is told of every block of the reply as it comes (text, index), also when the rest never comes.
        ``ControllerError`` where the controller refuses, ``LinkError`` where no answer or a broken one comes.
        """
        reply = self._exchange(text, on_text, within_s=within_s)
        if reply.header != _DATA:
            raise self.bad_reply(f"{reply.header} {reply.text!r} instead of data", text)
        return reply.text

    def _figures(self, command: str, count: int, within_s: float | None = None) -> list[int]:
        reply = self.ask(command, within_s=within_s)
        try:
            figures = [int(part.strip()) for part in reply.split(",")]
        except ValueError:
            figures = []
        if len(figures) != count:
            raise self.bad_reply(f"{reply!r} is not {count} whole numbers", command)
        return figures

    def bad_reply(self, what: str, where: str) -> BadReply:
        """The error for a reply that cannot belong to the command ``where``."""
        cause = "both sides bid for the line at once, and the controller's own message came first"
        return BadReply(what, where=where, cause=cause if self._link.contended else "", next_step="start again")

    def _exchange(
        self, text: str, on_text: Callable[[str, int], None] | None = None, *, within_s: float | None = None
    ) -> Message:
        where = text if len(text) <= 24 else f"{text[:21]}..."
        self._settle(within_s)
        self._owed += 1
        self._link.send(Message(_COMMAND, text), self.port.now_s())
        reply = self._await_reply(where, on_text, within_s)
        if reply.header == _RESULT and reply.text.strip() != "0000":
            number = reply.text.strip()
            if not (number.isdecimal() and len(number) == 4):
                raise BadReply(f"{reply.text!r} is not an error number", where=where)
            raise controller_error(int(number), where=where)
        return reply

    def _await_reply(self, where: str, on_text: Callable[[str, int], None] | None, within_s: float | None) -> Message:
        """Until the reply is here, the link gives up, or the controller has thought too long about it."""
        sent = False
        # The link's own timers end every wait; this ends a controller that keeps it busy with something else.
        give_up_s = self.port.now_s() + (self.patience_s if within_s is None else within_s)
        thinking_until_s = give_up_s
        while True:
            limit_s = thinking_until_s if sent and self._link.idle else give_up_s
            if self.port.now_s() >= limit_s:
                self._link.abort()
                self._flush()
                raise LinkError("no reply" if sent else "the line is never free", where=where, next_step=_LOOK_AT_LINE)
            for event in self._step(limit_s):
                match event:
                    case Sent():
                        sent = True
                        thinking_until_s = min(give_up_s, self.port.now_s() + self._reply_s)
                    case Failed(reason):
                        raise LinkError(reason, where=where, cause=_LINK_CAUSE, next_step=_LOOK_AT_LINE)
                    case BlockReceived(block, index) if sent and on_text is not None:
                        on_text(block, index)
                    case Received(message) if sent:
                        return message

    def _settle(self, within_s: float | None) -> None:
        """Take late replies off the line; in a hurry only for a quarter of the time that the next one may take."""
        until_s = self.port.now_s() + (self._timing.sequence_s if within_s is None else within_s / 4)
        while self._owed and self.port.now_s() < until_s:
            self._step(until_s)
        if within_s is None:
            self._owed = 0  # what has not come by now never will

    def listen(self, duration_s: float) -> None:
        """Serve the link and drop whatever it brings."""
        until_s = self.port.now_s() + duration_s
        while self.port.now_s() < until_s:
            self._step(until_s)

    def reconnect(self) -> None:
        """On a port that was lost: have it back, with nothing under way. ``HardwareError`` where it is not there."""
        self.port.reopen()
        self._link = BscLink(self._timing)
        self._owed = 1  # what the controller still says of before belongs to no command of ours

    def leave(self) -> None:
        """Let the link finish, then forget it: the port goes to another protocol."""
        until_s = self.port.now_s() + _FAREWELL_S
        while not self._link.idle and self.port.now_s() < until_s:
            self._step(until_s)
        self._link = BscLink(self._timing)
        self._owed = 0

    def _step(self, until_s: float) -> list[Event]:
        """Write what the link wants, wait for bytes or its next timer, and return what happened."""
        self._flush()
        link, port = self._link, self.port
        wake_s = until_s if link.deadline_s is None else min(until_s, link.deadline_s)
        data = port.read(max(0.0, wake_s - port.now_s()))
        if data:
            self.sink(data, False)
            link.receive(data, port.now_s())
        link.advance(port.now_s())
        self._flush()
        events = link.take_events()
        self._owed = max(0, self._owed - sum(isinstance(event, Received) for event in events))
        return events

    def _flush(self) -> None:
        output = self._link.take_output()
        if output:
            self.sink(output, True)
            self.port.write(output)


class ServoPower:
    """Power of all axes at once, on once it may be, off once they stand.

    Going off while an axis still moves, it would drop it into its brake, so standstill is looked for first - in the
    positions, which every controller reports. ``ours`` as long as we switched it on and have not switched it off yet.
    """

    def __init__(self, host: HostControl) -> None:
        self._host = host
        self.ours = False

    def on(self) -> None:
        """Release a command hold that was left behind, then power on; ``HardwareError`` where it is not seen."""
        status = self._host.status()
        if "command hold" in status.conditions:
            self._host.order("HOLD 0")
        self.ours = True
        if status.servo_on:
            return
        self._host.order("SVON 1")
        until_s = self._host.port.now_s() + _ON_WITHIN_S
        while not self._host.status().servo_on:
            if self._host.port.now_s() > until_s:
                raise HardwareError(
                    f"servo power is not on {_ON_WITHIN_S:g} s after it was ordered",
                    where="controller",
                    next_step="look at the pendant: safety circuit, e-stops, alarms",
                )

    def off(self, *, urgent: bool = False) -> None:
        """Wait for standstill, a second at most, then switch it off.

        ``urgent``: something failed; half a second per command, and power goes off also where the arm is not seen.
        """
        within_s = _URGENT_S if urgent else None
        with suppress(FrictidError) if urgent else nullcontext():
            self._await_rest(within_s)
        self._host.order("SVON 0", within_s=within_s)
        self.ours = False

    def _await_rest(self, within_s: float | None) -> None:
        until_s = self._host.port.now_s() + _AT_REST_WITHIN_S
        before = self._host.pulses(within_s=within_s)
        while self._host.port.now_s() < until_s:
            here = self._host.pulses(within_s=within_s)
            if max(abs(a - b) for a, b in zip(here, before, strict=True)) <= _STILL_PULSES:
                return
            before = here
