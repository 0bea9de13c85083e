"""Finds the bus logs that a person names, what their frames carry, and what the joints did meanwhile."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from frictid_hil.config.robot import Robot
from frictid_hil.config.yaml import read as read_yaml
from frictid_hil.errors import InvalidFields, UsageError
from frictid_hil.protocol.frames import frame_decoders
from frictid_hil.recording.bus_log import LOG_SUFFIXES
from frictid_hil.recording.read import read
from frictid_hil.recording.samples import Mark
from frictid_hil.runs.folder import load_manifest, parts_of

_EDS_SCHEMA = "frictid.frames/1"


@dataclass(frozen=True, slots=True)
class LoggedMotion:
    """One joint's motion in a log.

    Attributes:
        marks: where it is, on the log's own run time; empty where nothing tells.
        late_cycles: late and missed cycles that the live run counted.
    """

    joint: str
    marks: tuple[Mark, ...] = ()
    late_cycles: int = 0


@dataclass(frozen=True, slots=True)
class Log:
    """One bus log with what is known of it.

    Attributes:
        frame_map: which frame carries what.
        identities: what the drives said of themselves, by joint; empty for logs of other origin.
        motions: what the joints did; empty where nothing tells.
    """

    path: Path
    frame_map: Mapping[str, Any]
    identities: Mapping[str, Mapping[str, Any]]
    motions: tuple[LoggedMotion, ...]


def is_log(source: Path) -> bool:
    """A bus log, or a run folder that has one."""
    if source.is_dir():
        return any(source.glob("bus*.blf"))
    return source.name.lower().removesuffix(".gz").endswith(LOG_SUFFIXES)


def given_map(frames: Path | None, eds: Path | None, robot: Robot) -> Mapping[str, Any] | None:
    """The frame map that a person gave, None where none was.

    Raises:
        UsageError: two were given.
        ConfigError: the mapping file is wrong, every problem with its place.
        InputFileError: the EDS file is unreadable, or maps no position.
    """
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
    """The bus logs of a run folder, or the one file, each with its frame map.

    A frame map that a person gave goes before the manifest's.

    Raises:
        UsageError: nothing says which frame carries what.
    """
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
