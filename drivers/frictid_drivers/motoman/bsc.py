"""The BSC-like serial link as a pure state machine: bytes and the time go in, bytes, events and a deadline come out.

One station bids with ENQ, sends its blocks, each answered by an alternating acknowledgement, and ends with EOT::

    ENQ ->                       <- ACK0
    SOH hh,sss STX data ... BCC  <- ACK1        first block
    STX data ... BCC             <- ACK0        continuation, after a block that ended in ETB
    EOT ->

Framing, codes, timers and retry counts are public. How a controller recovers (what ENQ means in the middle of a
message, who yields when both bid) is not; this module does what BSC always did: ENQ asks for the last answer again.

The line is idle, ours (``bsc_sender``) or the other side's (``bsc_receiver``).
"""

from __future__ import annotations

from frictid_drivers.motoman.bsc_block import ENQ, EOT, BscTiming, Event, Message, encode_blocks
from frictid_drivers.motoman.bsc_receiver import Receiver
from frictid_drivers.motoman.bsc_sender import Outcome, Sender, Yielded


class BscLink:
    """One end of the link.

    ``send`` and ``receive`` are what happens to it, ``advance`` lets time pass, ``take_output`` and ``take_events`` are
    what it wants; ``deadline_s`` says when it wants to be advanced at the latest. It never blocks and owns no clock.
    """

    def __init__(self, timing: BscTiming | None = None) -> None:
        timing = timing or BscTiming()
        self._output = bytearray()
        self._events: list[Event] = []
        self._waiting: list[bytes] | None = None
        """Blocks of our message until it is through; it may have to wait for the line."""
        self._sending = False
        self._sender = Sender(timing, self._output)
        self._receiver = Receiver(timing, self._output, self._events)

    def retime(self, timing: BscTiming) -> None:
        """Other timers and retries from the next wait on."""
        self._sender.timing = self._receiver.timing = timing

    @property
    def idle(self) -> bool:
        """Nothing is being sent or received, and nothing waits to be."""
        return self._free and self._waiting is None

    @property
    def busy_sending(self) -> bool:
        """A message of ours is not through yet."""
        return self._waiting is not None

    @property
    def contended(self) -> bool:
        """The peer bid at the same moment as our newest message did."""
        return self._sender.contended

    @property
    def deadline_s(self) -> float | None:
        """When ``advance`` must be called at the latest; None while no timer runs."""
        if self._free:
            return None
        return self._sender.deadline_s if self._sending else self._receiver.deadline_s

    def take_output(self) -> bytes:
        """Bytes to put on the wire."""
        output = bytes(self._output)
        self._output.clear()
        return output

    def take_events(self) -> list[Event]:
        """What happened since the last call, in order."""
        events = list(self._events)
        self._events.clear()
        return events

    def send(self, message: Message, now_s: float) -> None:
        """Send a message as soon as the line is free.

        Raises:
            RuntimeError: the previous one is not through yet.
            ValueError: it cannot be put into blocks.
        """
        if self._waiting is not None:
            raise RuntimeError("a message is being sent already")
        self._waiting = encode_blocks(message)
        self._sender.contended = False
        self._use_free_line(now_s)

    def abort(self) -> None:
        """Forget everything and tell the peer by EOT."""
        if not self._free:
            self._output.append(EOT)
        self._waiting = None
        self._sending = False
        self._receiver.end()

    def receive(self, data: bytes, now_s: float) -> None:
        """Take bytes from the wire, in any portions."""
        for byte in data:
            if self._sending:
                self._after_sender(self._sender.take(byte, now_s), now_s)
            elif not self._receiver.over:
                self._receiver.take(byte, now_s)
                self._use_free_line(now_s)
            elif byte == ENQ:
                self._receiver.grant(now_s)

    def advance(self, now_s: float) -> None:
        """Let timers expire."""
        deadline_s = self.deadline_s
        if deadline_s is None or now_s < deadline_s:
            return
        if self._sending:
            self._after_sender(self._sender.expire(now_s), now_s)
        else:
            self._receiver.expire(now_s)
            self._use_free_line(now_s)

    # -- whose line it is --------------------------------------------------------------------------------------

    @property
    def _free(self) -> bool:
        return not self._sending and self._receiver.over

    def _use_free_line(self, now_s: float) -> None:
        if self._waiting is not None and self._free:
            self._sending = True
            self._sender.bid(self._waiting, now_s)

    def _after_sender(self, outcome: Outcome, now_s: float) -> None:
        match outcome:
            case None:
                return
            case Yielded():
                # The message waits until the other side's is through.
                self._sending = False
                self._receiver.grant(now_s)
            case _:
                self._sending = False
                self._waiting = None
                self._events.append(outcome)
