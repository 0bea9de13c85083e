"""Tables made of named arrays: what .mat, npz, HDF5, parquet, ROS and JSON logs come down to.

A column of a matrix is its name and an ``index``, or ``name/0``, ``name/1``, ... or ``name/`` and the file's label.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from frictid_hil.columns import ColumnMap
from frictid_hil.errors import FrictidError, InputFileError
from frictid_hil.friction.trajectory import Array
from frictid_hil.recording.bounds import check_rows

Shape = tuple[int, ...]
MAX_COLUMNS = 128  # matrices that are wider are images and the like


@dataclass(frozen=True, slots=True)
class ArrayTable:
    """Named arrays of one file; a ``Table``."""

    path: Path
    shapes: Mapping[str, Shape]
    load: Callable[[str], NDArray[Any]]
    # Names of the columns of a matrix, by the matrix' name.
    labels: Mapping[str, Sequence[str]] = field(default_factory=dict)
    standard: ColumnMap | None = None  # what the columns mean, where the format says so
    sparse: bool = False  # rows in which a column holds NaN say nothing of it
    told: tuple[str, ...] = ()
    read: dict[str, NDArray[Any]] = field(default_factory=dict, repr=False)  # arrays that were asked for, kept

    @staticmethod
    def of(path: Path, values: Mapping[str, NDArray[Any]], **more: Any) -> ArrayTable:
        """A table of arrays that are in memory; those that are no columns of numbers are left out."""
        usable = {name: value for name, value in values.items() if is_usable(value.shape, value.dtype)}
        return ArrayTable(path, {name: value.shape for name, value in usable.items()}, usable.__getitem__, **more)

    @property
    def names(self) -> list[str]:
        """Every column; matrices column by column."""
        found: list[str] = []
        for name, shape in self.shapes.items():
            width = _width(shape)
            found += [f"{name}/{label}" for label in self._labels(name)] if width > 1 else [name]
        return found

    def numbers(self, names: Sequence[str]) -> list[Array]:
        """Vectors, shape (n,) each; (1,) for scalars."""
        return [self._column(name) for name in names]

    def elements(self, name: str, index: int) -> Array:
        """One column of a matrix, shape (n,)."""
        if name not in self.shapes:
            raise self._no_such(name)
        value = self._oriented(name)
        if index >= value.shape[1]:
            raise InputFileError(f"{name} {self.shapes[name]} has no column {index}", where=str(self.path))
        return np.ascontiguousarray(value[:, index], dtype=np.float64)

    def place(self, row: int) -> str:
        """The row, counted from 1."""
        return f"row {row + 1}"

    def _column(self, name: str) -> Array:
        if name in self.shapes:
            if _width(self.shapes[name]) > 1:
                raise InputFileError(
                    f"variable {name} is a matrix {self.shapes[name]}; say with `index` which of its columns",
                    where=str(self.path),
                )
            return self.elements(name, 0)
        matrix, _, label = name.rpartition("/")
        if matrix in self.shapes and label in self._labels(matrix):
            return self.elements(matrix, list(self._labels(matrix)).index(label))
        raise self._no_such(name)

    def _no_such(self, name: str) -> InputFileError:
        return InputFileError(
            f"no numeric variable {name!r}; the file has {', '.join(self.names)[:300] or 'none'}", where=str(self.path)
        )

    def _labels(self, name: str) -> Sequence[str]:
        width = _width(self.shapes[name])
        labels = self.labels.get(name, ())
        return labels if len(labels) == width else [str(k) for k in range(width)]

    def _oriented(self, name: str) -> NDArray[Any]:
        """The array with time along its rows."""
        if name in self.read:
            return self.read[name]
        check_rows(max(self.shapes[name], default=1), str(self.path))
        with refusing(self.path):
            value = np.asarray(self.load(name))
        value = value.reshape(-1, 1) if value.ndim < 2 else value
        self.read[name] = value.T if value.shape[0] < value.shape[1] else value
        return self.read[name]


def is_usable(shape: Shape, dtype: np.dtype[Any]) -> bool:
    """Real numbers in one or two dimensions, and no picture."""
    real = dtype.kind in "biuf"
    return real and len(shape) <= 2 and all(shape) and _width(shape) <= MAX_COLUMNS


def _width(shape: Shape) -> int:
    return min(shape) if len(shape) == 2 else 1


@contextmanager
def refusing(path: Path, what: str = "") -> Iterator[None]:
    """Whatever a library can run into in a spoilt file, as an ``InputFileError``."""
    try:
        yield
    except FrictidError:
        raise
    except ImportError as error:
        raise InputFileError(
            f"cannot be read without the package {error.name or error}",
            where=str(path),
            next_step="pip install 'frictid-hil[logs]'",
        ) from None
    except OSError as error:
        raise InputFileError(f"cannot be read: {error.strerror or error}", where=str(path)) from None
    except MemoryError:
        raise InputFileError("asks for more memory than there is", where=str(path)) from None
    except Exception as error:  # each library has errors of its own, some of the bare language
        raise InputFileError(
            f"not a readable {what or 'file'}: {error or type(error).__name__}"[:400],
            where=str(path),
            cause="truncated or spoilt, or of another format",
        ) from None
