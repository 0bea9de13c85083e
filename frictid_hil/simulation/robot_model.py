"""A robot as its user's own simulator has it: MJCF or URDF, read by MuJoCo itself.

It tells what the file believes of each joint, and what the rigid bodies ask of every joint along a motion of all of
them. Friction, damping and motors are no part of that torque: they are what a diagnosis is about.
"""

from __future__ import annotations

import copy
import itertools
import math
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any
from xml.etree import ElementTree

import numpy as np

from frictid_hil.errors import InputFileError, UsageError
from frictid_hil.friction.trajectory import Array
from frictid_hil.simulation.rigid_bodies import mujoco_library

if TYPE_CHECKING:
    import mujoco

THREADS = 2  # MuJoCo computes without Python's lock, so that two threads halve the time
_ROWS_PER_THREAD = 5000


@dataclass(frozen=True, slots=True)
class Motor:
    """The actuators of a joint, as one; every number on the joint's side of the gear."""

    names: tuple[str, ...]  # of the actuators
    law: str  # ``position`` (kp * (command - q) - kv * v), ``torque`` (the control is a force), or ``other``
    kp_nm_per_rad: float  # gain of a position law
    kv_nm_s_per_rad: float  # damping of a position law
    gear: float  # joint torque per actuator force
    torque_limit_nm: float  # of the drive; infinite where the file has none
    delay_s: float  # of the control
    lag_s: float  # time constant between control and force; 0 where there is none


@dataclass(frozen=True, slots=True)
class ModelJoint:
    """What a model file says of one joint."""

    name: str  # of the joint
    prismatic: bool  # it slides: m, m/s, N
    range_rad: tuple[float, float] | None  # limits; None where it may turn on and on
    armature_kg_m2: float  # reflected inertia of the rotor
    dry_nm: float  # level of dry friction at speed (friction loss, a spring that yields, the Coulomb level of LuGre)
    damping: tuple[float, float, float]  # (a, b, c) of a v + b v abs(v) + c v**3
    # (rise above the dry level in N m, speed in rad/s) of exp(-(v/vs)**2); zeros where there is none.
    stribeck: tuple[float, float]
    presliding_nm_per_rad: float | None  # stiffness before friction slips; None where the file has none
    yields_gradually: bool  # friction is a LuGre element's
    spring_nm_per_rad: float  # of the joint's own spring
    motor: Motor | None  # None where nothing drives it

    def friction_nm(self, speed_rad_s: Array) -> Array:
        """Friction of steady sliding, positive speeds, any shape."""
        a, b, c = self.damping
        rise, at = self.stribeck
        torque: Array = self.dry_nm + (a + (b + c * speed_rad_s) * speed_rad_s) * speed_rad_s
        return torque + rise * np.exp(-((speed_rad_s / at) ** 2)) if rise else torque


class RobotModel:
    """A model file, MJCF or URDF, and MuJoCo's own model of it (``compiled``)."""

    def __init__(self, path: Path, compiled: mujoco.MjModel, *, urdf: bool) -> None:
        self.path = path
        self.urdf = urdf
        self.compiled = compiled
        library = mujoco_library()
        hinge, slide = int(library.mjtJoint.mjJNT_HINGE), int(library.mjtJoint.mjJNT_SLIDE)
        self._number = {
            compiled.joint(k).name: k for k in range(compiled.njnt) if int(compiled.jnt_type[k]) in (hinge, slide)
        }
        self._slide = slide

    @staticmethod
    def load(path: Path) -> RobotModel:
        """Read and compile a file; raises as ``mujoco_library``.

        ``InputFileError``: MuJoCo cannot read it, or no joint of it has a name.
        """
        library = mujoco_library()
        urdf = is_urdf(path)
        try:
            if urdf:
                compiled = library.MjModel.from_xml_string(urdf_for_mujoco(path.read_text(encoding="utf-8")))
            else:
                compiled = library.MjModel.from_xml_path(str(path))
            model = RobotModel(path, compiled, urdf=urdf)  # names that are no UTF-8 are seen here
        except (ValueError, OSError, UnicodeDecodeError, ElementTree.ParseError) as error:
            raise InputFileError(
                f"MuJoCo {library.__version__} cannot read it: {error}",
                where=str(path),
                next_step="open it in `python -m mujoco.viewer` and correct what it says",
            ) from None
        if not any(model.joints):
            raise InputFileError(
                "no hinge or slide joint with a name", where=str(path), next_step="name the joints in the file"
            )
        return model

    @property
    def joints(self) -> tuple[str, ...]:
        """Names of the hinge and slide joints, in the file's order."""
        return tuple(name for name in self._number if name)

    def number(self, joint: str) -> int:
        """Place of a joint in MuJoCo's tables; ``UsageError`` where the file has no such joint."""
        if joint not in self._number:
            raise UsageError(
                f"no joint is called {joint!r}", where=str(self.path), next_step=f"it has {', '.join(self.joints)}"
            )
        return self._number[joint]

    def dof(self, joint: str) -> int:
        """Degree of freedom of a joint."""
        return int(self.compiled.jnt_dofadr[self.number(joint)])

    def joint(self, name: str) -> ModelJoint:
        """What the file says of a joint."""
        m, k, dof = self.compiled, self.number(name), self.dof(name)
        limited = bool(m.jnt_limited[k])
        stiffness = float(m.jnt_stiffness[k])
        yields = float(getattr(m, "jnt_springyield", np.zeros(m.njnt))[k])
        polynomial = getattr(m, "dof_dampingpoly", np.zeros((m.nv, 2)))[dof]
        dry, presliding = float(m.dof_frictionloss[dof]), None
        if yields > 0.0:
            dry, presliding = dry + stiffness * yields, stiffness
        rise = at = 0.0
        gradually = False
        for a in actuators_on(m, k):
            if (lugre := self._lugre(a)) is not None:
                sigma, coulomb, static, speed = lugre
                dry, presliding, rise, at = dry + coulomb, sigma, static - coulomb, speed
                gradually = True
        return ModelJoint(
            name=name,
            prismatic=int(m.jnt_type[k]) == self._slide,
            range_rad=(float(m.jnt_range[k][0]), float(m.jnt_range[k][1])) if limited else None,
            armature_kg_m2=float(m.dof_armature[dof]),
            dry_nm=dry,
            damping=(float(m.dof_damping[dof]), float(polynomial[0]), float(polynomial[1])),
            stribeck=(rise, at),
            presliding_nm_per_rad=presliding,
            yields_gradually=gradually,
            spring_nm_per_rad=0.0 if yields > 0.0 else stiffness,
            motor=self._motor(k),
        )

    def _lugre(self, a: int) -> tuple[float, float, float, float] | None:
        """(sigma0, Coulomb, static, Stribeck speed) on the joint's side of a LuGre element; None for others."""
        m, library = self.compiled, mujoco_library()
        motor = getattr(library.mjtGain, "mjGAIN_DCMOTOR", None)
        if motor is None or int(m.actuator_gaintype[a]) != int(motor) or m.actuator_dynprm[a][5] == 0.0:
            return None
        gear = abs(float(m.actuator_gear[a][0]))
        sigma = float(m.actuator_dynprm[a][5])
        coulomb, static, speed = (float(v) for v in m.actuator_biasprm[a][3:6])
        return gear * gear * sigma, gear * coulomb, gear * static, speed / gear

    def _motor(self, joint: int) -> Motor | None:
        m, library = self.compiled, mujoco_library()
        affine, none = int(library.mjtBias.mjBIAS_AFFINE), int(library.mjtBias.mjBIAS_NONE)
        fixed, gears = int(library.mjtGain.mjGAIN_FIXED), np.asarray(m.actuator_gear)[:, 0]
        driven = [a for a in actuators_on(m, joint) if self._lugre(a) is None]
        if not driven:
            return None
        kp = kv = 0.0
        law, limit = "torque", math.inf
        for a in driven:
            bias, gear = m.actuator_biasprm[a], float(gears[a])
            if m.actuator_forcelimited[a]:
                limit = min(limit, abs(gear) * float(np.max(np.abs(m.actuator_forcerange[a]))))
            if int(m.actuator_gaintype[a]) != fixed or int(m.actuator_biastype[a]) not in (affine, none):
                law = "other"
            elif int(m.actuator_biastype[a]) == affine and law != "other":
                position = float(m.actuator_gainprm[a][0]) == -float(bias[1]) > 0.0
                law = "position" if position or law == "position" else "other"
                kp, kv = kp - gear * gear * float(bias[1]), kv - gear * gear * float(bias[2])
        if m.jnt_actfrclimited[joint]:
            limit = min(limit, float(np.max(np.abs(m.jnt_actfrcrange[joint]))))
        first = driven[0]
        lagged = int(m.actuator_dyntype[first]) in (
            int(library.mjtDyn.mjDYN_FILTER), int(library.mjtDyn.mjDYN_FILTEREXACT),
        )  # fmt: skip
        return Motor(
            names=tuple(m.actuator(a).name for a in driven),
            law=law,
            kp_nm_per_rad=kp,
            kv_nm_s_per_rad=kv,
            gear=float(gears[first]),
            torque_limit_nm=limit,
            delay_s=float(getattr(m, "actuator_delay", np.zeros(len(gears)))[first]),
            lag_s=float(m.actuator_dynprm[first][0]) if lagged else 0.0,
        )

    def posture(self, held: Mapping[str, float]) -> Array:
        """Positions of everything, (nq,): the file's reference, with some joints elsewhere; raises as ``number``."""
        qpos: Array = self.compiled.qpos0.copy()
        for name, value in held.items():
            qpos[int(self.compiled.jnt_qposadr[self.number(name)])] = value
        return qpos

    def rigid_body_torque(
        self,
        joints: Sequence[str],
        position_rad: Array,
        velocity_rad_s: Array,
        acceleration_rad_s2: Array,
        held: Mapping[str, float] | None = None,
    ) -> Array:
        """Torque that the bodies, their gravity and the joints' springs ask for, by ``mj_inverse``; all (n, k), N m.

        The other joints stand at the file's reference unless told.
        """
        numbers, posture = [self.number(name) for name in joints], self.posture(held or {})
        motion = position_rad, velocity_rad_s, acceleration_rad_s2
        return inverse_torque(self.without_friction(), posture, numbers, *motion)

    def inertia_kg_m2(self, joints: Sequence[str], position_rad: Array, held: Mapping[str, float]) -> Array:
        """Inertia that each joint feels of itself in some postures, armature included, shape (n, k)."""
        library, m = mujoco_library(), self.compiled
        data, dofs = library.MjData(m), [self.dof(name) for name in joints]
        places = [int(m.jnt_qposadr[self.number(name)]) for name in joints]
        full, out = np.zeros((m.nv, m.nv)), np.empty(position_rad.shape)
        data.qpos[:] = self.posture(held)
        for row, position in zip(out, position_rad, strict=True):
            data.qpos[places] = position
            library.mj_fwdPosition(m, data)
            if library.mj_versionString() >= "3.3.5":
                library.mj_fullM(m, data, full)
            else:
                library.mj_fullM(m, full, data.qM)
            row[:] = full[dofs, dofs]
        return out

    def without_friction(self) -> mujoco.MjModel:
        """The compiled model without friction, damping, contacts, limits and constraints; springs stay."""
        library = mujoco_library()
        m: Any = copy.copy(self.compiled)
        m.dof_frictionloss[:] = 0.0
        m.dof_damping[:] = 0.0
        if hasattr(m, "dof_dampingpoly"):
            m.dof_dampingpoly[:] = 0.0
        if hasattr(m, "jnt_springyield"):
            # A spring that yields is friction.
            slips = m.jnt_springyield > 0.0
            m.jnt_stiffness[slips] = 0.0
            m.jnt_stiffnesspoly[slips] = 0.0
        m.tendon_damping[:] = 0.0
        m.tendon_frictionloss[:] = 0.0
        if hasattr(m, "tendon_springyield"):
            m.tendon_stiffness[m.tendon_springyield > 0.0] = 0.0
        m.opt.disableflags |= int(library.mjtDisableBit.mjDSBL_CONSTRAINT) | int(library.mjtDisableBit.mjDSBL_ACTUATION)
        return m


def actuators_on(m: Any, joint: int) -> list[int]:
    """Actuators on a joint, passive ones included; the list may be longer than that of controls, which those lack."""
    kinds = (int(mujoco_library().mjtTrn.mjTRN_JOINT), int(mujoco_library().mjtTrn.mjTRN_JOINTINPARENT))
    count = len(m.actuator_trntype)
    return [a for a in range(count) if int(m.actuator_trntype[a]) in kinds and int(m.actuator_trnid[a][0]) == joint]


def inverse_torque(
    model: mujoco.MjModel,
    qpos: Array,
    joints: Sequence[int],
    position_rad: Array,
    velocity_rad_s: Array,
    acceleration_rad_s2: Array,
) -> Array:
    """``mj_inverse`` along a motion of some joints, the others held at ``qpos``; shapes (n, k)."""
    library = mujoco_library()
    places = np.array([int(model.jnt_qposadr[k]) for k in joints])
    dofs = np.array([int(model.jnt_dofadr[k]) for k in joints])
    out = np.empty(position_rad.shape)

    def part(rows: slice) -> None:
        data = library.MjData(model)
        data.qpos[:] = qpos
        q, v, a, torque = data.qpos, data.qvel, data.qacc, data.qfrc_inverse
        inverse = library.mj_inverse
        for k in range(rows.start, rows.stop):
            q[places] = position_rad[k]
            v[dofs] = velocity_rad_s[k]
            a[dofs] = acceleration_rad_s2[k]
            inverse(model, data)
            out[k] = torque[dofs]

    n = position_rad.shape[0]
    if n < 2 * _ROWS_PER_THREAD:
        part(slice(0, n))
        return out
    edges = np.linspace(0, n, THREADS + 1).astype(int)
    with ThreadPoolExecutor(THREADS) as pool:
        list(pool.map(part, [slice(int(a), int(b)) for a, b in itertools.pairwise(edges)]))
    return out


def relax(model: mujoco.MjModel, data: mujoco.MjData) -> None:
    """Let springs that yield begin without force where the joints stand.

    MuJoCo keeps their slip in ``data.plastic``; where it is not set with the positions, the first step feels thousands.
    """
    plastic = getattr(data, "plastic", None)
    if plastic is None or plastic.size == 0:
        return
    mujoco_library().mj_fwdPosition(model, data)
    for k, at in enumerate(model.jnt_plasticadr):
        if at >= 0:
            place = int(model.jnt_qposadr[k])
            plastic[at] = data.qpos[place] - model.qpos_spring[place]
    for k, at in enumerate(model.tendon_plasticadr):
        if at >= 0:
            plastic[at : at + 2] = data.ten_length[k] - model.tendon_lengthspring[k]


def is_urdf(path: Path) -> bool:
    """Whether a file is a URDF, by its root element; ``InputFileError`` where it cannot be read, or is no XML."""
    try:
        for _, element in ElementTree.iterparse(path, events=("start",)):
            if element.tag not in ("robot", "mujoco", "mujocoinclude"):
                raise InputFileError(f"neither MJCF nor URDF: its root is <{element.tag}>", where=str(path))
            return bool(element.tag == "robot")
    except (OSError, ElementTree.ParseError) as error:
        raise InputFileError(f"cannot be read: {error}", where=str(path)) from None
    raise InputFileError("is empty", where=str(path))


def urdf_for_mujoco(text: str) -> str:
    """The URDF as MuJoCo reads it without its meshes: shapes are left out, the dynamics stand in ``inertial``."""
    root = ElementTree.fromstring(text)
    for link in root.iter("link"):
        for shape in ("visual", "collision"):
            for element in link.findall(shape):
                link.remove(element)
    settings = root.find("mujoco")
    if settings is None:
        settings = ElementTree.SubElement(root, "mujoco")
    compiler = settings.find("compiler")
    if compiler is None:
        compiler = ElementTree.SubElement(settings, "compiler")
    compiler.set("fusestatic", "false")
    compiler.set("balanceinertia", "true")
    return ElementTree.tostring(root, encoding="unicode")
