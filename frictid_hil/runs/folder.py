"""The run folder: everything one run leaves behind, readable after a kill at any moment.

::

    runs/<robot>/<UTC>-<verb>/
        config.yaml       the robot file's values as used
        manifest.json     what was asked and done, by what, when, how it ended; rewritten whole at every step
        samples.mcap      every report of every joint, and the marks
        bus.blf           every frame
        joints/<j>.json   each finished joint's result
        profile.yaml      the profile
        report.html       for a person

A run that is continued gets another part: ``samples-2.mcap`` and ``bus-2.blf``, then ``-3``. No part is ever written to
again. What a folder held before the run is never touched, and only what the run made itself is ever removed.
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import re
from collections.abc import Callable, Mapping
from dataclasses import asdict
from datetime import UTC, datetime
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np

from frictid_hil.config.profile import JointProfile
from frictid_hil.config.provenance import file_sha256, utc_now
from frictid_hil.config.robot import Robot
from frictid_hil.config.write import dump, plain
from frictid_hil.errors import ConfigError, HardwareBusy, UsageError
from frictid_hil.files import could_not_write, made_folders, part_of_path, write_whole
from frictid_hil.recording.samples import Mark, Samples
from frictid_hil.runner.events import Configured, Event, JointRun, Marked, Preflight, Warned
from frictid_hil.runner.ring import Rows
from frictid_hil.runs.keeper import RowKeeper
from frictid_hil.version import __version__

SCHEMA = "frictid.run/1"
_WHERE_RUNS_ARE = "every run tells its folder when it ends; unless --out was given it lies below runs/<robot>/"
_OURS = re.compile(r"(manifest\.json|config\.yaml|profile\.yaml|report\.html|joints|(samples|bus)(-\d+)?\.(mcap|blf))")
_PART = re.compile(r"(?:samples|bus)(?:-(\d+))?\.(?:mcap|blf)")


class RunFolder:
    """One run on disk; made by ``create`` or ``resume``."""

    def __init__(self, path: Path, manifest: dict[str, Any]) -> None:
        self.path = path
        self.manifest = manifest
        self._made: list[Path] = []
        self._lock: int | None = None
        self._keeper: RowKeeper | None = None
        self._part = 0

    @staticmethod
    def create(robot: Robot, verb: str, options: Mapping[str, Any], out: Path | None = None) -> RunFolder:
        """A new folder, ``runs/<robot>/<UTC>-<verb>`` unless told; it may hold other things, but nothing of a run.

        ``UsageError``: it holds a run, or a file of one. ``FrictidError``: no permission, no space; nothing is left.
        """
        manifest: dict[str, Any] = {
            "schema": SCHEMA,
            "verb": verb,
            "robot": robot.name,
            "robot_file": str(robot.path.resolve()),
            "config_sha256": robot.digest,
            "tool_version": __version__,
            "started_utc": utc_now(),
            "ended_utc": None,
            "state": "preflight",
            "outcome": None,
            "options": dict(options),
            "identities": {},
            "sessions": [],
            "warnings": [],
        }
        folder = RunFolder(out or _unused(Path("runs") / robot.name, verb), manifest)
        try:
            folder._claim()
            folder._write("config.yaml", dump(robot.values()))
            folder.save()
        except BaseException:
            folder.withdraw()
            raise
        return folder

    @staticmethod
    def resume(path: Path, robot: Robot) -> RunFolder:
        """A folder to go on with, as it is until ``begin`` (``UsageError``: none, or another's; ``HardwareBusy``)."""
        folder = RunFolder(path, manifest_of(path, robot))
        folder._hold()
        return folder

    # Joints in the order of the driver; ``seen`` is given the rows, once they are kept.
    def add_part(self, joints: list[str], seen: Callable[[Rows], None]) -> RowKeeper:
        """New files beside earlier parts (``FrictidError``: they cannot be made; the folder is as it was)."""
        self._part = max((number for _, number in parts_of(self.path)), default=0) + 1
        suffix = "" if self._part == 1 else f"-{self._part}"
        samples, frames = self.path / f"samples{suffix}.mcap", self.path / f"bus{suffix}.blf"
        meta = {key: self.manifest[key] for key in ("robot", "config_sha256")} | {"started_utc": utc_now()}
        for path in (samples, frames):
            try:
                path.touch(exist_ok=False)
            except OSError as error:
                raise could_not_write(path, error) from error
            self._made.append(path)
        self._keeper = RowKeeper(samples, frames, joints, meta, seen)
        return self._keeper

    def claim_output(self, path: Path) -> None:
        """Make a folder for a result, or see that it takes files; ``FrictidError`` where it does not."""
        self._made += made_folders(path)

    def begin(self) -> None:
        """From here on something may have moved. Nothing is removed any more, whatever happens."""
        self.manifest |= {"state": "measuring", "outcome": None, "ended_utc": None}
        self.save()
        self._made.clear()

    def note(self, event: Event) -> None:
        """Take down what happened; it is in the manifest from ``begin`` on."""
        if isinstance(event, Preflight):
            identities = {name: _finite(asdict(identity)) for name, identity in event.identities.items()}
            self.manifest["identities"] = identities
            if self._keeper is not None:
                self._keeper.identify(identities)
            self.manifest["findings"] = [
                {"severity": f.severity.value, "subject": f.subject, "message": f.message} for f in event.findings
            ]
        elif isinstance(event, Configured):
            # One per part: the drives may have been mapped otherwise in between.
            suffix = "" if self._part == 1 else f"-{self._part}"
            self.manifest.setdefault("frame_maps", {})[f"bus{suffix}.blf"] = event.frame_map
        elif isinstance(event, JointRun):
            self.manifest["sessions"].append({**_finite(asdict(event)), "part": self._part})
        elif isinstance(event, Warned):
            self.manifest["warnings"].append(event.message)
        elif isinstance(event, Marked) and self._keeper is not None:
            self._keeper.mark(event.joint, event.mark)
        if self.manifest["state"] == "measuring" and not isinstance(event, Marked):
            self.save()

    def samples(self, run: JointRun) -> Samples:
        """The moving joint's samples of one session, with its marks."""
        assert self._keeper is not None, "after `add_part`"
        rows = self._keeper.taken(run.joint, run.marks[0].start_ns, run.marks[-1].end_ns)
        identity = self.manifest["identities"][run.joint]
        return samples_from_rows(run.joint, rows, run.marks, identity, self.manifest["robot"])

    def keep_joint(self, joint: str, profile: JointProfile, result: Mapping[str, Any]) -> None:
        """Keep a finished joint, so that a later crash cannot lose it and `--resume` finds it."""
        (self.path / "joints").mkdir(exist_ok=True)
        kept = {"profile": profile.model_dump(mode="json"), "result": result}
        self._write(f"joints/{part_of_path(joint)}.json", json.dumps(kept, indent=1))

    def log_digests(self) -> dict[str, str]:
        """SHA-256 of the recordings, by file name."""
        return {path.name: file_sha256(path) for path, _ in parts_of(self.path)}

    def finish(self, outcome: str, error: Mapping[str, str] | None) -> None:
        """Write how the run ended, and let go of the folder."""
        self.manifest |= {"state": "ended", "ended_utc": utc_now(), "outcome": outcome, "error": error}
        try:
            self.save()
        finally:
            self._release()

    def withdraw(self) -> None:
        """Remove what this run made since ``create``, ``resume`` or ``begin``, and nothing else."""
        for path in reversed(self._made):
            with contextlib.suppress(OSError):  # gone already, or a folder into which somebody has put something
                path.rmdir() if path.is_dir() else path.unlink()
        self._made.clear()
        self._release()

    def save(self) -> None:
        """Write the manifest."""
        self._write("manifest.json", json.dumps(self.manifest, indent=1))

    def _claim(self) -> None:
        """Make the folder, or take one that holds nothing of a run, and keep other processes out of it."""
        self.claim_output(self.path)
        taken = sorted(path.name for path in self.path.iterdir() if _OURS.fullmatch(path.name))
        if "manifest.json" in taken:
            raise UsageError(
                "holds a run already", where=str(self.path), next_step="choose another --out, or continue it (--resume)"
            )
        if taken:
            raise UsageError(
                f"holds {', '.join(taken)}, which the run would overwrite",
                where=str(self.path),
                next_step="choose another --out",
            )
        self._hold()

    def _hold(self) -> None:
        self._lock = os.open(self.path, os.O_RDONLY | os.O_CLOEXEC)
        try:
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            self._release()
            raise HardwareBusy(
                "another process is at work on this run", where=str(self.path), next_step="wait for it to end"
            ) from None
        except OSError:
            pass  # a network file system without locks

    def _release(self) -> None:
        if self._lock is not None:
            os.close(self._lock)
            self._lock = None

    def _write(self, name: str, text: str) -> None:
        path = self.path / name
        new = not path.exists()
        write_whole(path, text)
        if new:
            self._made.append(path)


def load_manifest(path: Path) -> dict[str, Any]:
    """The manifest of a run folder; ``UsageError`` where it is none."""
    try:
        manifest = json.loads((path / "manifest.json").read_text())
    except OSError as error:
        why = "it has no manifest.json" if path.is_dir() else error.strerror
        raise UsageError(f"not a run folder: {why}", where=str(path), next_step=_WHERE_RUNS_ARE) from error
    except ValueError as error:
        raise UsageError(f"not a run folder: its manifest.json cannot be read: {error}", where=str(path)) from error
    if not isinstance(manifest, dict) or manifest.get("schema") != SCHEMA:
        raise UsageError(f"not a run of schema {SCHEMA}", where=str(path))
    return manifest


def manifest_of(path: Path, robot: Robot) -> dict[str, Any]:
    """The manifest of a run that shall be continued; ``UsageError`` where it is none, or of another configuration."""
    manifest = load_manifest(path)
    if manifest["config_sha256"] != robot.digest:
        raise UsageError(
            "the robot file has changed since this run began",
            where=str(path),
            next_step="start a new run, or restore the robot file (the run's own copy is config.yaml)",
        )
    return manifest


def kept_joints(run: Path) -> dict[str, tuple[JointProfile, dict[str, Any]]]:
    """Finished joints of a run, each with its result; ``ConfigError`` where a file among them is something else."""
    kept = {}
    for path in sorted((run / "joints").glob("*.json")):
        try:
            values = json.loads(path.read_text())
            kept[path.stem] = (JointProfile.model_validate(values["profile"]), values["result"])
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise ConfigError(f"not a finished joint of a run: {error}", where=str(path)) from error
    return kept


def parts_of(folder: Path) -> list[tuple[Path, int]]:
    """Recordings of a run, each with the number of its part, in the order in which they were made."""
    found = [(path, int(match[1] or 1)) for path in folder.iterdir() if (match := _PART.fullmatch(path.name))]
    return sorted(found, key=lambda part: (part[1], part[0].name))


def samples_from_rows(
    joint: str, rows: Rows, marks: tuple[Mark, ...], identity: Mapping[str, Any], robot: str
) -> Samples:
    """Rows of ``ring.SAMPLE_ROW`` of one joint as samples, with what its drive says of itself as meta."""
    known = ["position_rad", "velocity_rad_s", "torque_nm", "position_command_rad"]
    known += [name for name in ("external_torque_nm", "temperature_c") if np.isfinite(rows[name]).any()]
    columns: dict[str, Any] = {name: rows[name].copy() for name in known}
    return Samples(joint=joint, time_ns=rows["t_ns"].copy(), marks=marks, meta={"robot": robot, **identity}, **columns)


def _finite(value: Any) -> Any:
    """Plain values with None for what is not a finite number."""
    if isinstance(value, float) and not np.isfinite(value):
        return None
    if isinstance(value, Mapping):
        return {str(key): _finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    return plain(value)


def _unused(parent: Path, verb: str) -> Path:
    name = f"{datetime.now(UTC):%Y%m%dT%H%M%SZ}-{verb}"
    return next(path for k in count(1) if not (path := parent / (name if k == 1 else f"{name}-{k}")).exists())
