"""The interlock: a digital input that says that the cell is closed and empty, read from the drive that it is wired to.

This check comes on top of the safety circuit of the robot and replaces no part of it.
"""

from __future__ import annotations

from dataclasses import dataclass

from frictid_hil.errors import SafetyAbort
from frictid_hil.protocol.driver import Feedback


@dataclass(frozen=True, slots=True)
class Interlock:
    """One bit of one drive's digital inputs."""

    joint: str  # whose drive reports it
    bit: int  # of 60FD
    closed_when: int = 1  # level of the bit when the cell is closed
    silence_s: float = 0.1  # oldest report that still counts

    def check(self, report: Feedback, cycle_hz: float) -> None:
        """Pass one report of that joint; ``SafetyAbort`` where it is open, or not reported."""
        where = f"interlock (joint {self.joint}, input bit {self.bit})"
        inputs = report.digital_inputs
        if inputs is None or report.digital_inputs_age_cycles > self.silence_s * cycle_hz:
            raise SafetyAbort(
                f"its input was not reported for {report.digital_inputs_age_cycles / cycle_hz:.3g} s",
                where=where,
                cause="the drive does not send its digital inputs (60FD), or frames are lost",
                next_step="run `frictid-hil check`; correct `policy.unattended.interlock_input` in the robot file",
            )
        if (inputs >> self.bit & 1) != self.closed_when:
            raise SafetyAbort(
                "the interlock is open; nothing may move with nobody watching",
                where=where,
                cause="a door or gate of the cell is open, or somebody is in it",
                next_step="close the cell and make sure that it is empty, then start again",
            )
