"""The policy of a robot file: what counts as drift, what may be promoted, and what may move with nobody watching."""

from __future__ import annotations

from datetime import date
from typing import Literal

from pydantic import Field, field_validator, model_validator

from frictid_hil.config.schema import Strict


class WarmUpPolicy(Strict):
    """How a joint is brought to its working temperature before it is measured."""

    # one cycle is repeated until its friction changes by less than this
    settled_percent_per_min: float = Field(default=1.0, gt=0)
    max_s: float = Field(default=900.0, ge=0)  # give up waiting for that after this time, and say so
    fixed_s: float | None = Field(default=None, ge=0)  # warm up for exactly this long instead; 0 for not at all


class InterlockInput(Strict):
    """The digital input that says the robot's cell is closed and empty."""

    joint: str  # whose drive carries the input
    # of the drive's digital inputs (object 60FD), or the number of the controller's input
    bit: int = Field(ge=0, le=31)
    closed_when: Literal[0, 1] = 1  # level of that bit when the interlock is closed


class Unattended(Strict):
    """The permission to move a real robot with nobody asked."""

    allowed_by: str = Field(min_length=1)  # the person who takes the responsibility
    date: str  # when, YYYY-MM-DD
    interlock_input: InterlockInput  # must be closed before and during motion

    @field_validator("date")
    @classmethod
    def _is_a_day(cls, value: str) -> str:
        try:
            date.fromisoformat(value)
        except ValueError:
            raise ValueError(f"expected a date like 2026-11-21, found {value!r}") from None
        return value


class Policy(Strict):
    """Limits are distances (15) between curves in percent of the reference curve's mean."""

    # a joint further than this from the reference has drifted; reported, not refused
    drift_percent: float = Field(default=10.0, gt=0)
    # ``baseline`` (the first profile promoted, or the one pinned since) sees slow drift that night-by-night comparison
    # with the ``active`` profile would not
    drift_reference: Literal["baseline", "active"] = "baseline"
    # ``report`` leaves a night on which a joint drifted at exit code 0; ``alarm`` ends it with 6
    on_drift: Literal["report", "alarm"] = "report"
    # a joint further than this from the active profile is taken as broken: nothing is promoted
    refuse_percent: float = Field(default=30.0, gt=0)
    # ``automatic`` within these limits, or only ``by_person``
    promotion: Literal["automatic", "by_person"] = "automatic"
    max_age_days: float = Field(default=180.0, gt=0)  # an older profile is not used for compensation unless forced
    # nor one identified at a temperature further away than this
    max_temperature_difference_c: float = Field(default=20.0, gt=0)
    warm_up: WarmUpPolicy = WarmUpPolicy()  # before measuring
    unattended: Unattended | None = None  # absent, a real robot is moved only after a person said yes

    @property
    def drift_limit_percent(self) -> float | None:
        """Limit of the distance from the baseline; None where drift is measured from the active profile."""
        return self.drift_percent if self.drift_reference == "baseline" else None

    @model_validator(mode="after")
    def _drift_before_refusal(self) -> Policy:
        if self.refuse_percent <= self.drift_percent and self.drift_reference == "active":
            raise ValueError("refuse_percent must be above drift_percent, or no drift is ever reported")
        return self
