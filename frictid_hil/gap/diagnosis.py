"""The result of a diagnosis as a value, and its JSON form."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

from frictid_hil.simulation.joint import JointModel

SCHEMA = "frictid.gap_diagnosis/1"


@dataclass(frozen=True, slots=True)
class Value:
    """A fitted number with its 95 % interval; ends are None where no interval can be formed."""

    value: float
    low: float | None = None
    high: float | None = None

    def moved(self, more: float, wider: float) -> Value:
        """The number larger by ``more``; its interval, too, and wider by ``wider`` on both sides."""
        low = None if self.low is None else self.low + more - wider
        high = None if self.high is None else self.high + more + wider
        return Value(self.value + more, low, high)


@dataclass(frozen=True, slots=True)
class Cause:
    """One effect that explains a part of the gap."""

    effect: str  # name
    confidence: float  # calibrated chance that this effect shows, where it either shows or is absent, 0..1
    # By name with unit; empty for an alternative that was not taken.
    parameters: Mapping[str, Value] = field(default_factory=dict)
    confusable_with: tuple[str, ...] = ()  # effects that this recording can hardly tell from it
    gap_closed_percent: float | None = None  # its own part of what closing the gap achieved, or None


@dataclass(frozen=True, slots=True)
class Where:
    """A part of the recordings and its share of the squared gap; the shares of a diagnosis add up to 1."""

    region: str
    share_of_gap: float
    description: str


@dataclass(frozen=True, slots=True)
class Figures:
    """RMS differences on validation logs; None where they cannot be formed."""

    inverse_nm: float | None = None
    forward_torque_nm: float | None = None
    forward_position_rad: float | None = None


@dataclass(frozen=True, slots=True)
class Raw:
    """The inverse gap before any filter, on validation logs, N m."""

    inverse_nm: float  # RMS of the residual
    noise_floor_nm: float  # what noise of torque and position leaves of it
    cutoff_hz: float  # of the low-pass behind which all other figures are formed


@dataclass(frozen=True, slots=True)
class NextExperiment:
    """What to record to decide between two causes."""

    description: str
    duration_s: float
    separates: tuple[str, ...]
    plan: Mapping[str, Any]


@dataclass(frozen=True, slots=True)
class Diagnosis:
    """Where the gap lies, what causes it, how far it closes."""

    name: str  # of the experiment set
    verdict: str  # ``none``, ``explained``, ``ambiguous`` or ``unknown``
    causes: tuple[Cause, ...]  # ranked, the likeliest first
    where: tuple[Where, ...]  # shares of the gap
    before: Figures  # gap of the nominal joint
    after: Figures  # gap with the causes added
    noise_floor: Figures  # what noise alone leaves
    # 95 % intervals of figures of ``after``, for another recording of the same motions, where they are formed.
    after_intervals: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    per_log: Mapping[str, Mapping[str, Figures]] = field(default_factory=dict)  # before and after by validation log
    next_experiment: NextExperiment | None = None  # where the verdict is ambiguous
    # Why a figure is None, or what could not be concluded, by subject.
    reasons: Mapping[str, str] = field(default_factory=dict)
    summary: str = ""  # one sentence
    # The joint with its causes and ``fitted_along`` added, where the closed loop can be simulated.
    model: JointModel | None = None
    # The joint with the likeliest causes added, whatever the verdict; for who asks for it all the same.
    candidate: JointModel | None = None
    # Errors of the belief within its tolerances that were fitted beside the causes, by effect; part of ``model``.
    fitted_along: Mapping[str, Mapping[str, Value]] = field(default_factory=dict)
    # By effect, change of the held-out squares when it alone is added, percent.
    held_out: Mapping[str, float] = field(default_factory=dict)
    raw: Raw | None = None  # the gap before any filter; None where it is not formed
    # Draws of the posterior, parameters by effect; empty where nothing was sampled.
    samples: tuple[Mapping[str, Mapping[str, float]], ...] = ()
    # Stiffness at the believed level that the recordings were compared with; None where no stiffness is believed.
    presliding_nm_per_rad: float | None = None

    def improved_model(self) -> JointModel | None:
        """The joint with the named causes and ``fitted_along`` added; None without a controller.

        Nothing is applied when the verdict is ``unknown`` or ``ambiguous``: it is the nominal joint.
        """
        return self.model

    def to_json(self) -> dict[str, Any]:
        """Plain values for ``gap diagnose --json``."""
        planned = self.next_experiment
        return {
            "schema": SCHEMA,
            "set": self.name,
            "verdict": self.verdict,
            "summary": self.summary,
            "causes": [
                {
                    "effect": c.effect,
                    "confidence": c.confidence,
                    "parameters": _numbers(c.parameters),
                    "confusable_with": list(c.confusable_with),
                    "gap_closed_percent": c.gap_closed_percent,
                }
                for c in self.causes
            ],
            "fitted_along": {effect: _numbers(values) for effect, values in self.fitted_along.items()},
            "where": [asdict(place) for place in self.where],
            "gap": {
                "before": _figures(self.before),
                "after": _figures(self.after),
                "after_interval_95": {
                    name: list(self.after_intervals[name]) if name in self.after_intervals else None
                    for name in _figures(self.after)
                },
                "noise_floor": _figures(self.noise_floor),
                "raw": self.raw
                and {"inverse_nm": self.raw.inverse_nm, "noise_floor": {"inverse_nm": self.raw.noise_floor_nm}},
                "band": self.raw and {"low_hz": 0.0, "high_hz": self.raw.cutoff_hz},
                "per_log": {
                    log: {when: _figures(f) for when, f in figures.items()} for log, figures in self.per_log.items()
                },
            },
            "next_experiment": planned and {**asdict(planned), "separates": list(planned.separates)},
            "held_out_change_percent": dict(self.held_out),
            "reasons": dict(self.reasons),
        }


def _numbers(values: Mapping[str, Value]) -> dict[str, Any]:
    return {
        name: {"value": v.value, "interval_95": None if v.low is None else [v.low, v.high]}
        for name, v in values.items()
    }


def _figures(figures: Figures) -> dict[str, float | None]:
    return {name: value if value is None or math.isfinite(value) else None for name, value in asdict(figures).items()}
