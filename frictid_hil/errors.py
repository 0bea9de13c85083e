"""Every error a user can meet: what went wrong, where, the likely cause, the next step.

Each branch of the tree carries the exit code of the command line and the ``outcome`` word of its JSON. ``recalibrate``
alone ends with 6, too: done, but a joint has drifted; only where ``policy.on_drift`` is ``alarm``.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import ClassVar


class FrictidError(Exception):
    """The run failed.

    Args:
        what: one sentence saying what went wrong, with the numbers.
        where: the object it happened to (``node 3, object 6041``; ``hp3j.yaml:8:14``; ``joint 1``).
        cause: the likely cause, when one is known.
        next_step: what the reader should do now; unless told, what its branch of the tree advises.
    """

    exit_code: ClassVar[int] = 1
    outcome: ClassVar[str] = "aborted"
    usual_next_step: ClassVar[str] = ""

    def __init__(self, what: str, *, where: str = "", cause: str = "", next_step: str = "") -> None:
        super().__init__(what)
        self.what = what
        self.where = where
        self.cause = cause
        self.next_step = next_step or self.usual_next_step

    def __str__(self) -> str:
        return f"{self.where}: {self.what}" if self.where else self.what

    def to_json(self) -> dict[str, str]:
        """The four sentences of the error."""
        return {"what": self.what, "where": self.where, "cause": self.cause, "next_step": self.next_step}

    def __reduce__(self) -> tuple[object, ...]:
        # Errors cross process borders (the cyclic loop is a process of its own).
        told = {"where": self.where, "cause": self.cause, "next_step": self.next_step}
        return (partial(type(self), self.what, **told), ())


class UsageError(FrictidError):
    """An argument, a unit, a combination of options that cannot work."""

    exit_code = 2
    outcome = "refused"


class ConfigError(UsageError):
    """A robot, profile or column-map file is wrong; ``where`` is file:line:column."""


class InputFileError(UsageError):
    """A recording or other input file is unreadable or unusable; ``where`` is the file, with a line where known."""


class PlanRefused(UsageError):
    """The plan breaks a limit of position, velocity, torque or bus load, or must not run so; nothing moved."""


class ProfileMismatch(UsageError):
    """A friction profile belongs to another robot, drive, gear ratio or schema."""


class IdentificationError(FrictidError):
    """A friction curve cannot be formed from these samples (empty window, F_0 <= 0, ...)."""


class HardwareError(FrictidError):
    """Hardware is unreachable, silent, or not what the robot file says."""

    exit_code = 3
    usual_next_step = "see that the robot is on and its cable in place; `frictid-hil check` tells what answers"


class HardwareBusy(HardwareError):
    """The bus or port is held by another process."""


class SafetyAbort(FrictidError):
    """Motion was stopped because a supervised quantity left its bounds."""

    exit_code = 4
    usual_next_step = "look at the joint before anything moves again; `frictid-hil check` reads its drive"


class GateFailed(FrictidError):
    """A quality gate failed; results are kept, nothing was promoted."""

    exit_code = 5
    outcome = "gate_failed"
    usual_next_step = "look at the joint and at the report; the recording is kept"


class Interrupted(FrictidError):
    """Ctrl-C, SIGTERM, or a vanished parent; the joint was brought to rest."""

    exit_code = 130
    outcome = "interrupted"
    usual_next_step = "start it again when it suits"


class Defect(FrictidError):
    """The program itself is wrong: something happened that nobody thought of."""

    usual_next_step = "report it with the traceback on standard error; what was measured until then is kept"

    @classmethod
    def of(cls, error: BaseException) -> Defect:
        """What happened, as one of our own."""
        return cls(f"defect of the program: {type(error).__name__}: {error}")


@dataclass(frozen=True, slots=True)
class FieldProblem:
    """One thing wrong with one field of a mapping; the loader adds file:line:column."""

    path: tuple[str | int, ...]  # from the root of the mapping, e.g. ``("joints", "1", "gear_ratio")``
    message: str  # what was expected and what was found


class InvalidFields(UsageError):
    """A mapping failed validation; ``problems`` lists every field that is wrong."""

    def __init__(self, problems: list[FieldProblem]) -> None:
        self.problems = problems
        super().__init__("; ".join(f"{'.'.join(map(str, p.path))}: {p.message}" for p in problems))

    def __reduce__(self) -> tuple[object, ...]:
        return (InvalidFields, (self.problems,))
