"""What the scheduler tells whoever watches: plain values that cross process borders."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from frictid_hil.protocol.driver import Capabilities, Finding, JointIdentity
from frictid_hil.recording.samples import Mark


@dataclass(frozen=True, slots=True)
class Preflight:
    """The hardware was reached and read. Nothing has moved and nothing was written yet; no finding is an error."""

    identities: dict[str, JointIdentity]
    capabilities: Capabilities
    findings: tuple[Finding, ...]


@dataclass(frozen=True, slots=True)
class Configured:
    """The drives were configured for the first time in this run; the log of frames is decoded with their frame map."""

    frame_map: Mapping[str, Any]


@dataclass(frozen=True, slots=True)
class PhaseStarted:
    """A joint begins a stretch of its plan.

    Attributes:
        phase: ``configure``, ``enable``, ``move``, ``rehearsal``, ``hold``, ``cycles``, ``drift``, ``reversal``, ...
        duration_s: planned, 0 where not known.
    """

    joint: str
    phase: str
    duration_s: float


@dataclass(frozen=True, slots=True)
class JointRun:
    """A joint's motions are over and it is locked again.

    Attributes:
        session: number of the stretch of cyclic traffic; run time starts at zero in each.
        marks: what it did, on the run time of the samples.
        rate_hz: achieved cycle rate.
        late_cycles: began later than half a period.
        missed_cycles: deadlines without exchange.
        duration_s: run time of the whole session.
    """

    joint: str
    session: int
    marks: tuple[Mark, ...]
    rate_hz: float
    cycles: int
    late_cycles: int
    missed_cycles: int
    worst_lateness_s: float
    duration_s: float


@dataclass(frozen=True, slots=True)
class Marked:
    """A stretch of a joint's plan is over."""

    joint: str
    mark: Mark


@dataclass(frozen=True, slots=True)
class JobProgress:
    """How far a job on the controller, or the transfer of its recording, has come; about once a second.

    Attributes:
        stage: ``motion`` or ``transfer``.
        share: done, 0..1.
    """

    joint: str
    stage: str
    share: float


@dataclass(frozen=True, slots=True)
class Warned:
    """Something a person should know that does not end the run."""

    message: str


Event = Preflight | Configured | PhaseStarted | JobProgress | Marked | JointRun | Warned
