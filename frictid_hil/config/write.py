"""YAML out, for people and for bytes that repeat: block style, keys in the order given, shortest exact floats.

A list of plain values stays on one line, so that a curve reads as a row; so does ``{value: .., low: .., high: ..}``.
Files are replaced whole or not at all.
"""

from __future__ import annotations

import errno
import math
import os
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml
import yamlcore

from frictid_hil.errors import FrictidError


class _Writer(yamlcore.CCoreDumper):  # type: ignore[misc]  # yamlcore is untyped
    def ignore_aliases(self, data: Any) -> bool:
        return True


def _on_one_line(value: Any) -> bool:
    scalars = all(not isinstance(item, list | dict) for item in value)
    return scalars or all(isinstance(item, list) and len(item) == 2 and _on_one_line(item) for item in value)


def _represent_list(writer: Any, value: list[Any]) -> Any:
    return writer.represent_sequence("tag:yaml.org,2002:seq", value, flow_style=_on_one_line(value))


def _represent_dict(writer: Any, value: dict[str, Any]) -> Any:
    on_one_line = not value or (next(iter(value)) == "value" and _on_one_line(value.values()))
    return writer.represent_mapping("tag:yaml.org,2002:map", value.items(), flow_style=on_one_line)


_Writer.add_representer(list, _represent_list)
_Writer.add_representer(dict, _represent_dict)


def dump(values: Mapping[str, Any]) -> str:
    """The values as YAML text; reading it back gives the same values, floats bit for bit.

    Raises:
        ValueError: a number that is not finite, or a value that is no mapping, list, text, number, truth or None.
    """
    text: str = yaml.dump(
        plain(values), Dumper=_Writer, sort_keys=False, allow_unicode=True, width=100, default_flow_style=False
    )
    return text


def plain(value: Any) -> Any:
    """Mappings, sequences and numbers of any library as the plain kinds that YAML and JSON know.

    Raises:
        ValueError: as ``dump``.
    """
    if value is None or isinstance(value, str | bool):
        return value
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if hasattr(value, "tolist"):  # numpy scalars and arrays
        return plain(value.tolist())
    if isinstance(value, float) and not math.isfinite(value):
        raise ValueError(f"{value} is not a finite number; write None and a reason")
    if isinstance(value, int | float):
        return value
    raise ValueError(f"{type(value).__name__} is no plain value")


def write_whole(path: Path, text: str | bytes, *, replace: bool = True) -> None:
    """Write a file so that every reader, at any moment and after any crash, sees the old content or the new, whole.

    The new content is staged in the same folder (a rename works only within one file system), synced, and named last.

    Args:
        path: of the file; its folder must exist.
        text: the whole content.
        replace: False to leave an existing file untouched and raise ``FileExistsError``.

    Raises:
        FrictidError: disk full, or no permission.
        FileExistsError: see ``replace``.
    """
    content = text.encode() if isinstance(text, str) else text
    staged = None
    try:
        handle, name = tempfile.mkstemp(prefix=f".{path.name}.", suffix=".part", dir=path.parent)
        staged = Path(name)
        with os.fdopen(handle, "wb") as file:
            os.fchmod(handle, 0o644)
            file.write(content)
            file.flush()
            os.fsync(handle)
        if replace:
            staged.replace(path)
        else:
            path.hardlink_to(staged)
        sync_folder(path.parent)
    except FileExistsError:
        raise
    except OSError as error:
        raise could_not_write(path, error) from error
    finally:
        if staged is not None:
            staged.unlink(missing_ok=True)


def sync_folder(folder: Path) -> None:
    """Make the names in a folder survive a power failure."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def could_not_write(path: Path, error: OSError) -> FrictidError:
    """The error a person should see when writing failed."""
    if error.errno in (errno.ENOSPC, errno.EDQUOT):
        return FrictidError(
            "the disk is full; what was written before is kept", where=str(path), next_step="free some space (`df -h`)"
        )
    return FrictidError(f"cannot be written: {error.strerror or error}", where=str(path))
