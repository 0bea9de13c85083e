"""Faults on command: what shall go wrong, and at which of the things that the controller does.

A fault is written ``kind@n``, ``kind@nxK`` or ``kind@n:value``: at the n-th occasion (from 0), K times in a row, with a
figure. ``OCCASIONS`` says which occasions are counted for each kind.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass

from frictid_hil.errors import UsageError

OCCASIONS = {
    "lost_ack": "ack",  # swallows it
    "wrong_ack": "ack",  # says the other parity
    "nak": "block heard",  # rejects an intact block
    "bad_bcc": "block",  # falsifies the block check
    "lost_block": "block",  # swallows it
    "garble": "utterance",  # flips a bit in the middle of it
    "silence": "utterance",  # says nothing for ``value`` seconds
    "enq": "enq heard",  # bids against it; ``value`` 1: and does not yield
    "split": "utterance",  # from here on, byte by byte
    "merge": "utterance",  # from here on, utterances within ``value`` seconds arrive together
    "close": "utterance",  # the port disappears, for good or for ``value`` seconds
    "bad_crc": "frame",  # falsifies the CRC
    "lost_frame": "frame",  # swallows it
    "deaf": "frame heard",  # does not hear it
    "noise": "frame heard",  # hears it with a flipped bit
    "late": "tick",  # the feedback of this tick comes ``value`` seconds late
    "alarm": "tick",  # alarm number ``value``: servo power off
    "hold": "tick",  # somebody presses hold on the pendant
    "drop": "tick",  # the speed limiter drops ``value`` pulses of every moving axis
    "unplug": "tick",  # the port disappears, for good or for ``value`` seconds
}
"""What is counted, by kind: what the controller says (acks, blocks, any utterance; stream frames), what it hears, ticks
of motion."""
_FROM_HERE_ON = {"split", "merge"}
_WRITTEN = re.compile(r"^([a-z_]+)@(\d+)(?:x(\d+))?(?::(-?\d+(?:\.\d+)?))?$", re.ASCII)


@dataclass(frozen=True, slots=True)
class Fault:
    """One thing that shall go wrong."""

    kind: str  # see ``OCCASIONS``
    at: int  # first occasion, from 0
    times: int = 1  # occasions in a row
    value: float = 0.0  # figure of the kind (seconds, alarm number, pulses)

    @staticmethod
    def parse(text: str) -> Fault:
        """From ``kind@n``, ``kind@nxK``, ``kind@n:value``; ``UsageError`` for another form, or no such kind."""
        match = _WRITTEN.match(text.strip())
        if match is None or match[1] not in OCCASIONS:
            raise UsageError(
                f"{text!r} is no fault; write kind@n, kind@nxK or kind@n:value",
                next_step=f"kinds: {', '.join(OCCASIONS)}",
            )
        return Fault(match[1], int(match[2]), int(match[3] or 1), float(match[4] or 0.0))


class FaultPlan:
    """Counts occasions, by name, and says which faults are due."""

    def __init__(self, faults: Iterable[Fault] = ()) -> None:
        self._faults = tuple(faults)
        self.counted: Counter[str] = Counter()

    def occasion(self, name: str) -> dict[str, Fault]:
        """One more occasion of this name; the faults that strike at it, by kind."""
        index = self.counted[name]
        self.counted[name] += 1
        if not self._faults:
            return {}
        return {fault.kind: fault for fault in self._faults if OCCASIONS[fault.kind] == name and _strikes(fault, index)}


def _strikes(fault: Fault, index: int) -> bool:
    return index >= fault.at and (fault.kind in _FROM_HERE_ON or index < fault.at + fault.times)
