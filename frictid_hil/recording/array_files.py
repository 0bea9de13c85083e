"""Files of arrays: ``.npz``, HDF5 (also MATLAB 7.3), parquet, and LeRobot datasets; every array of numbers is a column.

Pickled objects are refused; an array's size is checked before any of it is read. A LeRobot dataset is a folder with
``meta/info.json``, which names its lists (``observation.state/shoulder_pan.pos``), and parquet files of episodes; that
its units are not said, and its time is made up from the frame rate, is told. Recordings of the friction tools BAM
(JSON) and PACE (``.pt``, of torch) are read, too. What cannot be read, or lacks its library, is an ``InputFileError``.
"""

from __future__ import annotations

import io
import json
import math
import pickle
import zipfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from frictid_hil.columns import JOINT, ColumnMap, JointColumns, Source
from frictid_hil.errors import InputFileError
from frictid_hil.recording.arrays import ArrayTable, is_usable, refusing
from frictid_hil.recording.bounds import MAX_BYTES, check_expansion, check_rows

_PAUSE_S = 1.0  # between episodes, whose times all begin at zero
_DTYPES = {
    "FloatStorage": "<f4",
    "DoubleStorage": "<f8",
    "LongStorage": "<i8",
    "IntStorage": "<i4",
    "HalfStorage": "<f2",
}


def open_npz(path: Path) -> ArrayTable:
    """The arrays of a ``.npz`` file."""
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
    """The data sets of an HDF5 file by their paths in it; they are read when asked for."""
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
    """The columns of a parquet file; lists of equal length are matrices."""
    return ArrayTable.of(path, _columns(path))


def is_lerobot(path: Path) -> bool:
    """A folder that holds such a dataset."""
    return (path / "meta" / "info.json").is_file()


def open_lerobot(path: Path) -> ArrayTable:
    """All episodes of a dataset, one after the other on one clock, a second apart."""
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


def open_bam(path: Path) -> ArrayTable:
    """A recording of BAM, a servo with a pendulum: position and goal in rad, times in s; load, a duty, is left out."""
    with refusing(path, "BAM recording"):
        if path.stat().st_size > MAX_BYTES // 10:
            raise InputFileError("too large for a JSON recording", where=str(path))
        document = json.loads(path.read_text(encoding="utf-8"))
        entries = document["entries"]
        keys = [key for key, value in entries[0].items() if isinstance(value, int | float)]
        values = {key: np.array([float(entry[key]) for entry in entries]) for key in keys}
        known = {key: value for key, value in document.items() if isinstance(value, int | float)}
    sources = {"position_rad": Source(("position",)), "position_command_rad": Source(("goal_position",))}
    joint = JointColumns(sources, meta={f"bam_{key}": value for key, value in known.items()})
    standard = ColumnMap("BAM recording", Source(("timestamp",), 1e9), {str(document.get("motor", "0")): joint})
    return ArrayTable.of(path, values, standard=standard)


def open_pace(path: Path) -> ArrayTable:
    """A recording of PACE: ``time``, ``dof_pos`` and ``des_dof_pos`` in s and rad, without running its pickle."""
    with refusing(path, "recording of PACE"):
        values = {name: value for name, value in _tensors(path).items() if isinstance(value, np.ndarray)}
    sources = {
        "position_rad": Source((f"dof_pos/{JOINT}",)),
        "position_command_rad": Source((f"des_dof_pos/{JOINT}",)),
    }
    standard = ColumnMap("PACE recording", Source(("time",), 1e9), {JOINT: JointColumns(sources)})
    return ArrayTable.of(path, values, standard=standard)


def _tensors(path: Path) -> dict[str, Any]:
    """The mapping that torch saved: a zip with a pickle and one file of raw numbers for each tensor."""
    with zipfile.ZipFile(path) as archive:
        check_expansion(path.stat().st_size, sum(info.file_size for info in archive.infolist()), str(path))
        inside = {name.split("/", 1)[-1]: name for name in archive.namelist()}
        head = archive.read(inside["data.pkl"])
        found = _Tensors(head, lambda key: archive.read(inside[f"data/{key}"])).load()
    if not isinstance(found, dict):
        raise InputFileError("holds no mapping of tensors", where=str(path))
    return found


class _Tensors(pickle.Unpickler):
    """Reads tensors as arrays; every other thing that a pickle can name is refused."""

    def __init__(self, head: bytes, storage: Callable[[str], bytes]) -> None:
        super().__init__(io.BytesIO(head))
        self._storage = storage

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) == ("torch._utils", "_rebuild_tensor_v2"):
            return _array
        if (module, name) == ("collections", "OrderedDict"):
            return dict
        if module == "torch" and name in _DTYPES:
            return _DTYPES[name]
        raise pickle.UnpicklingError(f"{module}.{name} is no tensor")

    def persistent_load(self, pid: Any) -> NDArray[Any]:
        _, dtype, key, *_ = pid
        return np.frombuffer(self._storage(str(key)), dtype)


def _array(
    storage: NDArray[Any], offset: int, shape: tuple[int, ...], stride: tuple[int, ...], *_: Any
) -> NDArray[Any]:
    reach = offset + sum((n - 1) * step for n, step in zip(shape, stride, strict=True) if n) + 1
    if offset < 0 or any(step < 0 for step in stride) or (all(shape) and reach > storage.size):
        raise pickle.UnpicklingError(f"a tensor of shape {shape} in {storage.size} numbers")
    steps = [step * storage.itemsize for step in stride]
    return np.lib.stride_tricks.as_strided(storage[offset:], shape, steps).copy()
