"""Listening for other nodes' heartbeats (object 1016h): armed by the first one, lost when none came in time."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

_MS = 1_000_000


@dataclass(slots=True)
class Consumer:
    """One node listened for."""

    node: int
    timeout_ns: int
    deadline_ns: int | None = None  # when it counts as lost; None until it was heard
    lost: bool = False  # it fell silent and has not been heard again


class HeartbeatWatch:
    """All nodes listened for."""

    def __init__(self) -> None:
        self.consumers: list[Consumer] = []

    def configure(self, entries: Iterable[int]) -> None:
        """Take over the entries of 1016h; one that stays the same keeps its state."""
        known = {(consumer.node, consumer.timeout_ns): consumer for consumer in self.consumers}
        wanted = [(entry >> 16 & 0x7F, (entry & 0xFFFF) * _MS) for entry in entries]
        self.consumers = [known.get(one) or Consumer(*one) for one in wanted if all(one)]

    @property
    def any_lost(self) -> bool:
        """Somebody is missing."""
        return any(consumer.lost for consumer in self.consumers)

    @property
    def deadlines_ns(self) -> list[int]:
        """When those that were heard count as lost."""
        return [consumer.deadline_ns for consumer in self.consumers if consumer.deadline_ns is not None]

    def newly_lost(self, now_ns: int) -> list[int]:
        """Nodes whose time has run out; each is told once."""
        late = [one for one in self.consumers if one.deadline_ns is not None and now_ns >= one.deadline_ns]
        for consumer in late:
            consumer.deadline_ns = None
            consumer.lost = True
        return [consumer.node for consumer in late]
