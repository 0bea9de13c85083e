"""From a robot file to a plan: the motions of a calibration, and the peak torque that is expected of them."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace

import numpy as np

from frictid_hil.config import policy
from frictid_hil.config.robot import Robot
from frictid_hil.errors import UsageError
from frictid_hil.friction.gate import GateLimits, beside_usual
from frictid_hil.friction.trajectory import Procedure
from frictid_hil.jobs.identification.skew_stretch import shaking
from frictid_hil.plan.plan import (
    REHEARSAL,
    Corners,
    Cycles,
    Expected,
    Hold,
    JointPlan,
    Motion,
    Move,
    Plan,
    Shake,
    Sine,
    WarmUp,
    coupling_bound_nm,
    joint_plan,
)
from frictid_hil.plan.setup import JointSetup, RobotSetup
from frictid_hil.runner.care import Care

APPROACH_RAD_S = math.radians(20.0)  # speed of moves between the locked position and the start, and of the rehearsal

_LIMITS = ("position_min_rad", "position_max_rad", "max_velocity_rad_s", "max_torque_nm")
_REVERSAL_TRAVEL_RAD = 6e-3
_REVERSAL_SPEED_RAD_S = 4e-3


def calibration_motions(
    joint: JointSetup,
    procedure: Procedure,
    *,
    rehearse: bool,  # its travel was never seen slowly
    warm_up: policy.WarmUpPolicy | None = None,
    place: int | None = None,  # among the joints that move together
    measure_skew: bool = False,
) -> list[Motion]:
    """What one joint does in a calibration, from its locked position and back to it."""
    start, home = joint.start_position_rad, joint.locked_position_rad
    amplitude = procedure.amplitude_rad
    # An early cycle: the later it is run again, the better drift is seen.
    drift_speed = float(procedure.peak_velocities_rad_s[procedure.cycles // 4])
    motions: list[Motion] = [Move.within(home, start, APPROACH_RAD_S)] if home != start else []
    if rehearse:
        motions.append(Sine(start, amplitude, min(APPROACH_RAD_S, procedure.velocity_rad_s), name=REHEARSAL))
    longest_s = 0.0 if warm_up is None else warm_up.max_s if warm_up.fixed_s is None else warm_up.fixed_s
    if warm_up is not None and longest_s > 0.0:
        limit = warm_up.settled_percent_per_min if warm_up.fixed_s is None else None
        warming_speed = float(procedure.peak_velocities_rad_s[procedure.cycles // 2])
        motions.append(WarmUp(start, amplitude, warming_speed, longest_s, limit))
    motions += [
        Hold(start, 0.5),
        Cycles(start, procedure),
        Sine(start, amplitude, drift_speed, name="drift"),
        Hold(start, 0.3),
    ]
    if place is not None:
        motions += [Shake.beside(start, procedure, place), Hold(start, 0.2)]
    if measure_skew:
        motions += [*shaking(start, procedure), Hold(start, 0.2)]
    motions += [
        slow_reversal(start),
        Move.within(start, home, APPROACH_RAD_S, name="return"),
        Hold(home, 0.2),
    ]
    return motions


def rehearsal_note(joints: Sequence[str]) -> str:
    """The note in a plan about joints whose travel is new to this robot."""
    who = f"joint {joints[0]} proves its" if len(joints) == 1 else f"joints {', '.join(joints)} prove their"
    then = "rehearses" if len(joints) == 1 else "rehearse"
    return (
        f"first run of this travel on this robot: {who} units by "
        f"a few encoder steps and 0.5 deg, then {then} it slowly, torque watched"
    )


def care_notes(robot: Robot, setup: RobotSetup) -> list[str]:
    """Return notes on bounds of the supervisor that are not the usual ones, and on who set them; [] where all are."""
    return _set_by("bounds of care", setup.care, Care(), robot.file.care.model_fields_set)


def gate_notes(robot: Robot, setup: RobotSetup) -> list[str]:
    """Return notes on limits of quality gates that are not the usual ones, and on who set them; [] where all are."""
    return _set_by("limits of quality gates", setup.joints[0].gates, GateLimits(), robot.file.gates.model_fields_set)


def _set_by(called: str, given: Mapping[str, float], usual: object, stated: Collection[str]) -> list[str]:
    by_file = {name: value for name, value in given.items() if name in stated}
    by_driver = {name: value for name, value in given.items() if name not in stated}
    told = {"robot file": by_file, "driver": by_driver}
    return [f"{called} from the {who}: {beside_usual(some, usual)}" for who, some in told.items() if some]


def inherited_notes(robot: Robot, joints: Sequence[str]) -> list[str]:
    """Of a robot file that extends another: limits that it does not state itself, so that a person can doubt them."""
    by_origin: dict[tuple[str, tuple[str, ...]], list[str]] = {}
    for name in joints:
        for origin in {robot.document.place(("joints", name, key)).path for key in _LIMITS} - {robot.path}:
            keys = tuple(key for key in _LIMITS if robot.document.place(("joints", name, key)).path == origin)
            by_origin.setdefault((origin.name, keys), []).append(name)
    return [
        f"{', '.join(keys)} of joint {', '.join(names)} {'is' if len(keys) == 1 else 'are'} inherited from {origin}; "
        f"{robot.path.name} does not state {'it' if len(keys) == 1 else 'them'}"
        for (origin, keys), names in by_origin.items()
    ]


def slow_reversal(start_rad: float) -> Corners:
    """Two slow small triangles that load the gear's presliding one way, then the other."""
    leg_s = _REVERSAL_TRAVEL_RAD / _REVERSAL_SPEED_RAD_S
    there = start_rad + _REVERSAL_TRAVEL_RAD
    return Corners("reversal", tuple(k * leg_s for k in range(5)), (start_rad, there, start_rad, there, start_rad))


def calibration_plan(
    robot: Robot,
    setup: RobotSetup,
    procedures: Mapping[str, Procedure],
    expected: Mapping[str, Expected],
    *,
    rehearse: Sequence[str] = (),
    notes: Sequence[str] = (),
    warm_up: policy.WarmUpPolicy | None = None,
    together: bool = False,
    measure_skew: bool = False,
) -> Plan:
    """Joint by joint in the order of ``procedures``, or all at once (``UsageError``: these differ in timing)."""
    locked = {joint.name: joint.locked_position_rad for joint in setup.joints}
    if together:
        _refuse_different_timing(procedures)
        # One that has not been rehearsed makes all of them rehearse: their travels combined are new.
        rehearse = list(procedures) if rehearse else []
    motions = {
        name: calibration_motions(
            setup.joint(name),
            procedure,
            rehearse=name in rehearse,
            warm_up=warm_up,
            place=place if together and len(procedures) > 1 else None,
            measure_skew=measure_skew,
        )
        for place, (name, procedure) in enumerate(procedures.items())
    }
    if together:
        motions = _in_step(motions)
    joints: list[JointPlan] = []
    for name in procedures:
        others = {other: at for other, at in locked.items() if other != name and not (together and other in procedures)}
        coupling_nm = coupling_bound_nm(name, motions, expected) if together else 0.0
        joints.append(joint_plan(setup.joint(name), motions[name], others, expected.get(name), coupling_nm=coupling_nm))
    return Plan(robot.name, setup.cycle_hz, tuple(joints), tuple(notes), together=together)


def _refuse_different_timing(procedures: Mapping[str, Procedure]) -> None:
    """Refuse joints that would not reverse together, because their coupling would not cancel between the directions."""
    first, reference = next(iter(procedures.items()))
    for name, procedure in procedures.items():
        same = procedure.cycles == reference.cycles and procedure.shares == reference.shares
        if not (same and math.isclose(procedure.duration_s, reference.duration_s, rel_tol=1e-9)):
            raise UsageError(
                f"its {procedure.cycles} cycles take {procedure.duration_s:.3f} s, the {reference.cycles} of joint "
                f"{first} {reference.duration_s:.3f} s; joints that move together need identical timing",
                where=f"joint {name}",
                cause="the robot file gives this joint a procedure of its own",
                next_step="give all joints the same A / V and N, or calibrate this one by itself with --joint",
            )


def _in_step(motions: Mapping[str, Sequence[Motion]]) -> dict[str, list[Motion]]:
    """The same stretches for all, as long as for the one that needs longest; cycles have identical timing already."""
    moved_first = any(own[0].name == "move" for own in motions.values())
    lists = {name: list(own) for name, own in motions.items()}
    for own in lists.values():
        if moved_first and own[0].name != "move":  # it is locked where it starts
            here_rad = float(own[0].position_rad(np.zeros(1))[0])
            own.insert(0, Move(here_rad, here_rad, 0.0))
    longest_s = [max(motion.duration_s for motion in stretch) for stretch in zip(*lists.values(), strict=True)]
    return {
        name: [_lasting(motion, duration_s) for motion, duration_s in zip(own, longest_s, strict=True)]
        for name, own in lists.items()
    }


def _lasting(motion: Motion, duration_s: float) -> Motion:
    """Return the motion, slowed down so that it lasts as long as the others."""
    if isinstance(motion, Move):
        return replace(motion, duration_s=duration_s)
    if isinstance(motion, Sine) and motion.duration_s < duration_s:
        return replace(motion, peak_velocity_rad_s=motion.peak_velocity_rad_s * motion.duration_s / duration_s)
    return motion


def expected_of(robot: Robot) -> dict[str, Expected]:
    """What the robot file expects of its joints. Joints without an entry are left out."""
    told = {name: joint.expected for name, joint in robot.file.joints.items()}
    return {name: Expected(**values.model_dump()) for name, values in told.items() if values is not None}


def given_procedure(
    amplitude_rad: float | None, velocity_rad_s: float | None, cycles: int | None, ratio: float | None
) -> Procedure | None:
    """The procedure of a recording without marks, as typed; None without (``UsageError``: not all, or impossible)."""
    if amplitude_rad is not None and velocity_rad_s is not None:
        try:
            return Procedure(amplitude_rad, velocity_rad_s, cycles or 10, ratio or 0.8)
        except ValueError as error:
            raise UsageError(str(error)) from None
    if any(value is not None for value in (amplitude_rad, velocity_rad_s, cycles, ratio)):
        raise UsageError(
            "--amplitude and --velocity belong together, and --cycles and --ratio to them",
            next_step="give the procedure as it was commanded, or leave all four out",
        )
    return None
