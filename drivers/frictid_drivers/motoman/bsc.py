"""The BSC-like serial link as a pure state machine: bytes and the time go in, bytes, events and a deadline come out.

One station bids with ENQ, sends its blocks, each answered by an alternating acknowledgement, and ends with EOT::

    ENQ ->                                   <- ACK0
    SOH hh,sss STX data (CR ETX | ETB) BCC   <- ACK1        first block
    STX data (CR ETX | ETB) BCC              <- ACK0        continuation, after a block that ended in ETB
    EOT ->

The block check is a 16-bit **sum** of everything after the leading SOH (STX in a continuation) up to and including ETX
or ETB, low byte first. Its two bytes may look like any control code: after ETX or ETB exactly two raw bytes are taken.

Framing, codes, timers and retry counts are public. How a controller recovers (what ENQ means in the middle of a
message, who yields when both bid) is not; this module does what BSC always did: ENQ asks for the last answer again.

The line is idle, ours (``Sender``) or the other side's (``Receiver``).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

SOH: Final = 0x01
STX: Final = 0x02
ETX: Final = 0x03
EOT: Final = 0x04
ENQ: Final = 0x05
CR: Final = 0x0D
DLE: Final = 0x10
NAK: Final = 0x15
ETB: Final = 0x17
ACK: Final = (bytes([DLE, 0x30]), bytes([DLE, 0x31]))  # the two acknowledgements, which alternate from block to block

MAX_DATA_BYTES: Final = 256
_HEADER_BYTES: Final = 6
LONGEST_BLOCK: Final = 1 + _HEADER_BYTES + 1 + MAX_DATA_BYTES + 1


@dataclass(frozen=True, slots=True)
class Message:
    """One whole message: a header ``hh,sss``, and printable ASCII without the CR that ends it."""

    header: str
    text: str


@dataclass(frozen=True, slots=True)
class Block:
    """One block, read and checked: header "" on a continuation, text without the final CR, last where ETX ended it."""

    header: str
    text: str
    last: bool


@dataclass(frozen=True, slots=True)
class BscTiming:
    """Timers and retries, defaults of the controller's parameters RS034-RS037."""

    sequence_s: float = 3.0  # timer A (RS034): how long an answer may take
    text_end_s: float = 20.0  # timer B (RS035): how long the rest of a text, or the next block, may take
    response_retries: int = 10  # retry 1 (RS036): invalid or missing answers before giving up
    text_retries: int = 3  # retry 2 (RS037): NAKs to the same text before giving up
    quiet_s: float = 0.1  # silence after which garbage on the line is considered over (our choice, no parameter)


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


def block_check(covered: bytes) -> bytes:
    """The 16-bit sum of the covered bytes, low byte first."""
    return (sum(covered) & 0xFFFF).to_bytes(2, "little")


def encode_blocks(message: Message) -> list[bytes]:
    """A message's blocks of at most 256 bytes (the CR counts); ``ValueError`` without ``hh,sss`` or printable ASCII."""
    header, data = message.header.encode("ascii"), message.text.encode("ascii")
    if len(header) != _HEADER_BYTES or header[2:3] != b",":
        raise ValueError(f"header {message.header!r} is not hh,sss")
    if not _printable(data):
        raise ValueError("the text of a block may hold printable ASCII only")
    data += bytes([CR])
    blocks = []
    for start in range(0, len(data), MAX_DATA_BYTES):
        end_code = ETX if start + MAX_DATA_BYTES >= len(data) else ETB
        lead, covered = (SOH, header + bytes([STX])) if start == 0 else (STX, b"")
        covered += data[start : start + MAX_DATA_BYTES] + bytes([end_code])
        blocks.append(bytes([lead]) + covered + block_check(covered))
    return blocks


def decode_block(raw: bytes) -> Block | None:
    """The block in these bytes, from SOH or STX to the end of the block check; None where anything is wrong with it."""
    covered, check = raw[1:-2], raw[-2:]
    if len(covered) < 1 or check != block_check(covered):
        return None
    header, data, last = b"", covered[:-1], covered[-1] == ETX
    if raw[0] == SOH:
        header, stx, data = data[:_HEADER_BYTES], data[_HEADER_BYTES : _HEADER_BYTES + 1], data[_HEADER_BYTES + 1 :]
        if stx != bytes([STX]):
            return None
    if last:
        if data[-1:] != bytes([CR]):
            return None
        data = data[:-1]
    if not (_printable(header) and _printable(data)):
        return None
    return Block(header.decode("ascii"), data.decode("ascii"), last)


def _printable(data: bytes) -> bool:
    return all(0x20 <= byte < 0x7F for byte in data)


_BID = bytes([ENQ])


class Yielded:
    """Both sides bid for the line, and it is the other one's now."""


Outcome = Sent | Failed | Yielded | None  # how the sending ended; None while it goes on


class Sender:
    """One message on its way, once ``bid`` for, said into ``output``; call ``expire`` by ``deadline_s``."""

    def __init__(self, timing: BscTiming, output: bytearray) -> None:
        self.timing = timing
        self._output = output
        self.contended = False  # the other side bid at the same moment
        self._dle_seen = False

    def bid(self, blocks: Sequence[bytes], now_s: float) -> None:
        """Ask for the line, to send these."""
        self._blocks = blocks
        self._index = -1  # of the block under way; -1 while bidding
        self._response_retries = self._text_retries = self._contentions = 0
        self._say(_BID, now_s)

    def take(self, byte: int, now_s: float) -> Outcome:
        """One byte of an answer."""
        after_dle, self._dle_seen = self._dle_seen, byte == DLE
        if after_dle and byte in (0x30, 0x31):
            return self._acknowledged(byte - 0x30, now_s)
        if byte == NAK:
            return self._rejected(now_s)
        if byte == EOT and not self._bidding:
            return Failed("the other side ended the transmission")
        if byte == ENQ and self._bidding:
            return self._contention(now_s)
        return self._garbled(now_s)

    def expire(self, now_s: float) -> Outcome:
        """No answer in time."""
        self._response_retries += 1
        if self._response_retries > self.timing.response_retries:
            what = "ENQ" if self._bidding else "a block"
            return self._give_up(f"no answer to {what}, asked {self._response_retries} times")
        return self._say(_BID, now_s, again=True)

    @property
    def _bidding(self) -> bool:
        return self._index < 0

    def _acknowledged(self, number: int, now_s: float) -> Outcome:
        if self._bidding:
            return self._next_block(now_s) if number == 0 else self._garbled(now_s)
        if number == (self._index + 1) % 2:
            return self._next_block(now_s)
        if not self._asked_again:
            return self._garbled(now_s)
        # Asked again, the other side repeats the acknowledgement of the block before: this one never arrived.
        self._response_retries += 1
        if self._response_retries > self.timing.response_retries:
            return self._give_up(f"a block was never acknowledged, sent {self._response_retries} times")
        return self._say(self._blocks[self._index], now_s)

    def _next_block(self, now_s: float) -> Outcome:
        if not self._bidding:
            self._response_retries = self._text_retries = 0
        self._index += 1
        if self._index < len(self._blocks):
            return self._say(self._blocks[self._index], now_s)
        self._output.append(EOT)
        return Sent()

    def _rejected(self, now_s: float) -> Outcome:
        if self._bidding:
            # Not ready to receive: the same ENQ again, a little later.
            return self._garbled(now_s)
        if self._index > 0 and not self._asked_again:
            # An acknowledgement damaged into a NAK would double a continuation block, which carries no number.
            return self._say(_BID, now_s, again=True)
        self._text_retries += 1
        if self._text_retries > self.timing.text_retries:
            return self._give_up(f"a block was rejected (NAK) {self._text_retries} times")
        return self._say(self._blocks[self._index], now_s)

    def _contention(self, now_s: float) -> Outcome:
        """Both bid at once: hold on first, then yield; that ends it with those who yield at once, and who never do."""
        self._contentions += 1
        self.contended = True
        return self._garbled(now_s) if self._contentions == 1 else Yielded()

    def _garbled(self, now_s: float) -> Outcome:
        """An answer that is none, or half of one: wait until the line is quiet, then ask again."""
        self.deadline_s = min(now_s + self.timing.quiet_s, self._answer_due_s)
        return None

    def _say(self, what: bytes, now_s: float, *, again: bool = False) -> Outcome:
        """Put it on the wire, ENQ for the last answer ``again`` or a block, and wait for an answer."""
        self._asked_again = again
        self._output += what
        self.deadline_s = self._answer_due_s = now_s + self.timing.sequence_s
        self._dle_seen = False
        return None

    def _give_up(self, reason: str) -> Failed:
        self._output.append(EOT)
        return Failed(reason)


class Receiver:
    """The other side's messages, answered and told into the lists until ``over``; ``expire`` by ``deadline_s``."""

    def __init__(self, timing: BscTiming, output: bytearray, events: list[Event]) -> None:
        self.timing = timing
        self._output = output
        self._events = events
        self._raw = bytearray()  # of the block that has begun
        self._check_bytes_left = 0
        self._header = ""
        self._texts: list[str] = []
        self._complete = False  # the last block is acknowledged, EOT expected
        self._last_answer = b""
        self._repeats = 0
        self._rejections = 0
        self._block_due_s = 0.0
        self._broken = False
        self._last_broken_byte = 0
        self.deadline_s = 0.0
        self.over = True

    def grant(self, now_s: float) -> None:
        """The line is the peer's: ACK0, and a message from its beginning."""
        if self.over or self._complete:
            self._repeats = 0
        elif self._texts:
            self._events.append(Failed("the other side started anew in the middle of a message"))
        self._header, self._texts = "", []
        self._rejections = 0
        self._last_answer = ACK[0]
        self.over = self._complete = False
        self._repeat_answer(now_s)

    def take(self, byte: int, now_s: float) -> None:
        """One byte of the peer's, which holds the line."""
        if self._broken:
            self._break(byte, now_s)
        elif self._raw or byte in (SOH, STX):
            self._read(byte, now_s)
        elif byte == ENQ:
            self._asked_for_answer(now_s)
        elif byte == EOT:
            self._peer_ended()
        elif not self._complete and self._texts:
            # A byte that belongs to no block follows an accepted one: that block's end may have been a damaged byte.
            self._give_up("bytes outside any block in the middle of a message")
        elif not self._complete:
            self._block_due_s = now_s + self.timing.text_end_s
            self._break(byte, now_s)

    def expire(self, now_s: float) -> None:
        """Nothing more in time."""
        if self._broken and self._last_broken_byte == EOT:
            self._peer_ended()
        elif self._broken or self._raw:
            self._reject(now_s)
        elif self._complete:
            # The peer's EOT was lost; its message was not.
            self.end()
        else:
            self._give_up("the other side fell silent in the middle of a message")

    def end(self) -> None:
        """The line is free."""
        self._forget_block()
        self.over = True

    def _read(self, byte: int, now_s: float) -> None:
        raw = self._raw
        if not raw:
            self.deadline_s = self._block_due_s = now_s + self.timing.text_end_s
        raw.append(byte)
        if self._check_bytes_left:
            self._check_bytes_left -= 1
            if not self._check_bytes_left:
                self._raw = bytearray()
                self._take_block(bytes(raw), now_s)
        elif byte in (ETX, ETB):
            self._check_bytes_left = 2
        elif len(raw) >= LONGEST_BLOCK or (len(raw) > 1 and not (0x20 <= byte < 0x7F or byte in (CR, STX))):
            self._break(byte, now_s)

    def _forget_block(self) -> None:
        self._raw.clear()
        self._check_bytes_left = 0
        self._broken = False

    def _break(self, byte: int, now_s: float) -> None:
        """A block is lost: discard until the line is quiet, which tells a damaged byte from the peer's impatience."""
        self._broken = True
        self._last_broken_byte = byte
        self.deadline_s = min(now_s + self.timing.quiet_s, self._block_due_s)

    def _take_block(self, raw: bytes, now_s: float) -> None:
        block = decode_block(raw)
        if block is None or not (block.header or self._texts):
            self._reject(now_s)
        elif self._complete:
            # The last block once more: its acknowledgement did not arrive.
            self._repeat_answer(now_s)
        else:
            if block.header:
                # Seen twice, its acknowledgement did not arrive; the message simply starts anew.
                self._header, self._texts = block.header, []
            self._accept(block.text, block.last, now_s)

    def _accept(self, text: str, last: bool, now_s: float) -> None:
        self._events.append(BlockReceived(text, len(self._texts)))
        self._texts.append(text)
        self._rejections = self._repeats = 0
        self._complete = last
        self._answer(ACK[len(self._texts) % 2], now_s)
        if last:
            self._events.append(Received(Message(self._header, "".join(self._texts))))

    def _reject(self, now_s: float) -> None:
        self._rejections += 1
        if self._rejections > self.timing.text_retries + 1:
            self._give_up(f"a block was unreadable {self._rejections} times")
        else:
            self._answer(bytes([NAK]), now_s)

    def _asked_for_answer(self, now_s: float) -> None:
        if not self._texts or self._repeats >= 2:
            # Nothing accepted yet; or the peer has had its answer twice, so its EOT was lost and this is its next bid.
            self.grant(now_s)
        else:
            self._repeat_answer(now_s)

    def _repeat_answer(self, now_s: float) -> None:
        self._repeats += 1
        if self._repeats > self.timing.response_retries + 1:
            self._give_up(f"the other side asked for the same answer {self._repeats} times")
        else:
            self._answer(self._last_answer, now_s)

    def _answer(self, answer: bytes, now_s: float) -> None:
        self._last_answer = answer
        self._output += answer
        # A sender that misses this answer asks after its own timer A; being still here then costs nothing.
        self.deadline_s = now_s + (2 * self.timing.sequence_s if self._complete else self.timing.text_end_s)
        self._forget_block()

    def _peer_ended(self) -> None:
        if not self._complete and self._texts:
            self._events.append(Failed("the other side ended in the middle of a message"))
        self.end()

    def _give_up(self, reason: str) -> None:
        self._output.append(EOT)
        self._events.append(Failed(reason))
        self.end()


class BscLink:
    """One end of the link.

    ``send`` and ``receive`` are what happens to it, ``advance`` lets time pass, ``take_output`` and ``take_events`` are
    what it wants; ``deadline_s`` says when it wants to be advanced at the latest. It never blocks and owns no clock.
    """

    def __init__(self, timing: BscTiming | None = None) -> None:
        timing = timing or BscTiming()
        self._output = bytearray()
        self._events: list[Event] = []
        # Of our message, until it is through; it may have to wait for the line.
        self._waiting: list[bytes] | None = None
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
        """Send a message as soon as the line is free; one before it that is not through yet is given up."""
        if self._waiting is not None:
            self.abort()
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
