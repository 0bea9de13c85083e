"""What both ends of the BSC-like link share: its codes, timers, events and blocks.

``SOH hh,sss STX data (CR ETX | ETB) BCC`` comes first, ``STX data (CR ETX | ETB) BCC`` continues it. The block check is
a 16-bit **sum** of everything after the leading SOH (STX in a continuation) up to and including ETX or ETB, low byte
first. Its two bytes may look like any control code, so the reader goes to ETX or ETB and then takes exactly two raw
bytes.
"""

from __future__ import annotations

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
