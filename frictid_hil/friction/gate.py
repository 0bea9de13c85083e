"""A quality gate's answer."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Gate:
    """One question and its answer.

    Attributes:
        name: of the gate.
        passed: the answer.
        value: what was measured.
        limit: what was allowed.
        reason: a sentence for a person, whether passed or not.
    """

    name: str
    passed: bool
    value: float
    limit: float
    reason: str

    @classmethod
    def about(cls, name: str, passed: bool, value: float, limit: float, said: str, cause: str) -> Gate:
        """The same, where only a failure needs a cause."""
        return cls(name, bool(passed), float(value), float(limit), said if passed else f"{said}: {cause}")
