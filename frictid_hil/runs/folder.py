"""The run folder: everything one run leaves behind, readable after a kill at any moment.

::

    runs/<robot>/<UTC>-<verb>/
        config.yaml       the robot file's values as used
        manifest.json     what was done, by what, when, how it ended; rewritten whole at every step
        samples.mcap      every report of every joint, and the marks
        bus.blf           every frame
        joints/<j>.json   each finished joint's result
        profile.yaml      the profile
        report.html       for a person
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

import frictid_hil
from frictid_hil.config.profile import FrictionProfile, JointProfile
from frictid_hil.config.provenance import file_sha256, utc_now
from frictid_hil.config.robot import Robot
from frictid_hil.config.write import dump, plain
from frictid_hil.errors import ConfigError, FrictidError, UsageError
from frictid_hil.files import write_whole
from frictid_hil.plan.setup import RobotSetup
from frictid_hil.recording.bus_log import BusLogWriter
from frictid_hil.recording.mcap import SampleWriter
from frictid_hil.recording.samples import Mark, Samples
from frictid_hil.runner.events import Configured, Event, JointRun, Marked, Preflight, Warned
from frictid_hil.runner.ring import Rows

SCHEMA = "frictid.run/1"
_FLUSH_S = 0.25
_WHERE_RUNS_ARE = "every run tells its folder when it ends; unless --out was given it lies below runs/<robot>/"


class RowKeeper:
    """Writes rows as they come and remembers them for the identification.

    Args:
        samples: file of samples.
        frames: file of frames.
        joints: names, order of the driver.
        seen: given the rows, once they are kept.
    """

    def __init__(
        self, samples: SampleWriter, frames: BusLogWriter, joints: list[str], seen: Callable[[Rows], None]
    ) -> None:
        self._samples = samples
        self._frames = frames
        self._joints = joints
        self._seen = seen
        self._kept: list[Rows] = []
        self._flushed_at = time.monotonic()
        self.rows = 0

    def samples(self, rows: Rows) -> None:
        """Keep and write rows of ``ring.SAMPLE_ROW``."""
        self.rows += int(rows.size)
        self._kept.append(rows)
        for index in np.unique(rows["joint"]):
            self._samples.append(self._joints[int(index)], rows[rows["joint"] == index])
        self._seen(rows)
        self._flush()

    def frames(self, rows: Rows) -> None:
        """Write rows of ``ring.FRAME_ROW``."""
        self._frames.append(rows)
        self._flush()

    def mark(self, joint: str, mark: Mark) -> None:
        """Write a mark."""
        self._samples.mark(joint, mark)

    def identify(self, identities: Mapping[str, Mapping[str, Any]]) -> None:
        """Write what each drive says of itself into the recording."""
        for joint, identity in identities.items():
            self._samples.metadata(f"joint/{joint}", identity)

    def taken(self, joint: int, start_ns: int, end_ns: int) -> Rows:
        """One joint's rows in a stretch of run time; everything older than its start is forgotten.

        Joints that moved together are taken one after the other from the same stretch.
        """
        every = np.concatenate(self._kept) if self._kept else np.empty(0, dtype=[("joint", "<u2"), ("t_ns", "<i8")])
        self._kept = [every[every["t_ns"] >= start_ns]]
        mine = (every["joint"] == joint) & (every["t_ns"] >= start_ns) & (every["t_ns"] < end_ns)
        taken: Rows = every[mine]
        return taken

    def close(self) -> None:
        """Finish both files."""
        self._samples.close()
        self._frames.close()

    def _flush(self) -> None:
        now = time.monotonic()
        if now - self._flushed_at >= _FLUSH_S:
            self._samples.flush()
            self._frames.flush()
            self._flushed_at = now


class RunFolder:
    """One run on disk; made by ``create`` or ``resume``."""

    def __init__(self, path: Path, robot: Robot, manifest: dict[str, Any]) -> None:
        self.path = path
        self._robot = robot
        self.manifest = manifest
        self._keeper: RowKeeper | None = None
        self._joints: list[str] = []
        self._bus_log = ""

    @staticmethod
    def create(robot: Robot, verb: str, out: Path | None = None) -> RunFolder:
        """A new folder, ``runs/<robot>/<UTC>-<verb>`` unless told.

        Raises:
            UsageError: ``out`` holds a run already.
            FrictidError: no permission, or no space.
        """
        path = out or _unused(Path("runs") / robot.name, f"{datetime.now(UTC):%Y%m%dT%H%M%SZ}-{verb}")
        if (path / "manifest.json").exists():
            raise UsageError(
                "holds a run already", where=str(path), next_step="choose another --out, or continue it with --resume"
            )
        try:
            (path / "joints").mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise FrictidError(f"cannot be created: {error.strerror}", where=str(path)) from error
        manifest: dict[str, Any] = {
            "schema": SCHEMA,
            "verb": verb,
            "robot": robot.name,
            "robot_file": str(robot.path.resolve()),
            "config_sha256": robot.digest,
            "tool_version": frictid_hil.__version__,
            "started_utc": utc_now(),
            "ended_utc": None,
            "outcome": None,
            "identities": {},
            "sessions": [],
            "warnings": [],
        }
        folder = RunFolder(path, robot, manifest)
        values = {key: value for key, value in robot.document.data.items() if key != "extends"}
        write_whole(path / "config.yaml", dump(values))
        folder._save()
        return folder

    @staticmethod
    def resume(path: Path, robot: Robot) -> RunFolder:
        """A folder of an earlier run, to be continued.

        Raises:
            UsageError: not a run folder, or of another configuration.
        """
        manifest = load_manifest(path)
        if manifest["config_sha256"] != robot.digest:
            raise UsageError(
                "the robot file has changed since this run began",
                where=str(path),
                next_step="start a new run, or restore the robot file (the run's own copy is config.yaml)",
            )
        return RunFolder(path, robot, manifest)

    @contextmanager
    def keeping(self, setup: RobotSetup, seen: Callable[[Rows], None]) -> Iterator[RowKeeper]:
        """The files of a run, closed whatever happens."""
        self._joints = [joint.name for joint in setup.joints]
        part = len(self.manifest["sessions"])
        suffix = f"-{part}" if part else ""
        meta = {"robot": self._robot.name, "config_sha256": self._robot.digest, "started_utc": utc_now()}
        self._bus_log = f"bus{suffix}.blf"
        keeper = RowKeeper(
            SampleWriter(self.path / f"samples{suffix}.mcap", self._joints, meta),
            BusLogWriter(self.path / self._bus_log),
            self._joints,
            seen,
        )
        self._keeper = keeper
        try:
            yield keeper
        finally:
            keeper.close()

    def note(self, event: Event) -> None:
        """Write what happened into the manifest."""
        if isinstance(event, Preflight):
            identities = {name: _finite(asdict(identity)) for name, identity in event.identities.items()}
            self.manifest["identities"] = identities
            if self._keeper is not None:
                self._keeper.identify(identities)
            self.manifest["findings"] = [
                {"severity": f.severity.value, "subject": f.subject, "message": f.message} for f in event.findings
            ]
        elif isinstance(event, Configured):
            # One per part of a resumed run: the drives may have been mapped otherwise in between.
            self.manifest.setdefault("frame_maps", {})[self._bus_log] = event.frame_map
        elif isinstance(event, JointRun):
            self.manifest["sessions"].append(_finite(asdict(event)))
        elif isinstance(event, Warned):
            self.manifest["warnings"].append(event.message)
        else:
            if isinstance(event, Marked) and self._keeper is not None:
                self._keeper.mark(event.joint, event.mark)
            return
        self._save()

    def samples(self, run: JointRun) -> Samples:
        """The moving joint's samples of one session, with its marks."""
        assert self._keeper is not None, "inside `keeping`"
        start_ns, end_ns = run.marks[0].start_ns, run.marks[-1].end_ns
        rows = self._keeper.taken(self._joints.index(run.joint), start_ns, end_ns)
        identity = self.manifest["identities"][run.joint]
        return samples_from_rows(run.joint, rows, run.marks, identity, self._robot.name)

    def keep_joint(self, joint: str, profile: JointProfile, result: Mapping[str, Any]) -> None:
        """Keep a finished joint, so that a later crash cannot lose it and `--resume` finds it."""
        write_whole(
            self.path / "joints" / f"{joint}.json",
            json.dumps({"profile": profile.model_dump(mode="json"), "result": result}, indent=1),
        )

    def kept_joints(self) -> dict[str, tuple[JointProfile, dict[str, Any]]]:
        """Finished joints of this folder."""
        kept = {}
        for path in sorted((self.path / "joints").glob("*.json")):
            try:
                values = json.loads(path.read_text())
                kept[path.stem] = (JointProfile.model_validate(values["profile"]), values["result"])
            except (ValueError, KeyError, TypeError) as error:
                raise ConfigError(f"not a finished joint of a run: {error}", where=str(path)) from error
        return kept

    def write_profile(self, profile: FrictionProfile) -> Path:
        """Write ``profile.yaml``."""
        path = self.path / "profile.yaml"
        profile.save(path)
        return path

    def log_digests(self) -> dict[str, str]:
        """SHA-256 of the recordings, by file name."""
        return {
            path.name: file_sha256(path)
            for path in sorted(self.path.iterdir())
            if path.suffix in (".mcap", ".blf", ".asc")
        }

    def compared_with(self, profile: Path | None) -> None:
        """Note the profile that was in force, so that the page can be written again as it was."""
        self.manifest["active_profile"] = None if profile is None else str(profile)

    def finish(self, result: Mapping[str, Any]) -> None:
        """Write how the run ended."""
        self.manifest["ended_utc"] = utc_now()
        self.manifest["outcome"] = result["outcome"]
        self.manifest["error"] = result.get("error")
        self._save()

    def discard(self) -> None:
        """Remove a folder in which nothing was measured."""
        for path in sorted(self.path.rglob("*"), reverse=True):
            path.rmdir() if path.is_dir() else path.unlink()
        self.path.rmdir()

    def _save(self) -> None:
        write_whole(self.path / "manifest.json", json.dumps(self.manifest, indent=1))


def load_manifest(path: Path) -> dict[str, Any]:
    """The manifest of a run folder.

    Raises:
        UsageError: not a run folder.
    """
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


def samples_from_rows(
    joint: str, rows: Rows, marks: tuple[Mark, ...], identity: Mapping[str, Any], robot: str
) -> Samples:
    """Rows of ``ring.SAMPLE_ROW`` of one joint as samples, with what its drive says of itself as meta."""

    def optional(name: str) -> Any:
        column = rows[name]
        return column.copy() if np.isfinite(column).any() else None

    return Samples(
        joint=joint,
        time_ns=rows["t_ns"].copy(),
        position_rad=rows["position_rad"].copy(),
        velocity_rad_s=rows["velocity_rad_s"].copy(),
        torque_nm=rows["torque_nm"].copy(),
        position_command_rad=rows["position_command_rad"].copy(),
        external_torque_nm=optional("external_torque_nm"),
        temperature_c=optional("temperature_c"),
        marks=marks,
        meta={"robot": robot, **identity},
    )


def _finite(value: Any) -> Any:
    """Plain values with None for what is not a finite number."""
    if isinstance(value, float) and not np.isfinite(value):
        return None
    if isinstance(value, Mapping):
        return {str(key): _finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    return plain(value)


def _unused(parent: Path, name: str) -> Path:
    path, k = parent / name, 1
    while path.exists():
        k += 1
        path = parent / f"{name}-{k}"
    return path
