"""Frames to rows, live and from a log alike, for devices that answer each command with a report.

A cycle begins with the command to the first joint. Whatever reports come until the next one belong to it; each carries
the time at which its joint was commanded, because that is when the device looked at its sensors.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Protocol

from frictid_hil.protocol.driver import Feedback
from frictid_hil.protocol.frames import LoggedFrame


@dataclass(frozen=True, slots=True)
class Command:
    """A frame that commands a joint, or all of them."""

    joint: int  # index
    position_rad: float  # target that it sets; NaN for none
    others: tuple[tuple[int, float], ...] = ()  # the same of further joints, where one frame commands several


@dataclass(frozen=True, slots=True)
class Report:
    """A frame that brings figures of a joint, which are in its ``Feedback`` by now."""

    joint: int  # index


@dataclass(frozen=True, slots=True)
class Service:
    """A frame around the cycles."""

    name: str  # what a person would call it


class Decode(Protocol):
    """What a frame is; fills the feedback where it is a report. Raises nothing, whatever the bytes; None: unknown."""

    def __call__(self, can_id: int, data: bytes) -> Command | Report | Service | None:
        """Take one frame."""


class RowDecoder:
    """One robot's frames; ``feedback``, one per joint, is filled by the driver's ``decode``."""

    def __init__(self, feedback: Sequence[Feedback], decode: Decode) -> None:
        self.feedback = list(feedback)
        self._decode = decode
        self._asked_ns = [0] * len(self.feedback)

    def decode(self, can_id: int, data: bytes) -> Command | Report | Service | None:
        """What a frame is; a report's figures are in the feedback then, and ``take`` makes them count."""
        return self._decode(can_id, data)

    def take(self, t_ns: int, seen: Command | Report | Service | None) -> None:
        """Count a decoded frame: the first joint's command makes all figures one cycle older, a report renews them."""
        if isinstance(seen, Command):
            if seen.joint == 0:
                for report in self.feedback:
                    report.age_cycles += 1
            for joint, position_rad in ((seen.joint, seen.position_rad), *seen.others):
                self._asked_ns[joint] = t_ns
                self.feedback[joint].position_command_rad = position_rad
        elif isinstance(seen, Report):
            report = self.feedback[seen.joint]
            report.age_cycles, report.valid, report.t_ns = 0, True, self._asked_ns[seen.joint]

    def feed(self, t_ns: int, can_id: int, data: bytes) -> None:
        """Decode and count one frame, sent or received."""
        self.take(t_ns, self._decode(can_id, data))

    def waiting(self) -> bool:
        """Somebody has not reported in this cycle."""
        return any(report.age_cycles for report in self.feedback)


@dataclass(slots=True)
class Row:
    """One cycle of a log; reused from row to row."""

    t_ns: int
    feedback: Sequence[Feedback]


class RowLog:
    """A log, once, row by row (``protocol.frames.LogDecoder``)."""

    def __init__(self, decoder: RowDecoder) -> None:
        self._decoder = decoder
        self.unknown: Counter[str] = Counter()
        self.services: Counter[str] = Counter()
        self.repeated = 0
        self.backwards = 0

    def rows(self, frames: Iterable[LoggedFrame]) -> Iterator[Row]:
        """Decode frame by frame; whatever a log may hold, this does not raise."""
        decoder, row = self._decoder, Row(0, self._decoder.feedback)
        opened, last_ns = False, 0
        for t_ns, can_id, data in frames:
            self.backwards += t_ns < last_ns
            last_ns = t_ns
            fresh = [not report.age_cycles for report in decoder.feedback]
            seen = decoder.decode(can_id, data)
            if isinstance(seen, Command) and seen.joint == 0:
                if opened:
                    yield row
                opened, row.t_ns = True, t_ns
            elif isinstance(seen, Report):
                self.repeated += opened and fresh[seen.joint]
            elif isinstance(seen, Service):
                self.services[seen.name] += 1
            elif seen is None:
                self.unknown[f"frame {can_id & 0x1FFF_FFFF:#x}"] += 1
            decoder.take(t_ns, seen)
        if opened:
            yield row
