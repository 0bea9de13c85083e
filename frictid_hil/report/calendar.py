"""Nights as a calendar: one square for every day, coloured by how its recalibration ended, leading to its page."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import date, timedelta

from frictid_hil.profiles.records import Attempt

STATES: Mapping[str, tuple[str, str]] = {
    "promoted": ("\u2713", "promoted"),
    "kept": ("\u2013", "measured, not promoted"),
    "drifted": ("!", "drifted"),
    "failed": ("\u2717", "ended without a profile"),
}
"""Sign and words of every way in which a night can end."""

_WEEKS = 53


@dataclass(frozen=True, slots=True)
class Day:
    """One square."""

    date: str  # ``2026-03-01``
    state: str = ""  # key of ``STATES``; "" for a day without a recalibration
    words: str = ""  # for pointer and screen reader
    address: str = ""  # of the night's page; "" where there is none

    @property
    def sign(self) -> str:
        """What tells the state without its colour."""
        return STATES[self.state][0] if self.state else ""


@dataclass(frozen=True, slots=True)
class Calendar:
    """Weeks of seven days from Monday on, oldest first; None before the first and after the last day."""

    weeks: tuple[tuple[Day | None, ...], ...]
    caption: str


def calendar(nights: Sequence[Attempt], addresses: Mapping[str, str]) -> Calendar:
    """The newest year of one night at least, oldest first, the last of a day counting; addresses by their ``utc``."""
    days = {one.utc[:10]: one for one in nights}
    last = date.fromisoformat(max(days))
    first = max(date.fromisoformat(min(days)), last - timedelta(weeks=_WEEKS - 1, days=last.weekday()))
    monday = first - timedelta(days=first.weekday())
    weeks = []
    while monday <= last:
        week = (monday + timedelta(days=weekday) for weekday in range(7))
        weeks.append(tuple(_day(day, days, addresses) if first <= day <= last else None for day in week))
        monday += timedelta(weeks=1)
    meaning = ", ".join(f"{sign} {words}" for sign, words in STATES.values())
    return Calendar(tuple(weeks), f"One square a day (UTC): {meaning}. A square leads to the page of its night.")


def state_of(night: Attempt) -> str:
    """How a night ended: a key of ``STATES``."""
    if night.drifted:
        return "drifted"
    if night.promoted:
        return "promoted"
    return "kept" if night.profile else "failed"


def _day(day: date, nights: Mapping[str, Attempt], addresses: Mapping[str, str]) -> Day:
    iso = day.isoformat()
    if (night := nights.get(iso)) is None:
        return Day(iso, words=f"{iso}: no recalibration")
    state = state_of(night)
    which = f" (joint{'s' if len(night.drifted) > 1 else ''} {', '.join(night.drifted)})" if night.drifted else ""
    return Day(iso, state, f"{iso}: {STATES[state][1]}{which}", addresses.get(night.utc, ""))
