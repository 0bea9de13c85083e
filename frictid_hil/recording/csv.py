"""CSV in and out, gzipped or not: for people with other tools.

Header ``time_s,position_rad,velocity_rad_s,torque_nm,position_command_rad``; time, position and one of torque and
command must be there. A linear axis writes ``position_m,velocity_m_s,force_n,position_command_m``. Units are never
guessed: a header in other words needs a column map. Separators, decimal commas, lines before the header, a row of units
under it and text in Windows-1252 are found out and told.
"""

from __future__ import annotations

import codecs
import csv
import difflib
import gzip
import io
import re
import warnings
import zlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO

import numpy as np

from frictid_hil.columns import ColumnMap
from frictid_hil.errors import InputFileError
from frictid_hil.files import write_whole
from frictid_hil.friction.trajectory import Array
from frictid_hil.plan.linear_axis import linear_name
from frictid_hil.recording.bounds import MAX_BYTES, MAX_ROWS, check_expansion, check_rows
from frictid_hil.recording.draft import UNITS, without_unit
from frictid_hil.recording.samples import MAY_BE_MISSING, Samples
from frictid_hil.recording.table import mapped, samples_of

_MAX_HEADER = 65_536
_MOST_REMARKS = 10_000  # blank lines and remarks before the header, and between it and the first row
_MOST_TITLES = 50  # lines before the header that are neither: who measured, when, with what

_ORDER = (
    "position_rad",
    "velocity_rad_s",
    "torque_nm",
    "position_command_rad",
    "rigid_body_torque_nm",
    "torque_demand_nm",
    "external_torque_nm",
    "temperature_c",
)


def read_csv(path: Path, columns: ColumnMap | None = None, joint: str | None = None) -> list[Samples]:
    """The recording in a CSV file (``.csv`` or ``.csv.gz``): one joint under the standard header, or what a map says.

    ``joint`` is its name ("0" unless told); with a column map the only one wanted. ``InputFileError`` for what is
    unreadable, or a value that cannot be used, with line and column.
    """
    if columns is not None:
        return mapped(CsvTable, CsvTable(path), columns, joint)
    table = CsvTable(path)
    prismatic = "position_m" in table.names
    names = {(linear_name(name) if prismatic else name): name for name in _ORDER}
    present = [name for name in names if name in table.names]
    _check_header(table, names, present, path)
    time_s, *values = table.numbers(["time_s", *present])
    quantities = {names[name]: values[k] for k, name in enumerate(present)}
    for optional in MAY_BE_MISSING:
        if optional in quantities and np.isnan(quantities[optional]).all():
            del quantities[optional]
    meta = {"told": table.told} if table.told else {}
    return [samples_of(table, joint or "0", time_s, quantities, unit_ns=1e9, prismatic=prismatic, meta=meta)]


def write_csv(path: Path, samples: Samples) -> None:
    """Write one joint under the standard header, to be read back bit for bit; raises as ``write_whole``."""
    columns = samples.columns()
    names = [name for name in _ORDER if name in columns]
    text = io.StringIO()
    text.write(",".join(["time_s", *(linear_name(name) if samples.prismatic else name for name in names)]) + "\n")
    for t_ns, *row in zip(samples.time_ns.tolist(), *(columns[name].tolist() for name in names), strict=True):
        seconds, rest = divmod(t_ns, 1_000_000_000)
        text.write(f"{seconds}.{rest:09d},{','.join(map(repr, row))}\n")
    raw = text.getvalue().encode()
    write_whole(path, gzip.compress(raw, mtime=0) if path.suffix == ".gz" else raw)


@dataclass(frozen=True, slots=True)
class Dialect:
    """How a file is written: what separates its cells, and whether 1,5 is one and a half."""

    separator: str = ","
    decimal_comma: bool = False

    @staticmethod
    def of(header: str, first: str) -> Dialect:
        """What fits header and first row: the separator that is in both equally often, more often than any other."""
        counts = {mark: (len(_cells(header, mark)), len(_cells(first, mark))) for mark in ",;\t|"}
        fitting = [mark for mark, (a, b) in counts.items() if a > 1 and (a == b or not first)]
        if not fitting:  # a comma within the cells of the first row may be a decimal one, or a mistake
            fitting = [mark for mark in ";\t|," if counts[mark][0] > 1] or [","]
        separator = max(fitting, key=lambda mark: counts[mark][0])
        cells = [cell.strip() for cell in _cells(first, separator)]
        return Dialect(separator, separator != "," and any(_DECIMAL_COMMA.fullmatch(cell) for cell in cells))

    def told(self) -> tuple[str, ...]:
        """What is unusual about it."""
        name = {";": "semicolons", "\t": "tabs", "|": "bars"}.get(self.separator)
        said = [f"cells are separated by {name}"] if name else []
        return (*said, "numbers have decimal commas") if self.decimal_comma else tuple(said)


_DECIMAL_COMMA = re.compile(r"[+-]?\d*,\d+([eE][+-]?\d+)?")


def _cells(line: str, separator: str) -> list[str]:
    return next(csv.reader([line], delimiter=separator), [])


class CsvTable:
    """A CSV file with a header; a ``Table``. Blank lines and lines that begin with ``#`` are passed over.

    A file that is unreadable, or has no header that can be used, is an ``InputFileError``.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.standard: ColumnMap | None = None
        self.sparse = False
        self._read: dict[str, Array] = {}
        with _reading(path):
            self._encoding = _encoding(path)
            with _open(path, self._encoding) as file:
                header, units, first, self._header_lines, titles = _header(file, str(path))
        self.dialect = Dialect.of(header, first)
        self.told = self.dialect.told()
        if titles:
            self.told += (f"the header is line {self._header_lines}; what stands above it is passed over",)
        if self._encoding == _WESTERN:
            self.told += ("the text is not UTF-8 and is read as Windows-1252",)
        self.names = [name.strip() for name in _cells(header, self.dialect.separator)]
        if units:
            self.names = list(map(_with_unit, self.names, _cells(units, self.dialect.separator)))
            self.told += (f"line {self._header_lines} holds the units of the columns: {', '.join(self.names)}",)
        where = f"{path}, line {self._header_lines}"
        if all(_is_number(name) for name in self.names):
            raise InputFileError("no header: the first line holds numbers", where=where)
        twice = [name for name in self.names if self.names.count(name) > 1]
        if twice:
            raise InputFileError(f"column {twice[0]!r} appears twice in the header", where=where)

    def numbers(self, names: Sequence[str]) -> list[Array]:
        """Columns as float64, shape (n,) each; what is asked for together is read in one go."""
        new = [name for name in dict.fromkeys(names) if name not in self._read]
        if new:
            self._read.update(zip(new, self._parsed(new), strict=True))
        return [self._read[name] for name in names]

    def _parsed(self, names: Sequence[str]) -> list[Array]:
        at = [self._index(name) for name in names]
        with _reading(self.path), warnings.catch_warnings():
            self._check_row_lengths()
            warnings.simplefilter("ignore", UserWarning)  # "no data": said better by whoever needs rows
            try:
                values = np.loadtxt(
                    self._lines_with_points() if self.dialect.decimal_comma else self.path,
                    delimiter=self.dialect.separator,
                    skiprows=self._header_lines,
                    usecols=at,
                    quotechar='"',
                    max_rows=MAX_ROWS + 1,
                    ndmin=2,
                    encoding="utf-8" if self._encoding == _UNICODE else self._encoding,
                )
            except UnicodeDecodeError:
                raise
            except ValueError as error:
                raise self._explained(at, error) from None
        check_rows(len(values), str(self.path))
        return list(np.ascontiguousarray(values.T)) if values.size else [np.empty(0) for _ in names]

    def elements(self, name: str, index: int) -> Array:
        """One value of each list in a column, shape (n,)."""
        at = self._index(name)
        values = []
        with _reading(self.path):
            for line, row in self._rows():
                try:
                    cell = row[at].strip(" []()")
                    values.append(float(cell.split(",")[index] if "," in cell else cell.split()[index]))
                except (IndexError, ValueError):
                    found = row[at][:40] if at < len(row) else "nothing"
                    raise InputFileError(
                        f"line {line}, column {name}: no value number {index} in {found!r}", where=str(self.path)
                    ) from None
        return np.array(values)

    def place(self, row: int) -> str:
        """The line of a row."""
        with _reading(self.path):
            for k, (line, _) in enumerate(self._rows()):
                if k == row:
                    return f"line {line}"
        return f"row {row}"

    def _check_row_lengths(self) -> None:
        """A row with a comma too many would be read as something else."""
        expected = len(self.names)
        rows = commas = unpacked = 0
        last, size, separator = b"\n", self.path.stat().st_size, self.dialect.separator.encode()
        with _open_bytes(self.path) as file:
            while block := file.read(1 << 20):
                rows += block.count(b"\n")
                commas += block.count(separator)
                last = block
                unpacked += len(block)
                if unpacked > size or size > MAX_BYTES:
                    check_expansion(size, unpacked, str(self.path))
        check_rows(rows - self._header_lines, str(self.path))
        rows += not last.endswith(b"\n")
        if commas == rows * (expected - 1):
            return  # the plain case, told by counting alone
        for line, row in self._rows():
            if len(row) != expected:
                raise InputFileError(
                    f"line {line} has {len(row)} values where the header has {expected}",
                    where=str(self.path),
                    cause="the file ends in the middle of a line, or a separator is missing or too many",
                )

    def _index(self, name: str) -> int:
        if name not in self.names:
            raise InputFileError(
                f"no column {name!r}; the file has {', '.join(self.names)[:300]}",
                where=f"{self.path}, line {self._header_lines}",
            )
        return self.names.index(name)

    def _rows(self) -> Iterator[tuple[int, list[str]]]:
        """Line number and cells of each row of data."""
        with _open(self.path, self._encoding) as file:
            reader = csv.reader(file, delimiter=self.dialect.separator)
            for row in reader:
                if reader.line_num > self._header_lines and row and not row[0].lstrip().startswith("#"):
                    yield reader.line_num, row

    def _lines_with_points(self) -> Iterator[str]:
        with _open(self.path, self._encoding) as file:
            for line in file:
                yield line.replace(",", ".")

    def _is_number(self, cell: str) -> bool:
        return _is_number(cell.replace(",", ".") if self.dialect.decimal_comma else cell)

    def _explained(self, at: Sequence[int], error: ValueError) -> InputFileError:
        """What is wrong with the file that could not be read as numbers: the first bad cell."""
        where = str(self.path)
        for line, row in self._rows():
            if len(row) <= max(at):
                return InputFileError(
                    f"line {line} has {len(row)} values where the header has {len(self.names)}", where=where
                )
            for k in at:
                if not row[k].strip():
                    next_step = "remove the row, or fill the gap; nothing is interpolated silently"
                    message = f"line {line}, column {self.names[k]}: blank"
                    return InputFileError(message, where=where, next_step=next_step)
                if not self._is_number(row[k]):
                    return InputFileError(
                        f"line {line}, column {self.names[k]}: {row[k][:40]!r} is not a number", where=where
                    )
        return InputFileError(f"cannot be read as numbers: {error}", where=where)


def _check_header(table: CsvTable, names: dict[str, str], present: list[str], path: Path) -> None:
    """Refuse what is missing, and what looks like a known column in other words."""
    where = f"{path}, line 1"
    position = "position_m" if "position_m" in names else "position_rad"
    missing = [name for name in ("time_s", position) if name not in table.names]
    for unknown in table.names:
        near = difflib.get_close_matches(unknown.lower(), [n for n in [*names, "time_s"] if n not in present], n=1)
        if unknown not in names and near and near[0] not in table.names:
            raise InputFileError(
                f"unknown column {unknown!r}; did you mean {near[0]}?",
                where=where,
                next_step="rename it, or say by --columns MAP which column is which and in what unit",
            )
    if missing:
        raise InputFileError(
            f"no column {' and '.join(missing)}; the file has {', '.join(table.names)[:300]}",
            where=where,
            next_step="`frictid-hil columns` looks at the file and drafts the map for --columns",
        )
    torque, command = [name for name, ours in names.items() if ours in ("torque_nm", "position_command_rad")]
    if torque not in present and command not in present:
        raise InputFileError(f"neither {torque} nor {command}", where=where)


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return "_" not in text


_UNICODE, _WESTERN = "utf-8-sig", "cp1252"


def _encoding(path: Path) -> str:
    """Windows-1252 where the file begins with text that is not UTF-8; else UTF-8, whose errors name the byte."""
    with _open_bytes(path) as file:
        start = file.read(_MAX_HEADER)
    try:
        codecs.getincrementaldecoder("utf-8")().decode(start)
    except UnicodeDecodeError:
        return _UNICODE if re.search(rb"[\x00-\x08\x0e-\x1f\x81\x8d\x8f\x90\x9d]", start) else _WESTERN
    return _UNICODE


def _header(file: IO[str], where: str) -> tuple[str, str, str, int, int]:
    """Names, units, first row, the number of the header's last line, and how many lines of a title stand above it.

    The header is the first line of words whose cells are as many as those of the row of numbers that follows; where
    there is none, the first line that is no remark. If it holds units, the names stand in the line above it.
    """
    lines: list[tuple[int, str]] = []
    for number in range(1, _MOST_REMARKS + 1):
        line = file.readline(_MAX_HEADER)
        if not line:
            break
        if line.strip() and not line.lstrip().startswith("#"):
            lines.append((number, line))
            if len(lines) > _MOST_TITLES:
                break
            if len(lines) > 1 and _heads(lines[-2][1], line):
                names, header = lines[-3][1] if len(lines) > 2 else "", lines[-2][1]
                if _units_under(names, header):
                    return names, header, line, lines[-2][0], len(lines) - 3
                return header, "", line, lines[-2][0], len(lines) - 2
    else:
        if not lines:
            raise InputFileError(f"no header within {_MOST_REMARKS:,} lines", where=where)
    if not lines:
        raise InputFileError("the file is empty", where=where)
    return lines[0][1], "", lines[1][1] if len(lines) > 1 else "", lines[0][0], 0


def _heads(header: str, row: str) -> bool:
    for separator in ",;\t|":
        names, cells = _cells(header, separator), _cells(row, separator)
        if len(names) == len(cells) > 1 and not any(map(_is_number, names)):
            numbers = [cell.replace(",", ".") if separator != "," else cell for cell in cells]
            if all(_is_number(cell) for cell in numbers):
                return True
    return False


def _units_under(header: str, row: str) -> bool:
    """At least half of the row's cells are units, and each has a name above it."""
    for separator in ",;\t|":
        names, cells = _cells(header, separator), _cells(row, separator)
        if len(names) == len(cells) > 1 and 2 * sum(_unit(cell).lower() in UNITS for cell in cells) >= len(cells):
            return not any(_unit(name).lower() in UNITS or _is_number(name) for name in names)
    return False


def _unit(cell: str) -> str:
    return cell.strip(" \t\r\n[]()")


def _with_unit(name: str, cell: str) -> str:
    """``pos [deg]``; a name that says the unit itself stays as it is."""
    unit = _unit(cell)
    said = without_unit(name)[1]
    return name if unit in ("", "-") or (said and said == UNITS.get(unit.lower())) else f"{name} [{unit}]"


def _open_bytes(path: Path) -> io.BufferedReader:
    return io.BufferedReader(gzip.GzipFile(path)) if path.suffix == ".gz" else path.open("rb")


def _open(path: Path, encoding: str) -> IO[str]:
    if path.suffix == ".gz":
        return gzip.open(path, "rt", encoding=encoding, newline="")
    return path.open(encoding=encoding, newline="")


@contextmanager
def _reading(path: Path) -> Iterator[None]:
    """Whatever reading a file can run into, as an ``InputFileError``."""
    where = str(path)
    try:
        yield
    except UnicodeDecodeError as error:
        raise InputFileError(f"not UTF-8 text: byte 0x{error.object[error.start]:02x}", where=where) from None
    except (OSError, EOFError, zlib.error) as error:  # the last two: a gzip file that is cut off or spoilt
        raise InputFileError(f"cannot be read: {getattr(error, 'strerror', None) or error}", where=where) from None
    except (csv.Error, MemoryError) as error:
        raise InputFileError(f"not CSV: {error or 'a line larger than memory'}", where=where) from None
