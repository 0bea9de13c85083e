"""Whatever a person hands us: the right reader for a file, a data set or a run folder."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from frictid_hil.columns import ColumnMap
from frictid_hil.errors import InputFileError
from frictid_hil.recording import array_files
from frictid_hil.recording.bus_log import LOG_SUFFIXES
from frictid_hil.recording.csv import CsvTable, read_csv
from frictid_hil.recording.mat import open_mat
from frictid_hil.recording.mcap_reader import NO_SAMPLES, is_ours, read_mcap
from frictid_hil.recording.ros import is_bag, open_bag
from frictid_hil.recording.samples import Samples
from frictid_hil.recording.table import Table, mapped, own_names

_TABLES: dict[tuple[str, ...], Callable[[Path], Table]] = {
    (".csv", ".csv.gz", ".txt", ".txt.gz", ".tsv", ".tsv.gz"): CsvTable,
    (".mat",): open_mat,
    (".npz",): array_files.open_npz,
    (".h5", ".hdf5"): array_files.open_hdf5,
    (".parquet",): array_files.open_parquet,
    (".json",): array_files.open_bam,
    (".pt",): array_files.open_pace,
    (".mcap", ".bag", ".db3"): open_bag,
}
READABLE = tuple(suffix for suffixes in _TABLES for suffix in suffixes)  # how the names of recordings end


def read(
    path: str | Path,  # run folder, MCAP, CSV, .mat, npz, HDF5, parquet, ROS bag, LeRobot dataset, of BAM or PACE
    columns: ColumnMap | None = None,  # which column is which, for files of other tools
    joint: str | None = None,  # the only one wanted; the name of the joint where the file does not tell
) -> list[Samples]:
    """The samples in a recording, one entry per joint.

    ``InputFileError``: unreadable, unusable, of an unknown kind, or without that joint.
    """
    path = Path(path)
    if path.is_dir() and not array_files.is_lerobot(path) and not is_bag(path):
        return _run_folder(path, joint)
    if path.name.lower().endswith(".mcap") and columns is None:
        ours = is_ours(path)
        try:
            if ours is not False:
                return read_mcap(path, joint)
        except InputFileError as error:
            if ours or not error.what.startswith(NO_SAMPLES):
                raise
    if columns is None and path.name.lower().endswith(next(iter(_TABLES))):
        return read_csv(path, None, joint)
    table = open_table(path, None if columns is None else columns.topic)
    known = columns or table.standard
    if known is None:
        return mapped(open_table, table, own_names(table, joint or "0"))
    return mapped(open_table, table, known, joint)


def open_table(path: Path, topic: str | None = None) -> Table:
    """The named columns of a file, folder or data set of other tools; ``topic`` is of a ROS bag that has several.

    What is unreadable, or of an unknown kind, is an ``InputFileError``.
    """
    name = path.name.lower()
    if not path.exists() and not name.endswith(LOG_SUFFIXES):
        raise InputFileError("cannot be read: no such file", where=str(path))
    if array_files.is_lerobot(path):
        return array_files.open_lerobot(path)
    if is_bag(path) or name.endswith((".mcap", ".db3")):
        return open_bag(path, topic)
    for suffixes, opener in _TABLES.items():
        if name.endswith(suffixes):
            return opener(path)
    if name.endswith(LOG_SUFFIXES):
        raise InputFileError(
            "a bus log holds frames, not samples",
            where=str(path),
            next_step="give the robot whose drives sent them with --robot, so that they can be decoded",
        )
    raise InputFileError(
        "not a recording of a known kind", where=str(path), cause=f"read are {', '.join(READABLE)} and bus logs"
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
