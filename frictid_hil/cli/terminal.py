"""A terminal that is closed under a run: SIGHUP stops the run, which must not fail for want of a place to print."""

from __future__ import annotations

import errno
import io
import os
import sys


class _Terminal(io.TextIOWrapper):
    """Text to a terminal; once that is gone, to nowhere."""

    def write(self, text: str) -> int:
        """As of any file."""
        try:
            return super().write(text)
        except OSError as error:
            self._leave(error)
            return len(text)

    def flush(self) -> None:
        """As of any file."""
        try:
            super().flush()
        except OSError as error:
            self._leave(error)

    def _leave(self, error: OSError) -> None:
        if error.errno != errno.EIO:
            raise error
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, self.fileno())
        os.close(nowhere)


def outlive_the_terminal() -> None:
    """Let stdout and stderr, where they are a terminal, take text even after it was closed."""
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if isinstance(stream, io.TextIOWrapper) and stream.isatty():
            lasting = _Terminal(stream.buffer, stream.encoding, stream.errors, line_buffering=True)
            setattr(sys, name, lasting)
