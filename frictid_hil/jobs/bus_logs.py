"""Bus logs that a person names, as the samples that a live run would have kept, and an account of what they lack."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from operator import attrgetter
from pathlib import Path
from typing import Any

import can
import numpy as np
from numpy.typing import NDArray

from frictid_hil.config.profile import JudgedGate
from frictid_hil.config.robot import Robot
from frictid_hil.config.yaml import read as read_yaml
from frictid_hil.errors import InputFileError, InvalidFields, UsageError
from frictid_hil.protocol.frames import LoggedFrame, frame_decoders, joint_names
from frictid_hil.recording.bus_log import LOG_SUFFIXES, Frames, LogBus, read_frames
from frictid_hil.recording.read import read
from frictid_hil.recording.samples import Mark, Samples
from frictid_hil.runner.ring import SAMPLE_ROW, Rows
from frictid_hil.runs.folder import load_manifest, parts_of, samples_from_rows

_EDS_SCHEMA = "frictid.frames/1"


@dataclass(frozen=True, slots=True)
class LoggedMotion:
    """One joint's motion in a log."""

    joint: str
    marks: tuple[Mark, ...] = ()  # where it is, on the log's own run time; empty where nothing tells
    late_cycles: int = 0  # late and missed cycles that the live run counted


@dataclass(frozen=True, slots=True)
class Log:
    """One bus log with what is known of it."""

    path: Path
    frame_map: Mapping[str, Any]  # which frame carries what
    # What the drives said of themselves, by joint; empty for logs of other origin.
    identities: Mapping[str, Mapping[str, Any]]
    motions: tuple[LoggedMotion, ...]  # what the joints did; empty where nothing tells


def is_log(source: Path) -> bool:
    """A bus log, or a run folder that has one."""
    if source.is_dir():
        return any(source.glob("bus*.blf"))
    return source.name.lower().removesuffix(".gz").endswith(LOG_SUFFIXES)


def given_map(frames: Path | None, eds: Path | None, robot: Robot) -> Mapping[str, Any] | None:
    """The frame map that a person gave, or None (``UsageError``: two; ``ConfigError``, ``InputFileError``: wrong)."""
    if frames is not None and eds is not None:
        raise UsageError("--frames and --eds both say which frame is what; give one")
    if eds is not None:
        # The robot as its CAN drives know it, whatever bus its file names.
        return frame_decoders(_EDS_SCHEMA).map_from_eds(eds, robot.to_setup("socketcan:log"))
    if frames is None:
        return None
    document = read_yaml(frames)
    try:
        frame_decoders(str(document.data.get("schema"))).decoder(document.data)
    except InvalidFields as invalid:
        raise document.error(invalid.problems) from None
    return document.data


def logs_of(source: Path, given: Mapping[str, Any] | None) -> list[Log]:
    """Each bus log of a run folder, or the one file; a given map goes first (``UsageError``: there is no map)."""
    folder = source if source.is_dir() else source.parent
    manifest = load_manifest(folder) if (folder / "manifest.json").exists() else None
    logs = []
    for path in [part for part, _ in parts_of(folder) if part.suffix == ".blf"] if source.is_dir() else [source]:
        frame_map = given
        if frame_map is None and manifest is not None:
            frame_map = manifest.get("frame_maps", {}).get(path.name)
        if frame_map is None:
            raise UsageError(
                "nothing says which frame carries what",
                where=str(path),
                cause="a log of other origin, or of a run whose drives were never configured",
                next_step="give --eds with the drives' EDS or DCF file, or --frames with a mapping file",
            )
        motions = _motions(manifest, folder, path.name) if manifest is not None else ()
        logs.append(Log(path, frame_map, (manifest or {}).get("identities", {}), motions))
    return logs


def _motions(manifest: Mapping[str, Any], folder: Path, log: str) -> tuple[LoggedMotion, ...]:
    """What a run did during one of its logs; where it was cut off, what its samples say."""
    parts = parts_of(folder)
    part = next((number for path, number in parts if path.name == log), None)
    motions = [
        LoggedMotion(
            session["joint"],
            tuple(Mark(**mark) for mark in session["marks"]),
            session["late_cycles"] + session["missed_cycles"],
        )
        for session in manifest["sessions"]
        if session["part"] == part
    ]
    finished = {motion.joint for motion in motions}
    samples = folder / log.replace("bus", "samples").replace(".blf", ".mcap")
    last = part is not None and part == parts[-1][1]
    if last and manifest.get("outcome") != "ok" and samples.exists():
        motions += [
            LoggedMotion(one.joint, one.marks) for one in read(samples) if one.marks and one.joint not in finished
        ]
    return tuple(motions)


MOST_LOST_PERCENT = 5.0  # a joint that lacks more of its rows than this is not trusted


_MOTION = attrgetter("t_ns", "position_rad", "velocity_rad_s", "torque_nm", "position_command_rad")
_STATE = attrgetter("external_torque_nm", "temperature_c", "status_raw")
"""Columns of ``ring.SAMPLE_ROW`` that a report has, in order; between and after them are those that it has not."""


@dataclass(slots=True)
class Account:
    """What a log holds besides rows, and what it lacks."""

    frames: int = 0
    rows: int = 0
    unknown: dict[str, int] = field(default_factory=dict)  # frames that nothing describes, by name
    services: dict[str, int] = field(default_factory=dict)  # frames around the cycles, by name
    repeated: int = 0  # reports that came twice in a row
    backwards: int = 0  # frames that stood before an earlier one in the log; they were put back by their time
    skipped: int = 0  # error and remote frames
    lost_rows: dict[str, int] = field(default_factory=dict)  # rows that a joint lacks during its own motion, by joint
    lost_percent: dict[str, float] = field(default_factory=dict)  # the same in percent of what should be there
    damage: str = ""  # where the log ends before its end

    def take(self, samples: Samples) -> None:
        """Count what one joint lacks."""
        lost, percent = lost_rows(samples.time_ns)
        self.lost_rows[samples.joint] = self.lost_rows.get(samples.joint, 0) + lost
        self.lost_percent[samples.joint] = max(self.lost_percent.get(samples.joint, 0.0), percent)

    def gate(self, joint: str) -> JudgedGate | None:
        """What a profile must say of this joint's log; None for a whole one."""
        lost, percent = self.lost_rows.get(joint, 0), self.lost_percent.get(joint, 0.0)
        if not lost:
            return None
        message = f"{lost} rows ({percent:.2g} %) are missing from the log"
        passed = percent <= MOST_LOST_PERCENT
        then = "the others were used" if passed else f"up to {MOST_LOST_PERCENT:g} % are tolerated"
        return JudgedGate(name="log", passed=passed, message=f"{message}; {then}")


def lost_rows(time_ns: NDArray[np.int64]) -> tuple[int, float]:
    """How many rows of an evenly sampled recording are missing, and percent of what should be there."""
    if time_ns.size < 3:
        return 0, 0.0
    steps = np.diff(time_ns)
    period_ns = float(np.median(steps))
    lost = int(np.sum(np.maximum(0, np.round(steps / period_ns).astype(np.int64) - 1)))
    return lost, 100.0 * lost / (time_ns.size + lost)


def ordered(frames: Frames) -> tuple[Frames, int]:
    """The frames in the order of their times, and how many stood before an earlier one."""
    backwards = int(np.count_nonzero(np.diff(frames.t_ns) < 0))
    if not backwards:
        return frames, 0
    order = np.argsort(frames.t_ns, kind="stable")
    columns = ("t_ns", "can_id", "length", "data", "sent")
    return replace(frames, **{name: getattr(frames, name)[order] for name in columns}), backwards


def rows_by_joint(
    frames: Iterable[LoggedFrame],
    frame_map: Mapping[str, Any],
    account: Account,  # counts are added to it
    at: Callable[[int], None] = lambda _: None,  # told the run time of rows as they come, ns
) -> dict[str, Rows]:
    """Every report as a row of ``ring.SAMPLE_ROW``, as kept live, by joint (``InvalidFields``: a wrong frame map)."""
    names = joint_names(frame_map)
    kept: list[list[tuple[Any, ...]]] = [[] for _ in names]
    decoder = frame_decoders(str(frame_map.get("schema"))).decoder(frame_map)
    for row in decoder.rows(frames):
        account.rows += 1
        if account.rows % 1024 == 0:
            at(row.t_ns)
        for report, mine in zip(row.feedback, kept, strict=True):
            if report.age_cycles == 0 and report.valid:
                mine.append((*_MOTION(report), 0.0, *_STATE(report), 0, report.error_code))
    for counted, more in ((account.unknown, decoder.unknown), (account.services, decoder.services)):
        for name, count in more.items():
            counted[name] = counted.get(name, 0) + count
    account.repeated += decoder.repeated
    account.backwards += decoder.backwards
    return {name: _increasing(np.array(mine, dtype=SAMPLE_ROW)) for name, mine in zip(names, kept, strict=True)}


def samples_of(
    joint: str, rows: Rows, marks: tuple[Mark, ...], identity: Mapping[str, Any], robot: str, account: Account
) -> Samples:
    """One joint's samples during its own motion (all of them, where no marks tell), counted in the account."""
    if marks:
        rows = rows[(rows["t_ns"] >= marks[0].start_ns) & (rows["t_ns"] < marks[-1].end_ns)]
    samples = samples_from_rows(joint, rows, marks, identity, robot)
    # Before its first command a joint has none, and a log of other origin may carry none at all.
    columns = ("velocity_rad_s", "torque_nm", "position_command_rad")
    filled: dict[str, Any] = {name: _filled(getattr(samples, name)) for name in columns}
    samples = replace(samples, **filled)
    account.take(samples)
    return samples


def _increasing(rows: Rows) -> Rows:
    """Rows with a time after all before them; a damaged log may hold others."""
    if rows.size < 2:
        return rows
    highest = np.maximum.accumulate(rows["t_ns"])
    kept: Rows = rows[np.concatenate([[True], rows["t_ns"][1:] > highest[:-1]])]
    return kept


def _filled(column: NDArray[np.floating[Any]] | None) -> NDArray[np.floating[Any]] | None:
    """The nearest value after, or before, what is missing; None where all is."""
    if column is None or np.isfinite(column).all():
        return column
    good = np.flatnonzero(np.isfinite(column))
    if not good.size:
        return None
    return np.asarray(column[good[np.clip(np.searchsorted(good, np.arange(column.size)), 0, good.size - 1)]])


def samples_in(
    logs: Sequence[Log],  # of one run
    robot: str,
    account: Account,  # counts are added to it
    *,
    joints: Collection[str] = (),  # all when empty
    paced: bool = False,
    echo: can.BusABC | None = None,  # every frame is sent again there
    at: Callable[[float], None] = lambda _: None,  # told the time since the start of a log, s, as rows come
) -> dict[str, Samples]:
    """Samples of the joints that moved, each of the last log in which it did (``InputFileError``: of none)."""
    newest: dict[str, Samples] = {}
    for log in logs:
        frames = read_frames(log.path)
        account.frames += len(frames)
        account.skipped += frames.skipped
        account.damage = account.damage or frames.damage
        frames, backwards = ordered(frames)
        account.backwards += backwards
        began_ns = int(frames.t_ns[0])
        with LogBus(frames, paced=paced, echo=echo) as bus:
            rows = rows_by_joint(iter(bus.take, None), log.frame_map, account, partial(_tell, at, began_ns))
        for motion in log.motions or [LoggedMotion(name) for name in rows]:
            if motion.joint in rows and (not joints or motion.joint in joints):
                identity = log.identities.get(motion.joint, {})
                samples = samples_of(motion.joint, rows[motion.joint], motion.marks, identity, robot, account)
                if len(samples) >= 2:
                    newest[motion.joint] = samples
    if not newest:
        most = ", ".join(f"{count} x {name}" for name, count in Counter(account.unknown).most_common(5))
        raise InputFileError(
            "no report of a joint could be decoded",
            where=", ".join(str(log.path) for log in logs),
            cause=f"frames that nothing describes: {most}" if most else "",
            next_step="say which frame is what with `frictid-hil replay --frames` or `--eds`",
        )
    return newest


def _tell(at: Callable[[float], None], began_ns: int, t_ns: int) -> None:
    at((t_ns - began_ns) * 1e-9)
