"""Does a profile still describe this joint? A slow sine in position control tells, before the profile compensates.

Friction is half the difference of the torques of both directions, gravity half their sum; both are compared with what
the profile says at the very positions and speeds of the samples. Another joint's profile, a doubled or a negated one,
a changed load or a cold gear show here, where the joint is still held by its position loop.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from frictid_hil.errors import ProfileMismatch, SafetyAbort
from frictid_hil.plan.control import Probe
from frictid_hil.protocol.driver import Feedback, SetPoint
from frictid_hil.runner.cycle import SetPointSource
from frictid_hil.units import format_torque

_MOVING_RAD_S = math.radians(4.0)


@dataclass
class ProbeWatch:
    """Passes a stream on and keeps what the joint reports while it moves."""

    source: SetPointSource
    probe: Probe
    joint: str
    _rows: list[tuple[float, float, float]] = field(default_factory=list)
    _temperature_c: float = math.nan

    def update(self, feedback: Feedback, set_point: SetPoint) -> bool:
        """Keep the report, then pass the next set-point on."""
        if feedback.age_cycles == 0 and abs(feedback.velocity_rad_s) > _MOVING_RAD_S:
            self._rows.append((feedback.position_rad, feedback.velocity_rad_s, feedback.torque_nm))
        self._temperature_c = feedback.temperature_c
        return self.source.update(feedback, set_point)

    def judge(self) -> None:
        """Compare it with the profile (``SafetyAbort``: no motion both ways; ``ProfileMismatch``: other friction)."""
        position, velocity, torque = (
            (np.array(column) for column in zip(*self._rows, strict=True)) if self._rows else (np.empty(0),) * 3
        )
        forward, backward = velocity > 0, velocity < 0
        if not (forward.any() and backward.any()):
            raise SafetyAbort("did not move both ways during the probe", where=f"joint {self.joint}")
        probe = self.probe
        gravity = np.array([probe.gravity.torque_nm(q) for q in position.tolist()])
        friction = probe.curve.torque(velocity)
        measured = torque - gravity
        found_nm = 0.5 * float(measured[forward].mean() - measured[backward].mean())
        said_nm = 0.5 * float(friction[forward].mean() - friction[backward].mean())
        if not abs(found_nm - said_nm) <= probe.tolerance * abs(said_nm):
            cause = "another joint's profile, a changed gear"
            raise self._mismatch("friction at slow motion", found_nm, said_nm, cause)
        off_nm = 0.5 * float((measured - friction)[forward].mean() + (measured - friction)[backward].mean())
        if not abs(off_nm) <= probe.tolerance * abs(said_nm):
            middle_nm = float(gravity.mean())
            raise self._mismatch("holding torque", middle_nm + off_nm, middle_nm, "a changed load or posture")
        if probe.temperature_c is not None and abs(self._temperature_c - probe.temperature_c) > (
            probe.temperature_tolerance_c
        ):
            raise ProfileMismatch(
                f"stands at {self._temperature_c:.1f} degC, its profile is of {probe.temperature_c:.1f} degC"
                f" (policy.max_temperature_difference_c = {probe.temperature_tolerance_c:g})",
                where=f"joint {self.joint}",
                next_step="warm the joint up, or calibrate it at this temperature; --force uses it all the same",
            )

    def _mismatch(self, quantity: str, found_nm: float, said_nm: float, cause: str) -> ProfileMismatch:
        return ProfileMismatch(
            f"{quantity} is {format_torque(found_nm)}, its profile says {format_torque(said_nm)} "
            f"(tolerance {100 * self.probe.tolerance:.0f} % of friction)",
            where=f"joint {self.joint}",
            cause=f"{cause}, or an edited profile",
            next_step="calibrate the joint again; --force compensates all the same, under the supervisor's bounds",
        )
