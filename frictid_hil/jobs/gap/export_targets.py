"""The improved joints for other simulators, and posterior samples of their numbers for domain randomisation."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from frictid_hil.errors import UsageError
from frictid_hil.files import refuse_overwriting, write_whole
from frictid_hil.gap.diagnosis import Diagnosis
from frictid_hil.jobs.gap.export_figures import Withheld, figure_in_newton, figure_of_target
from frictid_hil.jobs.gap.from_model import ArmSet
from frictid_hil.jobs.gap.write_model import Export, joint_model, natives, use_of, within
from frictid_hil.simulation import usd
from frictid_hil.simulation.effects import all_effects
from frictid_hil.simulation.targets import LOST, TARGETS, Numbers, numbers_of, place_of, written_as

_SIGMAS = 2.0 * 1.96
"""Standard deviations in a 95 % interval."""


@dataclass(frozen=True, slots=True)
class Wanted:
    """What to write beside the model.

    Paths are by target, see ``targets.TARGETS``; ``samples`` of the posterior are drawn; ``newton`` is laid over the
    joints of ``stage``, and writes a stage of its own without.
    """

    files: Mapping[str, Path]
    samples: int = 0
    seed: int = 1
    stage: Path | None = None

    @staticmethod
    def of(words: Sequence[str], samples: int, stage: Path | None = None) -> Wanted:
        """Read what is wanted from words of the form ``TARGET=FILE``.

        Raises:
            UsageError: no such target, no file, or samples asked for that nobody writes.
        """
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
    """Refuse what cannot be written before anything is computed.

    Raises:
        ConfigError, InputFileError, UsageError: the stage, or the lack of one; see ``usd``.
    """
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

    Raises:
        UsageError: a file is there already.

    Returns:
        By target: ``files`` (absolute paths), ``effects`` (by joint, where each went: None where the target cannot hold
        it), ``lost`` and ``figures``, see ``export_figures``.
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
    draw = found.samples[int(random.integers(len(found.samples)))]
    told = {effect: within(effect, draw.get(effect, {})) for effect in effects}
    return {effect: all_effects()[effect].complete(values) for effect, values in told.items() if values}


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
