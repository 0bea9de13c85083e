"""Recordings of the friction tools BAM (JSON) and PACE (``.pt``, written by torch)."""

from __future__ import annotations

import io
import json
import pickle
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from frictid_hil.columns import JOINT, ColumnMap, JointColumns, Source
from frictid_hil.errors import InputFileError
from frictid_hil.recording.arrays import ArrayTable, refusing
from frictid_hil.recording.bounds import MAX_BYTES, check_expansion

_DTYPES = {
    "FloatStorage": "<f4",
    "DoubleStorage": "<f8",
    "LongStorage": "<i8",
    "IntStorage": "<i4",
    "HalfStorage": "<f2",
}


def open_bam(path: Path) -> ArrayTable:
    """A raw recording of BAM: a servo with a pendulum; position and goal in rad, times in s. Load is a duty: left out.

    Raises:
        InputFileError: not such a file.
    """
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
    """A recording of PACE: ``time``, ``dof_pos`` and ``des_dof_pos`` in s and rad, without running its pickle.

    Raises:
        InputFileError: not such a file, or one that holds anything but tensors of numbers.
    """
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
