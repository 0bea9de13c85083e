"""From a profile to the motions of a compensation: rehearsal, probe, then each mode of the task with its bounds.

``hand`` (section 5.1): a person guides the joint, the law gives gravity and friction. ``track`` (5.2): a triangle under
a PD so weak that friction alone costs 2 deg, the same in all modes.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from frictid_hil.config.policy import Policy
from frictid_hil.config.profile import JointProfile
from frictid_hil.config.robot import Robot
from frictid_hil.jobs.compensation.laws import TRACK_SLACK_RAD, calibrated_centre_rad, law_of, speed_bound_rad_s
from frictid_hil.jobs.compensation.wanted import Wanted, refuse_contradictions
from frictid_hil.jobs.plans import APPROACH_RAD_S, care_notes, inherited_notes, rehearsal_note
from frictid_hil.plan.control import Bounds, Compensated, ControlLaw, Probe, Swing
from frictid_hil.plan.mode import Mode
from frictid_hil.plan.plan import REHEARSAL, Corners, Hold, JointPlan, Motion, Move, Plan, Sine, joint_plan
from frictid_hil.plan.setup import JointSetup, RobotSetup
from frictid_hil.runs.rehearsals import Rehearsals

_HAND_SLACK_RAD = math.radians(8.0)
_STAND_SLACK_RAD = math.radians(1.0)
_STAND_RAD_S = math.radians(5.0)
_TOLD_SHARE = 0.999
"""The plan says that R falls where it falls below this share of its full value."""
_WITHSTANDS_SHARE = 3.0
"""A joint stands from -F_0 to F_0; static friction may be half as large again. Of F_0, from end to end."""
_POWER_SHARE = 0.8
"""Of the product of the bounds of torque and speed."""
_STAND_S, _REST_S, _PAUSE_S = 0.5, 0.5, 0.3


@dataclass(frozen=True, slots=True)
class Asked:
    """A compensation of a joint, decided before a bus is opened: its plan, and the laws by mode that it was made from.

    Attributes:
        entry: the joint's in the profile.
        lowest_ratio: R where gravity is known least, within the task's travel; None without compensation.
        warnings: what speaks against it and is done all the same.
    """

    robot: Robot
    setup: RobotSetup
    joint: str
    profile: Path
    entry: JointProfile
    wanted: Wanted
    plan: Plan
    centre_rad: float
    laws: Mapping[str, ControlLaw]
    lowest_ratio: float | None
    warnings: tuple[str, ...]


def compensation_plan(
    robot: Robot,
    setup: RobotSetup,
    name: str,
    profile: Path,
    entry: JointProfile,
    wanted: Wanted,
    rehearsals: Rehearsals,
    forced: Sequence[str],
) -> Asked:
    """The plan of one joint; a travel that was never seen on this robot is rehearsed first.

    ``forced`` are warnings of what is done in spite of doubts.

    Raises:
        UsageError: options that contradict each other, or an unstable R or K.
        ProfileMismatch: the profile lacks a figure that this needs.
    """
    joint = setup.joint(name)
    refuse_contradictions(wanted)
    centre_rad = calibrated_centre_rad(entry, joint) if wanted.centre_rad is None else wanted.centre_rad
    warnings: list[str] = []
    laws = {mode: law_of(entry, joint, mode, wanted, warnings) for mode in wanted.modes}
    task = _Task(joint, entry, wanted, centre_rad, laws, hunts=bool(warnings))
    reach_rad = wanted.amplitude_rad
    rehearse = not rehearsals.covers(name, centre_rad - reach_rad, centre_rad + reach_rad)
    others = {other.name: other.locked_position_rad for other in setup.joints if other.name != name}
    moved: JointPlan = joint_plan(joint, task.motions(robot.policy, rehearse=rehearse), others, None)
    inertia = entry.inertia_kg_m2.value or 0.0
    peak_nm = task.gravity.largest_nm + float(entry.curve().magnitude(np.array(moved.peak_velocity_rad_s)))
    peak_nm += inertia * wanted.peak_rad_s * 2 * math.pi / wanted.period_s
    moved = replace(moved, predicted_torque_nm=peak_nm)
    notes = [f"friction compensation in modes {', '.join(wanted.modes)}, setting {wanted.setting}"]
    if rehearse:
        notes.append(rehearsal_note([name]))
    ratio = max((law.friction.ratio for law in laws.values() if law.friction is not None), default=0.0)
    lowest_ratio = task.lowest_ratio()
    if lowest_ratio is not None and lowest_ratio < _TOLD_SHARE * ratio:
        falls = f"there R falls from {ratio:.3g} to {lowest_ratio:.3g}"
        notes.append(f"beyond the calibrated travel gravity is less certain: {falls}")
    notes += [*warnings, *inherited_notes(robot, [name]), *care_notes(robot, setup), *forced]
    plan = Plan(robot.name, setup.cycle_hz, (moved,), tuple(notes))
    told = (*warnings, *forced)
    return Asked(robot, setup, name, profile, entry, wanted, plan, centre_rad, laws, lowest_ratio, told)


class _Task:
    """The motions of one joint, under the laws of its modes; ``hunts`` where one of these hunts at standstill."""

    def __init__(
        self,
        joint: JointSetup,
        entry: JointProfile,
        wanted: Wanted,
        centre_rad: float,
        laws: Mapping[str, ControlLaw],
        *,
        hunts: bool,
    ) -> None:
        self._joint, self._entry, self._wanted = joint, entry, wanted
        self._centre_rad, self._laws, self._hunts = centre_rad, laws, hunts
        self.gravity = next(iter(laws.values())).gravity

    def lowest_ratio(self) -> float | None:
        """Over the travel of the whole task. A service may be guided anywhere."""
        reach_rad = self._wanted.amplitude_rad
        low, high = self._centre_rad - reach_rad, self._centre_rad + reach_rad
        if self._wanted.endless:
            low, high = self._joint.position_min_rad, self._joint.position_max_rad
        found = [
            law.friction.ratio * law.friction_share(position)
            for law in self._laws.values()
            if law.friction is not None
            for position in np.linspace(low, high, 41).tolist()
        ]
        return min(found, default=None)

    def motions(self, policy: Policy, *, rehearse: bool) -> list[Motion]:
        """Rehearsal, probe and modes, from the locked position and back."""
        wanted, centre_rad, home_rad = self._wanted, self._centre_rad, self._joint.locked_position_rad
        low_rad = centre_rad - wanted.amplitude_rad
        slowly = Sine(low_rad, 2 * wanted.amplitude_rad, min(APPROACH_RAD_S, wanted.peak_rad_s))
        motions: list[Motion] = [
            Move.within(home_rad, low_rad, APPROACH_RAD_S),
            *([replace(slowly, name=REHEARSAL)] if rehearse else []),
            Hold(low_rad, _PAUSE_S),
            Probe(
                slowly,
                self._entry.curve(),
                self.gravity,
                tolerance=policy.refuse_percent / 100.0,
                temperature_c=self._entry.temperature_c,
                temperature_tolerance_c=policy.max_temperature_difference_c,
                enforced=not wanted.force,
            ),
            Move.within(low_rad, centre_rad, APPROACH_RAD_S),
            Hold(centre_rad, _PAUSE_S),
        ]
        for mode, law in self._laws.items():
            motions += [*self._mode(mode, law), Hold(centre_rad, _PAUSE_S)]
        return [*motions, Move.within(centre_rad, home_rad, APPROACH_RAD_S, name="return"), Hold(home_rad, 0.2)]

    def _mode(self, mode: str, law: ControlLaw) -> list[Motion]:
        wanted, centre_rad, drive_mode = self._wanted, self._centre_rad, self._wanted.drive_mode
        bounds = self._bounds(law)
        if wanted.task == "track":
            path = triangle(centre_rad, wanted.amplitude_rad, wanted.peak_rad_s, wanted.cycles)
            return [Compensated(f"track {mode}", path, law, bounds, drive_mode)]
        standing = replace(
            bounds,
            position_min_rad=centre_rad - _STAND_SLACK_RAD,
            position_max_rad=centre_rad + _STAND_SLACK_RAD,
            velocity_rad_s=_STAND_RAD_S,
        )
        duration_s = math.inf if wanted.endless else wanted.cycles * wanted.period_s
        swing = Swing(centre_rad, wanted.amplitude_rad, 1.0 / wanted.period_s, duration_s)
        stand = Compensated(f"stand {mode}", Hold(centre_rad, _STAND_S), law, standing, drive_mode)
        hand = Compensated(f"hand {mode}", swing, law, bounds, drive_mode)
        rest = Compensated(f"rest {mode}", Hold(centre_rad, _REST_S), law, bounds, drive_mode)
        # A setting that hunts at standstill is only in force while the person moves the joint.
        return [hand] if self._hunts and law.friction is not None else [stand, hand, rest]

    def _bounds(self, law: ControlLaw) -> Bounds:
        wanted, joint = self._wanted, self._joint
        reach = wanted.amplitude_rad + (_HAND_SLACK_RAD if wanted.task == "hand" else TRACK_SLACK_RAD)
        low, high = self._centre_rad - reach, self._centre_rad + reach
        if wanted.endless:
            low, high = -math.inf, math.inf
        speed = speed_bound_rad_s(wanted, joint)
        # With the torque as an offset, the drive's own loop adds what it needs.
        torque_nm = law.torque_limit_nm if wanted.drive_mode is Mode.TORQUE else joint.max_torque_nm
        return Bounds(
            position_min_rad=max(low, joint.position_min_rad + _STAND_SLACK_RAD),
            position_max_rad=min(high, joint.position_max_rad - _STAND_SLACK_RAD),
            velocity_rad_s=speed,
            power_w=_POWER_SHARE * speed * torque_nm,
            growth_s=math.inf if wanted.task == "track" else max(0.75, 0.375 * wanted.period_s),
            withstands_nm=_WITHSTANDS_SHARE * self._entry.curve().coulomb_nm,
        )


def triangle(centre_rad: float, amplitude_rad: float, speed_rad_s: float, cycles: int) -> Corners:
    """A saw-tooth of constant speed, from the centre and back to it."""
    period_s = 4.0 * amplitude_rad / speed_rad_s
    times, positions = [0.0], [centre_rad]
    for k in range(cycles):
        times += [(k + 0.25) * period_s, (k + 0.75) * period_s]
        positions += [centre_rad + amplitude_rad, centre_rad - amplitude_rad]
    return Corners("triangle", (*times, cycles * period_s), (*positions, centre_rad))
