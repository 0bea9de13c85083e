"""From a robot file to a plan: which motions a calibration makes, and what peak torque is to be expected of them."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from frictid_hil.config import policy
from frictid_hil.config.robot import Robot
from frictid_hil.driver import JointSetup, RobotSetup
from frictid_hil.errors import UsageError
from frictid_hil.friction.trajectory import Procedure
from frictid_hil.plan import Corners, Cycles, Expected, Hold, JointPlan, Motion, Move, Plan, Sine, WarmUp, joint_plan

APPROACH_RAD_S = math.radians(20.0)
"""Speed of moves between the locked position and the start, and of the rehearsal."""

_REVERSAL_TRAVEL_RAD = 6e-3
_REVERSAL_SPEED_RAD_S = 4e-3


def calibration_motions(
    joint: JointSetup, procedure: Procedure, *, rehearse: bool, warm_up: policy.WarmUp | None = None
) -> list[Motion]:
    """What one joint does in a calibration, from its locked position and back to it."""
    start, home = joint.start_position_rad, joint.locked_position_rad
    amplitude = procedure.amplitude_rad
    # An early cycle: the later it is run again, the better drift is seen.
    drift_speed = float(procedure.peak_velocities_rad_s[procedure.cycles // 4])
    motions: list[Motion] = [Move.within(home, start, APPROACH_RAD_S)] if home != start else []
    if rehearse:
        motions.append(Sine(start, amplitude, min(APPROACH_RAD_S, procedure.velocity_rad_s), name="rehearsal"))
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
        slow_reversal(start),
        Move.within(start, home, APPROACH_RAD_S, name="return"),
        Hold(home, 0.2),
    ]
    return motions


def slow_reversal(start_rad: float, *, repeats: int = 2) -> Corners:
    """Slow small triangles that load the gear's presliding one way, then the other."""
    leg_s = _REVERSAL_TRAVEL_RAD / _REVERSAL_SPEED_RAD_S
    corners = [start_rad + (_REVERSAL_TRAVEL_RAD if k % 2 else 0.0) for k in range(2 * repeats + 1)]
    return Corners("reversal", tuple(k * leg_s for k in range(2 * repeats + 1)), tuple(corners))


def calibration_plan(
    robot: Robot,
    setup: RobotSetup,
    procedures: Mapping[str, Procedure],
    expected: Mapping[str, Expected],
    *,
    rehearse: Sequence[str] = (),
    notes: Sequence[str] = (),
    warm_up: policy.WarmUp | None = None,
) -> Plan:
    """The plan of a calibration, joint by joint in the order of ``procedures``."""
    locked = {joint.name: joint.locked_position_rad for joint in setup.joints}
    joints: list[JointPlan] = []
    for name, procedure in procedures.items():
        joint = setup.joint(name)
        motions = calibration_motions(joint, procedure, rehearse=name in rehearse, warm_up=warm_up)
        others = {other: at for other, at in locked.items() if other != name}
        joints.append(joint_plan(joint, motions, others, expected.get(name)))
    return Plan(robot.name, setup.cycle_hz, tuple(joints), tuple(notes))


def expected_of(robot: Robot) -> dict[str, Expected]:
    """What the robot file says is to be expected of its joints; joints it says nothing of are left out."""
    expected: dict[str, Expected] = {}
    for name, joint in robot.file.joints.items():
        if joint.expected is not None:
            values = joint.expected
            expected[name] = Expected(values.inertia_kg_m2, values.gravity_nm, values.friction_nm)
    return expected


def given_procedure(
    amplitude_rad: float | None, velocity_rad_s: float | None, cycles: int | None, ratio: float | None
) -> Procedure | None:
    """The procedure that a recording without marks was made with, as typed; None where nothing was.

    Raises:
        UsageError: some, but not amplitude and velocity, or values that make no procedure.
    """
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
