"""A rehearsal must show, before a joint moves fast, that friction opposes motion and that velocity fits position."""

from __future__ import annotations

import math
from dataclasses import InitVar, dataclass

from frictid_hil.errors import SafetyAbort
from frictid_hil.protocol.driver import Feedback, SetPoint
from frictid_hil.runner.cycle import SetPointSource
from frictid_hil.runner.unit_proof import Travelled

_MOVING_RAD_S = math.radians(2.0)


@dataclass
class SignWatch:
    """Passes a stream on and keeps the mean torque of both directions."""

    source: SetPointSource
    joint: str
    period_s: InitVar[float]  # of the set-points
    _least: float = math.inf
    _most: float = -math.inf

    def __post_init__(self, period_s: float) -> None:
        self._sum, self._count = [0.0, 0.0], [0, 0]
        self._travelled = Travelled(period_s)

    def update(self, feedback: Feedback, set_point: SetPoint) -> bool:
        """Count the report, then pass the next set-point on."""
        if abs(feedback.velocity_rad_s) > _MOVING_RAD_S and math.isfinite(feedback.torque_nm):
            backward = feedback.velocity_rad_s < 0
            self._sum[backward] += feedback.torque_nm
            self._count[backward] += 1
            self._least, self._most = min(self._least, feedback.torque_nm), max(self._most, feedback.torque_nm)
        before_rad = set_point.position_rad
        goes_on = self.source.update(feedback, set_point)
        self._travelled.add(feedback, (set_point.position_rad > before_rad) - (set_point.position_rad < before_rad))
        return goes_on

    def judge(self) -> None:
        """Judge the rehearsal, friction if it went both ways (``SafetyAbort``: torque helps, or figures disagree)."""
        self._travelled.judge(self.joint)
        if not all(self._count):
            return
        if self._least == self._most:
            raise SafetyAbort(
                f"the reported torque stood at {self._least:.3g} N m all the way, forward and back",
                where=f"joint {self.joint}",
                cause="the drive does not measure torque (6077), reports another object in its place, or its step is "
                "coarser than the friction",
                next_step="see in the drive's manual what it reports as torque, and `torque_source` in the robot file",
            )
        forward, backward = (total / count for total, count in zip(self._sum, self._count, strict=True))
        if forward <= backward:
            raise SafetyAbort(
                f"moving forward took {backward - forward:.3g} N m less torque than moving back; "
                "friction must oppose motion",
                where=f"joint {self.joint}",
                cause="the torque sign or the joint's direction is wrong, or the drive compensates friction itself",
                next_step="check `direction` in the robot file and the drive's own friction compensation",
            )
