"""The journal of promotions: which profile became active when, by whom and why; the last whole line rules."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from frictid_hil.profiles.journal import journal_lines


@dataclass(frozen=True, slots=True)
class Promotion:
    """A line of the journal.

    Attributes:
        action: ``promote``, ``rollback`` (to the one active before), ``baseline`` (pins what drift is measured from).
        id: the profile that is active, or the baseline, from here on.
        sha256: of its file.
        utc: when.
        by: person or job.
        reason: in words.
    """

    action: str
    id: str
    sha256: str
    utc: str
    by: str = ""
    reason: str = ""


def promotions_in(path: Path) -> list[Promotion]:
    """The lines of a journal, oldest first; nothing where there is none yet.

    Raises:
        FrictidError: it cannot be read.
    """
    return [Promotion(**line) for line in journal_lines(path) if line.keys() == Promotion.__dataclass_fields__.keys()]


def active_stack(journal: Sequence[Promotion]) -> list[Promotion]:
    """Those active one after the other, as far as they were not rolled back; the last is active."""
    stack: list[Promotion] = []
    for line in journal:
        if line.action == "promote":
            stack.append(line)
        elif line.action == "rollback" and stack:
            stack.pop()
    return stack


def baseline_of(journal: Sequence[Promotion]) -> str | None:
    """Id of the profile that drift is measured from: the pinned one, else the first ever promoted."""
    pinned = [line.id for line in journal if line.action == "baseline"]
    return pinned[-1] if pinned else journal[0].id if journal else None
