"""A quality gate's answer, and what the gates allow."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Gate:
    """One question and its answer; the reason is a sentence for a person, whether passed or not."""

    name: str
    passed: bool
    value: float
    limit: float
    reason: str

    @classmethod
    def about(cls, name: str, passed: bool, value: float, limit: float, said: str, cause: str) -> Gate:
        """The same, where only a failure needs a cause."""
        return cls(name, bool(passed), float(value), float(limit), said if passed else f"{said}: {cause}")

    @classmethod
    def at_most(cls, name: str, value: float, limit: float, said: str, cause: str) -> Gate:
        """The same, passed up to the limit."""
        return cls.about(name, value <= limit, value, limit, said, cause)


@dataclass(frozen=True, slots=True)
class GateLimits:
    """What the gates allow where it is a matter of the machine; ``config.robot.GatesFile`` says what each means.

    The gates that find wrong columns (delays, scales, torque that is cut off) have the same limits for every machine.
    """

    tracking_least: float = 0.95
    tracking_most: float = 1.3
    high_frequency_torque: float = 0.25
    samples_per_window: float = 8
    late_cycles: float = 0.02
    direction_asymmetry: float = 0.3
    straightness: float = 0.1
    saturation: float = 0.005
    drift: float = 0.05
    link_resonance: float = 0.2
    other_stretches: float = 0.15


def beside_usual(given: Mapping[str, float], usual: object) -> str:
    """Each figure beside the usual one, which is the attribute of that name: ``drift 0.1 (usually 0.05)``."""
    return ", ".join(f"{name} {value:.3g} (usually {getattr(usual, name):.3g})" for name, value in given.items())
