"""The user's model file with native elements put in: what to write, and whether anything else has changed.

A URDF gets the two numbers of friction and the effort limit that it can hold. What was edited is compiled and compared
with the original: names, bodies, and every number of other joints must be the same.
"""

from __future__ import annotations

import math
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from frictid_hil.errors import FrictidError
from frictid_hil.simulation.model_text import Element, ModelText
from frictid_hil.simulation.native import Native, words
from frictid_hil.simulation.robot_model import RobotModel

if TYPE_CHECKING:
    import mujoco

_ANGLES = ("ref", "springyield", "springref", "range")  # attributes of a hinge that are degrees where the file says so


def edited_files(robot: RobotModel, natives: Mapping[str, Native], out: Path) -> dict[Path, bytes]:
    """What to write so that ``out`` (which may be the user's own file) is the user's model with these joints, by path.

    A joint that does not stand in the file by its name is an ``InputFileError``.
    """
    text = ModelText(robot.path)
    degrees = not robot.urdf and _in_degrees(text)
    for name, native in natives.items():
        if robot.urdf:
            _edit_urdf(text, name, native)
        else:
            _edit_mjcf(text, robot, name, native, degrees=degrees and not robot.joint(name).prismatic)
    return text.written(out)


def compiled_with(robot: RobotModel, natives: Mapping[str, Native]) -> mujoco.MjModel:
    """MuJoCo's model of the edited file; ``FrictidError`` where it cannot be read, and nothing is written."""
    with tempfile.TemporaryDirectory(prefix="frictid-model-") as folder:
        out = Path(folder) / "model.xml"
        for path, content in edited_files(robot, natives, out).items():
            path.write_bytes(content)
        try:
            return RobotModel.load(out).compiled
        except FrictidError as error:
            raise FrictidError(
                f"the edited model cannot be read, so nothing is written: {error.what}",
                where=str(robot.path),
                next_step="give a model without the element that MuJoCo names, or use --write-model for one joint",
            ) from error


def changed_elsewhere(before: mujoco.MjModel, after: mujoco.MjModel, natives: Mapping[str, Native]) -> list[str]:
    """Numbers of other joints, bodies or actuators that are not what they were, by name; empty where all is well."""
    found = []
    for kind, tables in _TABLES.items():
        names = _names(before, kind)
        now = {name: k for k, name in enumerate(_names(after, kind))}
        for k, name in enumerate(names):
            if name not in now:
                found.append(f"{kind} {name} is gone")
                continue
            for table in tables:
                old, new = getattr(before, table, None), getattr(after, table, None)
                if old is None or new is None or _may_change(before, kind, k, table, natives):
                    continue
                if not np.allclose(
                    _row(before, kind, old, k), _row(after, kind, new, now[name]), rtol=1e-9, atol=1e-12
                ):
                    found.append(f"{table} of {name}")
    return found


_TABLES = {
    "body": ("body_mass", "body_inertia", "body_ipos", "body_iquat", "body_pos", "body_quat", "body_gravcomp"),
    "joint": ("jnt_type", "jnt_axis", "jnt_pos", "jnt_range", "jnt_limited", "jnt_stiffness", "jnt_actfrcrange",
              "dof_armature", "dof_damping", "dof_frictionloss"),
    "actuator": ("actuator_gainprm", "actuator_biasprm", "actuator_gear", "actuator_forcerange", "actuator_dynprm"),
    "geom": ("geom_size", "geom_pos", "geom_quat", "geom_friction"),
    "site": ("site_pos", "site_quat"),
}  # fmt: skip


def _may_change(model: Any, kind: str, k: int, table: str, natives: Mapping[str, Native]) -> bool:
    if kind == "joint":
        return model.joint(k).name in natives
    if kind == "body":
        own = {int(model.joint(name).bodyid[0]) for name, native in natives.items() if native.gravity_share is not None}
        return table in ("body_mass", "body_ipos") and k in own
    if kind == "actuator":
        return int(model.actuator_trnid[k][0]) in {int(model.joint(name).id) for name in natives}
    return False


def _names(model: Any, kind: str) -> list[str]:
    count = {"body": "nbody", "joint": "njnt", "geom": "ngeom", "site": "nsite"}
    n = len(model.actuator_trntype) if kind == "actuator" else int(getattr(model, count[kind]))
    read = getattr(model, kind)
    return [read(k).name or f"number {k}" for k in range(n)]


def _row(model: Any, kind: str, table: Any, k: int) -> Any:
    return table[int(model.jnt_dofadr[k]) if kind == "joint" and table.shape[0] == model.nv else k]


def _in_degrees(text: ModelText) -> bool:
    """MuJoCo's angles are degrees unless a compiler element says otherwise."""
    compilers = [e.attributes for file in text.files.values() for e in file.elements if e.tag == "compiler"]
    said = [attributes["angle"] for attributes in compilers if "angle" in attributes]
    return not said or said[-1] == "degree"


def _edit_mjcf(text: ModelText, robot: RobotModel, name: str, native: Native, *, degrees: bool) -> None:
    joint = text.joint(name)
    text.set(joint, {key: _turned(key, value, degrees) for key, value in native.joint.items()})
    if native.gravity_share is not None:
        _edit_inertial(text, robot, name, joint, 1.0 + native.gravity_share)
    if native.actuators:
        driving = [a for a in text.actuators(name) if a.attributes.get("input") != "none"]
        for element in driving[:1]:
            tag = "general" if element.tag == "motor" and "dyntype" in native.actuators else None
            text.set(element, _for_tag(element, native.actuators), tag=tag)
    for more in native.more_joints:
        axis = {key: joint.attributes[key] for key in ("type", "axis", "pos") if key in joint.attributes}
        same = "".join(f' {key}="{value}"' for key, value in axis.items())
        kept = ' armature="0" frictionloss="0"'
        kept += "" if "damping=" in more else ' damping="0"'
        kept += "" if "stiffness=" in more else ' stiffness="0"'
        text.add_after(joint, f'<joint name="{name}_play"{same}{kept} {_play(more, degrees)}/>')
    for section, elements in (("tendon", native.more_tendons), ("actuator", native.more_actuators)):
        if elements:
            _add(text, section, "\n".join(elements))


def _edit_inertial(text: ModelText, robot: RobotModel, name: str, joint: Element, factor: float) -> None:
    """Scale the gravity of the joint's body: mass by the factor squared, lever by its inverse, so that m r**2 stays."""
    m = robot.compiled
    number = robot.number(name)
    body, axis, anchor = int(m.jnt_bodyid[number]), m.jnt_axis[number], m.jnt_pos[number]
    lever = m.body_ipos[body] - anchor
    along = axis * float(axis @ lever)
    centre = anchor + along + (lever - along) / factor
    told = {"pos": words(centre), "mass": f"{m.body_mass[body] * factor**2:.9g}"}
    assert joint.parent is not None  # a joint stands in a body
    found = text.children(joint.parent, "inertial")
    if found:
        text.set(found[0], dict(told))
        return
    told |= {"quat": words(m.body_iquat[body]), "diaginertia": words(m.body_inertia[body])}
    text.add_inside(joint.parent, "<inertial" + "".join(f' {key}="{value}"' for key, value in told.items()) + "/>")


def _turned(key: str, value: str, degrees: bool) -> str:
    if not degrees or key not in _ANGLES:
        return value
    return " ".join(f"{math.degrees(float(word)):.9g}" for word in value.split())


def _play(attributes: str, degrees: bool) -> str:
    before, mark, after = attributes.partition('range="')
    if not mark:
        return attributes
    value, _, rest = after.partition('"')
    return f'{before}{mark}{_turned("range", value, degrees)}"{rest}'


def _for_tag(element: Element, attributes: Mapping[str, str]) -> dict[str, str | None]:
    """Attributes in the words of the actuator's tag; ``<general>`` has gains as tables."""
    out: dict[str, str | None] = dict(attributes)
    if element.tag == "general" and "kp" in out:
        kp, kv = out.pop("kp"), out.pop("kv")
        out |= {"gainprm": kp, "biasprm": f"0 -{kp} -{kv}"}
    if element.tag == "position" and "kv" in out:
        out["dampratio"] = None
    return out


def _add(text: ModelText, section: str, elements: str) -> None:
    found = text.section(section)
    if found is not None:
        text.add_inside(found, elements)
        return
    lines = "\n".join(f"  {line}" for line in elements.splitlines())
    text.add_inside(text.main.root, f"<{section}>\n{lines}\n</{section}>")


def _edit_urdf(text: ModelText, name: str, native: Native) -> None:
    """Damping, friction and effort: all that a URDF holds."""
    joint = text.joint(name)
    told: dict[str, dict[str, str]] = {}
    if "frictionloss" in native.joint:
        told["dynamics"] = {"damping": native.joint["damping"].split()[0], "friction": native.joint["frictionloss"]}
    if "forcerange" in native.actuators:
        told["limit"] = {"effort": native.actuators["forcerange"].split()[-1]}
    for tag, attributes in told.items():
        found = text.children(joint, tag)
        if found:
            text.set(found[0], dict(attributes))
        else:
            words = "".join(f' {key}="{value}"' for key, value in attributes.items())
            text.add_inside(joint, f"<{tag}{words}/>")
