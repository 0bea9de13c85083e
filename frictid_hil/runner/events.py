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
    """A joint begins a stretch of its plan."""

    joint: str
    phase: str  # ``configure``, ``enable``, ``move``, ``rehearsal``, ``hold``, ``cycles``, ``drift``, ``reversal``, ...
    duration_s: float  # planned, 0 where not known


@dataclass(frozen=True, slots=True)
class JointRun:
    """A joint's motions are over and it is locked again."""

    joint: str
    session: int  # number of the stretch of cyclic traffic; run time starts at zero in each
    marks: tuple[Mark, ...]  # what it did, on the run time of the samples
    rate_hz: float  # achieved cycle rate
    cycles: int
    late_cycles: int  # began later than half a period
    missed_cycles: int  # deadlines without exchange
    worst_lateness_s: float
    duration_s: float  # run time of the whole session


@dataclass(frozen=True, slots=True)
class Marked:
    """A stretch of a joint's plan is over."""

    joint: str
    mark: Mark


@dataclass(frozen=True, slots=True)
class JobProgress:
    """How far a job on the controller, or the transfer of its recording, has come; about once a second."""

    joint: str
    stage: str  # ``motion`` or ``transfer``
    share: float  # done, 0..1


@dataclass(frozen=True, slots=True)
class Warned:
    """Something a person should know that does not end the run."""

    message: str


Event = Preflight | Configured | PhaseStarted | JobProgress | Marked | JointRun | Warned
