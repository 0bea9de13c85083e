"""Every recalibration that was tried, however it ended: a line each in ``<store>/<robot>/recalibrations.jsonl``."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path

import filelock

from frictid_hil.errors import FrictidError
from frictid_hil.files import could_not_write
from frictid_hil.profiles.journal import append_line, journal_lines

_LOCK_TIMEOUT_S = 10.0


@dataclass(frozen=True, slots=True)
class Attempt:
    """How one recalibration ended.

    Attributes:
        utc: when it began.
        outcome: word of its JSON.
        exit_code: of the process.
        promoted: its profile became the active one.
        profile: id in the store; "" where nothing was identified.
        drift_percent: distance (15) from the reference by joint; None where there was none.
        drifted: joints beyond the policy's limit.
        reason: why it was promoted or not, in a sentence.
        next_step: for the person who reads it.
        run: folder; "" where none was kept.
    """

    utc: str
    outcome: str
    exit_code: int
    promoted: bool = False
    profile: str = ""
    drift_percent: Mapping[str, float | None] = field(default_factory=dict)
    drifted: tuple[str, ...] = ()
    reason: str = ""
    next_step: str = ""
    run: str = ""


def note_attempt(store_root: Path, robot: str, attempt: Attempt) -> None:
    """Add a line.

    Raises:
        FrictidError: the disk is full, there is no permission, or another process holds the journal for too long.
    """
    folder = store_root / robot
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with filelock.FileLock(folder / ".attempts.lock", timeout=_LOCK_TIMEOUT_S):
            append_line(folder / "recalibrations.jsonl", asdict(attempt))
    except filelock.Timeout:
        raise FrictidError("another process holds the journal of recalibrations", where=str(folder)) from None
    except OSError as error:
        raise could_not_write(folder, error) from error


def attempts(store_root: Path, robot: str) -> list[Attempt]:
    """All of them, oldest first."""
    found = []
    for line in journal_lines(store_root / robot / "recalibrations.jsonl"):
        try:
            found.append(Attempt(**{**line, "drifted": tuple(line.get("drifted", ()))}))
        except TypeError:
            continue  # written by another version
    return found
