"""An experiment set on disk: ``nominal.yaml`` and one CSV per experiment, new or added to."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence, Set
from pathlib import Path
from typing import Any

import yaml

from frictid_hil.config.write import dump
from frictid_hil.errors import ConfigError, UsageError
from frictid_hil.files import made_folder, write_whole
from frictid_hil.gap.experiments import Experiment
from frictid_hil.jobs.gap.belief import Belief
from frictid_hil.recording.csv import write_csv
from frictid_hil.recording.samples import Samples

_TIMING = (
    "row k: position sampled at t_k; torque is the value applied since t_(k-1); the command of row k acts from t_k"
)
_CONVENTION = "tau = inertia*acc + gravity_cos*cos(position) + gravity_sin*sin(position) + friction"


def existing_set(folder: Path, robot: str, joint: str) -> Mapping[str, Any] | None:
    """``nominal.yaml`` of a set that experiments shall be added to; None where there is no set yet.

    Raises:
        UsageError: the folder holds something else, or a set of another joint.
    """
    path = folder / "nominal.yaml"
    if not path.exists():
        if folder.exists() and any(folder.iterdir()):
            raise UsageError("holds something else than an experiment set", where=str(folder))
        return None
    try:
        document = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise ConfigError(f"cannot be read: {error}", where=str(path)) from error
    if not isinstance(document, Mapping) or (document.get("robot"), document.get("robot_joint")) != (robot, joint):
        raise UsageError(
            f"this set is not of {robot}, joint {joint}", where=str(path), next_step="choose another --out"
        )
    return document


def write_set(
    folder: Path,
    robot: str,
    joint: str,
    belief: Belief,
    logs: Sequence[tuple[Experiment, Samples]],
    *,
    earlier: Mapping[str, Any] | None = None,
) -> None:
    """Write logs, then ``nominal.yaml`` that lists them.

    Experiments are added to ``earlier`` ones; one that is there already goes on as ``chirp_2``, ``chirp_3``, ...

    Raises:
        FrictidError: disk full, or no permission.
    """
    made_folder(folder)
    listed = list(earlier["experiments"]) if earlier else []
    for experiment, samples in logs:
        # Also a log that no list names: whoever put it there did not ask for another in its place.
        taken = {str(entry["name"]) for entry in listed} | {path.stem for path in folder.glob("*.csv")}
        name = _unused(experiment.name, taken)
        write_csv(folder / f"{name}.csv", samples)
        listed.append(
            {
                "name": name,
                "file": f"{name}.csv",
                "role": experiment.role,
                "payload": experiment.payload,
                "run_order": len(listed),
                "duration_s": round(float(samples.time_s[-1] + samples.step_s), 6),
            }
        )
    document = earlier or {
        "case": f"{robot}-joint-{joint}",
        "robot": robot,
        "robot_joint": joint,
        "convention": _CONVENTION,
        "timing": _TIMING,
        "belief_from": list(belief.sources),
        **belief.sections,
    }
    write_whole(folder / "nominal.yaml", dump({**document, "experiments": listed}))


def _unused(name: str, taken: Set[str]) -> str:
    names = itertools.chain([name], (f"{name}_{k}" for k in itertools.count(2)))
    return next(candidate for candidate in names if candidate not in taken)
