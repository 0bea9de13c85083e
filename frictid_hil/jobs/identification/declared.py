"""The timing of the columns as the drive of a recording declares it. It is never fitted."""

from __future__ import annotations

from collections.abc import Mapping

from frictid_hil.friction.recording import Skew
from frictid_hil.recording.samples import Samples

_KEYS = ("position_delay_s", "velocity_delay_s", "torque_delay_s", "torque_lag_s", "uncertainty_s")


def declared_skew(samples: Samples) -> Skew:
    """The delay of each column; the defaults where nothing is declared."""
    timing = samples.meta.get("timing")
    if not isinstance(timing, Mapping):
        return Skew()
    return Skew(**{key: float(timing[key]) for key in _KEYS if timing.get(key) is not None})
