"""Improved joints for Newton, as USD text: a stage of their own, or an overlay on the stage that its user has.

USD counts angles in degrees. Newton's importer reads ``newton:armature``, ``newton:friction`` and ``newton:damping`` of
a joint and its position drive; its MuJoCo solver reads how stiff friction is, too.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from frictid_hil.errors import ConfigError, InputFileError, UsageError
from frictid_hil.friction.trajectory import Array
from frictid_hil.simulation.rigid_bodies import mujoco_library
from frictid_hil.simulation.robot_model import RobotModel

if TYPE_CHECKING:
    from frictid_hil.simulation.targets import Numbers

ROOT = "/robot"  # prim of the articulation in a stage of our own
_HEAD = '#usda 1.0\n(\n    doc = "{doc}"\n{more})\n'
_JOINT = re.compile(r'"(\w+)" \(\n\s+prepend apiSchemas = \["PhysicsDriveAPI:(\w+)", "NewtonJointAPI"\]([^}]*)}')
_UNITS = '    defaultPrim = "robot"\n    kilogramsPerUnit = 1\n    metersPerUnit = 1\n    upAxis = "Z"\n'


def overlay(stage: Path, prims: Mapping[str, tuple[str, bool]], joints: Mapping[str, Numbers]) -> str:
    """A layer over the user's stage: opinions on its joints (prims as ``joint_prims`` finds them), nothing else."""
    doc = "Joints identified by frictid-hil. Open this file instead of the one below it."
    below = f"    subLayers = [\n        @{stage.as_posix()}@\n    ]\n"
    told = {}
    for name, n in joints.items():
        path, slides = prims[name]
        *_, prim = parts = tuple(path.strip("/").split("/"))
        words = "".join(f"    {line}\n" for line in _joint_lines(n, slides=slides))
        told[parts] = f'over "{prim}"{_schema(slides)}\n{{\n{words}}}\n'
    return _HEAD.format(doc=doc, more=below) + "\n" + _overs(told)


def joint_prims(stage: Path, joints: Sequence[str]) -> dict[str, tuple[str, bool]]:
    """(path, slides) of the joints of a stage by name.

    ``ConfigError``: usd-core, which reads it, is missing. ``InputFileError``: the stage cannot be read. ``UsageError``:
    it has no joint of a name, or more than one.
    """
    try:
        from pxr import Tf, Usd
    except ImportError:
        raise ConfigError(
            "the package usd-core is missing, which reads a stage", next_step="pip install usd-core"
        ) from None
    try:
        opened = Usd.Stage.Open(str(stage))
    except Tf.ErrorException as error:
        raise InputFileError(f"USD cannot read it: {error}", where=str(stage)) from None
    kinds = {"PhysicsRevoluteJoint": False, "PhysicsPrismaticJoint": True}
    found: dict[str, list[tuple[str, bool]]] = {}
    for prim in opened.Traverse():
        if prim.GetTypeName() in kinds:
            found.setdefault(prim.GetName(), []).append((str(prim.GetPath()), kinds[prim.GetTypeName()]))
    prims = {}
    for name in joints:
        there = found.get(prim_name(name), [])
        if len(there) != 1:
            raise UsageError(
                f"{len(there)} joints are called {name}" if there else f"no joint is called {name}",
                where=str(stage),
                cause=f"it has {', '.join(sorted(found)) or 'no revolute or prismatic joint'}",
                next_step="rename the joints of your model or of your stage, so that each name stands once",
            )
        prims[name] = there[0]
    return prims


def stage(robot: RobotModel, joints: Mapping[str, Numbers]) -> str:
    """A whole stage: links with their masses, and joints; no shapes, as they are no part of what was identified.

    ``UsageError`` for a body of several joints, or of one that is neither hinge nor slide.
    """
    library, m = mujoco_library(), robot.compiled
    data = library.MjData(m)
    data.qpos[:] = 0.0
    library.mj_kinematics(m, data)
    fall = float(np.linalg.norm(m.opt.gravity))
    down = _vector(m.opt.gravity / fall if fall > 0.0 else [0.0, 0.0, -1.0])
    rate = round(1.0 / float(m.opt.timestep))
    doc = "Links and joints identified by frictid-hil; shapes are not in it."
    lines = [
        'def PhysicsScene "scene" (\n    prepend apiSchemas = ["NewtonSceneAPI"]\n)\n{\n'
        f"    vector3f physics:gravityDirection = {down}\n    float physics:gravityMagnitude = {fall:.9g}\n"
        f"    int newton:timeStepsPerSecond = {rate}\n}}\n",
        'def Xform "robot" (\n    prepend apiSchemas = ["PhysicsArticulationRootAPI"]\n)\n{',
    ]
    for body in range(1, m.nbody):
        lines += [_body(m, data, body), _joint(library, m, data, body, joints, robot)]
    return _HEAD.format(doc=doc, more=_UNITS) + "\n" + "\n".join(lines) + "}\n"


def joint_numbers(text: str) -> dict[str, dict[str, float]]:
    """What a text of this module says of its joints, in N m and rad: ``friction``, ``damping``, ``armature``."""
    found = {}
    for name, slides, block in _JOINT.findall(text):
        per = 1.0 if slides == "linear" else math.degrees(1.0)
        numbers = dict(re.findall(r"newton:(\w+) = (\S+)", block))
        if "friction" in numbers:
            told = {key: float(numbers[key]) for key in ("friction", "damping", "armature")}
            found[name] = told | {"damping": told["damping"] * per}
    return found


def _body(m: Any, data: Any, body: int) -> str:
    words = [
        f"float physics:mass = {m.body_mass[body]:.9g}",
        f"point3f physics:centerOfMass = {_vector(m.body_ipos[body])}",
        f"float3 physics:diagonalInertia = {_vector(m.body_inertia[body])}",
        f"quatf physics:principalAxes = {_vector(m.body_iquat[body])}",
        f"double3 xformOp:translate = {_vector(data.xpos[body])}",
        f"quatd xformOp:orient = {_vector(data.xquat[body])}",
        'uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:orient"]',
    ]
    schemas = '(\n    prepend apiSchemas = ["PhysicsRigidBodyAPI", "PhysicsMassAPI"]\n)'
    inside = "".join(f"    {word}\n" for word in words)
    return _indented(f'def Xform "{_link(m, body)}" {schemas}\n{{\n{inside}}}\n')


def _joint(library: Any, m: Any, data: Any, body: int, joints: Mapping[str, Numbers], robot: RobotModel) -> str:
    """The joint between a body and its parent; a fixed one where it has none."""
    count, first = int(m.body_jntnum[body]), int(m.body_jntadr[body])
    name = m.joint(first).name if count else f"{_link(m, body)}_fixed"
    if count > 1 or (count and name not in robot.joints):
        raise UsageError(
            f"body {m.body(body).name!r} has {count} joints, or one that is neither hinge nor slide",
            where=str(robot.path),
            next_step="give the stage that you have with --stage, so that nothing but its joints is told",
        )
    axis, at = (m.jnt_axis[first], m.jnt_pos[first]) if count else (np.array([1.0, 0.0, 0.0]), np.zeros(3))
    turn, local, where = np.empty(4), np.empty(4), np.empty(3)
    library.mju_quatZ2Vec(turn, np.asarray(axis))
    parent = int(m.body_parentid[body])
    back = np.empty(4)
    library.mju_negQuat(back, data.xquat[parent])
    library.mju_mulQuat(local, back, data.xquat[body])
    library.mju_mulQuat(local, local.copy(), turn)
    library.mju_rotVecQuat(where, np.asarray(at), data.xquat[body])
    library.mju_rotVecQuat(where, data.xpos[body] + where - data.xpos[parent], back)
    below = f"    rel physics:body0 = <{ROOT}/{_link(m, parent)}>\n" if parent else ""
    frame = (
        f"{below}    rel physics:body1 = <{ROOT}/{_link(m, body)}>\n"
        f"    point3f physics:localPos0 = {_vector(where)}\n    quatf physics:localRot0 = {_vector(local)}\n"
        f"    point3f physics:localPos1 = {_vector(at)}\n    quatf physics:localRot1 = {_vector(turn)}\n"
    )
    if not count:
        return _indented(f'def PhysicsFixedJoint "{name}"\n{{\n{frame}}}\n')
    slides = robot.joint(name).prismatic
    kind = "PhysicsPrismaticJoint" if slides else "PhysicsRevoluteJoint"
    reach = robot.joint(name).range_rad
    limits = ""
    if reach is not None:
        low, high = reach if slides else np.degrees(reach)
        limits = f"    float physics:lowerLimit = {low:.9g}\n    float physics:upperLimit = {high:.9g}\n"
    lines = _joint_lines(joints[name], slides=slides) if name in joints else []
    head = f'def {kind} "{prim_name(name)}"{_schema(slides) if lines else ""}'
    own = "".join(f"    {line}\n" for line in lines)
    return _indented(f'{head}\n{{\n{frame}    uniform token physics:axis = "Z"\n{limits}{own}}}\n')


def _joint_lines(n: Numbers, *, slides: bool) -> list[str]:
    """Attributes of a joint, as Newton and its MuJoCo solver read them."""
    per = 1.0 if slides else math.radians(1.0)
    drive = "drive:linear" if slides else "drive:angular"
    lines = [
        f"float newton:armature = {n.armature_kg_m2:.9g}",
        f"float newton:friction = {n.straight[0]:.9g}",
        f"float newton:damping = {n.straight[1] * per:.9g}",
        "uniform double[] mjc:solimpfriction = [0.9999, 0.9999, 0.001, 0.5, 2]",
        "uniform double[] mjc:solreffriction = [0.004, 1]",
        f"float {drive}:physics:stiffness = {n.kp_nm_per_rad * per:.9g}",
        f"float {drive}:physics:damping = {n.kv_nm_s_per_rad * per:.9g}",
    ]
    if math.isfinite(n.torque_limit_nm):
        lines.append(f"float {drive}:physics:maxForce = {n.torque_limit_nm:.9g}")
    return lines


def _overs(told: Mapping[tuple[str, ...], str]) -> str:
    """Nested ``over`` prims by path; each parent stands once, as USD asks."""
    text = ""
    for name in dict.fromkeys(path[0] for path in told):
        below = {path[1:]: words for path, words in told.items() if path[0] == name}
        text += below.get((), "") or f'over "{name}"\n{{\n{_indented(_overs(below))}}}\n'
    return text


def _schema(slides: bool) -> str:
    return f' (\n    prepend apiSchemas = ["PhysicsDriveAPI:{"linear" if slides else "angular"}", "NewtonJointAPI"]\n)'


def _link(m: Any, body: int) -> str:
    return prim_name(m.body(body).name or f"link_{body}")


def prim_name(name: str) -> str:
    """A name as USD allows it: letters, digits and underscores, and no digit first."""
    plain = re.sub(r"\W", "_", name)
    return f"_{plain}" if plain[:1].isdigit() else plain


def _indented(text: str) -> str:
    return "".join(f"    {line}\n" for line in text.splitlines())


def _vector(values: Array | Sequence[float]) -> str:
    return "(" + ", ".join(f"{float(value):.9g}" for value in values) + ")"
