"""``frictid-hil new robot``: a commented robot file from a few answers, and from what the drives say of themselves."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from frictid_hil.config.robot import load_robot
from frictid_hil.errors import UsageError
from frictid_hil.files import refuse_overwriting, write_whole
from frictid_hil.plan.setup import JointSetup, RobotSetup
from frictid_hil.protocol.driver import kind_of, new_driver


@dataclass(frozen=True, slots=True)
class JointAnswers:
    """What a person says of one joint, joint side; gear and rated torque are None where the drive shall say."""

    name: str
    address: int  # node, axis or id, as the driver calls it
    travel_rad: tuple[float, float]  # lowest and highest position
    max_velocity_rad_s: float
    max_torque_nm: float
    gear_ratio: float | None = None  # motor revolutions per joint revolution
    rated_torque_nm: float | None = None


@dataclass(frozen=True, slots=True)
class NewRobot:
    """The file that was written, and by joint the figures in it that its drive gave."""

    path: Path
    read: Mapping[str, Mapping[str, float]]

    def to_json(self) -> dict[str, Any]:
        """The JSON of the verb."""
        return {
            "outcome": "ok",
            "robot_file": str(self.path.resolve()),
            "joints": {name: {"read": dict(figures)} for name, figures in self.read.items()},
        }


def new_robot(
    path: Path,
    *,
    driver: str,
    bus: str,
    joints: Sequence[JointAnswers],
    cycle_hz: float = 1000.0,
    read: bool = False,
    force: bool = False,
) -> NewRobot:
    """Write a robot file that loads, the robot named after it; nothing moves, and drives are only read, if ``read``.

    ``UsageError``: the file exists, or no drive gave a figure. ``ConfigError``: no robot. ``HardwareError``:
    unreachable.
    """
    refuse_overwriting([path], force=force)
    setup = RobotSetup(path.stem, bus, cycle_hz, tuple(_provisional(joint) for joint in joints))
    found = _read(driver, setup) if read else {joint.name: {} for joint in joints}
    text = _text(driver, setup, joints, found)
    draft = path.with_name(f".{path.name}.draft")
    try:
        write_whole(draft, text)
        load_robot(draft).to_setup()
    finally:
        draft.unlink(missing_ok=True)
    write_whole(path, text)
    return NewRobot(path, found)


def _read(driver: str, setup: RobotSetup) -> dict[str, dict[str, float]]:
    """Ask each drive for its gear ratio and its rated torque."""
    with closing(new_driver(driver, setup)) as drives:
        drives.open()
        identities = drives.identify()
    return {
        joint: {
            key: value
            for key in ("gear_ratio", "rated_torque_nm")
            if math.isfinite(value := getattr(identity, key)) and value > 0
        }
        for joint, identity in identities.items()
    }


def _provisional(joint: JointAnswers) -> JointSetup:
    low, high = joint.travel_rad
    middle = (low + high) / 2
    return JointSetup(
        name=joint.name,
        address=joint.address,
        gear_ratio=joint.gear_ratio or 1.0,
        direction=1,
        max_velocity_rad_s=joint.max_velocity_rad_s,
        max_torque_nm=joint.max_torque_nm,
        rated_torque_nm=joint.rated_torque_nm or joint.max_torque_nm,
        position_min_rad=low,
        position_max_rad=high,
        start_position_rad=middle,
        locked_position_rad=middle,
    )


def _text(
    driver: str, setup: RobotSetup, joints: Sequence[JointAnswers], found: Mapping[str, Mapping[str, float]]
) -> str:
    """The file: what was answered, what was read, and what is still to be looked at."""
    travel = min(high - low for low, high in (joint.travel_rad for joint in joints))
    amplitude = min(travel / 4, math.radians(20))
    speed = min(joint.max_velocity_rad_s for joint in joints)
    lines = [
        "# Written by `frictid-hil new robot`. Look at every line before the robot moves.",
        "schema: frictid.robot/1",
        f"name: {setup.name}",
        f"driver: {driver}",
        f"bus: {setup.bus}",
        f"cycle_hz: {setup.cycle_hz:g}",
        "procedure:",
        f"  amplitude_rad: {_degrees(amplitude)}   # travel of a cycle, peak-to-peak",
        f"  velocity_rad_s: {_degrees(0.5 * speed, '/s')}   # peak speed of the last cycle; half of the lowest limit",
        "  cycles: 10",
        "joints:",
    ]
    for joint in joints:
        lines += _joint(joint, driver, found[joint.name], amplitude)
        if kind_of(driver).addressed_by == "node":  # as the simulated drives are
            lines += _simulated(joint, amplitude, 0.5 * speed)
    return "\n".join(lines) + "\n"


def _joint(joint: JointAnswers, driver: str, found: Mapping[str, float], amplitude_rad: float) -> list[str]:
    low, high = joint.travel_rad
    middle = (low + high) / 2
    figures = []
    for key, answered in (("gear_ratio", joint.gear_ratio), ("rated_torque_nm", joint.rated_torque_nm)):
        value = answered if answered is not None else found.get(key)
        if value is None:
            raise UsageError(
                f"joint {joint.name}: no {key}, and the drive was not asked or did not say",
                next_step=f"`--{key.removesuffix('_nm').replace('_', '-')}`, or `--read` with the drives on",
            )
        source = "read from the drive" if answered is None else "as given"
        figures.append(f"    {key}: {value:.6g}   # {source}")
    return [
        f'  "{joint.name}":',
        f"    {kind_of(driver).addressed_by}: {joint.address}",
        *figures,
        f"    max_velocity_rad_s: {_degrees(joint.max_velocity_rad_s, '/s')}",
        f"    max_torque_nm: {joint.max_torque_nm:.6g}   # joint side",
        f"    position_min_rad: {_degrees(low)}",
        f"    position_max_rad: {_degrees(high)}",
        f"    start_position_rad: {_degrees(middle - amplitude_rad / 2)}   # the travel runs from here to here + A",
        f"    locked_position_rad: {_degrees(middle)}   # where it stands while others move",
        "    direction: 1   # -1 where the drive counts the other way",
        "    # A rough guess lets the plan predict the peak torque before the first run:",
        "    # expected: {inertia_kg_m2: 0.5, gravity_nm: 5.0, friction_nm: 5.0}",
    ]


def _simulated(joint: JointAnswers, amplitude_rad: float, velocity_rad_s: float) -> list[str]:
    """A joint that moves along the plan with a third of its highest torque, for trials without the robot."""
    share_nm = joint.max_torque_nm / 9
    inertia_kg_m2 = share_nm * amplitude_rad / (2 * velocity_rad_s**2)
    return [
        "    # Trials without the robot (`--bus virtual:NAME`) move this joint instead; its figures are made up:",
        "    simulated:",
        f"      inertia_kg_m2: {inertia_kg_m2:.3g}",
        f"      friction: {{coulomb_nm: {share_nm:.3g}, viscous_nm_s_per_rad: {share_nm / velocity_rad_s:.3g}}}",
    ]


def _degrees(value_rad: float, per: str = "") -> str:
    return f"{math.degrees(value_rad):.6g}deg{per}"
