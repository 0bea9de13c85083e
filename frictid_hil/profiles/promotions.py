"""Promotions: which profile became active when, by whom and why; and recalibrations, however they ended."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field


@dataclass(frozen=True, slots=True)
class Promotion:
    """A file of ``promotions/``; they count in the order of their numbers.

    Attributes:
        action: ``promote``, ``rollback`` (to the one active before), ``baseline`` (pins what drift is measured from).
        id: the profile that is active, or the baseline, from here on.
        sha256: of its file.
        by: person or job.
    """

    action: str
    id: str
    sha256: str
    utc: str
    by: str = ""
    reason: str = ""


@dataclass(frozen=True, slots=True)
class Attempt:
    """A file of ``recalibrations/``: how one that began at ``utc`` ended; its reason says why it was promoted or not.

    Attributes:
        outcome: word of its JSON.
        profile: id in the store; "" where nothing was identified.
        drift_percent: distance (15) from the reference by joint; None where there was none.
        drift_limit_percent: of the distance from the baseline, by the policy; None where drift is measured otherwise.
        drifted: joints beyond the policy's limit.
        run: folder; "" where none was kept.
    """

    utc: str
    outcome: str
    exit_code: int
    promoted: bool = False
    profile: str = ""
    drift_percent: Mapping[str, float | None] = field(default_factory=dict)
    drift_limit_percent: float | None = None
    drifted: Sequence[str] = ()
    reason: str = ""
    next_step: str = ""
    run: str = ""


def active_stack(promotions: Sequence[Promotion]) -> list[Promotion]:
    """Those active one after the other, as far as they were not rolled back; the last is active."""
    stack: list[Promotion] = []
    for one in promotions:
        if one.action == "promote":
            stack.append(one)
        elif one.action == "rollback" and stack:
            stack.pop()
    return stack


def baseline_of(promotions: Sequence[Promotion]) -> str | None:
    """Id of the profile that drift is measured from: the pinned one, else the first ever promoted."""
    pinned = [one.id for one in promotions if one.action == "baseline"]
    return pinned[-1] if pinned else promotions[0].id if promotions else None
