"""The virtual HP3J changed as a benchmark asks: elastic joints, more delay, fewer joints."""

from __future__ import annotations

from collections.abc import Sequence
from math import pi
from pathlib import Path
from typing import Any

from frictid_hil.config.robot import load_robot
from frictid_hil.config.write import dump

JOINTS = ("0", "1", "2", "3", "4", "5")


def variant(
    path: Path, *, joints: Sequence[str] = (), elastic_hz: float = 0.0, delay_cycles: int = 2, robot: str = "hp3j.yaml"
) -> Path:
    """Write a robot file.

    Args:
        path: to write.
        joints: to keep; all of them when empty.
        elastic_hz: at which the links resonate; 0 for rigid ones.
        delay_cycles: from a report to the torque that answers it. One is the bus's and one the joint's own; what is
            more, torque commands lose on the bus, while the drive's own position loop is as good as ever.
        robot: to begin with.
    """
    values: dict[str, Any] = load_robot(robot).values()
    if joints:
        values["joints"] = {name: values["joints"][name] for name in joints}
    for joint in values["joints"].values():
        simulated = joint["simulated"]
        if elastic_hz:
            link = simulated["inertia_kg_m2"] * (1.0 - simulated["motor_inertia_share"])
            stiffness = link * (2.0 * pi * elastic_hz) ** 2
            simulated["effects"]["joint_elasticity"] = {"compliance_rad_per_nm": 1.0 / stiffness, "relaxation_s": 3e-4}
    if delay_cycles > 2:
        late_s = (delay_cycles - 2) / values["cycle_hz"]
        late = {"kind": "delay", "frames": "rpdo2", "at_s": 0.0, "for_s": 1e6, "delay_s": late_s}
        values["options"] = {**values["options"], "faults": [{**late, "joint": name} for name in values["joints"]]}
    path.write_text(dump(values))
    return path
