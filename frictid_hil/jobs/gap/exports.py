"""The improved joints for other simulators, posterior samples of their numbers, and how near every file comes.

The user's own MJCF runs in closed loop in MuJoCo, and for a short while in every other engine that is installed. Of a
file whose simulator does not run here, the friction law is read back from the file and evaluated along the motion: what
the machine gave, less what the bodies need, less what the file says. Such files say nothing of presliding: friction
builds up as in the user's model.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from frictid_hil.errors import UsageError
from frictid_hil.files import refuse_overwriting, write_whole
from frictid_hil.friction.metrics import plain_rms
from frictid_hil.friction.trajectory import Array
from frictid_hil.gap.diagnosis import Diagnosis
from frictid_hil.gap.residuals import slip_state
from frictid_hil.jobs.gap.closed_loop import driven, low_pass, reported, why_no_closed_loop, withheld
from frictid_hil.jobs.gap.draft import SLIP_RAD
from frictid_hil.jobs.gap.from_model import ArmSet, Motion
from frictid_hil.jobs.gap.write_model import Export, joint_model, natives, use_of, within
from frictid_hil.simulation import usd
from frictid_hil.simulation.effects import all_effects
from frictid_hil.simulation.model_edit import compiled_with
from frictid_hil.simulation.model_replay import replayed
from frictid_hil.simulation.native import Native
from frictid_hil.simulation.other_engines import in_newton, installed, newton
from frictid_hil.simulation.rigid_bodies import mujoco_library
from frictid_hil.simulation.robot_model import RobotModel
from frictid_hil.simulation.target_laws import Law, c_compiler, laws_of, run_c
from frictid_hil.simulation.targets import LOST, TARGETS, Numbers, numbers_of, place_of, written_as
from frictid_hil.simulation.usd import prim_name

LAW_S = 30.0  # length of the withheld motion along which laws are evaluated
ENGINE_S = 2.0  # length of the withheld motion that runs in Newton
SLOW_FROM_S, SLOW_S = 2.0, 0.5
"""Start and length of its part that runs in engines that need ten milliseconds for a step of one."""
EDGE_S = 0.25  # both ends of a motion, where a low-pass is not yet itself
_PERCENT = ("before_percent", "after_percent")
_ITSELF = "our own evaluation of the file, not run there"


class Withheld:
    """The last motion that was not fitted, and what the machine gave there beyond what the bodies need."""

    def __init__(self, arm: ArmSet, changed: Iterable[str]) -> None:
        self.arm = arm
        self.motion = withheld(arm)[-1].beginning(LAW_S)
        self.joints = tuple(changed) or arm.recorded  # whose torque error counts
        self._smooth = low_pass(self.motion.time_s)
        measured = {n: s.torque_nm for n, s in self.motion.samples.items() if s.torque_nm is not None}
        self.known = set(self.joints) <= set(measured)
        if not self.known:
            return
        self.size = {name: plain_rms(measured[name]) for name in self.joints}  # of the measured torque, N m
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
    """Rows of the improved model in MuJoCo, shortly in other engines, or as read from its file where it cannot run."""
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


_SIGMAS = 2.0 * 1.96  # standard deviations in a 95 % interval


@dataclass(frozen=True, slots=True)
class Wanted:
    """What to write beside the model."""

    files: Mapping[str, Path]  # by target, see ``targets.TARGETS``
    samples: int = 0  # of the posterior, to be drawn
    seed: int = 1
    stage: Path | None = None  # over whose joints ``newton`` is laid; without it a stage of its own

    @staticmethod
    def of(words: Sequence[str], samples: int, stage: Path | None = None) -> Wanted:
        """From words of the form ``TARGET=FILE`` (``UsageError``: no target or file, or samples that nobody writes)."""
        files = {}
        for word in words:
            target, equals, file = word.partition("=")
            if target not in TARGETS or not file or not equals:
                raise UsageError(
                    f"--export {word}: no target and file", next_step=f"one of {', '.join(TARGETS)}, as c=friction.h"
                )
            files[target] = Path(file)
        if "samples" in files and not samples:
            raise UsageError("--export samples=FILE needs --randomise N", next_step="say how many samples to draw")
        if samples and not files:
            raise UsageError(
                "--randomise has nothing to write to", next_step="add --export samples=FILE or isaaclab=FILE"
            )
        if stage is not None and "newton" not in files:
            raise UsageError("--stage is of Newton", next_step="add --export newton=FILE.usda")
        return Wanted(files, samples, stage=stage)


def check_targets(arm: ArmSet, wanted: Wanted) -> None:
    """Refuse, before anything is computed, a stage that cannot be written, or that is not there; raises as ``usd``."""
    if "newton" not in wanted.files:
        return
    if wanted.stage is None:
        usd.stage(arm.robot, {})
    else:
        usd.joint_prims(wanted.stage, list(arm.joints))


def write_targets(
    arm: ArmSet, found: Mapping[str, Diagnosis], made: Mapping[str, Export], wanted: Wanted, *, force: bool
) -> dict[str, Any]:
    """Write every target that is wanted, of all joints with a friction curve; with the causes that ``made`` has.

    By target: ``files``, ``effects`` (by joint, where each went or None), ``lost`` and ``figures``, see
    ``Withheld.row``. ``UsageError``: a file is there already.
    """
    joints, samples = {}, {}
    random = np.random.default_rng(wanted.seed)
    for name, joint in arm.joints.items():
        if joint.experiments.nominal.curve is None:
            continue
        use = use_of(arm, name)
        effects = made[name].model.effects if name in made else {}
        stiffness = found[name].presliding_nm_per_rad
        joints[name] = numbers_of(joint.believed, joint_model(joint, effects, stiffness), use)
        if wanted.samples:
            others = (_drawn(effects, found[name], random) for _ in range(wanted.samples))
            samples[name] = [numbers_of(joint.believed, joint_model(joint, o, stiffness), use) for o in others]
    texts = {
        target: {path.parent / name: text for name, text in _texts(arm, target, path, joints, samples, wanted).items()}
        for target, path in wanted.files.items()
    }
    refuse_overwriting([path for files in texts.values() for path in files], force=force)
    for files in texts.values():
        for path, text in files.items():
            write_whole(path, text)
    motion = Withheld(arm, made)
    told = {}
    for target, files in texts.items():
        places = {name: {e: place_of(target, e) for e in one.model.effects} for name, one in made.items()}
        lost = _lost_words(target, places)
        figures = figure_of_target(motion, target, {p.name: text for p, text in files.items()}, lost)
        if target == "newton":
            figures = figure_in_newton(motion, wanted.files[target], natives(made), lost) or figures
        paths = [str(path.resolve()) for path in files]
        told[target] = {"files": paths, "effects": places, "lost": lost, "figures": figures}
    return told


def _lost_words(target: str, places: Mapping[str, Mapping[str, str | None]]) -> str:
    """What of this machine is lost, then what the target lacks."""
    gone = {name: [e for e, place in placed.items() if place is None] for name, placed in places.items()}
    told = [f"{' and '.join(lost)} of {name}" for name, lost in gone.items() if lost]
    return "; ".join([*told, LOST[target]])


def _texts(
    arm: ArmSet,
    target: str,
    path: Path,
    joints: Mapping[str, Numbers],
    samples: Mapping[str, Sequence[Numbers]],
    wanted: Wanted,
) -> dict[str, str]:
    """What to write for a target, by file name."""
    if target != "newton":
        return written_as(target, path.name, joints, samples, float(arm.robot.compiled.opt.timestep))
    if wanted.stage is None:
        return {path.name: usd.stage(arm.robot, joints)}
    below = Path(os.path.relpath(wanted.stage.resolve(), path.resolve().parent))
    return {path.name: usd.overlay(below, usd.joint_prims(wanted.stage, list(joints)), joints)}


def _drawn(
    effects: Mapping[str, Mapping[str, float]], found: Diagnosis, random: np.random.Generator
) -> dict[str, dict[str, float]]:
    """The effects of one draw of the posterior: level and slope that belong together, and no effect that it lacks."""
    if not found.samples:
        return {effect: _within_interval(effect, values, found, random) for effect, values in effects.items()}
    draw, drawn = found.samples[int(random.integers(len(found.samples)))], set().union(*found.samples)
    told = {effect: within(effect, draw.get(effect, {})) for effect in effects if effect in drawn}
    return {
        **{effect: all_effects()[effect].complete(values) for effect, values in told.items() if values},
        # What was read without a posterior is in no draw.
        **{e: _within_interval(e, values, found, random) for e, values in effects.items() if e not in drawn},
    }


def _within_interval(
    effect: str, values: Mapping[str, float], found: Diagnosis, random: np.random.Generator
) -> dict[str, float]:
    """Parameters of an effect that was read without a posterior, each within its interval."""
    parameters = next((cause.parameters for cause in found.causes if cause.effect == effect), {})
    drawn = {
        name: values[name] + (told.high - told.low) / _SIGMAS * float(random.standard_normal())
        for name, told in parameters.items()
        if told.low is not None and told.high is not None and name in values
    }
    return {**values, **within(effect, drawn)}
