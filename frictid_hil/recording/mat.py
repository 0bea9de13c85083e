"""MATLAB files: every numeric vector or matrix column is a column, every scalar a constant.

Fields of a struct are named ``struct.field``. Version 7.3 is HDF5 inside and is read as such. Nothing is executed.
"""

from __future__ import annotations

from pathlib import Path

from frictid_hil.errors import InputFileError
from frictid_hil.recording.arrays import ArrayTable
from frictid_hil.recording.mat5 import SpoiltMatFile, read_numbers
from frictid_hil.recording.numpy_files import open_hdf5


def open_mat(path: Path) -> ArrayTable:
    """The numeric variables of a ``.mat`` file.

    Raises:
        InputFileError: unreadable, or larger than it may be.
    """
    try:
        data = path.read_bytes()
    except (OSError, MemoryError) as error:
        raise InputFileError(f"cannot be read: {error}", where=str(path)) from None
    if data.startswith(b"MATLAB 7.3"):
        return open_hdf5(path)
    try:
        values = read_numbers(data)
    except (SpoiltMatFile, MemoryError) as error:
        raise InputFileError(
            f"not a readable MATLAB file: {error}",
            where=str(path),
            cause="truncated or spoilt, or older than version 5",
        ) from None
    return ArrayTable.of(path, values)
