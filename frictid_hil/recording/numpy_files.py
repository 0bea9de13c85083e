"""``.npz`` and HDF5 (also MATLAB 7.3): every array of numbers is a column, every matrix a row of them.

Pickled objects are refused; an array's size is checked before any of it is read.
"""

from __future__ import annotations

import math
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from frictid_hil.errors import InputFileError
from frictid_hil.recording.arrays import ArrayTable, is_usable, refusing
from frictid_hil.recording.bounds import check_expansion


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
                version = np.lib.format.read_magic(file)
                read_head = np.lib.format.read_array_header_1_0 if version == (1, 0) else _head_2_0
                shape, _, dtype = read_head(file)
                if not is_usable(shape, dtype):
                    continue
                if math.prod(shape) * dtype.itemsize > info.file_size:
                    raise InputFileError(f"{info.filename}: shape {shape} is more than it holds", where=str(path))
            with archive.open(info) as file:
                array = np.lib.format.read_array(file, allow_pickle=False)
                values[info.filename.removesuffix(".npy")] = array
    return ArrayTable.of(path, values)


def _head_2_0(file: Any) -> Any:
    return np.lib.format.read_array_header_2_0(file)


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
