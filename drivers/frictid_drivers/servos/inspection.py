"""What servos tell of themselves, and what can be said about them without moving or writing."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from frictid_drivers.servos.line import Line
from frictid_drivers.servos.settings import JointSettings
from frictid_hil.plan.control import Compensated
from frictid_hil.plan.mode import Mode
from frictid_hil.plan.plan import Plan
from frictid_hil.plan.setup import JointSetup
from frictid_hil.protocol.driver import Finding, Severity


@dataclass(frozen=True, slots=True)
class Told:
    """What a servo said when it was reached."""

    model: int  # number
    mode: int
    delay_s: float  # of its answers
    p_gain: int
    i_gain: int
    current_limit: int  # largest goal current, 0 where it takes none


def meet(line: Line, mine: JointSettings) -> Told:
    """Read it.

    Raises:
        HardwareError: the servo does not answer.
    """
    registers, model = mine.model.registers, mine.model

    def word(address: int, count: int) -> int:
        return int.from_bytes(line.ask(mine.id, address, count), "big" if model.big_endian else "little")

    return Told(
        model=word(registers.model, 2),
        mode=word(registers.mode, 1),
        delay_s=word(registers.return_delay, 1) * 2e-6,
        p_gain=word(*registers.p_gain),
        i_gain=word(*registers.i_gain),
        current_limit=word(registers.current_limit, 2) if registers.goal_current else 0,
    )


def torque_source(mine: JointSettings) -> str:
    """What its torque is."""
    model = mine.model
    if model.current_a:
        return f"present current x {model.torque_constant_nm_per_a:g} N m/A"
    return f"PWM duty x {model.stall_nm:g} N m at stall (holds back-EMF and supply voltage)"


def joint_findings(joint: JointSetup, mine: JointSettings, told: Told, plan: Plan | None) -> Iterator[Finding]:
    """About one servo."""
    for severity, *said in _findings(joint, mine, told, plan):
        yield Finding(severity, f"joint {joint.name}", *said)


_Said = tuple[Severity, str] | tuple[Severity, str, str]  # how bad, what, and what to do about it


def _findings(joint: JointSetup, mine: JointSettings, told: Told, plan: Plan | None) -> Iterator[_Said]:
    registers = mine.model.registers
    yield Severity.OK, f"{mine.name} answers"
    yield (
        Severity.WARNING,
        f"torque is {torque_source(mine)}: every torque of this joint shares a scale error of up to "
        f"{mine.model.uncertainty_percent:g} %, which no interval contains",
        "weigh it: hang a known mass on a lever and set `torque_constant_nm_per_a` or `stall_nm`",
    )
    if registers.goal_current and told.mode == registers.current_mode:
        yield (
            Severity.WARNING,
            f"operating mode is {told.mode} (current), as after a run that was cut off",
            "a run puts it back into position mode; gains other than the maker's have to be set again",
        )
    elif told.mode != registers.position_mode:
        yield Severity.ERROR, f"operating mode is {told.mode}", "set position mode with its tool"
    if registers.goal_current:
        most_nm = told.current_limit * mine.torque_nm_per_unit
        yield Severity.OK, f"takes currents up to its current limit, {most_nm:.3g} N m"
    if plan is None or not _shifts_goals(plan, joint.name):
        return
    if told.i_gain:
        yield (
            Severity.ERROR,
            f"its position loop has an integral part (I gain {told.i_gain}), which takes away what a moved goal adds",
            "set the I gain to 0 with its tool, and calibrate the joint again",
        )
    if not joint.loop_stiffness_nm_per_rad:
        yield (
            Severity.ERROR,
            "the stiffness of its position loop is not known, so that no torque can be given by moving its goal",
            "calibrate the joint at this P gain, which measures it; or state `loop_stiffness_nm_per_rad`",
        )


def _shifts_goals(plan: Plan, joint: str) -> bool:
    """The plan adds torque to position control, which a servo does by moving its goal."""
    return any(
        isinstance(motion, Compensated) and motion.drive_mode is Mode.POSITION
        for entry in plan.joints
        if entry.joint == joint
        for motion in entry.motions
    )
