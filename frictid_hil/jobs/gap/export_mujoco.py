"""An improved joint as files for MuJoCo: the model, and a script with the joint's own friction and drive."""

from __future__ import annotations

import math
import pprint
from pathlib import Path
from typing import Any

from frictid_hil.errors import UsageError
from frictid_hil.files import write_whole
from frictid_hil.simulation.joint import JointModel
from frictid_hil.simulation.mjcf import described

_SCRIPT = '''"""The joint of {model} for MuJoCo, written by frictid-hil; needs the packages mujoco and frictid-hil.

Joint parameters that MJCF has are in the model:
{native}
What it has not, the control callback adds:
{callback}
What is lost:
{lost}

Put the drive's torque demand into data.ctrl[0] (N m on the joint's side of the gear) and read the encoder by
joint.reading_rad(data) and the drive's torque by joint.torque_nm. Run as a script, the joint is held for a second.
"""

{imports}from pathlib import Path

import mujoco

from frictid_hil.simulation.joint import JointModel
from frictid_hil.simulation.mjcf import MujocoJoint

SIMULATED = {mapping}

JOINT = JointModel.from_mapping(
    SIMULATED, gear_ratio={gear_ratio!r}, rated_torque_nm={rated!r}, max_torque_nm={limit!r}
)


def simulation(position_rad: float = 0.0):
    """(model, data, joint, holding torque in N m), the joint at rest where its encoder reads ``position_rad``."""
    model = mujoco.MjModel.from_xml_path(str(Path(__file__).with_name({model!r})))
    data = mujoco.MjData(model)
    joint = MujocoJoint(JOINT)
    holding_nm = joint.install(mujoco, model, data, position_rad=position_rad)
    return model, data, joint, holding_nm


if __name__ == "__main__":
    model, data, joint, holding_nm = simulation()
    while data.time < 1.0:
        data.ctrl[0] = holding_nm
        mujoco.mj_step(model, data)
    print(f"{{data.time:.3f}} s, {{joint.reading_rad(data):.6f}} rad, {{joint.torque_nm:.3f}} N m")
'''


def export_mujoco(path: Path, name: str, model: JointModel) -> dict[str, Any]:
    """Write ``path`` (MJCF) and a script beside it; what went where, what is lost (``UsageError``: it ends in .py)."""
    script = path.with_suffix(".py")
    if script == path:
        raise UsageError("is the name of the callback's script", where=str(path), next_step="name the model FILE.xml")
    exported = described(model, name)
    write_whole(path, exported.xml)
    text = _SCRIPT.format(
        # Only a joint without a torque limit has a number that Python does not spell by itself.
        imports="from math import inf\n" if math.isinf(model.drive.torque_limit_nm) else "",
        model=path.name,
        native=_listed(f"{what}: {how}" for what, how in exported.native.items()),
        callback=_listed(f"{what}: {how}" for what, how in exported.callback.items()),
        lost=_listed(exported.lost),
        mapping=pprint.pformat(model.to_mapping(), width=110, sort_dicts=False),
        gear_ratio=model.gear_ratio,
        rated=model.drive.rated_torque_nm,
        limit=model.drive.torque_limit_nm,
    )
    write_whole(script, text)
    return {
        "model": str(path.resolve()),
        "callback_script": str(script.resolve()),
        "in_model": dict(exported.native),
        "in_callback": dict(exported.callback),
        "lost": list(exported.lost),
    }


def _listed(lines: Any) -> str:
    return "\n".join(f"- {line}" for line in lines)
