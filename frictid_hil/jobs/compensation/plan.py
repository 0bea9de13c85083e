"""From a profile to the motions of a compensation: rehearsal, probe, then each mode with its law and bounds.

``hand`` (section 5.1): a person guides the joint, the law gives gravity and friction. ``track`` (5.2): a triangle under
a PD so weak that friction alone costs 2 deg, the same in all modes. All figures of a law come from profile and robot
file: gravity, the PD of the task, R, K and curve, and what the torque is clamped to.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from frictid_hil.config.policy import Policy
from frictid_hil.config.profile import Estimate, JointProfile
from frictid_hil.config.robot import Robot
from frictid_hil.errors import ProfileMismatch, UsageError
from frictid_hil.friction.compensation import (
    COARSE_RATIO,
    OUR_RATIO,
    PAPER_RATIO,
    PAPER_STIFFNESS_NM_PER_RAD,
    CompensationSettings,
    stiffness_with_margin,
)
from frictid_hil.friction.regression import BIAS_PRIOR
from frictid_hil.friction.rigid_body import COVERAGE
from frictid_hil.jobs.compensation.wanted import Wanted, refuse_contradictions
from frictid_hil.jobs.plans import APPROACH_RAD_S, care_notes, inherited_notes, rehearsal_note
from frictid_hil.plan.control import Bounds, Compensated, ControlLaw, Gravity, PositionGains, Probe, RippleTorque, Swing
from frictid_hil.plan.mode import Mode
from frictid_hil.plan.plan import REHEARSAL, Corners, Hold, JointPlan, Motion, Move, Plan, Sine, joint_plan
from frictid_hil.plan.setup import JointSetup, RobotSetup
from frictid_hil.runs.rehearsals import Rehearsals

TRACK_SLACK_RAD = math.radians(5.0)
"""A tracking joint may be this far from its travel; its PD is clamped to what that takes."""
_SPEED_MARGIN, _SPEED_SLACK_RAD_S = 1.4, math.radians(10.0)
_SLEW_PER_COULOMB = 400.0
"""Torque may change by the Coulomb level in 2.5 ms: faster than any reversal, slower than a defect."""


def law_of(entry: JointProfile, joint: JointSetup, mode: str, wanted: Wanted, warnings: list[str]) -> ControlLaw:
    """The law of one mode (``UsageError``: an unstable R or K; ``ProfileMismatch``: the profile lacks a figure)."""
    where = f"joint {joint.name}"
    curve = entry.curve()
    gravity = Gravity(
        _needed(entry.gravity_cos_nm, "gravity", where),
        _needed(entry.gravity_sin_nm, "gravity", where),
        _needed(entry.bias_nm, "bias", where),
        calibrated_centre_rad(entry, joint),
        _calibrated_travel_rad(entry) / math.sqrt(8.0),
        _unsure_nm(entry.bias_nm, curve.coulomb_nm) if wanted.setting == "ours" else 0.0,
    )
    gains = None
    limit_nm = gravity.largest_nm + 1.2 * float(curve.magnitude(np.array(speed_bound_rad_s(wanted, joint))))
    if wanted.task == "track" and wanted.drive_mode is Mode.TORQUE:
        gains = PositionGains.low(curve.coulomb_nm, _needed(entry.inertia_kg_m2, "inertia", where))
        limit_nm += gains.stiffness_nm_per_rad * TRACK_SLACK_RAD + gains.damping_nm_s_per_rad * 2 * wanted.peak_rad_s
    friction, ripple = None, None
    if mode != "nc":
        friction = friction_settings(entry, mode, wanted, where, warnings)
        if wanted.setting == "ours" and mode.startswith("mop") and entry.ripple is not None:
            ripple = RippleTorque(entry.ripple.period_rad, entry.ripple.table_nm())
    return ControlLaw(
        mode=mode,
        gravity=gravity,
        gains=gains,
        friction=friction,
        ripple=ripple,
        follows_reference=mode == "mop-reference",
        torque_limit_nm=min(limit_nm, joint.max_torque_nm),
        slew_nm_per_s=_SLEW_PER_COULOMB * curve.coulomb_nm,
    )


def friction_settings(
    entry: JointProfile, mode: str, wanted: Wanted, where: str, warnings: list[str]
) -> CompensationSettings:
    """R, K and curve of one mode (``UsageError``: unstable; ``ProfileMismatch``: no K, nor a stiffness)."""
    presliding = entry.presliding_stiffness_nm_per_rad.value
    ours = wanted.setting == "ours"
    # R of our setting is lower where the encoder hides presliding.
    usual = PAPER_RATIO if not ours else COARSE_RATIO if entry.presliding_yields == "unseen" else OUR_RATIO
    ratio = usual if wanted.ratio is None else wanted.ratio
    stiffness = wanted.stiffness_nm_per_rad
    if stiffness is None and not ours:
        stiffness = PAPER_STIFFNESS_NM_PER_RAD
    curve = entry.curve()
    if stiffness is None:
        found, level = entry.presliding_stiffness_nm_per_rad, entry.presliding_level_nm
        stiffness = stiffness_with_margin(
            found.low or _needed(found, "presliding stiffness", where),
            level.high or _needed(level, "presliding level", where),
            curve.coulomb_nm,
            ratio,
        )
    asymmetry = tuple(entry.quality.get("asymmetry_nm", ())) if ours else ()
    settings = CompensationSettings.of(
        curve,
        "mop" if mode == "mop-reference" else mode,
        stiffness_nm_per_rad=stiffness,
        ratio=ratio,
        asymmetry_nm=asymmetry if len(asymmetry) == len(curve.velocity_rad_s) else None,
        viscous_nm_s_per_rad=wanted.viscous_nm_s_per_rad,
        gradual=ours and entry.presliding_yields == "gradually",
    )
    published = not ours and wanted.ratio is None and wanted.stiffness_nm_per_rad is None
    try:
        settings.refuse_unstable(presliding, where=where)
    except UsageError as unstable:
        # The published figures are run as published on a simulated robot; a real one needs a person's --force.
        if not (published and (wanted.simulated or wanted.force)):
            raise
        sentence = f"the published setting may hunt: {unstable}"
        if sentence not in warnings:
            warnings.append(sentence)
    return settings


def calibrated_centre_rad(entry: JointProfile, joint: JointSetup) -> float:
    """Middle of the travel over which the profile was identified."""
    return joint.start_position_rad + _calibrated_travel_rad(entry) / 2


def speed_bound_rad_s(wanted: Wanted, joint: JointSetup) -> float:
    """Return the highest speed that the supervisor allows during the task."""
    return min(joint.max_velocity_rad_s, _SPEED_MARGIN * wanted.peak_rad_s + _SPEED_SLACK_RAD_S)


def _calibrated_travel_rad(entry: JointProfile) -> float:
    return entry.procedure.amplitude_rad if entry.procedure else 0.0


def _unsure_nm(bias: Estimate, coulomb_nm: float) -> float:
    """Half of the 95 % interval; where a profile has none, half of the interval that the identification starts from."""
    if bias.low is None or bias.high is None:
        return COVERAGE * BIAS_PRIOR * coulomb_nm
    return (bias.high - bias.low) / 2


def _needed(figure: Estimate, what: str, where: str) -> float:
    if figure.value is None:
        raise ProfileMismatch(
            f"the profile has no {what}: {figure.reason}",
            where=where,
            next_step="identify its run again, or calibrate the joint with its whole procedure, slow reversal included",
        )
    return figure.value


_HAND_SLACK_RAD = math.radians(8.0)
_STAND_SLACK_RAD = math.radians(1.0)
_STAND_RAD_S = math.radians(5.0)
_TOLD_SHARE = 0.999  # the plan says that R falls where it falls below this share of its full value
_WITHSTANDS_SHARE = 3.0
"""A joint stands from -F_0 to F_0; static friction may be half as large again. Of F_0, from end to end."""
_POWER_SHARE = 0.8  # of the product of the bounds of torque and speed
_STAND_S, _REST_S, _PAUSE_S = 0.5, 0.5, 0.3


@dataclass(frozen=True, slots=True)
class Asked:
    """A compensation of a joint, decided before a bus is opened: its plan, and the laws by mode that made it."""

    robot: Robot
    setup: RobotSetup
    joint: str
    profile: Path
    entry: JointProfile  # the joint's in the profile
    wanted: Wanted
    plan: Plan
    centre_rad: float
    laws: Mapping[str, ControlLaw]
    lowest_ratio: float | None  # R where gravity is known least, within the task's travel; None without compensation
    warnings: tuple[str, ...]  # what speaks against it and is done all the same


def compensation_plan(
    robot: Robot,
    setup: RobotSetup,
    name: str,
    profile: Path,
    entry: JointProfile,
    wanted: Wanted,
    rehearsals: Rehearsals,
    forced: Sequence[str],  # warnings of what is done in spite of doubts
) -> Asked:
    """The plan of one joint, a travel that is new to this robot rehearsed first; raises as ``law_of``."""
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
