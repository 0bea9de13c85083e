"""Experiment sets: of recordings that lie anywhere with a belief, or in a folder with ``nominal.yaml``."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from frictid_hil.columns import ColumnMap
from frictid_hil.config.columns import load_columns
from frictid_hil.config.nominal import ExperimentFile, NominalFile, load_nominal
from frictid_hil.config.profile import JointProfile, load_profile, profile_file
from frictid_hil.config.write import dump
from frictid_hil.errors import ConfigError, InputFileError, UsageError
from frictid_hil.files import made_folder, write_whole
from frictid_hil.gap.experiment_set import ExperimentSet, experiment_set, read_log
from frictid_hil.gap.tolerances import stated_by
from frictid_hil.jobs.gap.belief import Belief, measured_by
from frictid_hil.plan.experiments import Experiment
from frictid_hil.recording.csv import write_csv
from frictid_hil.recording.read import read
from frictid_hil.recording.samples import Samples

VALIDATION_SHARE = 1.0 / 3.0  # part of the recorded time, its end, that is judged on where nobody says what to judge on


@dataclass(frozen=True, slots=True)
class Source:
    """What is diagnosed: a set's folder, or recordings that lie anywhere, with a belief."""

    paths: Sequence[Path]
    columns: str | None = None
    # What the simulator believes; a set's own ``nominal.yaml`` unless told. It need not list the logs.
    nominal: Path | None = None
    profile: Path | None = None  # friction profile or run folder, whose numbers overrule it
    joint: str | None = None
    # Logs to judge on (files without ending); else as ``nominal`` says of logs of the same name, else by time.
    validation: Sequence[str] = ()
    split: str = ""  # see ``parted``

    def load(self) -> ExperimentSet:
        """Read it (``UsageError``: a set beside others, or no joint named; ``InputFileError``, ``ConfigError``)."""
        folders = [path for path in self.paths if (path / "nominal.yaml").exists()]
        options = (self.columns, self.nominal, self.profile, self.joint, self.split, *self.validation)
        if not folders and len(self.paths) == 1 and self.paths[0].is_dir() and not any(options):
            folders = list(self.paths)
        if not folders:
            return self._of_logs()
        if len(self.paths) > 1 or any(options):
            raise UsageError(
                "an experiment set says by itself what is believed and which logs are judged on",
                where=str(folders[0]),
                next_step="give the set alone, or its logs with --nominal",
            )
        return ExperimentSet.load(folders[0])

    def _of_logs(self) -> ExperimentSet:
        named = zip(names_of(self.paths), self.paths, strict=True)
        logs = [(name, _samples(path, self.columns, self.joint)) for name, path in named]
        data, told, where = _belief(self.nominal, self.profile, self.joint)
        entries = {entry.name: entry for entry in told.experiments}
        validation = self.validation
        if not validation and not self.split:
            validation = [name for name, _ in logs if name in entries and entries[name].role == "validation"]
        whole, listed = dict(logs), []
        for order, (name, source, keep, judged) in enumerate(parted(logs, validation, self.split)):
            payload = entries[name].payload if name in entries else False
            listed.append((listed_as(name, judged, order, payload=payload), whole[source].select(keep)))
        return experiment_set(told, data, where, self.paths[0].resolve().parent.name, listed)


def listed_as(name: str, judged: bool, order: int, *, payload: bool = False) -> ExperimentFile:
    """The entry of a log in a ``nominal.yaml``."""
    role: Any = "validation" if judged else "identification"
    return ExperimentFile(name=name, role=role, payload=payload, run_order=order)


def parted(
    logs: Sequence[tuple[str, Samples]], validation: Sequence[str] = (), split: str = ""
) -> list[tuple[str, str, NDArray[np.bool_], bool]]:
    """Part recordings into what is fitted and what is judged on: (name of the part, of its log, rows, judged on).

    Unless told: the last third of one log, else the last logs that make up a quarter or more. ``split`` is ``log`` for
    whole logs; ``30%`` or ``20s`` of the end of every log. ``UsageError``: unreadable, or nothing is left; unknown
    names.
    """
    names = [name for name, _ in logs]
    twice = [name for name in names if names.count(name) > 1]
    if twice:
        raise UsageError(f"two logs are called {twice[0]}", next_step="rename one of the files")
    absent = [name for name in validation if name not in names]
    if absent:
        raise UsageError(
            f"no log is called {absent[0]}", where="--validation", next_step=f"name of: {', '.join(names)}"
        )
    if split and validation:
        raise UsageError("--split and --validation both say what is judged on", next_step="give one of them")
    if split and split != "log":
        return [part for name, samples in logs for part in _by_time(name, samples, split, f"last {split}")]
    if len(logs) == 1 and not validation:
        if split:
            raise UsageError("--split log needs several logs", next_step="give --split 30% to part one log by time")
        ((name, samples),) = logs
        return _by_time(name, samples, f"{100.0 * VALIDATION_SHARE}%", "last third")
    every = [(name, name, np.ones(len(samples), dtype=np.bool_)) for name, samples in logs]
    if validation:
        return [(*part, part[0] in validation) for part in every]
    spans = [float(samples.time_s[-1] - samples.time_s[0]) for _, samples in logs]
    after = [sum(spans[k:]) for k in range(len(spans))]
    first = max(k for k in range(1, len(logs)) if after[k] >= 0.75 * VALIDATION_SHARE * after[0] or k == 1)
    return [(*part, k >= first) for k, part in enumerate(every)]


def _by_time(name: str, samples: Samples, split: str, called: str) -> list[tuple[str, str, NDArray[np.bool_], bool]]:
    """Divide one log into its beginning and its end."""
    length = float(samples.time_s[-1] - samples.time_s[0])
    try:
        end_s = float(split[:-1]) * {"%": 0.01 * length, "s": 1.0}[split[-1:]]
    except (ValueError, KeyError):
        raise UsageError(f"--split {split} cannot be read", next_step="write log, 30% or 20s") from None
    if not 0.0 < end_s < length:
        raise UsageError(
            f"--split {split} leaves nothing to fit or nothing to judge on: the log lasts {length:.3g} s", where=name
        )
    early = samples.time_s < samples.time_s[-1] - end_s
    return [(name, name, early, False), (f"{name}, {called}", name, ~early, True)]


def _belief(nominal: Path | None, profile: Path | None, joint: str | None) -> tuple[dict[str, Any], NominalFile, str]:
    """(the mapping, the same checked, where it comes from)."""
    data: dict[str, Any] = {"joint": {}}
    where = "no nominal joint"
    if nominal is not None:
        loaded = load_nominal(nominal, logs=False)
        data, where = loaded.document.data, str(loaded.document.path)
    if profile is not None:
        measured = _joint_of(profile, joint)
        numbers = measured_by(measured)
        known = "gravity_torque_nm" if "gravity_cos_nm" in numbers else ""
        kept = {name: value for name, value in data["joint"].items() if name != known}
        data = {
            **data,
            "joint": {**kept, **numbers},
            "tolerance": {**stated_by(measured), **(data.get("tolerance") or {})},
        }
        where = str(profile)
    return data, NominalFile.model_validate(data), where


def _joint_of(profile: Path, joint: str | None) -> JointProfile:
    loaded = load_profile(profile_file(profile))
    if joint is None and len(loaded.joints) == 1:
        return next(iter(loaded.joints.values()))
    if joint is None or joint not in loaded.joints:
        raise UsageError(
            f"holds joints {', '.join(loaded.joints)}", where=str(profile), next_step="name one with --joint"
        )
    return loaded.joints[joint]


def _samples(path: Path, columns: str | None, joint: str | None) -> Samples:
    if columns is None and path.name.lower().endswith((".csv", ".csv.gz")):
        return read_log(path)
    found = samples_of_all(path, load_columns(columns) if columns is not None else None, joint)
    if len(found) > 1:
        raise UsageError(
            f"holds joints {', '.join(samples.joint for samples in found)}",
            where=str(path),
            next_step="name one with --joint",
        )
    return replace(found[0], prismatic=False)  # a linear axis is diagnosed like a rotary one, m for rad, N for N m


def samples_of_all(path: Path, columns: ColumnMap | None, joint: str | None = None) -> list[Samples]:
    """Every joint of a recording, or the one (``InputFileError``: unusable, or without a joint)."""
    found = read(path, columns, joint)
    if not found:
        raise InputFileError("no joint in this recording", where=str(path))
    return found


def names_of(paths: Sequence[Path]) -> list[str]:
    """What recordings are called: the file's name without ending, after its folder's where two files have one name."""
    names = [_name_of(path) for path in paths]
    folders = [path.resolve().parent.name for path in paths]
    return [f"{f}/{n}" if names.count(n) > 1 else n for f, n in zip(folders, names, strict=True)]


def _name_of(path: Path) -> str:
    name = path.name
    for ending in (".gz", ".csv", ".txt", ".mat", ".mcap", ".npz", ".parquet", ".h5", ".hdf5", ".bag", ".db3"):
        name = name.removesuffix(ending)
    return name or str(path)


_TIMING = (
    "row k: position sampled at t_k; torque is the value applied since t_(k-1); the command of row k acts from t_k"
)
_CONVENTION = "tau = inertia*acc + gravity_cos*cos(position) + gravity_sin*sin(position) + friction"


def existing_set(folder: Path, robot: str, joint: str) -> Mapping[str, Any] | None:
    """``nominal.yaml`` of a set to add to, None without (``UsageError``: something else, or a set of another joint)."""
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
    """Write logs, then ``nominal.yaml`` that lists them, after ``earlier`` ones; a second ``chirp`` is ``chirp_2``."""
    made_folder(folder)
    listed = list(earlier["experiments"]) if earlier else []
    for experiment, samples in logs:
        # Also a log that no list names: whoever put it there did not ask for another in its place.
        taken = {str(entry["name"]) for entry in listed} | {path.stem for path in folder.glob("*.csv")}
        names = itertools.chain([experiment.name], (f"{experiment.name}_{k}" for k in itertools.count(2)))
        name = next(candidate for candidate in names if candidate not in taken)
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
