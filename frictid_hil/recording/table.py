"""A table with named columns, whatever file it came from, and the samples made of it.

Tables are read by name and by need; a value that cannot be used is told with its column and its line.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Protocol

import numpy as np

from frictid_hil.columns import ColumnMap, JointColumns, Source
from frictid_hil.errors import InputFileError
from frictid_hil.friction.trajectory import Array
from frictid_hil.plan.linear_axis import linear_name
from frictid_hil.recording.samples import Nanoseconds, Samples, checked

_EPOCH_NS = 1e17
"""Times beyond this (three years) are of a wall clock; run time is what has passed since the first row."""

_MAY_BE_MISSING = ("external_torque_nm", "temperature_c")


class Table(Protocol):
    """Named columns of equal length; a constant is a column of one value."""

    path: Path

    def numbers(self, names: Sequence[str]) -> list[Array]:
        """Columns as float64, shape (n,) each (or (1,) for a constant); ``InputFileError`` for a name it has not."""
        ...

    def elements(self, name: str, index: int) -> Array:
        """One value of each cell of a column whose cells are lists, shape (n,)."""
        ...

    def place(self, row: int) -> str:
        """Where row ``row`` (from 0) stands, for a person: ``line 17``."""
        ...


def mapped(open_table: Callable[[Path], Table], path: Path, columns: ColumnMap, joint: str | None) -> list[Samples]:
    """The joints of a foreign file.

    Args:
        open_table: opens a file of this kind.
        path: of the file.
        columns: which column is which.
        joint: name of the only one wanted.

    Raises:
        InputFileError: a column is missing or cannot be used; a companion file does not fit; no such joint.
    """
    if joint is not None and joint not in columns.joints:
        raise InputFileError(
            f"column map {columns.name} knows no joint {joint!r}; it has {', '.join(columns.joints)}", where=str(path)
        )
    table = open_table(path)
    (time,) = table.numbers(columns.time.columns)
    companions: dict[str, Table] = {}

    def table_of(source: Source) -> Table:
        if source.file is None:
            return table
        if source.file not in companions:
            companion = open_table(_beside(path, source.file))
            _check_belongs(companion, columns.time, time, path)
            companions[source.file] = companion
        return companions[source.file]

    return [
        _joint_samples(name, known, time, columns.time.scale, table, table_of)
        for name, known in columns.joints.items()
        if joint in (None, name)
    ]


def samples_of(
    table: Table,
    joint: str,
    time: Array,
    columns: dict[str, Array],
    *,
    unit_ns: float,
    prismatic: bool,
    meta: dict[str, object],
) -> Samples:
    """Samples from columns in SI units, after every check a reader owes its user.

    Args:
        table: names the place of a bad value.
        joint: name.
        time: in its own unit, shape (n,).
        columns: by the names of ``Samples``.
        unit_ns: nanoseconds in the unit of ``time``.
        prismatic: the values are m, m/s, N.
        meta: provenance.

    Raises:
        InputFileError: a blank, NaN or infinite value, or time that does not increase, with column and line.
    """
    for name, column in {"time": time, **columns}.items():
        bad = np.flatnonzero(~np.isfinite(column))
        if bad.size and name not in _MAY_BE_MISSING:
            shown = linear_name(name) if prismatic else name
            raise InputFileError(
                f"{table.place(int(bad[0]))}: {shown} is {column[bad[0]]} ({bad.size} such rows)",
                where=str(table.path),
                next_step="remove the rows, or fill the gaps; nothing is interpolated silently",
            )
    time_ns = _run_time(time, unit_ns, table)
    backwards = np.flatnonzero(np.diff(time_ns) <= 0)
    if backwards.size:
        raise InputFileError(
            f"{table.place(int(backwards[0]) + 1)}: time does not increase ({backwards.size} such rows)",
            where=str(table.path),
            cause="rows reordered, two recordings joined, or time written with too few digits",
        )
    return checked(
        Samples(joint=joint, time_ns=time_ns, prismatic=prismatic, meta=meta, **columns),  # type: ignore[arg-type]
        where=str(table.path),
    )


def _joint_samples(
    name: str, known: JointColumns, time: Array, unit_ns: float, table: Table, table_of: Callable[[Source], Table]
) -> Samples:
    columns = {}
    for quantity, source in known.sources.items():
        column = _values(table_of(source), source)
        columns[quantity] = np.full(time.size, column[0]) if column.size == 1 else column
        if columns[quantity].size != time.size:
            raise InputFileError(
                f"{' * '.join(source.columns)} has {column.size} values for {time.size} times", where=str(table.path)
            )
    return samples_of(table, name, time, columns, unit_ns=unit_ns, prismatic=known.prismatic, meta=dict(known.meta))


def _values(table: Table, source: Source) -> Array:
    """The product of the source's columns in SI units."""
    if source.index is not None:
        product = table.elements(source.columns[0], source.index)
    else:
        product, *others = table.numbers(source.columns)
        for other in others:
            if other.size not in (1, product.size) and product.size != 1:
                raise InputFileError(
                    f"{' * '.join(source.columns)}: columns of {product.size} and {other.size} values",
                    where=str(table.path),
                )
            product = product * other
    scaled: Array = product * source.scale + source.offset
    return scaled


def _run_time(time: Array, unit_ns: float, table: Table) -> Nanoseconds:
    if time.size and abs(time[0]) > _EPOCH_NS / unit_ns:
        time = time - time[0]
    if time.size and np.abs(time).max() > 9e18 / unit_ns:
        raise InputFileError("a time is out of range", where=str(table.path))
    time_ns: Nanoseconds = np.rint(time * unit_ns).astype(np.int64)
    return time_ns


def _beside(path: Path, name: str) -> Path:
    """The companion file in the same folder, gzipped like the first or not."""
    for candidate in (path.with_name(name), path.with_name(name + ".gz")):
        if candidate.exists():
            return candidate
    raise InputFileError(f"its companion {name} is not beside it", where=str(path))


def _check_belongs(companion: Table, time: Source, expected: Array, path: Path) -> None:
    (found,) = companion.numbers(time.columns)
    if found.shape != expected.shape or not np.array_equal(found, expected):
        raise InputFileError(
            f"its rows ({found.size}) are not at the times of {path.name} ({expected.size} rows)",
            where=str(companion.path),
            cause="two recordings, or two loggers that do not write at the same instants",
        )
