"""Files on disk: replaced whole or not at all, a full disk told as such, and no name that leads out of a folder."""

from __future__ import annotations

import errno
import os
import re
import secrets
import tempfile
from collections.abc import Iterable
from pathlib import Path

from frictid_hil.errors import FrictidError, UsageError

PLAIN_NAME = r"[A-Za-z0-9_][A-Za-z0-9_. -]{0,63}"
"""What may name a joint or a robot, and so a file: no separator, no leading dot."""


def part_of_path(name: str) -> str:
    """The name itself, where it may be part of a path; else (``../x``, ``left/elbow``) a ``UsageError``."""
    if re.fullmatch(PLAIN_NAME, name) is None:
        raise UsageError(f"{name!r} cannot name a file; letters, digits, '_', '-', '.' and spaces can")
    return name


def refuse_overwriting(paths: Iterable[Path | None], *, force: bool = False) -> None:
    """Refuse to write over what is there, naming all of it in a ``UsageError``, unless ``force``."""
    there = [str(path) for path in paths if path is not None and path.exists()]
    if there and not force:
        raise UsageError(
            "exists already, and would be overwritten",
            where=", ".join(there),
            next_step="choose another place, or add --force to replace it",
        )


def made_folders(path: Path) -> list[Path]:
    """Make a folder where there is none, see that it takes files, and tell which folders were made.

    Raises:
        FrictidError: no permission, no space, or a file is in the way; what was made is gone again.
    """
    made: list[Path] = []
    try:
        for folder in reversed([folder for folder in (path, *path.parents) if not folder.exists()]):
            folder.mkdir(exist_ok=True)
            made.append(folder)
        with tempfile.TemporaryFile(dir=path):
            return made
    except OSError as error:
        for folder in reversed(made):
            folder.rmdir()
        raise FrictidError(f"cannot be written to: {error.strerror}", where=str(path)) from error


def made_folder(path: Path, kind: type[FrictidError] = FrictidError, next_step: str = "") -> None:
    """Make a folder where there is none.

    Raises:
        FrictidError: of this kind: no permission, no space, or a file is in the way.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise kind(f"cannot be created: {error.strerror}", where=str(path), next_step=next_step) from error


def write_whole(path: Path, text: str | bytes) -> None:
    """Write a file so that every reader, at any moment and after any crash, sees the old content or the new, whole.

    The new content is staged in the same folder (a rename works only within one file system), synced, and named last.

    Raises:
        FrictidError: disk full, or no permission.
    """
    content = text.encode() if isinstance(text, str) else text
    staged = path.with_name(f".{path.name}.{secrets.token_hex(6)}.part")
    try:
        # Made anew, so through no link; readable for whom the account's umask lets it be.
        handle = os.open(staged, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o666)
        with os.fdopen(handle, "wb") as file:
            file.write(content)
            file.flush()
            os.fsync(handle)
        staged.replace(path)
        sync_folder(path.parent)
    except OSError as error:
        raise could_not_write(path, error) from error
    finally:
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
