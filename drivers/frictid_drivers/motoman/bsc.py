"""The BSC-like serial link as a pure state machine: bytes and the time go in, bytes, events and a deadline come out.

One station bids with ENQ, sends its blocks, each answered by an alternating acknowledgement, and ends with EOT::

    ENQ ->                       <- ACK0
    SOH hh,sss STX data ... BCC  <- ACK1        first block
    STX data ... BCC             <- ACK0        continuation, after a block that ended in ETB
    EOT ->

Framing, codes, timers and retry counts are public. How a controller recovers (what ENQ means in the middle of a
message, who yields when both bid) is not; this module does what BSC always did: ENQ asks for the last answer again.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum, auto
from typing import Final

from frictid_drivers.motoman.bsc_block import (
    DLE,
    ENQ,
    EOT,
    NAK,
    SOH,
    STX,
    BlockReader,
    Message,
    decode_block,
    encode_blocks,
)

ACK: Final = (b"\x10\x30", b"\x10\x31")


@dataclass(frozen=True, slots=True)
class BscTiming:
    """Timers and retries, defaults of the controller's parameters RS034-RS037.

    Attributes:
        sequence_s: timer A (RS034): how long an answer may take.
        text_end_s: timer B (RS035): how long the rest of a text, or the next block, may take.
        response_retries: retry 1 (RS036): invalid or missing answers before giving up.
        text_retries: retry 2 (RS037): NAKs to the same text before giving up.
        quiet_s: silence after which garbage on the line is considered over (our choice, no controller parameter).
    """

    sequence_s: float = 3.0
    text_end_s: float = 20.0
    response_retries: int = 10
    text_retries: int = 3
    quiet_s: float = 0.1


@dataclass(frozen=True, slots=True)
class BlockReceived:
    """One block of a message arrived intact; worth keeping even when the rest of the message never comes."""

    text: str
    index: int


@dataclass(frozen=True, slots=True)
class Received:
    """The last block of a message arrived intact and was acknowledged."""

    message: Message


@dataclass(frozen=True, slots=True)
class Sent:
    """Our message was acknowledged to its last block."""


@dataclass(frozen=True, slots=True)
class Failed:
    """The link gave up on a message; ``reason`` says why."""

    reason: str


Event = BlockReceived | Received | Sent | Failed


class _State(Enum):
    IDLE = auto()
    BIDDING = auto()
    """ENQ sent, ACK0 expected."""
    SENDING = auto()
    """A block sent, its acknowledgement expected."""
    RECEIVING = auto()
    """The peer holds the line; a block, ENQ or EOT expected."""
    COMPLETE = auto()
    """The peer's last block is acknowledged, its EOT expected."""


class BscLink:
    """One end of the link.

    ``send`` and ``receive`` are what happens to it, ``advance`` lets time pass, ``take_output`` and ``take_events`` are
    what it wants; ``deadline_s`` says when it wants to be advanced at the latest. It never blocks and owns no clock.

    Args:
        timing: timers and retries.

    Attributes:
        contended: the peer bid at the same moment as our newest message did.
    """

    def __init__(self, timing: BscTiming | None = None) -> None:
        self._timing = timing or BscTiming()
        self._output = bytearray()
        self._events: list[Event] = []
        self._state = _State.IDLE
        self._deadline_s: float | None = None
        self._waiting: Message | None = None
        # As a sender
        self._blocks: list[bytes] = []
        self._index = 0
        self._response_retries = 0
        self._text_retries = 0
        self._asked_again = False
        self._answer_due_s = 0.0
        self._contentions = 0
        self.contended = False
        self._dle_seen = False
        # As a receiver
        self._reader = BlockReader()
        self._header = ""
        self._texts: list[str] = []
        self._last_answer = b""
        self._repeats = 0
        self._rejections = 0
        self._block_due_s = 0.0
        self._broken = False
        self._last_broken_byte = 0

    # -- what the owner sees -----------------------------------------------------------------------------------

    @property
    def idle(self) -> bool:
        """Nothing is being sent or received, and nothing waits to be."""
        return self._state is _State.IDLE and self._waiting is None

    @property
    def busy_sending(self) -> bool:
        """A message of ours is not through yet."""
        return self._waiting is not None

    @property
    def deadline_s(self) -> float | None:
        """When ``advance`` must be called at the latest; None while no timer runs."""
        return self._deadline_s

    def take_output(self) -> bytes:
        """Bytes to put on the wire."""
        output = bytes(self._output)
        self._output.clear()
        return output

    def take_events(self) -> list[Event]:
        """What happened since the last call, in order."""
        events, self._events = self._events, []
        return events

    def send(self, message: Message, now_s: float) -> None:
        """Send a message as soon as the line is free.

        Raises:
            RuntimeError: the previous one is not through yet.
            ValueError: it cannot be put into blocks.
        """
        if self._waiting is not None:
            raise RuntimeError("a message is being sent already")
        self._blocks = encode_blocks(message)
        self._waiting = message
        self.contended = False
        if self._state is _State.IDLE:
            self._bid(now_s)

    def abort(self) -> None:
        """Forget everything and tell the peer by EOT."""
        if self._state is not _State.IDLE:
            self._output.append(EOT)
        self._waiting = None
        self._rest(0.0)

    def receive(self, data: bytes, now_s: float) -> None:
        """Take bytes from the wire, in any portions."""
        for byte in data:
            if self._state is _State.IDLE:
                if byte == ENQ:
                    self._grant(now_s)
            elif self._state in (_State.BIDDING, _State.SENDING):
                self._take_answer(byte, now_s)
            else:
                self._take_block_byte(byte, now_s)

    def advance(self, now_s: float) -> None:
        """Let timers expire."""
        if self._deadline_s is None or now_s < self._deadline_s:
            return
        if self._state is _State.BIDDING:
            self._retry("no answer to ENQ", now_s)
        elif self._state is _State.SENDING:
            self._retry("no answer to a block", now_s)
        elif self._broken and self._last_broken_byte == EOT:
            self._peer_ended(now_s)
        elif self._broken or self._reader.open:
            self._reject(now_s)
        elif self._state is _State.COMPLETE:
            # The peer's EOT was lost; its message was not.
            self._rest(now_s)
        else:
            self._give_up("the other side fell silent in the middle of a message", now_s)

    # -- sending -----------------------------------------------------------------------------------------------

    def _bid(self, now_s: float) -> None:
        self._index = self._response_retries = self._text_retries = self._contentions = 0
        self._output.append(ENQ)
        self._await_answer(_State.BIDDING, now_s)

    def _take_answer(self, byte: int, now_s: float) -> None:
        after_dle, self._dle_seen = self._dle_seen, byte == DLE
        if after_dle and byte in (0x30, 0x31):
            self._acknowledged(byte - 0x30, now_s)
        elif byte == NAK:
            self._rejected(now_s)
        elif byte == EOT and self._state is _State.SENDING:
            self._give_up("the other side ended the transmission", now_s, tell=False)
        elif byte == ENQ and self._state is _State.BIDDING:
            self._contention(now_s)
        else:
            self._garbled(now_s)

    def _acknowledged(self, number: int, now_s: float) -> None:
        if self._state is _State.BIDDING and number == 0:
            self._send_block(now_s)
        elif self._state is _State.SENDING and number == (self._index + 1) % 2:
            self._next_block(now_s)
        elif self._state is _State.SENDING and self._asked_again:
            # Asked again, the other side repeats the acknowledgement of the block before: this one never arrived.
            self._response_retries += 1
            if self._response_retries > self._timing.response_retries:
                self._give_up(f"a block was never acknowledged, sent {self._response_retries} times", now_s)
            else:
                self._send_block(now_s)
        else:
            self._garbled(now_s)

    def _next_block(self, now_s: float) -> None:
        self._index += 1
        self._response_retries = self._text_retries = 0
        if self._index < len(self._blocks):
            self._send_block(now_s)
            return
        self._output.append(EOT)
        self._waiting = None
        self._events.append(Sent())
        self._rest(now_s)

    def _rejected(self, now_s: float) -> None:
        if self._state is _State.BIDDING:
            # Not ready to receive: the same ENQ again, a little later.
            self._garbled(now_s)
        elif self._index > 0 and not self._asked_again:
            # An acknowledgement damaged into a NAK would double a continuation block, which carries no number.
            self._ask_again(now_s)
        else:
            self._text_retries += 1
            if self._text_retries > self._timing.text_retries:
                self._give_up(f"a block was rejected (NAK) {self._text_retries} times", now_s)
            else:
                self._send_block(now_s)

    def _garbled(self, now_s: float) -> None:
        """An answer that is none, or half of one: wait until the line is quiet, then ask again."""
        self._deadline_s = min(now_s + self._timing.quiet_s, self._answer_due_s)

    def _retry(self, why: str, now_s: float) -> None:
        self._response_retries += 1
        if self._response_retries > self._timing.response_retries:
            self._give_up(f"{why}, asked {self._response_retries} times", now_s)
        else:
            self._ask_again(now_s)

    def _ask_again(self, now_s: float) -> None:
        self._asked_again = True
        self._output.append(ENQ)
        self._await_answer(self._state, now_s)

    def _send_block(self, now_s: float) -> None:
        self._asked_again = False
        self._output += self._blocks[self._index]
        self._await_answer(_State.SENDING, now_s)

    def _await_answer(self, state: _State, now_s: float) -> None:
        self._answer_due_s = now_s + self._timing.sequence_s
        self._enter(state, self._answer_due_s)
        self._dle_seen = False

    def _contention(self, now_s: float) -> None:
        """Both bid at once: hold on the first time, yield the second.

        That ends it against a controller that yields at once as well as against one that never does.
        """
        self._contentions += 1
        self.contended = True
        if self._contentions == 1:
            self._garbled(now_s)
        else:
            self._grant(now_s)

    # -- receiving ---------------------------------------------------------------------------------------------

    def _grant(self, now_s: float) -> None:
        """The line is the peer's: ACK0, and a message from its beginning."""
        if self._state is not _State.RECEIVING:
            self._repeats = 0
        elif self._texts:
            self._events.append(Failed("the other side started anew in the middle of a message"))
        self._header, self._texts = "", []
        self._rejections = 0
        self._last_answer = ACK[0]
        self._repeat_answer(_State.RECEIVING, now_s)

    def _take_block_byte(self, byte: int, now_s: float) -> None:
        if self._broken:
            self._break(byte, now_s)
        elif self._reader.open or byte in (SOH, STX):
            self._read(byte, now_s)
        elif byte == ENQ:
            self._asked_for_answer(now_s)
        elif byte == EOT:
            self._peer_ended(now_s)
        elif self._state is _State.RECEIVING and self._texts:
            # A byte that belongs to no block follows an accepted one: that block's end may have been a damaged byte.
            self._give_up("bytes outside any block in the middle of a message", now_s)
        elif self._state is _State.RECEIVING:
            self._block_due_s = now_s + self._timing.text_end_s
            self._break(byte, now_s)

    def _read(self, byte: int, now_s: float) -> None:
        if not self._reader.open:
            self._deadline_s = self._block_due_s = now_s + self._timing.text_end_s
        try:
            raw = self._reader.take(byte)
        except ValueError:
            self._break(byte, now_s)
            return
        if raw is not None:
            self._take_block(raw, now_s)

    def _break(self, byte: int, now_s: float) -> None:
        """This block is lost: discard what comes until the line is quiet, then reject it.

        A control code here may be a damaged byte of the block as well as the peer's impatience; the quiet tells.
        """
        self._broken = True
        self._last_broken_byte = byte
        self._deadline_s = min(now_s + self._timing.quiet_s, self._block_due_s)

    def _take_block(self, raw: bytes, now_s: float) -> None:
        block = decode_block(raw)
        if block is None or not (block.header or self._texts):
            self._reject(now_s)
        elif self._state is _State.COMPLETE:
            # The last block once more: its acknowledgement did not arrive.
            self._repeat_answer(_State.COMPLETE, now_s)
        else:
            if block.header:
                # Seen twice, its acknowledgement did not arrive; the message simply starts anew.
                self._header, self._texts = block.header, []
            self._accept(block.text, block.last, now_s)

    def _accept(self, text: str, last: bool, now_s: float) -> None:
        self._events.append(BlockReceived(text, len(self._texts)))
        self._texts.append(text)
        self._rejections = self._repeats = 0
        self._answer(ACK[len(self._texts) % 2], _State.COMPLETE if last else _State.RECEIVING, now_s)
        if last:
            self._events.append(Received(Message(self._header, "".join(self._texts))))

    def _reject(self, now_s: float) -> None:
        self._rejections += 1
        if self._rejections > self._timing.text_retries + 1:
            self._give_up(f"a block was unreadable {self._rejections} times", now_s)
        else:
            self._answer(bytes([NAK]), self._state, now_s)

    def _asked_for_answer(self, now_s: float) -> None:
        if not self._texts or self._repeats >= 2:
            # Nothing accepted yet; or the peer has had its answer twice, so its EOT was lost and this is its next bid.
            self._grant(now_s)
        else:
            self._repeat_answer(self._state, now_s)

    def _repeat_answer(self, state: _State, now_s: float) -> None:
        self._repeats += 1
        if self._repeats > self._timing.response_retries + 1:
            self._give_up(f"the other side asked for the same answer {self._repeats} times", now_s)
        else:
            self._answer(self._last_answer, state, now_s)

    def _answer(self, answer: bytes, state: _State, now_s: float) -> None:
        self._last_answer = answer
        self._output += answer
        # A sender that misses this answer asks after its own timer A; being still here then costs nothing.
        wait_s = 2 * self._timing.sequence_s if state is _State.COMPLETE else self._timing.text_end_s
        self._enter(state, now_s + wait_s)
        self._reader.clear()
        self._broken = False

    def _peer_ended(self, now_s: float) -> None:
        if self._state is _State.RECEIVING and self._texts:
            self._give_up("the other side ended in the middle of a message", now_s, tell=False)
        else:
            self._rest(now_s)

    # -- both --------------------------------------------------------------------------------------------------

    def _enter(self, state: _State, deadline_s: float) -> None:
        self._state = state
        self._deadline_s = deadline_s

    def _rest(self, now_s: float) -> None:
        self._state = _State.IDLE
        self._deadline_s = None
        self._reader.clear()
        self._broken = False
        if self._waiting is not None:
            self._bid(now_s)

    def _give_up(self, reason: str, now_s: float, *, tell: bool = True) -> None:
        if tell:
            self._output.append(EOT)
        if self._state in (_State.BIDDING, _State.SENDING):
            self._waiting = None
        self._events.append(Failed(reason))
        self._rest(now_s)
