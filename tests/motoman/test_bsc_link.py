"""The link layer by transcripts: every byte of the published blocks, in both directions, and every damage to them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from frictid_drivers.motoman.bsc import (
    BlockReceived,
    BscLink,
    BscTiming,
    Event,
    Failed,
    Message,
    Received,
    Sent,
    decode_block,
    encode_blocks,
)
from frictid_drivers.motoman.emulator.panel import Settings
from frictid_drivers.motoman.emulator.station import Station, _pieces, _read

GOLDEN = {
    ("01,000", "RSTATS"): "01 30 31 2c 30 30 30 02 52 53 54 41 54 53 0d 03 10 03",
    ("01,000", "RPOSJ"): "01 30 31 2c 30 30 30 02 52 50 4f 53 4a 0d 03 bd 02",
    ("01,000", "SVON 1"): "01 30 31 2c 30 30 30 02 53 56 4f 4e 20 31 0d 03 c6 02",
    ("01,000", "HOLD 1"): "01 30 31 2c 30 30 30 02 48 4f 4c 44 20 31 0d 03 a7 02",
    ("90,000", "0000"): "01 39 30 2c 30 30 30 02 30 30 30 30 0d 03 f7 01",
    ("90,000", "2010"): "01 39 30 2c 30 30 30 02 32 30 31 30 0d 03 fa 01",
    ("90,000", "3070"): "01 39 30 2c 30 30 30 02 33 30 37 30 0d 03 01 02",
    ("90,001", "1,0"): "01 39 30 2c 30 30 31 02 31 2c 30 0d 03 c5 01",
}
LONG = Message("90,001", "".join(chr(0x21 + i % 90) for i in range(700)))


@pytest.mark.parametrize(("header", "text"), GOLDEN)
def test_golden_blocks_by_driver_and_by_emulator(header: str, text: str) -> None:
    raw = bytes.fromhex(GOLDEN[header, text])
    assert encode_blocks(Message(header, text)) == [raw]
    assert _pieces(header, text) == [raw]
    block = decode_block(raw)
    assert block is not None
    assert (block.header, block.text, block.last) == (header, text, True)
    assert _read(raw) == (header, text, True)


def step(link: BscLink, received: str, now_s: float = 0.0) -> tuple[str, list[Event]]:
    link.receive(bytes.fromhex(received), now_s)
    return link.take_output().hex(" "), link.take_events()


def test_golden_exchange_as_host() -> None:
    link = BscLink()
    link.send(Message("01,000", "RSTATS"), 0.0)
    assert link.take_output().hex(" ") == "05"
    assert step(link, "10 30") == ("01 30 31 2c 30 30 30 02 52 53 54 41 54 53 0d 03 10 03", [])
    assert step(link, "10 31") == ("04", [Sent()])
    assert step(link, "05") == ("10 30", [])
    sent, events = step(link, "01 39 30 2c 30 30 31 02 31 2c 30 0d 03 c5 01")
    assert sent == "10 31"
    assert events == [BlockReceived("1,0", 0), Received(Message("90,001", "1,0"))]
    assert step(link, "04") == ("", [])
    assert link.idle


def test_golden_exchange_as_controller() -> None:
    said: list[str] = []

    class Voice:
        def say(self, kind: str, data: bytes) -> None:
            said.append(data.hex(" "))

        def hears_enq(self) -> str:
            return ""

        def delivered(self, arrived: bool) -> None:
            assert arrived

        def doubts_block(self) -> bool:
            return False

    station = Station(Settings(), Voice(), lambda header, text: station.post("90,001", "1,0", 0.0))
    for heard, answer in [
        ("05", "10 30"),
        ("01 30 31 2c 30 30 30 02 52 53 54 41 54 53 0d 03 10 03", "10 31"),
        ("04", "05"),
        ("10 30", "01 39 30 2c 30 30 31 02 31 2c 30 0d 03 c5 01"),
        ("10 31", "04"),
    ]:
        station.hear(bytes.fromhex(heard), 0.0)
        assert said.pop() == answer
    assert not said
    assert station.quiet


@pytest.mark.parametrize(("text", "check"), [("RSTATS", "10 03"), ("3070", "01 02")])
def test_parser_traps_check_bytes_that_look_like_control_codes(text: str, check: str) -> None:
    header = "90,000" if text.isdigit() else "01,000"
    raw = encode_blocks(Message(header, text))[0]
    assert raw[-2:] == bytes.fromhex(check)
    for cut in range(len(raw) + 1):
        link = BscLink()
        link.receive(b"\x05", 0.0)
        link.receive(raw[:cut], 0.0)
        link.receive(raw[cut:], 0.0)
        assert Received(Message(header, text)) in link.take_events()
        assert link.take_output() == b"\x10\x30\x10\x31"


def test_continuation_blocks_alternate_and_end_in_etb() -> None:
    blocks = encode_blocks(LONG)
    assert [len(block) for block in blocks] == [8 + 256 + 3, 1 + 256 + 3, 1 + 189 + 3]
    assert [block[-3] for block in blocks] == [0x17, 0x17, 0x03]
    assert [block[0] for block in blocks] == [0x01, 0x02, 0x02]
    assert blocks == _pieces(LONG.header, LONG.text)
    link = BscLink()
    link.receive(b"\x05", 0.0)
    answers = []
    for block in blocks:
        link.receive(block, 0.0)
        answers.append(link.take_output().hex(" "))
    assert answers == ["10 30 10 31", "10 30", "10 31"]
    assert link.take_events()[-1] == Received(LONG)


def test_nak_resends_three_times_then_ends_with_eot() -> None:
    link = BscLink()
    link.send(Message("01,000", "RSTATS"), 0.0)
    link.receive(b"\x10\x30", 0.0)
    block = encode_blocks(Message("01,000", "RSTATS"))[0]
    assert link.take_output() == b"\x05" + block
    for _ in range(3):
        link.receive(b"\x15", 0.0)
        assert link.take_output() == block
    link.receive(b"\x15", 0.0)
    assert link.take_output() == b"\x04"
    assert link.take_events() == [Failed("a block was rejected (NAK) 4 times")]


def test_no_answer_to_enq_bids_again_by_timer_a_then_gives_up() -> None:
    link = BscLink()
    link.send(Message("01,000", "RSTATS"), 0.0)
    now_s = 0.0
    while link.deadline_s is not None:
        now_s = link.deadline_s
        link.advance(now_s)
    assert now_s == pytest.approx(11 * 3.0)
    assert link.take_output() == b"\x05" * 11 + b"\x04"
    assert link.take_events() == [Failed("no answer to ENQ, asked 11 times")]


def test_lost_acknowledgement_is_asked_for_and_nothing_is_doubled() -> None:
    link = BscLink()
    link.receive(b"\x05" + encode_blocks(Message("90,000", "0000"))[0], 0.0)
    assert link.take_output() == b"\x10\x30\x10\x31"
    link.receive(b"\x05", 3.0)  # the controller missed ACK1 and asks
    assert link.take_output() == b"\x10\x31"
    link.receive(b"\x04", 3.1)
    assert link.take_events() == [BlockReceived("0000", 0), Received(Message("90,000", "0000"))]
    assert link.idle


def test_wrong_parity_is_asked_again_before_anything_is_resent() -> None:
    link = BscLink()
    link.send(Message("01,000", "RSTATS"), 0.0)
    link.receive(b"\x10\x30", 0.0)
    link.take_output()
    link.receive(b"\x10\x30", 0.1)
    assert link.take_output() == b""
    link.advance(0.2)
    assert link.take_output() == b"\x05"
    link.receive(b"\x10\x31", 0.3)
    assert link.take_output() == b"\x04"
    assert link.take_events() == [Sent()]


def test_contention_holds_once_then_yields_and_sends_afterwards() -> None:
    link = BscLink()
    link.send(Message("01,000", "RSTATS"), 0.0)
    link.receive(b"\x05", 0.0)
    assert link.take_output() == b"\x05"
    link.advance(0.1)
    link.receive(b"\x05", 0.1)
    assert link.take_output() == b"\x05\x10\x30"
    link.receive(encode_blocks(Message("90,001", "UNASKED"))[0] + b"\x04", 0.2)
    assert link.take_output() == b"\x10\x31\x05"
    assert Received(Message("90,001", "UNASKED")) in link.take_events()


@given(st.data())
def test_any_split_or_merge_of_reads_gives_the_same_conversation(data: st.DataObject) -> None:
    stream = (
        b"\x05" + encode_blocks(Message("90,000", "3070"))[0] + b"\x04\x05" + b"".join(encode_blocks(LONG)) + b"\x04"
    )
    cuts = sorted(data.draw(st.lists(st.integers(0, len(stream)), max_size=20)))
    link = BscLink()
    for start, end in zip([0, *cuts], [*cuts, len(stream)], strict=True):
        link.receive(stream[start:end], 0.0)
    received = [event.message for event in link.take_events() if isinstance(event, Received)]
    assert received == [Message("90,000", "3070"), LONG]
    assert link.take_output() == bytes.fromhex("1030 1031 1030 1031 1030 1031")
    assert link.idle


@given(st.lists(st.tuples(st.binary(max_size=40), st.floats(0, 5)), max_size=30), st.booleans())
def test_arbitrary_bytes_never_hang_past_the_timers(script: list[tuple[bytes, float]], sending: bool) -> None:
    timing = BscTiming()
    link = BscLink(timing)
    now_s = 0.0
    if sending:
        link.send(Message("01,000", "RSTATS"), now_s)
    for data, pause_s in script:
        link.receive(data, now_s)
        now_s += pause_s
        while link.deadline_s is not None and link.deadline_s <= now_s:
            link.advance(link.deadline_s)
    started_s = now_s
    while link.deadline_s is not None:
        assert link.deadline_s >= now_s or link.deadline_s == pytest.approx(now_s)
        now_s = link.deadline_s
        link.advance(now_s)
    tries = timing.response_retries + 1
    assert now_s - started_s <= 2 * tries * timing.sequence_s + 6 * timing.text_end_s
    assert link.idle


@dataclass
class Pair:
    """The driver's link and the emulator's station on one wire that damages one byte; virtual time."""

    damage_at: int
    damage: int
    towards_host: bool
    dropped: bool = False
    to_host: bytearray = field(default_factory=bytearray)
    counts: dict[bool, int] = field(default_factory=lambda: {True: 0, False: 0})
    heard: list[tuple[str, str]] = field(default_factory=list)
    now_s: float = 0.0

    def __post_init__(self) -> None:
        self.link = BscLink()
        self.station = Station(Settings(), self, lambda header, text: self.heard.append((header, text)))

    def say(self, kind: str, data: bytes) -> None:
        self.to_host += data

    def hears_enq(self) -> str:
        return ""

    def delivered(self, arrived: bool) -> None:
        pass

    def doubts_block(self) -> bool:
        return False

    def _wire(self, data: bytes, towards_host: bool) -> bytes:
        out = bytearray()
        for byte in data:
            hit = towards_host == self.towards_host and self.counts[towards_host] == self.damage_at
            self.counts[towards_host] += 1
            if hit and self.dropped:
                continue
            out.append(byte ^ self.damage if hit else byte)
        return bytes(out)

    def run(self) -> list[Event]:
        events: list[Event] = []
        for _ in range(400):
            sent = self.link.take_output()
            if sent:
                self.station.hear(self._wire(sent, False), self.now_s)
            said, self.to_host = bytes(self.to_host), bytearray()
            if said:
                self.link.receive(self._wire(said, True), self.now_s)
            events += self.link.take_events()
            if sent or said:
                continue
            deadlines = [d for d in (self.link.deadline_s, self.station.deadline_s) if d is not None]
            if not deadlines:
                return events
            self.now_s = max(self.now_s, min(deadlines))
            self.link.advance(self.now_s)
            self.station.tick(self.now_s)
        raise AssertionError("the two never came to rest")


def received(events: list[Event]) -> list[Message]:
    return [event.message for event in events if isinstance(event, Received)]


def host_sends(pair: Pair, message: Message) -> None:
    pair.link.send(message, 0.0)
    events = pair.run()
    wanted = (message.header, message.text)
    if Sent() in events and not any(isinstance(event, Failed) for event in events):
        assert pair.heard, "sent, but the controller never heard it"
    assert all(heard == wanted for heard in pair.heard), "the controller took a damaged message for a whole one"
    assert len(pair.heard) <= 1, "one message was taken twice"
    assert pair.heard or any(isinstance(event, Failed) for event in events)


def controller_sends(pair: Pair, message: Message) -> None:
    pair.station.post(message.header, message.text, 0.0)
    events = pair.run()
    assert all(got == message for got in received(events)), "the host took a damaged message for a whole one"
    assert len(received(events)) <= 1, "one message was taken twice"
    assert received(events) or any(isinstance(event, Failed) for event in events)


@pytest.mark.slow
@pytest.mark.parametrize("towards_host", [True, False])
@pytest.mark.parametrize("sender", [host_sends, controller_sends])
@pytest.mark.parametrize("message", [Message("01,000", "RSTATS"), Message("90,000", "3070")])
def test_every_damage_to_every_byte_is_detected_or_retried(
    sender: Callable[[Pair, Message], None], message: Message, towards_host: bool
) -> None:
    for position in range(24):
        for damage in range(1, 256):
            sender(Pair(position, damage, towards_host), message)
        sender(Pair(position, 0, towards_host, dropped=True), message)


@pytest.mark.slow
def test_every_damage_to_every_answer_to_a_long_message_is_detected_or_retried() -> None:
    for position in range(8):
        for damage in range(1, 256):
            host_sends(Pair(position, damage, towards_host=True), LONG)
            controller_sends(Pair(position, damage, towards_host=False), LONG)


def test_a_text_cut_short_by_a_false_etx_is_no_block_even_with_a_matching_sum() -> None:
    covered = b"01,000\x02RST\x03"
    raw = b"\x01" + covered + sum(covered).to_bytes(2, "little")
    assert decode_block(raw) is None
    assert _read(raw) is None


@pytest.mark.slow
@settings(max_examples=150, deadline=None)
@given(st.integers(0, 760), st.integers(1, 255), st.booleans(), st.booleans())
def test_damage_to_a_long_message_is_detected_or_retried(
    position: int, damage: int, towards_host: bool, from_host: bool
) -> None:
    sender = host_sends if from_host else controller_sends
    sender(Pair(position, damage, towards_host), LONG)
