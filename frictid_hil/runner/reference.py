"""Checks, before anything gets power, that every joint is where the plan expects it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from frictid_hil.errors import SafetyAbort
from frictid_hil.plan.setup import JointSetup
from frictid_hil.protocol.driver import Feedback
from frictid_hil.units import degrees, format_angle


def verify_reference(
    joints: Sequence[JointSetup], reports: Sequence[Feedback], planned_rad: Mapping[str, float], tolerance_rad: float
) -> None:
    """Compare every joint's position with the plan and with its limits.

    Args:
        joints: in the order of the reports.
        reports: valid.
        planned_rad: where joints are to be locked, by name; others are expected at their own locked position.
        tolerance_rad: a joint further off has lost its reference, or was moved.

    Raises:
        SafetyAbort: naming the joint.
    """
    for joint, report in zip(joints, reports, strict=True):
        expected_rad = planned_rad.get(joint.name, joint.locked_position_rad)
        if not abs(report.position_rad - expected_rad) <= tolerance_rad:
            raise SafetyAbort(
                f"stands at {degrees(report.position_rad):.2f} deg, expected {degrees(expected_rad):.2f} deg "
                f"(within {format_angle(tolerance_rad)})",
                where=f"joint {joint.name}",
                cause="the position reference is lost, or the arm was moved",
                next_step="home the robot or bring the joint to its locked_position_rad, then start again",
            )
        if not joint.position_min_rad <= report.position_rad <= joint.position_max_rad:
            raise SafetyAbort(
                f"stands at {degrees(report.position_rad):.2f} deg, outside its limits", where=f"joint {joint.name}"
            )
