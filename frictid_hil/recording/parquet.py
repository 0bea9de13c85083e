"""Parquet tables, and LeRobot datasets (a folder with ``meta/info.json`` and parquet files, one or more episodes each).

A LeRobot dataset's lists are named by the names of its ``info.json`` (``observation.state/shoulder_pan.pos``). It does
not say their unit, and its time is made up from the frame rate: both are told.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from frictid_hil.errors import InputFileError
from frictid_hil.recording.arrays import ArrayTable, is_usable, refusing
from frictid_hil.recording.bounds import check_expansion, check_rows

_PAUSE_S = 1.0
"""Between episodes, whose times all begin at zero."""


def open_parquet(path: Path) -> ArrayTable:
    """The columns of a parquet file; lists of equal length are matrices.

    Raises:
        InputFileError: unreadable, too large, or pyarrow is not installed.
    """
    return ArrayTable.of(path, _columns(path))


def is_lerobot(path: Path) -> bool:
    """A folder that holds such a dataset."""
    return (path / "meta" / "info.json").is_file()


def open_lerobot(path: Path) -> ArrayTable:
    """All episodes of a dataset, one after the other on one clock, a second apart.

    Raises:
        InputFileError: unreadable, or without data.
    """
    with refusing(path, "LeRobot dataset"):
        info = json.loads((path / "meta" / "info.json").read_text(encoding="utf-8"))
        labels = {name: _flat(feature.get("names")) for name, feature in info["features"].items()}
        rate_hz = float(info["fps"])
    files = sorted((path / "data").rglob("*.parquet"))
    if not files:
        raise InputFileError("holds no data", where=str(path / "data"))
    parts = [_columns(file) for file in files]
    shared = [name for name in parts[0] if all(name in part for part in parts)]
    values = {name: np.concatenate([part[name] for part in parts]) for name in shared}
    rows = len(values[shared[0]])
    check_rows(rows, str(path))
    frame = values.get("frame_index", np.arange(rows)).astype(np.float64)
    begins = np.concatenate([[False], np.diff(frame) <= 0])
    lengths = np.where(begins, np.concatenate([[0.0], frame[:-1] + _PAUSE_S * rate_hz]), 0.0)
    values["time"] = (frame + np.cumsum(lengths)) / rate_hz
    told = [f"times are frame numbers over {rate_hz:g} Hz: jitter and missed frames cannot be seen"]
    if episodes := int(np.count_nonzero(begins)):
        told.append(f"{episodes + 1} episodes, put one after the other with a second between them")
    return ArrayTable.of(path, values, labels=labels, told=tuple(told))


def _flat(names: Any) -> Sequence[str]:
    """The names of a feature: a list, or a mapping that holds one."""
    if isinstance(names, Mapping):
        names = next(iter(names.values()), [])
    return [str(name) for name in names] if isinstance(names, list) else []


def _columns(path: Path) -> dict[str, NDArray[Any]]:
    found: dict[str, NDArray[Any]] = {}
    with refusing(path, "parquet file"):
        import pyarrow as pa
        import pyarrow.parquet as pq

        with pq.ParquetFile(path) as file:
            check_rows(file.metadata.num_rows, str(path))
            groups = (file.metadata.row_group(k) for k in range(file.metadata.num_row_groups))
            claimed = sum(group.total_byte_size for group in groups)
            check_expansion(path.stat().st_size, max(claimed, file.metadata.num_rows), str(path))
            wanted = [f.name for f in file.schema_arrow if _is_numeric(f.type)]
            table = file.read(columns=wanted)
        for name, column in zip(table.column_names, table.columns, strict=True):
            whole = column.combine_chunks()
            if isinstance(whole, pa.ChunkedArray):
                whole = pa.concat_arrays(whole.chunks) if whole.num_chunks else pa.array([], whole.type)
            if pa.types.is_nested(whole.type):
                flat = whole.flatten().to_numpy(zero_copy_only=False)
                width, rest = divmod(flat.size, max(len(whole), 1))
                values = flat.reshape(len(whole), width) if not rest and width else np.empty((0, 0))
            else:
                values = whole.to_numpy(zero_copy_only=False)
            if is_usable(values.shape, values.dtype):
                found[name] = values
    return found


def _is_numeric(kind: Any) -> bool:
    import pyarrow as pa

    if pa.types.is_list(kind) or pa.types.is_fixed_size_list(kind) or pa.types.is_large_list(kind):
        kind = kind.value_type
    return bool(pa.types.is_floating(kind) or pa.types.is_integer(kind))
