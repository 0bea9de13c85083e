"""The controller's end of the BSC-like link, written as the conversation that it is.

One generator tells the story from the first ENQ to the last EOT; it yields how long it is willing to wait and is sent
the next byte, or None when nobody spoke in time. Everything that it says goes through ``Voice``, where faults live.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Generator
from typing import Protocol

from frictid_drivers.motoman.emulator.panel import Settings

_CUT = 256

Listening = Generator[float | None, int | None, None]
Answering = Generator[float | None, int | None, str]
Delivering = Generator[float | None, int | None, bool]


class Voice(Protocol):
    """Where the station's utterances go."""

    def say(self, kind: str, data: bytes) -> None:
        """Put ``data`` on the wire; kinds are enq, ack, nak, block, eot."""

    def hears_enq(self) -> str:
        """An ENQ arrived; ``bid`` makes the station bid against it, ``insist`` not give way either (faults)."""

    def delivered(self, arrived: bool) -> None:
        """A message of the controller has been delivered and ended by EOT, or was given up."""

    def doubts_block(self) -> bool:
        """An intact block arrived; True makes the station reject it all the same (a fault)."""


class Station:
    """Answers the host's messages, tells ``on_message`` header and text of each, and sends the controller's own."""

    def __init__(self, settings: Settings, voice: Voice, on_message: Callable[[str, str], None]) -> None:
        self._p = settings
        self._voice = voice
        self._on_message = on_message
        self._outbox: deque[tuple[str, str]] = deque()
        self._yields = True
        self.reset(0.0)

    @property
    def quiet(self) -> bool:
        """Nothing under way and nothing to say."""
        return self.deadline_s is None and not self._outbox

    def post(self, header: str, text: str, now_s: float) -> None:
        """Say this when the line is free."""
        self._outbox.append((header, text))
        if self.deadline_s is None:
            self._go_on(None, now_s)

    def hear(self, data: bytes, now_s: float) -> None:
        """Bytes from the host."""
        for byte in data:
            self._go_on(byte, now_s)

    def tick(self, now_s: float) -> None:
        """Time passes."""
        while self.deadline_s is not None and now_s >= self.deadline_s:
            self._go_on(None, now_s)

    def reset(self, now_s: float) -> None:
        """Forget the conversation (line re-opened, or given to another protocol)."""
        self._now_s = now_s
        self._outbox.clear()
        self._story = self._life()
        self._note_wait(next(self._story))

    def _go_on(self, byte: int | None, now_s: float) -> None:
        self._now_s = now_s
        self._note_wait(self._story.send(byte))

    def _note_wait(self, wait_s: float | None) -> None:
        # When ``tick`` is wanted; None while only bytes matter.
        self.deadline_s: float | None = None if wait_s is None else self._now_s + wait_s

    def _life(self) -> Listening:
        while True:
            if self._outbox:
                yield from self._speak()
                continue
            byte = yield None
            if byte == 0x05:
                yield from self._greet()

    def _greet(self) -> Listening:
        against = self._voice.hears_enq()
        if against:
            self._outbox.append(("90,001", "UNASKED"))
            self._yields = against == "bid"
            yield from self._speak()
            self._yields = True
        else:
            yield from self._listen()

    def _speak(self) -> Listening:
        """Deliver the first message of the outbox, or drop it after all retries."""
        header, text = self._outbox[0]
        for _ in range(self._p.retry_1 + 1):
            self._voice.say("enq", b"\x05")
            answer = yield from self._answer()
            if answer == "ENQ" and self._yields:
                yield from self._listen()
                return
            if answer == "ACK0":
                break
        arrived = answer == "ACK0"
        for number, piece in enumerate(_pieces(header, text), start=1):
            if arrived:
                arrived = yield from self._deliver(piece, f"ACK{number % 2}", numbered=number == 1)
        self._outbox.popleft()
        self._voice.say("eot", b"\x04")
        self._voice.delivered(arrived)

    def _deliver(self, piece: bytes, wanted: str, *, numbered: bool) -> Delivering:
        refused = unanswered = 0
        asked = False
        self._voice.say("block", piece)
        while True:
            answer = yield from self._answer()
            if answer == wanted:
                return True
            if answer == "EOT":
                return False
            again = (answer == "NAK" and (numbered or asked)) or (answer.startswith("ACK") and asked)
            if answer == "NAK":
                refused += again
            else:
                unanswered += 1
            if refused > self._p.retry_2 or unanswered > self._p.retry_1:
                return False
            if again:
                self._voice.say("block", piece)
                asked = False
            else:
                self._voice.say("enq", b"\x05")
                asked = True

    def _answer(self) -> Answering:
        """ACK0, ACK1, NAK, EOT, ENQ, rubbish or silence."""
        give_up_s = self._now_s + self._p.timer_a_s
        word = yield self._p.timer_a_s
        if word == 0x10:
            digit = yield self._p.hush_s
            while digit == 0x10:
                digit = yield self._p.hush_s
            if digit in (0x30, 0x31):
                return f"ACK{digit - 0x30}"
            word = digit
        names = {0x15: "NAK", 0x04: "EOT", 0x05: "ENQ"}
        if word in names:
            return names[word]
        if word is None:
            return "silence"
        while word is not None and self._now_s < give_up_s:
            if word == 0x10:
                digit = yield self._p.hush_s
                if digit in (0x30, 0x31):
                    return f"ACK{digit - 0x30}"
            word = yield self._p.hush_s
        return "rubbish"

    def _listen(self) -> Listening:
        """Take one message from the host, block by block, from ACK0 to EOT."""
        header, parts = "", list[str]()
        whole = False
        last_word = b"\x10\x30"
        spoiled = asked = 0
        self._voice.say("ack", last_word)
        while True:
            byte = yield (2 * self._p.timer_a_s if whole else self._p.timer_b_s)
            if byte == 0x05:
                asked += 1
                if whole and asked > 2:
                    # It has had its answer twice: this is the next bid, the EOT in between was lost.
                    self._on_message(header, "".join(parts))
                    yield from self._greet()
                    return
                if asked > self._p.retry_1:
                    return
                if not parts:
                    last_word = b"\x10\x30"
                self._voice.say("ack", last_word)
            elif byte == 0x04 or byte is None:
                if whole:
                    self._on_message(header, "".join(parts))
                return
            elif byte in (0x01, 0x02):
                raw, farewell = yield from self._block(byte)
                if farewell:
                    return
                read = _read(raw)
                if read is None or (not parts and not read[0]) or (not whole and self._voice.doubts_block()):
                    spoiled += 1
                    if spoiled > self._p.retry_2 + 1:
                        self._voice.say("eot", b"\x04")
                        return
                    last_word = b"\x15"
                    self._voice.say("nak", last_word)
                    continue
                if not whole:
                    if read[0]:
                        header, parts = read[0], []
                    parts.append(read[1])
                    whole = read[2]
                    spoiled = asked = 0
                    last_word = b"\x10\x31" if len(parts) % 2 else b"\x10\x30"
                else:
                    asked += 1
                self._voice.say("ack", last_word)
            elif not whole:
                _, farewell = yield from self._hush(byte)
                if farewell or parts:
                    self._voice.say("eot", b"\x04")
                    return
                last_word = b"\x15"
                self._voice.say("nak", last_word)

    def _block(self, first: int) -> Generator[float | None, int | None, tuple[bytes, bool]]:
        """Bytes of a block including its two sum bytes, and whether it ended in a farewell instead."""
        until_s = self._now_s + self._p.timer_b_s
        raw = bytearray([first])
        ends_at = 0
        while len(raw) != ends_at:
            byte = yield max(0.0, until_s - self._now_s)
            if byte is None:
                break
            raw.append(byte)
            if byte in (0x03, 0x17) and not ends_at:
                ends_at = len(raw) + 2
            elif not ends_at and (len(raw) == 266 or (byte < 0x20 and byte not in (0x0D, 0x02))):
                return (yield from self._hush(byte))
        return bytes(raw), False

    def _hush(self, last: int) -> Generator[float | None, int | None, tuple[bytes, bool]]:
        """Wait until the line is silent; nothing of it is a block, but a last EOT is a farewell."""
        until_s = self._now_s + self._p.timer_b_s
        while self._now_s < until_s:
            byte = yield self._p.hush_s
            if byte is None:
                break
            last = byte
        return b"", last == 0x04


def _pieces(header: str, text: str) -> list[bytes]:
    """SOH header STX text CR ETX sum, cut after every 256 bytes of text by ETB sum, STX."""
    left = text + "\r"
    made: list[bytes] = []
    while left:
        part, left = left[:_CUT], left[_CUT:]
        end = "\x17" if left else "\x03"
        opening, summed = ("\x02", part + end) if made else ("\x01", header + "\x02" + part + end)
        total = sum(summed.encode("ascii"))
        made.append(opening.encode("ascii") + summed.encode("ascii") + bytes([total % 256, total // 256 % 256]))
    return made


def _read(raw: bytes) -> tuple[str, str, bool] | None:
    """(header or "", text, last) of an intact block."""
    if len(raw) < 5:
        return None
    total = sum(raw[1:-2])
    if raw[-2] != total % 256 or raw[-1] != total // 256 % 256:
        return None
    inside, last = raw[1:-3].decode("latin-1"), raw[-3] == 0x03
    header = ""
    if raw[0] == 0x01:
        header, found, inside = inside.partition("\x02")
        if not found or len(header) != 6:
            return None
    if last:
        if not inside.endswith("\r"):
            return None
        inside = inside[:-1]
    if not (header + inside).isascii() or not (header + inside).isprintable():
        return None
    return header, inside, last
