"""What an effect makes of a command on its way to the position, where nothing but these two is recorded.

Such effects form a chain: the position is the command, changed by one link after the other. The diagnosis composes
whatever links there are and knows none of them by name.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from frictid_hil.friction.trajectory import Array


@dataclass(frozen=True, slots=True)
class Link:
    """One number of the chain."""

    name: str  # with its unit, as reported
    position: Callable[[Array, float, float], Array]  # (what comes in (n,), value, step_s) -> what goes on (n,)
    start: float  # size from which it is sought
    upper: float  # largest value
    lower: float = 0.0  # smallest value
    neutral: float = 0.0  # value that changes nothing
    of_travel: bool = False  # start and upper are shares of the longest travel


@dataclass(frozen=True, slots=True)
class TrackingForm:
    """An effect in the chain."""

    links: tuple[Link, ...]  # its numbers, fitted together
    order: int  # effects act, and are sought, by rising order; the links of those before are fitted again beside it
    # Confidence in it where it pays on logs not fitted; position alone tells some effects better.
    certainty: float = 0.6
    looks_like: tuple[str, ...] = ()  # effects that position alone cannot tell from it
    # Effects that it may imitate on few motions; it is then named beside them, never by itself.
    mimics: tuple[str, ...] = ()
