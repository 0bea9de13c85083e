"""How well the declared timing fits the data: a delay is never taken from them, but an interval may be.

The least-squares model with one more column, the torque's own rate, shows what delay the data would ask for. Effects
that the model lacks drag that figure by milliseconds, so that it corrects nothing. But where it lies near zero, a wrong
declaration can hardly hide: what the declaration leaves open then shrinks to the delay seen and its own uncertainty,
tripled, for what the model lacks drags the figure by about that (`benchmarks/interval_coverage.py`, ripple).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from frictid_hil.friction.least_squares import few_knots
from frictid_hil.friction.recording import CycleRecording, Motion
from frictid_hil.friction.regression import fit

DRAGGED = 3.0
"""Standard deviations by which effects outside the model may have moved the delay that is seen."""


@dataclass(frozen=True, slots=True)
class SeenDelay:
    """What the data would ask for beyond the declared delay of the torque.

    Attributes:
        delay_s: positive where torque is later than declared.
        deviation_s: one standard deviation.
    """

    delay_s: float
    deviation_s: float

    def open_s(self, declared_s: float) -> float:
        """One standard deviation of the skew that may remain; never more than the declared one."""
        return min(declared_s, math.hypot(self.delay_s, DRAGGED * self.deviation_s))


def seen_delay(recording: CycleRecording, motion: Motion, level_nm: float) -> SeenDelay:
    """The delay that would explain most.

    Raises:
        IdentificationError: as ``regression.fit``.
    """
    rate = np.gradient(motion.torque_nm, motion.smoother.step_s)[:, None]
    solved = fit(recording, motion, few_knots(recording), level_nm, width_rad=0.0, extra=rate)
    index = solved.blocks.extra.start
    return SeenDelay(-float(solved.values[index]), float(np.sqrt(solved.covariance[index, index])))
