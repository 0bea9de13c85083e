"""MATLAB files up to version 7: every numeric vector is a column, every scalar a constant.

Under the standard names (``time_s``, ``position_rad``, ...) a file needs no column map. Fields of a struct are named
``struct.field``. Nothing in the file is executed.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from frictid_hil.columns import ColumnMap, JointColumns, Source
from frictid_hil.errors import InputFileError
from frictid_hil.friction.trajectory import Array
from frictid_hil.plan.linear_axis import linear_name
from frictid_hil.recording.mat5 import SpoiltMatFile, read_numbers
from frictid_hil.recording.samples import Samples
from frictid_hil.recording.table import mapped


def read_mat(path: Path, columns: ColumnMap | None = None, joint: str | None = None) -> list[Samples]:
    """The recording in a ``.mat`` file.

    Args:
        path: of the file.
        columns: which variable is which; None for the standard names.
        joint: name ("0" unless told); with a column map the only one wanted.

    Raises:
        InputFileError: unreadable, of version 7.3, or a variable that is missing or cannot be used.
    """
    if columns is None:
        columns = _standard(MatTable(path), joint or "0")
    return mapped(MatTable, path, columns, joint)


class MatTable:
    """A ``.mat`` file; a ``Table``.

    Raises:
        InputFileError: unreadable, or of version 7.3.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._values = _load(path)
        self.names = list(self._values)

    def numbers(self, names: Sequence[str]) -> list[Array]:
        """Vectors, shape (n,) each; (1,) for scalars."""
        columns = []
        for name in names:
            value = self._value(name)
            if value.size != max(value.shape):
                raise InputFileError(
                    f"variable {name} is a matrix {value.shape}; say with `index` which of its columns",
                    where=str(self.path),
                )
            columns.append(value.ravel())
        return columns

    def elements(self, name: str, index: int) -> Array:
        """One column of a matrix, shape (n,)."""
        value = self._value(name)
        if index >= value.shape[1]:
            raise InputFileError(f"variable {name} {value.shape} has no column {index}", where=str(self.path))
        return np.ascontiguousarray(value[:, index])

    def place(self, row: int) -> str:
        """The row, counted as MATLAB does."""
        return f"row {row + 1}"

    def _value(self, name: str) -> Array:
        if name not in self._values:
            raise InputFileError(
                f"no numeric variable {name!r}; the file has {', '.join(self.names)[:300] or 'none'}",
                where=str(self.path),
            )
        return self._values[name]


def _load(path: Path) -> dict[str, Array]:
    """The numeric vectors, matrices and scalars of a file, shape (n, k) each."""
    try:
        data = path.read_bytes()
    except (OSError, MemoryError) as error:
        raise InputFileError(f"cannot be read: {error}", where=str(path)) from None
    if data.startswith(b"MATLAB 7.3"):
        raise InputFileError(
            "a MATLAB 7.3 file, which is HDF5 inside",
            where=str(path),
            next_step="save it with `save(name, '-v7')`, or export CSV",
        )
    try:
        values = read_numbers(data)
    except (SpoiltMatFile, MemoryError) as error:
        raise InputFileError(
            f"not a readable MATLAB file: {error}",
            where=str(path),
            cause="truncated or spoilt, or older than version 5",
        ) from None
    return {name: value for name, value in values.items() if value.ndim == 2 and value.size}


def _standard(table: MatTable, joint: str) -> ColumnMap:
    """The map of a file that uses our own names."""
    prismatic = "position_m" in table.names
    names = {name: linear_name(name) if prismatic else name for name in Samples.COLUMNS}
    sources = {ours: Source((theirs,)) for ours, theirs in names.items() if theirs in table.names}
    if "time_s" not in table.names or "position_rad" not in sources:
        raise InputFileError(
            f"no variables time_s and position_rad; the file has {', '.join(table.names)[:300] or 'none'}",
            where=str(table.path),
            next_step="say by --columns MAP which variable is which",
        )
    return ColumnMap("standard names", Source(("time_s",), 1e9), {joint: JointColumns(sources, prismatic)})
