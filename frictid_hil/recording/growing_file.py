"""A file that grows by whole pieces: what a reader finds after any crash ends where a piece ended."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Self

from frictid_hil.files import could_not_write


class GrowingFile:
    """Appends pieces to a new file, each of them all or nothing; ``end`` tells the bytes written so far.

    An existing file is replaced, a link is not followed. Where the disk refuses, every method raises a
    ``FrictidError``; what was written is kept.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self.end = 0
        try:
            handle = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_NOFOLLOW, 0o666)
        except OSError as error:
            raise could_not_write(path, error) from error
        self._file = os.fdopen(handle, "wb", buffering=0)

    @property
    def closed(self) -> bool:
        """Nothing can be written any more."""
        return self._file.closed

    def write(self, piece: bytes) -> None:
        """Append a piece; where that fails the file ends where it did before."""
        view = memoryview(piece)
        try:
            while view:
                view = view[self._file.write(view) :]
        except OSError as error:
            self._file.truncate(self.end)
            self._file.seek(self.end)
            raise could_not_write(self._path, error) from error
        self.end += len(piece)

    def rewrite_head(self, head: bytes) -> None:
        """Replace the first bytes, for formats that tell there what only the end knows; nothing follows it."""
        try:
            self._file.seek(0)
            self._file.write(head)
        except OSError as error:
            raise could_not_write(self._path, error) from error

    def sync(self) -> None:
        """Have everything on the disk before returning."""
        try:
            os.fsync(self._file.fileno())
        except OSError as error:
            raise could_not_write(self._path, error) from error

    def close(self) -> None:
        """Release the file; safe to call twice."""
        self._file.close()


class GrowingLog:
    """A log in a file that grows: what was taken is written by ``flush``, what only the end knows by ``close``."""

    def __init__(self, path: Path) -> None:
        self._file = GrowingFile(path)

    def flush(self) -> None:
        """Write what was taken and sync it; ``FrictidError`` where the disk is full: what was flushed is kept."""
        self._write_taken()
        self._file.sync()

    def close(self) -> None:
        """Flush, and finish the file; safe to call twice."""
        if self._file.closed:
            return
        try:
            self.flush()
            self._finish()
            self._file.sync()
        finally:
            self._file.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _write_taken(self) -> None:
        raise NotImplementedError

    def _finish(self) -> None:
        raise NotImplementedError
