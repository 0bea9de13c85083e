"""Files of arrays: ``.npz``, HDF5 (also MATLAB 7.3), parquet, and LeRobot datasets; every array of numbers is a column.

Pickled objects are refused; an array's size is checked before any of it is read. A LeRobot dataset is a folder with
``meta/info.json`` and parquet files, one or more episodes each. Its lists are named by the names of its ``info.json``
(``observation.state/shoulder_pan.pos``). It does not say their unit, and its time is made up from the frame rate: both
are told.
"""

from __future__ import annotations

import json
import math
import zipfile
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


def open_npz(path: Path) -> ArrayTable:
    """The arrays of a ``.npz`` file.

    Raises:
        InputFileError: unreadable, or larger than it may be.
    """
    with refusing(path, "npz file"), zipfile.ZipFile(path) as archive:
        check_expansion(path.stat().st_size, sum(info.file_size for info in archive.infolist()), str(path))
        values: dict[str, NDArray[Any]] = {}
        for info in archive.infolist():
            with archive.open(info) as file:
                formats: Any = np.lib.format
                first = formats.read_magic(file) == (1, 0)
                read_head = formats.read_array_header_1_0 if first else formats.read_array_header_2_0
                shape, _, dtype = read_head(file)
                if not is_usable(shape, dtype):
                    continue
                if math.prod(shape) * dtype.itemsize > info.file_size:
                    raise InputFileError(f"{info.filename}: shape {shape} is more than it holds", where=str(path))
            with archive.open(info) as file:
                array = np.lib.format.read_array(file, allow_pickle=False)
                values[info.filename.removesuffix(".npy")] = array
    return ArrayTable.of(path, values)


def open_hdf5(path: Path) -> ArrayTable:
    """The data sets of an HDF5 file by their paths in it; they are read when asked for.

    Raises:
        InputFileError: unreadable, or h5py is not installed.
    """
    shapes: dict[str, tuple[int, ...]] = {}
    sizes: dict[str, int] = {}
    with refusing(path, "HDF5 file"):
        import h5py

        def look(name: str, item: Any) -> None:
            if isinstance(item, h5py.Dataset) and not name.startswith("#") and is_usable(item.shape or (), item.dtype):
                shapes[name] = item.shape
                sizes[name] = max(item.size * item.dtype.itemsize, 1)

        with h5py.File(path, "r") as file:
            file.visititems(look)

    def load(name: str) -> NDArray[Any]:
        import h5py

        check_expansion(path.stat().st_size, sizes[name], f"{path}, {name}")
        with h5py.File(path, "r") as file:
            return np.asarray(file[name][()])

    return ArrayTable(path, shapes, load)


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
