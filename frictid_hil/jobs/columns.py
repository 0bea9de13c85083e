"""``frictid-hil columns``: look at a log and draft the column map that reads it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from frictid_hil.config.columns import load_columns
from frictid_hil.config.write import dump
from frictid_hil.errors import FrictidError
from frictid_hil.files import refuse_overwriting, write_whole
from frictid_hil.recording.draft import draft
from frictid_hil.recording.mcap_reader import is_ours
from frictid_hil.recording.read import open_table, read
from frictid_hil.recording.samples import Samples


def columns(log: Path, *, columns: str | None = None, out: Path | None = None, force: bool = False) -> dict[str, Any]:
    """Show what a log holds; the map ``columns`` is tried on it, or one is drafted, into ``out``.

    ``InputFileError``: unreadable, or no column is like a position. ``UsageError``: ``out`` exists.
    """
    known = load_columns(columns) if columns else None
    run = log.is_dir() and any(log.glob("samples*.mcap"))
    ours = run or (log.suffix.lower() == ".mcap" and is_ours(log) is True)
    table = None if ours else open_table(log, known.topic if known else None)
    result: dict[str, Any] = {"outcome": "ok", "log": str(log.resolve()), "columns": list(table.names) if table else []}
    if known is not None or table is None or table.standard is not None:
        joints = read(log, known)
        result |= {"map": None, "findings": list(table.told) if table else [], "joints": _told(joints)}
        return result
    found = draft(table, log.name.split(".")[0] or "log")
    text = _TITLE + "".join(f"# {line}\n" for line in found.findings) + dump(dict(found.document))
    result |= {"map": text, "findings": list(found.findings), "left_out": list(found.left_out), "joints": {}}
    if out is not None:
        refuse_overwriting([out], force=force)
        write_whole(out, text)
        result["written"] = str(out.resolve())
        try:
            result["joints"] = _told(read(log, load_columns(out)))
        except FrictidError as error:
            result["findings"].append(f"with this map: {error}" + (f" ({error.cause})" if error.cause else ""))
    return result


_TITLE = "# Drafted by `frictid-hil columns`; correct what is wrong, then use it with --columns.\n"


def _told(joints: list[Samples]) -> dict[str, Any]:
    """Describe each joint by a few figures that a person can recognise."""
    return {
        samples.joint: {
            "rows": len(samples),
            "duration_s": float(samples.time_s[-1] - samples.time_s[0]),
            "rate_hz": 1.0 / samples.step_s,
            "columns": list(samples.columns()),
            "travel": float(samples.position_rad.max() - samples.position_rad.min()),
            "prismatic": samples.prismatic,
            "told": list(samples.meta.get("told", ())),
            "doubts": list(samples.meta.get("doubts", ())),
        }
        for samples in joints
    }
