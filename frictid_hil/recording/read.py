"""Whatever a person hands us: the right reader for a file or a run folder."""

from __future__ import annotations

from pathlib import Path

from frictid_hil.columns import ColumnMap
from frictid_hil.errors import InputFileError
from frictid_hil.recording.bus_log import LOG_SUFFIXES
from frictid_hil.recording.csv import read_csv
from frictid_hil.recording.mat import read_mat
from frictid_hil.recording.mcap_reader import read_mcap
from frictid_hil.recording.samples import Samples


def read(path: str | Path, columns: ColumnMap | None = None, joint: str | None = None) -> list[Samples]:
    """The samples in a recording, one entry per joint.

    Args:
        path: run folder, ``.mcap``, ``.csv``, ``.csv.gz`` or ``.mat``.
        columns: which column is which, for CSV and .mat of other tools.
        joint: the only one wanted; the name of the joint where the file does not tell.

    Raises:
        InputFileError: unreadable, unusable, of an unknown kind, or without that joint.
    """
    path = Path(path)
    if path.is_dir():
        return _run_folder(path, joint)
    name = path.name.lower()
    if name.endswith((".csv", ".csv.gz", ".txt", ".txt.gz")):
        return read_csv(path, columns, joint)
    if name.endswith(".mat"):
        return read_mat(path, columns, joint)
    if columns is not None:
        raise InputFileError("a column map is for CSV and .mat files", where=str(path))
    if name.endswith(".mcap"):
        return read_mcap(path, joint)
    if name.endswith(LOG_SUFFIXES):
        raise InputFileError(
            "a bus log holds frames, not samples",
            where=str(path),
            next_step="give the robot whose drives sent them with --robot, so that they can be decoded",
        )
    if not path.exists():
        raise InputFileError("no such file", where=str(path))
    raise InputFileError(
        "not a recording of a known kind", where=str(path), cause="read are .mcap, .csv, .csv.gz, .mat and bus logs"
    )


def _run_folder(path: Path, joint: str | None) -> list[Samples]:
    """A run that was resumed has several files; each joint is taken from the last one in which it moved."""
    files = sorted(path.glob("samples*.mcap"), key=lambda file: (len(file.name), file.name))
    if not files:
        raise InputFileError("no samples.mcap in this folder", where=str(path), cause="not a run folder")
    newest: dict[str, Samples] = {}
    for file in files:
        for samples in read_mcap(file):
            if samples.marks or samples.joint not in newest:
                newest[samples.joint] = samples
    if joint is not None and joint not in newest:
        raise InputFileError(f"no samples of joint {joint!r}; it has {', '.join(newest)}", where=str(path))
    return [samples for name, samples in newest.items() if joint in (None, name)]
