"""What both ends of the BSC-like link share: its codes for answers, its timers, and what happens on it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from frictid_drivers.motoman.bsc_block import DLE, Message

ACK: Final = (bytes([DLE, 0x30]), bytes([DLE, 0x31]))
"""The two acknowledgements, which alternate from block to block."""


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
