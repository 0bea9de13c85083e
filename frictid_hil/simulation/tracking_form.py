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
    """One number of the chain.

    Attributes:
        name: with its unit, as reported.
        position: (what comes in (n,), value, step_s) -> what goes on (n,).
        start: size from which it is sought.
        upper: largest value.
        lower: smallest value.
        neutral: value that changes nothing.
        of_travel: start and upper are shares of the longest travel.
    """

    name: str
    position: Callable[[Array, float, float], Array]
    start: float
    upper: float
    lower: float = 0.0
    neutral: float = 0.0
    of_travel: bool = False


@dataclass(frozen=True, slots=True)
class TrackingForm:
    """An effect in the chain.

    Attributes:
        links: its numbers, fitted together.
        order: effects act, and are sought, by rising order; the links of those before are fitted again beside it.
        certainty: confidence in it where it pays on logs not fitted; position alone tells some effects better.
        looks_like: effects that position alone cannot tell from it.
        mimics: effects that it may imitate on few motions; it is then named beside them, never by itself.
    """

    links: tuple[Link, ...]
    order: int
    certainty: float = 0.6
    looks_like: tuple[str, ...] = ()
    mimics: tuple[str, ...] = ()
