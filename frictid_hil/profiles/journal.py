"""A journal: JSON values, one a line, only ever added to. A line counts once its last byte is on the disk."""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from frictid_hil.errors import FrictidError
from frictid_hil.files import could_not_write, sync_folder


def journal_lines(path: Path) -> list[dict[str, Any]]:
    """The values of a journal's whole lines, oldest first; nothing where there is no journal yet.

    Raises:
        FrictidError: it cannot be read.
    """
    try:
        raw = path.read_bytes()
    except FileNotFoundError:
        return []
    except OSError as error:
        raise FrictidError(f"cannot be read: {error.strerror}", where=str(path)) from error
    values = []
    for line in raw.split(b"\n")[:-1]:
        try:
            value = json.loads(line)
        except ValueError:
            continue  # spoilt, and passed over: one line lost must not lose the rest
        if isinstance(value, dict):
            values.append(value)
    return values


def append_line(path: Path, value: Mapping[str, Any]) -> None:
    """Add a line and have it on the disk before returning; one writer at a time, which the caller sees to.

    Raises:
        FrictidError: disk full, or no permission; the journal is as before.
    """
    append_lines(path, [value])


def append_lines(path: Path, values: Iterable[Mapping[str, Any]]) -> None:
    """Add lines; as ``append_line``. A crash in the middle leaves the first few of them."""
    new = not path.exists()
    with path.open("ab", buffering=0) as file:
        end = _end_of_whole_lines(path)
        try:
            # What a crash cut off never counted; it must not begin to by getting its line end now.
            file.truncate(end)
            left = memoryview(b"".join(json.dumps(value).encode() + b"\n" for value in values))
            while left:
                left = left[file.write(left) :]
            os.fsync(file.fileno())
        except OSError as error:
            file.truncate(end)
            raise could_not_write(path, error) from error
    if new:
        sync_folder(path.parent)


def _end_of_whole_lines(path: Path) -> int:
    return path.read_bytes().rfind(b"\n") + 1
