"""A table with named columns, whatever file it came from, and the samples made of it.

Tables are read by name and by need; a value that cannot be used is told with its column and its line.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Protocol

import numpy as np

from frictid_hil.columns import JOINT, ColumnMap, JointColumns, Source
from frictid_hil.errors import InputFileError
from frictid_hil.friction.trajectory import Array
from frictid_hil.plan.linear_axis import linear_name
from frictid_hil.recording.proofs import doubts_of
from frictid_hil.recording.samples import MAY_BE_MISSING, Nanoseconds, Samples, checked

_EPOCH_NS = 1e17  # times beyond this (three years) are of a wall clock; run time is what has passed since the first row


class Table(Protocol):
    """Named columns of equal length; a constant is a column of one value."""

    @property
    def path(self) -> Path:
        """The file that was read."""

    @property
    def names(self) -> Sequence[str]:
        """Names of the columns."""

    @property
    def standard(self) -> ColumnMap | None:
        """What the columns mean, where the format itself says so."""

    @property
    def sparse(self) -> bool:
        """A row in which a column holds NaN says nothing of it (several publishers, several joints)."""

    @property
    def told(self) -> tuple[str, ...]:
        """What was found out about the file, in sentences."""

    def numbers(self, names: Sequence[str]) -> list[Array]:
        """Columns as float64, shape (n,) each (or (1,) for a constant); ``InputFileError`` for a name it has not."""

    def elements(self, name: str, index: int) -> Array:
        """One value of each cell of a column whose cells are lists, shape (n,)."""

    def place(self, row: int) -> str:
        """Where row ``row`` (from 0) stands, for a person: ``line 17``."""


def mapped(
    open_table: Callable[[Path], Table], table: Table, columns: ColumnMap, joint: str | None = None
) -> list[Samples]:
    """The joints of a foreign file, or the only one wanted; ``open_table`` opens a companion file.

    ``InputFileError``: a column is missing or cannot be used; a companion file does not fit; no such joint.
    """
    path = table.path
    joints = expanded(columns, table)
    if joint is not None and joint not in joints:
        raise InputFileError(
            f"column map {columns.name} knows no joint {joint!r}; it has {', '.join(joints)}", where=str(path)
        )
    chosen = {name: known for name, known in joints.items() if joint in (None, name)}
    wanted = [source for known in chosen.values() for source in known.sources.values()]
    here = [name for source in wanted if source.file is None and source.index is None for name in source.columns]
    table.numbers([*columns.time.columns, *here])  # all at once; tables keep what they have read
    time = _time(table, columns)
    companions: dict[str, Callable[[Array], Array]] = {}

    def values_of(source: Source) -> Array:
        if source.file is None:
            return _values(table, source)
        companion = open_table(_beside(path, source.file))
        values = _values(companion, source)
        if source.file not in companions:
            companions[source.file] = _onto(companion, columns, time, path)
        return companions[source.file](values)

    return [_joint_samples(name, known, time, columns.time.scale, table, values_of) for name, known in chosen.items()]


def expanded(columns: ColumnMap, table: Table) -> dict[str, JointColumns]:
    """The joints of a map; an entry ``{joint}`` stands for every joint whose position the file has.

    No column of the form that the map says is an ``InputFileError``.
    """
    found = {name: known for name, known in columns.joints.items() if JOINT not in name}
    for pattern, known in columns.joints.items():
        if JOINT not in pattern:
            continue
        position = known.sources["position_rad"].columns[0]
        form = re.compile(re.escape(position).replace(re.escape(JOINT), "(.+?)"))
        names = [match[1] for match in map(form.fullmatch, table.names) if match]
        if not names:
            raise InputFileError(
                f"no column {position!r}; the file has {', '.join(table.names)[:300]}", where=str(table.path)
            )
        for name in names:
            sources = {
                quantity: replace(source, columns=tuple(column.replace(JOINT, name) for column in source.columns))
                for quantity, source in known.sources.items()
            }
            present = {q: s for q, s in sources.items() if s.file or set(s.columns) <= set(table.names)}
            found[pattern.replace(JOINT, name)] = replace(known, sources=present)
    return found


def own_names(table: Table, joint: str) -> ColumnMap:
    """The map of a table that has our own names, of a joint or of a linear axis; else ``InputFileError``."""
    prismatic = "position_m" in table.names
    names = {name: linear_name(name) if prismatic else name for name in Samples.COLUMNS}
    sources = {ours: Source((theirs,)) for ours, theirs in names.items() if theirs in table.names}
    if "time_s" not in table.names or "position_rad" not in sources:
        raise InputFileError(
            f"no columns time_s and position_rad; the file has {', '.join(table.names)[:300] or 'none'}",
            where=str(table.path),
            next_step="`frictid-hil columns` looks at the file and drafts the map for --columns",
        )
    return ColumnMap("standard names", Source(("time_s",), 1e9), {joint: JointColumns(sources, prismatic)})


def samples_of(
    table: Table,
    joint: str,
    time: Array,
    columns: dict[str, Array],
    *,
    unit_ns: float,
    prismatic: bool,
    meta: Mapping[str, object],
) -> Samples:
    """Samples from columns in SI units by the names of ``Samples``, shape (n,) each, after every check of a reader.

    Times are in units of ``unit_ns`` nanoseconds. ``InputFileError`` for a value that is not finite, or time that does
    not increase, with column and line (which the table tells).
    """
    for name, column in {"time": time, **columns}.items():
        bad = np.flatnonzero(~np.isfinite(column))
        if bad.size and name not in MAY_BE_MISSING:
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
            next_step="sort the rows, give each recording a file, or write the time with more digits",
        )
    samples = checked(
        Samples(joint=joint, time_ns=time_ns, prismatic=prismatic, meta=meta, **columns),  # type: ignore[arg-type]
        where=str(table.path),
    )
    doubts = doubts_of(samples, where=f"{table.path}, joint {joint}")
    return replace(samples, meta={**samples.meta, "doubts": doubts}) if doubts else samples


def _joint_samples(
    name: str,
    known: JointColumns,
    time: Array,
    unit_ns: float,
    table: Table,
    values_of: Callable[[Source], Array],
) -> Samples:
    columns: dict[str, Array] = {}
    for quantity, source in known.sources.items():
        column = values_of(source)
        columns[quantity] = np.full(time.size, column[0]) if column.size == 1 else column
        if columns[quantity].size != time.size:
            raise InputFileError(
                f"{' * '.join(source.columns)} has {column.size} values for {time.size} times", where=str(table.path)
            )
    told = list(table.told)
    if table.sparse:
        said = np.isfinite(columns["position_rad"])
        said[1:] &= np.diff(time) > 0.0
        time = time[said]
        columns = {q: kept for q, column in columns.items() if not np.isnan(kept := column[said]).all()}
    for quantity in ("position_rad", "position_command_rad"):
        if quantity in columns and not known.prismatic:
            columns[quantity], turns = unwrapped(columns[quantity])
            if turns:
                told.append(f"{quantity} jumped by whole turns {turns} times and was unwrapped")
    if (shift := known.command_shift_s) and "position_command_rad" in columns:
        moved = time * unit_ns * 1e-9
        columns["position_command_rad"] = np.interp(moved - shift, moved, columns["position_command_rad"])
        told.append(f"the command was shifted by {1e3 * shift:g} ms, as the column map says")
    meta = {**known.meta, **({"told": tuple(told)} if told else {})}
    return samples_of(table, name, time, columns, unit_ns=unit_ns, prismatic=known.prismatic, meta=meta)


def unwrapped(angle_rad: Array) -> tuple[Array, int]:
    """An angle without jumps of a turn, and how many there were.

    A jump is a step of more than 0.9 of a turn where the steps around it are less than a tenth of one, so that neither
    a fast joint nor an angle in degrees is taken for one that wraps.
    """
    steps = np.diff(angle_rad)
    turn = 2 * np.pi
    jumps = (np.abs(np.abs(steps) - turn) < 0.1 * turn) & np.isfinite(steps)
    if not jumps.any() or float(np.ptp(angle_rad)) > 1.05 * turn:
        return angle_rad, 0
    if float(np.nanquantile(np.abs(steps[~jumps]), 0.99)) > 0.1 * turn:
        return angle_rad, 0
    turns = np.concatenate([[0.0], np.cumsum(np.where(jumps, -np.sign(steps), 0.0))])
    return angle_rad + turn * turns, int(np.count_nonzero(jumps))


def _time(table: Table, columns: ColumnMap) -> Array:
    """In the map's unit; made from the rate where the file has no column of time."""
    if columns.time.columns:
        (time,) = table.numbers(columns.time.columns)
        return time
    first = next(iter(expanded(columns, table).values()))
    return np.arange(_values(table, first.sources["position_rad"]).size, dtype=np.float64)


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
    return np.asarray(product * source.scale + source.offset)


def _run_time(time: Array, unit_ns: float, table: Table) -> Nanoseconds:
    if time.size and abs(time[0]) > _EPOCH_NS / unit_ns:
        time = time - time[0]
    if time.size and np.abs(time).max() > 9e18 / unit_ns:
        raise InputFileError("a time is out of range", where=str(table.path))
    return np.asarray(np.rint(time * unit_ns).astype(np.int64))


def _beside(path: Path, name: str) -> Path:
    """The companion file in the same folder, gzipped like the first or not."""
    for candidate in (path.with_name(name), path.with_name(name + ".gz")):
        if candidate.exists():
            return candidate
    raise InputFileError(f"its companion {name} is not beside it", where=str(path))


def _onto(companion: Table, columns: ColumnMap, time: Array, path: Path) -> Callable[[Array], Array]:
    """What brings a companion's values to the times of the first file: the last value before each, on one clock."""
    (found,) = companion.numbers(columns.time.columns)
    if found.shape == time.shape and np.array_equal(found, time):
        return lambda values: values
    slack = 0.05 * (time[-1] - time[0]) if time.size else 0.0
    covers = found.size >= max(10, time.size // 50) and found[0] <= time[0] + slack and found[-1] >= time[-1] - slack
    if not covers or (np.diff(found) < 0).any():
        raise InputFileError(
            f"its rows ({found.size}) are not at the times of {path.name} ({time.size} rows), nor do they cover them",
            where=str(companion.path),
            cause="files of two recordings, or of two clocks",
        )
    at = np.clip(np.searchsorted(found, time, side="right") - 1, 0, None)
    return lambda values: values[at]
