"""How near every file that is exported comes to the machine: torque on motion that was not fitted, before and after.

The user's own MJCF runs in closed loop in MuJoCo, and for a short while in every other engine that is installed. Of a
file whose simulator does not run here, the friction law is read back from the file and evaluated along the motion: what
the machine gave, less what the bodies need, less what the file says. Such files say nothing of presliding: friction
builds up as in the user's model.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from frictid_hil.friction.metrics import plain_rms
from frictid_hil.friction.trajectory import Array
from frictid_hil.gap.residuals import slip_state
from frictid_hil.jobs.gap.closed_loop import driven, low_pass, reported, why_no_closed_loop, withheld
from frictid_hil.jobs.gap.draft import SLIP_RAD
from frictid_hil.jobs.gap.from_model import ArmSet, Motion
from frictid_hil.simulation.model_edit import compiled_with
from frictid_hil.simulation.model_replay import replayed
from frictid_hil.simulation.native import Native
from frictid_hil.simulation.other_engines import in_newton, installed, newton
from frictid_hil.simulation.rigid_bodies import mujoco_library
from frictid_hil.simulation.robot_model import RobotModel
from frictid_hil.simulation.target_laws import Law, c_compiler, laws_of, run_c
from frictid_hil.simulation.usd import prim_name

LAW_S = 30.0
"""Length of the withheld motion along which laws are evaluated."""
ENGINE_S = 2.0
"""Length of the withheld motion that runs in Newton."""
SLOW_FROM_S, SLOW_S = 2.0, 0.5
"""Start and length of its part that runs in engines that need ten milliseconds for a step of one."""
EDGE_S = 0.25
"""Both ends of a motion, where a low-pass is not yet itself."""
_PERCENT = ("before_percent", "after_percent")
_ITSELF = "our own evaluation of the file, not run there"


class Withheld:
    """The last motion that was not fitted, and what the machine gave there beyond what the bodies need.

    Attributes:
        joints: whose torque error counts.
        size: RMS of their measured torque, N m.
    """

    def __init__(self, arm: ArmSet, changed: Iterable[str]) -> None:
        self.arm = arm
        self.motion = withheld(arm)[-1].beginning(LAW_S)
        self.joints = tuple(changed) or arm.recorded
        self._smooth = low_pass(self.motion.time_s)
        measured = {n: s.torque_nm for n, s in self.motion.samples.items() if s.torque_nm is not None}
        self.known = set(self.joints) <= set(measured)
        if not self.known:
            return
        self.size = {name: plain_rms(measured[name]) for name in self.joints}
        moved = self.motion.moved
        bodies = arm.robot.rigid_body_torque(arm.recorded, *moved, arm.held)
        if arm.found is not None and arm.found.torque is not None:
            bodies = bodies + arm.found.torque(*moved)
        columns = {name: arm.recorded.index(name) for name in self.joints}
        self._left = {name: self._smooth(measured[name] - bodies[:, k]) for name, k in columns.items()}
        self.velocity = {name: self._smooth(moved[1][:, k]) for name, k in columns.items()}
        self._slip = {name: slip_state(moved[0][:, k], 1.0 / _travel(arm, name)) for name, k in columns.items()}
        self._acceleration = {name: self._smooth(moved[2][:, k]) for name, k in columns.items()}

    def off(self, laws: Mapping[str, Law], friction_nm: Mapping[str, Array] | None = None) -> dict[str, float]:
        """RMS of the torque that a law leaves, by joint, N m; ``friction_nm`` where friction was computed elsewhere."""
        found = {}
        edge = slice(*np.searchsorted(self.motion.time_s, self.motion.time_s[[0, -1]] + [EDGE_S, -EDGE_S]))
        for name in self.joints:
            law, believed = laws[name], self.arm.robot.joint(name)
            torque = (friction_nm or {}).get(name, law.torque_nm(self.velocity[name], self._slip[name]))
            if law.armature_kg_m2 is not None:
                torque = torque + (law.armature_kg_m2 - believed.armature_kg_m2) * self._acceleration[name]
            found[name] = plain_rms((self._left[name] - self._smooth(torque))[edge])
        return found

    def row(
        self, target: str, where: str, before: Mapping[str, float], after: Mapping[str, float], lost: str
    ) -> dict[str, Any]:
        """One exported file, as JSON: RMS of the torque error by joint, N m, and in percent of the measured torque."""
        joints = {name: {"before_nm": before[name], "after_nm": after[name]} for name in after}
        told = {"target": target, "where": where, "lost": lost, "joints": joints}
        shares = (np.array([off[name] / self.size[name] for name in after]) for off in (before, after))
        return {**told, **dict(zip(_PERCENT, (100.0 * plain_rms(share) for share in shares), strict=True))}

    def before(self) -> dict[str, float]:
        """The same with the friction of the user's model."""
        believed = {name: self.arm.robot.joint(name) for name in self.joints}
        return self.off({name: Law(b.dry_nm, *b.stribeck, b.damping) for name, b in believed.items()})


def rows_of(result: Mapping[str, Any]) -> list[tuple[str, ...]]:
    """Every figure of a result, as words: target, where it ran, torque error before and after, what is lost."""
    written = [result.get("export", {}), *result.get("targets", {}).values()]
    rows = []
    for told in (row for one in written for row in one.get("figures", [])):
        figures = ("", "refused") if "refused" in told else (f"{told[w]:.2f} %" for w in _PERCENT)
        rows.append((told["target"], told["where"], *figures, told.get("refused") or told["lost"]))
    return rows


def figure_of_target(motion: Withheld, target: str, texts: Mapping[str, str], lost: str) -> list[dict[str, Any]]:
    """Rows of a target's files, see ``Withheld.row``; none where the logs have no torque."""
    if not motion.known:
        return []
    before, laws = motion.before(), laws_of(target, texts, motion.arm.joints)
    if not laws or not set(motion.joints) <= set(laws[0]):
        return []
    where, friction = _ITSELF, None
    if target == "c" and c_compiler() is not None:
        (text,) = texts.values()
        friction = run_c(text, motion.velocity, float(np.median(np.diff(motion.motion.time_s))))
        where = "compiled and run here"
    every = [motion.off(one, friction) for one in laws]
    after = {name: float(np.median([off[name] for off in every])) for name in motion.joints}
    return [motion.row(target, where, before, after, lost)]


def figures_of_model(motion: Withheld, natives: Mapping[str, Native], told: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Rows of the user's improved model: in MuJoCo, and for a short while in the other engines that are installed.

    Where it cannot run in closed loop, its friction is read back from the edited file.
    """
    if not motion.known:
        return []
    if "reason" in told:
        return [_row_as_read(motion, natives)]
    before, after = ({n: told[when][n]["torque_nm"] for n in motion.joints} for when in ("before", "after"))
    here = f"MuJoCo {mujoco_library().__version__}, closed loop"
    rows = [motion.row("mjcf", here, before, after, "told with each joint")]
    arm = motion.arm
    improved = compiled_with(arm.robot, natives)
    short = motion.motion.beginning(SLOW_FROM_S + SLOW_S)
    begin = int(np.searchsorted(short.time_s, short.time_s[0] + SLOW_FROM_S))
    for name, engine in installed().items():
        try:
            ran = replayed(improved, *driven(arm, short), engine=engine, begin=begin).torque_nm
        except Exception as error:  # whatever another engine raises: the model is written all the same
            rows.append({"target": "mjcf", "where": name, "refused": f"{type(error).__name__}: {error}"[:300]})
            continue
        where, torque = f"{name}, closed loop, {SLOW_S:g} s", reported(arm, natives) * ran
        off = _short_off(motion, short, begin, torque)
        rows.append(motion.row("mjcf", where, *off, "as above"))
    return rows


def _row_as_read(motion: Withheld, natives: Mapping[str, Native]) -> dict[str, Any]:
    robot = motion.arm.robot
    improved = RobotModel(robot.path, compiled_with(robot, natives), urdf=robot.urdf)
    joints = {name: improved.joint(name) for name in motion.joints}
    laws = {name: Law(b.dry_nm, *b.stribeck, b.damping, b.armature_kg_m2) for name, b in joints.items()}
    target, where = "urdf" if robot.urdf else "mjcf", "our own evaluation of the friction that MuJoCo reads from it"
    return motion.row(target, where, motion.before(), motion.off(laws), "told with each joint")


def figure_in_newton(motion: Withheld, stage: Path, natives: Mapping[str, Native], lost: str) -> list[dict[str, Any]]:
    """The row of a stage in Newton itself, where it is installed and the whole arm can be driven."""
    name, arm = newton(), motion.arm
    if name is None or not motion.known or why_no_closed_loop(arm, [motion.motion]):
        return []
    short, step_s = motion.motion.beginning(ENGINE_S), float(arm.robot.compiled.opt.timestep)
    joints, _, time, position, command = driven(arm, short)
    where = f"{name}, closed loop, {ENGINE_S:g} s"
    try:
        prims = [prim_name(joint) for joint in joints]
        ran = in_newton(stage, prims, step_s, time, position[0], command)
    except Exception as error:  # as above
        return [{"target": "newton", "where": name, "refused": f"{type(error).__name__}: {error}"[:300]}]
    begin = int(np.searchsorted(time, time[0] + EDGE_S))
    off = _short_off(motion, short, begin, reported(arm, natives) * ran)
    return [motion.row("newton", where, *off, lost)]


def _short_off(motion: Withheld, short: Motion, begin: int, torque: Array) -> tuple[dict[str, float], dict[str, float]]:
    """RMS of the torque error by joint from row ``begin`` on: user's model in MuJoCo, and ``torque`` (n, k)."""
    smooth, arm = low_pass(short.time_s), motion.arm
    nominal = replayed(arm.robot.compiled, *driven(arm, short)).torque_nm
    before, after = {}, {}
    for name in motion.joints:
        k, measured = arm.recorded.index(name), np.asarray(short.samples[name].torque_nm)
        before[name] = plain_rms(smooth(measured - nominal[:, k])[begin:])
        after[name] = plain_rms(smooth(measured - torque[:, k])[begin:])
    return before, after


def _travel(arm: ArmSet, name: str) -> float:
    """Travel over which a joint's friction builds up, as the user's model has it, rad."""
    believed = arm.robot.joint(name)
    stiffness = believed.presliding_nm_per_rad
    return believed.dry_nm / stiffness if stiffness and believed.dry_nm > 0.0 else SLIP_RAD
