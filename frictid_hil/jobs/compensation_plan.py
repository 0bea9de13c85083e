"""From a profile to the motions of a compensation: the probe, then each mode of the task.

``hand`` (section 5.1): a person guides the joint, the law gives gravity and friction. ``track`` (5.2): a triangle under
a PD so weak that friction alone costs 2 deg, the same in all modes. All figures come from profile and robot file.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from frictid_hil.config.policy import Policy
from frictid_hil.config.profile import Estimate, JointProfile
from frictid_hil.control import (
    Bounds,
    Compensated,
    ControlLaw,
    Gravity,
    PositionGains,
    Probe,
    RippleTorque,
    Swing,
)
from frictid_hil.driver import JointSetup, Mode, RobotSetup
from frictid_hil.errors import ProfileMismatch, UsageError
from frictid_hil.friction.compensation import (
    OUR_RATIO,
    PAPER_RATIO,
    PAPER_STIFFNESS_NM_PER_RAD,
    CompensationSettings,
    stiffness_with_margin,
)
from frictid_hil.jobs.plans import APPROACH_RAD_S, rehearsal_note
from frictid_hil.plan import REHEARSAL, Corners, Hold, JointPlan, Motion, Move, Plan, Sine, joint_plan
from frictid_hil.runner.rehearsals import Rehearsals

TASKS = ("hand", "track")
MODES = ("nc", "mo", "mol", "mop", "mop-reference")
SETTINGS = ("ours", "paper")

HAND_FREQUENCY_HZ = 0.5
HAND_AMPLITUDE_RAD = math.radians(20.0)
TRACK_SPEED_RAD_S = math.radians(30.0)
TRACK_AMPLITUDE_RAD = math.radians(10.0)

_HAND_SLACK_RAD = math.radians(8.0)
_TRACK_SLACK_RAD = math.radians(5.0)
_STAND_SLACK_RAD = math.radians(1.0)
_STAND_RAD_S = math.radians(5.0)
_SPEED_MARGIN, _SPEED_SLACK_RAD_S = 1.4, math.radians(10.0)
_SLEW_PER_COULOMB = 400.0
"""Torque may change by the Coulomb level in 2.5 ms: faster than any reversal, slower than a defect."""
_POWER_SHARE = 0.8
"""Of the product of the bounds of torque and speed."""
_STAND_S, _REST_S, _PAUSE_S = 0.5, 0.5, 0.3


@dataclass(frozen=True, slots=True)
class Wanted:
    """What a person asked for, defaults filled in.

    Attributes:
        task: ``hand`` or ``track``.
        modes: in order.
        setting: ``ours`` or ``paper``.
        ratio: R instead of the setting's.
        stiffness_nm_per_rad: K instead of the setting's.
        viscous_nm_s_per_rad: B_c instead of the least-squares one.
        speed_rad_s: of the triangle; of the hand at the middle of its travel.
        duration_s: of one mode; infinite until interrupted.
        centre_rad: middle of the travel; None for that of the calibrated travel.
        drive_mode: TORQUE, or POSITION or VELOCITY with the torque as offset.
        force: doubts only warn.
        simulated: the robot is simulated; the paper's K may then hunt.
    """

    task: str
    modes: tuple[str, ...]
    setting: str = "ours"
    ratio: float | None = None
    stiffness_nm_per_rad: float | None = None
    viscous_nm_s_per_rad: float | None = None
    speed_rad_s: float | None = None
    duration_s: float = 10.0
    centre_rad: float | None = None
    drive_mode: Mode = Mode.TORQUE
    force: bool = False
    simulated: bool = False

    @property
    def amplitude_rad(self) -> float:
        """To either side of the centre."""
        return HAND_AMPLITUDE_RAD if self.task == "hand" else TRACK_AMPLITUDE_RAD

    @property
    def peak_rad_s(self) -> float:
        """Highest speed of the task."""
        if self.speed_rad_s is not None:
            return self.speed_rad_s
        return 2 * math.pi * HAND_FREQUENCY_HZ * HAND_AMPLITUDE_RAD if self.task == "hand" else TRACK_SPEED_RAD_S

    @property
    def period_s(self) -> float:
        """Of one cycle of the task."""
        travel_rad = self.amplitude_rad * (2 * math.pi if self.task == "hand" else 4.0)
        return travel_rad / self.peak_rad_s

    @property
    def endless(self) -> bool:
        """Until interrupted."""
        return not math.isfinite(self.duration_s)

    @property
    def cycles(self) -> int:
        """Whole cycles within the duration, the first not counted into any figure."""
        return max(2, round(self.duration_s / self.period_s))


@dataclass(frozen=True, slots=True)
class CompensationPlan:
    """A plan and what it was made of.

    Attributes:
        plan: frozen.
        centre_rad: middle of the travel.
        laws: by mode.
        warnings: what speaks against it and is done all the same.
    """

    plan: Plan
    centre_rad: float
    laws: dict[str, ControlLaw]
    warnings: tuple[str, ...]


def compensation_plan(
    robot: str,
    setup: RobotSetup,
    name: str,
    entry: JointProfile,
    policy: Policy,
    wanted: Wanted,
    rehearsals: Rehearsals,
) -> CompensationPlan:
    """The plan of one joint; a travel that was never seen on this robot is rehearsed first.

    Raises:
        UsageError: options that contradict each other, or an unstable R or K.
        ProfileMismatch: the profile lacks a figure that this needs.
    """
    joint = setup.joint(name)
    _refuse_contradictions(wanted)
    centre_rad = wanted.centre_rad
    if centre_rad is None:
        travel_rad = entry.procedure.amplitude_rad if entry.procedure else 0.0
        centre_rad = joint.start_position_rad + travel_rad / 2
    warnings: list[str] = []
    laws = {mode: law_of(entry, joint, mode, wanted, warnings) for mode in wanted.modes}
    reach_rad = wanted.amplitude_rad
    rehearse = not rehearsals.covers(name, centre_rad - reach_rad, centre_rad + reach_rad)
    motions = _motions(joint, entry, policy, wanted, centre_rad, laws, hunts=bool(warnings), rehearse=rehearse)
    others = {other.name: other.locked_position_rad for other in setup.joints if other.name != name}
    moved: JointPlan = joint_plan(joint, motions, others, None)
    gravity = next(iter(laws.values())).gravity
    inertia = entry.inertia_kg_m2.value or 0.0
    peak_nm = gravity.largest_nm + float(entry.curve().magnitude(np.array(moved.peak_velocity_rad_s)))
    peak_nm += inertia * wanted.peak_rad_s * 2 * math.pi / wanted.period_s
    moved = replace(moved, predicted_torque_nm=peak_nm)
    notes = [f"friction compensation in modes {', '.join(wanted.modes)}, setting {wanted.setting}"]
    if rehearse:
        notes.append(rehearsal_note([name]))
    plan = Plan(robot, setup.cycle_hz, (moved,), (*notes, *warnings))
    return CompensationPlan(plan, centre_rad, laws, tuple(warnings))


def law_of(entry: JointProfile, joint: JointSetup, mode: str, wanted: Wanted, warnings: list[str]) -> ControlLaw:
    """The law of one mode.

    Raises:
        UsageError: an unstable R or K.
        ProfileMismatch: the profile lacks a figure that this needs.
    """
    where = f"joint {joint.name}"
    curve = entry.curve()
    gravity = Gravity(
        _needed(entry.gravity_cos_nm, "gravity", where),
        _needed(entry.gravity_sin_nm, "gravity", where),
        _needed(entry.bias_nm, "bias", where),
    )
    gains = None
    limit_nm = gravity.largest_nm + 1.2 * float(curve.magnitude(np.array(_speed_bound(wanted, joint))))
    if wanted.task == "track" and wanted.drive_mode is Mode.TORQUE:
        gains = PositionGains.low(curve.coulomb_nm, _needed(entry.inertia_kg_m2, "inertia", where))
        limit_nm += gains.stiffness_nm_per_rad * _TRACK_SLACK_RAD + gains.damping_nm_s_per_rad * 2 * wanted.peak_rad_s
    friction, ripple = None, None
    if mode != "nc":
        friction = friction_settings(entry, mode, wanted, where, warnings)
        if wanted.setting == "ours" and mode.startswith("mop") and entry.ripple is not None:
            ripple = RippleTorque(entry.ripple.period_rad, entry.ripple.torque_nm)
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
    """R, K and curve of one mode.

    Raises:
        UsageError: an unstable R or K.
        ProfileMismatch: no presliding stiffness was identified, and no K is given.
    """
    presliding = entry.presliding_stiffness_nm_per_rad.value
    ours = wanted.setting == "ours"
    ratio = wanted.ratio if wanted.ratio is not None else OUR_RATIO if ours else PAPER_RATIO
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


def _motions(
    joint: JointSetup,
    entry: JointProfile,
    policy: Policy,
    wanted: Wanted,
    centre_rad: float,
    laws: dict[str, ControlLaw],
    *,
    hunts: bool,
    rehearse: bool,
) -> list[Motion]:
    low_rad, home_rad = centre_rad - wanted.amplitude_rad, joint.locked_position_rad
    gravity = next(iter(laws.values())).gravity
    slowly = Sine(low_rad, 2 * wanted.amplitude_rad, min(APPROACH_RAD_S, wanted.peak_rad_s))
    motions: list[Motion] = [
        Move.within(home_rad, low_rad, APPROACH_RAD_S),
        *([replace(slowly, name=REHEARSAL)] if rehearse else []),
        Hold(low_rad, _PAUSE_S),
        Probe(
            slowly,
            entry.curve(),
            gravity,
            tolerance=policy.refuse_percent / 100.0,
            temperature_c=entry.temperature_c,
            temperature_tolerance_c=policy.max_temperature_difference_c,
            enforced=not wanted.force,
        ),
        Move.within(low_rad, centre_rad, APPROACH_RAD_S),
        Hold(centre_rad, _PAUSE_S),
    ]
    for mode, law in laws.items():
        motions += _task(joint, wanted, centre_rad, mode, law, hunts)
        motions.append(Hold(centre_rad, _PAUSE_S))
    return [*motions, Move.within(centre_rad, home_rad, APPROACH_RAD_S, name="return"), Hold(home_rad, 0.2)]


def _task(
    joint: JointSetup, wanted: Wanted, centre_rad: float, mode: str, law: ControlLaw, hunts: bool
) -> list[Motion]:
    bounds = _bounds(joint, wanted, centre_rad, law)
    drive_mode = wanted.drive_mode
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
    return [hand] if hunts and law.friction is not None else [stand, hand, rest]


def triangle(centre_rad: float, amplitude_rad: float, speed_rad_s: float, cycles: int) -> Corners:
    """A saw-tooth of constant speed, from the centre and back to it."""
    period_s = 4.0 * amplitude_rad / speed_rad_s
    times, positions = [0.0], [centre_rad]
    for k in range(cycles):
        times += [(k + 0.25) * period_s, (k + 0.75) * period_s]
        positions += [centre_rad + amplitude_rad, centre_rad - amplitude_rad]
    return Corners("triangle", (*times, cycles * period_s), (*positions, centre_rad))


def _bounds(joint: JointSetup, wanted: Wanted, centre_rad: float, law: ControlLaw) -> Bounds:
    slack = _HAND_SLACK_RAD if wanted.task == "hand" else _TRACK_SLACK_RAD
    reach = wanted.amplitude_rad + slack
    low, high = centre_rad - reach, centre_rad + reach
    if wanted.endless:
        low, high = -math.inf, math.inf
    speed = _speed_bound(wanted, joint)
    # With the torque as an offset, the drive's own loop adds what it needs.
    torque_nm = law.torque_limit_nm if wanted.drive_mode is Mode.TORQUE else joint.max_torque_nm
    return Bounds(
        position_min_rad=max(low, joint.position_min_rad + _STAND_SLACK_RAD),
        position_max_rad=min(high, joint.position_max_rad - _STAND_SLACK_RAD),
        velocity_rad_s=speed,
        power_w=_POWER_SHARE * speed * torque_nm,
        growth_s=math.inf if wanted.task == "track" else max(0.75, 0.375 * wanted.period_s),
    )


def _speed_bound(wanted: Wanted, joint: JointSetup) -> float:
    return min(joint.max_velocity_rad_s, _SPEED_MARGIN * wanted.peak_rad_s + _SPEED_SLACK_RAD_S)


def _refuse_contradictions(wanted: Wanted) -> None:
    for value, known, what in (
        (wanted.task, TASKS, "task"),
        (wanted.setting, SETTINGS, "setting"),
        *((mode, MODES, "mode") for mode in wanted.modes),
    ):
        if value not in known:
            raise UsageError(f"no {what} {value!r}; there are {', '.join(known)}")
    if len(set(wanted.modes)) != len(wanted.modes) or not wanted.modes:
        raise UsageError("name each mode once")
    if wanted.task == "hand":
        if "mop-reference" in wanted.modes:
            raise UsageError(
                "mop-reference needs to know what the joint will do; a person's hand does not tell",
                next_step="use it with --task track",
            )
        if wanted.drive_mode is not Mode.TORQUE:
            raise UsageError("a joint under position or velocity control cannot be guided by hand")
    elif wanted.endless:
        raise UsageError("only --task hand runs until interrupted", next_step="give --duration, e.g. 10s")
    if wanted.endless and len(wanted.modes) != 1:
        raise UsageError(
            "until interrupted, one mode runs; several were asked for", next_step="add --mode mop, for instance"
        )
    if wanted.peak_rad_s <= 0:
        raise UsageError("the speed must be positive")


def _needed(figure: Estimate, what: str, where: str) -> float:
    if figure.value is None:
        raise ProfileMismatch(
            f"the profile has no {what}: {figure.reason}",
            where=where,
            next_step="identify its run again, or calibrate the joint with its whole procedure, slow reversal included",
        )
    return figure.value
